"""Attitudes as three angles e = (phi, theta, psi): roll about x, pitch about y, yaw about z, in rad.

Two conventions, of body to world:

    "zyx"   R = Rz(psi) Ry(theta) Rx(phi)     singular where theta = +-90 degrees
    "zxy"   R = Rz(psi) Rx(phi) Ry(theta)     singular where phi = +-90 degrees

The body's rate w and the rates of the angles are related by w = G(e) de/dt. A gyroscope reads w, in the body:
a filter integrates de/dt = G(e)^-1 w. The matrix that makes the rate in world coordinates of de/dt is another
one, R G; with a gyroscope it would be wrong. At the singularity G has no inverse. Within about a degree of it
(`NEAR`) the cosine that divides is held at that bound, so that everything stays finite, and wrong.

Sources: the reports' eqs. 6 (world) and 7 (body); J. Diebel, "Representing attitude", Stanford 2006, secs. 8.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.errors import UnknownNameError

__all__ = [
    "NEAR",
    "ORDERS",
    "angles_from_matrix",
    "angles_from_quaternion",
    "body_rate_matrix",
    "inverse_rate_jacobian",
    "inverse_rate_matrix",
    "matrix_from_angles",
    "need_order",
    "quaternion_from_angles",
    "singular_cosine",
    "world_rate_matrix",
    "wrapped",
]

ORDERS = ("zxy", "zyx")
NEAR = 0.02
"""The cosine below which an attitude counts as singular: 1.1 degrees."""

_POLE, _CLOSE = 1e-8, 1e-4
"""The cosines below which two of the angles are one, and below which psi is what the others leave."""

_FLIP = {"zxy": 0, "zyx": 1}
"""The angle whose cosine vanishes."""


def need_order(order: str, path: str = "euler") -> None:
    """Refuse a convention that does not exist.

    Raises:
        UnknownNameError: listing both.
    """
    if order not in ORDERS:
        raise UnknownNameError("convention of Euler angles", order, ORDERS, path=path)


def _parts(e: Array, xp: Any) -> tuple[Array, ...]:
    c, s = xp.cos(e), xp.sin(e)
    return c[..., 0], s[..., 0], c[..., 1], s[..., 1], c[..., 2], s[..., 2]


def _rows(xp: Any, *rows: tuple[Array, ...]) -> Array:
    """A matrix (..., 3, 3) of entries (...)."""
    return xp.stack([xp.stack(list(row), axis=-1) for row in rows], axis=-2)


def matrix_from_angles(e: Array, *, order: str, xp: Any) -> Array:
    """The rotation (..., 3, 3), body to world, of angles (..., 3)."""
    cf, sf, ct, st, cp, sp = _parts(e, xp)
    if order == "zyx":
        return _rows(
            xp,
            (cp * ct, cp * st * sf - sp * cf, cp * st * cf + sp * sf),
            (sp * ct, sp * st * sf + cp * cf, sp * st * cf - cp * sf),
            (-st, ct * sf, ct * cf),
        )
    return _rows(
        xp,
        (cp * ct - sp * sf * st, -sp * cf, cp * st + sp * sf * ct),
        (sp * ct + cp * sf * st, cp * cf, sp * st - cp * sf * ct),
        (-cf * st, sf, cf * ct),
    )


def angles_from_matrix(R: Array, *, order: str, xp: Any) -> Array:
    """The angles (..., 3) of a rotation (..., 3, 3); the one that flips over lies in [-pi/2, pi/2].

    At +-90 degrees of that one only the sum or the difference of the other two has a meaning: the angle next
    to the body (phi of zyx, theta of zxy) is 0 there and psi is all of it, as SciPy gives them.
    """
    size = lambda a, b: xp.sqrt(a * a + b * b)  # not asin: near +-90 degrees that has half the digits
    if order == "zyx":
        cosine = size(R[..., 2, 1], R[..., 2, 2])
        theta = xp.atan2(-R[..., 2, 0], cosine)
        phi, psi = xp.atan2(R[..., 2, 1], R[..., 2, 2]), xp.atan2(R[..., 1, 0], R[..., 0, 0])
        phi, c, s = _inner(phi, cosine, xp)
        rest = xp.atan2(s * R[..., 0, 2] - c * R[..., 0, 1], c * R[..., 1, 1] - s * R[..., 1, 2])
    else:
        cosine = size(R[..., 2, 0], R[..., 2, 2])
        phi = xp.atan2(R[..., 2, 1], cosine)
        theta, psi = xp.atan2(-R[..., 2, 0], R[..., 2, 2]), xp.atan2(-R[..., 0, 1], R[..., 1, 1])
        theta, c, s = _inner(theta, cosine, xp)
        rest = xp.atan2(c * R[..., 1, 0] + s * R[..., 1, 2], c * R[..., 0, 0] + s * R[..., 0, 2])
    return xp.stack([phi, theta, xp.where(cosine < _CLOSE, rest, psi)], axis=-1)


def _inner(angle: Array, cosine: Array, xp: Any) -> tuple[Array, Array, Array]:
    """The angle next to the body, 0 at the pole, with its cosine and sine.

    Close to the pole its digits are those of two numbers near 0. What is left of the rotation when it is
    undone gives a psi that goes with it, whatever it is.
    """
    angle = xp.where(cosine < _POLE, 0.0, angle)
    return angle, xp.cos(angle), xp.sin(angle)


def angles_from_quaternion(q: Array, *, order: str, xp: Any) -> Array:
    """The angles (..., 3) of a unit quaternion (..., 4), body to world."""
    return angles_from_matrix(to_matrix(q, xp=xp), order=order, xp=xp)


def quaternion_from_angles(e: Array, *, order: str, xp: Any) -> Array:
    """The unit quaternion (..., 4), body to world, of angles (..., 3)."""
    h = 0.5 * e
    cf, sf, ct, st, cp, sp = _parts(h, xp)
    if order == "zyx":
        w, x = cp * ct * cf + sp * st * sf, cp * ct * sf - sp * st * cf
        y, z = cp * st * cf + sp * ct * sf, sp * ct * cf - cp * st * sf
    else:
        w, x = cp * cf * ct - sp * sf * st, cp * sf * ct - sp * cf * st
        y, z = cp * cf * st + sp * sf * ct, cp * sf * st + sp * cf * ct
    return xp.stack([w, x, y, z], axis=-1)


def body_rate_matrix(e: Array, *, order: str, xp: Any) -> Array:
    """G (..., 3, 3): the body's rate is G de/dt (the report's eq. 7; the course's G)."""
    cf, sf, ct, st, _, _ = _parts(e, xp)
    one, none = xp.ones_like(cf), xp.zeros_like(cf)
    if order == "zyx":
        return _rows(xp, (one, none, -st), (none, cf, ct * sf), (none, -sf, ct * cf))
    return _rows(xp, (ct, none, -cf * st), (none, one, sf), (st, none, cf * ct))


