"""Recurrence: what of a program each tick needs from the tick before, and what goes over all ticks at once.

A register that holds the last value of an input is no recurrence: where the input is spread over the ticks
until its next value, what the register holds is computed like anything else. What needs none of the other
registers comes before them, what none of them needs comes after, and only what is between has to go tick by
tick. A chain of operations on streams is often all before or after.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Parts:
    """A program in three parts, in the order in which they can be computed.

    Args:
        before: instructions that need no carried register. Those that write a held one take for the presence
            of its input the number that `seen` has, and as the register's value that before the first tick.
        around: those that lie between two carried registers; they go tick by tick.
        after: the rest.
        carried: places of the registers that are carried from tick to tick, among `program.reads`.
        held: places of registers that hold the last value of an input.
        seen: place of an input -> the number of whether it has been present, in this tick or before.
        into: values from before that `around` and the carried registers take.
        made: values of `around`, and carried registers as they are in a tick, that are needed after.
    """

    before: tuple[Instruction, ...]
    around: tuple[Instruction, ...]
    after: tuple[Instruction, ...]
    carried: tuple[int, ...]
    held: tuple[int, ...]
    seen: Mapping[int, int]
    into: tuple[int, ...]
    made: tuple[int, ...]

    @property
    def numbers(self) -> int:
        """How many numbers a tick makes."""
        return sum(map(_size, (*self.before, *self.around, *self.after)))

    @property
    def share(self) -> float:
        """Of these, those that are made tick by tick."""
        return sum(map(_size, self.around)) / max(self.numbers, 1)


def parts(program: Program, pipeline: Pipeline) -> Parts:
    """The parts of a program in which presence is data."""
    held = _held(program, pipeline)
    seen = {port: -1 - port for port in set(held.values())}
    writers = {program.writes[place]: port for place, port in held.items()}
    instructions = [
        replace(i, args=(seen[writers[i.out]], *i.args[1:])) if i.out in writers else i
        for i in program.instructions
    ]
    carried = [place for place in range(len(program.reads)) if place not in held]
    reads = {program.reads[place] for place in carried}
    late = set(reads)
    for i in instructions:
        if late.intersection(i.args):
            late.add(i.out)
    written = {program.writes[place] for place in carried}
    needed = set(written)
    for i in reversed(instructions):
        if i.out in needed and i.out in late:
            needed.update(i.args)
    before = [i for i in instructions if i.out not in late]
    around = [i for i in instructions if i.out in late and i.out in needed]
    after = [i for i in instructions if i.out in late and i.out not in needed]
    inside = reads | {i.out for i in around}
    ends = {n for flag, leaves in program.outputs for n in (flag, *leaves) if n is not None}
    into = written.union(*(i.args for i in around)) - inside - program.constants.keys() - {pipeline.seed}
    made = inside & ends.union(*(i.args for i in after))
    return Parts(
        tuple(before), tuple(around), tuple(after), tuple(carried), tuple(held), seen,
        tuple(sorted(into)), tuple(sorted(made)),
    )  # fmt: skip


def _held(program: Program, pipeline: Pipeline) -> dict[int, int]:
    """Place of each register that holds what comes of an input alone -> the place of that input."""
    presence = {port.present: k for k, port in enumerate(pipeline.inputs)}
    makers = {i.out: i for i in program.instructions}
    ends = {n for flag, leaves in program.outputs for n in (flag, *leaves)}
    found = {}
    for place, (read, write) in enumerate(zip(program.reads, program.writes, strict=True)):
        last = makers.get(write)
        if last is None or last.op != "where" or last.args[0] not in presence or last.args[2] != read:
            continue
        port = presence[last.args[0]]
        known = {*program.constants, pipeline.seed, *(leaf.value for leaf in pipeline.inputs[port].leaves)}
        others = read in ends or read in program.writes or program.users[read] != (last,)
        if not others and last.args[1] != read and _comes_of(last.args[1], known, makers):
            found[place] = port
    return found


def _comes_of(value: int, known: Iterable[int], makers: Mapping[int, Instruction]) -> bool:
    """Whether a value is computed from known ones alone."""
    seen, left = set(known), [value]
    while left:
        n = left.pop()
        if n in seen:
            continue
        if n not in makers:
            return False
        seen.add(n)
        left.extend(makers[n].args)
    return True


def _size(i: Instruction) -> int:
    return math.prod(i.spec.shape)
