"""The unscented filter: a Gaussian through any function by a few points, without Jacobians.

`sigma_points` places the points, on vectors as on angles and quaternions, and takes their mean and
covariance; `filters` predicts and corrects a `Gaussian` with them. The functions of motion and measurement
are those of `models` and `orientation`, or your own.
"""

from __future__ import annotations

from flowgraph.blocks.unscented.filters import (
    motion_cross,
    predict_unscented,
    through_motion,
    through_observation,
    unscented_crossing,
    update_unscented,
)
from flowgraph.blocks.unscented.sigma_points import (
    GAUSSIAN,
    MEANS,
    Cluster,
    SigmaPoints,
    mean_move,
    mean_turn,
)

__all__ = [
    "unscented_crossing",
    "motion_cross",
    "GAUSSIAN",
    "MEANS",
    "Cluster",
    "SigmaPoints",
    "mean_move",
    "mean_turn",
    "predict_unscented",
    "through_motion",
    "through_observation",
    "update_unscented",
]
