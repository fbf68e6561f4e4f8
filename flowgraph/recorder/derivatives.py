"""Derivatives: a function's own lines, run on dual arrays.

`jacobian(f, x, xp)` hands f an array that knows how it changes, and a namespace that knows how each operation
passes a change on. There is no second model to keep equal to the first, and no error of a difference: the
derivative is that of the lines, to rounding. In a block it is recorded like anything else, so a Jacobian
is drawn, lowered and optimised with the rest; what of it is known to be zero is not computed.

Source: A. Griewank and A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, sec. 3.1 (forward mode).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, LoweringError
from flowgraph.recorder.dual import Dual
from flowgraph.recorder.dual_rules import RULES
from flowgraph.recorder.namespaces import NUMPY, solve_positive
from flowgraph.recorder.ops import OPS
from flowgraph.recorder.refusals import caller, refuse
from flowgraph.recorder.symbolic_namespace import namespace as symbolic
from flowgraph.recorder.tangents import LINALG, Tangent, plain, pruned, spread
from flowgraph.types import Array

__all__ = ["jacobian"]


MOST_APART = 40
"""Directions up to which each is recorded by itself, so that the optimiser sees what it does not change."""


def jacobian(
    f: Callable[..., Array], x: Array, xp: Any, *, along: Array | Sequence[Array] | None = None
) -> tuple[Array, Array]:
    """The value of f at x, and its derivative.

    Args:
        f: `f(x, xp) -> y`, on x (..., n), a point a row, and y (..., m), of each row its own. It must take
            its functions from the `xp` that it is handed; what else it needs, it closes over, and that counts
            as constant. It may itself call `jacobian`.
        x: real numbers (..., n).
        xp: the namespace of x, as a block is handed it.
        along: (n, k), constant or not: the derivative along these k directions, in place of along each of
            the n numbers. Without leading axes, or with those of x. Several such matrices are taken as beside
            each other; what directions of one do not change is then not computed for them.

    Returns:
        y (..., m), and dy/dx (..., m, n), or (..., m, k): entry (i, j) is how y_i changes with x_j. Where y
        has other axes, the derivative has those, and that of x behind them.

    Raises:
        LoweringError: where a line of f loses the derivative, or calls what is no operation of a pipeline.
        DeclarationError: where x is not of real numbers, or `along` does not fit.
    """
    x = xp.asarray(x)
    n = _needs_real(x)
    if along is None:
        parts = [xp.reshape(xp.eye(n, dtype=x.dtype), (n, *(1,) * (len(x.shape) - 1), n))]
    else:
        given = along if isinstance(along, list | tuple) else [along]
        parts = [_directions(xp.asarray(d), x, xp) for d in given]
    inner = Duals(xp)
    if len(parts) > 1 and not inner.sparse:  # zeros are not looked for: side by side they are one
        parts = [xp.concat(_alike(parts, xp), axis=0)]
    k = sum(d.shape[0] for d in parts)
    if inner.sparse and k <= MOST_APART:
        parts = [d[i : i + 1, ...] for d in parts for i in range(d.shape[0])]
    ends = [0, *itertools.accumulate(d.shape[0] for d in parts)]
    start = {tuple(range(a, b)): d for a, b, d in zip(ends, ends[1:], parts, strict=False)}
    y = f(inner.made(x, start), inner)
    if not isinstance(y, Dual) or y.xp is not inner:
        y = xp.asarray(y)
        kind = y.dtype if np.dtype(y.dtype).kind == "f" else x.dtype
        return y, xp.zeros((*y.shape, k), dtype=kind)
    return y.value, _assembled(y, k, xp)


def _needs_real(x: Any) -> int:
    """The last size of x."""
    if not x.shape or np.dtype(x.dtype).kind != "f":
        raise DeclarationError(
            "this cannot be differentiated by",
            path=caller(),
            expected="real numbers (..., n)",
            got=f"{np.dtype(x.dtype).name} of shape {tuple(x.shape)}",
            fix="give x an axis, and make it real with xp.astype(x, xp.float64)",
        )
    return int(x.shape[-1])


def _directions(along: Any, x: Any, xp: Any) -> Any:
    """The directions (k, ..., n) from the columns of (..., n, k)."""
    shape = tuple(along.shape)
    if len(shape) < 2 or shape[-2] != x.shape[-1] or shape[:-2] not in ((), tuple(x.shape[:-1])):
        raise DeclarationError(
            "the directions do not fit",
            path=caller(),
            expected=f"shape ({x.shape[-1]}, k), with no leading axes or those of x, {tuple(x.shape[:-1])}",
            got=f"shape {shape}",
            fix="give one direction a column",
        )
    rank = len(shape)
    front = xp.permute_dims(along, (rank - 1, *range(rank - 1)))
    ones = (1,) * (len(x.shape) - (rank - 1))
    return xp.reshape(front, (shape[-1], *ones, *front.shape[1:])) if ones else front


def _alike(parts: list[Any], xp: Any) -> list[Any]:
    """The parts of directions with axes of one size, but for the first."""
    sizes = [max(d.shape[a] for d in parts) for a in range(1, len(parts[0].shape))]
    return [spread(xp, d, sizes, range(len(sizes))) for d in parts]


def _assembled(y: Dual, k: int, xp: Any) -> Any:
    """The derivative (..., k) from the parts of a tangent."""
    shape, rank = y.shape, y.ndim
    sizes = [max(d.shape[1 + a] for d in y.tangent.values()) for a in range(rank)]
    place = {i: (key, row) for key in y.tangent for row, i in enumerate(key)}
    pieces, i = [], 0
    while i < k:
        end = i + 1
        if i in place:
            key, row = place[i]
            while end < k and place.get(end) == (key, row + end - i):
                end += 1
            d = spread(xp, y.tangent[key], sizes, range(rank))
            pieces.append(d if end - i == len(key) else d[row : row + end - i, ...])
        else:
            while end < k and end not in place:
                end += 1
            pieces.append(xp.zeros((end - i, *sizes), dtype=y.dtype))
        i = end
    whole = pieces[0] if len(pieces) == 1 else xp.concat(pieces, axis=0)
    last = xp.matrix_transpose(whole) if rank == 1 else xp.permute_dims(whole, (*range(1, rank + 1), 0))
    return last if tuple(last.shape) == (*shape, k) else xp.broadcast_to(last, (*shape, k))


class Duals:
    """The array-API namespace of dual arrays over another namespace; without a dual array it is that one.

    Args:
        below: of the values: NumPy, the symbolic one, or another of these.
    """

    def __init__(self, below: Any) -> None:
        self.below = NUMPY if below is np else below
        self.depth: int = below.depth + 1 if isinstance(below, Duals) else 1
        self.sparse: bool = below.sparse if isinstance(below, Duals) else below is symbolic
        """Whether zeros are looked for: where work is recorded, to be done many times."""
        self.linalg = _Linalg(self)

    def made(self, value: Any, tangent: Tangent) -> Any:
        """A dual array, in one precision; the value itself where it does not change."""
        if self.sparse:
            tangent = pruned(tangent)
        for key, d in tangent.items():
            if d.dtype != value.dtype:
                tangent = {**tangent, key: self.below.astype(d, value.dtype)}
        return Dual(self, value, tangent) if tangent else value

    def asarray(self, x: Any, /, *, dtype: Any = None) -> Any:
        """The array itself, or a new one."""
        if isinstance(x, Dual) and x.xp is self:
            return x if dtype is None else self.astype(x, dtype)
        if isinstance(x, list | tuple) and any(isinstance(a, Dual) for a in x):
            refuse(
                "an array from a list of arrays that are differentiated",
                "xp.stack",
                "xp.asarray([...])",
                "write xp.stack([...])",
                in_every_engine=True,
            )
        return self.below.asarray(x, dtype=dtype)

    def concat(self, arrays: Sequence[Any], /, *, axis: int = 0) -> Any:
        """Arrays one behind the other."""
        return _applied(self, "concat", arrays, {"axis": axis}, joined=True)

    def stack(self, arrays: Sequence[Any], /, *, axis: int = 0) -> Any:
        """Arrays of one shape along a new axis."""
        return _applied(self, "stack", arrays, {"axis": axis}, joined=True)

    def astype(self, x: Any, dtype: Any, /) -> Any:
        """x as another kind of number; a whole number has no derivative."""
        return _applied(self, "astype", [x], {"dtype": dtype}, placed=True)

    def reshape(self, x: Any, /, shape: tuple[int, ...]) -> Any:
        """The elements of x in another shape."""
        return _applied(self, "reshape", [x], {"shape": shape}, placed=True)

    def broadcast_to(self, x: Any, /, shape: tuple[int, ...]) -> Any:
        """x, repeated along axes."""
        return _applied(self, "broadcast_to", [x], {"shape": shape}, placed=True)

    def permute_dims(self, x: Any, /, axes: tuple[int, ...]) -> Any:
        """x with its axes in another order."""
        return _applied(self, "permute_dims", [x], {"axes": axes}, placed=True)

    def roll(self, x: Any, /, shift: int, *, axis: int | None = None) -> Any:
        """x with its elements moved on, those beyond the end to the start."""
        return _applied(self, "roll", [x], {"shift": shift, "axis": axis})

    def expand_dims(self, x: Any, /, *, axis: int = 0) -> Any:
        """x with an axis of size 1 more."""
        shape = list(x.shape)
        shape.insert(axis if axis >= 0 else axis + len(shape) + 1, 1)
        return self.reshape(x, tuple(shape))

    def squeeze(self, x: Any, /, axis: int | tuple[int, ...]) -> Any:
        """x without axes of size 1."""
        rank = len(x.shape)
        axes = {a % rank for a in ([axis] if isinstance(axis, int) else axis)}
        return self.reshape(x, tuple(n for i, n in enumerate(x.shape) if i not in axes))

    def clip(self, x: Any, /, min: Any = None, max: Any = None) -> Any:
        """x, brought to the nearest end of a range."""
        low = x if min is None else self.maximum(x, min)
        return low if max is None else self.minimum(low, max)

    def solve_positive(self, a: Any, b: Any, /) -> Any:
        """The solution of a x = b with a positive matrix."""
        if any(type(x) is Dual and x.xp is self for x in (a, b)):
            return _applied(self, "solve", [a, b], {"assume_a": "pos"})
        return solve_positive(a, b, self.below)

    def zeros_like(self, x: Any, /) -> Any:
        """Zeros of a shape and kind."""
        return self.below.zeros_like(x.value if isinstance(x, Dual) and x.xp is self else x)

    def ones_like(self, x: Any, /) -> Any:
        """Ones of a shape and kind."""
        return self.below.ones_like(x.value if isinstance(x, Dual) and x.xp is self else x)

    def __getattr__(self, name: str) -> Any:
        _need_listed(symbolic, name)
        found = getattr(self.below, name)
        setattr(self, name, found)
        return found


class _Linalg:
    """The `linalg` extension of dual arrays."""

    def __init__(self, duals: Duals) -> None:
        self._duals = duals

    def __getattr__(self, name: str) -> Any:
        _need_listed(symbolic.linalg, name)
        return getattr(self._duals, name)


def _need_listed(namespace: Any, name: str) -> None:
    """Refuse what is no operation, by line."""
    if name.startswith("__"):
        raise AttributeError(name)
    try:
        getattr(namespace, name)
    except LoweringError as error:
        error.in_every_engine = True
        raise


def _applied(
    duals: Duals,
    name: str,
    args: Sequence[Any],
    attrs: dict[str, Any],
    *,
    joined: bool = False,
    placed: bool = False,
) -> Any:
    """An operation by its rule, where an argument is a dual array of this namespace; else the one below.

    Args:
        duals: the namespace.
        name, args, attrs: of the operation.
        joined: whether it takes its arrays as one list.
        placed: whether it takes its attributes by their place.
    """
    own = [type(a) is Dual and a.xp is duals for a in args]
    if True in own:
        values = [a.value if mine else a for a, mine in zip(args, own, strict=True)]
        tangents = [a.tangent if mine else _NONE for a, mine in zip(args, own, strict=True)]
        return duals.made(*RULES[name](duals.below, values, tangents, **attrs))
    function = plain(duals.below, name)
    if joined:
        return function(args, **attrs)
    return function(*args, *attrs.values()) if placed else function(*args, **attrs)


_NONE: Tangent = {}


def _method(name: str) -> Callable[..., Any]:
    def call(self: Duals | _Linalg, *args: Any, **attrs: Any) -> Any:
        return _applied(self if isinstance(self, Duals) else self._duals, name, args, attrs)

    return call


def _refusing(name: str) -> Callable[..., Any]:
    def call(self: Duals, *args: Any, **attrs: Any) -> Any:
        if any(isinstance(a, Dual) for a in args):
            refuse(
                f"xp.{name} has no derivative",
                "operations on real numbers",
                f"xp.{name}(x)",
                "keep it outside of the function that is differentiated",
                in_every_engine=True,
            )
        return plain(self.below, name)(*args, **attrs)

    return call


for _name in OPS:
    if _name in LINALG:
        setattr(_Linalg, _name, _method(_name))
    elif not hasattr(Duals, _name):
        setattr(Duals, _name, _method(_name) if _name in RULES else _refusing(_name))
