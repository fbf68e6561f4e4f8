"""One scalar operation as an expression of C, and the helpers that it calls."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from flowgraph.engines.c.nodes import Buffer, Node, value_of
from flowgraph.engines.c.syntax import ctype, number
from flowgraph.engines.comparisons import COMPARISONS
from flowgraph.errors import LoweringError
from flowgraph.recorder.ops import FUNCTIONS

_INFIX = {
    **COMPARISONS,
    "logical_and": "&&",
    "logical_or": "||",
    "logical_xor": "!=",
    "bitwise_and": "&",
    "bitwise_or": "|",
    "bitwise_xor": "^",
}
_LIBM = FUNCTIONS | {"floor", "ceil", "trunc"}
IN_LANES = ("exp", "log", "sin", "cos", "atan2")
"""Functions that have a form without branches, which vectorises: see `vector_math`."""
ARITHMETIC = {"add": "+", "subtract": "-", "multiply": "*"}


class Expressions:
    """Writes operations; remembers which helpers they need.

    Args:
        real: "double" or "float".
        turn: the text of a function, given its name, a case of a replay and the sizes of history and row.
        choice: the text of a function, given its name and a choice.
    """

    def __init__(
        self, real: str, turn: Callable[..., str] = lambda *_: "", choice: Callable[..., str] = lambda *_: ""
    ) -> None:
        self.real, self.turn, self.choice = real, turn, choice
        self.helpers: set[str] = set()
        self.packs = False
        self.called: set[str] = set()
        self.functions: dict[Any, tuple[str, str]] = {}

    def ctype(self, dtype: str) -> str:
        """The type of what a tick computes."""
        return ctype(dtype, self.real)

    def kind(self, buffer: Buffer) -> str:
        """The type of the elements of a buffer."""
        return self.ctype(buffer.dtype)

    def const(self, value: Any, dtype: str) -> str:
        """A known number as what a tick computes."""
        return number(value, dtype, self.real)

    def pick(self, dtype: str, mask: str, yes: str, no: str) -> str:
        """One of two, by a truth."""
        return f"{mask} ? {yes} : {no}"

    def helper(self, name: str) -> str:
        self.helpers.add(name)
        return name

    def function(self, key: Any, kind: str, make: Callable[..., str], *views: Any) -> str:
        """The name of a function for these sizes, written the first time it is asked for."""
        if key not in self.functions:
            name = f"fg_{kind}_{len(self.functions)}"
            self.functions[key] = name, make(name, *views)
        return self.functions[key][0]

    def libm(self, name: str) -> str:
        """A function of math.h; those that we have ourselves are noted."""
        if name in IN_LANES:
            self.called.add(name)
        return name if self.real == "double" else f"{name}f"

    def write(self, node: Node, args: Sequence[str]) -> str:
        """The expression of a node whose arguments are written already (each can stand in a product)."""
        op, dtype = node.op, node.dtype
        kind = node.args[0].dtype if node.args else dtype
        if op == "const":
            return number(node.extra[0], dtype, self.real)
        if op in ARITHMETIC:
            return self._arithmetic(op, dtype, args)
        if op == "divide":
            return f"{args[0]} / {args[1]}"
        if op == "negative":
            return f"-{args[0]}" if dtype == "real" else self._arithmetic("subtract", dtype, ("0", args[0]))
        if op in _INFIX:
            text = f"{args[0]} {_INFIX[op]} {args[1]}"
            return f"({text}) != 0" if dtype == "bool" and op.startswith("bitwise") else text
        if op == "where":
            return f"{args[0]} ? {args[1]} : {args[2]}"
        if op == "logical_not" or (op == "bitwise_invert" and dtype == "bool"):
            return f"!{args[0]}"
        if op == "bitwise_invert":
            return f"~{args[0]}"
        if op == "isnan":
            return f"{args[0]} != {args[0]}"
        if op == "isfinite":
            return f"{args[0]} - {args[0]} == 0"
        if op == "astype":
            return self._cast(kind, dtype, args[0])
        if op in ("maximum", "minimum"):
            return self._extreme(op, node, args)
        if op == "abs":
            if dtype == "real":
                return f"{self.libm('fabs')}({args[0]})"
            if dtype.startswith("u") or dtype == "bool":
                return args[0]
            return f"{args[0]} < 0 ? {self._arithmetic('subtract', dtype, ('0', args[0]))} : {args[0]}"
        if op in _LIBM and dtype == "real":
            if node.space and op in IN_LANES:
                return f"{self.helper('fg_' + op)}({', '.join(args)})"
            return f"{self.libm(op)}({', '.join(args)})"
        if op in ("floor", "ceil", "trunc", "round"):
            return args[0] if dtype != "real" else f"{self.libm('rint')}({args[0]})"
        if op == "sign":
            up, down = (self._cast("bool", dtype, f"({args[0]} {s} 0)") for s in "><")
            sign = f"{up} - {down}"
            return f"{args[0]} != {args[0]} ? {args[0]} : ({sign})" if dtype == "real" else sign
        if op in ("remainder", "floor_divide", "pow"):
            return self._division(op, dtype, node, args)
        if op in ("bitwise_left_shift", "bitwise_right_shift"):
            return self._shift(op, dtype, node, args)
        if op == "float32_bits":
            return f"{self.helper('fg_float_bits')}({args[0]})"
        raise LoweringError(
            f"the C backend has no operation {op} on {dtype}",
            path=node.origin,
            expected="an operation that C can do",
            got=f"{op} of {', '.join(a.dtype for a in node.args)}",
            fix='convert with xp.astype first, or use engine="xla"',
        )

    def _arithmetic(self, op: str, dtype: str, args: Sequence[str]) -> str:
        """Whole numbers wrap around, as in NumPy, so they go through unsigned ones."""
        sign = ARITHMETIC[op]
        if dtype in ("int32", "int64"):
            wide = f"uint{dtype[3:]}_t"
            return f"({dtype}_t)(({wide}){args[0]} {sign} ({wide}){args[1]})"
        if dtype == "bool":
            return f"{args[0]} {'||' if op == 'add' else '&&'} {args[1]}"
        return f"{args[0]} {sign} {args[1]}"

    def _cast(self, kind: str, dtype: str, arg: str) -> str:
        if dtype == "bool":
            return f"{arg} != 0"
        if kind == "real" and dtype != "real":
            return f"{self.helper('fg_whole_' + dtype)}({arg})"
        return f"({ctype(dtype, self.real)}){arg}"

    def _extreme(self, op: str, node: Node, args: Sequence[str]) -> str:
        """NaN wins, as in NumPy; with a number that is known one comparison says so."""
        a, b = args
        sign, other = (">", "<=") if op == "maximum" else ("<", ">=")
        if node.dtype == "real":
            first, second = map(value_of, node.args)
            if first is not None and first == first:
                return f"{a} {sign} {b} ? {a} : {b}"
            if second is not None and second == second:
                return f"!({a} {other} {b}) ? {a} : {b}"
            return f"({a} {sign} {b} || {a} != {a}) ? {a} : {b}"
        return f"{a} {sign} {b} ? {a} : {b}"

    def _division(self, op: str, dtype: str, node: Node, args: Sequence[str]) -> str:
        a, b = args
        power = node.args[1].extra[0] if op == "pow" and node.args[1].op == "const" else None
        if dtype == "real":
            if op == "pow":
                if power == 2:
                    return f"{a} * {a}"
                return f"{self.libm('sqrt')}({a})" if power == 0.5 else f"{self.libm('pow')}({a}, {b})"
            return f"{self.helper('fg_' + op)}({a}, {b})"
        known = node.args[1].op == "const" and node.args[1].extra[0] > 0
        if dtype.startswith("u") and known and op != "pow":
            return f"{a} {'%' if op == 'remainder' else '/'} {b}"
        return f"({ctype(dtype, self.real)}){self.helper(f'fg_{op}_{dtype[0]}')}({a}, {b})"

    def _shift(self, op: str, dtype: str, node: Node, args: Sequence[str]) -> str:
        a, by = args
        width = int(dtype.lstrip("uint"))
        amount = node.args[1]
        known = amount.op == "const" and 0 <= amount.extra[0] < width
        if known:
            by = str(int(amount.extra[0]))
        if op == "bitwise_left_shift":
            wide = f"uint{width}_t"
            shifted = f"({dtype}_t)(({wide}){a} << {by})"
            return shifted if known else f"{_in_range(by, width)} ? {shifted} : 0"
        most = f"({a} < 0 ? -1 : 0)" if dtype.startswith("i") else "0"
        return f"{a} >> {by}" if known else f"{_in_range(by, width)} ? {a} >> {by} : ({dtype}_t){most}"


def _in_range(by: str, width: int) -> str:
    return f"({by} >= 0 && {by} < {width})"
