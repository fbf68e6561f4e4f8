"""Checkpoints: a run that was broken off goes on to the same bits; of another run, or cut, it does not."""

from __future__ import annotations

import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from flowgraph import (
    Checkpoint,
    DataError,
    DeclarationError,
    FifoOverflowError,
    Result,
    Scalar,
    Series,
    Stream,
    block,
    delay,
    every,
    graph,
    latest,
    match,
    simulate,
    sink,
    window,
)
from flowgraph import zip as zip_
from flowgraph.cli import app
from flowgraph.engines import checkpoint
from tests.support import MS, same, same_state, scalars


@block
def mean(state, x: Scalar):
    count, value = state[0] + 1, state[1] + (x - state[1]) / (state[0] + 1)
    return (count, value), value


@mean.init
def _(x):
    return (np.int32(0), 0.0)


@block
def leak(level: Scalar, x: Scalar, *, dt: float, draw: Any, gain: float) -> Scalar:
    return level * (1.0 - gain * dt) + x + draw.normal("leak", ())


@graph
def mixed(a: Stream[Scalar], b: Stream[Scalar], *, gain: float = 1.0):
    """Queues, counters, stamps, windows and random numbers."""
    level = delay(0.0, name="level")
    now = leak(level, a, gain=gain)
    level.feed(now)
    return {
        "now": now,
        "mean": mean(a),
        "held": latest(b, init=0.0, name="held").at(a),
        "zipped": zip_(every(2, a), every(2, a, phase=1), name="zipped"),
        "matched": match(a, b, tolerance=3 * MS, size=8, name="matched"),
        "seen": window(a, at=every(3, a), size=4, name="seen"),
    }


MIXED = mixed.build()


