"""Streamed runs: as whole ones in every engine, memory that stays flat, and what a broken one leaves."""

from __future__ import annotations

import errno
import gc
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    FlowgraphError,
    OutputError,
    Run,
    Scalar,
    Series,
    Stream,
    UnknownNameError,
    graph,
    latest,
    read_pieces,
    scan,
    simulate,
)
from flowgraph.data.export.tables import write_parquet
from flowgraph.engines.python import run as run_module
from flowgraph.engines.streaming import NOTE, simulate_to_parquet
from flowgraph.graphs.benches.endurance import memory
from flowgraph.graphs.benches.growth import forget_peak, peak
from tests.support import scalars

dataset = pytest.importorskip("pyarrow.dataset")
parquet = pytest.importorskip("pyarrow.parquet")


@graph
def two(x: Stream[Scalar], y: Stream[Scalar]):
    total = scan(x, lambda s, x: 0.5 * s + x, init=0.0)
    return {"total": total, "held": y + latest(total, init=-1.0).at(y)}


def inputs(count: int) -> dict[str, Series]:
    """x at each ms, y at each third."""
    time = np.arange(count) * 1_000_000
    return {"x": scalars(time, np.sin(time * 1e-6)), "y": scalars(time[::3])}


def events(series: Series) -> Iterator[tuple[int, Any]]:
    return zip(series.time.tolist(), series["value"].tolist(), strict=True)


def read(folder: Path, name: str) -> tuple[list[int], list[float]]:
    table = dataset.dataset(folder / name).to_table()
    return table["time"].to_pylist(), table["value"].to_pylist()


def check(folder: Path, count: int, engine: str) -> None:
    whole = simulate(two.build(), inputs(count), engine=engine)
    for name in ("total", "held"):
        time, value = read(folder, name)
        assert time == whole[name].time.tolist()
        assert value == whole[name]["value"].tolist()


@pytest.mark.parametrize("engine", ["python", "reference", "c", "xla"])
def test_a_streamed_run_is_the_whole_one(tmp_path, engine):
    given = inputs(50)
    found = simulate_to_parquet(two.build(), given, tmp_path, engine=engine, ticks=8, parts=3)
    assert found.ticks == 50
    assert len(list((tmp_path / "total").iterdir())) == 3
    check(tmp_path, 50, engine)
    whole = simulate(two.build(), given, engine=engine)
    assert found.state["sources"] == whole.state["sources"]
    assert all(np.array_equal(a, found.state["registers"][p]) for p, a in whole.state["registers"].items())


def test_generators_are_read_some_ticks_at_a_time(tmp_path):
    taken = []

    def told(series: Series) -> Iterator[tuple[int, Any]]:
        for event in events(series):
            taken.append(event[0])
            yield event

    class Meter:
        def update(self, ticks: int, time: int) -> None:
            assert len(taken) <= ticks + 2  # one ahead, and where an iterator has ended
            steps.append(ticks)

    steps: list[int] = []
    given = inputs(40)
    simulate_to_parquet(
        two.build(), {"x": told(given["x"]), "y": events(given["y"])}, tmp_path, ticks=10, progress=Meter()
    )
    assert steps == [10, 20, 30, 40]
    check(tmp_path, 40, "python")


def test_a_run_that_was_broken_off_goes_on(tmp_path):
    given = inputs(60)

    def breaking() -> Iterator[tuple[int, Any]]:
        for n, event in enumerate(events(given["x"])):
            if n == 45:
                raise KeyboardInterrupt
            yield event

    with pytest.raises(KeyboardInterrupt):
        simulate_to_parquet(two.build(), {"x": breaking(), "y": given["y"]}, tmp_path, ticks=10, parts=2)
    assert read(tmp_path, "total")[0] == given["x"].time[:40].tolist()  # the part that broke is not there
    found = simulate_to_parquet(
        two.build(), {"x": events(given["x"]), "y": given["y"]}, tmp_path, ticks=10, parts=2, resume=True
    )
    assert found.ticks == 60
    check(tmp_path, 60, "python")
    again = simulate_to_parquet(two.build(), given, tmp_path, resume=True)  # nothing is left to be done
    assert again.ticks == 60
    check(tmp_path, 60, "python")


