"""Rigid motions as parts of a state: rotations, poses, and poses with a velocity, in the plane and in space.

    SO(2)    a unit complex number (cos, sin); moves by an angle
    SO(3)    a unit quaternion; moves by a rotation vector: `quaternion()`
    SE(2)    position (2) and heading in rad; moves by 2 + 1 numbers
    SE(3)    position (3) and attitude (4); moves by 3 + 3
    SE_2(3)  position (3), velocity (3) and attitude (4); moves by 3 + 3 + 3

A pose of which position and attitude are errors of their own is `euclidean(3)` beside `quaternion()`. As a
group it moves as a whole, X Exp(d): its errors are those of a frame that turns with the body, in which a
banana-shaped cloud of positions is a Gaussian. For an inertial motion such an error's own motion does not
depend on the state (it is invariant), so a wrong start does not spoil the linearisation. With
`error="world"` the error stands on the left, Exp(d) X, which suits what is measured in the body.

Sources: J. Solà, J. Deray and D. Atchuthan, "A micro Lie theory for state estimation in robotics",
arXiv:1812.01537, 2018, appendices A-D; A. Barrau and S. Bonnabel, "The invariant extended Kalman filter as a
stable observer", IEEE TAC 62(4), 2017 (SE_2(3)).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import Part, Quaternion, angle, quaternion
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalize,
    rotate,
    sinc,
    skew,
    to_rotation_vector,
)
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["SE", "SE_2", "SO", "swept", "turned_by"]

_SMALL = 1e-2
"""rad^2: below, the ratios of the exponential are sums, whose first term left out is under their rounding."""
_Q, _ANGLE = Quaternion(4, 3), angle()


class _Circle(Part):
    """A unit complex number, (cos, sin)."""

    @property
    def rest(self) -> np.ndarray:
        return np.array([1.0, 0.0])

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        c, s = xp.cos(d), xp.sin(d)
        a, b = x[..., :1], x[..., 1:]
        turned = xp.concat([a * c - b * s, a * s + b * c], axis=-1)
        return turned / xp.sqrt(xp.linalg.vecdot(turned, turned))[..., None]

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        sine = b[..., :1] * a[..., 1:] - b[..., 1:] * a[..., :1]
        return xp.atan2(sine, b[..., :1] * a[..., :1] + b[..., 1:] * a[..., 1:])

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.abs(d)


@dataclass(frozen=True)
class _Plane(Part):
    """Position and heading."""

    fields = (("position", slice(0, 2)), ("heading", slice(2, 3)))

    @property
    def curved(self) -> bool:
        return True

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        heading, theta = x[..., 2:], d[..., 2:]
        moved = x[..., :2] + turned_by(heading, swept(theta, d[..., :2], xp), xp)
        return xp.concat([moved, _ANGLE.plus(heading, theta, xp)], axis=-1)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        theta = _ANGLE.minus(a[..., 2:], b[..., 2:], xp)
        apart = turned_by(-b[..., 2:], a[..., :2] - b[..., :2], xp)
        return xp.concat([_unswept(theta, apart, xp), theta], axis=-1)

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.abs(d[..., 2:, :])

    def reset_table(self) -> np.ndarray:
        table = np.zeros((3, 3, 3))  # of ad(d), d = (rho, theta), halved
        table[2, 0, 1], table[2, 1, 0] = 0.5, -0.5
        table[0, 1, 2], table[1, 0, 2] = 0.5, -0.5
        return table


def turned_by(angle: Array, v: Array, xp: Any) -> Array:
    """A vector of the plane (..., 2), turned by an angle (..., 1)."""
    c, s = xp.cos(angle), xp.sin(angle)
    x, y = v[..., :1], v[..., 1:]
    return xp.concat([c * x - s * y, s * x + c * y], axis=-1)


def swept(theta: Array, v: Array, xp: Any) -> Array:
    """How far (..., 2) a body comes that goes v (..., 2) in its own frame and turns by theta (..., 1)."""
    square = theta * theta
    small = square < _SMALL
    safe = xp.where(small, 1.0, theta)
    half = 0.5 * theta * (1.0 - square / 12 * (1.0 - square / 30 * (1.0 - square / 56)))
    a = sinc(theta, xp=xp)
    b = xp.where(small, half, (1.0 - xp.cos(safe)) / safe)
    x, y = v[..., :1], v[..., 1:]
    return xp.concat([a * x - b * y, b * x + a * y], axis=-1)


def _unswept(theta: Array, v: Array, xp: Any) -> Array:
    """The inverse of `swept`: half theta over its tangent on the diagonal."""
    square = theta * theta
    small = square < _SMALL
    half = 0.5 * xp.where(small, 1.0, theta)
    near = 1.0 - square / 12 * (1.0 + square / 60 * (1.0 + square / 42 * (1.0 + square / 40)))
    a, b = xp.where(small, near, half * xp.cos(half) / xp.sin(half)), 0.5 * theta
    x, y = v[..., :1], v[..., 1:]
    return xp.concat([a * x + b * y, a * y - b * x], axis=-1)


@dataclass(frozen=True)
class _Rigid(Part):
    """Vectors (3) of the world, which an attitude carries along: a position, or a position and a velocity."""

    world: bool

    @property
    def fields(self) -> Any:  # type: ignore[override]
        names = ("position", "velocity")[: self._vectors]
        places = {name: slice(3 * k, 3 * k + 3) for k, name in enumerate(names)}
        return tuple((places | {"attitude": slice(self.size - 4, self.size)}).items())

    @property
    def _vectors(self) -> int:
        return (self.size - 4) // 3

    @property
    def rest(self) -> np.ndarray:
        return np.concatenate([np.zeros(self.size - 4), _Q.rest])

    @property
    def curved(self) -> bool:
        return True

    def _split(self, x: Array) -> list[Array]:
        return [x[..., 3 * k : 3 * k + 3] for k in range(self._vectors)]

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        q, theta = x[..., -4:], d[..., -3:]
        a, b = _ratios(theta, xp)
        swept = [_swept_by(theta, v, a, b, xp) for v in self._split(d)]
        turn = from_rotation_vector(theta, xp=xp)
        if self.world:
            moved = [rotate(turn, v, xp=xp) + s for v, s in zip(self._split(x), swept, strict=True)]
            turned = multiply(turn, q, xp=xp)
        else:
            moved = [v + rotate(q, s, xp=xp) for v, s in zip(self._split(x), swept, strict=True)]
            turned = multiply(q, turn, xp=xp)
        return xp.concat([*moved, normalize(turned, xp=xp)], axis=-1)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        p, q = a[..., -4:], conjugate(b[..., -4:], xp=xp)
        pairs = zip(self._split(a), self._split(b), strict=True)
        if self.world:
            turn = multiply(p, q, xp=xp)
            apart = [v - rotate(turn, w, xp=xp) for v, w in pairs]
        else:
            turn = multiply(q, p, xp=xp)
            apart = [rotate(q, v - w, xp=xp) for v, w in pairs]
        theta = to_rotation_vector(turn, xp=xp)
        c = _inverse_ratio(theta, xp)
        return xp.concat([*(_swept_by(theta, v, -0.5, c, xp) for v in apart), theta], axis=-1)

    def turn(self, d: Array, xp: Any) -> Array:
        theta = d[..., -3:, :]
        return xp.sqrt(xp.sum(theta * theta, axis=-2, keepdims=True))

    def reset_table(self) -> np.ndarray:
        half = 0.5 * np.asarray(skew(np.eye(3), xp=np))
        table = np.zeros((self.tangent, self.tangent, self.tangent))
        last = slice(self.tangent - 3, self.tangent)
        for k in range(self._vectors):
            on = slice(3 * k, 3 * k + 3)
            table[last, on, on] = half
            table[on, on, last] = half
        table[last, last, last] = half
        return table if self.world else -table


def _ratios(theta: Array, xp: Any) -> tuple[Array, Array]:
    """(1 - cos t) / t^2 and (t - sin t) / t^3, (..., 1), of rotation vectors of length t."""
    square = xp.linalg.vecdot(theta, theta)[..., None]
    small = square < _SMALL
    t = xp.sqrt(xp.where(small, 1.0, square))
    half = sinc(0.5 * xp.sqrt(square), xp=xp)
    second = 1.0 / 6 - square / 120 * (1.0 - square / 42 * (1.0 - square / 72 * (1.0 - square / 110)))
    return (
        0.5 * half * half,
        xp.where(small, second, (1.0 - sinc(t, xp=xp)) / (t * t)),
    )


def _inverse_ratio(theta: Array, xp: Any) -> Array:
    """(1 - t/2 cot(t/2)) / t^2, (..., 1)."""
    square = xp.linalg.vecdot(theta, theta)[..., None]
    small = square < _SMALL
    t = xp.sqrt(xp.where(small, 1.0, square))
    near = 1.0 / 12 * (1.0 + square / 60 * (1.0 + square / 42 * (1.0 + square / 40)))
    return xp.where(small, near, (1.0 - 0.5 * t * xp.cos(0.5 * t) / xp.sin(0.5 * t)) / (t * t))


def _swept_by(theta: Array, v: Array, a: Any, b: Array, xp: Any) -> Array:
    """v + a theta x v + b theta x (theta x v)."""
    once = xp.linalg.cross(*_both(theta, v, xp))
    twice = xp.linalg.cross(*_both(theta, once, xp))
    return v + a * once + b * twice


def _both(a: Array, b: Array, xp: Any) -> tuple[Array, Array]:
    shape = np.broadcast_shapes(tuple(a.shape), tuple(b.shape))
    spread = lambda x: x if tuple(x.shape) == shape else xp.broadcast_to(x, shape)
    return spread(a), spread(b)


def SO(n: int) -> Part:
    """A rotation: of the plane (n = 2) as a unit complex number, of space (n = 3) as a unit quaternion."""
    _need_dimension(n, "SO", (2, 3))
    return _Circle(2, 1) if n == 2 else quaternion()


def SE(n: int, *, error: str = "body") -> Part:
    """A pose: of the plane (n = 2) as position and heading, of space (n = 3) as position and attitude.

    Args:
        error: "body", X Exp(d), or of space also "world", Exp(d) X.
    """
    _need_dimension(n, "SE", (2, 3))
    _need_error(error, "SE", ("body",) if n == 2 else ("body", "world"))
    return _Plane(3, 3) if n == 2 else _Rigid(7, 6, error == "world")


def SE_2(n: int, *, error: str = "body") -> Part:
    """A pose in space with a velocity, as an inertial unit moves it: position, velocity, attitude.

    Args:
        error: "body", X Exp(d), or "world", Exp(d) X.
    """
    _need_dimension(n, "SE_2", (3,))
    _need_error(error, "SE_2", ("body", "world"))
    return _Rigid(10, 9, error == "world")


def _need_dimension(n: int, name: str, known: tuple[int, ...]) -> None:
    if n not in known:
        raise DeclarationError(
            "there is no such group here",
            path=name,
            expected=" or ".join(f"{name}({k})" for k in known),
            got=f"{name}({n!r})",
            fix="euclidean(n) has any number of dimensions",
        )


def _need_error(error: str, name: str, known: tuple[str, ...]) -> None:
    if error not in known:
        raise UnknownNameError("error", error, known, path=f"{name}.error")
