"""Every Jacobian that the library has by hand, as the step of the block that uses it, beside the same step
with the derivative of the model's own lines.

A step takes a belief, its mean `x` and covariance `P`, and a reading `z`, and gives a belief. By hand it is
the library's block. Derived, the block's model is written once, as what a state becomes or what would be
measured of it, `jacobian` says the rest, and prediction and correction are those that all filters share.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.filters import correct, moved
from flowgraph.blocks.models import pose
from flowgraph.blocks.signals import (
    Gaussian,
    Imu,
)

__all__ = [
    "DT",
    "LEVER",
    "NOISE",
    "Pair",
    "SIGMA",
    "Step",
    "corrected",
    "drawn",
    "gaussian",
    "imu_of",
    "imu_reading",
    "pose_reading",
    "predicted",
    "state",
    "vector",
]

Step = Callable[[Array, Array, Array, Any, Any], Gaussian]
"""`step(x, P, z, dt, xp)`: a belief after a step, or with a measurement."""

DT = 0.005
"""s, of a step: 200 Hz."""

NOISE = ImuNoise(gyro=1e-3, accelerometer=1e-2, gyro_bias=1e-5, accelerometer_bias=1e-4)
LEVER = (0.3, -0.2, 0.1)
SIGMA = 0.1
"""Of every measurement here, in its units."""


@dataclass(frozen=True)
class Pair:
    """A step with a Jacobian by hand, and without.

    Args:
        graphs: of the library that take the step.
        space: of the belief.
        reading: `reading(rng) -> z`.
        by_hand, derived: the step.
        bound: by how much they may differ: means relative to max(1, |x|), covariances to the deviations.
        start: `start(rng) -> x`; any state of the space if left out.
    """

    graphs: tuple[str, ...]
    space: StateSpace
    reading: Callable[[np.random.Generator], np.ndarray]
    by_hand: Step
    derived: Step
    bound: float = 1e-9
    start: Callable[[np.random.Generator], np.ndarray] | None = None


def drawn(pair: Pair, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A mean, a covariance and a reading to take the step with."""
    x = state(rng, pair.space) if pair.start is None else pair.start(rng)
    A = rng.normal(size=(pair.space.tangent,) * 2)
    return x, 0.01 * (A @ A.T / len(A) + 0.1 * np.eye(len(A))), pair.reading(rng)


def state(rng: np.random.Generator, space: StateSpace) -> np.ndarray:
    """Any state: attitudes of all, and vectors of about 1."""
    return np.asarray(space.plus(space.rest, rng.normal(size=space.tangent), np))


def imu_reading(rng: np.random.Generator) -> np.ndarray:
    """A turn of 1 rad/s about any axis, and a force of about 10 m/s^2 on each."""
    axis = rng.normal(size=3)
    return np.concatenate([axis / np.linalg.norm(axis), 10.0 * rng.normal(size=3)])


def vector(n: int) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: rng.normal(size=n)


def pose_reading(rng: np.random.Generator) -> np.ndarray:
    return state(rng, pose.POSE)


def imu_of(z: Array) -> Imu:
    return Imu(gyro=z[..., 0:3], specific_force=z[..., 3:6])


def predicted(mean: Array, F: Array, P: Array, before: Any, after: Any) -> Gaussian:
    """F (P + before) F^T + after."""
    P = F @ (P + before) @ F.mT + after
    return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))


def corrected(
    space: StateSpace,
    h: Callable[..., Array],
    measured: Callable[[Array, Any], Array],
    R: Callable[[Any], Any],
    seen: StateSpace | None = None,
    *,
    reset: bool = True,
) -> Step:
    """The correction by z = h(x, z, xp) + noise."""

    def step(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
        target = measured(z, xp)
        over = StateSpace(euclidean(target.shape[-1])) if seen is None else seen
        y, H = linearised(lambda s, xp: h(s, z, xp), x, space, xp, seen=over)
        noise = xp.asarray(R(z), dtype=x.dtype)
        apart = over.minus(target, y, xp)
        found = correct(P, apart, H, noise, space=space if reset else None, xp=xp)
        return Gaussian(mean=moved(x, found.shift, space, xp), covariance=found.covariance)

    return step


def gaussian(b: Any, xp: Any) -> Gaussian:
    parts = [getattr(b, name) for name in b._fields if name != "covariance"]
    return Gaussian(mean=xp.concat(parts, axis=-1), covariance=b.covariance)
