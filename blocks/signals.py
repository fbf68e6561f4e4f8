"""What the wires of an inertial filter carry: each quantity a type of its own, with its unit and frame.

Body is the frame of the inertial unit; world has z up. An attitude is a unit quaternion, Hamilton, scalar
first `(w, x, y, z)`, body to world.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from flowgraph import Array, Signal, boolean, integer, real

__all__ = [
    "Imu",
    "Gyro",
    "SpecificForce",
    "CoordinateAcceleration",
    "Position",
    "Velocity",
    "Attitude",
    "Pose",
    "NavigationState",
    "Belief",
    "Innovation",
    "Cloud",
    "Weights",
    "LogLikelihood",
    "Ancestors",
    "PoseEstimate",
    "GeodeticPosition",
    "MagneticField",
    "Range",
    "OpticalFlow",
    "Thrust",
    "BodyRate",
]


class Imu(Signal):
    """What an inertial unit reads: angular rate (rad/s) and specific force (m/s^2), both in the body."""

    gyro: Array = real(3, unit="rad/s", frame="body")
    specific_force: Array = real(3, unit="m/s^2", frame="body")

    @classmethod
    def at_rest(cls, gravity: float = 9.81) -> Self:
        """The reading of a level unit that does not move: no rate, and `gravity` m/s^2 upwards."""
        return cls(gyro=np.zeros(3), specific_force=np.array([0.0, 0.0, gravity]))


class Gyro(Signal):
    """Angular rate of the body relative to the world, in body coordinates, rad/s."""

    rate: Array = real(3, unit="rad/s", frame="body")


class SpecificForce(Signal):
    """What an accelerometer reads: all but gravity, per mass; +9.81 m/s^2 upwards at rest. Body frame."""

    force: Array = real(3, unit="m/s^2", frame="body")


class CoordinateAcceleration(Signal):
    """The second derivative of position, m/s^2, in body coordinates: zero at rest.

    Not what an accelerometer reads (that is `SpecificForce`); the thesis's accelerometer is of this type.
    """

    acceleration: Array = real(3, unit="m/s^2", frame="body")


class Position(Signal):
    """A position in the world, m. Of which point (origin, prism, antenna) is a setting of who reads it."""

    position: Array = real(3, unit="m", frame="world")


class Velocity(Signal):
    """A velocity in the world, m/s."""

    velocity: Array = real(3, unit="m/s", frame="world")


class Attitude(Signal):
    """An attitude: unit quaternion (w, x, y, z), Hamilton, body to world."""

    attitude: Array = real(4, unit="1", frame="world<-body")


class Pose(Signal):
    """A position (m, world) and an attitude (unit quaternion, body to world), as motion capture gives."""

    position: Array = real(3, unit="m", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")


class NavigationState(Signal):
    """Position (m), velocity (m/s), attitude and the biases of the inertial unit: what a full truth holds."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    accelerometer_bias: Array = real(3, unit="m/s^2", frame="body")


class Belief(Signal):
    """The Gaussian belief of a 15-state error-state filter: a nominal state and the covariance of its error.

    Error order, three each: position (m, world), velocity (m/s, world), attitude (rad, right rotation vector
    in the body: q_true = q * Exp(error)), gyro bias (rad/s, body), accelerometer bias (m/s^2, body). A bias
    is what the reading has too much: reading = truth + bias + noise.
    """

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    accelerometer_bias: Array = real(3, unit="m/s^2", frame="body")
    covariance: Array = real(15, 15)


class Innovation(Signal):
    """What a three-part measurement said beyond its prediction.

    residual: measured minus predicted (m in the world, or rad in the body); covariance: of the residual, as
    the filter expects it; nis: normalised innovation squared, r^T covariance^-1 r, 3 on average.
    """

    residual: Array = real(3)
    covariance: Array = real(3, 3)
    nis: Array = real()


class Cloud(Signal):
    """A Rao-Blackwellized particle cloud: attitude by particles, velocity and position Gaussian given each.

    Struct of arrays: the particle is the last axis of every field, so that one operation runs over all of
    them.

    log_weight: natural logarithm of the weights, which add up to 1. velocity, position: means, m/s and m,
    world. velocity_covariance (m^2/s^2), cross_covariance (m^2/s; rows position, columns velocity) and
    position_covariance (m^2): the blocks of the covariance of (velocity, position), each 3 x 3.
    """

    log_weight: Array = real("particles")
    attitude: Array = real(4, "particles", unit="1", frame="world<-body")
    velocity: Array = real(3, "particles", unit="m/s", frame="world")
    position: Array = real(3, "particles", unit="m", frame="world")
    velocity_covariance: Array = real(3, 3, "particles")
    cross_covariance: Array = real(3, 3, "particles")
    position_covariance: Array = real(3, 3, "particles")


class Weights(Signal):
    """The weights of a cloud, one a particle; they add up to 1."""

    weight: Array = real("particles")


class LogLikelihood(Signal):
    """The logarithm of a measurement's density given each particle."""

    value: Array = real("particles")


class Ancestors(Signal):
    """Which particle each new one is a copy of, and whether the cloud was resampled at all."""

    index: Array = integer("particles")
    resampled: Array = boolean()


class PoseEstimate(Signal):
    """The expected pose of a belief: position (m, world), velocity (m/s, world) and attitude."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")


class GeodeticPosition(Signal):
    """A position on the Earth (WGS84): latitude and longitude in rad, height above the ellipsoid in m."""

    latitude: Array = real(unit="rad", frame="WGS84")
    longitude: Array = real(unit="rad", frame="WGS84")
    height: Array = real(unit="m", frame="WGS84")


class MagneticField(Signal):
    """The magnetic field in body coordinates, T; the Earth's is 25e-6 to 65e-6."""

    field: Array = real(3, unit="T", frame="body")


class Range(Signal):
    """The distance to the ground (world z = 0) along the body's z axis, downwards, m."""

    distance: Array = real(unit="m", frame="body")


class OpticalFlow(Signal):
    """How the body moved over the interval that ends now; before and after are its two ends.

    displacement: m, R(q_before)^T (p_after - p_before): in body coordinates of before.
    turn: unit quaternion, q_before^-1 q_after.
    interval: s.
    """

    displacement: Array = real(3, unit="m", frame="body")
    turn: Array = real(4, unit="1", frame="body<-body")
    interval: Array = real(unit="s")


class Thrust(Signal):
    """The commanded thrust per mass, along body z, m/s^2; 9.81 at hover."""

    thrust: Array = real(unit="m/s^2", frame="body")


class BodyRate(Signal):
    """The commanded angular rate of the body, in body coordinates, rad/s. What is measured is `Gyro`."""

    rate: Array = real(3, unit="rad/s", frame="body")
