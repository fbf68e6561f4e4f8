"""The Kalman filter: predict and correct a Gaussian over any state, and smooth a whole run afterwards.

`linear` is motion in continuous time and its exact steps over any dt. `filters` predicts and corrects with
it, in Joseph form, with gates and with missing entries; its extended form takes any function of the state and
its Jacobian. `roots` carries a triangular root of the covariance instead, with twice the digits. `lost` is
for controls that do not come and gates that do not open, `robust` for outliers, and `learned` for a noise
that nobody knows. `smoothing` goes back over a run and adds to each state what later measurements say of it;
`backward` is that as a graph, `parallel` filters and smooths all steps of a recording at once, and `learning`
finds the linear model that explains a recording. What moves and what is measured is not said here: see
`models`.
"""

from __future__ import annotations

from flowgraph.blocks.kalman.backward import (
    Crossing,
    backwards,
    collect_steps,
    cross_covariance,
    forwards,
    go_back,
    sizes_of,
    smoother,
)
from flowgraph.blocks.kalman.filters import (
    Correction,
    Vector,
    correct,
    predict_linear,
    update_extended,
    update_linear,
)
from flowgraph.blocks.kalman.learned import (
    LEAST,
    feed_scale,
    learned_noise,
    learned_scale,
    scale_of,
    update_learned,
)
from flowgraph.blocks.kalman.learning import LEARNT, Learned, LinearGaussian, learn
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.lost import (
    FARTHEST,
    GROWN,
    PATIENCE,
    UNKNOWN_TURN,
    Held,
    aged,
    bridge,
    bridged,
    find_back,
    in_doubt,
    lost_variances,
    stay,
)
from flowgraph.blocks.kalman.matrices import noise_matrix, observation_matrix
from flowgraph.blocks.kalman.parallel import LinearSteps, Passed, linear_pass
from flowgraph.blocks.kalman.robust import ROBUST, Robust, huber, reweighted, student_t
from flowgraph.blocks.kalman.roots import correct_root, predict_root, update_extended_root, update_root
from flowgraph.blocks.kalman.smoothing import (
    Smoothing,
    Steps,
    fixed_lag,
    gone_back,
    lag_ticks,
    rauch_tung_striebel,
    smooth,
    smoother_gain,
    smoothing_pass,
    steps_of,
)
from flowgraph.blocks.kalman.triangles import covariance_root, lower_root, semidefinite_root
from flowgraph.blocks.signals import Gaussian, KalmanInnovation
from flowgraph.recorder.namespaces import solve_positive

__all__ = [
    "Smoothing",
    "reweighted",
    "GROWN",
    "Robust",
    "huber",
    "student_t",
    "learned_noise",
    "learned_scale",
    "learn",
    "feed_scale",
    "scale_of",
    "LEAST",
    "ROBUST",
    "update_learned",
    "Crossing",
    "gone_back",
    "noise_matrix",
    "observation_matrix",
    "FARTHEST",
    "PATIENCE",
    "UNKNOWN_TURN",
    "Held",
    "aged",
    "bridge",
    "bridged",
    "solve_positive",
    "stay",
    "find_back",
    "in_doubt",
    "lost_variances",
    "covariance_root",
    "LinearModel",
    "LinearSteps",
    "Passed",
    "linear_pass",
    "LinearGaussian",
    "Learned",
    "LEARNT",
    "Correction",
    "Vector",
    "correct",
    "predict_linear",
    "update_extended",
    "update_linear",
    "lower_root",
    "correct_root",
    "predict_root",
    "semidefinite_root",
    "update_extended_root",
    "update_root",
    "Steps",
    "fixed_lag",
    "lag_ticks",
    "rauch_tung_striebel",
    "smooth",
    "smoother_gain",
    "smoothing_pass",
    "steps_of",
    "backwards",
    "collect_steps",
    "cross_covariance",
    "forwards",
    "go_back",
    "sizes_of",
    "smoother",
    "Gaussian",
    "KalmanInnovation",
]
