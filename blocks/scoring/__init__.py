"""Scoring: what makes a case of a flight and a filter, and what a run of it is worth.

`cases` makes a case of a flight, with the settings that filters share, each declared once as `settings` lets
graphs do; `point` does so for linear filters, and `euler` for those with Euler angles. `tuning` finds the
noise that a filter is told, in its settings or in the flight, and `covariances` reads a whole one; `streams`
makes the streams that it asks for out of those that a flight has. `scorer` compares a run with the truth:
errors, consistency, and the same for the smoothed run; `orientation` counts only the times that a recording
says count, and `calibration` how well one explains its windows. `own` makes a case where nobody says how, and
`outdoors` has the streams and the start of a flight with satellites, `outdoor_start` that of one with six
sensors. `settings`, `point`, `euler`, `own` and
`calibration` are imported by their own names.
"""

from __future__ import annotations

from flowgraph.blocks.scoring.capture import on_capture
from flowgraph.blocks.scoring.cases import (
    Adapted,
    Factors,
    Gated,
    HeldControl,
    OnFlight,
    Particles,
    PoseAided,
    PoseFilter,
    PoseNoises,
    Scored,
    Smoothed,
    SmoothedPoseFilter,
    Weighed,
    on_flight,
)
from flowgraph.blocks.scoring.covariances import Covariance, six_by_six
from flowgraph.blocks.scoring.late import Late, built_for, late_streams, places, rewound_graph
from flowgraph.blocks.scoring.orientation import Share, counted, counted_errors, scored_errors
from flowgraph.blocks.scoring.outdoor_start import StartedOutdoor
from flowgraph.blocks.scoring.outdoors import (
    POSITIONS,
    Outdoors,
    World,
    declination,
)
from flowgraph.blocks.scoring.readings import Ranges, gap_notes, pause, taken
from flowgraph.blocks.scoring.scorer import SMOOTHED, Scorer
from flowgraph.blocks.scoring.start import (
    MAGNETIC_HEADING,
    UNKNOWN_HEADING,
    Started,
    StartPose,
    from_first,
    turned,
)
from flowgraph.blocks.scoring.streams import (
    own_density,
    reading_deviation,
    told_acceleration,
    with_parts,
)
from flowgraph.blocks.scoring.tuning import (
    WEIGHTLESS,
    given,
    imu_noise_of,
    noise_of,
    reading_of,
    unbiased_factors,
    with_imu,
)

__all__ = [
    "turned",
    "from_first",
    "taken",
    "pause",
    "gap_notes",
    "Ranges",
    "settings",
    "point",
    "euler",
    "own",
    "calibration",
    "Covariance",
    "six_by_six",
    "OnFlight",
    "on_flight",
    "on_capture",
    "Factors",
    "Gated",
    "HeldControl",
    "Particles",
    "PoseAided",
    "PoseFilter",
    "PoseNoises",
    "Scored",
    "Smoothed",
    "SmoothedPoseFilter",
    "Adapted",
    "Weighed",
    "SMOOTHED",
    "MAGNETIC_HEADING",
    "UNKNOWN_HEADING",
    "Started",
    "StartedOutdoor",
    "StartPose",
    "Scorer",
    "WEIGHTLESS",
    "given",
    "imu_noise_of",
    "noise_of",
    "reading_of",
    "unbiased_factors",
    "with_imu",
    "own_density",
    "reading_deviation",
    "told_acceleration",
    "with_parts",
    "Share",
    "counted",
    "counted_errors",
    "scored_errors",
    "Late",
    "built_for",
    "late_streams",
    "places",
    "rewound_graph",
    "POSITIONS",
    "Outdoors",
    "World",
    "declination",
]
