"""States that are not vectors: angles and quaternions, declared once and respected everywhere.

A `StateSpace` says what the numbers of a state or a measurement are, part by part, with or without names:

    CAR = StateSpace(position=euclidean(2), heading=angle(), speed=euclidean(1))
    pose = StateSpace(euclidean(3), quaternion())

With names, a function of the state reads `x.position` and `x.heading`: see `views`. Rigid motions, whose
parts do not move one by one, are in `groups`.

Three operations are all that a filter needs of a space. `plus(x, d)` moves a state by a small vector,
`minus(a, b)` is the vector that moves b to a, and `mean` is the state from which the weighted differences
add up to zero. On vectors they are +, - and the ordinary mean; an angle is wrapped into (-pi, pi], and a
quaternion, of four numbers, moves by a rotation vector of three: q * Exp(d). Covariances live in the tangent
space, whose dimension is `tangent`.

Source: C. Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state representations
through encapsulation of manifolds", Information Fusion 14(1), 2013, secs. 3-4.
"""

from __future__ import annotations

import abc
import functools
import itertools
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from flowgraph import Array, jacobian
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalize,
    skew,
    to_rotation_vector,
)
from flowgraph.blocks.geometry.views import View, joined, need_names
from flowgraph.blocks.signals import Gaussian
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["Part", "Quaternion", "StateSpace", "angle", "euclidean", "quaternion"]


@dataclass(frozen=True)
class Part(abc.ABC):
    """A part of a state: `size` numbers, whose small changes are vectors of `tangent` numbers."""

    size: int
    tangent: int

    fields: ClassVar[Any] = ()
    """Names of parts of the part, each with its place in `size`."""

    @property
    def rest(self) -> np.ndarray:
        """The element (size) from which nothing has moved."""
        return np.zeros(self.size)

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

    def directions(self, x: Array, xp: Any) -> Array | None:
        """(..., size, tangent): how x (..., size) changes with a small move; None: by the move itself."""
        still = xp.zeros((*x.shape[:-1], self.tangent), dtype=x.dtype)
        return jacobian(lambda d, xp: self.plus(x, d, xp), still, xp)[1]

    def errors(self, x: Array, xp: Any) -> Array | None:
        """(..., tangent, size): the small move that a small change of x (..., size) is; None: the change."""
        return jacobian(lambda a, xp: self.minus(a, x, xp), x, xp)[1]

    def turn(self, d: Array, xp: Any) -> Array | None:
        """How far tangent vectors, the columns of d (..., tangent, n), turn, in rad; None: not at all."""
        return None

    def reset_table(self) -> np.ndarray | None:
        """(tangent, tangent, tangent): d @ table is what a move by d adds to the error's Jacobian, which is
        the identity without it; to first order. None: nothing."""
        return None


class _Plain(Part):
    """Numbers that move as they change."""

    def directions(self, x: Array, xp: Any) -> None:
        return None

    def errors(self, x: Array, xp: Any) -> None:
        return None


class _Euclidean(_Plain):
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return x + d

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return a - b


class _Angle(_Plain):
    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return _wrapped(x + d, xp)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return _wrapped(a - b, xp)

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.abs(d)


class Quaternion(Part):
    """A unit quaternion; see `quaternion`."""

    @property
    def rest(self) -> np.ndarray:
        return np.array([1.0, 0.0, 0.0, 0.0])

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return normalize(multiply(x, from_rotation_vector(d, xp=xp), xp=xp), xp=xp)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return to_rotation_vector(multiply(conjugate(b, xp=xp), a, xp=xp), xp=xp)

    def directions(self, x: Array, xp: Any) -> Array:
        """Half of q times (0, d) (Solà eq. 201)."""
        w, u = x[..., :1], x[..., 1:]
        low = w[..., None] * xp.eye(3, dtype=x.dtype) + skew(u, xp=xp)
        return 0.5 * xp.concat([-u[..., None, :], low], axis=-2)

    def errors(self, x: Array, xp: Any) -> Array:
        """Twice the vector part of q^-1 times the change."""
        return 4.0 * xp.matrix_transpose(self.directions(x, xp))

    def turn(self, d: Array, xp: Any) -> Array:
        return xp.sqrt(xp.sum(d * d, axis=-2, keepdims=True))

    def reset_table(self) -> np.ndarray:
        return -0.5 * np.asarray(skew(np.eye(3), xp=np))


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
    return Quaternion(4, 3)


