"""Scoring: what makes a case of a flight and a filter, and what a run of it is worth.

`tuning` finds the noise that a filter is told, in its settings or in the flight; `streams` makes the streams
that it asks for out of those that a flight has. `scorer` compares a run with the truth: errors, consistency,
and the same for the smoothed run; `orientation` counts only the times that a recording says count.
"""

from __future__ import annotations

from flowgraph.blocks.scoring.orientation import scored_errors
from flowgraph.blocks.scoring.scorer import SMOOTHED, Scorer, scorer
from flowgraph.blocks.scoring.streams import (
    first_attitude,
    own_density,
    reading_deviation,
    told_acceleration,
    with_parts,
)
from flowgraph.blocks.scoring.tuning import (
    check_choice,
    check_settings,
    given,
    gravity_of,
    imu_noise_of,
    noise_of,
    reading_of,
    unbiased_noise_of,
    with_imu,
)

__all__ = [
    "SMOOTHED",
    "Scorer",
    "scorer",
    "check_choice",
    "check_settings",
    "given",
    "gravity_of",
    "imu_noise_of",
    "noise_of",
    "reading_of",
    "unbiased_noise_of",
    "with_imu",
    "first_attitude",
    "own_density",
    "reading_deviation",
    "told_acceleration",
    "with_parts",
    "scored_errors",
]
