"""Inertial navigation: what an inertial unit tells, how it is aided, started and calibrated.

`imu` carries a belief about position, velocity, attitude and the unit's biases forward on each reading: an
error-state Kalman filter's prediction, and `ImuNoise`, the densities by which all filters here know a unit.
`aiding` corrects that belief by measured positions and attitudes. `alignment` finds the attitude and biases
to start from, `calibration` takes out what a unit reads too much while it rests, and `imu_calibration` finds
what a count of its converters is worth by what a motion capture saw. Over the Earth, `navigation` predicts
where it turns and is round, and estimates more; `outdoors` aids by satellites, heights, directions and
wheels; `moving` aligns a body in motion by the positions that come after, `compassing` one at rest by the
turn of the Earth.
"""

from __future__ import annotations

from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position, correct_belief
from flowgraph.blocks.inertial.alignment import (
    Start,
    StartSpread,
    align_static,
    belief_at_start,
    level_attitude,
    need_usable,
    orientation_start,
    rest_seconds,
    start_belief,
    static_alignment,
    usable,
)
from flowgraph.blocks.inertial.calibration import silence_frozen_gyro, subtract_rest_bias
from flowgraph.blocks.inertial.compassing import Compassed, compass_by_gyro
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, carried, error_jacobian, predict
from flowgraph.blocks.inertial.imu_calibration import (
    CountsCalibration,
    calibrated,
    collect_equations,
    fit_counts,
    solve_equations,
    sum_counts,
    window_means,
    windows_of,
)
from flowgraph.blocks.inertial.moving import Motion, align_moving
from flowgraph.blocks.inertial.navigation import (
    PARAMETERS,
    Earth,
    Parameter,
    earth_at,
    extended,
    gravity_at,
    navigation_crossing,
    places,
    predict_navigation,
)
from flowgraph.blocks.inertial.outdoors import (
    AT_UNIT,
    Antenna,
    Resting,
    aid_antennas,
    aid_compass,
    aid_gnss_position,
    aid_gnss_velocity,
    aid_height,
    aid_wheels,
    standing,
)

__all__ = [
    "Compassed",
    "compass_by_gyro",
    "need_usable",
    "usable",
    "GRAVITY",
    "ImuNoise",
    "error_jacobian",
    "predict",
    "aid_attitude",
    "aid_position",
    "correct_belief",
    "carried",
    "Start",
    "StartSpread",
    "align_static",
    "level_attitude",
    "orientation_start",
    "rest_seconds",
    "belief_at_start",
    "start_belief",
    "static_alignment",
    "silence_frozen_gyro",
    "subtract_rest_bias",
    "CountsCalibration",
    "calibrated",
    "collect_equations",
    "fit_counts",
    "solve_equations",
    "sum_counts",
    "window_means",
    "windows_of",
    "Motion",
    "align_moving",
    "PARAMETERS",
    "Earth",
    "Parameter",
    "earth_at",
    "extended",
    "gravity_at",
    "navigation_crossing",
    "places",
    "predict_navigation",
    "AT_UNIT",
    "Antenna",
    "Resting",
    "aid_antennas",
    "aid_compass",
    "aid_gnss_position",
    "aid_gnss_velocity",
    "aid_height",
    "aid_wheels",
    "standing",
]
