"""Simulated sensors: blocks of a graph that read the motion of a tick (`BodyMotion`), each with its errors.

`blocks` has those of a body, `plane` those of a point in the plane, `car` those of a car. What differs in
time is said by clocks: the rate and phase of a sensor, and when a reading arrives, are those of the source at
which it fires.
"""

from __future__ import annotations

from flowgraph.blocks.geometry.geodetic import as_geodetic, as_position, from_enu, to_enu
from flowgraph.blocks.sensors.blocks import (
    bias_at_start,
    drift,
    read_acceleration,
    read_accelerometer,
    read_altimeter,
    read_attitude,
    read_body_rate,
    read_flow,
    read_gyro,
    read_imu,
    read_magnetometer,
    read_pose,
    read_position,
    read_thrust,
    to_geodetic,
    true_state,
)
from flowgraph.blocks.sensors.car import (
    read_fix,
    read_heading,
    read_height,
    read_over_earth,
    read_velocity,
    read_wheels,
)
from flowgraph.blocks.sensors.magnetic import earth_field
from flowgraph.blocks.sensors.plane import read_plane_position, read_plane_velocity

__all__ = [
    "bias_at_start",
    "drift",
    "read_acceleration",
    "read_accelerometer",
    "read_altimeter",
    "read_attitude",
    "read_body_rate",
    "read_flow",
    "read_gyro",
    "read_imu",
    "read_magnetometer",
    "read_pose",
    "read_position",
    "read_thrust",
    "read_plane_position",
    "read_plane_velocity",
    "read_fix",
    "read_heading",
    "read_height",
    "read_over_earth",
    "read_velocity",
    "read_wheels",
    "to_geodetic",
    "true_state",
    "earth_field",
    "to_enu",
    "from_enu",
    "as_geodetic",
    "as_position",
]
