"""Sigma points: a few chosen states that carry a mean and a covariance through any function.

A scaled set is the centre x and, for each of n directions, two points x plus and minus s L_j, where L is a
triangular root of the covariance and s = alpha sqrt(n + kappa). In the textbook form the mean is a weighted
sum of the images Y_i, whose central weight, 1 - n/s^2, is near -1e6 for alpha = 0.001: numbers of the size of
1e6 Y then cancel. Here everything is a deviation from the central image. With D_i = Y_i - Y_0, over the outer
points alone, all of weight W = 1/(2 s^2),

    mean        m = Y_0 + u,    u = W sum D_i
    covariance  P = W sum D_i D_i^T + (beta - alpha^2) u u^T

which is the same, as the weights add up to 1, and in which no large number is left to cancel. But the D_i are
as small as alpha, and what Y_i was rounded by comes back multiplied by W: for single precision alpha must not
be small either, see `SigmaPoints.limits`.

On a manifold the differences are those of a `StateSpace`, and u is the solution of its part: see
`mean_turn`.

Source: S. Julier, "The scaled unscented transformation", American Control Conference 2002; E. Wan and R. van
der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000; quaternion means: F. L.
Markley, Y. Cheng, J. L. Crassidis and Y. Oshman, "Averaging quaternions", Journal of Guidance, Control, and
Dynamics 30(4), 2007; E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking", Fusion
2003, eqs. 52-55.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import Part, Quaternion, StateSpace
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, to_rotation_vector
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.block import Limit

__all__ = ["GAUSSIAN", "MEANS", "Cluster", "SigmaPoints", "mean_move", "mean_turn"]

MEANS = ("markley", "kraft")
"""How quaternions are averaged: by the dominant eigenvector, or by gradient descent."""

LEAST_ALPHA = 0.1
"""In single precision or fixed point."""

FARTHEST = 0.9 * math.pi
"""How far an angle or a rotation is taken from the centre, rad: half a turn is the same either way round."""

_SQUARINGS, _STEPS = 6, 8


class Cluster(NamedTuple):
    """The images of a set of sigma points.

    mean: (..., size). outer: (..., 2 n, t), each outer image as a tangent vector at the mean, less that of
    the central one. centre: (..., 1, t), the central one. All of them are in the tangent space of the mean.
    """

    mean: Array
    outer: Array
    centre: Array


class Reach(NamedTuple):
    """How far the outer points lie where the covariance decides it: s and W = 1/(2 s^2), each (..., 1, 1)."""

    scale: Array
    weight: Array


def _weight(scale: float | Reach) -> Any:
    return scale.weight if isinstance(scale, Reach) else 0.5 / scale**2


@dataclass(frozen=True)
class SigmaPoints:
    """A scaled set of sigma points, and how to average what comes of them.

    Args:
        alpha: how far out the points lie, as a fraction of sqrt(n + kappa) standard deviations.
        beta: what is known of the fourth moment: 2 is best for a Gaussian. With alpha = 1, kappa = 0 and
            beta = 0 the centre has no weight: 2 n points of weight 1/(2 n).
        kappa: n + kappa is s^2 for alpha = 1; n + kappa must be positive.
        mean: "markley" or "kraft", for quaternions.

    Raises:
        DeclarationError: for an alpha that is not positive, or a number that is not finite.
        UnknownNameError: for another mean.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0
    mean: str = "markley"

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.alpha, self.beta, self.kappa))) or not 0.0 < self.alpha <= 10.0:
            raise DeclarationError(
                "these are no parameters of sigma points",
                path="SigmaPoints",
                expected="0 < alpha <= 10, and finite beta and kappa",
                got=f"alpha={self.alpha!r}, beta={self.beta!r}, kappa={self.kappa!r}",
                fix="write alpha=1.0, beta=2.0, kappa=0.0",
            )
        if self.mean not in MEANS:
            raise UnknownNameError("mean of quaternions", self.mean, MEANS, path="SigmaPoints.mean")

    def scale(self, n: int) -> float:
        """s, for n directions: how many standard deviations the outer points lie from the centre.

        Raises:
            DeclarationError: where n + kappa is not positive.
        """
        if not n + self.kappa > 0.0:
            raise DeclarationError(
                "kappa takes all the spread away",
                path="SigmaPoints.kappa",
                expected=f"kappa > -{n}, for {n} directions of state and noise",
                got=f"{self.kappa!r}",
                fix="write kappa=0.0",
            )
        return self.alpha * math.sqrt(n + self.kappa)

    def limits(self) -> tuple[Limit, ...]:
        """What a small alpha rules out: single precision and fixed point, below 0.1.

        The outer weights add up to n/s^2 = 1/alpha^2 (for kappa = 0), and a rounding of the images comes back
        multiplied by that: for alpha = 0.001 by 1e6, where single precision has 1.7e7 steps.
        """
        if self.alpha >= LEAST_ALPHA:
            return ()
        weight = 1.0 - 1.0 / self.alpha**2
        return (
            Limit(
                numbers=("float32", "fixed"),
                message="sigma points this close together drown in the rounding of these numbers",
                expected=f"alpha >= {LEAST_ALPHA} in float32 or fixed point",
                got=f"alpha={self.alpha:g}: the central weight is {weight:.3g}, and rounding is multiplied "
                "by as much",
                fix="write alpha=1.0 (points at sqrt(n + kappa) deviations), or compute in float64",
            ),
        )

    def reach(self, root: Array, scale: float, space: StateSpace | None, xp: Any) -> float | Reach:
        """The scale, or as much less as keeps every point of `space` within 0.9 of half a turn.

        A point beyond half a turn comes back from the other side, and an unknown heading would be taken for a
        known one. Nearer points of larger weight have the same covariance.
        """
        turns = [p.turn(root[..., on, :], xp) for p, _, on in space.places()] if space is not None else []
        sizes = [xp.max(turn, axis=(-2, -1), keepdims=True) for turn in turns if turn is not None]
        if not sizes:
            return scale
        most = sizes[0]
        for size in sizes[1:]:
            most = xp.maximum(most, size)
        far = most * scale > FARTHEST
        near = FARTHEST / xp.where(far, most, 1.0)
        return Reach(xp.where(far, near, scale), xp.where(far, 0.5 / (near * near), 0.5 / scale**2))

    def around(self, root: Array, scale: float | Reach, xp: Any) -> Array:
        """The outer points (..., 2 n, t), as tangent vectors: s times the columns of root (..., t, n), both
        ways."""
        columns = root.mT * (scale.scale if isinstance(scale, Reach) else scale)
        return xp.concat([columns, -columns], axis=-2)

    def cluster(self, images: Array, space: StateSpace | None, scale: float | Reach, xp: Any) -> Cluster:
        """The mean of images (..., 1 + 2 n, size), the first of them central, and how they lie about it."""
        first, others = images[..., :1, :], images[..., 1:, :]
        weight = _weight(scale)
        if space is None or not any(part.curved for part in space.parts):
            apart = others - first if space is None else space.minus(others, first, xp)
            shift = xp.sum(apart, axis=-2, keepdims=True) * weight
            mean = first + shift if space is None else space.plus(first, shift, xp)
            return Cluster(mean[..., 0, :], apart, -shift)
        apart = space.minus(others, first, xp)
        moves = [self._move(part, apart[..., on], weight, xp) for part, _, on in space.places()]
        mean = space.plus(first, xp.concat(moves, axis=-1), xp)
        seen = space.minus(images, mean, xp)
        centre = seen[..., :1, :]
        return Cluster(mean[..., 0, :], seen[..., 1:, :] - centre, centre)

    def _move(self, part: Part, apart: Array, weight: Any, xp: Any) -> Array:
        """How far (..., 1, t) the mean of a part lies from its central image."""
        if isinstance(part, Quaternion):
            return mean_turn(apart, weight, self.mean, xp)
        shift = xp.sum(apart, axis=-2, keepdims=True) * weight
        return mean_move(part, apart, shift, weight, xp) if part.curved else shift

    def covariance(self, a: Cluster, b: Cluster, scale: float | Reach) -> Array:
        """The covariance (..., t_a, t_b) of two clusters of the same points."""
        outer = a.outer.mT @ b.outer * _weight(scale)
        return outer + a.centre.mT @ b.centre * (self.beta - self.alpha**2)


