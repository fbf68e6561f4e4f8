"""The parts of a state by name: `x.position` and `x.heading` in place of slices.

A function of a state is handed a `View`: an array whose last axis holds the parts of a `StateSpace`, and that
gives each by its name, all rows at once. It adds and multiplies as the array does; `x[...]` is the array
itself. A function that changes some parts returns `x.replace(speed=...)`; one that moves all of them,
`SPACE.plus(x, velocity=..., dt=dt)`.
"""

from __future__ import annotations

import operator
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph import Array
from flowgraph.errors import DeclarationError, UnknownNameError

if TYPE_CHECKING:
    from flowgraph.blocks.geometry.manifold import StateSpace

__all__ = ["View", "array_of", "joined", "stacked_parts"]

_OWN = ("array", "dtype", "mT", "ndim", "replace", "shape", "space", "xp")
"""Attributes of a view, which no part can be called."""


class View:
    """States (..., size) with the names of their parts.

    Args:
        array: of the states, one a row.
        space: with names.
        xp: the array's namespace.
    """

    __slots__ = ("array", "space", "xp")
    __array_ufunc__ = None  # NumPy arrays on the left defer to this class

    def __init__(self, array: Array, space: StateSpace, xp: Any) -> None:
        self.array, self.space, self.xp = array, space, xp

    shape = property(lambda self: self.array.shape)
    ndim = property(lambda self: len(self.array.shape))
    dtype = property(lambda self: self.array.dtype)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        names = self.space.names
        if name not in names:
            raise UnknownNameError("part of the state", name, names, path="x")
        part, at, _ = self.space.places()[names.index(name)]
        inside = self.array[..., at]
        return PartView(inside, part.fields) if part.fields else inside

    def __getitem__(self, index: Any) -> Array:
        return self.array[index]

    def replace(self, **parts: Any) -> View:
        """These states with some parts exchanged, each (..., size of the part)."""
        for name in parts:
            if name not in self.space.names:
                raise UnknownNameError("part of the state", name, self.space.names, path="x.replace")
        kept = {name: array_of(getattr(self, name)) for name in self.space.names if name not in parts}
        return View(joined(self.space, kept | parts, self.array, self.xp, tangent=False), self.space, self.xp)

    def __array__(self, *_: Any, **__: Any) -> Any:
        raise DeclarationError(
            "a function of arrays is given a state with named parts",
            path="x",
            expected="an array",
            got=f"the whole state, {self.space}",
            fix="give it a part, such as x." + self.space.names[0] + ", or the numbers of all: x[...]",
        )

    def __repr__(self) -> str:
        return f"<View of {self.space}: {self.array!r}>"


class PartView:
    """A part that has parts of its own, such as the position of a pose; else an array."""

    __slots__ = ("array", "fields")
    __array_ufunc__ = None

    def __init__(self, array: Array, fields: Sequence[tuple[str, slice]]) -> None:
        self.array, self.fields = array, dict(fields)

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        if name not in self.fields:
            raise UnknownNameError("part of the state", name, self.fields, path="x")
        return self.array[..., self.fields[name]]

    def __getitem__(self, index: Any) -> Array:
        return self.array[index]


def _operated(name: str, swap: bool) -> Any:
    function = getattr(operator, name)

    def method(self: View, other: Any) -> Array:
        other = array_of(other)
        return function(other, self.array) if swap else function(self.array, other)

    return method


for _name in ("add", "sub", "mul", "truediv", "matmul"):
    setattr(View, f"__{_name}__", _operated(_name, False))
    setattr(View, f"__r{_name}__", _operated(_name, True))
setattr(View, "__neg__", lambda self: -self.array)  # noqa: B010 (as those above)


def array_of(x: Any) -> Array:
    """The array of a view; anything else as it is."""
    return x.array if isinstance(x, View | PartView) else x


def stacked_parts(parts: Any, like: Array, xp: Any) -> Array:
    """Arrays (..., n) after each other along the last axis; where one lacks it, it is one number a row."""
    arrays = [_last_axis(array_of(p), 1, len(like.shape) - 1, like.dtype, xp) for p in parts]
    lead = np.broadcast_shapes(*(tuple(a.shape[:-1]) for a in arrays))
    return xp.concat([_rows(a, lead, xp) for a in arrays], axis=-1)


def joined(space: StateSpace, given: Any, like: Array, xp: Any, *, tangent: bool) -> Array:
    """The parts of a state, or of a tangent vector, of all `space` as one array (..., size or tangent).

    Args:
        given: of each part in order, or by name; a name that is left out is at rest.
        like: (..., size), a state of the same rows.
        tangent: whether the parts are of a tangent vector.

    Raises:
        DeclarationError: for too few or too many parts, or one of another size; UnknownNameError: for a name
            that no part has.
    """
    labels = space.names or tuple(map(str, range(len(space.parts))))
    if isinstance(given, Mapping):
        for name in given:
            if name not in labels:
                raise UnknownNameError("part of the state", name, labels, path="StateSpace")
        rest = {
            n: np.zeros(p.tangent) if tangent else p.rest for n, p in zip(labels, space.parts, strict=True)
        }
        given = [given.get(name, rest[name]) for name in labels]
    parts = [given] if len(labels) == 1 and not isinstance(given, tuple | list) else given
    if not isinstance(parts, tuple | list) or len(parts) != len(labels):
        raise DeclarationError(
            "these are not the parts of the state",
            path="StateSpace",
            expected=f"one for each of {', '.join(labels)}",
            got=f"{len(parts)} parts" if isinstance(parts, tuple | list) else type(parts).__name__,
            fix="give each part in order, or those that move by name: velocity={"
            + f'"{labels[0]}": ...'
            + "}",
        )
    wanted = [p.tangent if tangent else p.size for p in space.parts]
    arrays = [
        _last_axis(array_of(part), n, len(like.shape) - 1, like.dtype, xp)
        for part, n in zip(parts, wanted, strict=True)
    ]
    for array, n, label in zip(arrays, wanted, labels, strict=True):
        if array.shape[-1] != n:
            raise DeclarationError(
                f"{label!r} has another number of entries",
                path=f"StateSpace.{label}",
                expected=f"{n} along the last axis",
                got=f"shape {tuple(array.shape)}",
                fix="give it one number for each direction of the part",
            )
    lead = np.broadcast_shapes(tuple(like.shape[:-1]), *(tuple(a.shape[:-1]) for a in arrays))
    return xp.concat([_rows(a, lead, xp) for a in arrays], axis=-1)


def _last_axis(array: Any, n: int, rows: int, kind: Any, xp: Any) -> Array:
    """With a last axis, which one number may lack; a number alone stands for all n."""
    if isinstance(array, int | float | np.ndarray | np.generic | list | tuple):
        array = xp.asarray(array, dtype=kind)
    if not array.shape and n != 1:
        return xp.broadcast_to(array, (n,))
    return array[..., None] if n == 1 and len(array.shape) <= rows else array


def _rows(array: Array, lead: tuple[int, ...], xp: Any) -> Array:
    shape = (*lead, array.shape[-1])
    return array if tuple(array.shape) == shape else xp.broadcast_to(array, shape)


def need_names(names: Iterable[str]) -> None:
    """Refuse a part that is called as an attribute of arrays is."""
    for name in names:
        if name in _OWN or name.startswith("_"):
            raise DeclarationError(
                "a part cannot be called this",
                path=f"StateSpace.{name}",
                expected="a name other than " + ", ".join(_OWN),
                got=repr(name),
                fix="choose another name: x." + name + " is an attribute of every array",
            )