def test_what_the_folder_holds_is_respected(tmp_path):
    simulate_to_parquet(two.build(), inputs(10), tmp_path / "a")
    with pytest.raises(DataError, match="already here") as error:
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "a")
    assert "resume=True" in str(error.value.fix)
    with pytest.raises(DataError, match="another seed"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "a", seed=1, resume=True)
    with pytest.raises(DataError, match="no streamed run"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "b", resume=True)
    (tmp_path / "a" / NOTE).write_text("{}")
    with pytest.raises(DataError, match="no streamed run"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "a", resume=True)
    with pytest.raises(DeclarationError, match="whole number as 'ticks'"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "c", ticks=0)
    with pytest.raises(DeclarationError, match="whole number as 'parts'"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path / "c", parts=0)


def test_a_part_that_cannot_be_closed_is_not_there(tmp_path, monkeypatch):
    close = parquet.ParquetWriter.close

    def full(writer: Any) -> None:
        close(writer)
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(parquet.ParquetWriter, "close", full)
    with pytest.raises(OutputError, match="No space left"):
        simulate_to_parquet(two.build(), inputs(10), tmp_path)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_nothing_in_is_nothing_out(tmp_path):
    found = simulate_to_parquet(two.build(), {"x": iter(()), "y": iter(())}, tmp_path)
    assert (found.ticks, list(found.notes)) == (0, [])


def test_memory_does_not_grow_with_the_length(tmp_path):
    def ramp(count: int, step: int) -> Iterator[tuple[int, float]]:
        return ((n * step * 1000, float(n % 7)) for n in range(count))

    def most(count: int) -> int:
        given = {"x": ramp(count, 1), "y": ramp(count // 4, 4)}
        gc.collect()  # what others have left is not collected while it is measured
        tracemalloc.start()
        simulate_to_parquet(two.build(), given, tmp_path / str(count), ticks=500, parts=2)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return peak

    most(1000)  # what is imported and compiled once
    assert most(12_000) < 1.2 * most(3000) + 60_000  # kept, 9,000 more ticks would be 1.5 MB


def pieces(series: Series, *sizes: int) -> Iterator[Series]:
    """A series in pieces of these lengths, and the rest."""
    first = 0
    for size in sizes:
        yield series[first : first + size]
        first += size
    yield series[first:]


@pytest.mark.parametrize("engine", ["python", "c"])
def test_series_one_after_the_other_are_a_source(tmp_path, engine):
    given = inputs(100)
    mixed = {"x": pieces(given["x"], 0, 1, 33, 40), "y": events(given["y"])}
    found = simulate_to_parquet(two.build(), mixed, tmp_path, engine=engine, ticks=16)
    assert found.ticks == 100
    check(tmp_path, 100, engine)


def test_a_run_goes_on_within_a_piece(tmp_path):
    given = inputs(60)
    simulate_to_parquet(two.build(), {n: s[s.time < 25e6] for n, s in given.items()}, tmp_path)
    again = {"x": pieces(given["x"], 20, 20), "y": pieces(given["y"], 19)}
    assert simulate_to_parquet(two.build(), again, tmp_path, resume=True, ticks=7).ticks == 60
    check(tmp_path, 60, "python")


def test_simulate_takes_series_one_after_the_other_too():
    given = inputs(30)
    whole = simulate(two.build(), given)
    found = simulate(two.build(), {"x": pieces(given["x"], 7, 5), "y": pieces(given["y"], 3)})
    for name in ("total", "held"):
        assert found[name]["value"].tolist() == whole[name]["value"].tolist()


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([(0, 1.0), (2_000_000, 1.0), (1_000_000, 1.0)], "time goes backwards"),
        ([(0, 1.0), (1_000_000, np.nan)], "not finite"),
        ([(0, 1.0), (1.5, 1.0)], "integer nanoseconds"),
        ([(0, 1.0), 3], "an event is not a pair"),
        ([scalars([0, 1]), scalars([1, 2])], "two events at one time"),
        ([scalars([0, 1]), (2, np.ones(2))], "shape"),
    ],
)
def test_what_is_wrong_with_a_source_is_said_as_of_single_events(tmp_path, given, words):
    for run in (
        lambda data: simulate_to_parquet(two.build(), data, tmp_path),
        lambda data: simulate(two.build(), data),
    ):
        with pytest.raises(FlowgraphError) as error:
            run({"x": iter(given), "y": scalars([])})
        assert words in str(error.value)


