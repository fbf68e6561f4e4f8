"""What is done with a stretch of ticks: steps that give values, one after the other.

A value is kept for the ticks that need it, in their order; `Stretch` brings it to the ticks of who takes it.
"""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flowgraph.engines.numpy.guards import Bounds, Patterns
from flowgraph.engines.numpy.rules import at_one_tick, bound
from flowgraph.pipeline.pipeline import RandomSite
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.random import numbers_at
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

LARGE = 4096
"""Numbers of a value that is worth being let go."""


class Stretch:
    """Ticks that follow one another, and the values in them.

    Args:
        times: int64 ns; `which` of the patterns each tick has.
        every: the set of all patterns.
        cells: by the number of its value, what each register cell holds before the first tick.
        fixed: values that are the same in all ticks, with a last axis of 1.
        seed: (2,) uint32.
    """

    def __init__(
        self,
        times: np.ndarray,
        which: np.ndarray,
        every: Patterns,
        cells: Mapping[int, Any],
        fixed: Mapping[int, Any],
        seed: np.ndarray,
    ) -> None:
        self.times, self.which, self.every = times, which, every
        self.cells, self.fixed, self.seed = cells, fixed, seed
        self.values: dict[int, tuple[Patterns, Any]] = {}
        self._masks: dict[Patterns, np.ndarray] = {}
        self._rows: dict[Patterns, np.ndarray] = {}
        self._places: dict[tuple[Patterns, Patterns], np.ndarray] = {}

    def mask(self, where: Patterns) -> np.ndarray:
        """Whether each tick has one of these patterns."""
        if where not in self._masks:
            table = np.array([where >> p & 1 for p in range(self.every.bit_length())], bool)
            self._masks[where] = table[self.which]
        return self._masks[where]

    def rows(self, where: Patterns) -> np.ndarray:
        """The places of these ticks."""
        if where not in self._rows:
            self._rows[where] = np.flatnonzero(self.mask(where))
        return self._rows[where]

    def places(self, some: Patterns, among: Patterns) -> np.ndarray:
        """Where, among the ticks of one set, those of another are that lies in it."""
        if (some, among) not in self._places:
            self._places[some, among] = np.flatnonzero(self.mask(some)[self.rows(among)])
        return self._places[some, among]

    def at(self, n: int, where: Patterns) -> Any:
        """A value at the ticks of a set, zero where it was not needed; a last axis of 1: the same in all."""
        if n in self.fixed:
            return self.fixed[n]
        if n not in self.values:  # a condition beside one that never holds
            return np.zeros(1, bool)
        had, value = self.values[n]
        if had == where:
            return value
        if not where & ~had:
            return value.take(self.places(where, had), axis=-1)
        spread = np.zeros((*value.shape[:-1], len(self.rows(where))), value.dtype)
        both = had & where
        spread[..., self.places(both, where)] = value[..., self.places(both, had)]
        return spread

    def full(self, n: int, where: Patterns) -> Any:
        """A value with a column for each of these ticks."""
        found = self.at(n, where)
        return np.broadcast_to(found, (*found.shape[:-1], len(self.rows(where))))


class Step(abc.ABC):
    """Something that gives values, from values that are there."""

    @property
    @abc.abstractmethod
    def makes(self) -> tuple[int, ...]:
        """The values that it gives."""

    @property
    @abc.abstractmethod
    def takes(self) -> tuple[int, ...]:
        """The values that must be there."""

    @abc.abstractmethod
    def play(self, ticks: Stretch) -> None:
        """Put the values into the stretch."""


@dataclass(eq=False)
class Instructed(Step):
    """What makes the value of one instruction, at the ticks that need it."""

    instruction: Instruction
    where: Patterns
    real: Any

    @property
    def makes(self) -> tuple[int, ...]:
        return (self.instruction.out,)

    @property
    def takes(self) -> tuple[int, ...]:
        return self.instruction.args


@dataclass(eq=False)
class Evaluate(Instructed):
    """An instruction at all ticks that need it, at once."""

    def __post_init__(self) -> None:
        self.run = bound(self.instruction, self.real)

    def play(self, ticks: Stretch) -> None:
        i, where = self.instruction, self.where
        n = len(ticks.rows(where))
        given = [ticks.at(a, where) for a in i.args] if n else ()
        ticks.values[i.out] = where, self.run(*given) if n else _nothing(i.spec, self.real)


