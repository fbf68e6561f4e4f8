"""Triangular roots of matrices, out of operations that every backend has.

`lower_root` is the triangle of a wide matrix, usually had by a QR factorization. That is no instruction of a
pipeline, so here it is written out: one Householder reflection a row, a fixed number of them. The others are
roots L of a covariance P = L L^T that may be singular.

Source: G. Golub and C. Van Loan, "Matrix Computations", 4th ed., 2013: algorithms 5.1.1, 5.2.1 and 4.2.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array

__all__ = ["covariance_root", "lower_root", "semidefinite_root"]

_FIRM = 1e-12
"""The share of its diagonal from which a pivot is not made by rounding: Cholesky's digits are then taken."""


def lower_root(wide: Array, *, xp: Any) -> Array:
    """The lower triangle L (..., n, n) with L L^T = A A^T and no negative diagonal, of A (..., n, m), m >= n.

    A is turned from the right by n reflections, each of which clears one row beyond its diagonal; A A^T is
    never formed. A row of zeros stays one.
    """
    n, m = wide.shape[-2:]
    one = np.eye(m)
    for j in range(n):
        row = wide[..., j, :] * xp.asarray(np.arange(m) >= j, dtype=wide.dtype)
        first = row[..., j : j + 1]
        length = xp.sqrt(xp.linalg.vecdot(row, row))[..., None]
        u = row + xp.where(first < 0.0, -length, length) * xp.asarray(one[j], dtype=wide.dtype)
        square = xp.linalg.vecdot(u, u)[..., None]
        scale = xp.where(square > 0.0, 2.0 / xp.where(square > 0.0, square, 1.0), 0.0)
        wide = wide - (wide @ u[..., None]) * (scale * u)[..., None, :]
    lower = xp.tril(wide[..., :n])
    diagonal = xp.sum(lower * xp.eye(n, dtype=lower.dtype), axis=-2)
    return lower * xp.where(diagonal < 0.0, -1.0, 1.0)[..., None, :]


def semidefinite_root(P: Array, *, xp: Any) -> Array:
    """The lower triangle L (..., n, n) with L L^T = P, for a P that may be singular, or zero.

    Cholesky's factorization by outer products; a pivot below 1e-15 of its own diagonal counts as zero.
    """
    return _outer_root(P, xp)


def covariance_root(P: Array, *, xp: Any) -> Array:
    """`semidefinite_root`, which is Cholesky's own wherever P is clearly positive definite.

    So a filter whose start is known in some direction goes on, and others have the digits of Cholesky.
    """
    root = _cholesky(P) if isinstance(P, np.ndarray) else xp.linalg.cholesky(P)
    one = xp.eye(P.shape[-1], dtype=P.dtype)
    pivots, variances = (xp.sum(x * one, axis=-1) for x in (root, P))
    firm = xp.all(pivots * pivots > 2.0 * _FIRM * variances, axis=-1)
    if isinstance(P, np.ndarray) and firm.all():  # without computing what will not be taken
        return root
    return xp.where(firm[..., None, None], root, _outer_root(P, xp))


def _cholesky(P: np.ndarray) -> np.ndarray:
    try:
        return np.linalg.cholesky(P)
    except np.linalg.LinAlgError:
        return np.zeros_like(P)


def _outer_root(P: Array, xp: Any) -> Array:
    n = P.shape[-1]
    variance = xp.sum(P * xp.eye(n, dtype=P.dtype), axis=-1)
    columns = []
    for j in range(n):
        pivot, least = P[..., j, j : j + 1], variance[..., j : j + 1]
        solid = (pivot > least * 1e-15) & (pivot > 0.0)
        column = P[..., :, j] / xp.sqrt(xp.where(solid, pivot, 1.0)) * xp.astype(solid, P.dtype)
        columns.append(column)
        P = P - column[..., :, None] * column[..., None, :]
    return xp.tril(xp.stack(columns, axis=-1))
