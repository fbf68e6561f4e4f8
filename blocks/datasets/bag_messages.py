"""What is read of a bag's messages: the numbers, the signal they make, and the flags for 'not measured'.

    sensor_msgs/Imu                              Imu               the stream imu
    geometry_msgs/PoseStamped                    Pose              vicon
    geometry_msgs/TransformStamped               Pose              vicon
    geometry_msgs/PoseWithCovarianceStamped      Pose              vicon, where no topic of those two is there
    nav_msgs/Odometry                            Pose              vicon, likewise; its velocity: GnssVelocity
    tf2_msgs/TFMessage, tf/tfMessage             Pose              vicon, likewise
    geometry_msgs/PointStamped                   Position          leica
    sensor_msgs/NavSatFix                        GnssFix           gps
    sensor_msgs/MagneticField                    MagneticField     magnetometer
    geometry_msgs/TwistStamped                   Velocity          velocity, when it is named
    geometry_msgs/TwistWithCovarianceStamped     GnssVelocity      velocity, when it is named

A message says what it did not measure: a negative first variance (ROS has -1), and a NavSatFix by its status.
Such numbers are NaN. Fixes and velocities keep the covariance of each message; one that is not known is zero.
A stream that is called gyro or accelerometer takes that part of an Imu, and one that is called velocity or
gps_velocity the velocity of an Odometry, turned into its frame.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np

from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.signals import (
    GnssFix,
    GnssVelocity,
    Gyro,
    Imu,
    MagneticField,
    Pose,
    Position,
    SpecificForce,
    Velocity,
)

__all__ = ["KINDS", "TRANSFORMS", "VELOCITIES", "Kind", "kind_of"]


class Kind(NamedTuple):
    """How a type of message is read.

    stream: its usual name. numbers: those of one reading. fields: of the signal, in the numbers. signal: what
    they make. variances: the covariances of the message, and the numbers that each is of. parts: the readings
    in one message. beside: what a reading has that is not read. first: whether it has its usual name before
    others of that name. named: whether it is read only when it is named.
    """

    stream: str
    numbers: Callable[[Any], list[float]]
    fields: Mapping[str, slice]
    signal: Any
    variances: Mapping[str, slice] = {}
    parts: Callable[[Any], Sequence[Any]] = lambda m: (m,)
    beside: Callable[[Any], Sequence[str]] = lambda m: ()
    first: bool = True
    named: bool = False

    def read(self, reading: Any) -> tuple[list[float], list[str]]:
        """Its numbers, NaN where the message says that they were not measured, and the flags that say so."""
        numbers, flags = self.numbers(reading), []
        for name, part in self.variances.items():
            if attrgetter(name)(reading)[0] < 0.0:
                numbers[part] = [math.nan] * len(numbers[part])
                flags.append(f"{name}[0] < 0")
        if self.signal is _fixed and reading.status.status < 0:
            numbers = [math.nan] * len(numbers)
            flags.append("status.status < 0")
        return numbers, flags


def _vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def _quaternion(q: Any) -> list[float]:
    return [q.w, q.x, q.y, q.z]


def _pose(p: Any) -> list[float]:
    return _vector(p.position) + _quaternion(p.orientation)


def _transform(m: Any) -> list[float]:
    return _vector(m.transform.translation) + _quaternion(m.transform.rotation)


def _world_velocity(m: Any) -> list[float]:
    """The velocity of an Odometry, which is in the axes of its body, in those of its frame, and its block of
    the covariance, turned with it."""
    twist = _twist(m)
    q = np.array([_quaternion(m.pose.pose.orientation)])
    if not np.any(q):  # which is refused with the poses
        return twist
    R = np.asarray(to_matrix(q / np.linalg.norm(q), xp=np))[0]
    covariance = R @ np.reshape(twist[3:], (3, 3)) @ R.T
    return [*(R @ twist[:3]).tolist(), *covariance.ravel().tolist()]


def _orientation(m: Any) -> list[str]:
    """Whether an Imu has an orientation: not flagged, and not what is there when nobody sets it."""
    covariance, q = m.orientation_covariance, m.orientation
    unset = covariance[0] < 0.0 or not any(_quaternion(q)) or not (any((q.x, q.y, q.z)) or covariance.any())
    return [] if unset else ["orientations"]


def _fix(m: Any) -> list[float]:
    known = m.position_covariance_type > 0 and m.position_covariance[0] >= 0.0
    covariance = [float(x) for x in m.position_covariance] if known else [0.0] * 9
    return [math.radians(m.latitude), math.radians(m.longitude), m.altitude, *covariance]


def _fixed(latitude: Any, longitude: Any, height: Any, covariance: Any) -> GnssFix:
    return GnssFix(
        latitude=latitude[:, 0], longitude=longitude[:, 0], height=height[:, 0],
        covariance=covariance.reshape(-1, 3, 3),
    )  # fmt: skip


def _twist(m: Any) -> list[float]:
    """The velocity, and its block of the covariance."""
    rows = [float(x) for k in range(3) for x in m.twist.covariance[6 * k : 6 * k + 3]]
    return _vector(m.twist.twist.linear) + ([0.0] * 9 if rows[0] < 0.0 else rows)


def _moved(velocity: Any, covariance: Any) -> GnssVelocity:
    return GnssVelocity(velocity=velocity, covariance=covariance.reshape(-1, 3, 3))


_POSE = {"position": slice(0, 3), "attitude": slice(3, 7)}
_VELOCITY = {"velocity": slice(0, 3)}
_WITH_ITS_OWN = {"velocity": slice(0, 3), "covariance": slice(3, 12)}
_TRANSFORMS = Kind("vicon", _transform, _POSE, Pose, parts=lambda m: m.transforms, first=False)
_WITH_COVARIANCE = {"pose.covariance": slice(0, 7)}

TRANSFORMS = ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
"""The types that hold transforms of many bodies in one topic."""

KINDS: Mapping[str, Kind] = {
    "sensor_msgs/msg/Imu": Kind(
        "imu",
        lambda m: _vector(m.angular_velocity) + _vector(m.linear_acceleration),
        {"gyro": slice(0, 3), "specific_force": slice(3, 6)},
        Imu,
        {"angular_velocity_covariance": slice(0, 3), "linear_acceleration_covariance": slice(3, 6)},
        beside=_orientation,
    ),
    "geometry_msgs/msg/PoseStamped": Kind("vicon", lambda m: _pose(m.pose), _POSE, Pose),
    "geometry_msgs/msg/TransformStamped": Kind("vicon", _transform, _POSE, Pose),
    "geometry_msgs/msg/PoseWithCovarianceStamped": Kind(
        "vicon", lambda m: _pose(m.pose.pose), _POSE, Pose, _WITH_COVARIANCE, first=False
    ),
    "nav_msgs/msg/Odometry": Kind(
        "vicon",
        lambda m: _pose(m.pose.pose),
        _POSE,
        Pose,
        _WITH_COVARIANCE,
        beside=lambda m: ["velocities"],
        first=False,
    ),
    **{name: _TRANSFORMS for name in TRANSFORMS},
    "geometry_msgs/msg/PointStamped": Kind(
        "leica", lambda m: _vector(m.point), {"position": slice(0, 3)}, Position
    ),
    "sensor_msgs/msg/NavSatFix": Kind(
        "gps",
        _fix,
        {
            "latitude": slice(0, 1),
            "longitude": slice(1, 2),
            "height": slice(2, 3),
            "covariance": slice(3, 12),
        },
        _fixed,
        {"position_covariance": slice(0, 3)},
    ),
    "sensor_msgs/msg/MagneticField": Kind(
        "magnetometer",
        lambda m: _vector(m.magnetic_field),
        {"field": slice(0, 3)},
        MagneticField,
        {"magnetic_field_covariance": slice(0, 3)},
    ),
    "geometry_msgs/msg/TwistStamped": Kind(
        "velocity", lambda m: _vector(m.twist.linear), _VELOCITY, Velocity, named=True
    ),
    "geometry_msgs/msg/TwistWithCovarianceStamped": Kind(
        "velocity",
        _twist,
        _WITH_ITS_OWN,
        _moved,
        {"twist.covariance": slice(0, 3)},
        named=True,
    ),
}
"""What is read of a bag, by type of message."""

VELOCITIES = ("velocity", "gps_velocity", "gnss_velocity")
"""Names of streams of a velocity."""

_PARTS: Mapping[tuple[str, str], Kind] = {
    ("sensor_msgs/msg/Imu", "gyro"): Kind(
        "gyro",
        lambda m: _vector(m.angular_velocity),
        {"rate": slice(0, 3)},
        Gyro,
        {"angular_velocity_covariance": slice(0, 3)},
    ),
    ("sensor_msgs/msg/Imu", "accelerometer"): Kind(
        "accelerometer",
        lambda m: _vector(m.linear_acceleration),
        {"force": slice(0, 3)},
        SpecificForce,
        {"linear_acceleration_covariance": slice(0, 3)},
    ),
    ("nav_msgs/msg/Odometry", "velocity"): Kind(
        "velocity",
        _world_velocity,
        _WITH_ITS_OWN,
        _moved,
        {"twist.covariance": slice(0, 3)},
    ),
}


def kind_of(message: str, stream: str) -> Kind:
    """How messages of a type of `KINDS` are read into a stream of that name."""
    return _PARTS.get((message, "velocity" if stream in VELOCITIES else stream), KINDS[message])
