"""Inertial navigation: what an inertial unit tells, how it is aided, started and calibrated.

`imu` carries a belief about position, velocity, attitude and the unit's biases forward on each reading: an
error-state Kalman filter's prediction, and `ImuNoise`, the densities by which all filters here know a unit.
`aiding` corrects that belief by measured positions and attitudes. `alignment` finds the attitude and biases
to start from, `calibration` takes out what a unit reads too much while it rests, and `imu_calibration` finds
what a count of its converters is worth by what a motion capture saw.
"""

from __future__ import annotations

from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.alignment import (
    Start,
    StartSpread,
    align_static,
    level_attitude,
    need_usable,
    orientation_start,
    rest_seconds,
    start_belief,
    static_alignment,
    usable,
)
from flowgraph.blocks.inertial.calibration import silence_frozen_gyro, subtract_rest_bias
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, error_jacobian, predict
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

__all__ = [
    "need_usable",
    "usable",
    "GRAVITY",
    "ImuNoise",
    "error_jacobian",
    "predict",
    "aid_attitude",
    "aid_position",
    "Start",
    "StartSpread",
    "align_static",
    "level_attitude",
    "orientation_start",
    "rest_seconds",
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
]
