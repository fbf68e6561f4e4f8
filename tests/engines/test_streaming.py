"""Streamed runs: as whole ones in every engine, memory that stays flat, and what a broken one leaves."""

from __future__ import annotations

import errno
import gc
import tracemalloc
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    OutputError,
    Scalar,
    Series,
    Stream,
    graph,
    latest,
    scan,
    simulate,
)
from flowgraph.engines.streaming import NOTE, simulate_to_parquet
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
