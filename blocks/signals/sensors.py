"""What sensors read and actuators are told, each in the unit and frame of its device."""

from __future__ import annotations

from typing import Self

import numpy as np

from flowgraph import Array, Signal, real

__all__ = [
    "Imu",
    "ImuCounts",
    "Gyro",
    "SpecificForce",
    "CoordinateAcceleration",
    "MagneticField",
    "Range",
    "OpticalFlow",
    "Thrust",
    "BodyRate",
    "PointReading",
    "Steering",
]


class Imu(Signal):
    """What an inertial unit reads: angular rate (rad/s) and specific force (m/s^2), both in the body."""

    gyro: Array = real(3, unit="rad/s", frame="body")
    specific_force: Array = real(3, unit="m/s^2", frame="body")

    @classmethod
    def at_rest(cls, gravity: float | tuple[float, float, float] = 9.81) -> Self:
        """The reading of a level unit that does not move: no rate, and a force that holds it up.

        Args:
            gravity: m/s^2, downwards; or the vector of it in the world.
        """
        down = np.asarray((0.0, 0.0, -gravity) if np.ndim(gravity) == 0 else gravity, dtype=float)  # type: ignore[operator]
        return cls(gyro=np.zeros(3), specific_force=0.0 - down)


class ImuCounts(Signal):
    """What the converters of an inertial unit give, before any calibration: counts, in the body's axes."""

    gyro: Array = real(3, frame="body")
    force: Array = real(3, frame="body")


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


class PointReading(Signal):
    """A control and what was measured with it: acceleration (m/s^2) and position (m), both world.

    A coordinate that was not measured is NaN; an acceleration too, where there was no control.
    """

    acceleration: Array = real(3, unit="m/s^2", frame="world")
    position: Array = real(3, unit="m", frame="world")


class Steering(Signal):
    """What a driver does: the angle of the front wheels (rad, to the left) and the acceleration (m/s^2)."""

    angle: Array = real(unit="rad")
    acceleration: Array = real(unit="m/s^2")
