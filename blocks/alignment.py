"""Alignment: where a filter starts, and how sure it may honestly be.

One reading of an accelerometer fixes two of three angles, as far as the body does not accelerate; the third,
the heading, comes from a reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import block
from flowgraph.blocks.geometry import level, to_matrix
from flowgraph.blocks.signals import Attitude, Belief, SpecificForce

__all__ = ["StartSpread", "level_attitude", "start_belief"]


@block
def level_attitude(
    force: SpecificForce, *, nearest: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0), xp: Any
) -> Attitude:
    """The attitude that takes the measured specific force to world +z and is nearest to a reference.

    With u = R(nearest) force, it is the smallest rotation from u to +z, after `nearest`. Right when the body
    does not accelerate; a horizontal acceleration a tilts it by about a / 9.81 rad.

    Args:
        force: m/s^2, body; not zero.
        nearest: the reference, a unit quaternion, body to world.
    """
    return Attitude(attitude=level(xp.asarray(nearest, dtype=force.force.dtype), force.force, xp=xp))


@dataclass(frozen=True)
class StartSpread:
    """Standard deviations of a start, each the same on its axes.

    Args:
        position: m.
        velocity: m/s.
        tilt: rad, about each horizontal axis.
        heading: rad, about the vertical.
        gyro_bias: rad/s.
        accelerometer_bias: m/s^2.
    """

    position: float = 0.7
    velocity: float = 0.7
    tilt: float = 0.1
    heading: float = 0.05
    gyro_bias: float = 0.1
    accelerometer_bias: float = 0.1


def start_belief(
    position: npt.ArrayLike,
    attitude: npt.ArrayLike,
    *,
    specific_force: npt.ArrayLike | None = None,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    spread: StartSpread = StartSpread(),
) -> Belief:
    """A belief to start from, with zero biases.

    Args:
        position: (3,) m, world.
        attitude: (4,) unit quaternion, body to world.
        specific_force: (3,) m/s^2, body: when given, the attitude is levelled with it, as `level_attitude`
            does.
        velocity: (3,) m/s, world.
        spread: how sure the start is. Tilt and heading are about world axes, and turned into the body here.
    """
    q = np.asarray(attitude, dtype=float)
    if specific_force is not None:
        q = np.asarray(level(q, np.asarray(specific_force, dtype=float), xp=np))
    R = to_matrix(q, xp=np)
    P = np.zeros((15, 15))
    for place, deviation in ((0, spread.position), (3, spread.velocity)):
        P[place : place + 3, place : place + 3] = np.eye(3) * deviation**2
    P[6:9, 6:9] = R.T @ np.diag(np.square([spread.tilt, spread.tilt, spread.heading])) @ R
    for place, deviation in ((9, spread.gyro_bias), (12, spread.accelerometer_bias)):
        P[place : place + 3, place : place + 3] = np.eye(3) * deviation**2
    return Belief(
        position=np.array(position, dtype=float),
        velocity=np.array(velocity, dtype=float),
        attitude=q,
        gyro_bias=np.zeros(3),
        accelerometer_bias=np.zeros(3),
        covariance=0.5 * (P + P.T),
    )
