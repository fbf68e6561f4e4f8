"""Unrolling: small arrays become scalars, and arrays of particles become rows of one number a particle.

Rearranging then costs nothing, and every zero, one and repetition among the elements shows to the passes that
follow. What is larger than the bounds stays an array. Between the two an array is taken apart with `getitem`
and put together with `stack` and `reshape`, only where someone asks for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.pipeline.optimise.draft import Draft, ends
from flowgraph.pipeline.optimise.elements import Elements, Table
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction

LARGEST_ARRAY = 36
"""Elements (beside those along the axis of particles) of an array above which it stays one: 6 by 6."""

LONGEST_AXIS = 16
"""Beside that of particles: a longer one is a loop."""

LARGEST_WORK = 256
"""Scalar operations of an instruction above which it stays one."""


class Unroller:
    """The pass at work on a program: arrays in its tables are taken apart, others are not.

    Args:
        program: what to rewrite.
        largest: scalar operations of an instruction above which it stays one.
        lanes: sizes of last axes that stay whole; those of the program if left out.
    """

    def __init__(self, program: Program, largest: int, lanes: frozenset[int] | None = None) -> None:
        self.draft = Draft(program)
        self.program, self.largest = program, largest
        self.elements = Elements(self.draft.specs, program.lanes if lanes is None else lanes, self.make)
        self.made = {i.out: i for i in program.instructions}
        self.tables: dict[int, Table] = {}
        self.loads: dict[Any, int] = {}
        self.by: Instruction

    def run(self) -> Program:
        draft = self.draft
        for i in self.program.instructions:
            self.by = i
            table = self.expanded(i)
            if table is None:
                for a in set(i.args):
                    self.pack(a)
                draft.keep(i)
            else:
                self.tables[i.out] = table
                self.settled(i, table)
        for n in ends(self.program.outputs, self.program.writes):
            self.pack(n)
        return draft.done()

    def settled(self, i: Instruction, table: Table) -> None:
        """What else is done with the elements of an array that was taken apart."""

    def expanded(self, i: Instruction) -> Table | None:
        """The elements of a result, where it is small enough and has a rule."""
        serves = self.program.origin.get(i.out, i.out)  # a piece of a large product stays with its likes
        if self.elements.count(i.out) > LARGEST_ARRAY or self.elements.count(serves) > LARGEST_ARRAY:
            return None
        if self._work(i) > self.largest or self.elements.longest(i.out) > LONGEST_AXIS:
            return None
        if any(self.elements.count(a) > LARGEST_ARRAY for a in i.args if a not in self.program.constants):
            return None
        return self.elements.expand(i, [self.table(a) for a in i.args])

    def _work(self, i: Instruction) -> int:
        size = self.elements.count(i.out)
        inner = self.elements.specs[i.args[0]].shape
        return size * inner[-1] if i.op in ("matmul", "vecdot") and inner else size

    def table(self, value: int) -> Table:
        """The elements of a value: scalars where it was expanded, else places to load them from."""
        if value not in self.tables:
            table = np.empty(self.elements.shape(self.elements.specs[value]), object)
            for at in np.ndindex(table.shape):
                table[at] = (value, at)
            self.tables[value] = table
        return self.tables[value]

    def make(self, op: str, *entries: Any, **attrs: Any) -> int:
        if op == "constant":
            return self.draft.constant(np.asarray(entries[0]), entries[1])
        return self.draft.emit(op, *(self.entry(e) for e in entries), by=self.by, **attrs)

    def entry(self, entry: Any) -> int:
        """The number of an element, loaded where it is not a value yet."""
        if isinstance(entry, int):
            return entry
        if entry not in self.loads:
            self.loads[entry] = self._load(*entry)
        return self.loads[entry]

    def _load(self, value: int, at: tuple[int, ...]) -> int:
        draft = self.draft
        spec, number = draft.specs[value], draft.now(value)
        wide = self.elements.laned(spec)
        if number in draft.constants:
            return draft.constant(draft.constants[number][at], spec.dtype)
        if not at:
            return number
        index = [*(int(k) for k in at), *([[None, None, None]] if wide else [])]
        return draft.emit("getitem", number, by=self.by, index=index)

    def pack(self, value: int) -> None:
        """Put a value together that was expanded, for an instruction that needs it whole."""
        draft, made = self.draft, self.made.get(value)
        if made is None or value not in self.tables or value in draft.made or draft.now(value) != value:
            return
        entries = list(self.tables[value].flat)
        if all(isinstance(e, tuple) for e in entries):  # it only moved data that is there
            for a in set(made.args):
                self.pack(a)
            return draft.keep(made)
        spec = draft.specs[value]
        row = spec.shape[-1:] if self.elements.laned(spec) else ()
        parts = [self._row(self.entry(e), row, made) for e in entries]
        whole = parts[0] if draft.specs[parts[0]].shape == spec.shape else self._stacked(parts, spec, made)
        draft.replace(value, whole)

    def _row(self, entry: int, row: tuple[int, ...], by: Instruction) -> int:
        if self.draft.specs[entry].shape == row:
            return entry
        return self.draft.emit("broadcast_to", entry, by=by, shape=list(row))

    def _stacked(self, parts: list[int], spec: Spec, by: Instruction) -> int:
        whole = self.draft.emit("stack", *parts, by=by, axis=0)
        if self.draft.specs[whole].shape == spec.shape:
            return whole
        return self.draft.emit("reshape", whole, by=by, shape=list(spec.shape))


def unroll(program: Program, *, largest: int = LARGEST_WORK) -> Program:
    """Take small arrays apart.

    Args:
        program: what to rewrite.
        largest: scalar operations of an instruction above which it stays one.
    """
    return Unroller(program, largest).run()
