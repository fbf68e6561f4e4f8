"""Clocks: the set of ticks at which a stream can be present, as an expression over sources.

A clock is a Boolean expression whose atoms are sources (`Source`), counted parts of another clock
(`Counted`: every fifth tick of it) and conditions only known at run time (`Condition`: what a filter let
through). Whether two clocks are equal, one within the other, or never together is decided exactly, by
going through all assignments of their atoms that the declarations allow: an atom derived from a clock
implies it, and two strictly periodic sources coincide only where their periods and phases let them.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

from flowgraph.errors import ClockError, DeclarationError

_UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


def nanoseconds(duration: str | int, *, what: str = "duration", least: int | None = None) -> int:
    """Nanoseconds from "5ms", "1.25us", "2s" or an integer count of nanoseconds.

    Raises:
        DeclarationError: where the text is not a number and one of ns, us, ms, s, or is beyond 64 bits; or
            for less than `least` ns.
    """
    if isinstance(duration, int) and not isinstance(duration, bool):
        return _in_range(duration, duration, what, least)
    match = re.fullmatch(r"\s*([0-9]+\.?[0-9]*|\.[0-9]+)\s*(ns|us|ms|s)\s*", str(duration))
    if match is None or isinstance(duration, float):
        raise DeclarationError(
            f"{what} is not understood",
            path=what,
            expected='a text such as "5ms", "20us", "0.25s", or integer nanoseconds',
            got=repr(duration),
            fix=f'write {what}="5ms"',
        )
    number = float(match[1]) * _UNITS[match[2]]
    return _in_range(round(number) if number < 2.0**64 else 2**64, duration, what, least)


def _in_range(number: int, given: object, what: str, least: int | None) -> int:
    if least is not None and number < least:
        raise DeclarationError(
            f"{what} is too short",
            path=what,
            expected=f"{least} ns or more",
            got=repr(given),
            fix=f'write {what}="5ms"',
        )
    if not -(2**63) <= number < 2**63:
        raise DeclarationError(
            f"{what} is too long",
            path=what,
            expected="what int64 nanoseconds hold: below 9.2e9 s",
            got=repr(given),
            fix=f'write {what}="5ms"',
        )
    return number


@dataclass(frozen=True)
class Timing:
    """When a source can have events. Made by `periodic` and `aperiodic`.

    Args:
        period: nanoseconds between events; None for an aperiodic source.
        phase: time of the events modulo the period, in ns; None: whatever the first event shows.
        jitter: how far the step between two stamps may be from the period, in ns; 0 for exact.
        max_rate: highest rate of an aperiodic source in Hz (for its closest two events), or None.
    """

    period: int | None = None
    phase: int | None = None
    jitter: int = 0
    max_rate: float | None = None

    def __str__(self) -> str:
        if self.period is None:
            return "aperiodic" + (f", at most {self.max_rate:g} Hz" if self.max_rate else "")
        return f"{1e9 / self.period:g} Hz"


def periodic(period: str | int, *, phase: str | int | None = None, jitter: str | int = 0) -> Timing:
    """A source with one event each `period` ("5ms"); data that do not keep to it are refused at run time.

    With `phase` given and no `jitter`, coincidences with other such sources are known at build.
    """
    length = nanoseconds(period, what="period")
    if length <= 0:
        raise DeclarationError(
            "a period must be positive", expected="more than 0 ns", got=length, fix='write periodic("5ms")'
        )
    spread = nanoseconds(jitter, what="jitter")
    if spread < 0:
        raise DeclarationError(
            "a jitter cannot be negative", expected="0 ns or more", got=spread, fix='write jitter="100us"'
        )
    return Timing(
        period=length,
        phase=None if phase is None else nanoseconds(phase, what="phase") % length,
        jitter=spread,
    )


def aperiodic(*, max_rate: float | None = None) -> Timing:
    """A source whose events come when they come, at most `max_rate` times a second if given."""
    number = isinstance(max_rate, int | float) and not isinstance(max_rate, bool)
    if max_rate is not None and (not number or not 0 < max_rate < math.inf):
        raise DeclarationError(
            "a highest rate must be positive",
            expected="more than 0 Hz",
            got=repr(max_rate),
            fix="leave it out",
        )
    return Timing(max_rate=max_rate)


class Clock:
    """A Boolean expression over sources. Combine with `|` and `&`."""

    def __or__(self, other: object) -> Clock:
        return either(self, clock_of(other))

    def __and__(self, other: object) -> Clock:
        return both(self, clock_of(other))


@dataclass(frozen=True)
class Source(Clock):
    """The ticks in which a source has an event."""

    name: str
    timing: Timing = Timing()

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class Counted(Clock):
    """Ticks of `parent` whose running number, modulo `period`, is in `offsets`."""

    parent: Clock
    period: int
    offsets: tuple[int, ...]

    def __str__(self) -> str:
        if len(self.offsets) == 1:
            phase = "" if self.offsets == (0,) else f", phase={self.offsets[0]}"
            return f"every({self.period}, {self.parent}{phase})"
        return f"{len(self.offsets)} of {self.period} {self.parent}"


@dataclass(frozen=True)
class Condition(Clock):
    """Ticks of `parent` at which the output called `name` turns out to be present.

    `owner` is the path of its block, which keeps apart what is only spelled alike.
    """

    name: str
    parent: Clock
    owner: str = ""

    def __str__(self) -> str:
        return self.name


@dataclass(frozen=True)
class AnyOf(Clock):
    """Ticks of at least one of `terms`."""

    terms: tuple[Clock, ...]

    def __str__(self) -> str:
        return " | ".join(map(str, self.terms)) if self.terms else "never"


@dataclass(frozen=True)
class AllOf(Clock):
    """Ticks of all `terms`."""

    terms: tuple[Clock, ...]

    def __str__(self) -> str:
        return " & ".join(f"({t})" if isinstance(t, AnyOf) else str(t) for t in self.terms)


@dataclass(frozen=True)
class Not(Clock):
    """Ticks at which `term` is absent."""

    term: Clock

    def __str__(self) -> str:
        return f"not ({self.term})" if isinstance(self.term, AnyOf | AllOf) else f"not {self.term}"


NEVER = AnyOf(())


def either(*clocks: Clock) -> Clock:
    """The union, flattened and without repeats."""
    terms = _flat(AnyOf, clocks)
    return terms[0] if len(terms) == 1 else AnyOf(terms)


def both(*clocks: Clock) -> Clock:
    """The intersection, flattened and without repeats."""
    terms = _flat(AllOf, clocks)
    if NEVER in terms:
        return NEVER
    return terms[0] if len(terms) == 1 else AllOf(terms)


def _flat(kind: type[AnyOf] | type[AllOf], clocks: tuple[Clock, ...]) -> tuple[Clock, ...]:
    inner = itertools.chain.from_iterable(c.terms if isinstance(c, kind) else (c,) for c in clocks)
    return tuple(dict.fromkeys(inner))


def every(n: int, parent: Clock, *, phase: int = 0) -> Clock:
    """Each n-th tick of `parent`, starting with its tick number `phase`."""
    if n == 1:
        return parent
    if isinstance(parent, Counted):  # count within the parent's own count: one pattern over the grandparent
        size = len(parent.offsets)
        rounds = [divmod(phase % n + k * n, size) for k in range(size)]
        hits = [turn * parent.period + parent.offsets[place] for turn, place in rounds]
        return counted(parent.parent, parent.period * n, hits)
    return counted(parent, n, [phase % n])


def counted(parent: Clock, period: int, offsets: list[int]) -> Clock:
    """The clock with the shortest equal pattern: `offsets` of each `period` ticks of `parent`."""
    hits = set(offsets)
    for factor in _prime_factors(math.gcd(period, len(hits))):  # a pattern in so many equal parts
        part = period // factor
        if all((i + part) % period in hits for i in hits):
            period, hits = part, {i for i in hits if i < part}
    return parent if len(hits) == period else Counted(parent, period, tuple(sorted(hits)))


def _prime_factors(n: int) -> Iterator[int]:
    """As often as they are in it."""
    factor = 2
    while factor * factor <= n:
        while n % factor == 0:
            yield factor
            n //= factor
        factor += 1
    if n > 1:
        yield n


def root_of(clock: Clock) -> Clock:
    """What a clock counts ticks of, in the end; itself, if it does not count."""
    return root_of(clock.parent) if isinstance(clock, Counted) else clock


def share_of_root(clock: Clock) -> Fraction:
    """How many of the ticks of its root a clock has."""
    if not isinstance(clock, Counted):
        return Fraction(1)
    return Fraction(len(clock.offsets), clock.period) * share_of_root(clock.parent)


def clock_of(thing: object) -> Clock:
    """The clock of a stream, or the clock itself."""
    found = thing if isinstance(thing, Clock) else getattr(thing, "clock", None)
    if not isinstance(found, Clock):
        raise DeclarationError(
            "this has no clock",
            expected="a stream, or clocks combined with | and &",
            got=f"{thing!r}",
            fix="name the stream whose ticks you mean; a held value (latest, delay) has no ticks of its own",
        )
    return found


def _children(clock: Clock) -> tuple[Clock, ...]:
    if isinstance(clock, AnyOf | AllOf):
        return clock.terms
    if isinstance(clock, Not):
        return (clock.term,)
    if isinstance(clock, Counted | Condition):
        return (clock.parent,)
    return ()


def atoms(*clocks: Clock) -> list[Clock]:
    """All atoms that the clocks are made of, parents before what is derived from them."""
    found: dict[Clock, None] = {}

    def visit(clock: Clock) -> None:
        for child in _children(clock):
            visit(child)
        if isinstance(clock, Source | Counted | Condition):
            found.setdefault(clock)

    for clock in clocks:
        visit(clock)
    return list(found)


def evaluate(clock: Clock, present: dict[Clock, bool]) -> bool:
    """Whether `clock` has the tick in which exactly the atoms marked True are present."""
    if isinstance(clock, AnyOf):
        return any(evaluate(t, present) for t in clock.terms)
    if isinstance(clock, AllOf):
        return all(evaluate(t, present) for t in clock.terms)
    if isinstance(clock, Not):
        return not evaluate(clock.term, present)
    return present[clock]


_MOST_ATOMS = 14


def _possible(names: list[Clock]) -> Iterator[dict[Clock, bool]]:
    """All assignments of the atoms that the declarations allow, one atom after the other."""
    if len(names) > _MOST_ATOMS:
        raise ClockError(
            "these clocks depend on too many streams to compare them",
            expected=f"at most {_MOST_ATOMS}",
            got=", ".join(map(str, names)),
            fix="name a clock with at=, or sample some inputs with latest(...)",
        )

    def extend(chosen: dict[Clock, bool], rest: list[Clock]) -> Iterator[dict[Clock, bool]]:
        if not rest:
            yield chosen
            return
        atom = rest[0]
        for value in (True, False):
            trial = {**chosen, atom: value}
            if _allowed(atom, value, trial):
                yield from extend(trial, rest[1:])

    yield from extend({}, names)


def _allowed(atom: Clock, value: bool, chosen: dict[Clock, bool]) -> bool:
    if isinstance(atom, Counted | Condition) and value and not evaluate(atom.parent, chosen):
        return False
    if isinstance(atom, Counted) and evaluate(atom.parent, chosen):
        siblings = [a for a in chosen if isinstance(a, Counted) and a.parent == atom.parent]
        inside = [(a.period, a.offsets) for a in siblings if chosen[a]]
        outside = [(a.period, frozenset(a.offsets)) for a in siblings if not chosen[a]]
        return any(_some_outside(*place, outside) for place in _places(0, 1, inside))
    if isinstance(atom, Source):
        return all(
            _coincide(atom.timing, value, other.timing, present)
            for other, present in chosen.items()
            if isinstance(other, Source) and other != atom
        )
    return True


_Pattern = tuple[int, tuple[int, ...]]


def _places(rest: int, span: int, patterns: Sequence[_Pattern]) -> Iterator[tuple[int, int]]:
    """The numbers that are `rest` modulo `span` and in all patterns, as (rest, span)."""
    if not patterns:
        yield rest, span
        return
    (period, offsets), *more = patterns
    common = math.gcd(span, period)
    for offset in offsets:
        if (offset - rest) % common == 0:
            steps = (offset - rest) // common * pow(span // common, -1, period // common)
            yield from _places(rest + span * (steps % (period // common)), math.lcm(span, period), more)


def _some_outside(rest: int, span: int, patterns: Sequence[tuple[int, frozenset[int]]]) -> bool:
    """Whether some number that is `rest` modulo `span` is in none of the patterns."""
    left = []
    covered = Fraction(0)
    for period, offsets in patterns:
        common = math.gcd(span, period)
        share = Fraction(sum((o - rest) % common == 0 for o in offsets) * common, period)
        if share == 1:
            return False
        if share:
            left.append((period, offsets))
            covered += share
    if covered < 1:
        return True
    (period, offsets), *more = sorted(left, key=lambda pattern: pattern[0])
    step = math.lcm(span, period)
    return any(
        _some_outside(number, step, more)
        for number in range(rest, rest + step, span)
        if number % period not in offsets
    )


def _coincide(a: Timing, a_present: bool, b: Timing, b_present: bool) -> bool:
    """Whether two sources can be present (or not) like this in one tick."""
    exact = all(t.period is not None and t.phase is not None and not t.jitter for t in (a, b))
    if not exact or not (a_present or b_present):
        return True
    assert a.period  # as `exact` says
    assert b.period
    assert a.phase is not None
    assert b.phase is not None
    meet = (a.phase - b.phase) % math.gcd(a.period, b.period) == 0
    if a_present and b_present:
        return meet
    # streams may begin and end at different times, so a tick of one alone is always possible
    return True


@lru_cache(maxsize=4096)
def within(inner: Clock, outer: Clock) -> bool:
    """Whether every tick of `inner` is provably a tick of `outer`."""
    if inner == outer:
        return True
    return all(evaluate(outer, p) for p in _possible(atoms(inner, outer)) if evaluate(inner, p))


def equal(a: Clock, b: Clock) -> bool:
    """Whether the two clocks provably have the same ticks."""
    return within(a, b) and within(b, a)


@lru_cache(maxsize=4096)
def disjoint(a: Clock, b: Clock) -> bool:
    """Whether the two clocks provably never have a tick together."""
    return not any(evaluate(a, p) and evaluate(b, p) for p in _possible(atoms(a, b)))


def simplify(clock: Clock, names: list[Clock]) -> Clock:
    """A shorter equal clock, if one of `names`, an atom or nothing at all is equal to it."""
    for candidate in (NEVER, *names, *atoms(clock)):
        if equal(clock, candidate):
            return candidate
    return clock
