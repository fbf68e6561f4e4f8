"""What a filter believes: Gaussians with and without names, and what a measurement said beyond them.

The covariance of a belief with an attitude is that of its error, in which the attitude has three numbers: a
right rotation vector in the body, q_true = q * Exp(error).
"""

from __future__ import annotations

from flowgraph import Array, Signal, boolean, real

__all__ = [
    "Gaussian",
    "GaussianRoot",
    "Bank",
    "CrossCovariance",
    "FilterStep",
    "SmoothedBelief",
    "KalmanInnovation",
    "Innovation",
    "Belief",
    "PointBelief",
    "PoseBelief",
    "QuaternionBelief",
    "EulerAngles",
    "AttitudeBelief",
    "AttitudeRateBelief",
    "AttitudeBiasBelief",
    "LevelBelief",
    "HeadingBelief",
]


class Gaussian(Signal):
    """A Gaussian belief: its mean (n) and its covariance (t, t) in the tangent space; t = n for vectors."""

    mean: Array = real("n")
    covariance: Array = real("t", "t")


class GaussianRoot(Signal):
    """A Gaussian belief by the lower triangular root of its covariance: covariance = root root^T."""

    mean: Array = real("n")
    root: Array = real("t", "t")


class GaussianInformation(Signal):
    """A Gaussian belief by the inverse of its covariance."""

    mean: Array = real("n")
    information: Array = real("t", "t")


class Bank(Signal):
    """Gaussian beliefs under several models: how likely each is (weights add up to 1), and what it says."""

    weight: Array = real("models")
    mean: Array = real("models", "n")
    covariance: Array = real("models", "t", "t")


class CrossCovariance(Signal):
    """What a belief and what was predicted of it have in common: the covariance of the errors of the belief
    before a step (rows) and of the prediction after it (columns). Of a linear prediction it is P F^T."""

    covariance: Array = real("t", "t")


class FilterStep(Signal):
    """One tick of a filter, as a smoother needs it.

    mean, covariance: the belief after the tick's measurements. prior_mean, prior_covariance: before them.
    cross: of the belief of the tick before (rows) and this prior; of the first tick it does not matter.
    """

    mean: Array = real("n")
    covariance: Array = real("t", "t")
    prior_mean: Array = real("n")
    prior_covariance: Array = real("t", "t")
    cross: Array = real("t", "t")


class SmoothedBelief(Signal):
    """A belief that knows what was measured later.

    mean, covariance: as of a `Gaussian`. lag_one: the covariance of the error of the tick after it (rows) and
    of its own, zero at the last.
    """

    mean: Array = real("n")
    covariance: Array = real("t", "t")
    lag_one: Array = real("t", "t")


class KalmanInnovation(Signal):
    """What a measurement said beyond its prediction.

    residual: measured minus predicted, 0 where an entry is missing. covariance: of the residual, as the
    filter expects it; 1 on the diagonal where an entry is missing. nis: residual^T covariance^-1 residual.
    parts: how many entries there were, which is the mean of `nis` in a consistent filter. accepted: whether
    it passed the gate.
    """

    residual: Array = real("m")
    covariance: Array = real("m", "m")
    nis: Array = real()
    parts: Array = real()
    accepted: Array = boolean()


Innovation = KalmanInnovation
"""What it was called while measurements of three numbers had a type of their own."""


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


class PointBelief(Signal):
    """The belief about a point: position (m) and velocity (m/s), world, with the covariance of both."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    covariance: Array = real(6, 6)


class PoseBelief(Signal):
    """A belief about position (m), velocity (m/s) and attitude, with the covariance of its error.

    Error order, three each: position, velocity (world), attitude (rad, right rotation vector in the body),
    which is the nine-dimensional tangent space in which a NEES is taken.
    """

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    covariance: Array = real(9, 9)


class QuaternionBelief(Signal):
    """A Gaussian belief over (velocity, position, quaternion), ten numbers; covariance in that order.

    velocity: m/s, world. position: m, world. attitude: unit quaternion, body to world.
    """

    velocity: Array = real(3, unit="m/s", frame="world")
    position: Array = real(3, unit="m", frame="world")
    attitude: Array = real(4, unit="1", frame="world<-body")
    covariance: Array = real(10, 10)


class EulerAngles(Signal):
    """The attitude as the filter holds it, and how far it is from where its angles fail.

    angles: phi, theta, psi, rad. cosine: that of the angle that must stay off +-90 degrees; below 0.02 the
    rates of the angles are held finite, and are wrong. deviations: of the angles, rad.
    """

    angles: Array = real(3, unit="rad")
    cosine: Array = real()
    deviations: Array = real(3, unit="rad")


class AttitudeBelief(Signal):
    """An attitude and the covariance (rad^2) of its error, a right rotation vector in the body."""

    attitude: Array = real(4, unit="1", frame="world<-body")
    covariance: Array = real(3, 3, unit="rad^2")


class AttitudeRateBelief(Signal):
    """A belief about attitude and body rate (rad/s), with the covariance of its error.

    Error order, three each: attitude (rad, right rotation vector in the body), rate (rad/s, body).
    """

    attitude: Array = real(4, unit="1", frame="world<-body")
    rate: Array = real(3, unit="rad/s", frame="body")
    covariance: Array = real(6, 6)


class AttitudeBiasBelief(Signal):
    """A Gaussian belief about attitude and gyroscope bias.

    Error order, three each: attitude (rad, right rotation vector in the body), gyroscope bias (rad/s, body).
    """

    attitude: Array = real(4, unit="1", frame="world<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    covariance: Array = real(6, 6)


class LevelBelief(Signal):
    """A Gaussian belief about velocity, tilt and gyroscope bias, in a frame with z up and a free heading.

    Error order, three each: velocity (m/s, level), attitude (rad, right rotation vector in the body), bias
    (rad/s, body). A bias is what the reading has too much.
    """

    velocity: Array = real(3, unit="m/s", frame="level")
    attitude: Array = real(4, unit="1", frame="level<-body")
    gyro_bias: Array = real(3, unit="rad/s", frame="body")
    covariance: Array = real(9, 9)


class HeadingBelief(Signal):
    """The angle (rad) about the vertical from the level frame to the world, its variance (rad^2), and the
    strength (T) and dip (rad, below the horizon) of the field where nothing disturbs it."""

    angle: Array = real(unit="rad")
    variance: Array = real(unit="rad^2")
    strength: Array = real(unit="T")
    dip: Array = real(unit="rad")
