"""Writes small bags, of either version and in all containers, and reads what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph.blocks.datasets import rosbag
from flowgraph.errors import DataError

MS = 1_000_000

TRANSFORMS = "geometry_msgs/TransformStamped[] transforms"


class Pen:
    """Writes messages into a bag of either version."""

    def __init__(self, path: Path, version: int = 2, storage: str = "sqlite3") -> None:
        from rosbags import rosbag1, rosbag2
        from rosbags.rosbag2 import StoragePlugin
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.version = version
        self.store = get_typestore(Stores.ROS2_HUMBLE if version == 2 else Stores.ROS1_NOETIC)
        if version == 1:
            for name in ("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage"):
                self.store.register(get_types_from_msg(TRANSFORMS, name))
        self.writer: Any = (
            rosbag2.Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
            if version == 2
            else rosbag1.Writer(path)
        )
        self.connections: dict[tuple[str, str], Any] = {}
        self.count = 0
        self.frame = "body"

    def __enter__(self) -> Pen:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, *parts: Any) -> Any:
        return self.store.types[name](*parts)

    def header(self, t: int) -> Any:
        time = self.make("builtin_interfaces/msg/Time", t // 10**9, t % 10**9)
        first = () if self.version == 2 else (self.count,)
        return self.make("std_msgs/msg/Header", *first, time, self.frame)

    def vector(self, v: Any, kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", *map(float, v))

    def quaternion(self, q: Any) -> Any:
        w, x, y, z = map(float, q)
        return self.make("geometry_msgs/msg/Quaternion", x, y, z, w)

    def put(self, topic: str, kind: str, t: int, message: Any) -> None:
        """A whole message, recorded at `t`."""
        key = topic, kind
        if key not in self.connections:
            self.connections[key] = self.writer.add_connection(topic, kind, typestore=self.store)
        pack = self.store.serialize_cdr if self.version == 2 else self.store.serialize_ros1
        self.writer.write(self.connections[key], t, pack(message, kind))
        self.count += 1

    def write(self, topic: str, kind: str, t: int, *parts: Any, late: int = 0) -> None:
        self.put(topic, kind, t + late, self.make(kind, self.header(t), *parts))

    def imu(
        self,
        topic: str,
        t: int,
        gyro: Any,
        force: Any,
        late: int = 0,
        absent: str = "",
        attitude: Any = (1, 0, 0, 0),
    ) -> None:
        first = {"orientation": np.zeros(9), "gyro": np.zeros(9), "force": np.zeros(9)}
        if absent:
            first[absent][0] = -1.0
        o, g, f = first.values()
        at = (self.quaternion(attitude), o, self.vector(gyro), g, self.vector(force), f)
        self.write(topic, "sensor_msgs/msg/Imu", t, *at, late=late)

    def posed(self, p: Any, q: Any) -> Any:
        return self.make("geometry_msgs/msg/Pose", self.vector(p, "Point"), self.quaternion(q))

    def pose(self, topic: str, t: int, p: Any, q: Any = (1, 0, 0, 0), late: int = 0) -> None:
        self.write(topic, "geometry_msgs/msg/PoseStamped", t, self.posed(p, q), late=late)

    def covered(self, p: Any, q: Any, variance: float = 1e-4) -> Any:
        return self.make("geometry_msgs/msg/PoseWithCovariance", self.posed(p, q), np.full(36, variance))

    def twist(self, v: Any) -> Any:
        return self.make("geometry_msgs/msg/Twist", self.vector(v), self.vector([0, 0, 0]))

    def odometry(
        self, topic: str, t: int, p: Any, q: Any, v: Any, body: str = "base", covariance: Any = None
    ) -> None:
        told = np.zeros(36) if covariance is None else np.ravel(covariance).astype(float)
        moved = self.make("geometry_msgs/msg/TwistWithCovariance", self.twist(v), told)
        self.write(topic, "nav_msgs/msg/Odometry", t, body, self.covered(p, q), moved)

    def transformed(self, t: int, p: Any, q: Any = (1, 0, 0, 0), body: str = "child") -> Any:
        turn = self.make("geometry_msgs/msg/Transform", self.vector(p), self.quaternion(q))
        return self.make("geometry_msgs/msg/TransformStamped", self.header(t), body, turn)

    def transform(self, topic: str, t: int, p: Any, q: Any = (1, 0, 0, 0), body: str = "child") -> None:
        self.put(topic, "geometry_msgs/msg/TransformStamped", t, self.transformed(t, p, q, body))

    def tree(self, topic: str, t: int, at: dict[str, Any], kind: str = "tf2_msgs/msg/TFMessage") -> None:
        """Transforms of several bodies in one message."""
        self.put(topic, kind, t, self.make(kind, [self.transformed(t, p, body=b) for b, p in at.items()]))

    def fix(
        self, topic: str, t: int, status: int, lat: float, lon: float, height: float, covariance: Any = None
    ) -> None:
        state = self.make("sensor_msgs/msg/NavSatStatus", status, 1)
        told = (np.zeros(9), 0) if covariance is None else (np.ravel(covariance).astype(float), 3)
        self.write(topic, "sensor_msgs/msg/NavSatFix", t, state, lat, lon, height, *told)

    def moving(self, topic: str, t: int, v: Any, covariance: Any) -> None:
        twist = self.make("geometry_msgs/msg/TwistWithCovariance", self.twist(v), np.ravel(covariance))
        self.write(topic, "geometry_msgs/msg/TwistWithCovarianceStamped", t, twist)

    def field(self, topic: str, t: int, v: Any, variance: float = 0.0) -> None:
        self.write(topic, "sensor_msgs/msg/MagneticField", t, self.vector(v), np.full(9, variance))


def refused(path: Path, *parts: str, kind: type = DataError, **settings: str) -> None:
    with pytest.raises(kind) as caught:
        rosbag.load(str(path), settings=settings)
    for part in (*parts, "expected:", "got:", "fix:"):
        assert part in str(caught.value)
