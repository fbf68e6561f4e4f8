"""The derivative of each operation of a pipeline: one rule an operation, in the order of the table of `ops`.

A rule is handed the values and the tangents of the arguments, and gives the value and the tangent of the
result. What is constant from place to place (a comparison, a rounding, an index) has no tangent.

Where a value is finite, so is its derivative: at a point at which a function has a kink, the rule takes a
slope between those on both sides (0 for `abs` and `hypot` at 0), a guard such as `maximum(x, 1e-30)` or
`clip` counts as holding where its bound is met, and where the slope has no bound (`sqrt` at 0, `acos` at 1)
it is a very large number, so that a change of 0 stays 0.

Source: A. Griewank and A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, secs. 2.2, 3.1, 14 (kinks);
for matrices M. Giles, "Collected matrix derivative results for forward and reverse mode algorithmic
differentiation", 2008, and I. Murray, "Differentiation of the Cholesky decomposition", arXiv:1602.07527, 2016.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph.recorder.tangents import Tangent, added, aligned, lifted, mapped, spread

Made = tuple[Any, Tangent]
Rule = Callable[..., Made]

LEAST = 1e-30
"""In place of 0 under a division whose numerator is 0 there too."""

_LINALG = ("cholesky", "solve", "cross", "vecdot", "outer")


def plain(xp: Any, name: str) -> Any:
    """The function of that name in the namespace below."""
    return getattr(xp.linalg if name in _LINALG else xp, name)


def shape_of(x: Any) -> tuple[int, ...]:
    """The shape of an array or number."""
    return tuple(getattr(x, "shape", ()))


# -- element by element ----------------------------------------------------------------------------------


def _constant(name: str) -> Rule:
    """The same from place to place: no tangent."""
    return lambda xp, values, tangents, **attrs: (plain(xp, name)(*values, **attrs), {})


def _unary(name: str, slope: Callable[[Any, Any, Any], Any]) -> Rule:
    """`slope(xp, x, y)`: dy/dx, given x and y = f(x)."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        (x,), (t,) = values, tangents
        y = plain(xp, name)(x)
        g = slope(xp, x, y)
        return y, mapped(t, lambda d: d * g)

    return rule


def _weighted(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], slopes: Sequence[Any]) -> Tangent:
    """Sum of slope times tangent over the arguments of an operation element by element.

    A slope is called when its argument has a tangent; None in place of it is 1.
    """
    rank = max(len(shape_of(v)) for v in values)
    out: Tangent = {}
    for t, slope in zip(tangents, slopes, strict=True):
        if t:
            g = None if slope is None else slope()
            wide = mapped(t, lambda d: lifted(xp, d, rank))
            out = added(xp, out, wide if g is None else mapped(wide, lambda d, g=g: d * g))
    return out


