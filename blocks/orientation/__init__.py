"""Orientation: which way a body points, from gyroscope, gravity, and the Earth's magnetic field.

`accelerometer` has the state and the measurements of a filter of attitude and body rate on an inertial unit
alone. `complementary` blends a gyroscope that drifts with a direction or a pose that is noisy, by shares set
by hand; `fixed_gain` computes what such shares leave of noise. `marg` adds the magnetometer, with the tilt in
one filter and the `heading` in another, so that no magnet can tip the horizon. `commanded` needs no inertial
unit: a commanded rate, and a sensor of the whole attitude.
"""

from __future__ import annotations

from flowgraph.blocks.orientation.accelerometer import (
    STATE,
    OrientationBelief,
    named_orientation,
    orientation_crossing,
    orientation_steps,
    roll_pitch_attitude,
    see_rate_and_gravity,
    stacked_imu,
    start_orientation,
    turn_by_rate,
)
from flowgraph.blocks.orientation.commanded import (
    TURN,
    attitude_belief,
    attitude_vector,
    between_rates,
    predict_turn,
    see_attitude,
    start_turn,
    turn_crossing,
    turn_steps,
    turned_back,
)
from flowgraph.blocks.orientation.complementary import (
    blend,
    carry_to_world,
    correct_by_pose,
    dead_reckon,
    level_near,
    remove_thrust,
    turn_by_gyro,
)
from flowgraph.blocks.orientation.fixed_gain import AttitudeNoise, PoseNoise, attitude_spread, pose_spread
from flowgraph.blocks.orientation.heading import (
    FieldTrust,
    doubt_heading,
    join_orientation,
    predict_heading,
    start_heading,
    update_heading,
)
from flowgraph.blocks.orientation.marg import (
    UNIT,
    RestRule,
    detect_rest,
    hold_velocity,
    predict_level,
    start_level,
)
from flowgraph.blocks.orientation.recording import turn_recording

__all__ = [
    "turn_recording",
    "turned_back",
    "turn_steps",
    "turn_crossing",
    "orientation_steps",
    "orientation_crossing",
    "doubt_heading",
    "TURN",
    "attitude_belief",
    "attitude_vector",
    "between_rates",
    "predict_turn",
    "see_attitude",
    "start_turn",
    "STATE",
    "OrientationBelief",
    "named_orientation",
    "roll_pitch_attitude",
    "see_rate_and_gravity",
    "stacked_imu",
    "start_orientation",
    "turn_by_rate",
    "turn_by_gyro",
    "carry_to_world",
    "level_near",
    "remove_thrust",
    "blend",
    "dead_reckon",
    "correct_by_pose",
    "UNIT",
    "RestRule",
    "detect_rest",
    "hold_velocity",
    "predict_level",
    "start_level",
    "FieldTrust",
    "join_orientation",
    "predict_heading",
    "start_heading",
    "update_heading",
    "AttitudeNoise",
    "PoseNoise",
    "attitude_spread",
    "pose_spread",
]
