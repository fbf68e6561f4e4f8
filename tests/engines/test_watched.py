"""A run that is watched: the same to the bit, and what its watcher is shown."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DivergedError,
    Graph,
    Stream,
    aperiodic,
    block,
    collect,
    delay,
    graph,
    merge,
    periodic,
    simulate,
    when,
)
from flowgraph.engines.watched import simulate_watched
from flowgraph.language.graph import Wire
from flowgraph.types import Scalar
from tests.support import MS, same, scalars


@block
def total(state: Any, value: Scalar):
    """The sum."""
    return state + value, state + value


@total.init
def _(value):
    return np.float64(0)


@block
def even(value: Scalar) -> Scalar | None:
    """The value where it is even."""
    return when(value % 2 == 0, value)


@graph
def summed(a: Stream[Scalar], b: Stream[Scalar]):
    before = delay(10.0, name="before")
    sums = total(merge(a, b, tie="left", name="either"), name="total")
    before.feed(sums)
    collect(even(sums, name="even"), "even")
    return {"both": sums + before}


INPUTS = {"a": scalars(np.arange(6) * 5 * MS), "b": scalars([7 * MS, 12 * MS])}


def built() -> Graph:
    return summed.build(a=periodic("5ms"), b=aperiodic(max_rate=500))


class Everything:
    """Keeps what it is shown."""

    def __init__(self, stride: int = 1) -> None:
        self.stride = stride
        self.rows: list[tuple[int, dict[str, Any], dict[int, Any]]] = []
        self.blocks: Mapping[str, tuple[float, int]] = {}
        self.graph = built()

    def see(self, time: int, seen: Mapping[Wire, Any], read: Mapping[int, Any]) -> None:
        self.rows.append((time, {self.graph.label(w): found for w, found in seen.items()}, dict(read)))

    def took(self, blocks: Mapping[str, tuple[float, int]]) -> None:
        self.blocks = blocks


def test_the_result_is_the_same_to_the_bit() -> None:
    same(simulate(built(), INPUTS, seed=3), simulate_watched(built(), INPUTS, Everything(), seed=3))


def test_every_wire_is_shown_with_the_time_of_its_value() -> None:
    watcher = Everything()
    simulate_watched(built(), INPUTS, watcher)
    times = sorted({int(t) for s in INPUTS.values() for t in s.time})
    assert [row[0] for row in watcher.rows] == times
    values = {**dict(zip(INPUTS["b"].time, INPUTS["b"]["value"], strict=True))}
    values |= dict(zip(INPUTS["a"].time, INPUTS["a"]["value"], strict=True))
    sums = np.cumsum([values[t] for t in times])
    assert [seen["total"] for _, seen, _ in watcher.rows] == list(zip(times, sums, strict=True))
    last = None
    for (time, seen, _), value in zip(watcher.rows, sums, strict=True):
        last = (time, value) if value % 2 == 0 else last
        assert seen.get("even") == last  # an output that is absent shows what it gave last


def test_a_delay_shows_what_was_read_in_the_tick() -> None:
    watcher = Everything()
    simulate_watched(built(), INPUTS, watcher)
    index = next(i for i, n in watcher.graph.registers if n.path == "before")
    read = [row[2].get(index) for row in watcher.rows]
    sums = [seen["total"] for _, seen, _ in watcher.rows]
    assert read == [None, *sums[:-1]]


def test_every_few_ticks_and_how_long_blocks_took() -> None:
    watcher = Everything(stride=3)
    result = simulate_watched(built(), INPUTS, watcher)
    assert len(watcher.rows) == result.ticks // 3
    assert watcher.blocks["total"][1] == result.ticks == 8
    assert all(seconds > 0 for seconds, _ in watcher.blocks.values())


def test_progress_and_errors_are_those_of_any_run() -> None:
    class Told:
        ticks = 0

        def update(self, ticks: int, time: int) -> None:
            self.ticks = ticks

    told = Told()
    simulate_watched(built(), INPUTS, Everything(), progress=told)
    assert told.ticks == 8
    with pytest.raises(DataError, match="a"):
        simulate_watched(built(), {"b": INPUTS["b"]}, Everything())

    @block
    def inverse(value: Scalar) -> Scalar:
        return 1.0 / value

    @graph
    def divided(a: Stream[Scalar]):
        return {"inverse": inverse(a)}

    one = divided.build(a=periodic("5ms"))
    with np.errstate(divide="ignore"), pytest.raises(DivergedError):
        simulate_watched(one, {"a": scalars([0, 5 * MS], [1.0, 0.0])}, Everything())
