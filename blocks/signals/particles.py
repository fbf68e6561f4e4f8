"""Beliefs as weighted samples: clouds, their weights, and who descends from whom.

Struct of arrays: `particles` is the number of them, and the last axis of every field but where it is said.
"""

from __future__ import annotations

from flowgraph import Array, Signal, boolean, integer, real

__all__ = [
    "Cloud",
    "Weights",
    "LogLikelihood",
    "Ancestors",
    "Depletion",
    "StateCloud",
    "StateKernels",
    "OutdoorCloud",
    "PlaneCloud",
    "PlaneBelief",
]


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


class Depletion(Signal):
    """Whether too few particles have the weight for the cloud to stand for a belief."""

    depleted: Array = boolean()


class StateCloud(Signal):
    """Weighted states. log_weight: natural logarithm, the weights add up to 1. state: one a particle."""

    log_weight: Array = real("particles")
    state: Array = real("particles", "size")


class StateEnsemble(Signal):
    """States of equal weight, one a member."""

    state: Array = real("members", "size")


class ConditionalCloud(Signal):
    """Weighted states, part of each of which is known as a Gaussian: its mean stands in the state."""

    log_weight: Array = real("particles")
    state: Array = real("particles", "size")
    covariance: Array = real("particles", "l", "l")


class StateKernels(Signal):
    """Weighted Gaussians over the states of a `StateCloud`: their means, and the covariance that all have."""

    log_weight: Array = real("particles")
    state: Array = real("particles", 15)
    covariance: Array = real(15, 15)


class OutdoorCloud(Signal):
    """A Rao-Blackwellized cloud whose particles remember the last picture. The particle is the last axis.

    log_weight: natural logarithm of the weights, which add up to 1. attitude: the mean of now, so that the
    true one is Exp(e) * attitude; picture: at the last picture, exactly. motion: the mean of (velocity in
    m/s, position in m, displacement since the last picture in m), world, and of the biases (rad/s, m/s^2,
    body) where they are estimated; covariance: of the first three, of e (rad, world), the mean of which is
    zero, and of the biases.
    """

    log_weight: Array = real("particles")
    attitude: Array = real(4, "particles", unit="1", frame="world<-body")
    picture: Array = real(4, "particles", unit="1", frame="world<-body")
    motion: Array = real("numbers", "particles")
    covariance: Array = real("errors", "errors", "particles")


class PlaneCloud(Signal):
    """Weighted points: log_weight, whose exponentials add up to 1, and positions in m."""

    log_weight: Array = real("particles")
    position: Array = real(2, "particles", unit="m", frame="world")


class PlaneBelief(Signal):
    """Mean (m) and covariance (m^2) of a cloud."""

    position: Array = real(2, unit="m", frame="world")
    covariance: Array = real(2, 2)
