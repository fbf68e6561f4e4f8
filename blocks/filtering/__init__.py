"""Filters: the belief about a state that moves as one model says and is seen as others say.

A model is declared once (`statespace`), over a `StateSpace` with named parts; `filtered` makes a filter of it
by any method, as a sub-graph of delay, predict and correct. `methods` has them by name, `gaussian` the maths
of those that believe in a Gaussian. `rewind` runs any filter over events that come late. Everything that a
user's own filter needs is importable from here.
"""

from __future__ import annotations

from flowgraph.blocks.filtering.ageing import AgedMotion, Ageing, doubt_control
from flowgraph.blocks.filtering.banks import BankFilter, Interacting, bank_step, imm, mmae
from flowgraph.blocks.filtering.batch import (
    LOSSES,
    Aged,
    Derived,
    Loss,
    Moves,
    Recording,
    cauchy,
    estimate_batch,
    huber,
    loss_of,
)
from flowgraph.blocks.filtering.ensembles import (
    Ensemble,
    carry_ensemble,
    correct_ensemble,
    ensemble,
    ensemble_cross,
)
from flowgraph.blocks.filtering.filtered import FirstMeasurement, filtered, first
from flowgraph.blocks.filtering.gaussian import (
    Extended,
    GaussianMethod,
    Linear,
    SquareRoot,
    Unscented,
    innovation_log_likelihood,
)
from flowgraph.blocks.filtering.information import Information, information
from flowgraph.blocks.filtering.marginal import (
    Marginal,
    carry_conditional,
    rao_blackwellized,
    weigh_conditional,
)
from flowgraph.blocks.filtering.methods import (
    Advanced,
    Method,
    Seen,
    correct,
    crossed,
    cubature,
    extended,
    linear,
    predict,
    square_root,
    unscented,
)
from flowgraph.blocks.filtering.particles import Particles, cloud_size, particles, resample_cloud
from flowgraph.blocks.filtering.proposals import (
    PROPOSALS,
    auxiliary_cloud,
    carry_cloud,
    guide_cloud,
    propose_cloud,
)
from flowgraph.blocks.filtering.rewind import OLDER, Rewound, rewind
from flowgraph.blocks.filtering.simulation import CloudSteps, backward_simulation, smoothed_cloud
from flowgraph.blocks.filtering.switching import BankSteps, bank_steps_of
from flowgraph.blocks.filtering.towards import Moved, deviations, find_cloud_back, moved_towards
from flowgraph.blocks.filtering.weighing import weigh_cloud
from flowgraph.blocks.geometry import SE, SE_2, SO, StateSpace, angle, euclidean, quaternion
from flowgraph.blocks.kalman import LinearModel, smooth
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.statespace import (
    DiscreteModel,
    LinearMeasurement,
    MeasurementModel,
    MotionModel,
    runge_kutta,
)
from flowgraph.blocks.unscented import SigmaPoints

__all__ = [
    "Moves",
    "moved_towards",
    "deviations",
    "Moved",
    "crossed",
    "loss_of",
    "Recording",
    "Derived",
    "Aged",
    "LOSSES",
    "StateSpace",
    "euclidean",
    "angle",
    "quaternion",
    "SO",
    "SE",
    "SE_2",
    "MotionModel",
    "runge_kutta",
    "LinearModel",
    "DiscreteModel",
    "MeasurementModel",
    "LinearMeasurement",
    "Gaussian",
    "filtered",
    "first",
    "Ageing",
    "AgedMotion",
    "doubt_control",
    "FirstMeasurement",
    "smooth",
    "CloudSteps",
    "backward_simulation",
    "smoothed_cloud",
    "estimate_batch",
    "Loss",
    "huber",
    "cauchy",
    "linear",
    "extended",
    "information",
    "Information",
    "ensemble",
    "Ensemble",
    "carry_ensemble",
    "correct_ensemble",
    "ensemble_cross",
    "rao_blackwellized",
    "Marginal",
    "carry_conditional",
    "weigh_conditional",
    "square_root",
    "unscented",
    "cubature",
    "SigmaPoints",
    "imm",
    "mmae",
    "Interacting",
    "BankFilter",
    "BankSteps",
    "bank_step",
    "bank_steps_of",
    "particles",
    "PROPOSALS",
    "Particles",
    "carry_cloud",
    "guide_cloud",
    "propose_cloud",
    "auxiliary_cloud",
    "weigh_cloud",
    "resample_cloud",
    "cloud_size",
    "find_cloud_back",
    "Method",
    "Advanced",
    "Seen",
    "predict",
    "correct",
    "rewind",
    "Rewound",
    "OLDER",
    "GaussianMethod",
    "Linear",
    "Extended",
    "SquareRoot",
    "Unscented",
    "innovation_log_likelihood",
]