def test_masked_and_nested_values_are_taken_one_by_one(tmp_path):
    masked: list[Any] = [(0, np.ma.array(1.0, mask=True))]
    with pytest.raises(DataError, match="not finite"):
        simulate_to_parquet(two.build(), {"x": masked, "y": scalars([])}, tmp_path)
    whole: list[Any] = [(0, 1), (1_000_000, True), (2_000_000, np.float32(0.5))]
    with pytest.raises(FlowgraphError):  # no truth value is a number, and is none among many either
        simulate_to_parquet(two.build(), {"x": whole, "y": scalars([])}, tmp_path)
    found = simulate_to_parquet(two.build(), {"x": whole[::2], "y": scalars([])}, tmp_path / "b")
    assert found.state["registers"]["scan.state"] == 1.0


def test_a_recording_is_read_by_pieces(tmp_path):
    pytest.importorskip("pandas")
    time = np.arange(1000) * 1_000_000
    series = scalars(time, np.sin(time * 1e-6))
    write_parquet({"x": series}, tmp_path)
    np.savetxt(
        tmp_path / "x.csv", np.c_[time * 1e-9, series["value"]], delimiter=",", header="t,v", comments=""
    )
    for read_, exact in (
        (read_pieces(tmp_path / "x.parquet", rows=300), True),
        (read_pieces(tmp_path / "x.csv", time="t", unit="s", rows=300), False),
    ):
        some = list(read_)
        assert all(len(s) <= 300 for s in some) or not exact
        assert np.array_equal(np.concatenate([s.time for s in some]), time)
        np.testing.assert_allclose(
            np.concatenate([s["value"] for s in some]), series["value"], rtol=0 if exact else 1e-12
        )
    with pytest.raises(DataError, match="no table to read by pieces"):
        read_pieces(tmp_path / "none.parquet")
    with pytest.raises(UnknownNameError, match="column"):
        list(read_pieces(tmp_path / "x.parquet", time="t"))
    with pytest.raises(UnknownNameError, match="column"):
        list(read_pieces(tmp_path / "x.parquet", stamp="s"))


def test_much_that_is_collected_becomes_arrays(monkeypatch):
    """A run that packs what it has collected gives what one that never does gives."""
    given = inputs(100)
    whole = simulate(two.build(), given)
    monkeypatch.setattr(run_module, "_PACKED", 7)
    found = simulate(two.build(), given)
    run = Run(two.build(), {"x": events(given["x"]), "y": given["y"]}).to_end(most=50)
    some = run.drain().series["total"]
    rest = run.to_end().result().series["total"]
    for name in ("total", "held"):
        assert np.array_equal(found[name].time, whole[name].time)
        assert found[name]["value"].tolist() == whole[name]["value"].tolist()
    assert [*some["value"], *rest["value"]] == whole["total"]["value"].tolist()


CHILD = """
import sys
from pathlib import Path
from tests.engines.test_streaming import long_run
print(long_run(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])))
"""


def long_run(engine: str, count: int, folder: Path) -> int:
    """The bytes that a streamed run takes at most, beside what its process held before."""

    def made(step: int) -> Iterator[Series]:
        for first in range(0, count, 5000):
            time = np.arange(first, min(first + 5000, count), step, dtype=np.int64) * 1000
            yield Series(time, np.sin(time * 1e-9))

    def run(name: str) -> None:
        simulate_to_parquet(
            two.build(), {"x": made(1), "y": made(4)}, folder / name, engine=engine, ticks=8192
        )

    whole, count = count, 20_000
    run("first")
    count = whole
    forget_peak()
    before = memory()
    run("run")
    return peak() - before


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/clear_refs").exists(), reason="the system does not tell the peak")
@pytest.mark.parametrize("engine", ["python", "numpy", "c", "xla"])
def test_a_process_stays_small_however_long_the_run(tmp_path, engine):
    """A million ticks would be 16 MB of results alone; what is left is the allocator's."""

    def most(count: int) -> int:
        words = [sys.executable, "-c", CHILD, engine, str(count), str(tmp_path / str(count))]
        return int(subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()[-1])

    few, many = (50_000, 200_000) if engine == "numpy" else (100_000, 2_000_000)
    assert most(many) < most(few) + 8_000_000
