"""Scoring: what makes a case of a flight and a filter, and what a run of it is worth.

`settings` lets graphs share settings that are declared once; `cases` has those of filters, and makes the
case, as `point` does for linear filters and `euler` for those with Euler angles. `tuning` finds the noise
that a filter is told, in its settings or in the flight; `streams` makes the streams that it asks for out of
those that a flight has. `scorer` compares a run with the truth: errors, consistency, and the same for the
smoothed run; `orientation` counts only the times that a recording says count, and `calibration` is of
windows.
"""

from __future__ import annotations

from flowgraph.blocks.scoring.cases import (
    Factors,
    Gated,
    OnFlight,
    Particles,
    PoseAided,
    PoseFilter,
    PoseNoises,
    Scored,
    Smoothed,
    SmoothedPoseFilter,
    on_capture,
    on_flight,
)
from flowgraph.blocks.scoring.orientation import scored_errors
from flowgraph.blocks.scoring.scorer import SMOOTHED, Scorer
from flowgraph.blocks.scoring.settings import NotNegative, Positive, Settings, count, named, one_of
from flowgraph.blocks.scoring.streams import (
    first_attitude,
    own_density,
    reading_deviation,
    told_acceleration,
    with_parts,
)
from flowgraph.blocks.scoring.tuning import (
    given,
    imu_noise_of,
    noise_of,
    reading_of,
    unbiased_factors,
    with_imu,
)

__all__ = [
    "Settings",
    "NotNegative",
    "Positive",
    "count",
    "named",
    "one_of",
    "OnFlight",
    "on_flight",
    "on_capture",
    "Factors",
    "Gated",
    "Particles",
    "PoseAided",
    "PoseFilter",
    "PoseNoises",
    "Scored",
    "Smoothed",
    "SmoothedPoseFilter",
    "SMOOTHED",
    "Scorer",
    "given",
    "imu_noise_of",
    "noise_of",
    "reading_of",
    "unbiased_factors",
    "with_imu",
    "first_attitude",
    "own_density",
    "reading_deviation",
    "told_acceleration",
    "with_parts",
    "scored_errors",
]
