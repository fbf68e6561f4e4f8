"""State-space models: how something moves and what is seen of it, declared once for every method.

A model is only its maths. A `Motion` carries states over a step, a `Measurement` says what would be seen of
them; the state is one of a `StateSpace`, whose parts have names. Both are given as functions of states one a
row (`MotionModel`, `MeasurementModel`) or as matrices (`DiscreteModel`, `LinearMeasurement`, and
`kalman.LinearModel` for motion in continuous time). No filter is said here: what is made of a model is a
matter of the method, in `filtering`. Names that a user of models needs are all importable from there.
"""

from __future__ import annotations

from flowgraph.blocks.statespace.functions import Covariance, Handed, numbers
from flowgraph.blocks.statespace.measurement import LinearMeasurement, Measurement, MeasurementModel
from flowgraph.blocks.statespace.motion import DiscreteModel, Motion, MotionModel, runge_kutta

__all__ = [
    "Motion",
    "MotionModel",
    "DiscreteModel",
    "runge_kutta",
    "Measurement",
    "MeasurementModel",
    "LinearMeasurement",
    "Covariance",
    "Handed",
    "numbers",
]
