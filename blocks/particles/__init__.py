"""Particles: beliefs that no Gaussian can hold, as weighted samples.

`cloud` draws, weighs and averages particles of attitude; `resampling` draws a cloud anew when few particles
have the weight, and decides alike on every engine; `rao_blackwell` gives each particle a Kalman filter of its
own for position and velocity, which need no sampling once the attitude is given.
"""

from __future__ import annotations

from flowgraph.blocks.particles.cloud import (
    attitude_likelihood,
    average_attitude,
    average_pose,
    dominant_eigenvector,
    effective_sample_size,
    log_sum_exp,
    propagate_attitude,
    reweight,
    start_cloud,
    weights,
)
from flowgraph.blocks.particles.rao_blackwell import correct_motion, predict_motion
from flowgraph.blocks.particles.resampling import (
    MOST_PARTICLES,
    SCHEMES,
    ancestor_index,
    draw_ancestors,
    quantised,
    take_ancestors,
)

__all__ = [
    "attitude_likelihood",
    "average_attitude",
    "average_pose",
    "dominant_eigenvector",
    "effective_sample_size",
    "log_sum_exp",
    "propagate_attitude",
    "reweight",
    "start_cloud",
    "weights",
    "MOST_PARTICLES",
    "SCHEMES",
    "ancestor_index",
    "draw_ancestors",
    "quantised",
    "take_ancestors",
    "correct_motion",
    "predict_motion",
]
