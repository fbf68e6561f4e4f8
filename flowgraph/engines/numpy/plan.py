"""The order of a program's values over many ticks at once: after what they need, at any tick.

A register needs what was written to it. Values that need one another so, through a register, are one part:
most are a register that takes a value now and then and else stays, or that adds up, which is one `Scan`; the
others are a `Loop`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph.engines.numpy.guards import Bounds, Patterns, bounds_of, needed_in
from flowgraph.engines.numpy.steps import Before, Choose, Draw, Evaluate, Loop, Scan, Step
from flowgraph.pipeline.optimise import optimise
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise
from flowgraph.recorder.trace import Instruction

_SUMS: Mapping[str, Any] = {
    name: getattr(np, name)
    for name in (
        "add",
        "multiply",
        "maximum",
        "minimum",
        "logical_and",
        "logical_or",
        "bitwise_and",
        "bitwise_or",
        "bitwise_xor",
    )
}
"""What makes the same of old and new as of new and old, and so may be accumulated in order."""


@dataclass(frozen=True)
class Plan:
    """What is done with each stretch of ticks.

    Args:
        program: what is played.
        every: the set of all patterns.
        needed: for each value, the patterns in which it is.
        bounds: for each scalar Boolean, the patterns in which it is surely true, and may be.
        once: steps whose values are the same in all ticks.
        steps: the others, in order.
        done: after each of these, the values that nothing takes any more.
        stays: (read) of the registers that are never written.
    """

    program: Program
    every: Patterns
    needed: Mapping[int, Patterns]
    bounds: Bounds
    once: tuple[Step, ...]
    steps: tuple[Step, ...]
    done: tuple[tuple[int, ...], ...]
    stays: frozenset[int]

    @property
    def loops(self) -> int:
        """How many parts are played tick by tick."""
        return sum(isinstance(s, Loop) for s in self.steps)


def planned(pipeline: Pipeline, patterns: Sequence[int], real: Any, passes: Iterable[str]) -> Plan:
    """The plan for ticks of these patterns of present inputs."""
    program = optimise(_without_draws(specialise(pipeline, None), pipeline), tuple(passes))
    every = (1 << len(patterns)) - 1
    bounds = bounds_of(program, pipeline.inputs, patterns)
    needed = needed_in(program, bounds, every)
    return _Planner(pipeline, program, real, every, bounds, needed).plan()


def _without_draws(program: Program, pipeline: Pipeline) -> Program:
    """The program without what makes random numbers: a site's are drawn for all ticks by a function."""
    sites = {s.value for s in pipeline.random}
    wanted = {*program.writes, *(n for flag, leaves in program.outputs for n in (flag, *leaves))}
    kept = []
    for i in reversed(program.instructions):
        if i.out in wanted and i.out not in sites:
            kept.append(i)
            wanted.update(i.args)
    return replace(program, instructions=tuple(reversed(kept)))


