"""Small vectors, quaternions and 3 x 3 matrices side by side: n of each, the number of which is the last
axis.

With struct-of-arrays fields such as (3, n) and (3, 3, n) a closed form is a few array operations over all n,
several times faster than n factorizations (`linalg.solve` on (n, 3, 3)), and each lane is independent: a
compiler may put them on as many processors as it has.

Conventions and equation numbers are those of `flowgraph.blocks.geometry.rotations`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry import rotations as geometry

__all__ = [
    "cross",
    "exponential",
    "inverse_and_log_determinant",
    "matrix_product",
    "multiply",
    "normalize",
    "products",
    "relative_to",
    "rotate",
    "rotation_matrices",
    "rotation_vectors",
    "rotation_vectors_to",
    "solve_and_log_determinant",
    "transpose",
    "turned",
]


_FIRST, _SECOND = np.triu_indices(4)


def _tables() -> tuple[np.ndarray, np.ndarray]:
    """The quaternion product (4, 16) of 16 products, and the rotation matrix (9, 10) of the 10 products of a
    quaternion with itself."""
    units = np.eye(4)
    pairs = [(a, b) for a in units for b in units]
    product = np.stack([geometry.multiply(a, b, xp=np) for a, b in pairs], axis=1)
    # what is bilinear in (q, q) follows from its values on sums of units: B(a, b) = (Q(a + b) - Q(a - b)) / 4
    square = lambda q: geometry.to_matrix(q, xp=np).reshape(9)
    matrix = np.stack(
        [
            (square(units[i] + units[j]) - square(units[i] - units[j])) / (4.0 if i == j else 2.0)
            for i, j in zip(_FIRST, _SECOND, strict=True)
        ],
        axis=1,
    )
    return product, matrix


_PRODUCT, _MATRIX = _tables()
_CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


def products(a: Array, b: Array, *, xp: Any) -> Array:
    """The 16 products (16, n) of the parts of quaternions a and b (4, n)."""
    return xp.reshape(a[:, None, :] * b[None, :, :], (16, a.shape[-1]))


def _squares(q: Array, xp: Any) -> Array:
    """The 10 products (10, n) of the parts of quaternions q (4, n) with each other."""
    return xp.concat([q[k : k + 1, :] * q[k:, :] for k in range(4)], axis=0)


def multiply(a: Array, b: Array, *, xp: Any) -> Array:
    """The quaternion products a * b (4, n) (Solà eq. 12)."""
    return xp.asarray(_PRODUCT, dtype=a.dtype) @ products(a, b, xp=xp)


def normalize(q: Array, *, xp: Any) -> Array:
    """The quaternions (4, n) scaled to unit norm."""
    return q / xp.sqrt(xp.sum(q * q, axis=0))


def exponential(v: Array, *, xp: Any) -> Array:
    """Exp: the quaternions (4, n) of rotation vectors (3, n) in rad (Solà eq. 101)."""
    u = 0.5 * v
    half = xp.sqrt(xp.sum(u * u, axis=0, keepdims=True))
    return xp.concat([xp.cos(half), geometry.sinc(half, xp=xp) * u], axis=0)


def turned(q: Array, v: Array, *, xp: Any) -> Array:
    """q * Exp(v), of unit norm: attitudes (4, n), which are nearly so, turned by rotation vectors (3, n).

    What is added to q is q (Exp(v) - 1), with cos(h) - 1 = -h^2 sinc(h/2)^2 / 2 for the half turn h, and then
    what brings the norm back, q (1 - |q|^2) / 2. Both are small where the turn is, so that in words of few
    bits only their sum is rounded to the last bit of q.
    """
    u = 0.5 * v
    squared = xp.sum(u * u, axis=0, keepdims=True)
    half = xp.sqrt(squared)
    quarter = geometry.sinc(0.5 * half, xp=xp)
    by = xp.concat([-0.5 * squared * (quarter * quarter), geometry.sinc(half, xp=xp) * u], axis=0)
    q = q + multiply(q, by, xp=xp)
    return q + q * (0.5 - 0.5 * xp.sum(q * q, axis=0))


def rotation_matrices(q: Array, *, xp: Any) -> Array:
    """The rotation matrices (3, 3, n), body to world (Solà eq. 115)."""
    return xp.reshape(xp.asarray(_MATRIX, dtype=q.dtype) @ _squares(q, xp), (3, 3, q.shape[-1]))


def rotate(q: Array, v: Array, *, xp: Any) -> Array:
    """One body vector v (3) in world coordinates, for each attitude (4, n): (3, n).

    v + w t + u x t with t = 2 u x v, where q = (w, u): no rotation matrices, and no products of q's parts.
    """
    u = q[1:, :]
    t = 2.0 * cross(u, v[:, None, None], xp=xp)
    return v[:, None] + q[:1, :] * t[:, 0, :] + cross(u, t, xp=xp)[:, 0, :]


def relative_to(q: Array, z: Array, *, xp: Any) -> Array:
    """q^-1 * z: what turns attitudes (4, n) to z (4)."""
    to_z = geometry.right_product(z, xp=xp) * xp.asarray(_CONJUGATE, dtype=q.dtype)
    return to_z @ q


def rotation_vectors(q: Array, *, xp: Any) -> Array:
    """Log: the rotation vectors (3, n) in rad, at most pi long, of quaternions (4, n)."""
    w, v = q[:1, :], q[1:, :]
    squared = xp.sum(v * v, axis=0, keepdims=True)
    small = squared < 1e-10
    sine = xp.sqrt(xp.where(small, 1.0, squared))
    # near zero: 2 asin(s)/s, with s^2 << 1; a series, so that the ratio is never 0/0
    scale = xp.where(small, 2.0 + squared / 3.0, 2.0 * xp.atan2(sine, xp.abs(w)) / sine)
    return xp.where(w < 0.0, -scale, scale) * v


def rotation_vectors_to(q: Array, z: Array, *, xp: Any) -> Array:
    """Log(q^-1 * z): the rotation vectors (3, n) in rad, at most pi long, from attitudes (4, n) to z (4)."""
    return rotation_vectors(relative_to(q, z, xp=xp), xp=xp)


def cross(a: Array, B: Array, *, xp: Any) -> Array:
    """The cross products (3, m, n) of vectors a (3, n), or one for all (3, 1), with m columns B (3, m, n)."""
    after, before = (lambda v, k=k: xp.concat([v[k:, ...], v[:k, ...]], axis=0) for k in (1, 2))
    return after(a)[:, None, :] * before(B) - before(a)[:, None, :] * after(B)


def transpose(a: Array, *, xp: Any) -> Array:
    """The transposed matrices (m, k, n) of a (k, m, n)."""
    return xp.permute_dims(a, (1, 0, 2))


def matrix_product(a: Array, b: Array) -> Array:
    """The products (3, 3, n) of matrices a and b."""
    return a[:, 0:1, :] * b[0:1, :, :] + a[:, 1:2, :] * b[1:2, :, :] + a[:, 2:3, :] * b[2:3, :, :]


def _triangle(S: Array) -> tuple[tuple[Array, Array, Array], tuple[Array, Array, Array]]:
    """The pivots D of S = L D L^T, and of the unit lower triangle L the entries 10, 20 and 21, (n) each."""
    first = S[0, 0, :]
    a, b = S[1, 0, :] / first, S[2, 0, :] / first
    second = S[1, 1, :] - a * S[1, 0, :]
    rest = S[2, 1, :] - b * S[1, 0, :]
    c = rest / second
    third = S[2, 2, :] - b * S[2, 0, :] - c * rest
    return (first, second, third), (a, b, c)


def inverse_and_log_determinant(S: Array, *, xp: Any) -> tuple[Array, Array]:
    """The inverses (3, 3, n) and log det (n) of symmetric positive matrices (3, 3, n), by L D L^T.

    S = L D L^T with a unit lower triangle L, and S^-1 = M^T D^-1 M with M = L^-1. The pivots are of the size
    of variances, where a determinant is of the size of their cube, which words of few bits do not hold (Golub
    and Van Loan, Matrix Computations, section 4.1).
    """
    (first, second, third), (a, b, c) = _triangle(S)
    corner = a * c - b  # M = [[1, 0, 0], [-a, 1, 0], [corner, -c, 1]]
    z = 1.0 / third
    zx, zy = corner * z, -c * z
    yx = -a / second - c * zx
    y, x = 1.0 / second - c * zy, 1.0 / first + a * a / second + corner * zx
    inverse = xp.stack([xp.stack([x, yx, zx]), xp.stack([yx, y, zy]), xp.stack([zx, zy, z])])
    return inverse, xp.log(first) + xp.log(second) + xp.log(third)


def solve_and_log_determinant(S: Array, B: Array, *, xp: Any) -> tuple[Array, Array]:
    """S^-1 B (3, m, n) and log det S (n) of symmetric positive matrices S (3, 3, n), by L D L^T.

    Forward through L, divided by D, back through L^T: each quotient is of the size of its own column, where
    an inverse has one size for all, and loses in words of few bits what a column has beside a large pivot.
    """
    (first, second, third), (a, b, c) = _triangle(S)
    x, y, z = B[0, :, :], B[1, :, :], B[2, :, :]
    y = y - a * x
    z = (z - b * x - c * y) / third
    y = y / second - c * z
    x = x / first - a * y - b * z
    return xp.stack([x, y, z]), xp.log(first) + xp.log(second) + xp.log(third)
