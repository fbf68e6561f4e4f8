"""Each operation over many ticks: arrays whose last axis is the ticks, or 1 for what is the same in all.

Element by element an operation is itself, for shapes are matched from the last axis on. The others are told
which axes they now work on; the few for which NumPy has no such form go row by row.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Spec, bound_attrs
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

Rule = Callable[..., Any]
"""`(spec of the result, arrays, attributes) -> array`."""


def bound(i: Instruction, real: Any) -> Callable[..., Any]:
    """What an instruction does, as a function of arrays over ticks."""
    attrs = bound_attrs(i.op, i.attrs, real)
    if OPS[i.op].local:
        return partial(OPS[i.op].run, NUMPY, **attrs)
    rule = _RULES.get(i.op)
    return partial(row_by_row, i, real) if rule is None else partial(rule, i.spec, **attrs)


def at_one_tick(i: Instruction, real: Any) -> Callable[..., Any]:
    """What an instruction does, as a function of the arrays of one tick."""
    return partial(OPS[i.op].run, NUMPY, **bound_attrs(i.op, i.attrs, real))


def row_by_row(i: Instruction, real: Any, *xs: Any) -> Any:
    """An operation tick by tick."""
    run, ticks = at_one_tick(i, real), _ticks(xs)
    rows = [_first(_full(x, ticks)) for x in xs]
    kind = real if i.spec.dtype == "real" else DTYPES[i.spec.dtype]
    found = np.array([run(*row) for row in zip(*rows, strict=True)], kind)
    return _last(found.reshape(ticks, *i.spec.shape))


def _ticks(xs: Any) -> int:
    return next((x.shape[-1] for x in xs if x.shape[-1] != 1), 1)


def _full(x: Any, ticks: int) -> Any:
    return np.broadcast_to(x, (*x.shape[:-1], ticks))


def _first(x: Any) -> Any:
    """With the ticks first, each row in one piece, as compiled code of NumPy likes it."""
    return np.ascontiguousarray(np.moveaxis(x, -1, 0))


def _last(x: Any) -> Any:
    return np.ascontiguousarray(np.moveaxis(x, 0, -1))


def _inner(axis: Any, rank: int) -> Any:
    """Axes of an array of `rank` axes, where one more comes after them; None: all."""
    if axis is None:
        return tuple(range(rank))
    return axis % max(rank, 1) if isinstance(axis, int) else tuple(a % rank for a in axis)


def _reduce(name: str) -> Rule:
    def run(spec: Spec, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return getattr(NUMPY, name)(x, axis=_inner(axis, x.ndim - 1), keepdims=keepdims)

    return run


def _single(name: str) -> Rule:
    def run(spec: Spec, x: Any, *, axis: int | None = None) -> Any:
        flat = x.reshape(-1, x.shape[-1]) if axis is None else x
        return getattr(NUMPY, name)(flat, axis=0 if axis is None else _inner(axis, x.ndim - 1))

    return run


def _along(name: str) -> Rule:
    def run(spec: Spec, x: Any, *, axis: Any = -1) -> Any:
        return getattr(NUMPY, name)(x, axis=_inner(axis, x.ndim - 1))

    return run


def _flip(spec: Spec, x: Any, *, axis: Any = None) -> Any:
    return np.flip(x, axis=_inner(axis, x.ndim - 1))


def _roll(spec: Spec, x: Any, *, shift: Any, axis: Any = None) -> Any:
    if axis is None:
        return np.roll(x.reshape(-1, x.shape[-1]), shift, axis=0).reshape(x.shape)
    return np.roll(x, shift, axis=_inner(axis, x.ndim - 1))


def _join(name: str) -> Rule:
    def run(spec: Spec, *xs: Any, axis: int = 0) -> Any:
        ticks = _ticks(xs)
        return getattr(np, name)([_full(x, ticks) for x in xs], axis=axis % len(spec.shape))

    return run


def _matmul(spec: Spec, a: Any, b: Any) -> Any:
    """A product with a matrix that is the same in all ticks is one product with all of them."""
    if a.shape[-1] == 1 and a.ndim == 3:  # (m, k) by (k, ...), which is (k, ... ticks)
        if b.ndim == 2:
            return a[..., 0] @ b
        if b.ndim == 3:
            return (a[..., 0] @ b.reshape(len(b), -1)).reshape(len(a), *b.shape[1:])
    if b.shape[-1] == 1 and b.ndim == 3 and a.ndim == 2:
        return b[..., 0].T @ a
    left, right = _first(a), _first(b)
    left = left[:, None, :] if a.ndim == 2 else left
    right = right[:, :, None] if b.ndim == 2 else right
    found = np.matmul(*_same_rank(left, right))
    found = found[..., 0] if b.ndim == 2 else found
    found = found[..., 0, :] if a.ndim == 2 and b.ndim > 2 else found[..., 0] if a.ndim == 2 else found
    return _last(found)


def _same_rank(a: Any, b: Any) -> tuple[Any, Any]:
    """Stacks of matrices, ticks first, with as many axes of stacking."""
    rank = max(a.ndim, b.ndim)
    filled = (x.reshape(len(x), *(1,) * (rank - x.ndim), *x.shape[1:]) for x in (a, b))
    left, right = filled
    return left, right


def _transpose(spec: Spec, x: Any) -> Any:
    return x.swapaxes(-2, -3)


def _half(name: str) -> Rule:
    def run(spec: Spec, x: Any, *, k: int = 0) -> Any:
        kept = getattr(np, name)(np.ones(x.shape[-3:-1], bool), k)
        return np.where(kept[..., None], x, x.dtype.type(0))

    return run


def _cholesky(spec: Spec, x: Any) -> Any:
    return _last(NUMPY.linalg.cholesky(_first(x)))


def _solve(spec: Spec, a: Any, b: Any, *, assume_a: str = "gen") -> Any:
    left, right = _first(a), _first(b)
    if b.ndim == 2:
        return _last(NUMPY.linalg.solve(*_same_rank(left, right[..., None]))[..., 0])
    return _last(NUMPY.linalg.solve(*_same_rank(left, right)))


def _cross(spec: Spec, a: Any, b: Any) -> Any:
    (a0, a1, a2), (b0, b1, b2) = ([x[..., k, :] for k in range(3)] for x in (a, b))
    parts = (a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0)
    return np.stack(np.broadcast_arrays(*parts), axis=-2)


def _vecdot(spec: Spec, a: Any, b: Any) -> Any:
    products = a * b
    return products.sum(axis=-2, dtype=products.dtype)


def _outer(spec: Spec, a: Any, b: Any) -> Any:
    return a[:, None] * b[None]


def _permute(spec: Spec, x: Any, *, axes: list[int]) -> Any:
    return np.permute_dims(x, (*axes, len(axes)))


def _reshape(spec: Spec, x: Any, *, shape: Any) -> Any:
    return x.reshape(*spec.shape, x.shape[-1])


def _broadcast_to(spec: Spec, x: Any, *, shape: Any) -> Any:
    return np.broadcast_to(x, (*spec.shape, x.shape[-1]))


def _searchsorted(spec: Spec, x: Any, v: Any, *, side: str = "left") -> Any:
    if x.shape[-1] == 1:
        return np.searchsorted(x[..., 0], v, side=side)  # type: ignore[call-overload]
    ticks = range(_ticks((x, v)))
    v = _full(v, len(ticks))
    return _last(np.stack([np.searchsorted(x[..., k], v[..., k], side=side) for k in ticks]))  # type: ignore[call-overload]


def _take(spec: Spec, x: Any, indices: Any, *, axis: int) -> Any:
    along = axis % (x.ndim - 1)
    if indices.shape[-1] == 1:
        return np.take(x, indices[..., 0], axis=along, mode="clip")
    if x.shape[-1] == 1:
        found = np.take(x[..., 0], indices, axis=along, mode="clip")
        return np.moveaxis(found, along + indices.ndim - 1, -1)
    entries = np.moveaxis(x, along, 0)
    rest = entries.shape[1:-1]
    where = np.clip(indices, 0, len(entries) - 1)
    where = where.reshape(*indices.shape[:-1], *(1,) * len(rest), indices.shape[-1])
    found = entries[(where, *np.ogrid[tuple(slice(n) for n in (*rest, x.shape[-1]))])]
    places = range(indices.ndim - 1)
    return np.moveaxis(found, tuple(places), tuple(k + along for k in places))


_RULES: dict[str, Rule] = {
    **{name: _reduce(name) for name in ("sum", "prod", "max", "min", "mean", "any", "all")},
    **{name: _single(name) for name in ("argmax", "argmin")},
    **{name: _along(name) for name in ("sort", "argsort", "cumulative_sum")},
    **{name: _join(name) for name in ("concat", "stack")},
    **{name: _half(name) for name in ("tril", "triu")},
    "flip": _flip,
    "roll": _roll,
    "matmul": _matmul,
    "matrix_transpose": _transpose,
    "cholesky": _cholesky,
    "solve": _solve,
    "cross": _cross,
    "vecdot": _vecdot,
    "outer": _outer,
    "permute_dims": _permute,
    "reshape": _reshape,
    "broadcast_to": _broadcast_to,
    "getitem": lambda spec, x, *, index: OPS["getitem"].run(NUMPY, x, index=index),
    "searchsorted": _searchsorted,
    "take": _take,
}
