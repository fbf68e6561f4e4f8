"""Runs side by side in C: each lane is what a single run gives, whatever happens in the lanes beside it."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    Case,
    Scalar,
    Series,
    Signal,
    Stream,
    block,
    delay,
    graph,
    latest,
    lower,
    real,
    simulate,
)
from flowgraph import simulate_many as many
from flowgraph.engines.c.lanes.expressions import NoLanesError
from flowgraph.engines.c.lanes.library import lanes_of
from flowgraph.engines.c.lanes.source import WIDTH, generate_lanes
from flowgraph.engines.subject import LoweredGraph
from flowgraph.pipeline.optimise import COMPILED, optimise
from flowgraph.recorder.random import seed_words
from tests.graphs.library import LIBRARY, library_case

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")

MS = 1_000_000
APART = {
    "ins_particle": "cumulative_sum",
    "particle": "cumulative_sum",
    "rbpf_indoor": "argmax",
    "outdoor_eskf": "9 patterns",
    "rbpf_outdoor": "9 patterns",
}
"""Graphs whose runs go singly: those that resample, and those of many patterns of sources."""

QUICK = ("async_kalman", "complementary", "kalman", "roll_pitch")


def compare(batch: Any, k: int, alone: Any, *, tolerance: float = 1e-9) -> None:
    for name, runs in batch.series.items():
        run = runs.run(k)
        np.testing.assert_array_equal(run.time, alone[name].time)
        for leaf, array in run.leaves.items():
            expected = alone[name].leaves[leaf]
            assert array.dtype == expected.dtype
            np.testing.assert_allclose(array, expected, rtol=tolerance, atol=tolerance)


def has_lanes(case: Case) -> bool:
    subject = LoweredGraph(case.graph, dtype="float64")
    return lanes_of(subject.pipeline, np.float64, subject.tape(case.inputs).patterns, COMPILED) is not None


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.slow) for n in LIBRARY if n not in APART]
)
def test_a_lane_is_a_run(name):
    case = library_case(name)
    if lower(case.graph).host:
        pytest.skip("has a host part: its runs go one by one")
    assert has_lanes(case)
    alone = simulate(case.graph, case.inputs, engine="c")
    batch = many(case.graph, case.inputs, range(WIDTH + 1), engine="c")
    for k in (0, WIDTH - 1, WIDTH):
        compare(batch, k, alone)


@pytest.mark.parametrize("name", APART)
def test_what_has_no_lanes_is_named(name):
    case = library_case(name)
    subject = LoweredGraph(case.graph, dtype="float64")
    with pytest.raises(NoLanesError, match=APART[name]):
        generate_lanes(subject.pipeline, subject.tape(case.inputs).patterns, lambda p: optimise(p, COMPILED))


class Three(Signal):
    """What the runs read."""

    value: Array = real(3)


class Mixed(Signal):
    """Leaves of every kind that memory can hold."""

    place: Array = real(3)
    solved: Array = real(2)
    factor: Array = real(2, 2)
    count: Array = real()


@block
def mix(before: Three, given: Three, b: Scalar, *, xp) -> Mixed:
    """All that is written otherwise in lanes: truths, choices, extremes, functions, products, solutions."""
    a = given.value
    far = xp.abs(a) > 1.0
    some = xp.any(far) | ~xp.all(xp.isfinite(a))
    place = xp.where(far, xp.sign(a) * xp.sqrt(xp.abs(a)), 0.5 * before.value + a)
    matrix = xp.stack([xp.stack([a[0], b + 0.0 * b]), xp.stack([a[1], a[2]])])
    square = matrix @ xp.matrix_transpose(matrix) + xp.where(some, -1.0, 1.0) * xp.eye(2)
    return Mixed(
        place=xp.where(xp.isnan(place), -1.0, place),
        solved=xp.linalg.solve(matrix, xp.stack([xp.sin(b), xp.atan2(b, a[0])])),
        factor=xp.linalg.cholesky(square),
        count=xp.maximum(xp.max(a), b) + xp.astype(xp.sum(xp.astype(far, xp.int64)), xp.float64),
    )


@graph
def mixed(a: Stream[Three], b: Stream[Scalar]):
    """One output at every tick of `a`, and one where the data say so."""
    memory = delay(Three(value=np.zeros(3)), name="memory")
    now = mix(memory, a, latest(b, init=0.0, at=a))
    place = now.map(lambda n: Three(value=n.place))
    memory.feed(place)
    return {"now": now, "high": place.filter(lambda x: x.value[0] > 0.0)}


def data(seed: int, n: int = 60, *, sixth: Any = None) -> dict[str, Series]:
    draw = np.random.default_rng(seed)
    time = np.arange(n) * 5 * MS
    values = draw.normal(size=(n, 3))
    if sixth is not None:
        values[5] = sixth
    return {"a": Series(time, Three(value=values)), "b": Series(time[::7], draw.normal(size=len(time[::7])))}


@pytest.fixture(scope="module")
def built():
    return mixed.build()


def test_what_one_lane_meets_does_not_reach_the_others(built):
    """A singular matrix, one whose rows are exchanged, and one that is not finite, each in a lane."""
    odd = [0.0, [0.0, 1.0, 2.0], [0.0, 1e200, 1.0], None]
    inputs = [data(k, sixth=row) for k, row in enumerate(odd)]
    batch = many(built, inputs, range(len(odd)), engine="c", diverged="count")
    assert np.isnan(batch["now"].solved[0, 5]).all()
    assert np.isfinite(batch["now"].solved[3]).all()
    for k, given in enumerate(inputs):
        compare(batch, k, simulate(built, given, engine="c", seed=k, diverged="count"))


def test_a_run_is_the_same_to_the_bit_in_any_lane_and_beside_any_other(built):
    inputs = [data(k) for k in range(2 * WIDTH + 1)]
    batch = many(built, inputs, range(len(inputs)), engine="c", diverged="count")
    other = many(built, inputs[::-1], range(len(inputs)), engine="c", diverged="count")
    for k in range(len(inputs)):
        one, two = batch["now"].run(k), other["now"].run(len(inputs) - 1 - k)
        for leaf, array in one.leaves.items():
            np.testing.assert_array_equal(array, two.leaves[leaf])


def test_runs_with_ticks_of_their_own_go_beside(built):
    inputs = [data(0), data(1, 50), data(2), data(3, 40), data(4)]
    batch = many(
        built,
        inputs,
        range(5),
        engine="c",
        diverged="count",
        init=[{"memory": Three(value=np.full(3, float(k)))} for k in range(5)],
    )
    for k, given in enumerate(inputs):
        alone = simulate(
            built,
            given,
            engine="c",
            seed=k,
            init={"memory": Three(value=np.full(3, float(k)))},
            diverged="count",
        )
        compare(batch, k, alone)


def test_only_what_is_kept_is_written(built):
    batch = many(built, [data(0), data(1)], range(2), engine="c", keep=["now.place"], diverged="count")
    assert list(batch.series) == ["now"]
    assert list(batch["now"].leaves) == ["place"]
    np.testing.assert_allclose(
        batch["now"].place[1], simulate(built, data(1), engine="c", diverged="count")["now"].place, rtol=1e-12
    )


@block
def looked_up(a: Three, *, draw, xp) -> Three:
    """Draws, and entries of a table and of what was computed, at places that the lanes do not share."""
    table = xp.asarray(np.linspace(-1.0, 1.0, 11))
    many = draw.normal("many", (9, 9)) @ draw.normal("more", (9, 9))  # more than a stack should hold
    drawn = draw.normal("noise", (3,)) + draw.uniform("even", (3,)) + 1e-3 * many[0, :3]
    place = xp.astype(xp.clip(10.0 * xp.abs(a.value), 0.0, 10.0), xp.int64)
    return Three(value=drawn + xp.take(table, place) + xp.take(drawn, place % 3))


@graph
def drawing(a: Stream[Three]):
    """Noise and look-ups."""
    return {"out": looked_up(a)}


def test_each_lane_draws_its_own_numbers_and_looks_up_its_own_places():
    built = drawing.build()
    inputs = [{"a": data(k)["a"]} for k in range(WIDTH + 1)]
    seeds = [3, 1, 4, 1, 5]
    subject = LoweredGraph(built, dtype="float64")
    assert lanes_of(subject.pipeline, np.float64, subject.tape(inputs[0]).patterns, COMPILED) is not None
    batch = many(built, inputs, seeds, engine="c")
    for k, seed in enumerate(seeds):
        compare(batch, k, simulate(built, inputs[k], engine="c", seed=seed), tolerance=1e-12)
    assert (batch["out"].value[1] != batch["out"].value[0]).all()


BASE = np.random.default_rng(1).normal(size=(18, 18))


class Factors(Signal):
    """Of matrices of several sizes, with and without loops, and whole powers."""

    one: Array = real(1, 1)
    nine: Array = real(9, 9)
    most: Array = real(16, 16)
    more: Array = real(18, 18)
    powers: Array = real(9, 3)
    found: Array = real(3)


@block
def factored(a: Three, *, xp) -> Factors:
    """Matrices that are positive definite unless the first number is below 0, and places beyond a table."""
    square = BASE @ BASE.T + np.eye(18)
    of = lambda n: xp.linalg.cholesky(a.value[0] * xp.asarray(square[:n, :n]) + 0.0 * a.value[1])
    table = xp.asarray(np.linspace(-1.0, 1.0, 11))
    place = xp.astype(20.0 * a.value, xp.int32), xp.astype(40.0 * a.value, xp.int64)
    return Factors(
        one=of(1),
        nine=of(9),
        most=of(16),
        more=of(18),
        powers=xp.stack([a.value**k for k in range(1, 10)]),
        found=xp.take(table, place[0]) + 3.0 * xp.take(table, place[1]),
    )


@graph
def factoring(a: Stream[Three]):
    """Factors tick by tick."""
    return {"out": factored(a)}


def test_factors_powers_and_places_of_a_lane_are_those_of_a_run():
    built = factoring.build()
    values = np.random.default_rng(2).normal(size=(WIDTH + 1, 20, 3))
    values[:, ::2, 0] = np.abs(values[:, ::2, 0])
    inputs = [{"a": Series(np.arange(20) * MS, Three(value=v))} for v in values]
    subject = LoweredGraph(built, dtype="float64")
    assert lanes_of(subject.pipeline, np.float64, subject.tape(inputs[0]).patterns, COMPILED) is not None
    batch = many(built, inputs, range(WIDTH + 1), engine="c", diverged="count")
    for k, given in enumerate(inputs):
        compare(batch, k, simulate(built, given, engine="c", seed=k, diverged="count"), tolerance=1e-11)
    assert np.isfinite(batch["out"].most[:, ::2]).all()
    assert (np.isnan(batch["out"].nine).all(axis=(2, 3)) == (values[:, :, 0] < 0.0)).all()


@block
def counted(state: tuple[Any, Any], a: Three, *, xp) -> tuple[tuple[Any, Any], Scalar]:
    """State: whether all were above 0 (a truth), and their sum."""
    state = state[0] & xp.all(a.value > 0.0), state[1] + xp.sum(a.value)
    return state, state[1]


@counted.init
def _(a: Any) -> tuple[Any, Any]:
    return np.asarray(True), np.asarray(0.0)


@graph
def counting(a: Stream[Three]):
    """The sum so far."""
    return counted(a)


def test_a_truth_is_no_number_that_is_not_finite():
    """In lanes all bits of a true one are set, as in a NaN."""
    subject = LoweredGraph(counting.build(), dtype="float64")
    given = {"a": Series(np.arange(3) * MS, Three(value=np.ones((3, 3))))}
    lanes = lanes_of(subject.pipeline, np.float64, subject.tape(given).patterns, COMPILED)
    assert lanes is not None
    cells, seeds = [np.asarray(True), np.asarray(0.0)], [seed_words(k) for k in range(WIDTH)]
    memory = lanes.state([cells], seeds)
    assert lanes.finite(memory)
    for k in range(WIDTH):
        astray = [*[cells] * k, [np.asarray(True), np.asarray(np.nan)]]
        assert not lanes.finite(lanes.state([*astray, *[cells] * (WIDTH - 1 - k)], seeds))
    apart = lanes.state([cells] * WIDTH, seeds)
    np.testing.assert_array_equal(lanes.begun(memory, seeds).view(np.uint8), apart.view(np.uint8))


def test_runs_that_start_alike_differ_by_their_seeds_alone():
    built = drawing.build()
    inputs = {"a": data(0)["a"]}
    batch = many(built, inputs, [7, 8, 7, 9, 7, 8], engine="c")
    for k, seed in enumerate(batch.seeds):
        compare(batch, k, simulate(built, inputs, engine="c", seed=seed), tolerance=1e-12)
