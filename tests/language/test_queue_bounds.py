"""How many values may wait in the queues of joins, and when one more is one too many."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest

from flowgraph import FifoOverflowError, Graph, Scalar, Stream, graph, match, simulate, window
from flowgraph.errors import ClockError
from flowgraph.language import clock as c
from flowgraph.language.clock import Clock, Counted, Source
from flowgraph.language.pairs import _zip, _zip_plan
from flowgraph.types import ArrayType
from tests.support import pairs, scalars

A = Source("a")
QUICK = ("python", "reference", "c")


def overflow_time(built: Graph, data: Any, engine: str) -> int | None:
    try:
        simulate(built, data, engine=engine)
    except FifoOverflowError as error:
        return error.time
    return None


def matching(size: int) -> Graph:
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return match(x, y, tolerance=3, size=size, name="m").map(lambda p: 100 * p[0] + p[1])

    return g.build()


@pytest.mark.parametrize("engine", QUICK)
@pytest.mark.parametrize("size", [1, 2, 3])
@pytest.mark.parametrize("full", ["x", "y"])
def test_as_many_as_the_size_may_wait_in_either_queue_of_a_match(full: str, size: int, engine: str):
    built, other = matching(size), "y" if full == "x" else "x"
    stamps = [10 * k for k in range(size)]
    assert overflow_time(built, {full: scalars(stamps), other: scalars([])}, engine) is None
    more = [*stamps, 10 * size, 10 * size + 1, 10 * size + 2]
    assert overflow_time(built, {full: scalars(more), other: scalars([])}, engine) == 10 * size


@pytest.mark.parametrize("engine", QUICK)
@pytest.mark.parametrize("full", ["x", "y"])
def test_a_value_that_leaves_in_its_own_tick_does_not_wait(full: str, engine: str):
    other = "y" if full == "x" else "x"
    data = {full: scalars([0, 10, 20]), other: scalars([20])}
    result = simulate(matching(2), data, engine=engine)
    assert pairs(result.output) == [(20, 301.0 if full == "x" else 103.0)]
    assert result.stats == {f"m.expired_{'a' if full == 'x' else 'b'}": 2} | {
        f"m.expired_{'b' if full == 'x' else 'a'}": 0
    }


@pytest.mark.parametrize("engine", QUICK)
@pytest.mark.parametrize("full", ["x", "y"])
def test_a_full_queue_has_room_again_when_old_values_expire_or_are_taken(full: str, engine: str):
    other = "y" if full == "x" else "x"
    expired = {full: scalars([0, 10, 30, 40]), other: scalars([20])}
    assert overflow_time(matching(2), expired, engine) is None
    assert overflow_time(matching(2), {**expired, full: scalars([0, 10, 30, 40, 50])}, engine) == 50
    taken = {full: scalars([0, 10, 30]), other: scalars([11])}
    assert overflow_time(matching(2), taken, engine) is None
    result = simulate(matching(2), taken, engine=engine)
    assert pairs(result.output) == [(11, 201.0 if full == "x" else 102.0)]


@pytest.mark.parametrize("engine", QUICK)
@pytest.mark.parametrize("size", [1, 2, 4])
def test_as_many_as_the_size_are_in_a_window(size: int, engine: str):
    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        return window(x, at=y, size=size).map(lambda w, *, xp: xp.sum(w.values))

    built = g.build()
    stamps = list(range(size))
    at_the_tick = {"x": scalars(stamps), "y": scalars([size - 1])}
    assert pairs(simulate(built, at_the_tick, engine=engine).output) == [
        (size - 1, float(sum(range(1, size + 1))))
    ]
    over = {"x": scalars(range(size + 3)), "y": scalars([size + 5])}
    assert overflow_time(built, over, engine) == size
    closing = {"x": scalars(range(size + 1)), "y": scalars([size])}
    assert overflow_time(built, closing, engine) == size


@pytest.mark.parametrize("engine", QUICK)
@pytest.mark.parametrize("first", [0, 1])
def test_a_zip_whose_bound_was_too_small_would_say_so(first: int, engine: str):
    """Two values of one side come before two of the other; a bound of one is exceeded at the second."""

    @graph
    def g(x: Stream[Scalar], y: Stream[Scalar]):
        kind = ArrayType()
        return _zip(x, y, size=1, types=(kind, kind), clock=c.either(x.clock, y.clock), name="z").map(
            lambda p: 100 * p[0] + p[1]
        )

    sides = [scalars([0, 1, 2]), scalars([5, 6])]
    data = {"x": sides[first], "y": sides[1 - first]}
    assert overflow_time(g.build(), data, engine) == 1
    calm = {"x": scalars([0, 2, 4]), "y": scalars([1, 3, 4])}
    found = dict(pairs(simulate(g.build(), calm, engine=engine).output))
    assert [found[t] for t in (1, 3, 4)] == [101.0, 202.0, 303.0]


def ticks_of(clock: Clock, ticks: int) -> list[int]:
    """By the definition: number the ticks of the parent, and keep some."""
    if not isinstance(clock, Counted):
        return list(range(ticks))
    inner = ticks_of(clock.parent, ticks)
    return [t for k, t in enumerate(inner) if k % clock.period in clock.offsets]


PATTERNS = [
    Counted(A, 2, (0,)),
    Counted(A, 2, (1,)),
    Counted(A, 3, (2,)),
    Counted(A, 4, (0, 1)),
    Counted(A, 6, (4, 5)),
    Counted(A, 6, (0, 1, 3)),
    Counted(Counted(A, 2, (1,)), 3, (0,)),
    Counted(Counted(A, 3, (0, 2)), 2, (1,)),
    Counted(Counted(A, 3, (0, 1)), 4, (0, 1, 2)),
    A,
]


@pytest.mark.parametrize(("a", "b"), list(itertools.product(PATTERNS, PATTERNS)))
def test_the_plan_of_a_zip_against_counting(a: Clock, b: Clock):
    span = 4 * 144
    left, right = ticks_of(a, span), ticks_of(b, span)
    if len(left) != len(right):
        with pytest.raises(ClockError, match="the rates are unequal"):
            _zip_plan(a, b, "z")
        return
    depth, clock = _zip_plan(a, b, "z")
    ahead = [sum(t <= tick for t in left) - sum(t <= tick for t in right) for tick in range(span)]
    assert depth == max(1, *map(abs, ahead))
    at = [max(x, y) for x, y in zip(left, right, strict=True)]
    assert ticks_of(clock, span) == at


def test_unequal_rates_are_told_in_numbers():
    with pytest.raises(ClockError) as error:
        _zip_plan(Counted(A, 2, (0,)), Counted(A, 3, (1, 2)), "z")
    assert error.value.got == "every(2, a): 6 of 12, 2 of 3 a: 8 of 12 ticks of a"


# -- large counts ------------------------------------------------------------------------------------------


def test_large_and_coprime_counts_are_compared_at_once():
    huge = c.every(2**30, c.every(4, A), phase=3)
    assert huge == Counted(A, 2**32, (12,))
    assert c.every(2**20, Counted(A, 3, (0, 2)), phase=1) == Counted(A, 3 * 2**19, (2,))
    primes = [c.every(p, A) for p in (1009, 1013, 1019, 1021, 1031)]
    assert c.within(c.both(*primes), primes[4])
    assert not c.disjoint(c.both(*primes[:3]), c.both(*primes[3:]))
    assert not c.equal(c.either(*primes), A)
    assert _zip_plan(c.every(2**40, A), c.every(2**40, A, phase=7), "z")[0] == 1
    with pytest.raises(ClockError, match="the rates are unequal"):
        _zip_plan(c.every(2**31 - 1, A), c.every(2**31 - 3, A), "z")


@pytest.mark.parametrize(
    ("parts", "all_"),
    [
        ([(2, 0), (2, 1)], True),
        ([(2, 0), (3, 0), (4, 1), (6, 5), (12, 7)], True),
        ([(2, 0), (3, 0), (4, 1), (6, 5)], False),
        ([(3, 0), (3, 1)], False),
        ([(2, 0), (4, 1), (4, 3)], True),
    ],
)
def test_parts_that_cover_a_clock_are_known_to(parts: list[tuple[int, int]], all_: bool):
    found = c.either(*(c.every(n, A, phase=k) for n, k in parts))
    span = math.lcm(*(n for n, _ in parts))
    assert all_ == all(any(i % n == k for n, k in parts) for i in range(span))
    assert c.equal(found, A) is all_


@pytest.mark.parametrize(
    ("n", "i", "m", "j", "p", "k"), [(4, 1, 6, 3, 10, 9), (4, 1, 6, 2, 10, 9), (4, 3, 6, 1, 9, 7)]
)
def test_three_counts_meet_where_their_numbers_do(n: int, i: int, m: int, j: int, p: int, k: int):
    all_ = [c.every(n, A, phase=i), c.every(m, A, phase=j), c.every(p, A, phase=k)]
    meet = any(t % n == i and t % m == j and t % p == k for t in range(math.lcm(n, m, p)))
    assert c.disjoint(c.both(all_[0], all_[1]), all_[2]) is not meet