class StateSpace:
    """The product of its parts, in order. Immutable.

    Args:
        parts: made by `euclidean(n)`, `angle(n)`, `quaternion()`, `SO(n)`, `SE(n)` and `SE_2(n)`.
        named: the same by name, in place of parts without names.

    Raises:
        DeclarationError: without a part, with both kinds, or with a name that an array's attribute has.
    """

    def __init__(self, *parts: Part, **named: Part) -> None:
        both = (*parts, *named.values())
        if not both or (parts and named) or not all(isinstance(p, Part) for p in both):
            raise DeclarationError(
                "a state space is made of parts",
                path="StateSpace",
                expected="euclidean(n), angle(n) and quaternion()",
                got=", ".join(map(repr, both)) or "none",
                fix="write StateSpace(euclidean(3), quaternion())",
            )
        need_names(named)
        self.parts, self.names = both, tuple(named)
        self.size, self.tangent = sum(p.size for p in both), sum(p.tangent for p in both)
        self._flat = all(isinstance(p, _Euclidean) for p in both)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, StateSpace) and (self.parts, self.names) == (other.parts, other.names)

    def __hash__(self) -> int:
        return hash((self.parts, self.names))

    def __repr__(self) -> str:
        kinds = [f"{type(p).__name__.lstrip('_').lower()}({p.size})" for p in self.parts]
        named = [f"{n}={k}" for n, k in zip(self.names, kinds, strict=True)] if self.names else kinds
        return f"StateSpace({', '.join(named)})"

    @property
    def flat(self) -> bool:
        """Whether it is a vector space."""
        return self._flat

    @property
    def rest(self) -> np.ndarray:
        """The state (size) of zeros, and of attitudes that are not turned."""
        return np.concatenate([p.rest for p in self.parts])

    def places(self) -> list[tuple[Part, slice, slice]]:
        """Each part, with its place in a state and in a tangent vector."""
        at = [0, *itertools.accumulate(p.size for p in self.parts)]
        on = [0, *itertools.accumulate(p.tangent for p in self.parts)]
        return [(p, slice(at[k], at[k + 1]), slice(on[k], on[k + 1])) for k, p in enumerate(self.parts)]

    def view(self, x: Array, xp: Any = np) -> Any:
        """States (..., size) whose parts have names; themselves where the space has none."""
        if not self.names or isinstance(x, View):
            return x
        return View(x, self, xp)

    def covers(self, name: str) -> slice:
        """Where a part stands in a tangent vector, and in a covariance.

        Raises:
            UnknownNameError: for a name that no part has.
        """
        if name not in self.names:
            raise UnknownNameError("part", name, self.names, path="StateSpace")
        return self.places()[self.names.index(name)][2]

    def resting(self) -> Gaussian:
        """The state at rest, with a covariance of one."""
        return Gaussian(mean=self.rest, covariance=np.eye(self.tangent))

    def gaussian(self, **parts: tuple[Any, Any]) -> Gaussian:
        """A belief to start from: for each part by name its mean and standard deviation.

            CAR.gaussian(position=((0.0, 0.0), 2.0), heading=(0.3, 0.1), speed=(5.0, 1.0))

        Args:
            parts: (mean, deviation); the deviation is one number or one for each direction of the part.

        Raises:
            UnknownNameError, DeclarationError: where the parts are not those of the space.
        """
        for name in parts:
            self.covers(name)
        means = {name: np.asarray(mean, dtype=float) for name, (mean, _) in parts.items()}
        spread = {name: np.asarray(sigma, dtype=float) for name, (_, sigma) in parts.items()}
        mean = joined(self, means, self.rest, np, tangent=False)
        deviations = joined(self, spread, self.rest, np, tangent=True)
        return Gaussian(mean=mean, covariance=np.diag(deviations**2))

    def plus(
        self, x: Array, d: Array | None = None, xp: Any = None, *, velocity: Any = None, dt: Any = None
    ) -> Any:
        """The state (..., size): x moved by d (..., tangent), or by a velocity over dt seconds.

            CAR.plus(x, velocity=(x.speed * along, turn_rate, acceleration), dt=dt)

        Args:
            x: (..., size); of a view, the result is one too.
            d: (..., tangent).
            velocity: in place of d: of each part in order, (..., its tangent), or by name in a dict, which
                leaves out what does not move. A part of one direction may leave out the last axis.
            dt: s.
        """
        if isinstance(x, View):
            d = joined(self, velocity, x.array, x.xp, tangent=True) * dt if d is None else d
            return View(self.plus(x.array, d, x.xp), self, x.xp)
        if d is None:
            d = joined(self, velocity, x, xp, tangent=True) * dt
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

    def directions(self, x: Array, xp: Any) -> list[Array] | None:
        """How x (..., size) changes with a small move: (..., size, 1) for each direction of the tangent
        space, or (..., size, tangent) for all; None on vectors and angles, where it is the move itself."""
        parts = [(part.directions(x[..., at], xp), at, on) for part, at, on in self.places()]
        if all(found is None for found, _, _ in parts):
            return None
        lead = tuple(x.shape[:-1])
        if isinstance(x, np.ndarray):  # at once: zeros are looked for where work is recorded
            whole = np.zeros((*lead, self.size, self.tangent), dtype=x.dtype)
            for found, at, on in parts:
                whole[..., at, on] = np.eye(on.stop - on.start) if found is None else found
            return [whole]
        columns = []
        for found, at, on in parts:
            for i in range(on.stop - on.start):
                one = np.eye(at.stop - at.start, 1, -i)
                piece = (
                    xp.broadcast_to(xp.asarray(one, dtype=x.dtype), (*lead, *one.shape))
                    if found is None
                    else found[..., :, i : i + 1]
                )
                above, below = (
                    xp.zeros((*lead, n, 1), dtype=x.dtype) for n in (at.start, self.size - at.stop)
                )
                columns.append(xp.concat([above, piece, below], axis=-2))
        return columns

    def errors(self, x: Array, J: Array, xp: Any) -> Array:
        """J (..., size, k), changes of x (..., size), as small moves (..., tangent, k)."""
        parts = [(part.errors(x[..., at], xp), J[..., at, :]) for part, at, _ in self.places()]
        if all(found is None for found, _ in parts):
            return J
        return xp.concat([j if found is None else found @ j for found, j in parts], axis=-2)

    def mean(self, points: Array, weights: Array, xp: Any, *, rounds: int = 8) -> Array:
        """The weighted mean (..., size) of points (..., n, size); weights (n) or (..., n) add up to 1.

        Starts from the first point and moves, `rounds` times, by the weighted mean of the differences; on
        vectors once is exact. The points should lie within half a turn of each other.
        """
        middle = points[..., 0, :]
        for _ in range(1 if self._flat else rounds):
            apart = self.minus(points, middle[..., None, :], xp)
            middle = self.plus(middle, (weights[..., None, :] @ apart)[..., 0, :], xp)
        return middle

    def reset(self, d: Array, xp: Any) -> Array | None:
        """The Jacobian (..., tangent, tangent) of the error when the state moves by d; None where it is I.

        A rotation by d leaves of a right rotation error I - skew(d)/2, to first order (Solà 2017, eq. 287).
        """
        if self._reset_table is None:
            return None
        table, turning = self._reset_table
        parts = [d[..., on] for on in turning]  # the others leave the error as it is
        d = parts[0] if len(parts) == 1 else xp.concat(parts, axis=-1)
        turned = d @ xp.asarray(table, dtype=d.dtype)
        turned = xp.reshape(turned, (*d.shape[:-1], self.tangent, self.tangent))
        return turned + xp.eye(self.tangent, dtype=d.dtype)

    @functools.cached_property
    def _reset_table(self) -> tuple[np.ndarray, list[slice]] | None:
        """(k, tangent^2): maps the k numbers of d that turn an error to the sum of what their parts say, and
        where those stand in d."""
        table = np.zeros((self.tangent, self.tangent, self.tangent))
        known = [(part.reset_table(), on) for part, _, on in self.places()]
        for own, on in known:
            if own is not None:
                table[on, on, on] = own
        turning = [on for own, on in known if own is not None]
        if not turning:
            return None
        flat = table.reshape(self.tangent, -1)
        return np.concatenate([flat[on] for on in turning]), turning
