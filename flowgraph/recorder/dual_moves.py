"""Derivatives of what moves, joins and sums: linear in its arrays, so the tangents go the same way.

The axes of a tangent's arrays stand behind that of the directions. An axis along which a change is the same
may have size 1 there; it is brought to its size where the operation needs the elements. A reduction that
chooses (`max`, `sort`) takes the change of what it chose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph.recorder.tangents import Made, Rule, Tangent, aligned, lifted, mapped, plain, shape_of, spread


def _axes(axis: Any, rank: int) -> list[int]:
    """The axes meant, counted from the left; None: all."""
    chosen = range(rank) if axis is None else [axis] if isinstance(axis, int) else axis
    return [a % rank for a in chosen]


def _along(name: str, default: Any = None) -> Rule:
    """Linear along some axes: of the tangent, the same axes behind that of the directions."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], **attrs: Any) -> Made:
        (x,), (t,) = values, tangents
        shape = shape_of(x)
        chosen = _axes(attrs.get("axis", default), len(shape))
        axis = 1 + chosen[0] if len(chosen) == 1 else tuple(1 + a for a in chosen)
        behind = {**attrs, "axis": axis}
        function = plain(xp, name)
        if not chosen:  # a scalar
            return function(x, **attrs), t
        return function(x, **attrs), mapped(t, lambda d: function(spread(xp, d, shape, chosen), **behind))

    return rule


def _roll(
    xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, shift: Any, axis: Any = None
) -> Made:
    (x,), (t,) = values, tangents
    shape = shape_of(x)
    if axis is not None:
        return _along("roll")(xp, values, tangents, shift=shift, axis=axis)
    flat = mapped(t, lambda d: xp.reshape(spread(xp, d, shape, range(len(shape))), (d.shape[0], -1)))
    rolled = mapped(flat, lambda d: xp.reshape(xp.roll(d, shift, axis=1), (d.shape[0], *shape)))
    return xp.roll(x, shift), rolled


def _local(name: str) -> Rule:
    """Linear, and the same for a tangent as for a value."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        function = plain(xp, name)
        return function(values[0]), mapped(tangents[0], function)

    return rule


def _matrices(name: str) -> Rule:
    """Linear in the last two axes."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], **attrs: Any) -> Made:
        (x,), (t,) = values, tangents
        shape, function = shape_of(x), plain(xp, name)
        last = range(max(len(shape) - 2, 0), len(shape))
        return function(x, **attrs), mapped(t, lambda d: function(spread(xp, d, shape, last), **attrs))

    return rule


def _astype(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, dtype: Any) -> Made:
    real = np.dtype(dtype).kind == "f"
    found = xp.astype(values[0], dtype)
    return found, mapped(tangents[0], lambda d: xp.astype(d, dtype)) if real else {}


def _reshape(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, shape: Any) -> Made:
    (x,), (t,) = values, tangents
    old, y = shape_of(x), xp.reshape(x, shape)
    new = shape_of(y)
    kept = 0  # leading axes that stay what they are
    while kept < min(len(old), len(new)) and old[kept] == new[kept]:
        kept += 1

    def moved(d: Any) -> Any:
        wide = spread(xp, d, old, range(kept, len(old)))
        return xp.reshape(wide, (*wide.shape[: 1 + kept], *new[kept:]))

    return y, mapped(t, moved)


def _permute(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, axes: Any) -> Made:
    order = (0, *(1 + a % len(axes) for a in axes))
    return xp.permute_dims(values[0], axes), mapped(tangents[0], lambda d: xp.permute_dims(d, order))


def _broadcast_to(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, shape: Any) -> Made:
    y = xp.broadcast_to(values[0], shape)
    return y, mapped(tangents[0], lambda d: lifted(xp, d, len(shape_of(y))))


_ALL = slice(None)


def _getitem(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, index: Any) -> Made:
    (x,), (t,) = values, tangents
    shape = shape_of(x)

    def piece(d: Any) -> Any:
        if d.shape[1:] == shape:
            return d[(_ALL, *index)]
        entries, axis = [_ALL], 0
        for e in index:
            if e is not None:
                if d.shape[1 + axis] != shape[axis]:  # the same all along
                    e = 0 if isinstance(e, int) else slice(0, min(1, len(range(shape[axis])[e])))
                axis += 1
            entries.append(e)
        return d[tuple(entries)]

    return x[index], mapped(t, piece)


def _take(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, axis: int = 0) -> Made:
    x, places = values
    shape = shape_of(x)
    along = axis % len(shape)
    found = mapped(tangents[0], lambda d: xp.take(spread(xp, d, shape, [along]), places, axis=1 + along))
    return xp.take(x, places, axis=axis), found


