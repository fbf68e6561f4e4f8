"""Where a body is and how it moves: positions, velocities, attitudes, and several of them at once."""

from __future__ import annotations

from typing import Self

import numpy as np

from flowgraph import Array, Signal, real

__all__ = [
    "GRAVITY",
    "Position",
    "Velocity",
    "Attitude",
    "Pose",
    "PoseEstimate",
    "NavigationState",
    "MotionTruth",
    "GeodeticPosition",
    "WorldAcceleration",
    "WorldForce",
    "PlanePosition",
    "PlaneVelocity",
]

GRAVITY = (0.0, 0.0, -9.81)
"""Gravity in the world, m/s^2: z is up."""


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


class PoseEstimate(Signal):
    """The expected pose of a belief: position (m, world), velocity (m/s, world) and attitude."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")


class NavigationState(Signal):
    """Position (m), velocity (m/s), attitude and the biases of the inertial unit: what a full truth holds."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    accelerometer_bias: Array = real(3, unit="m/s^2", frame="body")


class MotionTruth(Signal):
    """What a motion capture knows: pose, velocity (world) and angular rate (body)."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    rate: Array = real(3, unit="rad/s", frame="body")


class GeodeticPosition(Signal):
    """A position on the Earth (WGS84): latitude and longitude in rad, height above the ellipsoid in m."""

    latitude: Array = real(unit="rad", frame="WGS84")
    longitude: Array = real(unit="rad", frame="WGS84")
    height: Array = real(unit="m", frame="WGS84")


class WorldAcceleration(Signal):
    """The second derivative of position, m/s^2, in world coordinates."""

    acceleration: Array = real(3, unit="m/s^2", frame="world")

    @classmethod
    def at_rest(cls) -> Self:
        """None."""
        return cls(acceleration=np.zeros(3))


class WorldForce(Signal):
    """A specific force in world coordinates, m/s^2; (0, 0, 9.81) at rest."""

    force: Array = real(3, unit="m/s^2", frame="world")

    @classmethod
    def at_rest(cls) -> WorldForce:
        """That of a body that does not accelerate."""
        return cls(force=-np.array(GRAVITY))


class PlanePosition(Signal):
    """A position in the plane, m."""

    position: Array = real(2, unit="m", frame="world")


class PlaneVelocity(Signal):
    """The mean velocity in the plane since the reading before, m/s."""

    velocity: Array = real(2, unit="m/s", frame="world")
