"""Rotations: the quaternion and rotation-vector maths that every pose filter shares.

A quaternion is Hamilton, scalar first `(w, x, y, z)`, of unit norm, and turns body coordinates into world
coordinates. A rotation vector is axis times angle in radians. A small attitude error is a right (body)
rotation vector: `q_true = q * Exp(error)`. All functions take leading batch axes, and their array
namespace as `xp`; they run on NumPy arrays and on traced ones alike.

A quaternion product and a rotation matrix are bilinear: each is an outer product times a constant table,
which is a few array operations in place of dozens of scalar ones.

Source: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017; equation
numbers below are his.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array
from flowgraph.recorder.namespaces import unnormalized_sinc

__all__ = [
    "multiply",
    "right_product",
    "conjugate",
    "normalize",
    "from_rotation_vector",
    "to_rotation_vector",
    "to_matrix",
    "rotate",
    "sinc",
    "skew",
    "between_vectors",
    "level",
    "parted",
    "geodesic_angle",
    "tilt_and_heading",
    "world_error",
    "slerp",
]


def _table(shape: tuple[int, ...], entries: dict[tuple[int, ...], int]) -> np.ndarray:
    table = np.zeros(shape)
    for index, sign in entries.items():
        table[index] = sign
    table.flags.writeable = False
    return table


def _product_table() -> np.ndarray:
    units = [(0, 0, 0, 1), (0, 1, 1, 1), (0, 2, 2, 1), (0, 3, 3, 1)]  # (left, right, result, sign)
    units += [(1, 0, 1, 1), (1, 1, 0, -1), (1, 2, 3, 1), (1, 3, 2, -1)]
    units += [(2, 0, 2, 1), (2, 1, 3, -1), (2, 2, 0, -1), (2, 3, 1, 1)]
    units += [(3, 0, 3, 1), (3, 1, 2, 1), (3, 2, 1, -1), (3, 3, 0, -1)]
    return _table((16, 4), {(4 * a + b, c): sign for a, b, c, sign in units})


def _matrix_table() -> np.ndarray:
    squares = [(1, 1, -1, -1), (1, -1, 1, -1), (1, -1, -1, 1)]
    table = np.zeros((16, 9))
    for row, signs in enumerate(squares):
        for part, sign in enumerate(signs):
            table[5 * part, 4 * row] = sign
    pairs = [(1, 2, 3), (2, 3, 1), (3, 1, 2)]
    for i, j, k in pairs:  # R_ij = 2 (q_i q_j - w q_k), R_ji = 2 (q_i q_j + w q_k)
        table[4 * i + j, 3 * (i - 1) + j - 1] = table[4 * i + j, 3 * (j - 1) + i - 1] = 2
        table[k, 3 * (i - 1) + j - 1], table[k, 3 * (j - 1) + i - 1] = -2, 2
    table.flags.writeable = False
    return table


_PRODUCT = _product_table()
_RIGHT = _PRODUCT.reshape(4, 4, 4).transpose(1, 2, 0).reshape(4, 16)
_MATRIX = _matrix_table()
_SKEW = _table((3, 9), {(0, 5): -1, (0, 7): 1, (1, 2): 1, (1, 6): -1, (2, 1): -1, (2, 3): 1})
_CONJUGATE = _table((4,), {(0,): 1, (1,): -1, (2,): -1, (3,): -1})


def _outer(a: Array, b: Array, xp: Any) -> Array:
    """The 16 products (..., 16) of the parts of two quaternions."""
    product = a[..., :, None] * b[..., None, :]
    return xp.reshape(product, (*product.shape[:-2], 16))


def multiply(a: Array, b: Array, *, xp: Any) -> Array:
    """The quaternion product (..., 4): first b, then a, as rotations (Solà eq. 12)."""
    return _outer(a, b, xp) @ xp.asarray(_PRODUCT, dtype=a.dtype)


def right_product(b: Array, *, xp: Any) -> Array:
    """The matrix (..., 4, 4) of a product with b on the right: right_product(b) @ a = a * b (Solà eq. 19)."""
    return xp.reshape(b @ xp.asarray(_RIGHT, dtype=b.dtype), (*b.shape[:-1], 4, 4))


def conjugate(q: Array, *, xp: Any) -> Array:
    """The inverse (..., 4) of a unit quaternion."""
    return q * xp.asarray(_CONJUGATE, dtype=q.dtype)


def normalize(q: Array, *, xp: Any) -> Array:
    """The quaternion (..., 4) scaled to unit norm; q must not be zero."""
    return q / xp.sqrt(xp.linalg.vecdot(q, q))[..., None]


def sinc(x: Array, *, xp: Any) -> Array:
    """sin(x) / x, and 1 at 0, element by element: one operation where `xp` has it."""
    own = getattr(xp, "unnormalized_sinc", None)
    return own(x) if own is not None else unnormalized_sinc(x, xp)


def from_rotation_vector(v: Array, *, xp: Any) -> Array:
    """Exp: the quaternion (..., 4) of a rotation vector (..., 3) in rad (Solà eq. 101)."""
    u = 0.5 * v
    half = xp.sqrt(xp.linalg.vecdot(u, u)[..., None])
    return xp.concat([xp.cos(half), sinc(half, xp=xp) * u], axis=-1)


def to_rotation_vector(q: Array, *, xp: Any) -> Array:
    """Log: the rotation vector (..., 3) in rad, at most pi long, of the shorter of q and -q (eq. 105)."""
    w, v = q[..., :1], q[..., 1:]
    squared = xp.linalg.vecdot(v, v)[..., None]
    small = squared < 1e-10
    sine = xp.sqrt(xp.where(small, 1.0, squared))
    size = xp.abs(w)
    # near zero: 2 asin(s)/s, with s^2 << 1; a series, so that the ratio is never 0/0
    scale = xp.where(small, 2.0 + squared / 3.0, 2.0 * xp.atan2(sine, size) / sine)
    return xp.where(w < 0.0, -scale, scale) * v


def to_matrix(q: Array, *, xp: Any) -> Array:
    """The rotation matrix (..., 3, 3), body to world, of a unit quaternion (Solà eq. 115)."""
    return xp.reshape(_outer(q, q, xp) @ xp.asarray(_MATRIX, dtype=q.dtype), (*q.shape[:-1], 3, 3))


def rotate(q: Array, v: Array, *, xp: Any) -> Array:
    """The vector (..., 3) in world coordinates, given v in body coordinates."""
    return (to_matrix(q, xp=xp) @ v[..., None])[..., 0]


def skew(v: Array, *, xp: Any) -> Array:
    """The matrix (..., 3, 3) with skew(a) @ b = a x b (Solà eq. 68)."""
    return xp.reshape(v @ xp.asarray(_SKEW, dtype=v.dtype), (*v.shape[:-1], 3, 3))


def between_vectors(a: Array, b: Array, *, xp: Any) -> Array:
    """The quaternion (..., 4) of the smallest rotation that turns the direction of a into that of b.

    Opposite vectors have no smallest rotation: half a turn about some axis normal to a is taken. Neither
    vector may be zero.
    """
    a = a / xp.sqrt(xp.linalg.vecdot(a, a))[..., None]
    b = b / xp.sqrt(xp.linalg.vecdot(b, b))[..., None]
    middle = a + b
    # a normal to a that is never zero: cross the axis with a's smallest part
    x, y, z = xp.abs(a[..., 0:1]), xp.abs(a[..., 1:2]), xp.abs(a[..., 2:3])
    least_x = xp.astype((x <= y) & (x <= z), a.dtype)
    least_y = xp.astype(y <= z, a.dtype) * (1.0 - least_x)
    axis = xp.concat([least_x, least_y, 1.0 - least_x - least_y], axis=-1)
    normal = (skew(a, xp=xp) @ axis[..., None])[..., 0]
    opposite = xp.linalg.vecdot(middle, middle)[..., None] < 1e-10
    # the product half * a^-1 turns a by twice its angle to the bisector
    half = xp.where(opposite, normal, middle)
    half = half / xp.sqrt(xp.linalg.vecdot(half, half))[..., None]
    scalar = xp.linalg.vecdot(a, half)[..., None]
    vector = (skew(a, xp=xp) @ half[..., None])[..., 0]
    turn = xp.concat([0.0 * scalar, half], axis=-1)
    return xp.where(opposite, turn, xp.concat([scalar, vector], axis=-1))


def level(nearest: Array, specific_force: Array, *, xp: Any) -> Array:
    """The attitude (..., 4) nearest to `nearest` that takes `specific_force` (..., 3, body) to world +z."""
    upright = rotate(nearest, specific_force, xp=xp)
    up = 0.0 * upright + xp.asarray((0.0, 0.0, 1.0), dtype=upright.dtype)
    return normalize(multiply(between_vectors(upright, up, xp=xp), nearest, xp=xp), xp=xp)


def parted(e: Array, *, xp: Any, hypot: Callable[[Array, Array], Array] | None = None) -> tuple[Array, Array]:
    """Tilt and heading (...) in rad of a rotation (..., 4); see `tilt_and_heading`.

    hypot: in place of `xp.hypot`, where lengths are far from overflow.
    """
    hypot = hypot or xp.hypot
    tilt = 2.0 * xp.atan2(hypot(e[..., 1], e[..., 2]), hypot(e[..., 0], e[..., 3]))
    sign = xp.where(e[..., 0] < 0.0, -1.0, 1.0)
    return tilt, 2.0 * xp.atan2(sign * e[..., 3], xp.abs(e[..., 0]))


# Judging results: NumPy only, in degrees.


def world_error(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> np.ndarray:
    """The rotation vector (..., 3) in rad, world frame, of R_estimate R_truth^T."""
    conjugated = conjugate(np.asarray(truth, dtype=float), xp=np)
    error = multiply(np.asarray(estimate, dtype=float), conjugated, xp=np)
    return np.asarray(to_rotation_vector(error, xp=np))


def geodesic_angle(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> np.ndarray:
    """The angle (...) in degrees, 0 to 180, between two attitudes (..., 4)."""
    return np.asarray(np.degrees(np.linalg.norm(world_error(estimate, truth), axis=-1)))


def tilt_and_heading(estimate: npt.ArrayLike, truth: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """The attitude error R_estimate R_truth^T split into two parts, each (...) in degrees.

    Returns:
        tilt: 0 to 180, the angle about a horizontal axis; the angle between the two verticals.
        heading: -180 to 180, the angle about world z. The error is first the heading, then the tilt
            (a swing-twist split); zero where the tilt is half a turn and a heading has no meaning.

    Source: D. Laidig and T. Seel, "VQF", Information Fusion 2023, sec. 4 (inclination and heading errors).
    """
    conjugated = conjugate(np.asarray(truth, dtype=float), xp=np)
    tilt, heading = parted(multiply(np.asarray(estimate, dtype=float), conjugated, xp=np), xp=np)
    return np.degrees(tilt), np.degrees(heading)


def slerp(a: npt.ArrayLike, b: npt.ArrayLike, fraction: npt.ArrayLike) -> np.ndarray:
    """The attitude (..., 4) at `fraction` (...) of the shorter way from a to b."""
    start, end = np.asarray(a, dtype=float), np.asarray(b, dtype=float)
    turn = to_rotation_vector(multiply(conjugate(start, xp=np), end, xp=np), xp=np)
    part = from_rotation_vector(np.asarray(fraction, dtype=float)[..., None] * turn, xp=np)
    return np.asarray(multiply(start, part, xp=np))
