"""Many runs in C: each is what a single run in C gives, to the last bit, however its outputs get there."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    Scalar,
    Series,
    Signal,
    Stream,
    UnknownNameError,
    block,
    delay,
    graph,
    latest,
    real,
    simulate,
    simulate_many,
)

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

MS = 1_000_000


class Mixed(Signal):
    """Two leaves of different kinds."""

    place: Array = real(2, 3)
    total: Array = real()


@block
def mix(before: Scalar, a: Scalar, b: Scalar, *, draw, xp) -> Mixed:
    now = 0.5 * before + a + b + xp.sum(draw.normal("step", (3,)))
    return Mixed(place=now * xp.ones((2, 3)), total=now)


@graph
def mixed(a: Stream[Scalar], b: Stream[Scalar]):
    """One output at every tick of `a`, one at those of `b`, and one where the data say so."""
    memory = delay(0.0, name="memory")
    now = mix(memory, a, latest(b, init=0.0, at=a))
    total = now.map(lambda n: n.total)
    memory.feed(total)
    return {"now": now, "b": b.map(lambda x: 2.0 * x), "high": total.filter(lambda x: x > 0.0)}


def data(seed: int = 0, n: int = 120) -> dict[str, Series]:
    draw = np.random.default_rng(seed)
    time = np.arange(n) * 5 * MS
    few = time[::7] + 2 * (n % 2) * MS  # at the ticks of `a`, or between them
    return {"a": Series(time, draw.normal(size=n)), "b": Series(few, draw.normal(size=len(few)))}


def check(batch: Any, k: int, alone: Any) -> None:
    for name, runs in batch.series.items():
        run = runs.run(k)
        np.testing.assert_array_equal(run.time, alone[name].time)
        for leaf, array in run.leaves.items():
            np.testing.assert_array_equal(array, alone[name].leaves[leaf])
            assert array.dtype == alone[name].leaves[leaf].dtype


@pytest.fixture(scope="module")
def built():
    return mixed.build()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("keep", [None, ["now.total", "high"], ["b"]])
def test_runs_of_the_same_ticks(built, dtype, keep):
    init = [{"memory": float(k)} for k in range(5)]
    inputs = [data(k) for k in range(5)]
    batch = simulate_many(built, inputs, range(5), engine="c", dtype=dtype, init=init, keep=keep)
    assert set(batch.series) == ({n.partition(".")[0] for n in keep} if keep else {"now", "b", "high"})
    if keep is None:
        assert batch["now"].place.shape == (5, 120, 2, 3)
        assert batch["now"].present.all()
        assert batch["b"].value.shape == (5, 18)
        assert not batch["high"].present.all()
    assert all(a.dtype == dtype for runs in batch.series.values() for a in runs.leaves.values())
    if keep and "b" not in keep:
        assert list(batch["now"].leaves) == ["total"]
        with pytest.raises(UnknownNameError, match="place"):
            batch["now"]["place"]
    for k in range(5):
        alone = simulate(built, data(k), engine="c", dtype=dtype, init=init[k], seed=k)
        check(batch, k, alone)


def test_runs_of_other_ticks_are_put_on_the_union_of_their_times(built):
    inputs = [data(0, 120), data(1, 90), data(2, 120), data(3, 101)]
    batch = simulate_many(built, inputs, range(4), engine="c")
    assert batch["now"].present.sum(axis=1).tolist() == [120, 90, 120, 101]
    assert not batch["now"].place[1, 90:].any()
    for k, given in enumerate(inputs):
        check(batch, k, simulate(built, given, engine="c", seed=k))


def test_shared_inputs_and_start(built):
    batch = simulate_many(built, data(), [3, 4], engine="c", init={"memory": 2.0})
    for k, seed in enumerate([3, 4]):
        check(batch, k, simulate(built, data(), engine="c", init={"memory": 2.0}, seed=seed))


def test_presence_is_data_where_there_are_many_patterns():
    """Beyond eight patterns one reaction serves all, and what is present is known only afterwards."""

    @graph
    def wide(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar], d: Stream[Scalar]):
        return {"b": b.map(lambda x: x + 1.0), "sum": latest(c, init=0.0, at=d) + latest(a, init=0.0, at=d)}

    draw = np.random.default_rng(1)
    ticks = {n: np.flatnonzero(draw.random(80) < 0.5) * MS for n in "abcd"}
    inputs = {n: Series(t, draw.normal(size=len(t))) for n, t in ticks.items()}
    keys = sum((np.isin(np.arange(80) * MS, t) << k for k, t in enumerate(ticks.values())), np.zeros(80, int))
    assert len(set(keys.tolist()) - {0}) > 8
    built = wide.build()
    batch = simulate_many(built, inputs, range(3), engine="c")
    for k in range(3):
        check(batch, k, simulate(built, inputs, engine="c", seed=k))
    assert batch["b"].time.tolist() == ticks["b"].tolist()


def test_no_ticks_at_all(built):
    empty = {n: s[:0] for n, s in data().items()}
    batch = simulate_many(built, empty, range(2), engine="c")
    assert batch.ticks == 0
    assert batch["now"].place.shape == (2, 0, 2, 3)