def world_rate_matrix(e: Array, *, order: str, xp: Any) -> Array:
    """R G (..., 3, 3): the rate in world coordinates is R G de/dt (eq. 6). Not for a gyroscope."""
    return matrix_from_angles(e, order=order, xp=xp) @ body_rate_matrix(e, order=order, xp=xp)


def singular_cosine(e: Array, *, order: str, xp: Any) -> Array:
    """det G (...): the cosine that vanishes at the singularity of the convention."""
    return xp.cos(e[..., _FLIP[order]])


def _held(cosine: Array, xp: Any) -> Array:
    """The cosine, no nearer to zero than `NEAR`."""
    return xp.where(xp.abs(cosine) < NEAR, xp.where(cosine < 0.0, -NEAR, NEAR), cosine)


def inverse_rate_matrix(e: Array, *, order: str, xp: Any) -> Array:
    """G^-1 (..., 3, 3): de/dt = G^-1 w for a rate w in the body. Finite, and wrong, at the singularity."""
    cf, sf, ct, st, _, _ = _parts(e, xp)
    one, none = xp.ones_like(cf), xp.zeros_like(cf)
    if order == "zyx":
        c = _held(ct, xp)
        t = st / c
        return _rows(xp, (one, sf * t, cf * t), (none, cf, -sf), (none, sf / c, cf / c))
    c = _held(cf, xp)
    t = sf / c
    return _rows(xp, (ct, none, st), (t * st, one, -t * ct), (-st / c, none, ct / c))


def inverse_rate_jacobian(e: Array, w: Array, *, order: str, xp: Any) -> Array:
    """The Jacobian (..., 3, 3) of G(e)^-1 w with respect to e, for a given w (..., 3)."""
    cf, sf, ct, st, _, _ = _parts(e, xp)
    none = xp.zeros_like(cf)
    a, b, d = w[..., 0], w[..., 1], w[..., 2]
    if order == "zyx":
        c = _held(ct, xp)
        t = st / c
        along, across = sf * b + cf * d, cf * b - sf * d
        return _rows(
            xp,
            (across * t, along / (c * c), none),
            (-along, none, none),
            (across / c, along * t / c, none),
        )
    c = _held(cf, xp)
    t = sf / c
    along, across = ct * a + st * d, ct * d - st * a
    return _rows(
        xp, (none, across, none), (-across / (c * c), t * along, none), (across * t / c, -along / c, none)
    )


def wrapped(e: np.ndarray) -> np.ndarray:
    """The same angles in (-pi, pi]."""
    return np.pi - np.remainder(np.pi - np.asarray(e), 2.0 * np.pi)
