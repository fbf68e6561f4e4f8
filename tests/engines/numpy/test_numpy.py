"""All ticks at once: equal to the reference, whatever the stretches, with registers of every kind."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    Scalar,
    Series,
    Signal,
    Stream,
    block,
    delay,
    graph,
    integer,
    latest,
    lower,
    real,
    simulate,
    ticks,
    when,
)
from flowgraph.blocks.flights.figure import figure
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.engines.numpy import engine as whole
from flowgraph.engines.numpy import steps
from flowgraph.engines.numpy.plan import ordered, planned
from flowgraph.engines.numpy.rules import _RULES
from flowgraph.engines.numpy.steps import Before, Draw, Loop, Scan
from flowgraph.recorder.ops import ELEMENTWISE, OPS
from tests.engines.c.test_expand import SHAPES, outputs
from tests.engines.test_engines import RANDOM, RECIPES, TIMES, random_data, random_graph
from tests.support import same, scalars

NOISY: dict[str, Any] = {
    "rate": 50.0,
    "noise": ImuNoise(0.01, 0.1, 1e-3, 1e-2),
    "gyro_bias": 0.1,
    "accelerometer_bias": 0.2,
    "position_noise": 0.1,
    "attitude_noise": 0.1,
}


@pytest.fixture(params=[3, 8192])
def stretch(request, monkeypatch):
    monkeypatch.setattr(whole, "TICKS", request.param)
    return request.param


def plan_of(built: Any, patterns: tuple[int, ...]) -> Any:
    return planned(lower(built), patterns, np.dtype("float64"), whole.ENGINE.passes)


def kinds(plan: Any) -> set[type]:
    return {type(s) for s in plan.steps}


def equal(built: Any, inputs: Any, **options: Any) -> Any:
    """The result, with the values of the reference to 1e-12 and its times and whole numbers to the bit."""
    want, got = (simulate(built, inputs, engine=e, **options) for e in ("reference", "numpy"))
    same(want, got, exact=False)
    for name, series in want.series.items():
        for leaf, values in series.leaves.items():
            found = got[name].leaves[leaf]
            assert found.dtype == values.dtype
            np.testing.assert_allclose(found, values, rtol=1e-12, atol=1e-12, err_msg=f"{name}.{leaf}")
    return got


@settings(RANDOM, max_examples=60)
@given(RECIPES, TIMES, TIMES, st.integers(0, 1000), st.sampled_from([1, 4, 8192]), st.sampled_from([0, 1024]))
def test_random_graphs_are_equal(recipe, times_x, times_y, seed, size, large):
    built, data = random_graph(recipe), random_data(times_x, times_y, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole, "TICKS", size)
        patch.setattr(steps, "LARGE", large)
        equal(built, data)


def test_a_flight_made_by_a_graph_is_equal_to_the_bit(stretch):
    end = 1_600_000_001
    clocks = {
        "start": ticks(end, until=end),
        "imu": ticks("20ms", until=end),
        "vicon": ticks("250ms", until=end),
    }
    built = figure.build(**NOISY)
    want, got = (simulate(built, clocks, engine=e, seed=2**40 + 7) for e in ("reference", "numpy"))
    same(want, got, exact=True)
    plan = plan_of(built, (2, 6, 7))
    assert not plan.loops
    assert {Draw, Scan} <= kinds(plan)


# -- instructions ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_every_instruction_over_ticks_is_that_of_a_tick(shape):
    class Given(Signal):
        x: Array = real(*shape)
        y: Array = real(*shape)
        n: Array = integer(*shape, dtype="int64")

    @block
    def work(given: Given, *, xp):
        more = {
            "flip_last": xp.flip(given.x, axis=-1),
            "taken_last": xp.take(given.x, given.n[..., 0] % 3, axis=-1),
            "of_known": xp.take(xp.asarray(np.arange(12.0).reshape(4, 3)), given.n, axis=1),
            "at_known": xp.take(given.x, xp.asarray(np.array([[0, 2], [1, 0]])), axis=0),
            "search_own": xp.searchsorted(xp.sort(xp.reshape(given.x, (-1,))), given.y),
            "order_first": xp.argsort(given.x, axis=0),
            "largest_first": xp.argmax(given.x, axis=0),
        }
        return tuple({**outputs(given.x, given.y, given.n, xp), **more}.values())

    @graph
    def g(given: Stream[Given]):
        return work(given)

    random = np.random.default_rng(3)
    size = (5, *shape)
    data = Given(random.normal(size=size) * 2.0, random.normal(size=size), random.integers(0, 7, size=size))
    equal(g.build(), {"given": Series(np.arange(5), data)}, diverged="count")


def test_products_with_what_is_known_and_with_vectors():
    known = np.random.default_rng(1).normal(size=(4, 3))

    class Given(Signal):
        v: Array = real(3)
        w: Array = real(4)
        A: Array = real(3, 4)
        B: Array = real(2, 4, 3)

    @block
    def work(given: Given, *, xp):
        m, s = xp.asarray(known), given.A @ given.A.mT + np.eye(3)
        return (
            m @ given.v, given.w @ m, m @ given.A, given.A @ m, given.B @ given.A, given.B @ given.v,
            given.v @ given.A, given.A @ given.w, given.w @ given.B, xp.linalg.solve(s, given.v),
            xp.linalg.solve(s, given.A), m @ given.v[:, None], m.mT @ given.B, given.v @ given.v,
        )  # fmt: skip

    @graph
    def g(given: Stream[Given]):
        return work(given)

    random = np.random.default_rng(4)
    shapes = ((3,), (4,), (3, 4), (2, 4, 3))
    equal(g.build(), {"given": Series(np.arange(7), Given(*(random.normal(size=(7, *s)) for s in shapes)))})


def test_no_instruction_is_without_a_rule():
    """Those that are left over go row by row: the one loop within a tick alone."""
    assert set(OPS) - set(ELEMENTWISE) - set(_RULES) == {"replay"}


# -- registers ------------------------------------------------------------------------------------------


@block
def total(state, x, *, gain=1.0):
    return state + gain * x, state + gain * x


@total.init
def _(x: Any, **_: Any) -> Any:
    return 0.125


@block
def most(state, x, *, xp):
    new = xp.maximum(x, state)
    return new, new


@most.init
def _(x: Any) -> Any:
    return -10.0


@block
def smooth(state, x):
    return 0.5 * state + x, state


@smooth.init
def _(x: Any) -> Any:
    return 1.0


@block
def above(x: Scalar, *, limit: float, xp: Any) -> Scalar | None:
    return when(x > limit, x * 2.0)


@block
def seconds(x: Scalar, *, dt: float, xp: Any) -> Scalar:
    return xp.asarray(dt, dtype=x.dtype) + 0.0 * x


@graph
def registers(x: Stream[Scalar], y: Stream[Scalar]):
    some = above(x, limit=0.3)
    return {
        "sum": total(x),
        "rare": total(some),
        "most": most(y),
        "held": latest(some, init=7.0, at=y),
        "late": x.delay(0.5).at(y),
        "dt": seconds(some),
        "again": total(latest(total(y, gain=0.5), init=1.0, at=x)),
    }


BUILT = registers.build()
RANDOM_WALKS = st.lists(st.floats(-1.0, 1.0, width=32), min_size=0, max_size=40)


@settings(RANDOM, max_examples=30)
@given(RANDOM_WALKS, RANDOM_WALKS, st.integers(1, 4), st.integers(1, 4), st.sampled_from([1, 7, 8192]))
def test_sums_extremes_holds_and_delays_are_one_pass_and_equal_to_the_bit(xs, ys, every_x, every_y, size):
    data = {"x": scalars(np.arange(len(xs)) * every_x, xs), "y": scalars(np.arange(len(ys)) * every_y, ys)}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(whole, "TICKS", size)
        want, got = (simulate(BUILT, data, engine=e) for e in ("reference", "numpy"))
    same(want, got, exact=True)


def test_the_registers_of_memory_that_adds_or_holds_are_no_loops():
    plan = plan_of(BUILT, (1, 2, 3))
    assert not plan.loops
    assert Scan in kinds(plan)


def test_a_register_that_is_written_in_every_tick_is_moved_on_by_one(stretch):
    """As a description may have it, where a lowered graph keeps what it held while nothing comes."""

    @graph
    def g(x: Stream[Scalar]):
        return {"late": x.delay(0.25).at(x)}

    lowered = lower(g.build())
    (register,) = lowered.registers
    (cell,) = register.cells
    always = replace(cell, write=lowered.inputs[0].leaves[0].value)
    pipeline = replace(lowered, registers=(replace(register, cells=(always,)),))
    plan = planned(pipeline, (1,), np.dtype("float64"), ())
    assert Before in kinds(plan)
    assert Scan not in kinds(plan)
    data = {"x": scalars(np.arange(9), np.arange(9.0))}
    results = [pipeline.run(data, engine=e) for e in ("reference", "numpy")]
    same(*results)
    assert results[1]["late"].value.tolist() == [0.25, *range(8)]


def test_what_loops_in_another_way_is_played_tick_by_tick_between_the_rest(stretch):
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        low = smooth(x)
        back = delay(0.25)
        fed = total(back.at(y) + y)
        back.feed(fed * 0.5)
        return {"low": low, "after": total(low * low), "fed": fed, "both": latest(low, init=0.0, at=y) * y}

    built = g.build()
    plan = plan_of(built, (1, 2, 3))
    assert plan.loops == 2
    assert Scan in kinds(plan)
    random = np.random.default_rng(5)
    data = {
        "x": scalars(np.arange(20) * 2, random.normal(size=20)),
        "y": scalars(np.arange(15) * 3, random.normal(size=15)),
    }
    want, got = (simulate(built, data, engine=e) for e in ("reference", "numpy"))
    same(want, got, exact=True)
    (loop, *_) = (s for s in plan.steps if isinstance(s, Loop))
    assert len(loop.instructions) < len(plan.program.instructions) // 2


def test_a_looped_tick_holds_no_more_arrays_than_are_read_later():
    size = 20_000

    @block
    def long_way(state, x: Scalar, *, xp):
        moved = state + x
        for k in range(40):
            moved = xp.sin(moved) + float(k)
        return moved, xp.max(moved)

    @long_way.init
    def _(x):
        return np.zeros(size)

    @graph
    def g(x: Stream[Scalar]):
        return {"out": long_way(x)}

    built, data = g.build(), scalars([0, 1, 2], [0.5, 1.5, 2.5])
    want = simulate(built, {"x": data}, engine="reference")
    assert plan_of(built, (1,)).loops == 1
    tracemalloc.start()
    try:
        got = simulate(built, {"x": data}, engine="numpy")
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    same(want, got, exact=True)
    assert peak < 20 * 8 * size  # a few arrays, and the registers of three ticks; all would be eighty


def test_single_precision_is_that_of_the_reference(stretch):
    end = 400_000_001
    clocks = {
        "start": ticks(end, until=end),
        "imu": ticks("20ms", until=end),
        "vicon": ticks("100ms", until=end),
    }
    built = figure.build(**NOISY)
    want, got = (simulate(built, clocks, engine=e, dtype="float32", seed=3) for e in ("reference", "numpy"))
    for name, series in want.series.items():
        for leaf, values in series.leaves.items():
            np.testing.assert_allclose(got[name][leaf], values, rtol=2e-5, atol=2e-6, err_msg=leaf)


def test_the_order_is_that_of_needs_and_circles_are_one_part():
    needs = {0: [1, 2], 1: [2], 2: [3], 3: [1, 4], 4: [], 5: [5]}
    parts = ordered([0, 5], needs.__getitem__)
    assert [sorted(p) for p in parts] == [[4], [1, 2, 3], [0], [5]]
    chain = ordered([20_000], lambda n: [n - 1] if n else [])
    assert chain == [[n] for n in range(20_001)]
