"""A point in space driven by its acceleration: the model, the signals and the start of the linear filters.

State x = (position, velocity), m and m/s in the world. The control is the coordinate acceleration in the
world, which an accelerometer gives to whoever knows the attitude: a = R(q) (f - bias) + gravity. A filter
that is told the exact attitude and biases is the bound: no filter on the same accelerometer and positions can
do better.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 6.2.2 (white noise acceleration).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Result, Series, block, when
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.signals import Gaussian, PointBelief, WorldAcceleration

__all__ = [
    "between",
    "point_belief",
    "point_model",
    "point_steps",
    "start_point",
    "whole",
]


@block
def point_belief(belief: Gaussian) -> PointBelief:
    """A Gaussian over (position, velocity), with names and units."""
    x = belief.mean
    return PointBelief(position=x[..., :3], velocity=x[..., 3:6], covariance=belief.covariance)


@block
def between(before: WorldAcceleration, now: WorldAcceleration) -> WorldAcceleration:
    """The mean of the last control and this one, which a step between their times holds.

    Holding either alone lags or leads by half a step. Where no new control came, both are the last one.
    """
    return WorldAcceleration(acceleration=0.5 * (before.acceleration + now.acceleration))


@block
def whole(control: WorldAcceleration, *, xp: Any) -> WorldAcceleration | None:
    """The control, absent where a part of it is NaN."""
    return when(~xp.any(xp.isnan(control.acceleration)), control)


def point_model(density: float) -> LinearModel:
    """p' = v, v' = a, with white noise of `density` (m/s^2/sqrt(Hz)) on the acceleration.

        F = [I  dt I]    G = [dt^2/2 I]    Q = density^2 [dt^3/3 I  dt^2/2 I]
            [0     I]        [dt I    ]                  [dt^2/2 I  dt I    ]

    (The thesis prints the control matrix without its dt.)
    """
    one, none = np.eye(3), np.zeros((3, 3))
    A = np.block([[none, one], [none, none]])
    return LinearModel(A, np.vstack([none, one]), np.diag([0.0] * 3 + [density**2] * 3))


def start_point(
    position: npt.ArrayLike,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    position_deviation: float = 0.7,
    velocity_deviation: float = 0.7,
) -> Gaussian:
    """A belief to start from: position (3,) m and velocity (3,) m/s, with their standard deviations."""
    P = np.diag([position_deviation**2] * 3 + [velocity_deviation**2] * 3)
    mean = np.concatenate([np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)])
    return Gaussian(mean=mean, covariance=P)


def point_steps(result: Result, model: LinearModel) -> Steps:
    """Those of a run of `kalman` or `async_kalman`, which collect `prior` and `posterior`."""

    def named(smoothed: Series) -> Series:
        return Series(smoothed.time, point_belief.step(smoothed.values), name=smoothed.name)

    return Steps(result["prior"], result["posterior"], model, None, named)