def _concat(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, axis: int = 0) -> Made:
    shapes = [shape_of(v) for v in values]
    rank = len(shapes[0])
    along = axis % rank

    def joined(key: tuple[int, ...], found: list[Any]) -> Any:
        known = [d for d in found if d is not None]
        rest = [max(d.shape[1 + a] for d in known) for a in range(rank)]
        pieces = []
        for d, shape in zip(found, shapes, strict=True):
            sizes = [shape[a] if a == along else rest[a] for a in range(rank)]
            if d is None:
                d = xp.zeros((len(key), *sizes), dtype=known[0].dtype)
            pieces.append(spread(xp, d, sizes, range(rank)))
        return xp.concat(pieces, axis=1 + along)

    whole = {key: joined(key, found) for key, found in aligned(xp, *tangents)}
    return xp.concat(list(values), axis=axis), whole


def _stack(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, axis: int = 0) -> Made:
    shape = shape_of(values[0])
    at = axis % (len(shape) + 1)
    wide = [(*shape[:at], 1, *shape[at:])] * len(values)
    parts = [
        mapped(t, lambda d: xp.reshape(d, (*d.shape[: 1 + at], 1, *d.shape[1 + at :]))) for t in tangents
    ]
    shells = [xp.reshape(xp.asarray(v), s) for v, s in zip(values, wide, strict=True)]
    return xp.stack(list(values), axis=axis), _concat(xp, shells, parts, axis=at)[1]


def _one_axis(rule: Callable[[Any, Any, Tangent], Tangent], name: str) -> Rule:
    """A reduction along any axes, from one along the last axis."""

    def whole(
        xp: Any,
        values: Sequence[Any],
        tangents: Sequence[Tangent],
        *,
        axis: Any = None,
        keepdims: bool = False,
    ) -> Made:
        (x,), (t,) = values, tangents
        shape = shape_of(x)
        rank = len(shape)
        gone = _axes(axis, rank)
        y = plain(xp, name)(x, axis=axis, keepdims=keepdims)
        if not gone:
            return y, t
        kept = [a for a in range(rank) if a not in gone]
        flat = (*(shape[a] for a in kept), int(np.prod([shape[a] for a in gone])))
        order = (*kept, *gone)

        def last(d: Any) -> Any:
            wide = xp.permute_dims(spread(xp, d, shape, range(rank)), (0, *(1 + a for a in order)))
            return xp.reshape(wide, (d.shape[0], *flat))

        rows = xp.reshape(xp.permute_dims(x, order) if rank > 1 else x, flat)
        found = rule(xp, rows, mapped(t, last))
        return y, mapped(found, lambda d: xp.reshape(d, (d.shape[0], *shape_of(y))))

    return whole


def _of_extreme(place: str) -> Callable[[Any, Any, Tangent], Tangent]:
    """The change of the first element that is the largest, or smallest."""

    def rule(xp: Any, x: Any, t: Tangent) -> Tangent:
        n = shape_of(x)[-1]
        at = getattr(xp, place)(x, axis=-1)
        here = xp.astype(at[..., None] == xp.arange(n), x.dtype)
        return mapped(t, lambda d: xp.sum(d * here, axis=-1))

    return rule


def _of_product(xp: Any, x: Any, t: Tangent) -> Tangent:
    """Each change times the product of the other elements, zeros among them or not."""
    n = shape_of(x)[-1]
    before, after = [xp.ones_like(x[..., 0])], [xp.ones_like(x[..., 0])]
    for i in range(n - 1):
        before.append(before[-1] * x[..., i])
        after.append(after[-1] * x[..., n - 1 - i])
    others = xp.stack([b * a for b, a in zip(before, after[::-1], strict=True)], axis=-1)
    return mapped(t, lambda d: xp.sum(d * others, axis=-1))


def _sort(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, axis: int = -1) -> Made:
    (x,), (t,) = values, tangents
    shape = shape_of(x)
    along = axis % len(shape)
    order = xp.argsort(x, axis=axis)
    # row i of the permutation says which element came to place i
    swap = [*(a for a in range(len(shape)) if a != along), along]
    back = [swap.index(a) for a in range(len(shape))]
    places = xp.permute_dims(order, tuple(swap)) if len(shape) > 1 else order
    moves = xp.astype(places[..., None] == xp.arange(shape[along]), x.dtype)

    def sorted_change(d: Any) -> Any:
        wide = spread(xp, d, shape, range(len(shape)))
        columns = xp.permute_dims(wide, (0, *(1 + a for a in swap)))[..., None]
        return xp.permute_dims((moves @ columns)[..., 0], (0, *(1 + a for a in back)))

    return xp.sort(x, axis=axis), mapped(t, sorted_change)


MOVES: dict[str, Rule] = {
    **{name: _local(name) for name in ("negative", "positive", "materialise")},
    "astype": _astype,
    **{name: _along(name) for name in ("sum", "mean", "flip", "cumulative_sum")},
    "roll": _roll,
    "prod": _one_axis(_of_product, "prod"),
    "max": _one_axis(_of_extreme("argmax"), "max"),
    "min": _one_axis(_of_extreme("argmin"), "min"),
    "sort": _sort,
    "concat": _concat,
    "stack": _stack,
    **{name: _matrices(name) for name in ("matrix_transpose", "tril", "triu")},
    "permute_dims": _permute,
    "reshape": _reshape,
    "broadcast_to": _broadcast_to,
    "getitem": _getitem,
    "take": _take,
}
"""The rules by name."""
