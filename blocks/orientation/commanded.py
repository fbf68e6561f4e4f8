"""Attitude by a commanded body rate and a sensor of the whole attitude: a multiplicative Kalman filter.

The estimate is a unit quaternion, and its error a rotation vector of three numbers in the body, so that the
covariance is 3 x 3 and no direction in it is along the quaternion. What a sensor of the attitude adds is
again a rotation vector, and H is the identity.

Sources: E. J. Lefferts, F. L. Markley, M. D. Shuster, "Kalman filtering for spacecraft attitude estimation",
J. Guidance 5(5), 1982, sec. XI; F. L. Markley, "Attitude error representations for Kalman filtering", J.
Guidance, Control, and Dynamics 26(2), 2003, sec. IV.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Result, Series, block
from flowgraph.blocks.geometry.manifold import StateSpace, quaternion
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, normalize, to_matrix
from flowgraph.blocks.kalman.smoothing import Steps, steps_of
from flowgraph.blocks.signals import Attitude, AttitudeBelief, BodyRate, Gaussian

__all__ = [
    "TURN",
    "attitude_belief",
    "attitude_vector",
    "between_rates",
    "predict_turn",
    "see_attitude",
    "start_turn",
    "turn_crossing",
    "turn_steps",
    "turned_back",
]

TURN = StateSpace(quaternion())
"""An attitude; its error is a rotation vector in the body."""


@block
def between_rates(before: BodyRate, now: BodyRate) -> BodyRate:
    """The mean of the last rate and this one, which a step between their times holds."""
    return BodyRate(rate=0.5 * (before.rate + now.rate))


@block
def predict_turn(belief: Gaussian, rate: BodyRate, *, noise: float, dt: float, xp: Any) -> Gaussian:
    """Turn a belief over `TURN` by `dt` seconds of a body rate.

        q' = q * Exp(w dt)      P' = E P E^T + noise^2 dt I      E = R(Exp(w dt))^T

    Args:
        noise: density of the rate's white noise, rad/s/sqrt(Hz).
    """
    q, turn = belief.mean, from_rotation_vector(rate.rate * dt, xp=xp)
    E = turned_back(rate, dt, xp)
    P = E @ belief.covariance @ E.mT + xp.asarray(np.eye(3), dtype=q.dtype) * (noise**2 * dt)
    turned = normalize(multiply(q, turn, xp=xp), xp=xp)
    return Gaussian(mean=turned, covariance=0.5 * (P + P.mT))


def turned_back(rate: BodyRate, dt: Any, xp: Any) -> Array:
    """E (3, 3) of `predict_turn`: how the error before a step stands in the body after it."""
    return to_matrix(from_rotation_vector(rate.rate * dt, xp=xp), xp=xp).mT


def turn_crossing(belief: Gaussian, rate: BodyRate, dt: Any, xp: Any) -> Array:
    """What `cross_covariance` asks of a filter that predicts with `predict_turn`."""
    return belief.covariance @ turned_back(rate, dt, xp).mT


def turn_steps(result: Result) -> Steps:
    """Those of a run of `attitude_mekf` that was wired for a smoother."""

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        return Series(smoothed.time, attitude_belief.step(belief), name=smoothed.name)

    return steps_of(result, TURN)._replace(named=named)


def see_attitude(x: Array, xp: Any) -> tuple[Array, Array]:
    """The whole attitude, with its Jacobian (3, 3)."""
    return x, xp.asarray(np.eye(3), dtype=x.dtype)


def attitude_vector(measured: Attitude) -> Array:
    """An attitude as a vector (4)."""
    return measured.attitude


@block
def attitude_belief(belief: Gaussian) -> AttitudeBelief:
    """A belief over `TURN`, with its names."""
    return AttitudeBelief(attitude=belief.mean, covariance=belief.covariance)


def start_turn(attitude: npt.ArrayLike, *, deviation: float = 1.0) -> Gaussian:
    """A belief to start from: an attitude (4,), with a standard deviation in rad about each body axis."""
    return Gaussian(mean=np.asarray(attitude, dtype=float), covariance=np.eye(3) * deviation**2)
