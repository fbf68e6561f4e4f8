"""Simulated sensors: each reads a `World` by its own clock, with its own noise, and perhaps late.

A sensor is immutable; `sensor.sample(world, seed=0)` gives a `Series` of its signal type. Random numbers
depend on the seed and the sensor's name only. `blocks` has sensors that are blocks of a graph, which read the
motion of a tick.
"""

from __future__ import annotations

from flowgraph.blocks.geometry.geodetic import as_geodetic, as_position, from_enu, to_enu
from flowgraph.blocks.sensors.altimeter import Altimeter
from flowgraph.blocks.sensors.blocks import (
    bias_at_start,
    drift,
    read_altimeter,
    read_attitude,
    read_flow,
    read_imu,
    read_magnetometer,
    read_pose,
    read_position,
    true_state,
)
from flowgraph.blocks.sensors.control import BodyRateInput, ThrustInput
from flowgraph.blocks.sensors.flow import OpticalFlowSensor
from flowgraph.blocks.sensors.gps import Gps
from flowgraph.blocks.sensors.inertial import (
    MOST_LOOKS,
    Accelerometer,
    CoordinateAccelerometer,
    Gyroscope,
    InertialSensor,
    InertialUnit,
    RateSensor,
)
from flowgraph.blocks.sensors.magnetic import MagneticAttitude, Magnetometer, earth_field
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.plane import read_plane_position, read_plane_velocity
from flowgraph.blocks.sensors.pose import AttitudeSensor, PositionSensor, Vicon, turned
from flowgraph.blocks.sensors.sensor import Recording, Sensor

__all__ = [
    "bias_at_start",
    "drift",
    "read_altimeter",
    "read_attitude",
    "read_flow",
    "read_imu",
    "read_magnetometer",
    "read_pose",
    "read_position",
    "read_plane_position",
    "read_plane_velocity",
    "true_state",
    "Sensor",
    "Recording",
    "Noise",
    "NO_NOISE",
    "MOST_LOOKS",
    "InertialSensor",
    "Gyroscope",
    "Accelerometer",
    "CoordinateAccelerometer",
    "InertialUnit",
    "RateSensor",
    "PositionSensor",
    "AttitudeSensor",
    "Vicon",
    "turned",
    "Gps",
    "Magnetometer",
    "MagneticAttitude",
    "earth_field",
    "Altimeter",
    "OpticalFlowSensor",
    "ThrustInput",
    "BodyRateInput",
    "to_enu",
    "from_enu",
    "as_geodetic",
    "as_position",
]
