"""What ends a run, alike in all engines: the first full queue in time, numbers that are no longer finite."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Array,
    DataError,
    DivergedError,
    FifoOverflowError,
    Graph,
    Pipeline,
    Run,
    Scalar,
    Series,
    Signal,
    Stream,
    apply,
    arrays,
    delay,
    graph,
    latest,
    lower,
    match,
    real,
    simulate,
    simulate_many,
    tap,
    window,
)
from flowgraph.errors import RunError, UnknownNameError
from tests.support import ENGINES, MS, flat_state, scalars

LOWERED = ENGINES[1:]


def ended(built: Graph, inputs: Any, engine: str, **options: Any) -> RunError:
    with pytest.raises(RunError) as error:
        simulate(built, inputs, engine=engine, **options)
    return error.value


def alike(built: Graph, inputs: Any, **options: Any) -> RunError:
    """The error in Python, after checking that the other engines give the same one, with the same result."""
    first = ended(built, inputs, "python", **options)
    for engine in LOWERED:
        other = ended(built, inputs, engine, **options)
        assert type(other) is type(first)
        assert str(other) == str(first), engine
        assert other.time == first.time
        assert other.result.ticks == first.result.ticks, engine
        assert dict(other.result.stats) == dict(first.result.stats), engine
        for name, series in first.result.series.items():
            np.testing.assert_array_equal(other.result[name].time, series.time, err_msg=engine)
            for leaf, array in series.leaves.items():
                np.testing.assert_allclose(other.result[name][leaf], array, rtol=1e-9, atol=1e-12)
        mine, theirs = flat_state(first.result.state), flat_state(other.result.state)
        assert list(mine) == list(theirs)
        for name, value in mine.items():
            np.testing.assert_allclose(theirs[name], value, rtol=1e-9, atol=1e-12, err_msg=f"{engine} {name}")
    return first


# -- full queues -------------------------------------------------------------------------------------------


@graph
def three_queues(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar]):
    return {
        "late": match(a, b, tolerance="1ms", size=6, name="late").map(lambda p: p[0]),
        "early": match(a, c, tolerance="1ms", size=2, name="early").map(lambda p: p[0]),
        "window": window(a, at=b, size=4, name="window").map(lambda w, *, xp: xp.sum(w.values)),
        "a": a,
    }


QUEUES = three_queues.build()
SILENT = {"a": scalars(np.arange(40) * MS), "b": scalars([200 * MS]), "c": scalars([200 * MS])}


def test_the_first_full_queue_in_time_is_named_not_the_first_in_the_list():
    error = alike(QUEUES, SILENT)
    assert isinstance(error, FifoOverflowError)
    assert (error.path, error.time) == ("early", 2 * MS)
    assert error.got == f"one more at t = {2 * MS} ns"
    assert error.result.a.time.tolist() == [0, MS]


def test_a_window_that_is_full_first():
    error = alike(QUEUES, {**SILENT, "c": scalars(np.arange(40) * MS)})
    assert (error.path, error.time, error.result.ticks) == ("window", 4 * MS, 4)
    assert error.result.early.time.tolist() == [0, MS, 2 * MS, 3 * MS]


def test_of_two_full_at_one_tick_the_first_that_was_declared():
    @graph
    def two(a: Stream[Scalar], b: Stream[Scalar], c: Stream[Scalar]):
        return {
            "x": match(a, b, tolerance="1ms", size=3, name="x").map(lambda p: p[0]),
            "y": match(a, c, tolerance="1ms", size=3, name="y").map(lambda p: p[0]),
        }

    assert alike(two.build(), SILENT).path == "x"


@pytest.mark.parametrize("engine", ENGINES)
def test_many_runs_end_in_the_error_of_the_first_and_name_its_seed(engine: str):
    def inputs(seed: int) -> Any:
        return SILENT if seed >= 5 else {**SILENT, "a": scalars(np.arange(40) * 1000 * MS)}

    calm = {**SILENT, "a": scalars([0, 300 * MS])}
    assert len(simulate_many(QUEUES, calm, [1, 2], engine=engine)["a"].time) == 2
    with pytest.raises(FifoOverflowError) as error:
        simulate_many(QUEUES, SILENT, [5, 6], engine=engine)
    assert (error.value.path, error.value.time, error.value.result.ticks) == ("early", 2 * MS, 2)
    assert "in the run of seed 5" in error.value.__notes__


@pytest.mark.parametrize("engine", LOWERED)
def test_a_pipeline_without_its_graph_ends_alike(engine: str):
    pipeline = Pipeline.from_json(json.loads(json.dumps(lower(QUEUES).to_json())))
    with pytest.raises(FifoOverflowError) as error:
        pipeline.run(SILENT, engine=engine)
    assert (error.value.path, error.value.time) == ("early", 2 * MS)
    assert error.value.result.a.time.tolist() == [0, MS]


def test_events_that_are_read_as_they_come_end_alike():
    def endless() -> Any:
        n = 0
        while True:
            yield n * MS, float(n)
            n += 1

    with pytest.raises(FifoOverflowError) as error:
        simulate(QUEUES, {**SILENT, "a": endless()})
    assert error.value.result.a.time.tolist() == [0, MS]


# -- numbers that are not finite ---------------------------------------------------------------------------


@graph
def solves(a: Stream[Scalar]):
    """Solves with a matrix that is singular from a = 3 on."""
    P = delay(np.eye(2), name="P")

    def step(P: Any, v: Any, *, xp: Any) -> Any:
        last = v * xp.where(v < 3, 2.0, 1.0)
        return xp.linalg.solve(xp.stack([xp.stack([v, v]), xp.stack([v, last])]), P)

    new = apply(step, P, a, name="step")
    P.feed(new)
    return {"corner": new.map(lambda m: m[0, 0]), "a": a}


@graph
def factors(a: Stream[Scalar]):
    """Factors a matrix that is not positive definite from the third tick on; no output tells."""
    P = delay(np.eye(2), name="P")
    new = apply(lambda P, v, *, xp: xp.linalg.cholesky(P - v * np.eye(2) / 4), P, a, name="factor")
    P.feed(new)
    return {"a": a}


@graph
def overflows(a: Stream[Scalar]):
    """Squares itself beyond the largest number."""
    x = delay(1e40, name="x")
    new = apply(lambda x, v: x * x * v, x, a, name="square")
    x.feed(new)
    return {"a": a, "new": new}


SIX = {"a": scalars(np.arange(6) * MS)}


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize(
    ("build", "block_", "what", "time"),
    [
        (solves, "step", "output corner", 2 * MS),
        (factors, "factor", "register P", 2 * MS),
        (overflows, "square", "output new", 2 * MS),
    ],
)
def test_block_time_and_last_good_tick_are_named(build: Any, block_: str, what: str, time: int):
    error = alike(build.build(), SIX)
    assert isinstance(error, DivergedError)
    assert (error.path, error.time, error.last) == (block_, time, time - MS)
    assert error.expected == f"finite numbers in {what}"
    assert f"t = {time} ns, made by" in str(error.got)
    assert __name__ in str(error.got)
    assert error.result.a.time.tolist() == list(range(0, time, MS))


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize("build", [solves, factors, overflows])
def test_counted_they_are_notes_and_counts(build: Any, engine: str):
    result = simulate(build.build(), SIX, engine=engine, diverged="count")
    assert result.ticks == 6
    assert all(note.startswith("diverged: ") for note in result.notes)
    counts = {
        "solves": {"corner.diverged": 4, "P.diverged": 1},
        "factors": {"P.diverged": 1},
        "overflows": {"new.diverged": 4, "x.diverged": 1},
    }
    assert dict(result.stats) == counts[build.name]
    batch = simulate_many(build.build(), SIX, [1, 2], engine=engine, diverged="count")
    assert sorted(batch.diverged) == [0, 1]
    with pytest.raises(DivergedError) as error:
        simulate_many(build.build(), SIX, [1, 2], engine=engine)
    assert error.value.time == 2 * MS
    assert "in the run of seed 1" in error.value.__notes__


@pytest.mark.parametrize("engine", ENGINES)
def test_of_many_only_those_that_diverge_are_listed(engine: str):
    built = factors.build()

    def inputs(seed: int) -> Any:
        return {"a": scalars(np.arange(6) * MS, np.full(6, seed / 100))}

    batch = simulate_many(built, inputs, [0, 400, 0, 390], engine=engine, diverged="count")
    assert sorted(batch.diverged) == [1, 3]
    with pytest.raises(DivergedError) as error:
        simulate_many(built, inputs, [0, 400, 0, 390], engine=engine)
    assert "in the run of seed 400" in error.value.__notes__


@pytest.mark.parametrize("engine", ENGINES)
def test_a_run_that_is_resumed_names_the_same_tick(engine: str):
    built = factors.build()
    half = simulate(built, {"a": SIX["a"][:1]}, engine=engine)
    with pytest.raises(DivergedError) as error:
        simulate(built, {"a": SIX["a"][1:]}, engine=engine, state=half.state)
    assert (error.value.time, error.value.last) == (2 * MS, MS)


def test_what_is_earlier_counts_a_full_queue_or_a_number():
    @graph
    def both(a: Stream[Scalar], b: Stream[Scalar], n: Stream[Scalar]):
        pair = match(a, b, tolerance="1ms", size=5, name="pair").map(lambda p: p[0])
        return {"pair": pair, "root": n.map(lambda v, *, xp: xp.sqrt(v), name="root"), "a": a}

    built = both.build()
    a, b = scalars(np.arange(9) * MS), scalars([90 * MS])
    with np.errstate(invalid="ignore"):
        early = alike(built, {"a": a, "b": b, "n": scalars([0, 3 * MS], [1.0, -1.0])})
        late = alike(built, {"a": a, "b": b, "n": scalars([0, 7 * MS], [1.0, -1.0])})
    assert (early.path, early.time) == ("root", 3 * MS)
    assert (late.path, late.time) == ("pair", 5 * MS)


class Fix(Signal):
    z: Array = real(2)


def gaps() -> Series:
    return arrays(
        np.arange(3) * MS, Fix(np.array([[1.0, 2.0], [np.nan, 3.0], [4.0, np.nan]])), not_finite="keep"
    )


@pytest.mark.parametrize("engine", ENGINES)
def test_nan_that_came_in_may_be_moved_held_and_given_out(engine: str):
    @graph
    def held(a: Stream[Fix]):
        last = latest(a, init=Fix(np.zeros(2)), name="last")
        return {
            "now": last.at(a),
            "turned": a.map(lambda s, *, xp: xp.flip(s.z)),
            "first": a.map(lambda s: s.z[0]),
        }

    result = simulate(held.build(), {"a": gaps()}, engine=engine)
    assert np.isnan(result.first.value).tolist() == [False, True, False]
    assert not result.notes


def test_nan_that_came_in_and_was_computed_with_is_named_by_its_input():
    error = alike(_sums(), {"a": gaps()})
    assert error.time == MS
    assert "from one of input 'a'" in str(error.got)


def _sums() -> Graph:
    @graph
    def sums(a: Stream[Fix]):
        return a.map(lambda s, *, xp: xp.sum(s.z), name="sum")

    return sums.build()


@pytest.mark.parametrize("engine", ENGINES)
def test_an_infinity_that_a_step_writes_down_is_meant(engine: str):
    @graph
    def marked(a: Stream[Scalar]):
        return a.map(lambda v, *, xp: xp.where(v > 3, xp.inf, xp.where(v > 2, xp.nan, v)))

    result = simulate(marked.build(), SIX, engine=engine)
    assert np.isfinite(result.output.value).tolist() == [True, True, False, False, False, False]


@pytest.mark.parametrize("engine", ENGINES)
def test_an_initial_value_that_is_not_finite_is_meant(engine: str):
    @graph
    def kept(a: Stream[Scalar], b: Stream[Scalar]):
        return {"a": a, "held": latest(b, init=0.0, name="kept").at(a)}

    built = kept.build()
    inputs = {"a": scalars([0]), "b": scalars([])}
    assert np.isnan(simulate(built, inputs, engine=engine, init={"kept": np.nan}).held.value).all()


def test_another_way_than_those_is_refused():
    with pytest.raises(UnknownNameError, match="no way of diverged is called 'ignore'"):
        simulate(QUEUES, SILENT, diverged="ignore")


@pytest.mark.parametrize("engine", ENGINES)
def test_blocks_of_the_host_are_not_run_twice(engine: str):
    seen: list[float] = []

    @graph
    def watched(a: Stream[Scalar]):
        tap(a, lambda v: seen.append(float(v)))
        return a.map(lambda v, *, xp: xp.log(v - 3.0), name="log")

    with pytest.raises(DivergedError) as error, np.errstate(all="ignore"):
        simulate(watched.build(), {"a": scalars([0, MS, 2 * MS], [5.0, 1.0, 6.0])}, engine=engine)
    assert error.value.time == MS
    assert len(seen) <= 3


# -- singular matrices ------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ENGINES)
def test_only_the_matrix_that_is_singular_gives_nan(engine: str):
    class Two(Signal):
        a: Array = real(2, 2, 2)

    @graph
    def both(a: Stream[Two]):
        return {
            "solved": a.map(lambda s, *, xp: xp.linalg.solve(s.a, xp.broadcast_to(xp.eye(2), (2, 2, 2)))),
            "factor": a.map(lambda s, *, xp: xp.linalg.cholesky(s.a)),
            "vector": a.map(lambda s, *, xp: xp.linalg.solve(s.a[0, :, :], xp.asarray([1.0, 2.0]))),
        }

    matrices = np.array([[[1.0, 2.0], [2.0, 4.0]], [[2.0, 0.0], [0.0, 2.0]]])
    with np.errstate(all="ignore"):
        result = simulate(
            both.build(), {"a": (np.array([0]), Two(matrices[None]))}, engine=engine, diverged="count"
        )
    assert np.isnan(result.solved.value[0, 0]).all()
    np.testing.assert_allclose(result.solved.value[0, 1], np.eye(2) / 2)
    assert np.isnan(result.vector.value).all()
    indefinite = np.array([[[1.0, 2.0], [2.0, 1.0]], [[4.0, 0.0], [0.0, 4.0]]])
    result = simulate(
        both.build(), {"a": (np.array([0]), Two(indefinite[None]))}, engine=engine, diverged="count"
    )
    assert np.isnan(result.factor.value[0, 0]).all()
    np.testing.assert_allclose(result.factor.value[0, 1], 2 * np.eye(2))


# -- ticks that are too far apart --------------------------------------------------------------------------


def test_ticks_that_are_more_than_int64_apart_are_refused_in_every_engine():
    far = scalars([-(2**62) - 2**61, 2**62])
    for engine in ENGINES:
        with pytest.raises(DataError, match="two ticks of a run are too far apart"):
            simulate(factors.build(), {"a": far}, engine=engine)
        with pytest.raises(DataError, match="two ticks of a run are too far apart"):
            simulate(QUEUES, {**SILENT, "b": far[:1], "c": far[1:]}, engine=engine)
    with pytest.raises(DataError, match="two ticks of a run are too far apart"):
        simulate(factors.build(), {"a": iter([(-(2**62) - 2**61, 0.0), (2**62, 0.0)])})
    run = Run(factors.build())
    run.push(-(2**62) - 2**61, a=0.0)
    with pytest.raises(DataError, match="too far apart"):
        run.push(2**62, a=0.0)