@dataclass(eq=False)
class Choose(Step):
    """A selection by presence: each side is taken at its own ticks."""

    instruction: Instruction
    where: Patterns
    yes: Patterns
    real: Any

    @property
    def makes(self) -> tuple[int, ...]:
        return (self.instruction.out,)

    @property
    def takes(self) -> tuple[int, ...]:
        return self.instruction.args[1:]

    def play(self, ticks: Stretch) -> None:
        i, where = self.instruction, self.where
        sides = [
            (n, part)
            for n, part in zip(i.args[1:], (where & self.yes, where & ~self.yes), strict=True)
            if len(ticks.rows(part))
        ]
        kind = _kind(i.spec, self.real)
        found = np.empty((*i.spec.shape, len(ticks.rows(where))), kind)
        for n, part in sides:
            found[..., slice(None) if len(sides) == 1 else ticks.places(part, where)] = ticks.at(n, part)
        ticks.values[i.out] = where, found


@dataclass(eq=False)
class Draw(Step):
    """The random numbers of a site at all ticks that need them."""

    site: RandomSite
    where: Patterns
    real: Any

    @property
    def makes(self) -> tuple[int, ...]:
        return (self.site.value,)

    @property
    def takes(self) -> tuple[int, ...]:
        return ()

    def play(self, ticks: Stretch) -> None:
        s, times = self.site, ticks.times[ticks.rows(self.where)]
        made = numbers_at(s.kind, s.shape, s.hash, times, ticks.seed)
        ticks.values[s.value] = self.where, made.astype(self.real, copy=False)


@dataclass(eq=False)
class Before(Step):
    """The value of a register that does not read itself: at each tick, what was written at the one before."""

    read: int
    write: int

    @property
    def makes(self) -> tuple[int, ...]:
        return (self.read,)

    @property
    def takes(self) -> tuple[int, ...]:
        return (self.write,)

    def play(self, ticks: Stretch) -> None:
        cell = ticks.cells[self.read]
        found = np.empty((*np.shape(cell), len(ticks.times)), cell.dtype)
        found[..., :1] = cell[..., None]
        found[..., 1:] = ticks.full(self.write, ticks.every)[..., :-1]
        ticks.values[self.read] = ticks.every, found


@dataclass(eq=False)
class Scan(Step):
    """A register that at some ticks takes a value, or adds it to what it holds, and else stays.

    Args:
        read, write: of the register.
        given: what comes at these ticks.
        conditions: Booleans and what they are at these ticks.
        where: patterns in which these ticks may be.
        ufunc: what makes the new value of the old one and what comes; None: what comes takes its place.
        before: whether the values before each tick are wanted as well.
    """

    read: int
    write: int
    given: int
    conditions: tuple[tuple[int, bool], ...]
    where: Patterns
    ufunc: Any
    before: bool

    @property
    def makes(self) -> tuple[int, ...]:
        return (self.write, self.read) if self.before else (self.write,)

    @property
    def takes(self) -> tuple[int, ...]:
        return (self.given, *(n for n, _ in self.conditions))

    def play(self, ticks: Stretch) -> None:
        cell, where = ticks.cells[self.read], self.where
        taken = np.ones(len(ticks.rows(where)), bool)
        for n, wanted in self.conditions if len(taken) else ():
            taken &= ticks.at(n, where) == wanted
        count = int(taken.sum())
        held = np.empty((*cell.shape, 1 + count), cell.dtype)
        held[..., :1] = cell[..., None]
        if count:
            given = ticks.full(self.given, where)
            held[..., 1:] = given if count == len(taken) else given[..., taken]
        if self.ufunc is not None:
            held = self.ufunc.accumulate(held, axis=-1, dtype=cell.dtype)
        ever = count == len(ticks.times)
        step = np.zeros(len(ticks.times), np.intp)
        step[ticks.rows(where)] = taken
        past = np.cumsum(step)
        ticks.values[self.write] = ticks.every, held[..., 1:] if ever else held.take(past, axis=-1)
        if self.before:
            earlier = held[..., :-1] if ever else held.take(past - step, axis=-1)
            ticks.values[self.read] = ticks.every, earlier


