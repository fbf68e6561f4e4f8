"""The trace: what a step did, as typed instructions in single-assignment form.

Each operation on a symbolic array appends one instruction, with the shape that its rule gives and the source
line that asked for it. Operands are brought to a common kind of number first; what is known already is a
constant, and equal constants are one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.recorder.ops import OPS, ShapeError, Spec, promote
from flowgraph.recorder.refusals import caller, refuse
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.types import DTYPES, dtype_name

_LEAST_NORMAL = float(np.finfo(np.float64).tiny)


@dataclass(frozen=True)
class Instruction:
    """`out = op(*args, **attrs)`: `args` are value numbers; `line` is module:line of the block's source."""

    op: str
    args: tuple[int, ...]
    attrs: dict[str, Any]
    out: int
    spec: Spec
    line: str


def _need_normal(array: np.ndarray) -> None:
    """Refuse subnormal constants: one engine keeps them where another takes them for 0."""
    small = np.abs(array)
    below = small[(small < _LEAST_NORMAL) & (small > 0)]
    if below.size:
        refuse(
            "a constant is smaller than the normal numbers",
            f"0, or {_LEAST_NORMAL:.3g} and more in size",
            f"{below.min():g}",
            "write 1e-300, or scale the quantity: compiled engines take such numbers for 0",
            in_every_engine=True,
        )


class Trace:
    """Instructions in the order recorded, and the constants they use."""

    namespace = namespace
    """The array namespace of its symbolic arrays."""

    def __init__(self) -> None:
        self.instructions: list[Instruction] = []
        self.constants: dict[int, np.ndarray] = {}
        self._interned: dict[tuple[bytes, tuple[int, ...], str], int] = {}
        self._count = 0

    def new(self) -> int:
        """A fresh value number."""
        self._count += 1
        return self._count - 1

    def input(self, spec: Spec) -> Symbolic:
        """A value that comes from outside."""
        return Symbolic(self, self.new(), spec)

    def constant(self, value: Any) -> Symbolic:
        """A value known now; equal constants share one number."""
        array = np.asarray(value)
        dtype = dtype_name(array)
        array = array.astype(DTYPES[dtype])
        if array.dtype.kind == "f":
            _need_normal(array)
        key = (array.tobytes(), array.shape, dtype)
        number = self._interned.get(key)
        if number is None:
            number = self._interned[key] = self.new()
            self.constants[number] = array
        return Symbolic(self, number, Spec(array.shape, dtype))

    def apply(self, op: str, *args: Any, **attrs: Any) -> Symbolic:
        """Record one instruction, bringing its operands to a common kind of number first."""
        rule = OPS[op]
        operands = self._operands(rule.operands, op, args)
        try:
            spec = rule.rule(*(a.spec for a in operands), **attrs)
        except ShapeError as error:
            raise LoweringError(
                f"{op}: {error}",
                path=caller(),
                expected="shapes that fit",
                got=str([a.shape for a in operands]),
                fix="reshape or transpose one side",
            ) from None
        out = Symbolic(self, self.new(), spec)
        numbers = tuple(a.number for a in operands)
        self.instructions.append(Instruction(op, numbers, attrs, out.number, spec, caller()))
        return out

    def _operands(self, kind: str, op: str, args: Sequence[Any]) -> list[Symbolic]:
        peers = [a for a in (args[1:] if op == "where" else args) if isinstance(a, Symbolic)]
        lifted = []
        for arg in args:
            if isinstance(arg, Symbolic):
                if arg.trace is not self:
                    refuse(
                        "this mixes values of two blocks",
                        "only values of this step",
                        "a value kept from elsewhere",
                        "pass it through a port",
                    )
                lifted.append(arg)
            elif isinstance(arg, bool | int | float) and not isinstance(arg, np.generic) and peers:
                dtypes = [p.dtype_name for p in peers] + (["real"] if isinstance(arg, float) else [])
                weak = promote(*dtypes)
                if weak == "bool" and not isinstance(arg, bool):
                    weak = "int64"  # True + 1 is a number
                lifted.append(
                    self.constant(
                        np.asarray(arg, DTYPES["bool" if isinstance(arg, bool) and weak == "bool" else weak])
                    )
                )
            else:
                lifted.append(self.constant(arg))
        if op == "where":
            common = promote(lifted[1].dtype_name, lifted[2].dtype_name)
            return [lifted[0].cast("bool"), lifted[1].cast(common), lifted[2].cast(common)]
        if kind == "same":
            common = promote(*(a.dtype_name for a in lifted))
            return [a.cast(common) for a in lifted]
        if kind in ("real", "bool"):
            return [a.cast(kind) for a in lifted]
        if kind == "int" and any(a.dtype_name == "real" for a in lifted):
            refuse(f"{op} of real numbers", "integers", "real", "convert with xp.astype first")
        return lifted
