"""Names of streams that would be one, topics that are passed over, and topics that cannot be read."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.datasets import rosbag
from tests.blocks.datasets.bags import MS, Pen, refused

pytest.importorskip("rosbags", reason="needs the extra ros")


@pytest.mark.parametrize(
    ("topics", "name"),
    [
        (["/a/pose", "/a_pose"], "a_pose"),
        (["a/b/c", "/a_b_c", "/z"], "a_b_c"),
        (["/imu", "/x"], "imu"),
        (["/m/n", "m_n"], "m_n"),
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_topics_that_would_have_one_name_are_both_named(tmp_path, topics, name, version):
    with Pen(tmp_path / "b.bag", version) as pen:
        for k in range(3):
            pen.imu("/unit", k * MS, [0, 0, 0], [0, 0, 9.8])
            for n, topic in enumerate(topics):
                pen.pose(topic, k * MS, [n, 0, 0])
    pair = [t for t in topics if t.strip("/").replace("/", "_") == name]
    if len(pair) == 1:
        pair.append("/unit")
    refused(tmp_path / "b.bag", "would have one name", repr(name), *pair, "topics=vicon:")
    names = ",".join(f"p{n}:{t}" for n, t in enumerate(topics))
    flight = rosbag.load(str(tmp_path / "b.bag"), settings={"topics": names})
    for n in range(len(topics)):
        assert flight.streams[f"p{n}"]["position"][0, 0] == n


def test_a_topic_that_is_nothing_but_slashes_has_no_name(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for topic in ("/", "/a"):
            pen.pose(topic, 5, [0, 0, 0])
    refused(tmp_path / "b", "has no name", "topics=vicon:/")


def test_topics_that_are_passed_over_are_named_with_type_and_count(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for k in range(3):
            pen.imu("/imu", k * MS, [0, 0, 0], [0, 0, 9.8])
            pen.pose("/pose", k * MS, [0, 0, 0])
            pen.write("/up", "geometry_msgs/msg/Vector3Stamped", k * MS, pen.vector([0, 0, 1]))
        pen.put("/said", "std_msgs/msg/String", 5, pen.make("std_msgs/msg/String", "hello"))
    other = (
        "skipped: /said (std_msgs/msg/String, 1 message), /up (geometry_msgs/msg/Vector3Stamped, 3 messages)"
    )
    assert other in rosbag.load(str(tmp_path / "b")).notes
    notes = rosbag.load(str(tmp_path / "b"), settings={"topics": "imu:/imu"}).notes
    assert other in notes
    left = "skipped: /pose (geometry_msgs/msg/PoseStamped, 3 messages); `topics` reads those that it names"
    assert left in notes


@pytest.mark.parametrize(
    "kind", ["std_msgs/msg/String", "geometry_msgs/msg/Vector3Stamped", "std_msgs/msg/Empty"]
)
def test_a_named_topic_of_a_type_that_is_not_read_is_named_with_its_type(tmp_path, kind):
    with Pen(tmp_path / "b") as pen:
        pen.pose("/pose", 5, [0, 0, 0])
        parts = {
            "std_msgs/msg/String": ["hello"],
            "std_msgs/msg/Empty": [],
            "geometry_msgs/msg/Vector3Stamped": [pen.header(5), pen.vector([0, 0, 1])],
        }
        pen.put("/it", kind, 5, pen.make(kind, *parts[kind]))
    refused(tmp_path / "b", "/it", "not read", kind, "nav_msgs/msg/Odometry", topics="vicon:/it")


def test_one_topic_of_two_types_is_refused(tmp_path):
    with Pen(tmp_path / "b") as pen:
        pen.pose("/x", 5, [0, 0, 0])
        pen.imu("/x", 6, [0, 0, 0], [0, 0, 9.8])
    refused(tmp_path / "b", "/x", "several types", "geometry_msgs/msg/PoseStamped, sensor_msgs/msg/Imu")


def test_a_topic_without_messages_is_passed_over_or_refused_when_it_is_named(tmp_path):
    with Pen(tmp_path / "b") as pen:
        kind = "geometry_msgs/msg/PoseStamped"
        pen.writer.add_connection("/none", kind, typestore=pen.store)
        pen.pose("/pose", 5, [0, 0, 0])
    flight = rosbag.load(str(tmp_path / "b"))
    assert set(flight.streams) == {"vicon"}
    assert f"skipped: /none ({kind}, 0 messages)" in flight.notes
    refused(tmp_path / "b", "/none", "holds no messages", topics="vicon:/none")


def test_the_truth_by_its_name_is_said(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for topic in ("/truth", "/other"):
            pen.pose(topic, 5, [1, 2, 3])
    flight = rosbag.load(str(tmp_path / "b"))
    assert flight.truth is not None
    np.testing.assert_array_equal(flight.truth["position"], [[1, 2, 3]])
    assert "assumed: /truth is the truth, by its name" in flight.notes
