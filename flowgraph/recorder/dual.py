"""The dual array: a value, and how it changes with the numbers that it is differentiated by.

A `Dual` has the look of an array: it takes the operators and the indices that an array takes, and an
operation on it makes both a new value and, by the rule of that operation, its new tangent. It belongs to the
namespace that its function was handed as `xp`; what is not of that namespace is a constant to it. What would
lose the derivative unseen, such as `float(x)` or a function of NumPy, is refused by line.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

import numpy as np

from flowgraph.recorder.refusals import refuse, refuse_in_place
from flowgraph.recorder.tangents import Tangent


class Dual:
    """An array with its tangent.

    Args:
        xp: the namespace of the function that is being differentiated.
        value: of any namespace below.
        tangent: see `tangents`.
    """

    __slots__ = ("tangent", "value", "xp")
    __array_ufunc__ = None  # arrays on the left, symbolic ones as well, defer to this class
    __array_priority__ = 2000

    def __init__(self, xp: Any, value: Any, tangent: Tangent) -> None:
        self.xp, self.value, self.tangent = xp, value, tangent

    shape = property(lambda self: tuple(self.value.shape))
    ndim = property(lambda self: len(self.value.shape))
    size = property(lambda self: int(np.prod(self.value.shape)))
    dtype = property(lambda self: self.value.dtype)

    @property
    def mT(self) -> Any:
        return self.xp.matrix_transpose(self)

    @property
    def T(self) -> Any:
        if self.ndim != 2:
            refuse(".T of other than two axes", "a matrix", f"{self.shape}", "use .mT", in_every_engine=True)
        return self.mT

    def __array_namespace__(self, *, api_version: str | None = None) -> Any:
        return self.xp

    def __getitem__(self, index: Any) -> Any:
        entries = list(index) if isinstance(index, tuple) else [index]
        if len(entries) == 1 and getattr(entries[0], "shape", None):
            if np.dtype(entries[0].dtype) == np.bool_:
                refuse(
                    "the shape of x[mask] depends on data",
                    "a fixed shape",
                    "a Boolean index",
                    "use xp.where(mask, x, ...)",
                    in_every_engine=True,
                )
            return self.xp.take(self, entries[0], axis=0)
        return self.xp.getitem(self, index=self._full(entries))

    def _full(self, entries: list[Any]) -> tuple[Any, ...]:
        """The index with one entry for each axis, and those that are None."""
        rank = len(self.value.shape)
        used = sum(e is not None and e is not Ellipsis for e in entries)
        if used > rank:
            refuse(
                f"too many indices for shape {self.shape}",
                f"at most {rank}",
                str(used),
                "drop some",
                in_every_engine=True,
            )
        at = next((i for i, e in enumerate(entries) if e is Ellipsis), len(entries))
        entries[at : at + 1] = [slice(None)] * (rank - used)
        return tuple(e if e is None or isinstance(e, slice) else operator.index(e) for e in entries)

    def __setitem__(self, index: Any, value: Any) -> None:
        refuse(
            "in-place write",
            "a new array",
            "x[...] = value",
            "build it with xp.concat, xp.stack or xp.where",
            in_every_engine=True,
        )

    def __array__(self, dtype: Any = None, copy: Any = None) -> Any:
        _needs_xp("a function of NumPy, or of another xp")

    def __bool__(self) -> bool:
        _needs_xp("if, while, and, or, not, min() or max() on an array")

    def __float__(self) -> float:
        _needs_xp("float(x) or math.f(x)")

    def __int__(self) -> int:
        _needs_xp("int(x)")

    def __index__(self) -> int:
        _needs_xp("a value as index or size")

    def __len__(self) -> int:
        return int(self.shape[0])

    def __iter__(self) -> Iterator[Any]:
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
        refuse(
            f"arrays have no attribute {name!r} in the array API",
            "the standard's attributes",
            f".{name}",
            f"use xp.{name}(x)" if hasattr(np, name) else "use functions of xp",
            in_every_engine=True,
        )

    def __repr__(self) -> str:
        return f"<Dual of {self.value!r} along {sorted(i for key in self.tangent for i in key)}>"

    __hash__ = None  # type: ignore[assignment]


def _needs_xp(got: str) -> NoReturn:
    refuse(
        "this loses the derivative",
        "functions of the xp that the differentiated function was handed",
        got,
        "take xp as parameter and call xp.f(x); select with xp.where(condition, a, b)",
        in_every_engine=True,
    )


def _operator(op: str, swap: bool = False) -> Callable[..., Any]:
    def method(self: Dual, other: Any) -> Any:
        # to an inner derivative the arrays of the outer one are constants
        inner = isinstance(other, Dual) and other.xp.depth > self.xp.depth
        apply = getattr(other.xp if inner else self.xp, op)
        return apply(other, self) if swap else apply(self, other)

    return method


_BINARY = {
    "add": "add",
    "sub": "subtract",
    "mul": "multiply",
    "truediv": "divide",
    "floordiv": "floor_divide",
    "mod": "remainder",
    "pow": "pow",
    "matmul": "matmul",
}
_COMPARED = {
    "lt": "less",
    "le": "less_equal",
    "gt": "greater",
    "ge": "greater_equal",
    "eq": "equal",
    "ne": "not_equal",
}
for _name, _op in _BINARY.items():
    setattr(Dual, f"__{_name}__", _operator(_op))
    setattr(Dual, f"__r{_name}__", _operator(_op, swap=True))
for _name, _op in _COMPARED.items():
    setattr(Dual, f"__{_name}__", _operator(_op))
for _name, _op in {"neg": "negative", "pos": "positive", "abs": "abs"}.items():
    setattr(Dual, f"__{_name}__", lambda self, _op=_op: getattr(self.xp, _op)(self))
refuse_in_place(Dual)
