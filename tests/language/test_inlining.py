"""A built graph inside another."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import (
    ClockError,
    Graph,
    Scalar,
    Series,
    Stream,
    Tick,
    TypeMismatchError,
    UnknownNameError,
    block,
    delay,
    graph,
    latest,
    periodic,
    simulate,
)
from flowgraph.language.builder import builder
from flowgraph.language.inlining import inlined
from tests.support import MS, all_engines, same_state, scalars


@block
def advance(x: Scalar, v: Scalar, *, dt: float, draw) -> Scalar:
    return x + v * dt + draw.normal("push", ())


@graph
def distance(v: Stream[Scalar], seldom: Stream[Scalar]):
    x = delay(2.0, name="x")
    new = advance(x, v)
    x.feed(new)
    return {"x": new, "seen": latest(new, init=0.0, at=seldom) + seldom, "half": new.every(2)}


CLOCKS: dict[str, Any] = {"v": periodic("5ms", phase=0), "seldom": periodic("15ms", phase=0)}


def built() -> Graph:
    return distance.build(**CLOCKS)


@block
def twice(v: Scalar, *, dt: float) -> Scalar:
    return 2.0 * v + 0.0 * dt


@graph
def around(v: Stream[Scalar], seldom: Stream[Scalar], *, inner: Graph):
    found = inlined(builder("around"), inner, {"v": twice(v), "seldom": seldom})
    return {"x": found["x"], "sum": found["x"] + v, "seen": found["seen"], "half": found["half"]}


def test_a_built_graph_does_inside_another_what_it_does_alone() -> None:
    v, seldom = scalars(np.arange(8) * 5 * MS), scalars(np.arange(3) * 15 * MS)
    inside = all_engines(around.build(**CLOCKS, inner=built()), {"v": v, "seldom": seldom}, seed=4)
    alone = all_engines(built(), {"v": scalars(v.time, 2.0 * v["value"]), "seldom": seldom}, seed=4)
    for name in ("x", "seen", "half"):
        np.testing.assert_array_equal(inside[name].time, alone[name].time)
        np.testing.assert_array_equal(inside[name].value, alone[name].value)
    np.testing.assert_allclose(inside["sum"].value, alone["x"].value + v["value"])
    registers = inside.state["registers"]
    same_state({n: registers[n] for n in alone.state["registers"]}, alone.state["registers"])


@block
def thrice(v: Scalar) -> Scalar:
    return 3.0 * v


@graph
def started(v: Stream[Scalar], seldom: Stream[Scalar], once: Stream[Tick], *, inner: Graph):
    start = thrice(latest(v, init=0.0, name="first"), at=once, name="start")
    found = inlined(builder("started"), inner, {"v": v, "seldom": seldom}, {"x": start})
    return {"x": found["x"], "seen": found["seen"]}


def test_a_register_of_a_built_graph_starts_with_a_stream_where_there_is_one() -> None:
    v, seldom = scalars(np.arange(8) * 5 * MS, 1.0 + np.arange(8)), scalars(np.arange(3) * 15 * MS)
    once = Series(np.array([0]), np.ones(1, dtype=bool))
    whole = started.build(**CLOCKS, once=periodic("40ms", phase=0), inner=built())
    found = all_engines(whole, {"v": v, "seldom": seldom, "once": once}, seed=4)
    want = all_engines(distance.build(**CLOCKS), {"v": v, "seldom": seldom}, seed=4, init={"x": 3.0})
    np.testing.assert_array_equal(found["x"].value, want["x"].value)
    alone = simulate(distance.build(**CLOCKS), {"v": v, "seldom": seldom}, seed=4)
    np.testing.assert_allclose(found["x"].value - alone["x"].value, 1.0, atol=1e-12)  # 3 in place of 2


def test_a_start_of_a_register_that_is_none_is_refused() -> None:
    @graph
    def wrong(v: Stream[Scalar], seldom: Stream[Scalar]):
        return inlined(builder("wrong"), built(), {"v": v, "seldom": seldom}, {"y": v})

    with pytest.raises(UnknownNameError, match="register"):
        wrong.build(**CLOCKS)


def test_streams_that_are_no_sources_or_are_missing_are_refused() -> None:
    @graph
    def wrong(v: Stream[Scalar], seldom: Stream[Scalar]):
        return inlined(builder("wrong"), built(), {"v": v, "often": seldom})

    with pytest.raises(UnknownNameError, match="often"):
        wrong.build(**CLOCKS)

    @graph
    def half(v: Stream[Scalar], seldom: Stream[Scalar]):
        return inlined(builder("half"), built(), {"v": v + latest(seldom, init=0.0)})

    with pytest.raises(UnknownNameError, match="seldom"):
        half.build(**CLOCKS)


def test_a_stream_of_another_clock_or_type_is_refused() -> None:
    @graph
    def crossed(v: Stream[Scalar], seldom: Stream[Scalar]):
        return inlined(builder("crossed"), built(), {"v": seldom, "seldom": v})

    with pytest.raises(ClockError, match="was built for another clock") as caught:
        crossed.build(**CLOCKS)
    assert "seldom at seldom" in str(caught.value)

    @graph
    def ticked(v: Stream[Tick], seldom: Stream[Scalar]):
        return inlined(builder("ticked"), built(), {"v": v, "seldom": seldom})

    with pytest.raises(TypeMismatchError):
        ticked.build(**CLOCKS)
