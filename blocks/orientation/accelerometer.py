"""Orientation from an inertial unit alone: attitude and body rate by sigma points, and two simple baselines.

State x = (q, w): attitude body to world, and body rate (rad/s). Nothing drives it: the rate is a random walk,
and the gyroscope measures it. Gravity is all that an accelerometer is expected to read, so what accelerates
the body is noise; the heading is not measured, and drifts.

Source: E. Kraft, "A quaternion-based unscented Kalman filter for orientation tracking", Fusion 2003. Two of
its steps are made to agree: the noise and the correction of the attitude multiply from the right, in the
body, as the rate does.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Result, Series, block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, rotate
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.kalman.smoothing import Steps, steps_of
from flowgraph.blocks.signals import Attitude, AttitudeRateBelief, Gaussian, Imu
from flowgraph.blocks.unscented.filters import motion_cross
from flowgraph.blocks.unscented.sigma_points import SigmaPoints

__all__ = [
    "STATE",
    "OrientationBelief",
    "named_orientation",
    "orientation_crossing",
    "orientation_steps",
    "roll_pitch_attitude",
    "see_rate_and_gravity",
    "stacked_imu",
    "start_orientation",
    "turn_by_rate",
]

OrientationBelief = AttitudeRateBelief
"""The older name of the belief over attitude and body rate."""

STATE = StateSpace(quaternion(), euclidean(3))
"""Attitude, body rate."""


def turn_by_rate(x: Array, control: Any, noise: Array | None, dt: Any, xp: Any) -> Array:
    """The motion over dt seconds: q' = q * Exp(w dt), w' = w (Kraft eqs. 8-12), without noise."""
    q, w = x[..., :4], x[..., 4:]
    return xp.concat([multiply(q, from_rotation_vector(w * dt, xp=xp), xp=xp), w], axis=-1)


def orientation_crossing(Q: npt.ArrayLike, points: SigmaPoints) -> Callable[..., Array]:
    """What `cross_covariance` asks of a filter whose noise is added before the points are drawn.

        D = P (P + Q dt)^-1 D'      D' of the points, which are drawn from P + Q dt

    Args:
        Q: (6, 6), its spectral density.
        points: the set of sigma points.
    """

    def crossing(belief: Gaussian, control: Any, dt: Any, xp: Any) -> Array:
        P = belief.covariance
        wide = P + xp.asarray(np.asarray(Q), dtype=P.dtype) * dt
        carry = lambda x, w: turn_by_rate(x, control, w, dt, xp)
        drawn = motion_cross(belief.mean, wide, carry, None, space=STATE, points=points, xp=xp)
        return P @ xp.linalg.solve(wide, drawn)

    return crossing


def orientation_steps(result: Result) -> Steps:
    """Those of a run of `quaternion_ukf` that was wired for a smoother."""

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        return Series(smoothed.time, named_orientation.step(belief), name=smoothed.name)

    return steps_of(result, STATE)._replace(named=named)


def see_rate_and_gravity(x: Array, xp: Any) -> Array:
    """What an inertial unit that does not accelerate reads: (w, -R(q)^T gravity), rad/s and m/s^2."""
    q, w = x[..., :4], x[..., 4:]
    up = 0.0 * w - xp.asarray(GRAVITY, dtype=x.dtype)
    return xp.concat([w, rotate(conjugate(q, xp=xp), up, xp=xp)], axis=-1)


@block
def stacked_imu(imu: Imu, *, xp: Any) -> Array:
    """A reading as one vector (6): rate (rad/s), specific force (m/s^2)."""
    return xp.concat([imu.gyro, imu.specific_force], axis=-1)


@block
def named_orientation(belief: Gaussian) -> AttitudeRateBelief:
    """The belief over (q, w) with names and units."""
    x = belief.mean
    return AttitudeRateBelief(attitude=x[..., :4], rate=x[..., 4:], covariance=belief.covariance)


def start_orientation(
    attitude: npt.ArrayLike, *, attitude_deviation: float = 0.1, rate_deviation: float = 0.1
) -> Gaussian:
    """A belief over (q, w) of a body that does not turn, with standard deviations in rad and rad/s."""
    mean = np.concatenate([np.asarray(attitude, dtype=float), np.zeros(3)])
    return Gaussian(mean=mean, covariance=np.diag(np.repeat([attitude_deviation, rate_deviation], 3) ** 2))


@block
def roll_pitch_attitude(imu: Imu, *, xp: Any) -> Attitude:
    """The attitude whose roll and pitch the specific force shows, and whose yaw is zero.

        roll = atan2(f_y, f_z)      pitch = atan2(-f_x, hypot(f_y, f_z))      q = Ry(pitch) Rx(roll)

    Right when the body does not accelerate. Fires with each reading. No state.
    """
    f = imu.specific_force
    x, y, z = f[..., 0:1], f[..., 1:2], f[..., 2:3]
    roll, pitch = xp.atan2(y, z), xp.atan2(-x, xp.hypot(y, z))
    about_x = xp.concat([roll, 0.0 * roll, 0.0 * roll], axis=-1)
    about_y = xp.concat([0.0 * pitch, pitch, 0.0 * pitch], axis=-1)
    turns = (from_rotation_vector(turn, xp=xp) for turn in (about_y, about_x))
    return Attitude(attitude=multiply(*turns, xp=xp))
