"""The list of a pipeline while it is written: numbered values, instructions, and the stages they fall into.

A value is numbered once and equal constants are one. What is emitted waits until `close` makes a stage of it,
so that all that a block does stands together under one enable value.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flowgraph.pipeline.pipeline import Stage, kind_of
from flowgraph.recorder.ops import OPS, Spec
from flowgraph.recorder.trace import Instruction, Trace
from flowgraph.types import Type, leaves_of


class StageList:
    """Stages in order; `place` is the line that instructions get which no line of a block asked for."""

    def __init__(self, place: str) -> None:
        self.count = 0
        self.constants: dict[int, np.ndarray] = {}
        self.interned: dict[tuple[bytes, tuple[int, ...], str], int] = {}
        self.specs: dict[int, Spec] = {}
        self.stages: list[Stage] = []
        self.pending: list[Instruction] = []
        self.place = place

    def value(self, spec: Spec) -> int:
        """A fresh value number."""
        self.count += 1
        self.specs[self.count - 1] = spec
        return self.count - 1

    def values(self, type_: Type) -> list[int]:
        """Fresh numbers for the leaves of a type."""
        return [self.value(Spec(fixed(t.shape), t.dtype)) for _, t in leaves_of(type_)]

    def constant(self, value: Any) -> int:
        """The number of a value known now."""
        array = np.asarray(value)
        key = (array.tobytes(), array.shape, array.dtype.str)
        if key not in self.interned:
            self.interned[key] = self.value(Spec(array.shape, kind_of(array)))
            self.constants[self.interned[key]] = array
        return self.interned[key]

    def emit(self, op: str, *args: int, line: str | None = None, **attrs: Any) -> int:
        """Append an instruction; returns the number of its result."""
        spec = OPS[op].rule(*(self.specs[a] for a in args), **attrs)
        out = self.value(spec)
        self.pending.append(Instruction(op, args, attrs, out, spec, line or self.place))
        return out

    def select(self, condition: int, yes: int, no: int) -> int:
        """One of two values."""
        return yes if yes == no else self.emit("where", condition, yes, no)

    def copy(self, trace: Trace, renamed: dict[int, int]) -> None:
        """Append a trace's instructions, under this pipeline's numbers."""
        renamed.update({n: self.constant(a) for n, a in trace.constants.items()})
        for i in trace.instructions:
            renamed[i.out] = self.emit(i.op, *(renamed[a] for a in i.args), line=i.line, **i.attrs)

    def close(
        self,
        path: str,
        block: str,
        enable: int,
        reads: Sequence[str],
        writes: Sequence[str],
        axis: str | None = None,
    ) -> None:
        """End a stage with what has been emitted since the last."""
        if self.pending or writes:
            self.stages.append(
                Stage(path, block, enable, tuple(reads), tuple(writes), tuple(self.pending), axis)
            )
        self.pending = []


def fixed(shape: tuple[int | str, ...]) -> tuple[int, ...]:
    """A shape whose sizes are all bound."""
    return tuple(int(n) for n in shape)
