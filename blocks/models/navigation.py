"""The state of navigation outdoors, as a space: what a smoother of `gnss_ins` goes back over."""

from __future__ import annotations

import numpy as np

from flowgraph import Result, Series
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.inertial.navigation import PARAMETERS
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.models.inertial_pose import inertial_steps
from flowgraph.blocks.signals import Gaussian, NavigationBelief

__all__ = ["navigation_space", "navigation_steps"]


def navigation_space(estimated: tuple[str, ...]) -> StateSpace:
    """Pose, velocity, biases, and what is estimated beside them."""
    return StateSpace(
        position=euclidean(3),
        velocity=euclidean(3),
        attitude=quaternion(),
        gyro_bias=euclidean(3),
        accelerometer_bias=euclidean(3),
        parameters=euclidean(sum(PARAMETERS[name].size for name in estimated)),
    )


def navigation_steps(result: Result, *, estimated: tuple[str, ...]) -> Steps:
    """Those of a run of `gnss_ins` that was wired for a smoother.

    Args:
        estimated: what the filter estimates, names of `PARAMETERS`.
    """
    if not estimated:
        return inertial_steps(result)
    space = navigation_space(estimated)
    prior, posterior = (_stacked(result[name], space) for name in ("prior", "belief"))
    return Steps(prior, posterior, result["cross"], space, _named)


def _stacked(series: Series, space: StateSpace) -> Series:
    mean = np.concatenate([series[part] for part in space.names], axis=-1)
    return Series(series.time, Gaussian(mean=mean, covariance=series["covariance"]), name=series.name)


def _named(smoothed: Series) -> Series:
    p, v, q, b_g, b_a, more = np.split(smoothed["mean"], (3, 6, 10, 13, 16), axis=-1)
    belief = NavigationBelief(p, v, q, b_g, b_a, more, smoothed["covariance"])
    return Series(smoothed.time, belief, name=smoothed.name)
