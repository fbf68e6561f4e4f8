"""States that are not vectors: angles and quaternions, declared once and respected everywhere.

A `StateSpace` says what the numbers of a state or a measurement are, part by part:

    heading_and_place = StateSpace(euclidean(2), angle())
    pose = StateSpace(euclidean(3), quaternion())

Three operations are all that a filter needs of it. `plus(x, d)` moves a state by a small vector, `minus(a,
b)` is the vector that moves b to a, and `mean` is the state from which the weighted differences add up to
zero. On vectors they are +, - and the ordinary mean; an angle is wrapped into (-pi, pi], and a quaternion, of
four numbers, moves by a rotation vector of three: q * Exp(d). Covariances live in the tangent space, whose
dimension is `tangent`.

Source: C. Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state representations
through encapsulation of manifolds", Information Fusion 14(1), 2013, secs. 3-4.
"""

from __future__ import annotations

import abc
import functools
import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalize,
    skew,
    to_rotation_vector,
)
from flowgraph.errors import DeclarationError

__all__ = ["Part", "StateSpace", "angle", "euclidean", "quaternion"]


@dataclass(frozen=True)
class Part(abc.ABC):
    """A part of a state: `size` numbers, whose small changes are vectors of `tangent` numbers."""

    size: int
    tangent: int

    @property
    def curved(self) -> bool:
        """Whether it takes more numbers than it has directions, as a quaternion does."""
        return self.size != self.tangent

    @abc.abstractmethod
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        """x (..., size) moved by d (..., tangent)."""

    @abc.abstractmethod
    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        """The vector (..., tangent) that moves b to a."""

    def turn(self, d: Array, xp: Any) -> Array | None:
        """How far tangent vectors, the columns of d (..., tangent, n), turn, in rad; None: not at all."""
        return None


class _Euclidean(Part):
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return x + d

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return a - b


class _Angle(Part):
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return _wrapped(x + d, xp)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return _wrapped(a - b, xp)

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.abs(d)


class _Quaternion(Part):
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return normalize(multiply(x, from_rotation_vector(d, xp=xp), xp=xp), xp=xp)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return to_rotation_vector(multiply(conjugate(b, xp=xp), a, xp=xp), xp=xp)

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.sqrt(xp.sum(d * d, axis=-2, keepdims=True))


def _wrapped(x: Array, xp: Any) -> Array:
    """The same angle in (-pi, pi]."""
    return np.pi - xp.remainder(np.pi - x, 2.0 * np.pi)


def euclidean(n: int) -> Part:
    """n real numbers."""
    return _Euclidean(n, n)


def angle(n: int = 1) -> Part:
    """n angles in rad, each kept in (-pi, pi]."""
    return _Angle(n, n)


def quaternion() -> Part:
    """A unit quaternion (w, x, y, z); its error is a right (body) rotation vector, rad."""
    return _Quaternion(4, 3)


class StateSpace:
    """The product of its parts, in order. Immutable.

    Args:
        parts: made by `euclidean(n)`, `angle(n)` and `quaternion()`.

    Raises:
        DeclarationError: without a part.
    """

    def __init__(self, *parts: Part) -> None:
        if not parts or not all(isinstance(p, Part) for p in parts):
            raise DeclarationError(
                "a state space is made of parts",
                path="StateSpace",
                expected="euclidean(n), angle(n) and quaternion()",
                got=", ".join(map(repr, parts)) or "none",
                fix="write StateSpace(euclidean(3), quaternion())",
            )
        self.parts = parts
        self.size, self.tangent = sum(p.size for p in parts), sum(p.tangent for p in parts)
        self._flat = all(isinstance(p, _Euclidean) for p in parts)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StateSpace) and self.parts == other.parts

    def __hash__(self) -> int:
        return hash(self.parts)

    def __repr__(self) -> str:
        inside = ", ".join(f"{type(p).__name__[1:].lower()}({p.size})" for p in self.parts)
        return f"StateSpace({inside})"

    def places(self) -> list[tuple[Part, slice, slice]]:
        """Each part, with its place in a state and in a tangent vector."""
        at = [0, *itertools.accumulate(p.size for p in self.parts)]
        on = [0, *itertools.accumulate(p.tangent for p in self.parts)]
        return [(p, slice(at[k], at[k + 1]), slice(on[k], on[k + 1])) for k, p in enumerate(self.parts)]

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        """The state (..., size): x moved by d (..., tangent)."""
        if self._flat:
            return x + d
        moved = [p.plus(x[..., at], d[..., on], xp) for p, at, on in self.places()]
        return xp.concat(moved, axis=-1)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        """The vector (..., tangent) that moves b (..., size) to a."""
        if self._flat:
            return a - b
        apart = [p.minus(a[..., at], b[..., at], xp) for p, at, _ in self.places()]
        return xp.concat(apart, axis=-1)

    def mean(self, points: Array, weights: Array, xp: Any, *, rounds: int = 8) -> Array:
        """The weighted mean (..., size) of points (..., n, size); weights (n) add up to 1.

        Starts from the first point and moves, `rounds` times, by the weighted mean of the differences; on
        vectors once is exact. The points should lie within half a turn of each other.
        """
        middle = points[..., 0, :]
        for _ in range(1 if self._flat else rounds):
            apart = self.minus(points, middle[..., None, :], xp)
            middle = self.plus(middle, xp.sum(apart * weights[..., :, None], axis=-2), xp)
        return middle

    def reset(self, d: Array, xp: Any) -> Array | None:
        """The Jacobian (..., tangent, tangent) of the error when the state moves by d; None where it is I.

        A rotation by d leaves of a right rotation error I - skew(d)/2, to first order (Solà 2017, eq. 287).
        """
        if not any(isinstance(p, _Quaternion) for p in self.parts):
            return None
        table = xp.asarray(self._reset_table, dtype=d.dtype)
        turned = xp.reshape(d @ table, (*d.shape[:-1], self.tangent, self.tangent))
        return turned + xp.eye(self.tangent, dtype=d.dtype)

    @functools.cached_property
    def _reset_table(self) -> np.ndarray:
        """(tangent, tangent^2): maps d to the matrix with -skew(d)/2 for each quaternion."""
        table = np.zeros((self.tangent, self.tangent, self.tangent))
        for part, _, on in self.places():
            if isinstance(part, _Quaternion):
                table[on, on, on] = -0.5 * np.asarray(skew(np.eye(3), xp=np))
        return table.reshape(self.tangent, -1)
