"""Outputs that come in stretches, and the ticks of a chunk as XLA takes them."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from flowgraph import Graph, Scalar, Series, Stream, graph, latest, simulate
from flowgraph.data.tape import Rows, Tape
from flowgraph.engines.stretches import Gathered
from flowgraph.engines.xla.buffers import Buffers, aligned
from flowgraph.pipeline.lowering import lower


@graph
def summed(a: Stream[Scalar], b: Stream[Scalar]):
    """At each of `a`, its value and the latest of `b`."""
    return {"out": a + latest(b, init=0.5)}


def built() -> Graph:
    return summed.build()


@pytest.mark.parametrize("cuts", [[0, 6], [0, 2, 6], [0, 1, 2, 3, 6]])
@pytest.mark.parametrize("there", [[1, 1, 1, 1, 1, 1], [1, 1, 0, 1, 1, 1], [0, 0, 0, 1, 0, 1], [0] * 6])
def test_rows_come_together_from_stretches(cuts, there):
    """Present at every tick, at some, in none of a stretch, or never."""
    time, mask = np.arange(6) * 10, np.array(there, dtype=bool)
    values = np.arange(6.0) ** 2
    gathered = Gathered(lower(built()).outputs[0], time)
    for first, last in itertools.pairwise(cuts):
        here = mask[first:last]
        gathered.add(last - first, time[first:last][here], [values[first:last][here]])
    times, leaves = gathered.rows()
    np.testing.assert_array_equal(times, time[mask])
    np.testing.assert_array_equal(leaves[0], values[mask])


@pytest.mark.parametrize(
    "at",
    [
        slice(None),
        slice(1, 19, 6),
        slice(5, 13, 2),
        slice(9, 10, 1),
        np.array([0, 1, 7, 8]),
        np.array([], int),
    ],
    ids=["all", "each sixth", "each second", "one", "some", "none"],
)
def test_an_input_is_spread_over_the_ticks_of_each_chunk(at):
    """Zero where it is absent, and where a recording is short of a chunk."""
    time, choice = np.arange(13) * 7, np.arange(13, dtype=np.uint8)
    there = np.zeros(13, dtype=bool)
    there[at] = True
    values = np.arange(1.0, 1 + there.sum())
    dense = np.zeros(13)
    dense[there] = values
    buffers = Buffers(4, np.uint8, True, [[values]], 0, np.float64, 99)
    for first in range(0, 13, 4):
        last = min(first + 4, 13)
        buffers.fill(choice, time, [at], [[values]], slice(first, last))
        kept, when, ((column,),), _ = buffers.arrays
        short = 4 - (last - first)
        np.testing.assert_array_equal(column, np.r_[dense[first:last], np.zeros(short)])
        np.testing.assert_array_equal(kept, np.r_[choice[first:last], [99] * short])
        np.testing.assert_array_equal(when, np.r_[time[first:last], [time[last - 1]] * short])
        assert buffers.holds(column[1:])
        assert not buffers.holds(column.copy())


def test_buffers_serve_one_recording_after_another():
    """What another left in them is gone, whichever rows it had."""
    every, fifth = slice(None), slice(1, 12, 5)
    ways: list[tuple[Rows, int]] = [
        (every, 12), (fifth, 12), (fifth, 12), (np.array([0, 3]), 7), (slice(0, 12, 5), 12), (every, 12)
    ]  # fmt: skip
    buffers = Buffers(12, np.uint8, False, [[np.zeros(12)]], 0, np.float64, 9)
    for n, (at, ticks) in enumerate(ways):
        dense = np.zeros(12)
        dense[at] = n + np.arange(1.0, 13)[: len(dense[at])]
        time, choice = np.arange(ticks), np.zeros(ticks, np.uint8)
        buffers.fill(choice, time, [at], [[dense[:ticks][at]]], slice(0, ticks))
        np.testing.assert_array_equal(buffers.arrays[2][0][0], dense)
    assert buffers.bytes == 12 * 9
    assert buffers.fits([[np.zeros(5)]])
    assert not buffers.fits([[np.zeros((5, 3))]])


def test_runs_in_threads_do_not_share_buffers():
    """Two at once of one compiled scan: each with its own inputs."""
    pytest.importorskip("jax")
    one = built()
    time = np.arange(200_000) * 10
    flights = [
        {
            "a": Series(time, np.full(len(time), 1.0 * k)),
            "b": Series(time[::3], np.full(len(time[::3]), 100.0 * k)),
        }
        for k in range(8)
    ]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda f: simulate(one, f, engine="xla")["out"]["value"], flights))
    for k, values in enumerate(found):
        np.testing.assert_array_equal(values, 101.0 * k)


def test_buffers_lie_where_xla_takes_them():
    for size in (1, 3, 1000):
        array = aligned((size, 3), np.float32)
        assert array.ctypes.data % 64 == 0
        assert array.shape == (size, 3)
        assert not array.any()


@pytest.mark.parametrize("engine", ["xla", "c"])
def test_what_was_handed_through_stays_when_the_next_chunk_is_filled(engine):
    """An output that is an input, over more ticks than a chunk has."""
    if engine == "xla":
        pytest.importorskip("jax")

    @graph
    def through(a: Stream[Scalar]):
        return {"same": a, "twice": a + a}

    n = 140_000
    series = Series(np.arange(n) * 1000, np.arange(n) * 1.0)
    found = simulate(through.build(), {"a": series}, engine=engine)
    np.testing.assert_array_equal(found["same"]["value"], series["value"])
    np.testing.assert_array_equal(found["twice"]["value"], 2 * series["value"])


@pytest.mark.parametrize("b", [[0, 30, 60], [10, 20, 60], [5, 25], [30], [-10, 20], []], ids=str)
@pytest.mark.parametrize(
    "a", [[0, 10, 20, 30, 40, 50, 60], [0, 10, 20, 30, 45, 60, 61]], ids=["even", "uneven"]
)
def test_ticks_know_where_each_source_is(a, b):
    """Whether times are equally far apart, each n-th of another's, or neither."""
    series = tuple(Series(np.array(t, np.int64), np.zeros(len(t))) for t in (a, b))
    tape = Tape.of(series)
    np.testing.assert_array_equal(tape.time, np.unique(np.r_[a, b]))
    for k, one in enumerate(series):
        np.testing.assert_array_equal(tape.time[tape.rows[k]], one.time)
        np.testing.assert_array_equal(tape.time[tape.key >> k & 1 == 1], one.time)
    assert tape.patterns == tuple(np.unique(tape.key).tolist())
    part = tape.part(1, 4)
    for k, one in enumerate(part.series):
        np.testing.assert_array_equal(part.time[part.rows[k]], one.time)


def test_many_patterns_are_all_found():
    """More than are looked for one by one, and one that comes late."""
    rng = np.random.default_rng(3)
    times = [np.flatnonzero(rng.random(5000) < 0.5) for _ in range(7)]
    many = Tape.of(tuple(Series(t, np.zeros(len(t))) for t in times))
    assert many.patterns == tuple(np.unique(many.key).tolist())
    assert len(many.patterns) > 100
    late = Tape.of((Series(np.arange(5000), np.zeros(5000)), Series(np.array([4321]), np.zeros(1))))
    assert late.patterns == (1, 3)


def test_stamps_are_shared_and_looked_at_once():
    """A series' own, which nobody can write to, and so what is said of them stays true."""
    given = np.arange(10)
    series = Series(given, np.zeros(10))
    given[3] = 99
    assert series.time.tolist() == list(range(10))
    assert not series.time.flags.writeable
    assert series.steps == (1, 1)
    assert series.holding(np.ones(10)).time is series.time
    assert series[::2].steps == (2, 2)
    frozen = np.arange(4)
    view = frozen.view()
    view.flags.writeable = False
    other = Series(view, np.zeros(4))
    frozen[1] = 50
    assert other.time.tolist() == [0, 1, 2, 3]
