"""When things can happen: the longest chains, the initiation interval, and how long values wait.

The unit is a cycle in which every multiplier can begin one multiplication and any number of other operations
is done. A datapath has `lanes` copies of `multipliers`; work along the axis of particles is spread over the
lanes, the rest is done by one of them.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from flowgraph.pipeline.costs.energy import expanded
from flowgraph.pipeline.costs.operations import depth, operations
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Machine:
    """What a program is to run on.

    Args:
        multipliers: a lane.
        lanes: how many particles at once.
        clock: cycles a second, Hz.
    """

    multipliers: int = 16
    lanes: int = 1
    clock: float = 100e6


def reach(program: Program, start: set[int]) -> dict[int, int]:
    """For each value that depends on one of `start`, the operations on the longest chain from there."""
    found = dict.fromkeys(start, 0)
    for i in program.instructions:
        before = [found[a] for a in i.args if a in found]
        if before:
            found[i.out] = max(before) + depth(i, program.specs)
    return found


def critical_path(program: Program) -> int:
    """Operations on the longest chain of all."""
    found: dict[int, int] = {}
    for i in program.instructions:
        found[i.out] = max((found.get(a, 0) for a in i.args), default=0) + depth(i, program.specs)
    return max(found.values(), default=0)


def recurrence(program: Program) -> int:
    """Operations on the longest chain from register to register: a tick waits for those of the last."""
    found = reach(program, set(program.reads))
    return max((found.get(w, 0) for w in program.writes), default=0)


def is_laned(i: Instruction, specs: Mapping[int, Spec], lanes: frozenset[int]) -> bool:
    """Whether an instruction's work lies along the axis of particles."""
    return any(n in lanes for s in (i.spec, *(specs[a] for a in i.args)) for n in s.shape)


def cycles(instructions: list[Instruction], program: Program, machine: Machine) -> int:
    """Cycles that the multipliers need for these, if they never wait."""
    common: Counter[str] = Counter()
    spread: Counter[str] = Counter()
    for i in instructions:
        (spread if is_laned(i, program.specs, program.lanes) else common).update(operations(i, program.specs))
    one, many = (_products(expanded(c)) for c in (common, spread))
    return math.ceil(one / machine.multipliers) + math.ceil(many / (machine.multipliers * machine.lanes))


def _products(counts: Mapping[str, int]) -> int:
    return counts.get("multiply", 0) + counts.get("integer multiply", 0)


@dataclass(frozen=True)
class Interval:
    """The initiation interval, in cycles: the larger of what the multipliers and what the feedback needs."""

    multipliers: int
    feedback: int

    @property
    def cycles(self) -> int:
        return max(self.multipliers, self.feedback, 1)


def interval(program: Program, machine: Machine) -> Interval:
    """A lower bound of the cycles between two ticks (B. Rau, "Iterative modulo scheduling", MICRO 1994)."""
    return Interval(cycles(list(program.instructions), program, machine), recurrence(program))


@dataclass(frozen=True)
class Slot:
    """When a stage works: from `start` for `duration` cycles after the tick began."""

    start: int
    duration: int

    @property
    def end(self) -> int:
        return self.start + self.duration


def schedule(program: Program, machine: Machine, stage_of: Callable[[int], str]) -> dict[str, Slot]:
    """Each stage as soon as those are done that it takes from, on multipliers of its own."""
    members: dict[str, list[Instruction]] = {}
    home = {i.out: stage_of(i.out) for i in program.instructions}
    for i in program.instructions:
        members.setdefault(home[i.out], []).append(i)
    after = {
        name: {home[a] for i in own for a in i.args if a in home} - {name} for name, own in members.items()
    }
    found: dict[str, Slot] = {}
    waiting = list(members)
    while waiting:
        ready = [n for n in waiting if after[n] <= found.keys()] or waiting[:1]
        for name in ready:
            own = members[name]
            chain: dict[int, int] = {}
            for i in own:
                chain[i.out] = max((chain.get(a, 0) for a in i.args), default=0) + depth(i, program.specs)
            duration = max(max(chain.values()), cycles(own, program, machine))
            begin = max((found[p].end for p in after[name] if p in found), default=0)
            found[name] = Slot(begin, duration)
            waiting.remove(name)
    return found
