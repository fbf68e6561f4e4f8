"""Triangular roots of covariances, out of operations that every backend has.

A covariance P = L L^T kept as its root L has twice the digits and cannot become negative. Filters on roots
need one thing: the triangle of a wide matrix, usually by a QR factorization. That is no instruction of a
pipeline, so here it is written out: one Householder reflection a row, a fixed number of them.

Source: G. Golub and C. Van Loan, "Matrix Computations", 4th ed., 2013: algorithms 5.1.1, 5.2.1 and 4.2.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array

__all__ = ["lower_root", "semidefinite_root"]


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

    Cholesky's factorization by outer products; a pivot below 1e-15 of the largest diagonal counts as zero.
    """
    n = P.shape[-1]
    one = xp.eye(n, dtype=P.dtype)
    least = xp.max(xp.sum(P * one, axis=-1), axis=-1)[..., None] * 1e-15
    columns = []
    for j in range(n):
        pivot = P[..., j, j : j + 1]
        solid = pivot > least
        column = P[..., :, j] / xp.sqrt(xp.where(solid, pivot, 1.0)) * xp.astype(solid, P.dtype)
        columns.append(column)
        P = P - column[..., :, None] * column[..., None, :]
    return xp.tril(xp.stack(columns, axis=-1))
