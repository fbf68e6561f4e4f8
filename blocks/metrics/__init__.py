"""Metrics: how good an estimate is, and whether its filter knew.

`errors` compares an estimate with a truth: metres, degrees, and the NEES, the squared error in deviations of
the filter's own. `chi_square` says how large such a square is when all is well, which gives bands for the
average and gates for single measurements. `consistency` has what needs no truth, the NIS of innovations, and
`bound` how small the errors can be. `states` compares a state of one's own, part by part. All of these run
on the host after a run, but for the limits of a gate, which become constants of the graph. `running` has
scores as blocks, which are summed up while a run goes.
"""

from __future__ import annotations

from flowgraph.blocks.metrics.bound import posterior_bound, smoothing_bound
from flowgraph.blocks.metrics.chi_square import (
    chi_square,
    chi_square_band,
    chi_square_gate,
    gate_table,
    inside,
)
from flowgraph.blocks.metrics.consistency import nis_remarks, nis_summary, point_errors, state_nees
from flowgraph.blocks.metrics.errors import (
    attitude_errors,
    error_summary,
    interpolate,
    interpolate_pose,
    nees,
    nees_summary,
    orientation_errors,
    plane_errors,
    pose_errors,
    state_error,
    tilt_and_heading_nees,
    within_truth,
)
from flowgraph.blocks.metrics.running import (
    nis_score,
    pose_score,
    running_extremes,
    running_mean,
    running_rms,
    running_share,
    settle_time,
)
from flowgraph.blocks.metrics.states import ALIGNMENTS, StateErrors, true_parts
from flowgraph.blocks.metrics.terms import (
    FIGURES,
    attitude_terms,
    nis_limits,
    nis_terms,
    place_terms,
    turn_error,
)
from flowgraph.blocks.metrics.truth import known, truth_remarks

__all__ = [
    "FIGURES",
    "attitude_terms",
    "nis_limits",
    "nis_terms",
    "place_terms",
    "turn_error",
    "nis_score",
    "pose_score",
    "running_extremes",
    "running_mean",
    "running_rms",
    "running_share",
    "settle_time",
    "ALIGNMENTS",
    "StateErrors",
    "true_parts",
    "posterior_bound",
    "smoothing_bound",
    "chi_square",
    "chi_square_band",
    "chi_square_gate",
    "gate_table",
    "inside",
    "attitude_errors",
    "error_summary",
    "interpolate",
    "interpolate_pose",
    "nees",
    "nees_summary",
    "orientation_errors",
    "plane_errors",
    "pose_errors",
    "state_error",
    "tilt_and_heading_nees",
    "within_truth",
    "known",
    "truth_remarks",
    "nis_remarks",
    "nis_summary",
    "point_errors",
    "state_nees",
]
