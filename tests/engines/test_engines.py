"""The three engines agree, on random small graphs and where they could most easily differ."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from flowgraph import (
    Array,
    FifoOverflowError,
    Scalar,
    Series,
    Signal,
    Stream,
    aperiodic,
    apply,
    block,
    delay,
    every,
    graph,
    integer,
    latest,
    lower,
    match,
    merge,
    periodic,
    real,
    simulate,
    zip,
    zip_latest,
)
from tests.support import ENGINES, all_engines, isolated, same, same_state, scalars

# -- random graphs ------------------------------------------------------------------------------------


@block
def option(x: Scalar, z: Scalar | None) -> tuple[Scalar, Scalar | None]:
    return (x, None) if z is None else (x + 0.5 * z, x - z)


@block
def two_options(x: Scalar, y: Scalar | None, z: Scalar | None) -> Scalar:
    return x if y is None and z is None else x - z if y is None else x + y if z is None else y * z - x


@block
def since(x, *, dt):
    return x + 1e8 * dt


@block
def smooth(state, x):
    value = 0.75 * state + 0.25 * x
    return value, value


@smooth.init
def _(x: Any) -> Any:
    return 0.0


RANDOM = settings(deadline=None, report_multiple_bugs=False)


def affine(k: int) -> Any:
    return lambda v: 0.5 * v + k


def above(limit: float) -> Any:
    return lambda v: v > limit


KINDS = (
    "map",
    "filter",
    "every",
    "every_clock",
    "latest",
    "delay",
    "merge",
    "zip",
    "match",
    "option",
    "two_options",
    "dt",
    "state",
    "apply",
    "zip_latest",
    "loop",
)
RECIPES = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, 20), st.integers(0, 20), st.integers(0, 5)), max_size=7
)


def grow(recipe: list[tuple[str, int, int, int]], streams: list[Stream[Any]]) -> list[Stream[Any]]:
    """Add a node for each line of a recipe; all streams are real scalars."""
    for kind, i, j, k in recipe:
        a, b = streams[i % len(streams)], streams[j % len(streams)]
        if kind == "map":
            made = a.map(affine(k))
        elif kind == "filter":
            made = a.filter(above(0.2 * k - 0.5))
        elif kind == "every":
            made = every(1 + k, a, phase=j % (1 + k))
        elif kind == "every_clock":
            made = latest(a, init=0.5).at(every(2, a | b))
        elif kind == "latest":
            made = latest(a, init=float(k), at=b)
        elif kind == "delay":
            made = a.delay(float(k)).at(b)
        elif kind == "merge":
            made = merge(a, b, tie=("left", "right", lambda p, q: p - q)[k % 3])
        elif kind == "zip":
            made = zip(every(2, a), every(2, a, phase=1)).map(lambda p: p[0] - p[1])
        elif kind == "match":
            made = match(a, b, tolerance=k, size=40).map(lambda p: p[0] + 2.0 * p[1])
        elif kind == "option":
            made, other = option(a, every(1 + k, a))
            streams.append(other)
        elif kind == "two_options":
            made = two_options(latest(a, init=0.0), a, b, at=a | b)
        elif kind == "dt":
            made = since(a)
        elif kind == "state":
            made = smooth(a)
        elif kind == "apply":
            made = apply(lambda p, q: p - q, a, latest(b, init=1.0))
        elif kind == "zip_latest":
            made = zip_latest(a, b, init=(0.0, 0.0)).map(lambda p: p[0] * p[1])
        else:
            memory = delay(0.25)
            made = apply(lambda p, q: 0.5 * p + q, memory, a)
            memory.feed(made)
        streams.append(made)
    return streams


def random_graph(recipe: list[tuple[str, int, int, int]]) -> Any:
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return {f"s{n}": s for n, s in enumerate(grow(recipe, [x, y]))}

    return g.build()


TIMES = st.lists(st.integers(0, 25), unique=True, max_size=12).map(sorted)


def random_data(times_x: list[int], times_y: list[int], seed: int) -> dict[str, Series]:
    random = np.random.default_rng(seed)
    draw = lambda times: scalars(times, np.round(random.normal(size=len(times)), 2))
    return {"x": draw(times_x), "y": draw(times_y)}


@settings(RANDOM, max_examples=120)
@given(RECIPES, TIMES, TIMES, st.integers(0, 1000))
def test_python_and_reference_agree_to_the_bit_on_random_graphs(recipe, times_x, times_y, seed):
    built, data = random_graph(recipe), random_data(times_x, times_y, seed)
    same(simulate(built, data), simulate(built, data, engine="reference"))


@settings(RANDOM, max_examples=10, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(RECIPES, TIMES, TIMES, st.integers(0, 1000))
def test_xla_agrees_on_random_graphs(recipe, times_x, times_y, seed):
    built, data = random_graph(recipe), random_data(times_x, times_y, seed)
    same(simulate(built, data), simulate(built, data, engine="xla"), exact=False)


@settings(RANDOM, max_examples=10, phases=(Phase.explicit, Phase.reuse, Phase.generate))
@given(RECIPES, TIMES, TIMES, st.integers(0, 1000))
def test_c_agrees_on_random_graphs(recipe, times_x, times_y, seed):
    built, data = random_graph(recipe), random_data(times_x, times_y, seed)
    same(simulate(built, data), simulate(built, data, engine="c"), exact=False)


@settings(RANDOM, max_examples=40)
@given(RECIPES, TIMES, TIMES, st.integers(0, 26), st.permutations(["python", "reference"]))
def test_a_run_resumes_in_another_engine(recipe, times_x, times_y, cut, engines):
    built, data = random_graph(recipe), random_data(times_x, times_y, 1)
    head = simulate(built, {n: s[s.time < cut] for n, s in data.items()}, engine=engines[0])
    tail = simulate(
        built, {n: s[s.time >= cut] for n, s in data.items()}, engine=engines[1], state=head.state
    )
    same_state(tail.state, simulate(built, data).state)


@settings(RANDOM, max_examples=40)
@given(RECIPES, TIMES, TIMES)
def test_nesting_changes_no_result(recipe, times_x, times_y):
    @graph
    def inner(x: Stream[Scalar], y: Stream[Scalar]):
        return grow(recipe, [x, y])

    @graph
    def outer(x: Stream[Scalar], y: Stream[Scalar]):
        return {f"s{n}": s for n, s in enumerate(inner(x, y))}

    data = random_data(times_x, times_y, 2)
    flat, nested = simulate(random_graph(recipe), data), simulate(outer.build(), data)
    for name in flat.series:
        np.testing.assert_array_equal(flat[name].time, nested[name].time)
        np.testing.assert_array_equal(flat[name].value, nested[name].value)


# -- all three, by hand ---------------------------------------------------------------------------------


class Fix(Signal):
    place: Array = real(2)
    good: Array = integer(dtype="int64")


def test_structs_integers_and_truths_come_out_of_every_engine_alike():
    @graph
    def g(fix: Stream[Fix], beat: Stream[Scalar]):
        return {
            "fix": fix,
            "held": latest(fix, init=Fix(np.zeros(2), np.int64(-1))).at(beat),
            "count": fix.map(lambda f: f.good * 3),
            "far": fix.map(lambda f: f.place > 0.0),
            "found": fix.map(lambda f: f.place @ f.place),
        }

    random = np.random.default_rng(0)
    fixes = Series(np.arange(8) * 10, Fix(random.normal(size=(8, 2)), np.arange(8) * 2**40))
    result = all_engines(g.build(), {"fix": fixes, "beat": scalars([5, 25, 70])})
    assert result.held.good.tolist() == [0, 2 * 2**40, 7 * 2**40]
    assert result["count"].value.dtype == np.int64
    assert result.far.value.dtype == np.bool_


def test_an_index_of_the_data_can_be_kept_from_tick_to_tick():
    """Regression: JAX searches in int32, and a register of int64 did not take it."""

    @block
    def place(x, *, xp):
        return xp.searchsorted(xp.asarray([0.0, 1.0, 2.0]), x)

    @graph
    def g(x: Stream[Scalar]):
        return place(x).delay(np.int64(-1), name="memory").at(x)

    result = all_engines(g.build(), {"x": scalars([0, 1, 2], [0.5, 5.0, 1.0])})
    assert result.output.value.tolist() == [-1, 1, 3]


def test_many_patterns_of_sources_use_one_program():
    names = [f"s{k}" for k in range(5)]

    @graph
    def g(s0: Stream[Scalar], s1: Stream[Scalar], s2: Stream[Scalar], s3: Stream[Scalar], s4: Stream[Scalar]):
        total = s0
        for other in (s1, s2, s3, s4):
            total = merge(total, other, tie=lambda a, b: a + 2.0 * b)
        return {"total": total, "dt": since(total)}

    random = np.random.default_rng(5)
    data = {n: scalars(np.flatnonzero(random.random(60) < 0.5), None) for n in names}
    assert len({tuple(t in d.time for d in data.values()) for t in range(60)}) > 16
    all_engines(g.build(), data)


def test_programs_chosen_by_a_switch_agree():
    @block
    def heavy(P: real(6, 6), z: Scalar | None, *, xp) -> real(6, 6):  # type: ignore[valid-type]
        Q = 0.5 * (P @ P.mT) / (1.0 + xp.sum(P * P)) + xp.eye(6)
        return Q if z is None else Q + z * xp.linalg.solve(Q + 6.0 * xp.eye(6), P)

    @graph
    def g(x: Stream[Scalar], z: Stream[Scalar]):
        memory = delay(np.eye(6), name="P")
        now = heavy(memory, z, at=x | z)
        memory.feed(now)
        return now

    built = g.build()
    data = {"x": scalars(range(0, 90, 3)), "z": scalars(range(0, 90, 10), np.linspace(0.0, 1.0, 9))}
    all_engines(built, data)
    (scan,) = lower(built).__dict__["_scans"].values()
    assert scan.branches is not None, "this graph was to be large enough for a switch"


def test_more_sources_than_bits_in_an_int32():
    """Regression: the pattern of present sources was cut to 32 bits."""
    names = [f"x{k}" for k in range(34)]
    scope: dict[str, Any] = {"Stream": Stream, "Scalar": Scalar}
    exec(f"def g({', '.join(n + ': Stream[Scalar]' for n in names)}):\n    return {', '.join(names)}", scope)
    data = {n: scalars([10 * k, 1000]) for k, n in enumerate(names)}
    all_engines(graph(scope["g"]).build(), data)


def test_recordings_longer_than_a_chunk_of_xla():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return smooth(merge(x, y, tie="left"))

    n = 70_000
    data = {"x": scalars(np.arange(n), np.sin(np.arange(n))), "y": scalars(np.arange(0, n, 7) * 2)}
    a, b = simulate(g.build(), data), simulate(g.build(), data, engine="xla")
    same(a, b, exact=False)


def test_a_count_of_a_count_is_absent_where_it_does_not_fire():
    """Regression: a counter that stood still was taken for one that had come round."""

    @graph
    def g(x: Stream[Scalar]):
        third = every(3, x)
        return {
            "six": every(2, third),
            "pairs": zip(every(2, third), every(2, third, phase=1)).map(lambda p: p[0] + p[1]),
        }

    result = all_engines(g.build(), {"x": scalars(range(20))})
    assert result.six.time.tolist() == [0, 6, 12, 18]
    assert result.pairs.time.tolist() == [3, 9, 15]


def test_an_absent_source_may_be_named_by_a_selection_that_does_not_take_it():
    """Regression: the interpreter had no value for the leaves of an absent input."""

    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return merge(x.filter(lambda v: v > 1.5), y, tie="left")

    result = all_engines(g.build(), {"x": scalars([0, 10, 20]), "y": scalars([5, 20])})
    assert result.output.value.tolist() == [1.0, 2.0, 3.0]


def test_declared_clocks_change_no_result():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return {"merge": merge(x, y, tie="left"), "held": latest(y, init=0.0, at=x)}

    data = {"x": scalars(range(0, 100, 10)), "y": scalars(range(5, 100, 30))}
    plain = all_engines(g.build(), data)
    declarations: tuple[dict[str, Any], ...] = (
        {"x": periodic(10, phase=0), "y": periodic(30, phase=5)},
        {"x": periodic(10), "y": aperiodic(max_rate=1e9)},
    )
    for clocks in declarations:
        declared = all_engines(g.build(**clocks), data)
        for name in plain.series:
            np.testing.assert_array_equal(plain[name].value, declared[name].value)


# -- float32 --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("engine", ["reference", "xla", "c"])
def test_float32_stays_float32(engine):
    @block
    def update(P, x, *, dt, xp):
        scaled = 0.1 * xp.eye(3) + P * xp.exp(-dt) + xp.mean(P) + 1 / 3
        return xp.linalg.cholesky(scaled @ scaled.mT) * xp.where(x > 0.0, x, 2.0)

    @graph
    def g(x: Stream[Scalar]):
        memory = delay(np.eye(3), name="P")
        now = update(memory, x)
        memory.feed(now)
        return now

    built = g.build()
    data = {"x": scalars(np.arange(5) * 10**8, [0.1, 0.2, 0.3, 0.1, 0.7])}
    single = simulate(built, data, engine=engine, dtype="float32")
    double = simulate(built, data, engine=engine)
    for array in (single.output.value, single.state["registers"]["P"]):
        np.testing.assert_array_equal(array, array.astype(np.float32))
    assert np.abs(single.output.value - double.output.value).max() > 0.0
    np.testing.assert_allclose(single.output.value, double.output.value, rtol=1e-4, atol=1e-5)


# -- errors and absence ---------------------------------------------------------------------------------


def test_an_overflow_is_the_same_error_in_every_engine():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return {"p": match(x, y, tolerance=1, size=2, name="pairs")}

    data = {"x": scalars([0, 10, 20, 30, 40]), "y": scalars([35])}
    messages = set()
    for engine in ENGINES:
        with pytest.raises(FifoOverflowError) as error:
            simulate(g.build(), data, engine=engine)
        messages.add(str(error.value))
    assert len(messages) == 1
    assert "t = 20 ns" in messages.pop()


@pytest.mark.parametrize(
    "pair", [("python", "xla"), ("xla", "python"), ("xla", "reference"), ("python", "c"), ("c", "python")]
)
def test_a_run_resumes_from_and_to_xla(pair):
    recipe = [(kind, n, n + 1, 2) for n, kind in enumerate(("loop", "match", "dt", "zip", "state"))]
    built, data = random_graph(recipe), random_data(list(range(0, 24, 2)), list(range(1, 24, 3)), 3)
    head = simulate(built, {n: s[s.time < 11] for n, s in data.items()}, engine=pair[0])
    tail = simulate(built, {n: s[s.time >= 11] for n, s in data.items()}, engine=pair[1], state=head.state)
    same_state(tail.state, simulate(built, data).state, exact=False)


NO_JAX = """
import numpy as np
from flowgraph import MissingDependencyError, Scalar, Stream, graph, simulate
@graph
def g(x: Stream[Scalar]):
    return x.map(lambda v: 2.0 * v)
data = {"x": (np.arange(3), np.ones(3))}
for engine in ("python", "reference"):
    assert simulate(g.build(), data, engine=engine).output.value.tolist() == [2.0, 2.0, 2.0]
try:
    simulate(g.build(), data, engine="xla")
except MissingDependencyError as error:
    print(error)
else:
    raise SystemExit("no error without JAX")
"""


def test_without_jax_only_its_engine_is_missing():
    done = isolated(NO_JAX, blocked=("jax", "jaxlib"))
    assert done.returncode == 0, done.stderr
    for word in ('engine="xla": the XLA engine needs JAX', "pip install", "flowgraph-filters[xla]"):
        assert word in done.stdout