def recording(n: int = 40, seed: int = 0) -> dict[str, Series]:
    rng = np.random.default_rng(seed)
    return {
        "a": scalars(np.arange(n) * 10 * MS, rng.normal(size=n)),
        "b": scalars(np.arange(0, n, 2) * 10 * MS + 2 * MS, rng.normal(size=(n + 1) // 2)),
    }


def all_kept(
    monkeypatch: pytest.MonkeyPatch, folder: Path, every_s: float, **more: Any
) -> tuple[Result, list[Path]]:
    """A run that is kept, and each checkpoint that it wrote."""
    written: list[Path] = []
    write = checkpoint.write_checkpoint

    def noted(file: Path, kept: Any) -> None:
        written.append(folder / f"{len(written)}.npz")
        write(written[-1], kept)

    with monkeypatch.context() as patched:
        patched.setattr(checkpoint, "write_checkpoint", noted)
        found = simulate(MIXED, recording(), checkpoint=Checkpoint(folder / "x", every=every_s), **more)
    return found, written


@settings(max_examples=10, deadline=None)
@given(every_ms=st.integers(1, 500), engine=st.sampled_from(("python", "reference")), seed=st.integers(0, 9))
def test_a_run_goes_on_from_any_checkpoint_to_the_same_bits(every_ms, engine, seed):
    whole = simulate(MIXED, recording(), engine=engine, seed=seed)
    with tempfile.TemporaryDirectory() as folder, pytest.MonkeyPatch.context() as patch:
        kept, files = all_kept(patch, Path(folder), every_ms * 1e-3, engine=engine, seed=seed)
        same(kept, whole)
        span = (int(recording()["a"].time[-1]) // MS) // every_ms
        assert len(files) <= span
        assert bool(files) == (every_ms <= 390)
        for file in random.Random(every_ms).sample(files, min(4, len(files))):
            same(
                simulate(MIXED, recording(), engine=engine, seed=seed, checkpoint=Checkpoint(resume=file)),
                whole,
            )


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("engine", ["c", pytest.param("xla", marks=pytest.mark.slow)])
def test_compiled_engines_go_on_to_the_same_bits(engine, dtype, monkeypatch, tmp_path):
    whole = simulate(MIXED, recording(), engine=engine, dtype=dtype, seed=3)
    kept, files = all_kept(monkeypatch, tmp_path, 0.09, engine=engine, dtype=dtype, seed=3)
    same(kept, whole)
    assert len(files) == 4
    for file in files:
        again = Checkpoint(tmp_path / "again", every=0.05, resume=file)
        same(simulate(MIXED, recording(), engine=engine, dtype=dtype, seed=3, checkpoint=again), whole)


def test_it_tells_how_far_the_whole_run_is(monkeypatch, tmp_path):
    class Meter:
        def __init__(self):
            self.told = []

        def update(self, ticks: int, time: int) -> None:
            self.told.append(ticks)

    for engine in ("python", "c"):
        whole, files = all_kept(monkeypatch, tmp_path, 0.1, engine=engine)
        meter = Meter()
        simulate(MIXED, recording(), engine=engine, progress=meter, checkpoint=Checkpoint(resume=files[1]))
        assert meter.told == sorted(meter.told)
        assert meter.told[-1] == whole.ticks


OTHERS: Mapping[str, Mapping[str, Any]] = {
    "engine": {"engine": "reference"},
    "seed": {"seed": 8},
    "recording": {"inputs": recording(seed=1)},
    "form of this graph": {"graph": mixed.build(gain=0.5)},
    "start": {"init": {"level": 1.0}},
}


@pytest.mark.parametrize("what", OTHERS)
def test_a_checkpoint_of_another_run_is_refused_by_name(what, monkeypatch, tmp_path):
    _, files = all_kept(monkeypatch, tmp_path, 0.1, seed=7)
    given = {"graph": MIXED, "inputs": recording(), "seed": 7, **OTHERS[what]}
    with pytest.raises(DataError, match=f"this checkpoint is of another {what}"):
        simulate(given.pop("graph"), given.pop("inputs"), checkpoint=Checkpoint(resume=files[0]), **given)


def test_of_another_graph_or_version_too(monkeypatch, tmp_path):
    @graph
    def other(a: Stream[Scalar], b: Stream[Scalar]):
        return {"a": a, "b": b}

    _, files = all_kept(monkeypatch, tmp_path, 0.1)
    with pytest.raises(DataError, match="of another graph\n[\\s\\S]*other\n[\\s\\S]*mixed"):
        simulate(other.build(), recording(), checkpoint=Checkpoint(resume=files[0]))
    monkeypatch.setattr(checkpoint, "package_version", lambda: "99.0")
    with pytest.raises(DataError, match="of another version of flowgraph\n[\\s\\S]*99.0"):
        simulate(MIXED, recording(), checkpoint=Checkpoint(resume=files[0]))


def test_a_cut_or_damaged_one_never_loads(monkeypatch, tmp_path):
    _, files = all_kept(monkeypatch, tmp_path, 0.2)
    content = files[0].read_bytes()
    bad = tmp_path / "bad.npz"
    for size in np.linspace(0, len(content) - 1, 40, dtype=int).tolist():
        bad.write_bytes(content[:size])
        with pytest.raises(DataError, match="this is no checkpoint"):
            checkpoint.read_checkpoint(bad)
    right, refused = checkpoint.read_checkpoint(files[0]), 0
    for place in np.linspace(0, len(content) - 1, 60, dtype=int).tolist():
        bad.write_bytes(content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :])
        try:
            found = checkpoint.read_checkpoint(bad)
        except DataError:
            refused += 1
        else:  # a byte that means nothing, such as one of a date
            assert (found.ticks, found.identity) == (right.ticks, right.identity)
            same_state(found.state, right.state)
    assert refused > 30
    with pytest.raises(DataError, match="this is no checkpoint"):
        checkpoint.read_checkpoint(tmp_path / "none.npz")


def test_a_full_queue_is_the_same_error_after_going_on(tmp_path):
    @graph
    def waits(a: Stream[Scalar], b: Stream[Scalar]):
        return match(a, b, tolerance=1, size=4)

    built = waits.build()
    silent = {"a": scalars(np.arange(12) * 10 * MS), "b": scalars([0, 115 * MS])}
    for engine in ("python", "c"):
        with pytest.raises(FifoOverflowError) as plain:
            simulate(built, silent, engine=engine)
        file = tmp_path / f"{engine}.npz"
        for asked in (Checkpoint(file, every=0.02), Checkpoint(resume=file)):
            with pytest.raises(FifoOverflowError) as found:
                simulate(built, silent, engine=engine, checkpoint=asked)
            assert str(found.value) == str(plain.value)
            same(found.value.result, plain.value.result)


def test_what_cannot_be_kept_is_refused():
    with pytest.raises(DeclarationError, match="some time of the flight apart"):
        Checkpoint("x", every=0.0)
    with pytest.raises(DeclarationError, match="many runs start anew"):
        simulate(MIXED, recording(), seeds=[1, 2], checkpoint=Checkpoint("x"))

    @graph
    def shown(a: Stream[Scalar], b: Stream[Scalar]):
        sink(a, lambda x: None)
        return b.map(lambda x: 2.0 * x)

    with pytest.raises(DeclarationError, match="cut at the blocks of the host has no checkpoints"):
        simulate(shown.build(), recording(), engine="reference", checkpoint=Checkpoint("x"))


# -- the command, killed ---------------------------------------------------------------------------------

RUN = ("ins_eskf", "--data", "sim", "--set", "duration=8")


def command(*words: str) -> list[str]:
    return [sys.executable, "-c", "from flowgraph.cli import main; main()", "run", *words]


def figures(printed: str) -> dict[str, Any]:
    return {n: v for n, v in json.loads(printed).items() if n not in ("wall_s", "setup_s")}


def plain_run(*words: str) -> dict[str, Any]:
    done = subprocess.run(command(*words, "--json"), capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return figures(done.stdout)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["python", "c"])
def test_kill_9_and_go_on(engine, tmp_path):
    """Killed at a random moment, twice; then all figures are those of the run that nobody disturbed.

    A run that ends before it is killed is begun anew, and the next is given less time.
    """
    rng, span, file = random.Random(engine), 0.15, tmp_path / "run.npz"
    whole = plain_run(*RUN, "--engine", engine)
    kills = 0
    while kills < 2:
        words = ("--resume", str(file)) if kills else RUN
        kept = ("--checkpoint", str(file), "--every", "0.05", "--engine", engine, "--json")
        stamp = file.stat().st_mtime_ns if kills else None
        process = subprocess.Popen(command(*words, *kept), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        while process.poll() is None and (file.stat().st_mtime_ns if file.exists() else None) == stamp:
            time.sleep(0.002)
        time.sleep(rng.random() * span)
        process.kill()
        process.communicate()
        if process.returncode == -signal.SIGKILL:
            kills += 1
            checkpoint.read_checkpoint(file)
            continue
        assert process.returncode == 0
        if kills:
            break  # it has gone on, which is what is asked
        file.unlink()
        span /= 2.0
    resumed = plain_run("--resume", str(file))
    assert resumed == whole
    assert {"run.npz"} <= {f.name for f in tmp_path.iterdir()} <= {"run.npz", ".run.npz.part"}


def test_the_command_takes_from_the_checkpoint_what_is_left_out(tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "200")
    file = tmp_path / "run.npz"

    def invoke(*words: str) -> Any:
        return CliRunner().invoke(app, ["run", *words])

    first = invoke(*RUN[:3], "--set", "duration=3", "--seed", "4", "--engine", "c", "--json",
                   "--checkpoint", str(file), "--every", "1")  # fmt: skip
    again = invoke("--resume", str(file), "--json")
    assert figures(again.stdout) == figures(first.stdout)
    monkeypatch.chdir(tmp_path)
    elsewhere = invoke("--resume", str(file))
    assert "the checkpoint was written in" in elsewhere.stderr
    assert "the checkpoint was written in" not in again.stderr
    for words, status, said in (
        (("--resume", str(file), "ekf"), 1, "this checkpoint is of another graph"),
        (("--resume", str(file), "--set", "duration=2"), 1, "this checkpoint is of another recording"),
        (("--resume", str(file), "--engine", "reference"), 1, "this checkpoint is of another engine"),
        (("--resume", str(file), "--seed", "5"), 1, "this checkpoint is of another seed"),
        (("ekf", "--data", "sim", "--every", "5"), 2, "a time between checkpoints, and no file for them"),
        (("--data", "sim"), 2, "missing argument GRAPH"),
        (("ekf",), 2, "missing option --data SPEC"),
    ):
        refused = invoke(*words)
        assert refused.exit_code == status
        assert said in refused.output
