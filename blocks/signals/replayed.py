"""What smoothers and batch estimates are told beside the readings themselves."""

from __future__ import annotations

from flowgraph import Array, Signal, real

__all__ = ["BankStep", "CameraVelocity", "CloneDrive", "TurningSpeed", "TurningVelocity"]


class BankStep(Signal):
    """A tick of a bank of k filters, as its smoother needs it; pairs are of a filter (rows) and a motion.

    chance: (k, k) that motion i becomes j over the step to this tick. prior_mean, prior_covariance: what the
    belief of filter i at the tick before becomes with motion j. cross: (t, t) each, of both.
    """

    chance: Array = real("models", "models")
    prior_mean: Array = real("models", "models", "n")
    prior_covariance: Array = real("models", "models", "t", "t")
    cross: Array = real("models", "models", "t", "t")


class CameraVelocity(Signal):
    """A camera's velocity, and the rate of the body that goes with it: from the gyroscope, with its bias, or
    from the camera."""

    velocity: Array = real(3, unit="m/s", frame="camera")
    rate: Array = real(3, unit="rad/s", frame="body")


class CloneDrive(Signal):
    """What drives a step: the IMU's readings, and 1 where the step begins at a picture, else 0."""

    gyro: Array = real(3, unit="rad/s", frame="body")
    specific_force: Array = real(3, unit="m/s^2", frame="body")
    picture: Array = real()


class TurningSpeed(Signal):
    """A speed of wheels, and what the gyroscope read at its time."""

    speed: Array = real(unit="m/s", frame="body")
    gyro: Array = real(3, unit="rad/s", frame="body")


class TurningVelocity(Signal):
    """A velocity, its covariance, and what the gyroscope read at its time."""

    velocity: Array = real(3, unit="m/s", frame="world")
    covariance: Array = real(3, 3, unit="m^2/s^2", frame="world")
    gyro: Array = real(3, unit="rad/s", frame="body")
