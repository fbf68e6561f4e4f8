"""The symbolic array: runs through a block's step once, and has what it does written down.

A `Symbolic` has a shape and a dtype but no values. Every operation of the array API on it goes to the `Trace`
that it belongs to, which writes an instruction. Whatever a fixed-size pipeline cannot hold (a Python branch
on a value, an in-place write, a shape that depends on data) is refused here, by line.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from flowgraph.recorder import ranges
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.refusals import refuse, refuse_in_place
from flowgraph.types import DTYPES

if TYPE_CHECKING:
    from flowgraph.recorder.trace import Trace


class Symbolic:
    """An array of known shape and dtype whose values are not known yet."""

    __slots__ = ("number", "spec", "trace")
    __array_ufunc__ = None  # NumPy arrays on the left defer to this class
    __array_priority__ = 1000

    def __init__(self, trace: Trace, number: int, spec: Spec) -> None:
        self.trace, self.number, self.spec = trace, number, spec

    shape = property(lambda self: self.spec.shape)
    ndim = property(lambda self: len(self.spec.shape))
    size = property(lambda self: int(np.prod(self.spec.shape)))
    dtype_name = property(lambda self: self.spec.dtype)

    @property
    def dtype(self) -> np.dtype[Any]:
        return np.dtype(DTYPES[self.spec.dtype])

    @property
    def mT(self) -> Symbolic:
        return self.trace.apply("matrix_transpose", self)

    @property
    def T(self) -> Symbolic:
        return (
            self.mT
            if self.ndim == 2
            else refuse(".T of other than two axes", "a matrix", f"{self.shape}", "use .mT")
        )

    def cast(self, dtype: str) -> Symbolic:
        if dtype == self.dtype_name:
            return self
        known = self.trace.constants.get(self.number)
        if known is not None:
            return self.trace.constant(ranges.cast(np, known, DTYPES[dtype]))
        return self.trace.apply("astype", self, dtype=dtype)

    def __array_namespace__(self, *, api_version: str | None = None) -> Any:
        return self.trace.namespace

    def __getitem__(self, index: Any) -> Symbolic:
        entries = list(index) if isinstance(index, tuple) else [index]
        if len(entries) == 1 and isinstance(entries[0], Symbolic):
            if entries[0].dtype_name == "bool":
                refuse(
                    "the shape of x[mask] depends on data",
                    "a fixed shape",
                    "a Boolean index",
                    "use xp.where(mask, x, ...)",
                )
            return self.trace.apply("take", self, entries[0], axis=0)
        return _getitem(self, entries)

    def __setitem__(self, index: Any, value: Any) -> None:
        refuse(
            "in-place write",
            "a new array",
            "x[...] = value",
            "build it with xp.concat, xp.stack or xp.where",
            in_every_engine=True,
        )

    def __bool__(self) -> bool:
        refuse(
            "Python branch on a traced value",
            "one flow for all values",
            "if, while, and, or, not, min() or max() on an array",
            "select with xp.where(condition, a, b), or split the stream with filter",
        )

    def __float__(self) -> float:
        refuse(
            "Python number from a traced value",
            "arrays throughout",
            "float(x) or math.f(x)",
            "use xp functions",
        )

    def __int__(self) -> int:
        refuse(
            "Python number from a traced value", "arrays throughout", "int(x)", "use xp.astype(x, xp.int64)"
        )

    def __index__(self) -> int:
        refuse(
            "Python index from a traced value",
            "a fixed index",
            "a value as index or size",
            "use xp.take(x, i)",
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        refuse(
            "NumPy function on a traced value",
            "functions of xp",
            "np.f(x)",
            "take xp as keyword parameter and call xp.f(x)",
        )

    def __len__(self) -> int:
        return int(self.shape[0])

    def __iter__(self) -> Iterator[Symbolic]:
        if not self.shape:
            refuse(
                "iteration over a scalar",
                "an array with an axis",
                "a scalar",
                "do not unpack it",
                in_every_engine=True,
            )
        return (self[i] for i in range(self.shape[0]))

    def __getattr__(self, name: str) -> NoReturn:
        if name.startswith("__"):
            raise AttributeError(name)
        hint = f"use xp.{name}(x)" if hasattr(np, name) else "use functions of xp"
        refuse(
            f"arrays have no attribute {name!r} in the array API",
            "the standard's attributes",
            f".{name}",
            hint,
            in_every_engine=not hasattr(np.ndarray, name) and not hasattr(np.float64, name),
        )

    def __repr__(self) -> str:
        return f"<Symbolic %{self.number} {self.dtype_name}{list(self.shape)}>"

    __hash__ = None  # type: ignore[assignment]


def _getitem(x: Symbolic, entries: list[Any]) -> Symbolic:
    """Basic indexing by whole numbers, slices, None and Ellipsis."""
    used = sum(e is not None and e is not Ellipsis for e in entries)
    if used > x.ndim:
        refuse(
            f"too many indices for shape {x.shape}",
            f"at most {x.ndim}",
            str(used),
            "drop some",
            in_every_engine=True,
        )
    if Ellipsis in [e for e in entries if e is Ellipsis]:
        at = next(i for i, e in enumerate(entries) if e is Ellipsis)
        entries[at : at + 1] = [slice(None)] * (x.ndim - used)
    else:
        entries = entries + [slice(None)] * (x.ndim - used)
    index: list[Any] = []
    for entry in entries:
        if entry is None:
            continue
        if isinstance(entry, slice):
            parts = (entry.start, entry.stop, entry.step)
            if any(isinstance(p, Symbolic) for p in parts):
                refuse(
                    "a slice with a traced bound", "fixed bounds", str(entry), "use xp.take with fixed size"
                )
            index.append([None if p is None else int(p) for p in parts])
        elif isinstance(entry, int | np.integer):
            index.append(int(entry))
        else:
            refuse(
                "this index is not supported",
                "whole numbers, slices, None, ...",
                repr(entry),
                "use xp.take(x, indices, axis=...)",
            )
    whole = all(e == [None, None, None] for e in index)
    out = x if whole else x.trace.apply("getitem", x, index=index)
    shape, sizes = [], iter(out.shape)
    for entry in entries:
        if entry is None:
            shape.append(1)
        elif isinstance(entry, slice):
            shape.append(next(sizes))
    return out if tuple(shape) == out.shape else out.trace.apply("reshape", out, shape=shape)


def _operator(op: str, swap: bool = False) -> Callable[..., Any]:
    def method(self: Symbolic, other: Any) -> Any:
        if not isinstance(other, Symbolic) and getattr(other, "__array_ufunc__", other) is None:
            return NotImplemented  # as NumPy's arrays do: the other class says what the operator means
        pair = (other, self) if swap else (self, other)
        return self.trace.apply(op, *pair)

    return method


for _name, _op in {
    "add": "add",
    "sub": "subtract",
    "mul": "multiply",
    "truediv": "divide",
    "floordiv": "floor_divide",
    "mod": "remainder",
    "pow": "pow",
    "matmul": "matmul",
    "and": "bitwise_and",
    "or": "bitwise_or",
    "xor": "bitwise_xor",
    "lshift": "bitwise_left_shift",
    "rshift": "bitwise_right_shift",
}.items():
    setattr(Symbolic, f"__{_name}__", _operator(_op))
    setattr(Symbolic, f"__r{_name}__", _operator(_op, swap=True))
for _name, _op in {
    "lt": "less",
    "le": "less_equal",
    "gt": "greater",
    "ge": "greater_equal",
    "eq": "equal",
    "ne": "not_equal",
}.items():
    setattr(Symbolic, f"__{_name}__", _operator(_op))
for _name, _op in {"neg": "negative", "pos": "positive", "abs": "abs", "invert": "bitwise_invert"}.items():
    setattr(Symbolic, f"__{_name}__", lambda self, _op=_op: self.trace.apply(_op, self))
refuse_in_place(Symbolic)
