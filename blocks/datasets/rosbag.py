"""Bags of ROS 1 (.bag) and ROS 2 (a folder with metadata.yaml), without ROS.

    sensor_msgs/Imu                    Imu                the stream imu
    geometry_msgs/PoseStamped          Pose               vicon
    geometry_msgs/TransformStamped     Pose               vicon
    sensor_msgs/NavSatFix              GeodeticPosition   gps
    sensor_msgs/MagneticField          MagneticField      magnetometer

Where a bag has several topics of one kind, each stream is named by its topic (/left/imu becomes left_imu),
and `topics` can name them. Only the topics of these kinds are read. Messages are read by the definitions that
ROS publishes; those inside a bag are not run.

The work is done by the `rosbags` library: pip install "flowgraph-filters[ros]".
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    number,
    policy,
    stream_settings,
)
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.blocks.signals import GeodeticPosition, Imu, MagneticField, Pose
from flowgraph.errors import DataError, DeclarationError, MissingDependencyError, UnknownNameError

__all__ = ["KINDS", "SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    "topics": "NAME:TOPIC, comma-separated: which topics to read, and their streams' names; truth is one",
    "stamp": "header (when it was measured) or bag (when it was recorded)",
    **NOISE_SETTINGS,
    "position.noise": "standard deviation of measured positions, m",
    "attitude.noise": "standard deviation of measured attitudes, rad",
    "bad_time": "messages out of order: " + ", ".join(POLICIES),
    **stream_settings("STREAM"),
}
"""The settings of `load` and what they mean."""


class Kind(NamedTuple):
    """A message that is read: its stream's name, the numbers in it, their fields and the signal."""

    stream: str
    numbers: Callable[[Any], list[float]]
    fields: Mapping[str, slice]
    signal: Any


def _vector(v: Any) -> list[float]:
    return [v.x, v.y, v.z]


def _quaternion(q: Any) -> list[float]:
    return [q.w, q.x, q.y, q.z]


def _fix(m: Any) -> list[float]:
    seen = m.status.status >= 0  # -1 says that there was no fix
    return [math.radians(m.latitude), math.radians(m.longitude), m.altitude] if seen else [math.nan] * 3


_POSE = {"position": slice(0, 3), "attitude": slice(3, 7)}
KINDS: Mapping[str, Kind] = {
    "sensor_msgs/msg/Imu": Kind(
        "imu",
        lambda m: _vector(m.angular_velocity) + _vector(m.linear_acceleration),
        {"gyro": slice(0, 3), "specific_force": slice(3, 6)},
        Imu,
    ),
    "geometry_msgs/msg/PoseStamped": Kind(
        "vicon", lambda m: _vector(m.pose.position) + _quaternion(m.pose.orientation), _POSE, Pose
    ),
    "geometry_msgs/msg/TransformStamped": Kind(
        "vicon", lambda m: _vector(m.transform.translation) + _quaternion(m.transform.rotation), _POSE, Pose
    ),
    "sensor_msgs/msg/NavSatFix": Kind(
        "gps",
        _fix,
        {"latitude": slice(0, 1), "longitude": slice(1, 2), "height": slice(2, 3)},
        lambda latitude, longitude, height: GeodeticPosition(
            latitude=latitude[:, 0], longitude=longitude[:, 0], height=height[:, 0]
        ),
    ),
    "sensor_msgs/msg/MagneticField": Kind(
        "magnetometer", lambda m: _vector(m.magnetic_field), {"field": slice(0, 3)}, MagneticField
    ),
}
"""What is read of a bag, by type of message."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the topics of the `KINDS` of a bag.

    Args:
        argument: a .bag file, or a folder with a metadata.yaml.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight` with a stream a topic. truth: the topic that `topics` calls truth. info: `topics` (by
        stream), `frames` (frame_id by stream), `absent`; with an imu `imu_noise`.

    Raises:
        MissingDependencyError: without the rosbags library.
        DataError: there is no such bag, it is damaged or holds none of the `KINDS`; stamps are out of order
            (topic, message), or values cannot be of the unit that ROS gives them.
        DeclarationError, UnknownNameError: for a setting, or a topic that is not there.
    """
    given = settings or {}
    known(given, SETTINGS, "rosbag")
    stamp = chosen(given, "stamp", ("header", "bag"), "rosbag")
    made = Recording(
        Path(argument).stem,
        policy(given, "rosbag"),
        kind="rosbag",
        given=given,
        clock="stamp=bag takes the clock of the recorder" if stamp == "header" else "check the bag",
        units="mend the driver: ROS has SI units",
        place=argument,
    )
    path = Path(argument).expanduser()
    wanted = _wanted(str(given["topics"])) if "topics" in given else None
    made.info.update(topics={}, frames={})
    with _Bag(path) as bag:
        for name, topic, kind in _chosen(path, bag, wanted):
            _read(made, path, bag, name, topic, kind, stamp)
    if any("gyro" in s.leaves for s in made.streams.values()):
        made.info["imu_noise"] = imu_noise(given, "rosbag", made.notes)
    for name in ("position", "attitude"):
        if f"{name}.noise" in given:
            made.info[f"{name}_noise"] = number(given, f"{name}.noise", 0.01, "rosbag")
    return made.flight()