class _Planner:
    def __init__(
        self,
        pipeline: Pipeline,
        program: Program,
        real: Any,
        every: Patterns,
        bounds: Bounds,
        needed: dict[int, Patterns],
    ) -> None:
        self.pipeline, self.program, self.real = pipeline, program, real
        self.every, self.bounds, self.needed = every, bounds, needed
        sites = {s.value: s for s in pipeline.random if needed.get(s.value)}
        self.sites = sites
        self.making = {i.out: i for i in program.instructions if needed.get(i.out) and i.out not in sites}
        self.written = dict(zip(program.reads, program.writes, strict=True))
        self.stays = frozenset(r for r, w in self.written.items() if r == w)
        self.order = {n: k for k, n in enumerate((*program.reads, *self.making))}

    def needs(self, n: int) -> tuple[int, ...]:
        """What must be there before a value."""
        if n in self.making:
            return self.making[n].args
        return (self.written[n],) if n in self.written and n not in self.stays else ()

    def plan(self) -> Plan:
        ends = set(self.program.writes)
        for flag, leaves in self.program.outputs:
            ends.update(leaves if flag is None else (flag, *leaves))
        self.ends = ends
        alike = set(self.program.constants) | {self.pipeline.seed} | self.stays
        once: list[Step] = []
        steps: list[Step] = []
        for part in ordered(sorted(ends), self.needs):
            if len(part) == 1 and part[0] in self.making and part[0] not in self.making[part[0]].args:
                i = self.making[part[0]]
                if alike.issuperset(i.args):
                    alike.add(i.out)
                    once.append(Evaluate(i, 1, self.real))
                    continue
            steps += self.steps_of(part)
        last: dict[int, int] = {}
        for k, step in enumerate(steps):
            last.update(dict.fromkeys((*step.takes, *step.makes), k))
        done: list[list[int]] = [[] for _ in steps]
        for n, k in last.items():
            if n not in ends and n not in alike:
                done[k].append(n)
        return Plan(
            self.program,
            self.every,
            self.needed,
            self.bounds,
            tuple(once),
            tuple(steps),
            tuple(map(tuple, done)),
            self.stays,
        )

    def steps_of(self, part: list[int]) -> list[Step]:
        """The steps of values that need one another, or of one."""
        (first, *others) = part
        if not others and first in self.sites:
            return [Draw(self.sites[first], self.needed[first], self.real)]
        if not others and first in self.making:
            return [self.evaluate(self.making[first])]
        if not others:
            known = first in self.stays or first not in self.written
            return [] if known else [Before(first, self.written[first])]
        cells = [n for n in part if n in self.written]
        inside = [self.making[n] for n in sorted(part, key=self.order.__getitem__) if n in self.making]
        return self.scan(cells, inside, set(part)) or [self.loop(cells, inside, set(part))]

    def evaluate(self, i: Instruction) -> Step:
        where, side = self.needed[i.out], self.side(i)
        return Evaluate(i, where, self.real) if side is None else Choose(i, where, side, self.real)

    def side(self, i: Instruction) -> Patterns | None:
        """Of a selection by presence alone, where it is needed: the patterns in which it takes the first."""
        if i.op != "where" or self.program.specs[i.args[0]].shape:
            return None
        low, high = (b & self.needed[i.out] for b in self.bounds.get(i.args[0], (0, self.every)))
        return low if low == high else None

    def scan(self, cells: list[int], inside: list[Instruction], part: set[int]) -> list[Step]:
        """The steps of a register that takes or adds up; nothing for what loops in another way."""
        if len(cells) != 1:
            return []
        (read,) = cells
        n = write = self.written[read]
        chain, conditions, where = {read}, [], self.every
        while n in part and self.making[n].op == "where":
            condition, yes, no = self.making[n].args
            if condition in part or self.program.specs[condition].shape or read not in (yes, no):
                return []
            wanted = no == read
            low, high = self.bounds.get(condition, (0, self.every))
            where &= high if wanted else ~low
            conditions.append((condition, wanted))
            chain.add(n)
            n = yes if wanted else no
        spec, ufunc, given = self.program.specs[read], None, n
        if n in part:
            i = self.making.get(n)
            sums = i is not None and i.op in _SUMS and i.args.count(read) == 1 and i.spec == spec
            given = next((a for a in i.args if a != read), n) if i is not None and sums else n
            if not sums or given in part:
                return []
            ufunc = _SUMS[i.op] if i is not None else None
            chain.add(n)
        elif self.program.specs[given] != spec:
            return []
        if chain != part:
            return []
        rest = [i for i in inside if i.out != write and self.used_outside(i.out, part)]
        before = bool(rest) or self.used_outside(read, part)
        made: list[Step] = [Scan(read, write, given, tuple(conditions), where, ufunc, before)]
        return made + [self.evaluate(i) for i in (inside if rest else []) if i.out != write]

    def used_outside(self, n: int, part: set[int]) -> bool:
        """Whether something takes a value that is not of its part."""
        return n in self.ends or any(
            i.out in self.making and i.out not in part for i in self.program.users.get(n, ())
        )

    def loop(self, cells: list[int], inside: list[Instruction], part: set[int]) -> Step:
        taken = dict.fromkeys(a for i in inside for a in i.args if a not in part)
        known = {n: self.bounds[n] for i in inside for n in (i.args[0], i.out) if n in self.bounds}
        wanted = tuple(
            (n, self.program.specs[n], self.every if n in self.written else self.needed[n])
            for n in sorted(part)
            if self.used_outside(n, part)
        )
        return Loop(
            tuple((r, self.written[r]) for r in cells),
            tuple((i, self.needed[i.out]) for i in inside),
            tuple((n, self.needed.get(n, 0)) for n in taken),
            known,
            wanted,
            self.every.bit_length(),
            self.real,
        )


def ordered(nodes: Iterable[int], needs: Callable[[int], Iterable[int]]) -> list[list[int]]:
    """Nodes in an order in which each comes after what it needs; those that need one another are one part.

    The strongly connected components, after R. Tarjan, "Depth-first search and linear graph algorithms",
    SIAM J. Computing 1972, without recursion.
    """
    number: dict[int, int] = {}
    least: dict[int, int] = {}
    waiting: list[int] = []
    open_: set[int] = set()
    parts: list[list[int]] = []
    for root in nodes:
        if root in number:
            continue
        number[root] = least[root] = len(number)
        waiting.append(root)
        open_.add(root)
        way = [(root, iter(needs(root)))]
        while way:
            n, coming = way[-1]
            for other in coming:
                if other not in number:
                    number[other] = least[other] = len(number)
                    waiting.append(other)
                    open_.add(other)
                    way.append((other, iter(needs(other))))
                    break
                if other in open_:
                    least[n] = min(least[n], number[other])
            else:
                way.pop()
                if way:
                    least[way[-1][0]] = min(least[way[-1][0]], least[n])
                if least[n] == number[n]:
                    part = [waiting.pop()]
                    while part[-1] != n:
                        part.append(waiting.pop())
                    parts.append(part)
                    open_.difference_update(part)
    return parts
