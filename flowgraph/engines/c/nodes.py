"""Scalar operations in the order of their making: what an array instruction comes apart into before it is C.

A `Node` is one scalar operation; equal ones are made once, and what is known is folded. It is uniform, or
it varies over a `space`: the sizes of the loops in which it is computed. A `Buffer` is memory, a `Store`
writes a node into one, and a `Macro` is an operation with loops of its own (a factorization, a sort, random
numbers).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

Space = tuple[int, ...]


@dataclass(eq=False)
class Buffer:
    """Memory of `size` numbers.

    Args:
        name: as C writes it; a work buffer gets its name when it is placed.
        kind: "state", "input", "output", "const" or "work".
        bare: whether it is one number, written without an index.
        data: of a constant.
        known: nodes stored at fixed places.
        writers: what fills a work buffer.
    """

    name: str
    dtype: str
    size: int
    kind: str
    bare: bool = False
    data: np.ndarray | None = None
    known: dict[int, Node] = field(default_factory=dict)
    writers: list[Store | Macro] = field(default_factory=list)
    ready: int = 0


class View(NamedTuple):
    """An array in a buffer: the place of element (i, j, ...) is offset + i strides[0] + j strides[1] + ..."""

    buffer: Buffer
    shape: tuple[int, ...]
    offset: int
    strides: tuple[int, ...]


class Node:
    """One scalar operation; `extra` is what it needs beside its arguments."""

    __slots__ = ("args", "dtype", "extra", "level", "op", "order", "origin", "space")

    def __init__(
        self, op: str, args: tuple[Node, ...], dtype: str, space: Space, extra: Any, order: int, origin: str
    ) -> None:
        self.op, self.args, self.dtype, self.space, self.extra = op, args, dtype, space, extra
        self.order, self.origin, self.level = order, origin, 0


@dataclass(eq=False)
class Store:
    """Write a node to a place of a buffer, or to one place for each turn of the loops over `space`."""

    buffer: Buffer
    offset: int
    strides: tuple[int, ...]
    node: Node
    space: Space
    order: int
    level: int = 0


@dataclass(eq=False)
class Macro:
    """An operation with loops of its own, from whole arrays to a whole buffer."""

    kind: str
    inputs: tuple[View, ...]
    args: tuple[Node, ...]
    output: View
    extra: dict[str, Any]
    order: int
    origin: str
    level: int = 0


Item = Node | Store | Macro


class Tape:
    """Everything made so far, in order."""

    def __init__(self) -> None:
        self.items: list[Item] = []
        self.buffers: list[Buffer] = []
        self.origin = ""
        self._made: dict[Any, Node] = {}

    # -- nodes ---------------------------------------------------------------------------------------

    def node(self, op: str, args: Sequence[Node], dtype: str, space: Space = (), extra: Any = None) -> Node:
        """The node, made if it is new; its space is that of its arguments unless another is given."""
        for a in args:
            space = a.space or space
        key = (op, tuple(a.order for a in args), dtype, space, extra)
        if key not in self._made:
            made = Node(op, tuple(args), dtype, space, extra, len(self.items), self.origin)
            self._made[key] = made
            self.items.append(made)
        return self._made[key]

    def const(self, value: Any, dtype: str) -> Node:
        """A number known now."""
        plain = float(value) if dtype == "real" else bool(value) if dtype == "bool" else int(value)
        key = (math.copysign(1.0, plain), str(plain)) if dtype == "real" else plain
        return self.node("const", (), dtype, (), (plain, key))

    def given(self, name: str, dtype: str) -> Node:
        """A number that C knows under a name."""
        return self.node("given", (), dtype, (), name)

    def load(self, buffer: Buffer, offset: int, strides: tuple[int, ...], space: Space) -> Node:
        """What is at a place; strides are those of the loops."""
        if not any(strides):
            if offset in buffer.known:
                return buffer.known[offset]
            if buffer.data is not None:
                return self.const(buffer.data.ravel()[offset], buffer.dtype)
            return self.node("load", (), buffer.dtype, (), (buffer, offset, ()))
        return self.node("load", (), buffer.dtype, space, (buffer, offset, strides))

    def gather(
        self, view: View, offset: int, strides: tuple[int, ...], space: Space, axis: int, index: Node
    ) -> Node:
        """What is at `index` of an axis of a view; an index outside is brought to the nearest end."""
        n, step = view.shape[axis], view.strides[axis]
        if index.op == "const":
            at = min(max(int(index.extra[0]), 0), n - 1)
            return self.load(view.buffer, offset + at * step, strides, space)
        varies = space if any(strides) else ()
        return self.node(
            "gather", (index,), view.buffer.dtype, varies, (view.buffer, offset, strides, step, n)
        )

    def iota(self, axis: int, space: Space) -> Node:
        """The count of a loop, as int64."""
        return self.node("iota", (), "int64", space, axis)

    def reduce(self, kind: str, node: Node, space: Space) -> Node:
        """A sum, product, maximum, minimum, any or all over the loops."""
        key = ("reduce", kind, node.order, space)
        if key not in self._made:
            made = Node("reduce", (node,), node.dtype, (), (kind, space), len(self.items), self.origin)
            self._made[key] = made
            self.items.append(made)
        return self._made[key]

    def op(self, op: str, dtype: str, *args: Node, **attrs: Any) -> Node:
        """An operation element by element, folded where its arguments are known."""
        known = fold(self, op, dtype, args)
        if known is not None:
            return known
        return self.node(op, args, dtype, (), tuple(sorted(attrs.items())) or None)

    # -- memory --------------------------------------------------------------------------------------

    def work(self, dtype: str, size: int) -> Buffer:
        """Fresh memory for one tick."""
        made = Buffer("", dtype, size, "work")
        self.buffers.append(made)
        return made

    def store(self, buffer: Buffer, offset: int, strides: tuple[int, ...], node: Node, space: Space) -> Store:
        """Write a node."""
        made = Store(buffer, offset, strides, node, space, len(self.items))
        self.items.append(made)
        buffer.writers.append(made)
        if not space and buffer.kind == "work":
            buffer.known[offset] = node
        return made

    def macro(
        self, kind: str, inputs: Sequence[View], output: View, args: Sequence[Node] = (), **extra: Any
    ) -> Macro:
        """An operation with loops of its own."""
        made = Macro(kind, tuple(inputs), tuple(args), output, extra, len(self.items), self.origin)
        self.items.append(made)
        output.buffer.writers.append(made)
        return made


# -- folding -----------------------------------------------------------------------------------------


def value_of(node: Node) -> Any:
    """The number of a constant, or None."""
    return node.extra[0] if node.op == "const" else None


def fold(tape: Tape, op: str, dtype: str, args: Sequence[Node]) -> Node | None:
    """What an operation is known to be: a constant, or one of its arguments.

    A product with a constant zero is zero, which is how structural zeros of small matrices disappear.
    """
    values = [value_of(a) for a in args]
    if op in _EXACT and all(v is not None for v in values):
        return tape.const(_EXACT[op](*values), dtype)
    rule = _RULES.get(op)
    return rule(tape, dtype, args, values) if rule is not None else None


def _add(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if dtype == "bool":
        return None
    if values[0] == 0:
        return args[1]
    if values[1] == 0:
        return args[0]
    if dtype == "real" and args[1].op == "negative":
        return tape.op("subtract", dtype, args[0], args[1].args[0])
    if dtype == "real" and args[0].op == "negative":
        return tape.op("subtract", dtype, args[1], args[0].args[0])
    return None


def _subtract(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if values[1] == 0:
        return args[0]
    if dtype == "real" and values[0] == 0:
        return tape.op("negative", dtype, args[1])
    if dtype == "real" and args[1].op == "negative":
        return tape.op("add", dtype, args[0], args[1].args[0])
    return None


def _multiply(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if dtype == "bool":
        return None
    for k in (0, 1):
        if values[k] == 0:
            return tape.const(0, dtype)
        if values[k] == 1:
            return args[1 - k]
        if values[k] == -1 and dtype == "real":
            return tape.op("negative", dtype, args[1 - k])
    return None


def _divide(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    return args[0] if values[1] == 1 else None


def _negative(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if dtype == "real" and values[0] is not None:
        return tape.const(-values[0], dtype)
    return args[0].args[0] if args[0].op == "negative" and dtype == "real" else None


def _where(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if values[0] is not None:
        return args[1] if values[0] else args[2]
    return args[1] if args[1] is args[2] else None


def _astype(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
    if args[0].dtype == dtype:
        return args[0]
    (value,) = values
    if value is None:
        return None
    if dtype == "bool":
        return tape.const(value != 0, dtype)
    if dtype == "real":
        return tape.const(value, dtype)
    width, signed = int(dtype.lstrip("uint")), dtype[0] == "i"
    if args[0].dtype == "real" and not abs(value) < 2.0 ** (width - 1):
        return None
    whole = int(value) % 2**width
    return tape.const(whole - 2**width if signed and whole >= 2 ** (width - 1) else whole, dtype)


def _logical(op: str) -> Callable[..., Node | None]:
    ends = op == "logical_or"

    def rule(tape: Tape, dtype: str, args: Sequence[Node], values: list[Any]) -> Node | None:
        if ends in values:
            return tape.const(ends, "bool")
        for k in (0, 1):
            if values[k] is not None:
                return args[1 - k]
        return None

    return rule


_RULES: dict[str, Callable[..., Node | None]] = {
    "add": _add,
    "subtract": _subtract,
    "multiply": _multiply,
    "divide": _divide,
    "negative": _negative,
    "where": _where,
    "astype": _astype,
    "logical_and": _logical("logical_and"),
    "logical_or": _logical("logical_or"),
    "positive": lambda tape, dtype, args, values: args[0],
}

_EXACT: dict[str, Callable[..., Any]] = {
    "equal": lambda a, b: a == b,
    "not_equal": lambda a, b: a != b,
    "less": lambda a, b: a < b,
    "less_equal": lambda a, b: a <= b,
    "greater": lambda a, b: a > b,
    "greater_equal": lambda a, b: a >= b,
    "logical_not": lambda a: not a,
    "isnan": lambda a: a != a,
}