GAUSSIAN = SigmaPoints()
"""What is taken where no set is named: alpha = 1, beta = 2, kappa = 0."""


def mean_turn(turns: Array, weight: float | Array, method: str, xp: Any) -> Array:
    """The turn (..., 1, 3) from a central attitude to the mean of it and others; rotation vectors, rad.

    "markley": the unit quaternion that minimises the weighted squared chordal distance to all, which is the
    dominant eigenvector of M = sum W_i q_i q_i^T. With q_i = (w_i, v_i) relative to the central one, whose
    weight is 1 - sum W, no large weight appears in it:

        M = [1 - W sum |v|^2   W sum w v^T]
            [W sum w v         W sum v v^T]

    M is squared six times, which is 64 steps of the power method from the centre, and where other
    eigenvectors remain another six times, which makes 4096. Where the centre has a negative weight and the
    others lie so far out that M is no more about it, the mean is that of the rotation vectors.

    "kraft": the attitude at which the weighted rotation vectors to all add up to zero, by 8 steps of gradient
    descent from the centre, m <- m * Exp(sum W_i Log(m^-1 q_i)). What remains is below 1e-11 rad for
    attitudes that spread by 0.7 rad about each axis, and below 1e-8 rad for 1 rad.

    Args:
        turns: (..., k, 3), from the central attitude to each of the others.
        weight: of each of the others.
        method: of `MEANS`.

    Source: Markley et al. 2007, eqs. 12-13; Kraft 2003, eqs. 52-55.
    """
    q = from_rotation_vector(turns, xp=xp)
    if method == "kraft":
        shift = xp.sum(turns, axis=-2, keepdims=True) * weight
        for _ in range(_STEPS):
            m = from_rotation_vector(shift, xp=xp)
            apart = to_rotation_vector(multiply(conjugate(m, xp=xp), q, xp=xp), xp=xp)
            # the centre, at -shift from m, has what weight the others leave: a deviation from it, again
            step = xp.sum(apart + shift, axis=-2, keepdims=True) * weight - shift
            shift = to_rotation_vector(multiply(m, from_rotation_vector(step, xp=xp), xp=xp), xp=xp)
        return shift
    v = q[..., 1:]
    both = q.mT @ v * weight  # (..., 4, 3): sum w v^T over sum v v^T
    ahead = 1.0 - xp.sum(xp.linalg.vecdot(v, v), axis=-1)[..., None, None] * weight
    M = xp.concat([xp.concat([ahead, both[..., :1, :].mT], axis=-2), both], axis=-1)
    M = 2.0 * M  # its trace is 2: the largest eigenvalue is at least 1/2, and no power of it vanishes
    for _ in range(_SQUARINGS):
        M = M @ M
    mean = to_rotation_vector(_dominant(M, xp), xp=xp)
    if isinstance(weight, float) and weight * turns.shape[-2] < 1.0 + 1e-9:
        return mean  # the centre's weight is not negative
    rest = both[..., 1:, :]
    lost = xp.sqrt(xp.sum(rest * rest, axis=(-2, -1), keepdims=True)) > ahead
    return xp.where(lost, xp.sum(turns, axis=-2, keepdims=True) * weight, mean)


