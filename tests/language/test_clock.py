"""The algebra of clocks, against brute force over what sources can do."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flowgraph import ClockError, DeclarationError, aperiodic, periodic
from flowgraph.language import clock as c
from flowgraph.language.clock import AllOf, AnyOf, Clock, Condition, Counted, Not, Source, Timing

A, B, C = (Source(name) for name in "abc")
SOURCES = (A, B, C)
LENGTH = 6


def ticks_of(clock: Clock, tape: Sequence[frozenset[Source]], passed: dict[Clock, list[bool]]) -> list[bool]:
    """Which of the ticks on a tape belong to a clock: the meaning of each constructor, spelled out."""
    if isinstance(clock, Source):
        return [clock in tick for tick in tape]
    if isinstance(clock, AnyOf):
        return [any(x) for x in zip(*(ticks_of(t, tape, passed) for t in clock.terms), strict=True)] or [
            False for _ in tape
        ]
    if isinstance(clock, AllOf):
        return [all(x) for x in zip(*(ticks_of(t, tape, passed) for t in clock.terms), strict=True)]
    if isinstance(clock, Not):
        return [not x for x in ticks_of(clock.term, tape, passed)]
    if isinstance(clock, Counted):
        number, found = -1, []
        for here in ticks_of(clock.parent, tape, passed):
            number += here
            found.append(here and number % clock.period in clock.offsets)
        return found
    assert isinstance(clock, Condition)
    let = passed[clock]
    return [x and y for x, y in zip(ticks_of(clock.parent, tape, passed), let, strict=True)]


def clocks() -> st.SearchStrategy[Clock]:
    return st.recursive(
        st.sampled_from(SOURCES),
        lambda inner: st.one_of(
            st.builds(c.either, inner, inner),
            st.builds(c.both, inner, inner),
            st.builds(
                lambda n, k, p: c.every(n, p, phase=k % n), st.integers(2, 3), st.integers(0, 2), inner
            ),
            st.builds(lambda p: Condition("filter", p), inner),
        ),
        max_leaves=4,
    )


TAPES = st.lists(st.sets(st.sampled_from(SOURCES), min_size=1).map(frozenset), min_size=1, max_size=LENGTH)


def passes(found: tuple[Clock, ...], bits: int) -> dict[Clock, list[bool]]:
    conditions = [a for a in c.atoms(*found) if isinstance(a, Condition)]
    return {a: [bool(bits >> (k * LENGTH + i) & 1) for i in range(LENGTH)] for k, a in enumerate(conditions)}


@settings(deadline=None, max_examples=150)
@given(clocks(), clocks(), TAPES, st.integers(0, 2**24 - 1))
def test_what_is_proven_holds_on_every_tape(x, y, tape, bits):
    let = {k: v[: len(tape)] for k, v in passes((x, y), bits).items()}
    in_x, in_y = ticks_of(x, tape, let), ticks_of(y, tape, let)
    pairs = list(zip(in_x, in_y, strict=True))
    if c.within(x, y):
        assert all(b for a, b in pairs if a)
    if c.equal(x, y):
        assert in_x == in_y
    if c.disjoint(x, y):
        assert not any(a and b for a, b in pairs)
    union, common = c.either(x, y), c.both(x, y)
    assert ticks_of(union, tape, let) == [a or b for a, b in pairs]
    assert ticks_of(common, tape, let) == [a and b for a, b in pairs]
    assert c.equal(c.simplify(union, [x, y]), union)


def boolean() -> st.SearchStrategy[Clock]:
    return st.recursive(
        st.sampled_from(SOURCES),
        lambda inner: st.one_of(st.builds(c.either, inner, inner), st.builds(c.both, inner, inner)),
        max_leaves=6,
    )


@settings(deadline=None)
@given(boolean(), boolean())
def test_for_aperiodic_sources_the_answers_are_exact(x, y):
    every_tick = [frozenset(s) for n in range(4) for s in itertools.combinations(SOURCES, n)]
    pairs = list(zip(ticks_of(x, every_tick, {}), ticks_of(y, every_tick, {}), strict=True))
    assert c.within(x, y) == all(b for a, b in pairs if a)
    assert c.equal(x, y) == all(a == b for a, b in pairs)
    assert c.disjoint(x, y) == (not any(a and b for a, b in pairs))


@settings(deadline=None)
@given(clocks(), clocks(), clocks())
def test_laws(x, y, z):
    assert c.equal(x | y, y | x)
    assert c.equal(x & y, y & x)
    assert c.equal((x | y) | z, x | (y | z))
    assert c.equal(x & (x | y), x)
    assert c.within(x & y, x)
    assert c.within(x, x | y)
    assert c.disjoint(x, Not(x))
    assert c.equal(c.both(x, c.NEVER), c.NEVER)
    assert c.equal(c.either(x, c.NEVER), x)


@given(st.integers(1, 6), st.integers(0, 5), st.integers(1, 6), st.integers(0, 5))
def test_counted_clocks_meet_where_their_numbers_do(n, i, m, j):
    i, j = i % n, j % m
    x, y = c.every(n, A, phase=i), c.every(m, A, phase=j)
    span = math.lcm(n, m)
    in_x = {k for k in range(span) if k % n == i}
    in_y = {k for k in range(span) if k % m == j}
    assert c.disjoint(x, y) == (not in_x & in_y)
    assert c.within(x, y) == (in_x <= in_y)
    assert c.equal(x, y) == (in_x == in_y)
    assert c.within(x, A)


@given(st.integers(1, 4), st.integers(0, 3), st.integers(1, 4), st.integers(0, 3))
def test_every_of_every_counts_the_survivors(n, i, m, j):
    i, j = i % n, j % m
    nested = c.every(m, c.every(n, A, phase=i), phase=j)
    tape = [frozenset([A])] * (2 * n * m)
    survivors = [k for k in range(2 * n * m) if k % n == i]
    assert [k for k, here in enumerate(ticks_of(nested, tape, {})) if here] == survivors[j::m]


def test_counted_takes_the_shortest_pattern():
    assert c.counted(A, 4, [0, 2]) == Counted(A, 2, (0,))
    assert c.counted(A, 3, [0, 1, 2]) == A
    assert c.counted(A, 4, [0, 1]) == Counted(A, 4, (0, 1))


@settings(deadline=None)
@given(st.integers(1, 12), st.integers(0, 11), st.integers(1, 12), st.integers(0, 11))
def test_periodic_sources_meet_where_their_stamps_do(p, i, q, j):
    x = Source("x", periodic(p, phase=i))
    y = Source("y", periodic(q, phase=j))
    stamps = lambda period, phase: {t for t in range(period * 4 * 12) if t % period == phase % period}
    meet = bool(stamps(p, i) & {t for t in range(q * 4 * 12) if t % q == j % q} & set(range(4 * 12)))
    if math.lcm(p, q) <= 4 * 12:
        assert c.disjoint(x, y) == (not meet)


@pytest.mark.parametrize(
    "other",
    [periodic("10ms"), periodic("10ms", phase="5ms", jitter="1ms"), aperiodic(max_rate=100), Timing()],
)
def test_without_an_exact_phase_nothing_is_known(other):
    assert not c.disjoint(Source("x", periodic("10ms", phase=0)), Source("y", other))


def test_streams_may_start_and_end_at_different_times():
    x, y = Source("x", periodic("5ms", phase=0)), Source("y", periodic("5ms", phase=0))
    assert not c.equal(x, y)
    assert not c.within(x, y)


def test_conditions_are_within_their_parent_and_not_equal_to_each_other():
    one, two = Condition("f", A), Condition("g", A)
    assert c.within(one, A)
    assert not c.within(A, one)
    assert not c.equal(one, two)
    assert not c.disjoint(one, two)
    assert c.disjoint(Condition("f", A & B), A & Not(B))


def test_simplify_finds_a_shorter_name():
    assert c.simplify(c.either(c.both(A, B), c.both(A, Not(B))), [A, B]) == A
    assert c.simplify(c.both(A, Not(A)), [A]) == c.NEVER


def test_clocks_read_as_they_are_written():
    assert str((A | B) & C) == "(a | b) & c"
    assert str(c.every(5, A)) == "every(5, a)"
    assert str(c.every(5, A, phase=2)) == "every(5, a, phase=2)"
    assert str(Not(A | B)) == "not (a | b)"
    assert str(c.NEVER) == "never"


def test_too_many_streams_are_refused_with_a_way_out():
    many = [Source(f"s{k}") for k in range(15)]
    with pytest.raises(ClockError, match="too many streams") as error:
        c.within(c.both(*many), c.either(*many, A))
    assert "latest" in str(error.value.fix)


@pytest.mark.parametrize(
    ("text", "ns"),
    [("5ms", 5_000_000), ("1.25us", 1250), ("2s", 2_000_000_000), (" 7 ns ", 7), (12, 12), (".5us", 500)],
)
def test_durations(text, ns):
    assert c.nanoseconds(text) == ns


@pytest.mark.parametrize("bad", ["5", "ms", "1.2.3ms", "-5ms", "5 hours", 0.005, True, None, "."])
def test_durations_that_are_not_understood(bad):
    with pytest.raises(DeclarationError, match="period is not understood") as error:
        periodic(bad)
    assert error.value.got == repr(bad)
    assert "5ms" in str(error.value.fix)


@pytest.mark.parametrize(
    ("made", "words"),
    [
        (lambda: periodic(0), "a period must be positive"),
        (lambda: periodic("5ms", jitter=-1), "a jitter cannot be negative"),
        (lambda: aperiodic(max_rate=0.0), "a highest rate must be positive"),
        (lambda: aperiodic(max_rate=-5.0), "a highest rate must be positive"),
    ],
)
def test_impossible_timings_are_refused(made, words):
    with pytest.raises(DeclarationError, match=words):
        made()


def test_a_phase_is_taken_modulo_the_period():
    assert periodic("5ms", phase="12ms").phase == 2_000_000


def test_what_has_no_clock_is_refused():
    with pytest.raises(DeclarationError, match="this has no clock"):
        A | 3
