"""What navigation outdoors reads and believes: fixes of satellites with their own covariance, heights,
wheels."""

from __future__ import annotations

from flowgraph import Array, Signal, real

__all__ = [
    "GnssFix",
    "GnssHeading",
    "GnssPosition",
    "GnssVelocity",
    "Height",
    "NavigationBelief",
    "WheelSpeed",
]


class GnssFix(Signal):
    """A position on the Earth (WGS84) as a receiver gives it, with its own covariance (m^2) east, north,
    up."""

    latitude: Array = real(unit="rad", frame="WGS84")
    longitude: Array = real(unit="rad", frame="WGS84")
    height: Array = real(unit="m", frame="WGS84")
    covariance: Array = real(3, 3, unit="m^2", frame="world")


class GnssPosition(Signal):
    """A measured position of an antenna, m, and the covariance of this measurement, m^2."""

    position: Array = real(3, unit="m", frame="world")
    covariance: Array = real(3, 3, unit="m^2", frame="world")


class GnssVelocity(Signal):
    """A measured velocity, m/s, and the covariance of this measurement, (m/s)^2. A component may be NaN."""

    velocity: Array = real(3, unit="m/s", frame="world")
    covariance: Array = real(3, 3, unit="m^2/s^2", frame="world")


class GnssHeading(Signal):
    """The direction from one antenna to another, by both: angle (rad) from the world's x axis to it, to the
    left, and its standard deviation (rad)."""

    angle: Array = real(unit="rad", frame="world")
    deviation: Array = real(unit="rad")


class Height(Signal):
    """A height by the pressure of the air, m, above a level of which nothing is known."""

    height: Array = real(unit="m", frame="world")


class WheelSpeed(Signal):
    """The speed along the body's x axis as wheels tell it, m/s; NaN where it is not measured."""

    speed: Array = real(unit="m/s", frame="body")


class NavigationBelief(Signal):
    """A `Belief` with further numbers that a filter estimates, behind its fifteen in the covariance.

    parameters: those that were chosen when the filter was built, in their order: the lever of the antenna
    (3, m, body), scale factors of gyroscope and accelerometer (3 each), the time by which fixes are late (s),
    the level of the barometer (m).
    """

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    accelerometer_bias: Array = real(3, unit="m/s^2", frame="body")
    parameters: Array = real("m")
    covariance: Array = real("t", "t")
