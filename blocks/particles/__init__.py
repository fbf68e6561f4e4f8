"""Particles: beliefs that no Gaussian can hold, as weighted samples.

`cloud` draws, weighs and averages particles of attitude; `resampling` draws a cloud anew when few particles
have the weight, and decides alike on every engine; `guided` lets particles of any state look at a measurement
before they are drawn; `lost` judges what a cloud should believe, and says when it is depleted;
`rao_blackwell` gives each particle a Kalman filter of its own for position and velocity, which need no
sampling once the attitude is given.
"""

from __future__ import annotations

from flowgraph.blocks.particles.cloud import (
    attitude_likelihood,
    average_attitude,
    average_pose,
    cloud_at_start,
    cloud_belief,
    dominant_eigenvector,
    effective_sample_size,
    log_sum_exp,
    propagate_attitude,
    reweight,
    start_cloud,
    weights,
    within_depth,
)
from flowgraph.blocks.particles.guided import Kernels, Spread, corrected, drawn, spread_of
from flowgraph.blocks.particles.lost import (
    BELIEVED,
    believe_pose,
    depletion,
    depletion_remarks,
    judge_pose,
    judged,
    mixture,
    pose_within_reach,
    verdict,
    within_reach,
)
from flowgraph.blocks.particles.rao_blackwell import correct_motion, predict_motion
from flowgraph.blocks.particles.resampling import (
    MOST_PARTICLES,
    SCHEMES,
    ancestor_index,
    draw_ancestors,
    quantised,
    roughening,
    take_ancestors,
)

__all__ = [
    "within_depth",
    "within_reach",
    "pose_within_reach",
    "BELIEVED",
    "Spread",
    "Kernels",
    "attitude_likelihood",
    "average_attitude",
    "average_pose",
    "dominant_eigenvector",
    "effective_sample_size",
    "log_sum_exp",
    "cloud_belief",
    "propagate_attitude",
    "reweight",
    "cloud_at_start",
    "start_cloud",
    "weights",
    "MOST_PARTICLES",
    "SCHEMES",
    "ancestor_index",
    "draw_ancestors",
    "quantised",
    "roughening",
    "corrected",
    "drawn",
    "spread_of",
    "believe_pose",
    "depletion",
    "depletion_remarks",
    "judge_pose",
    "judged",
    "mixture",
    "verdict",
    "take_ancestors",
    "correct_motion",
    "predict_motion",
]
