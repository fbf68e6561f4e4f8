"""Joins: when each result is present, what it remembers, what happens at ties, and what a build refuses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import (
    ClockError,
    DeclarationError,
    FifoOverflowError,
    Scalar,
    Stream,
    TypeMismatchError,
    aperiodic,
    apply,
    delay,
    every,
    graph,
    integer,
    latest,
    match,
    merge,
    periodic,
    real,
    simulate,
    sink,
    zip,
    zip_latest,
    zip_latest_right,
)
from flowgraph.language.clock import Counted, Source, counted, disjoint
from flowgraph.language.pairs import _zip_plan
from tests.support import all_engines, pairs, scalars


def run(body, x, y=None, /, **clocks):
    """The output of a graph of two sources, the same in all engines."""
    if y is None:

        @graph
        def one(x: Stream[Scalar]):
            return body(x)

        return all_engines(one.build(**clocks), {"x": x})

    @graph
    def two(x: Stream[Scalar], y: Stream[Scalar]):
        return body(x, y)

    return all_engines(two.build(**clocks), {"x": x, "y": y})


def build(body, **clocks):
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        merge(x, y, tie="left")
        return body(x, y)

    return g.build(**clocks)


def both(result) -> list[tuple[int, float, float]]:
    """Time and both values of a series of pairs."""
    out = result.output
    return list(map(tuple, np.column_stack([out.time, out["0"], out["1"]]).tolist()))


# -- latest and delay --------------------------------------------------------------------------------


def test_latest_reads_after_the_write_and_delay_before():
    def body(x):
        return {"latest": latest(x, init=-1.0).at(x), "delay": x.delay(-1.0).at(x)}

    result = run(body, scalars([0, 10, 20]))
    assert [v for _, v in pairs(result.latest)] == [1.0, 2.0, 3.0]
    assert [v for _, v in pairs(result.delay)] == [-1.0, 1.0, 2.0]


def test_latest_at_a_tie_sees_the_fresh_value():
    result = run(lambda x, y: latest(y, init=-1.0).at(x), scalars([0, 10, 20]), scalars([10, 15]))
    assert pairs(result.output) == [(0, -1.0), (10, 1.0), (20, 2.0)]


def test_delay_at_a_tie_sees_the_value_before():
    result = run(lambda x, y: y.delay(-1.0).at(x), scalars([0, 10, 20]), scalars([10, 15]))
    assert pairs(result.output) == [(0, -1.0), (10, -1.0), (20, 2.0)]


def test_latest_holds_a_derived_stream_of_the_same_tick():
    result = run(
        lambda x, y: latest(y.map(lambda v: 10.0 * v), init=0.0, at=x), scalars([0, 1]), scalars([1])
    )
    assert pairs(result.output) == [(0, 0.0), (1, 10.0)]


def test_latest_needs_an_initial_value_or_a_proof():
    with pytest.raises(
        ClockError, match="y: no initial value, and no proof that a value came first"
    ) as error:
        build(lambda x, y: latest(y, at=x))
    assert "latest(stream, init=...)" in str(error.value.fix)
    with pytest.raises(ClockError, match="latest without init"):
        build(lambda x, y: latest(y))
    result = run(lambda x: latest(x, at=every(2, x)), scalars(range(3)))
    assert pairs(result.output) == [(0, 1.0), (2, 3.0)]


def test_latest_of_a_held_value_is_refused():
    with pytest.raises(DeclarationError, match="latest needs a stream"):
        build(lambda x, y: latest(latest(x, init=0.0), init=0.0))


def test_the_initial_value_must_have_the_type_of_the_stream():
    with pytest.raises(TypeMismatchError, match=r"h: the shape of the value for h does not fit h"):
        build(lambda x, y: latest(x, init=np.zeros(2), name="h").at(x))


def test_a_latest_fed_by_a_conditional_stream_keeps_its_value():
    result = run(
        lambda x: latest(x.filter(lambda v: v > 1.5), init=0.0).at(x), scalars(range(4), [1, 2, 1, 3])
    )
    assert [v for _, v in pairs(result.output)] == [0.0, 2.0, 2.0, 3.0]


# -- map over several, filter, every -------------------------------------------------------------------


def test_apply_over_several_of_one_clock():
    result = run(lambda x: apply(lambda a, b: a - b, x, x.map(lambda v: v * v)), scalars([0, 1], [2.0, 3.0]))
    assert pairs(result.output) == [(0, -2.0), (1, -6.0)]


@settings(deadline=None, max_examples=25)
@given(st.lists(st.floats(-10, 10), max_size=12))
def test_filter_keeps_exactly_what_its_predicate_says(values):
    @graph
    def g(x: Stream[Scalar]):
        return x.filter(lambda v: v > 1.0)

    series = scalars(range(len(values)), values)
    for engine in ("python", "reference"):
        kept = pairs(simulate(g.build(), {"x": series}, engine=engine).output)
        assert kept == [(k, v) for k, v in enumerate(values) if v > 1.0]


@settings(deadline=None, max_examples=40)
@given(st.integers(1, 6), st.integers(0, 5), st.integers(0, 20))
def test_every_counts_values(n, phase, length):
    phase %= n

    @graph
    def g(x: Stream[Scalar]):
        return x.every(n, phase=phase)

    for engine in ("python", "reference"):
        out = simulate(g.build(), {"x": scalars(range(length))}, engine=engine).output
        assert out.time.tolist() == list(range(length))[phase::n]


def test_every_of_a_filter_counts_what_passed():
    result = run(lambda x: every(2, x.filter(lambda v: v > 0.0)), scalars(range(6), [1, -1, 2, 3, -2, 4]))
    assert [v for _, v in pairs(result.output)] == [1.0, 3.0]


def test_every_of_a_clock_counts_ticks():
    result = run(
        lambda x, y: latest(x, init=0.0).at(every(2, x | y)), scalars([0, 20]), scalars([10, 20, 30])
    )
    assert pairs(result.output) == [(0, 1.0), (20, 2.0)]


@pytest.mark.parametrize(("n", "phase"), [(0, 0), (-1, 0), (2, 2), (2, -1), (2.5, 0)])
def test_every_refuses_what_is_no_count(n, phase):
    with pytest.raises(DeclarationError, match="every needs a positive whole number"):
        build(lambda x, y: every(n, x, phase=phase))


# -- merge -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("tie", "value"), [("left", 1.0), ("right", 10.0), (lambda a, b: a + b, 11.0)])
def test_merge_takes_either_and_a_rule_at_ties(tie, value):
    result = run(
        lambda x, y: merge(x, y, tie=tie), scalars([0, 20], [1.0, 2.0]), scalars([0, 10], [10.0, 20.0])
    )
    assert pairs(result.output) == [(0, value), (10, 20.0), (20, 2.0)]


def test_merge_without_a_tie_is_refused_where_clocks_can_coincide():
    with pytest.raises(ClockError, match="x and y can be present together") as error:
        build(lambda x, y: merge(x, y))
    assert 'tie="left"' in str(error.value.fix)


def test_merge_of_clocks_that_never_meet_needs_no_tie():
    result = run(
        lambda x, y: merge(x, y),
        scalars([0, 10]),
        scalars([5, 15]),
        x=periodic(10, phase=0),
        y=periodic(10, phase=5),
    )
    assert [v for _, v in pairs(result.output)] == [1.0, 1.0, 2.0, 2.0]
    other = run(lambda x: merge(every(2, x), every(2, x, phase=1)), scalars(range(4)))
    assert [v for _, v in pairs(other.output)] == [1.0, 2.0, 3.0, 4.0]


def test_merge_refuses_an_unknown_rule_and_other_types():
    with pytest.raises(DeclarationError, match="this tie rule does not exist"):
        build(lambda x, y: merge(x, y, tie="first"))
    with pytest.raises(TypeMismatchError, match="changes its type"):
        build(lambda x, y: merge(x, y.map(lambda v: v > 0.0), tie="left"))


def test_joins_refuse_held_values():
    for join in (
        lambda h, x: zip(h, x),
        lambda h, x: merge(x, h, tie="left"),
        lambda h, x: match(h, x, tolerance=1, size=1),
        lambda h, x: zip_latest(h, x, init=(0.0, 0.0)),
    ):
        with pytest.raises(DeclarationError, match="needs a stream as"):
            build(lambda x, y, join=join: join(latest(x, init=0.0), y))


# -- zip ---------------------------------------------------------------------------------------------


def test_zip_of_one_clock_has_no_queue():
    @graph
    def g(x: Stream[Scalar]):
        return zip(x, x.map(lambda v: -v))

    built = g.build()
    assert built.registers == []
    assert both(all_engines(built, {"x": scalars([0, 1])})) == [(0, 1.0, -1.0), (1, 2.0, -2.0)]


def test_zip_pairs_the_kth_with_the_kth_at_the_later_time():
    result = run(lambda x: zip(every(3, x), every(3, x, phase=2)), scalars(range(9)))
    assert both(result) == [(2, 1.0, 3.0), (5, 4.0, 6.0), (8, 7.0, 9.0)]


def test_zip_knows_its_clock():
    result = run(
        lambda x: apply(
            lambda p, q: p[0] + p[1] - 2.0 * q,
            zip(every(3, x), every(3, x, phase=2)),
            every(3, x, phase=2),
        ),
        scalars(range(6)),
    )
    assert [v for _, v in pairs(result.output)] == [-2.0, -2.0]


@st.composite
def patterns_of_one_rate(draw: st.DrawFn) -> tuple[tuple[int, list[int]], ...]:
    """Two patterns, (period, offsets), with the same share of the ticks."""
    of = draw(st.integers(1, 4))
    share = draw(st.integers(1, of))
    made = []
    for _ in range(2):
        times = draw(st.integers(1, 3))
        size = share * times
        hits = draw(st.sets(st.integers(0, of * times - 1), min_size=size, max_size=size))
        made.append((of * times, sorted(hits)))
    return tuple(made)


@settings(deadline=None, max_examples=200)
@given(patterns_of_one_rate())
def test_the_derived_queue_bound_holds_and_is_tight(patterns):
    first, second = patterns
    root = Source("root")
    a, b = counted(root, *first), counted(root, *second)
    size, clock = _zip_plan(a, b, "zip")
    inside = lambda c, k: not isinstance(c, Counted) or k % c.period in c.offsets
    left = right = most = 0
    present = []
    for k in range(6 * math.lcm(first[0], second[0])):
        left += inside(a, k)
        right += inside(b, k)
        pair = min(left, right, 1)
        present.append(bool(pair))
        left, right = left - pair, right - pair
        most = max(most, left, right)
    assert size >= most, "a queue would overflow"
    assert size == max(most, 1), "the bound is larger than is ever needed"
    assert present == [inside(clock, k) for k in range(len(present))]


@settings(deadline=None, max_examples=25)
@given(st.integers(1, 4), st.integers(0, 3), st.integers(0, 3))
def test_zip_runs_within_its_bound_at_all_phases(n, i, j):
    i, j = i % n, j % n

    @graph
    def g(x: Stream[Scalar]):
        return zip(every(n, x, phase=i), every(n, x, phase=j))

    for engine in ("python", "reference"):
        out = simulate(g.build(), {"x": scalars(range(4 * n))}, engine=engine).output
        assert out["0"].tolist() == [1.0 + i + n * k for k in range(4)]
        assert out["1"].tolist() == [1.0 + j + n * k for k in range(4)]
        assert out.time.tolist() == [max(i, j) + n * k for k in range(4)]


def test_zip_of_filtered_streams_counts_from_the_filter():
    def body(x):
        kept = x.filter(lambda v: v > 0.0)
        return zip(every(2, kept), every(2, kept, phase=1))

    result = run(body, scalars(range(6), [1, -1, 2, 3, -2, 4]))
    assert both(result) == [(2, 1.0, 2.0), (5, 3.0, 4.0)]


@pytest.mark.parametrize(
    ("body", "clocks", "words"),
    [
        (lambda x, y: zip(x, every(2, x)), {}, ["the rates are unequal", "latest(slow, init=...)"]),
        (
            lambda x, y: zip(x, y),
            {"x": periodic("5ms"), "y": periodic("5ms")},
            ["two devices whose rates are only nominally equal", "match(a, b, tolerance=..., size=...)"],
        ),
        (
            lambda x, y: zip(x, y),
            {"x": periodic("5ms"), "y": periodic("25ms")},
            ["cannot be proven equal", "match", "latest(b, init=...)"],
        ),
        (lambda x, y: zip(x, y), {"x": aperiodic(), "y": aperiodic()}, ["cannot be proven equal", "match"]),
        (lambda x, y: zip(x, x.filter(lambda v: v > 0.0)), {}, ["cannot be proven equal", "latest"]),
    ],
)
def test_zip_refuses_what_it_cannot_bound(body, clocks, words):
    with pytest.raises(ClockError) as error:
        build(body, **clocks)
    for word in words:
        assert word in str(error.value)


# -- zip_latest --------------------------------------------------------------------------------------


def test_zip_latest_pairs_whenever_either_comes():
    result = run(
        lambda x, y: zip_latest(x, y, init=(-1.0, -2.0)), scalars([0, 20]), scalars([10, 20], [10.0, 20.0])
    )
    assert both(result) == [(0, 1.0, -2.0), (10, 1.0, 10.0), (20, 2.0, 20.0)]


def test_zip_latest_right_pairs_only_when_the_first_comes():
    result = run(
        lambda x, y: zip_latest_right(x, y, init=-2.0), scalars([0, 20]), scalars([10, 20], [10.0, 20.0])
    )
    assert both(result) == [(0, 1.0, -2.0), (20, 2.0, 20.0)]


# -- match -------------------------------------------------------------------------------------------


def matched(times_x, times_y, tolerance=3, size=4):
    result = run(
        lambda x, y: match(x, y, tolerance=tolerance, size=size, name="m"), scalars(times_x), scalars(times_y)
    )
    return both(result), result.stats


def test_match_pairs_stamps_within_the_tolerance_at_the_later_time():
    assert matched([0, 10, 20], [2, 11, 30])[0] == [(2, 1.0, 1.0), (11, 2.0, 2.0)]


def test_match_at_the_tolerance_and_beyond():
    assert matched([0], [3])[0] == [(3, 1.0, 1.0)]
    assert matched([0], [4])[0] == []


def test_match_of_simultaneous_values():
    found, stats = matched([0, 10], [10], tolerance=3)
    assert found == [(10, 2.0, 1.0)]
    assert stats == {"m.expired_a": 1, "m.expired_b": 0}


def test_match_takes_the_nearest_and_counts_what_it_passes_over():
    found, stats = matched([0, 1, 2], [3])
    assert found == [(3, 3.0, 1.0)]
    assert stats == {"m.expired_a": 2, "m.expired_b": 0}


def test_match_counts_what_expires():
    found, stats = matched([0, 10, 20], [5, 15])
    assert found == []
    assert stats == {"m.expired_a": 2, "m.expired_b": 2}


def test_match_keeps_what_may_still_find_a_partner():
    found, stats = matched([0], [])
    assert found == []
    assert stats == {"m.expired_a": 0, "m.expired_b": 0}


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.integers(0, 40), max_size=10, unique=True).map(sorted),
    st.lists(st.integers(0, 40), max_size=10, unique=True).map(sorted),
    st.integers(0, 6),
)
def test_match_against_brute_force(times_x, times_y, tolerance):
    waiting: dict[str, list[int]] = {"x": [], "y": []}
    found, expired = [], {"x": 0, "y": 0}
    for t in sorted({*times_x, *times_y}):
        here = [name for name, times in (("x", times_x), ("y", times_y)) if t in times]
        for name in here:
            waiting[name].append(t)
        if len(here) == 2:
            pick = {"x": t, "y": t}
        else:
            other = "y" if here[0] == "x" else "x"
            near = [s for s in waiting[other] if t - s <= tolerance]
            pick = {here[0]: t, other: max(near)} if near else {}
            if not near:
                expired[other] += len(waiting[other])
                waiting[other] = []
        if pick:
            found.append((t, pick["x"], pick["y"]))
            for name, stamp in pick.items():
                expired[name] += sum(s < stamp for s in waiting[name])
                waiting[name] = [s for s in waiting[name] if s > stamp]

    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return match(x, y, tolerance=tolerance, size=12)

    data = {"x": scalars(times_x, times_x), "y": scalars(times_y, times_y)}
    for engine in ("python", "reference"):
        result = simulate(g.build(), data, engine=engine)
        assert both(result) == found
        assert list(result.stats.values()) == [expired["x"], expired["y"]]


def test_match_overflow_names_the_join_its_bound_and_the_time():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return match(x, y, tolerance=3, size=2, name="pairs")

    full = {"x": scalars([0, 10]), "y": scalars([])}
    assert len(simulate(g.build(), full).output) == 0
    over = {"x": scalars([0, 10, 20, 30]), "y": scalars([])}
    messages = []
    for engine in ("python", "reference", "xla"):
        with pytest.raises(FifoOverflowError) as error:
            simulate(g.build(), over, engine=engine)
        messages.append(str(error.value))
    assert len(set(messages)) == 1
    for word in ("pairs: the queue is full", "at most 2", "t = 20 ns", "size="):
        assert word in messages[0]


@pytest.mark.parametrize("size", [None, 0, -1, 2.5])
def test_match_needs_a_size(size):
    with pytest.raises(DeclarationError, match="match needs the size of its queues") as error:
        build(lambda x, y: match(x, y, tolerance="5ms", size=size))
    assert "size=8" in str(error.value.fix)


def test_match_needs_a_duration():
    with pytest.raises(DeclarationError, match="tolerance is not understood"):
        build(lambda x, y: match(x, y, tolerance=0.005, size=1))  # type: ignore[arg-type]


def test_queues_hold_arrays_structs_and_integers():
    @graph
    def g(x: Stream[real(2)], k: Stream[integer()]):  # type: ignore[valid-type]
        pair = match(zip(x, x), k, tolerance=2, size=2)
        return pair

    data = {"x": ([0, 10], np.arange(4.0).reshape(2, 2)), "k": ([1, 11], np.array([5, 6], np.int32))}
    out = all_engines(g.build(), data).output
    assert out["0.1"].tolist() == [[0.0, 1.0], [2.0, 3.0]]
    assert out["1"].dtype == np.int32
    assert out["1"].tolist() == [5, 6]


# -- sinks -------------------------------------------------------------------------------------------


def test_a_sink_sees_each_value_once():
    seen: list[float] = []

    @graph
    def g(x: Stream[Scalar]):
        sink(every(2, x), seen.append)

    simulate(g.build(), {"x": scalars(range(5))})
    assert seen == [1.0, 3.0, 5.0]


def test_a_delay_in_a_loop_counts_ticks():
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        count = delay(0.0, name="count")
        now = apply(lambda n: n + 1.0, count, at=x | y)
        count.feed(now)
        return now

    result = all_engines(g.build(), {"x": scalars([0, 10, 20]), "y": scalars([10, 15])})
    assert pairs(result.output) == [(0, 1.0), (10, 2.0), (15, 3.0), (20, 4.0)]


def test_disjoint_clocks_of_every_are_known():
    seen: list[bool] = []

    @graph
    def g(x: Stream[Scalar]):
        seen.append(disjoint(every(3, x).clock, every(3, x, phase=1).clock))
        return x

    g.build()
    assert seen == [True]


# -- what a declaration refuses ------------------------------------------------------------------------


@pytest.mark.parametrize(
    "body",
    [
        lambda x, y: every(2, x, phase=0.5),  # type: ignore[arg-type]
        lambda x, y: every(True, x),
        lambda x, y: every(2, x, phase=True),
        lambda x, y: every(2**31, x),
        lambda x, y: x.every(1.0),
        lambda x, y: match(x, y, tolerance=-5, size=2),
        lambda x, y: match(x, y, tolerance=2**62, size=2),
        lambda x, y: match(x, y, tolerance=2**62 + 1, size=2),
        lambda x, y: match(x, y, tolerance=2**63, size=2),
        lambda x, y: match(x, y, tolerance="99999999999999999999s", size=2),
        lambda x, y: match(x, y, tolerance=1, size=True),
        lambda x, y: match(x, y, tolerance=1, size=2**40),
        lambda x, y: zip_latest(x, y, init=0.0),
        lambda x, y: {1: x},
        lambda x, y: {"": x},
    ],
)
def test_a_count_duration_or_name_that_is_none_is_refused(body):
    with pytest.raises(DeclarationError) as caught:
        build(body)
    assert all((caught.value.path, caught.value.expected, caught.value.got, caught.value.fix))


def test_the_longest_tolerance_still_tells_empty_slots_from_values():
    def body(x, y):
        return match(x, y, tolerance=2**62 - 1, size=3)

    assert both(run(body, scalars([0, 10], [1.0, 2.0]), scalars([15], [3.0]))) == [(15, 2.0, 3.0)]


@pytest.mark.parametrize("rate", ["x", float("nan"), float("inf"), True, 0, -1.0])
def test_a_highest_rate_is_a_positive_number(rate):
    with pytest.raises(DeclarationError, match="a highest rate must be positive"):
        aperiodic(max_rate=rate)


CAPTURES = {
    "value + stream": lambda x, y: x.map(lambda v: v + y),
    "stream + value": lambda x, y: x.map(lambda v: y + v),
    "comparison": lambda x, y: x.filter(lambda v: y > v),
    "in a function of xp": lambda x, y: x.map(lambda v, *, xp: xp.maximum(v, y)),
    "returned": lambda x, y: x.map(lambda v: y),
}


@pytest.mark.parametrize("body", CAPTURES.values(), ids=CAPTURES)
@pytest.mark.parametrize("held", [False, True])
def test_a_captured_stream_is_to_be_passed_as_a_port(body, held):
    with pytest.raises(DeclarationError, match=r"a step sees only what comes through its ports") as caught:
        build(lambda x, y: body(x, latest(y, init=0.0, name="y_held") if held else y))
    assert "pass it as a port: apply(f, a, b)" in str(caught.value)
    assert "y" in str(caught.value.path)
