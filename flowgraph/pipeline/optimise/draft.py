"""A program while it is being rewritten: what every pass reads from and writes into.

A pass walks through the instructions once, in order. It keeps an instruction, replaces its value by another,
or emits others in its stead; what came later and named the old value then names the new one. Each new value
remembers the one of the pipeline that it serves, so that costs can be told by stage to the end.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph.pipeline.pipeline import kind_of
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import OPS, Spec
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

LARGEST_CONSTANT = 4096
"""Elements above which a pass makes no new constant."""


class Draft:
    """The new list of one pass over `program`."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.specs: dict[int, Spec] = dict(program.specs)
        self.constants: dict[int, np.ndarray] = dict(program.constants)
        self.instructions: list[Instruction] = []
        self.made: dict[int, Instruction] = {}
        self.origin: dict[int, int] = dict(program.origin)
        self._same: dict[int, int] = {}
        self._next = max(self.specs, default=-1) + 1
        self._interned: dict[tuple[bytes, tuple[int, ...], str], int] = {}

    def now(self, value: int) -> int:
        """The number under which a value of the old list is known in the new one."""
        return self._same.get(value, value)

    def args(self, i: Instruction) -> tuple[int, ...]:
        """The arguments of an old instruction, as numbers of the new list."""
        return tuple(self._same.get(a, a) for a in i.args)

    def keep(self, i: Instruction) -> None:
        """Take an instruction over."""
        self._append(Instruction(i.op, self.args(i), i.attrs, i.out, i.spec, i.line))

    def emit(self, op: str, *args: int, by: Instruction, **attrs: Any) -> int:
        """Append a new instruction in the service of an old one; returns its value."""
        spec = OPS[op].rule(*(self.specs[a] for a in args), **attrs)
        out, self._next = self._next, self._next + 1
        self.origin[out] = self.origin.get(by.out, by.out)
        self._append(Instruction(op, args, attrs, out, spec, by.line))
        return out

    def _append(self, i: Instruction) -> None:
        self.specs[i.out] = i.spec
        self.instructions.append(i)
        self.made[i.out] = i

    def replace(self, old: int, new: int) -> None:
        """From now on `new` (a number of the new list) stands for `old`."""
        self._same[old] = new

    def constant(self, value: Any, dtype: str) -> int:
        """The number of a constant; equal ones share it."""
        array: np.ndarray = np.asarray(value).astype(DTYPES[dtype])
        key = (array.tobytes(), array.shape, dtype)
        if key not in self._interned:
            out, self._next = self._next, self._next + 1
            self._interned[key] = out
            self.constants[out] = array
            self.specs[out] = Spec(array.shape, kind_of(array))
        return self._interned[key]

    def done(self, elements: Mapping[int, np.ndarray] | None = None) -> Program:
        """The program with the new list, its ends renamed; unused constants stay behind.

        Args:
            elements: of the new list's factors; those of the old list if left out.
        """
        p = self.program
        outputs = tuple(
            (None if flag is None else self.now(flag), tuple(self.now(x) for x in leaves))
            for flag, leaves in p.outputs
        )
        writes = tuple(self.now(w) for w in p.writes)
        used = {a for i in self.instructions for a in i.args} | set(ends(outputs, writes))
        return Program(
            {n: a for n, a in self.constants.items() if n in used},
            tuple(self.instructions),
            outputs,
            writes,
            self.specs,
            p.reads,
            p.symmetric,
            p.lanes,
            self.origin,
            p.elements if elements is None else elements,
        )


def ends(outputs: Any, writes: tuple[int, ...]) -> list[int]:
    """The values that outputs and registers take."""
    return [*writes, *(n for flag, leaves in outputs for n in (*leaves, *([] if flag is None else [flag])))]
