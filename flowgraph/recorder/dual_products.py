"""Derivatives of products of vectors and matrices, and of the two factorizations.

A product is linear in each side. A system of equations is solved again for the changes, for all directions at
once: as columns beside each other they share one factorization.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import solve_positive
from flowgraph.recorder.tangents import Made, Rule, Tangent, added, lifted, mapped, shape_of, spread


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


def _solve(xp: Any, values: Sequence[Any], tangents: Sequence[Tangent], *, assume_a: str = "gen") -> Made:
    """A dX = dB - dA X, all directions as columns of one right side."""
    solve = partial(solve_positive, xp=xp) if assume_a == "pos" else xp.linalg.solve
    A, b = values
    y = solve(A, b)
    vector = len(shape_of(b)) == 1
    wide, right = (b[:, None], mapped(tangents[1], lambda d: d[..., None])) if vector else (b, tangents[1])
    X = solve(A, wide) if vector and len(shape_of(A)) > 2 else y[:, None] if vector else y
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
    solved = solve(A, columns[0] if len(columns) == 1 else xp.concat(columns, axis=-1))
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


PRODUCTS: dict[str, Rule] = {
    "matmul": _matmul,
    "cholesky": _cholesky,
    "solve": _solve,
    "cross": _cross,
    "vecdot": _vecdot,
    "outer": _outer,
}
"""The rules by name."""
