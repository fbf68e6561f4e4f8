"""Many runs at once: the same as one at a time, whatever else is asked for."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import (
    DataError,
    DeclarationError,
    DivergedError,
    Scalar,
    Series,
    Stream,
    UnknownNameError,
    block,
    delay,
    graph,
    simulate,
    simulate_many,
)
from tests.support import ENGINES, scalars


@block
def walk(before: Scalar, push: Scalar, *, draw, xp) -> Scalar:
    return before + push + xp.sum(draw.normal("step", (3,)))


@graph
def walker(push: Stream[Scalar], *, start):
    place = delay(start, name="place")
    moved = walk(place, push)
    place.feed(moved)
    return {"place": moved, "high": moved.filter(lambda x: x > 0.0)}


def inputs(seed: int = 0, n: int = 150) -> dict[str, Series]:
    return {"push": Series(np.arange(n) * 10_000_000, np.random.default_rng(seed).normal(size=n))}


@pytest.fixture(scope="module")
def built():
    return walker.build(start=0.0)


@pytest.mark.parametrize("engine", ["python", "reference", "xla", "c"])
def test_each_run_is_what_a_single_run_gives(built, engine):
    batch = simulate_many(built, inputs, range(5), engine=engine, runs_at_once=2)
    for k in range(5):
        alone = simulate(built, inputs(k), engine=engine, seed=k)
        for name in ("place", "high"):
            run = batch[name].run(k)
            assert np.array_equal(run.time, alone[name].time)
            np.testing.assert_allclose(run.value, alone[name].value, rtol=0, atol=1e-12)


def test_a_run_does_not_depend_on_how_many_are_asked_for(built):
    many = simulate_many(built, inputs, range(70), runs_at_once=16)
    few = simulate_many(built, inputs, range(3), runs_at_once=16)
    assert np.array_equal(many["place"].value[:3], few["place"].value)


def test_runs_differ_by_their_seed_alone(built):
    batch = simulate(built, inputs(), seeds=[4, 4, 5], engine="xla")
    assert np.array_equal(batch["place"].value[0], batch["place"].value[1])
    assert not np.array_equal(batch["place"].value[0], batch["place"].value[2])


def test_start_values_may_depend_on_the_seed(built):
    batch = simulate_many(built, inputs(), range(3), init=lambda seed: {"place": 100.0 * seed})
    alone = simulate(built, inputs(), init={"place": 200.0}, seed=2)
    np.testing.assert_allclose(batch["place"].value[2], alone.place.value)


def test_only_what_is_kept_comes_back(built):
    batch = simulate_many(built, inputs(), range(2), keep=["place.value"])
    assert list(batch.series) == ["place"]
    with pytest.raises(UnknownNameError, match="place"):
        simulate_many(built, inputs(), range(2), keep=["plaice"])
    with pytest.raises(UnknownNameError, match="high"):
        batch["high"]


@pytest.mark.parametrize("engine", ENGINES)
def test_what_is_not_kept_and_nothing_else_needs_is_not_computed(engine):
    """Nor is it found to have diverged; what a register needs is."""

    @block
    def moved(level: Scalar, x: Scalar) -> tuple[Scalar, Scalar, Scalar]:
        return level + x, 1.0 / (x - 3.0), 2.0 * x

    @graph
    def g(x: Stream[Scalar]):
        memory = delay(0.0, name="level")
        level, far, double = moved(memory, x)
        memory.feed(level)
        return {"level": level, "far": far, "double": double}

    made, data = g.build(), {"x": scalars(range(5))}
    whole = simulate_many(made, data, [0, 1], engine=engine, diverged="count")
    few = simulate_many(made, data, [0, 1], engine=engine, keep=["double", "level"])
    assert list(few.series) == ["double", "level"]
    assert not few.diverged
    assert set(whole.diverged) == {0, 1}
    for name, runs in few.series.items():
        np.testing.assert_array_equal(runs.value, whole[name].value)
    with pytest.raises(DivergedError, match="far"):
        simulate_many(made, data, [0, 1], engine=engine)


def test_runs_at_other_times_are_refused(built):
    with pytest.raises(DataError, match="at the same times"):
        simulate_many(built, lambda seed: inputs(seed, 100 + seed), range(2))


@pytest.mark.parametrize("engine", ["python", "reference", "xla"])
def test_inputs_that_can_be_read_only_once_serve_all_runs(built, engine):
    events = [(k * 10_000_000, float(k % 3 - 1)) for k in range(20)]
    batch = simulate(built, {"push": iter(events)}, seeds=[0, 1], engine=engine)
    assert batch["place"].present.all()
    assert batch["place"].value.shape == (2, 20)


@pytest.mark.parametrize("size", [0, -1, 1.5, True])
def test_chunks_of_no_size_are_refused(built, size):
    with pytest.raises(DeclarationError, match="positive size"):
        simulate_many(built, inputs(), range(2), runs_at_once=size)


def test_outputs_at_few_ticks_are_kept_at_those_alone(built):
    @graph
    def rare(a: Stream[Scalar], b: Stream[Scalar]):
        return {"b": b.map(lambda x: x + 1.0), "a": a}

    time = np.arange(1000) * 1_000_000
    data = {"a": Series(time, np.zeros(1000)), "b": Series(time[::250], np.arange(4.0))}
    batch = simulate_many(rare.build(), data, range(3), runs_at_once=2)
    assert batch["b"].value.tolist() == [[1.0, 2.0, 3.0, 4.0]] * 3
    assert batch["b"].time.tolist() == time[::250].tolist()