@dataclass(eq=False)
class Loop(Step):
    """Instructions and registers that need one another: played tick by tick.

    Args:
        cells: (read, write) of the registers.
        instructions: in order, each with the patterns in which it is needed.
        outside: what they take of the values that are there, and the patterns in which it is needed.
        known: for Booleans, the patterns in which they are surely true, and may be.
        wanted: the values that others take, with their specs and patterns.
        count: of the patterns.
        real: what `real` is.
    """

    cells: tuple[tuple[int, int], ...]
    instructions: tuple[tuple[Instruction, Patterns], ...]
    outside: tuple[tuple[int, Patterns], ...]
    known: Bounds
    wanted: tuple[tuple[int, Spec, Patterns], ...]
    count: int
    real: Any

    @property
    def makes(self) -> tuple[int, ...]:
        return tuple(n for n, _, _ in self.wanted)

    @property
    def takes(self) -> tuple[int, ...]:
        return tuple(n for n, _ in self.outside)

    def __post_init__(self) -> None:
        self.lists = [self._parted(self._list(p)) for p in range(self.count)]

    def _parted(self, some: list[Any]) -> list[tuple[list[Any], list[int]]]:
        """In parts, with the large values that nothing takes after each: the next find their memory."""
        ends = {n for n, _, _ in self.wanted} | {write for _, write in self.cells}
        large = {i.out for i, _ in self.instructions if math.prod(i.spec.shape) >= LARGE} - ends
        parts: list[tuple[list[Any], list[int]]] = [([], [])]
        for run, args, out in reversed(some):
            if done := large.intersection((out, *args)):
                large -= done
                parts.append(([], sorted(done)))
            parts[-1][0].append((run, args, out))
        return [(part[::-1], done) for part, done in reversed(parts)]

    def _list(self, p: int) -> list[Any]:
        """What one tick of a pattern does."""
        found: list[Any] = []
        for i, where in self.instructions:
            if not where >> p & 1:
                continue
            choice = i.args[0] if i.op == "where" else i.out
            low, high = (b >> p & 1 for b in self.known.get(choice, (0, -1)))
            if low == high and i.op == "where":
                found.append((_Taken(i.spec, self.real), (i.args[1 if low else 2],), i.out))
            elif low == high:
                found.append((partial(np.bool_, bool(low)), (), i.out))
            else:
                found.append((at_one_tick(i, self.real), i.args, i.out))
        return found

    def play(self, ticks: Stretch) -> None:
        env = {read: ticks.cells[read] for read, _ in self.cells}
        env.update({n: ticks.fixed[n][..., 0] for n, _ in self.outside if n in ticks.fixed})
        moving = [(n, where) for n, where in self.outside if n not in ticks.fixed and where]
        feeds = [(n, where, iter(_columns(ticks.at(n, where)))) for n, where in moving]
        kept: list[tuple[int, Patterns, list[Any]]] = [(n, where, []) for n, _, where in self.wanted]
        coming = [[(n, feed) for n, where, feed in feeds if where >> p & 1] for p in range(self.count)]
        going = [[(n, rows) for n, where, rows in kept if where >> p & 1] for p in range(self.count)]
        for p in ticks.which.tolist():
            for n, feed in coming[p]:
                env[n] = next(feed)
            for part, done in self.lists[p]:
                for run, args, out in part:
                    env[out] = run(*[env[a] for a in args])
                for n in done:
                    del env[n]
            for n, rows in going[p]:
                rows.append(env[n])
            env.update([(read, env[write]) for read, write in self.cells])
        for (n, spec, where), (_, _, rows) in zip(self.wanted, kept, strict=True):
            column = np.array(rows, _kind(spec, self.real)).reshape(len(rows), *spec.shape)
            ticks.values[n] = where, np.ascontiguousarray(np.moveaxis(column, 0, -1))


@dataclass(frozen=True)
class _Taken:
    """A selection of which the side is known."""

    spec: Spec
    real: Any

    def __call__(self, side: Any) -> Any:
        return np.broadcast_to(np.asarray(side, _kind(self.spec, self.real)), self.spec.shape)


def _columns(value: Any) -> Sequence[Any]:
    return np.ascontiguousarray(np.moveaxis(value, -1, 0))  # type: ignore[return-value]


def _kind(spec: Spec, real: Any) -> Any:
    return real if spec.dtype == "real" else DTYPES[spec.dtype]


def _nothing(spec: Spec, real: Any) -> np.ndarray:
    return np.zeros((*spec.shape, 0), _kind(spec, real))