def _binary(name: str, slopes: Callable[..., tuple[Any, Any]]) -> Rule:
    """`slopes(xp, a, b, y)`: two functions that give dy/da and dy/db when they are asked for."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        y = plain(xp, name)(*values)
        return y, _weighted(xp, values, tangents, slopes(xp, *values, y))

    return rule


def _multiply(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    if a is b and tangents[0] is tangents[1]:
        return xp.multiply(a, b), mapped(tangents[0], lambda d: d * (2.0 * a))
    return xp.multiply(a, b), _weighted(xp, values, tangents, (lambda: b, lambda: a))


def _divide(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    y = xp.divide(a, b)
    inverse = xp.divide(1.0, b)
    return y, _weighted(xp, values, tangents, (lambda: inverse, lambda: -(y * inverse)))


def _pow(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    x, p = values
    y = xp.pow(x, p)

    def by_base() -> Any:
        if not shape_of(p) and isinstance(p, int | float | np.generic | np.ndarray):
            known = float(p)
            if known == 2.0:
                return 2.0 * x
            inside = x if known >= 1.0 or known <= 0.0 else xp.maximum(x, LEAST)
            return 0.0 * y if known == 0.0 else p * xp.pow(inside, p - 1)
        # p x^(p - 1), which at x = 0 has no bound where p < 1
        return p * xp.pow(xp.where((x == 0.0) & (p < 1.0), LEAST, x), p - 1.0)

    def by_power() -> Any:
        return y * xp.log(xp.where(x > 0.0, x, 1.0))

    return y, _weighted(xp, values, tangents, (by_base, by_power))


def _extreme(name: str, wins: str) -> Rule:
    """`maximum`, `minimum`: the change of the one that wins; at a tie a constant does, else the first."""

    def rule(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
        a, b = values
        if not tangents[0]:
            first = getattr(xp, wins + "_equal")(a, b)
        else:
            first = getattr(xp, wins + ("_equal" if tangents[1] else ""))(a, b)
        return plain(xp, name)(a, b), _chosen(xp, first, values, tangents)

    return rule


def _chosen(xp: Any, first: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Tangent:
    """The tangent of `where(first, a, b)`."""
    rank = max(len(shape_of(v)) for v in (first, *values))
    a, b = (mapped(t, lambda d: lifted(xp, d, rank)) for t in tangents)
    return {
        key: xp.where(first, 0.0 if d is None else d, 0.0 if e is None else e)
        for key, (d, e) in aligned(xp, a, b)
    }


def _where(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    condition, a, b = values
    return xp.where(condition, a, b), _chosen(xp, condition, (a, b), tangents[1:])


def _remainder_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    return None, lambda: -xp.floor_divide(a, b)


def _nonzero(xp: Any, x: Any) -> Any:
    return xp.where(x == 0.0, 1.0, x)


def _atan2_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    inverse = 1.0 / _nonzero(xp, a * a + b * b)
    return (lambda: b * inverse), (lambda: -(a * inverse))


def _hypot_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    inverse = 1.0 / _nonzero(xp, y)
    return (lambda: a * inverse), (lambda: b * inverse)


def _copysign_slopes(xp: Any, a: Any, b: Any, y: Any) -> tuple[Any, Any]:
    return (lambda: xp.sign(a) * xp.copysign(1.0, b)), (lambda: 0.0)


def _inverse_root(xp: Any, square: Any) -> Any:
    """1 / sqrt, very large at 0."""
    return 1.0 / xp.maximum(xp.sqrt(square), LEAST)


_SLOPES: dict[str, Callable[[Any, Any, Any], Any]] = {
    "abs": lambda xp, x, y: xp.sign(x),
    "square": lambda xp, x, y: 2.0 * x,
    "sqrt": lambda xp, x, y: 0.5 / xp.maximum(y, LEAST),
    "exp": lambda xp, x, y: y,
    "expm1": lambda xp, x, y: y + 1.0,
    "log": lambda xp, x, y: 1.0 / x,
    "log1p": lambda xp, x, y: 1.0 / (1.0 + x),
    "log2": lambda xp, x, y: (1.0 / np.log(2.0)) / x,
    "sin": lambda xp, x, y: xp.cos(x),
    "cos": lambda xp, x, y: -xp.sin(x),
    "tan": lambda xp, x, y: 1.0 + y * y,
    "asin": lambda xp, x, y: _inverse_root(xp, 1.0 - x * x),
    "acos": lambda xp, x, y: -_inverse_root(xp, 1.0 - x * x),
    "atan": lambda xp, x, y: 1.0 / (1.0 + x * x),
    "sinh": lambda xp, x, y: xp.cosh(x),
    "cosh": lambda xp, x, y: xp.sinh(x),
    "tanh": lambda xp, x, y: 1.0 - y * y,
}


# -- moves and sums: linear in one argument --------------------------------------------------------------


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


def _getitem(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, index: Any) -> Made:
    (x,), (t,) = values, tangents
    shape = shape_of(x)

    def piece(d: Any) -> Any:
        entries, axis = [slice(None)], 0
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


# -- reductions that choose, and products ----------------------------------------------------------------


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


# -- linear algebra --------------------------------------------------------------------------------------


def _bilinear(
    xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], function: Any, last: int
) -> Tangent:
    """Of a product of arrays of equal rank: f(da, b) + f(a, db). `last` axes of each meet the others."""
    a, b = values
    rank = max(len(shape_of(a)), len(shape_of(b)))

    def part(d: Any, x: Any) -> Any:
        shape = shape_of(x)
        return lifted(xp, spread(xp, d, shape, range(len(shape) - last, len(shape))), rank)

    left = mapped(tangents[0], lambda d: function(part(d, a), b))
    right = mapped(tangents[1], lambda d: function(a, part(d, b)))
    return added(xp, left, right)


def _matmul(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    y = xp.matmul(a, b)
    row, column = len(shape_of(a)) == 1, len(shape_of(b)) == 1
    left, right = tangents
    if row:
        a, left = a[None, :], mapped(left, lambda d: d[:, None, :])
    if column:
        b, right = b[:, None], mapped(right, lambda d: d[..., None])
    t = _bilinear(xp, (a, b), (left, right), xp.matmul, 2)
    if row:
        t = mapped(t, lambda d: d[..., 0, :])
    return y, mapped(t, lambda d: d[..., 0]) if column else t


def _vecdot(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    y = xp.linalg.vecdot(a, b)
    if a is b and tangents[0] is tangents[1]:
        shape = shape_of(a)
        last = [len(shape) - 1]
        return y, mapped(tangents[0], lambda d: 2.0 * xp.linalg.vecdot(spread(xp, d, shape, last), a))
    return y, _bilinear(xp, values, tangents, xp.linalg.vecdot, 1)


def _cross(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    return xp.linalg.cross(*values), _bilinear(xp, values, tangents, xp.linalg.cross, 1)


def _outer(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    a, b = values
    left = mapped(tangents[0], lambda d: d[:, :, None] * b[None, :])
    right = mapped(tangents[1], lambda d: a[:, None] * d[:, None, :])
    return xp.linalg.outer(a, b), added(xp, left, right)


def _solve(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    """A dX = dB - dA X, all directions as columns of one right side."""
    A, b = values
    y = xp.linalg.solve(A, b)
    vector = len(shape_of(b)) == 1
    wide, right = (b[:, None], mapped(tangents[1], lambda d: d[..., None])) if vector else (b, tangents[1])
    X = xp.linalg.solve(A, wide) if vector and len(shape_of(A)) > 2 else y[:, None] if vector else y
    rank, lead, last = len(shape_of(X)), shape_of(X)[:-2], shape_of(X)[-2:]
    moved = _bilinear(xp, (A, X), (mapped(tangents[0], lambda d: -d), {}), xp.matmul, 2)
    change = added(xp, mapped(right, lambda d: lifted(xp, _spread_matrix(xp, d, wide), rank)), moved)
    if not change:
        return y, {}
    columns = []
    for d in change.values():
        k = d.shape[0]
        full = xp.broadcast_to(d, (k, *lead, *last)) if tuple(d.shape) != (k, *lead, *last) else d
        order = (*range(1, rank - 1), rank - 1, 0, rank)
        columns.append(xp.reshape(xp.permute_dims(full, order), (*lead, last[0], k * last[1])))
    solved = xp.linalg.solve(A, columns[0] if len(columns) == 1 else xp.concat(columns, axis=-1))
    out, start = {}, 0
    for key, d in change.items():
        width = d.shape[0] * last[1]
        piece = xp.reshape(solved[..., start : start + width], (*lead, last[0], d.shape[0], last[1]))
        out[key] = xp.permute_dims(piece, (rank - 1, *range(rank - 2), rank - 2, rank))
        start += width
    return y, mapped(out, lambda d: d[..., 0]) if vector else out


def _spread_matrix(xp: Any, d: Any, x: Any) -> Any:
    """A part with the last two axes of its array at their full size."""
    shape = shape_of(x)
    return spread(xp, d, shape, range(len(shape) - 2, len(shape)))


def _cholesky(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent]) -> Made:
    """dL = L Phi(L^-1 dA L^-T), Phi the lower triangle with half of the diagonal (Murray 2016, eq. 8)."""
    (A,), (t,) = values, tangents
    L = xp.linalg.cholesky(A)
    n = shape_of(A)[-1]
    lower = np.tril(np.ones((n, n))) - 0.5 * np.eye(n)
    rank = len(shape_of(A)) + 1

    def change(d: Any) -> Any:
        k = d.shape[0]
        shape = (k, *shape_of(A))
        full = xp.broadcast_to(d, shape) if tuple(d.shape) != shape else d
        # numpy's solve takes no broadcast of a matrix against stacks: side by side, one factorization
        left = _solved(xp, L, full, rank)
        both = xp.matrix_transpose(_solved(xp, L, xp.matrix_transpose(left), rank))
        return xp.matmul(L, both * xp.asarray(lower, dtype=A.dtype))

    return L, mapped(t, change)


def _solved(xp: Any, L: Any, d: Any, rank: int) -> Any:
    """L^-1 of each d (k, ..., n, n), with their columns side by side."""
    k, n = d.shape[0], d.shape[-1]
    lead = tuple(d.shape[1:-2])
    beside = xp.permute_dims(d, (*range(1, rank - 2), rank - 2, 0, rank - 1))
    found = xp.linalg.solve(L, xp.reshape(beside, (*lead, n, k * n)))
    apart = xp.reshape(found, (*lead, n, k, n))
    return xp.permute_dims(apart, (rank - 2, *range(rank - 3), rank - 3, rank - 1))


# -- the table -------------------------------------------------------------------------------------------

_STEPS = """sign floor ceil round trunc floor_divide equal not_equal less less_equal greater greater_equal
logical_and logical_or logical_xor logical_not isfinite isnan any all argmax argmin argsort searchsorted"""

RULES: dict[str, Rule] = {
    **{name: _constant(name) for name in _STEPS.split()},
    **{name: _unary(name, slope) for name, slope in _SLOPES.items()},
    "add": _binary("add", lambda xp, a, b, y: (None, None)),
    "subtract": _binary("subtract", lambda xp, a, b, y: (None, lambda: -1.0)),
    "multiply": _multiply,
    "divide": _divide,
    "pow": _pow,
    "remainder": _binary("remainder", _remainder_slopes),
    "maximum": _extreme("maximum", "greater"),
    "minimum": _extreme("minimum", "less"),
    "atan2": _binary("atan2", _atan2_slopes),
    "hypot": _binary("hypot", _hypot_slopes),
    "copysign": _binary("copysign", _copysign_slopes),
    "where": _where,
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
    "matmul": _matmul,
    **{name: _matrices(name) for name in ("matrix_transpose", "tril", "triu")},
    "cholesky": _cholesky,
    "solve": _solve,
    "cross": _cross,
    "vecdot": _vecdot,
    "outer": _outer,
    "permute_dims": _permute,
    "reshape": _reshape,
    "broadcast_to": _broadcast_to,
    "getitem": _getitem,
    "take": _take,
}
"""The rule of each operation that takes real numbers."""
