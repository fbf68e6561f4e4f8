"""A pose that an IMU carries and a motion capture sees, as models for any method of `filtering`.

    INERTIAL            position, velocity, attitude, each with an error of its own; nine numbers
    INERTIAL_BIASED     and the biases of gyroscope and accelerometer; fifteen
    INERTIAL_GROUP      the first as one element of SE_2(3), whose error the motion does not change in form

The motion is that of `unscented_pose`, in all of them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Result, Series
from flowgraph.blocks.geometry.groups import SE_2
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, error_jacobian
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.models.pose import POSE
from flowgraph.blocks.models.unscented_pose import carry_pose, imu_density, see_pose
from flowgraph.blocks.signals import Belief, Gaussian, Imu
from flowgraph.blocks.statespace import MeasurementModel, MotionModel

__all__ = [
    "INERTIAL",
    "INERTIAL_BIASED",
    "INERTIAL_GROUP",
    "inertial_crossing",
    "inertial_motion",
    "inertial_steps",
    "pose_seen",
    "stacked",
]

INERTIAL = StateSpace(position=euclidean(3), velocity=euclidean(3), attitude=quaternion())
"""m and m/s in the world, body to world."""

INERTIAL_BIASED = StateSpace(
    position=euclidean(3),
    velocity=euclidean(3),
    attitude=quaternion(),
    gyro_bias=euclidean(3),
    accelerometer_bias=euclidean(3),
)
"""And what the readings have too much: rad/s and m/s^2, body."""

INERTIAL_GROUP = StateSpace(body=SE_2(3))
"""Of the same ten numbers as `INERTIAL`."""


def inertial_motion(
    noise: ImuNoise, *, space: StateSpace = INERTIAL, gravity: tuple[float, float, float] = GRAVITY
) -> MotionModel:
    """How a pose moves on one reading of an `Imu`, held over the step, and its noise.

    Args:
        noise: of the IMU; those of the biases count where the space has some.
        space: one of this module.
        gravity: m/s^2, world.
    """
    carry = carry_pose(gravity)

    def plain(x: Any, imu: Imu, w: Array, dt: Any, xp: Any) -> Array:
        return carry(x[..., :10], imu, w * dt, dt, xp)

    def biased(x: Any, imu: Imu, w: Array, dt: Any, xp: Any) -> Array:
        bias = xp.concat([x.accelerometer_bias, x.gyro_bias], axis=-1)
        pose = carry(x[..., :10], imu, (w[..., :6] - bias) * dt, dt, xp)
        return xp.concat([pose, x[..., 10:] + w[..., 6:] * dt], axis=-1)

    density = imu_density(noise)
    if space.size == 10:
        return MotionModel(space, plain, density=density)
    walks = np.repeat([noise.gyro_bias**2, noise.accelerometer_bias**2], 3)
    return MotionModel(space, biased, density=np.diag([*np.diag(density), *walks]))


def pose_seen(
    position_noise: float,
    attitude_noise: float,
    *,
    space: StateSpace = INERTIAL,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> MeasurementModel:
    """What a motion capture sees: the position of a point of the body, and the attitude; a `Pose`.

    Args:
        position_noise, attitude_noise: standard deviations on each axis, m and rad.
        space: one of this module.
        lever: the point, m, body.
    """
    see = see_pose(lever)

    def observe(x: Any, xp: Any) -> Array:
        return see(x[..., :10], xp)

    noise = np.repeat([position_noise**2, attitude_noise**2], 3)
    return MeasurementModel(space, observe, noise=noise, measured_space=POSE)


def inertial_crossing(belief: Belief, imu: Imu, dt: Any, xp: Any) -> Array:
    """What `cross_covariance` asks of a filter that predicts with `inertial.predict`."""
    return belief.covariance @ error_jacobian(belief, imu, dt, xp).mT


def inertial_steps(result: Result) -> Steps:
    """Those of a run of `ins_eskf` that was wired for a smoother; over `INERTIAL_BIASED`."""
    prior, posterior = (Series(s.time, stacked(s.values)) for s in (result["prior"], result["belief"]))
    return Steps(prior, posterior, result["cross"], INERTIAL_BIASED, _beliefs)


def stacked(belief: Belief) -> Gaussian:
    """A belief, or one at each tick, over `INERTIAL_BIASED`."""
    mean = np.concatenate([getattr(belief, part) for part in INERTIAL_BIASED.names], axis=-1)
    return Gaussian(mean=mean, covariance=np.asarray(belief.covariance))


def _beliefs(smoothed: Series) -> Series:
    p, v, q, b_g, b_a = np.split(smoothed["mean"], (3, 6, 10, 13), axis=-1)
    belief = Belief(p, v, q, b_g, b_a, smoothed["covariance"])
    return Series(smoothed.time, belief, name=smoothed.name)
