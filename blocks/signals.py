"""What the wires of an inertial filter carry: each quantity a type of its own, with its unit and frame.

Body is the frame of the inertial unit; world has z up. An attitude is a unit quaternion, Hamilton, scalar
first `(w, x, y, z)`, body to world.
"""

from __future__ import annotations

from typing import Self

import numpy as np

from flowgraph import Array, Signal, real

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
    """The second derivative of position, m/s^2, world: zero at rest. Not what an accelerometer reads."""

    acceleration: Array = real(3, unit="m/s^2", frame="world")


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
