"""How a pose moves on what an IMU reads and how a motion capture sees it, for filters of sigma points.

State x = (p, v, q): position (m) and velocity (m/s) in the world, attitude body to world; ten numbers, whose
errors are nine, in the order of `PoseBelief`. The functions take many states at once, one a row, and the
noise of the IMU as an argument of its own.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Result, Series, block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, rotate
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.smoothing import Steps, steps_of
from flowgraph.blocks.signals import Gaussian, Imu, Pose, PoseBelief

__all__ = [
    "STATE",
    "carry_pose",
    "imu_density",
    "named_pose",
    "see_pose",
    "start_state",
    "state_at_start",
    "unscented_steps",
]

STATE = StateSpace(euclidean(6), quaternion())
"""Position, velocity, attitude."""


def carry_pose(gravity: tuple[float, float, float] = GRAVITY) -> Callable[..., Array]:
    """The motion over dt seconds with one reading (w, f), held, and noise (n_a, n_w), its integral in m/s and
    rad.

        r = w dt + n_w      push = R(q * Exp(r/2)) (f dt + n_a) + gravity dt
        p' = p + (v + push/2) dt      v' = v + push      q' = q * Exp(r)
    """

    def move(x: Array, imu: Imu, noise: Array, dt: Any, xp: Any) -> Array:
        p, v, q = x[..., :3], x[..., 3:6], x[..., 6:]
        turn = (imu.gyro * dt)[..., None, :] + noise[..., 3:]
        force = (imu.specific_force * dt)[..., None, :] + noise[..., :3]
        half = multiply(q, from_rotation_vector(0.5 * turn, xp=xp), xp=xp)
        push = rotate(half, force, xp=xp) + xp.asarray(gravity, dtype=x.dtype) * dt
        turned = multiply(q, from_rotation_vector(turn, xp=xp), xp=xp)
        return xp.concat([p + (v + 0.5 * push) * dt, v + push, turned], axis=-1)

    return move


def imu_density(noise: ImuNoise) -> np.ndarray:
    """The spectral density (6, 6) of the noise that `carry_pose` takes."""
    return np.diag([noise.accelerometer**2] * 3 + [noise.gyro**2] * 3)


def see_pose(lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Callable[..., Array]:
    """What a motion capture sees of x: (p + R(q) lever, q), the lever in m, body."""

    def observe(x: Array, xp: Any) -> Array:
        p, q = x[..., :3], x[..., 6:]
        arm = xp.asarray(lever, dtype=x.dtype)
        return xp.concat([p + rotate(q, arm, xp=xp), q], axis=-1)

    return observe


def start_state(
    position: npt.ArrayLike,
    attitude: npt.ArrayLike,
    *,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    position_deviation: float = 0.7,
    velocity_deviation: float = 0.7,
    attitude_deviation: float = 0.3,
) -> Gaussian:
    """A belief over (p, v, q) to start from, with standard deviations in m, m/s and rad (about each body
    axis)."""
    mean = np.concatenate([np.asarray(part, dtype=float) for part in (position, velocity, attitude)])
    return Gaussian(mean=mean, covariance=_apart(position_deviation, velocity_deviation, attitude_deviation))


def _apart(*deviations: float) -> np.ndarray:
    return np.diag(np.repeat(deviations, 3) ** 2)


@block
def state_at_start(
    pose: Pose, *, deviations: tuple[float, float, float] = (0.7, 0.7, 0.3), xp: Any
) -> Gaussian:
    """`start_state` at a measured pose and at rest; deviations in m, m/s and rad."""
    mean = xp.concat([pose.position, 0.0 * pose.position, pose.attitude])
    return Gaussian(mean=mean, covariance=xp.asarray(_apart(*deviations), dtype=mean.dtype))


@block
def named_pose(belief: Gaussian) -> PoseBelief:
    """The belief over (p, v, q) with names and units."""
    x = belief.mean
    return PoseBelief(
        position=x[..., :3], velocity=x[..., 3:6], attitude=x[..., 6:], covariance=belief.covariance
    )


def unscented_steps(result: Result) -> Steps:
    """Those of a run of `ukf` that was wired for a smoother."""
    return steps_of(result, STATE)._replace(named=_named)


def _named(smoothed: Series) -> Series:
    belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
    return Series(smoothed.time, named_pose.step(belief), name=smoothed.name)