def mean_move(part: Part, apart: Array, shift: Array, weight: Any, xp: Any) -> Array:
    """The move (..., 1, t) from a central element of a group to the mean of it and others.

    The element from which the weighted moves to all add up to zero, by 8 steps of gradient descent from the
    sum `shift` of the moves from the centre, as for "kraft".

    Args:
        part: of the state.
        apart: (..., k, t), from the central element to each of the others.
        weight: of each of the others.
    """
    centre = xp.asarray(part.rest, dtype=apart.dtype) + 0.0 * shift[..., :1]
    others = part.plus(centre, apart, xp)
    for _ in range(_STEPS):
        m = part.plus(centre, shift, xp)
        back = part.minus(centre, m, xp)
        step = xp.sum(part.minus(others, m, xp) - back, axis=-2, keepdims=True) * weight + back
        shift = part.minus(part.plus(m, step, xp), centre, xp)
    return shift


def _dominant(M: Array, xp: Any) -> Array:
    """The unit eigenvector (..., 1, 4) of a high power M (..., 4, 4), taken further where others remain.

    It is M's first column, or where that is small the one with the largest diagonal.
    """
    one = xp.eye(4, dtype=M.dtype)
    trace = lambda A: xp.sum(A * one, axis=(-2, -1), keepdims=True)
    N = M / trace(M)
    loose = xp.sum(N * N, axis=(-2, -1), keepdims=True) < 1.0 - 1e-12  # 1 where one eigenvalue is left
    if not isinstance(M, np.ndarray) or loose.any():  # of arrays, only where it will be taken
        N = 2.0 * N
        for _ in range(_SQUARINGS):
            N = N @ N
        M = xp.where(loose, N, M)
    column, most = M[..., :, :1].mT, M[..., :1, :1]
    enough = most > 0.01 * trace(M)
    for k in range(1, 4):
        size = M[..., k : k + 1, k : k + 1]
        larger = ~enough & (size > most)
        column, most = xp.where(larger, M[..., :, k : k + 1].mT, column), xp.where(larger, size, most)
    return column / xp.sqrt(xp.linalg.vecdot(column, column))[..., None]