class _Bag:
    """An open bag of either version, with the definitions that ROS publishes."""

    def __init__(self, path: Path) -> None:
        try:
            from rosbags import rosbag1, rosbag2  # optional, with what follows
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise MissingDependencyError(
                "bags need the rosbags library",
                path=str(path),
                expected="the Python package rosbags",
                got="it cannot be imported",
                fix='pip install "flowgraph-filters[ros]"',
            ) from None
        self.path = path
        if not path.exists() or not (path.is_dir() or path.suffix == ".bag"):
            raise DataError(
                "this is no bag",
                path=str(path),
                expected="a .bag file (ROS 1), or a folder with metadata.yaml (ROS 2)",
                got="no such file or folder" if not path.exists() else f"a file {path.name}",
                fix="check the path",
            )
        with self._damage():
            self.reader: Any = rosbag2.Reader(path) if path.is_dir() else rosbag1.Reader(path)
        self.store = get_typestore(Stores.ROS2_HUMBLE if path.is_dir() else Stores.ROS1_NOETIC)
        self.decode = self.store.deserialize_cdr if path.is_dir() else self.store.deserialize_ros1

    def __enter__(self) -> _Bag:
        with self._damage():
            self.reader.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.reader.close()

    def connections(self) -> list[Any]:
        return [c for c in self.reader.connections if c.msgtype in KINDS]

    def messages(self, connections: list[Any]) -> Iterator[tuple[int, Any]]:
        with self._damage():
            for connection, time, raw in self.reader.messages(connections=connections):
                yield time, self.decode(raw, connection.msgtype)

    def _damage(self) -> _Damage:
        return _Damage(self.path)


class _Damage:
    """What the library says against a bag becomes a `DataError`."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: Any, error: Any, trace: Any) -> None:
        if error is None or not isinstance(error, Exception) or isinstance(error, DataError):
            return
        raise DataError(
            "this bag cannot be read",
            path=str(self.path),
            expected="a whole bag of ROS 1 or ROS 2",
            got=f"{type(error).__name__}: {error}"[:200],
            fix="fetch it again, or mend it with the tools of ROS (rosbag reindex, ros2 bag reindex)",
        ) from error


def _wanted(text: str) -> dict[str, str]:
    """Names of streams by topic."""
    pairs = [part.strip().partition(":") for part in text.split(",")]
    for name, colon, topic in pairs:
        if not name or not colon or not topic:
            raise DeclarationError(
                "this is no list of topics",
                path="rosbag.topics",
                expected="NAME:TOPIC, comma-separated",
                got=repr(text),
                fix="for example topics=imu:/imu0,vicon:/vicon/pose,truth:/ground_truth",
            )
    names = [name for name, _, _ in pairs]
    if len({*names}) < len(names) or len({t for _, _, t in pairs}) < len(names):
        raise DeclarationError(
            "a stream or topic is named twice",
            path="rosbag.topics",
            expected="each once",
            got=text,
            fix="leave one of them out",
        )
    return {topic: name for name, _, topic in pairs}


def _chosen(path: Path, bag: _Bag, wanted: dict[str, str] | None) -> list[tuple[str, str, Kind]]:
    """Name, topic and kind of each stream to read."""
    kinds = {c.topic: KINDS[c.msgtype] for c in bag.connections() if c.msgcount}
    if not kinds:
        held = [f"{c.topic} ({c.msgtype}, {c.msgcount})" for c in bag.reader.connections]
        raise DataError(
            "there is nothing to read in this bag",
            path=str(path),
            expected="messages of " + ", ".join(KINDS),
            got=", ".join(held) or "an empty bag",
            fix="record the topics of the sensors",
        )
    if wanted is not None:
        for topic in wanted:
            if topic not in kinds:
                raise UnknownNameError("topic", topic, kinds, path=str(path))
        return [(name, topic, kinds[topic]) for topic, name in wanted.items()]
    usual = [kind.stream for kind in kinds.values()]
    return [
        (kind.stream if usual.count(kind.stream) == 1 else topic.strip("/").replace("/", "_"), topic, kind)
        for topic, kind in kinds.items()
    ]


def _read(made: Recording, path: Path, bag: _Bag, name: str, topic: str, kind: Kind, stamp: str) -> None:
    times, rows, frames = [], [], set()
    for time, message in bag.messages([c for c in bag.connections() if c.topic == topic]):
        header = message.header
        times.append(header.stamp.sec * 10**9 + header.stamp.nanosec if stamp == "header" else time)
        rows.append(kind.numbers(message))
        frames.add(header.frame_id)
    place = f"{path}: {topic}"
    table = np.array(rows, dtype=float)
    columns = {field: table[:, part] for field, part in kind.fields.items()}
    made.add(
        name,
        place,
        np.array(times, dtype=np.int64),
        columns,
        kind.signal,
        row=lambda k: f"{place}, message {k + 1}",
    )
    made.info["topics"][name], made.info["frames"][name] = topic, ", ".join(sorted(frames))
