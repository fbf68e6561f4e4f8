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

from flowgraph.errors import LoweringError, TypeMismatchError
from flowgraph.recorder import units
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Op, ShapeError, Spec, bound_attrs, promote
from flowgraph.recorder.refusals import caller, refuse
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.units import Unit
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
        self.units: dict[int, Unit] = {}
        self._interned: dict[tuple[bytes, tuple[int, ...], str], int] = {}
        self._count = 0

    @property
    def values(self) -> list[tuple[Any, int]]:
        """The constants to the last bit, with their numbers, in the order met."""
        return list(self._interned.items())

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
            refusal = LoweringError(
                f"{op}: {error}",
                path=caller(),
                expected="shapes that fit",
                got=str([a.shape for a in operands]),
                fix="reshape or transpose one side",
            )
            refusal.in_every_engine = not _numpy_can(rule, operands, attrs)
            raise refusal from None
        out = Symbolic(self, self.new(), spec)
        numbers = tuple(a.number for a in operands)
        if self.units:
            self._measure(op, numbers, out.number)
        self.instructions.append(Instruction(op, numbers, attrs, out.number, spec, caller()))
        return out

    def _measure(self, op: str, numbers: tuple[int, ...], out: int) -> None:
        """Note the unit of a result where it is known."""
        power = self.constants.get(numbers[1]) if op == "pow" else None
        exponent = None if power is None or power.shape else float(power)
        try:
            unit = units.result(op, [self.units.get(n) for n in numbers], exponent)
        except units.UnitsDifferError as error:
            raise TypeMismatchError(
                f"{op} of different units",
                path=caller(),
                expected="one unit",
                got=str(error),
                fix="convert one of them first; a product with a constant has no unit and fits any",
            ) from None
        if unit is not None:
            self.units[out] = unit

    def unit(self, number: int, given: Sequence[str]) -> str | None:
        """The unit of a value, spelled as in `given`, the units at the ports; None where it is not known."""
        found = self.units.get(number)
        return None if found is None else units.spelled(found, given)

    def line(self, number: int) -> str | None:
        """The line that computed a value; None for one from outside."""
        return next((i.line for i in self.instructions if i.out == number), None)

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


def _numpy_can(op: Op, operands: Sequence[Symbolic], attrs: dict[str, Any]) -> bool:
    """Whether NumPy has a result where the rule of an operation has none."""
    zeros = [np.zeros(a.shape, DTYPES[a.dtype_name]) for a in operands]
    try:
        with np.errstate(all="ignore"):
            op.run(NUMPY, *zeros, **bound_attrs(op.name, attrs, np.float64))
    except Exception:  # whatever it has against them
        return False
    return True
