"""Every kind of message, the flags for 'not measured', bodies and frames, and stamps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import load_flight
from flowgraph.blocks.datasets import rosbag
from flowgraph.blocks.datasets.bag_messages import KINDS
from flowgraph.data.registry import find_graph
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.graphs.gnss_ins import gnss_ins
from tests.blocks.datasets.bags import MS, Pen, refused
from tests.blocks.datasets.test_satellites import inspected

pytest.importorskip("rosbags", reason="needs the extra ros")

TILT = (0.8, 0, 0.6, 0)
TIMES = [10**9 + k * 10 * MS for k in range(4)]


def noted(flight, word: str, *parts: str) -> None:
    """One note of that kind has all parts."""
    notes = [n for n in flight.notes if n.startswith(f"{word}: ")]
    assert any(all(p in n for p in parts) for n in notes), flight.notes


def write_pose(pen: Pen, kind: str, t: int, p: list[float], body: str = "base") -> None:
    """A pose by a message of any kind that holds one, in /pose."""
    if kind == "nav_msgs/msg/Odometry":
        pen.odometry("/pose", t, p, TILT, [1, 0, 0], body)
    elif kind == "geometry_msgs/msg/PoseWithCovarianceStamped":
        pen.write("/pose", kind, t, pen.covered(p, TILT))
    elif kind == "geometry_msgs/msg/PoseStamped":
        pen.pose("/pose", t, p, TILT)
    elif kind == "geometry_msgs/msg/TransformStamped":
        pen.transform("/pose", t, p, TILT, body)
    else:
        pen.put("/pose", kind, t, pen.make(kind, [pen.transformed(t, p, TILT, body)]))


POSES = [(kind, v) for kind, k in KINDS.items() if k.stream == "vicon" for v in (1, 2)]


@pytest.mark.parametrize(("kind", "version"), [p for p in POSES if p != ("tf/msg/tfMessage", 2)])
@pytest.mark.parametrize("named", [True, False])
def test_poses_are_read_from_every_message_that_holds_one(tmp_path, kind, version, named):
    with Pen(tmp_path / "b.bag", version) as pen:
        for k, t in enumerate(TIMES):
            write_pose(pen, kind, t, [k, 2, 3])
    flight = rosbag.load(str(tmp_path / "b.bag"), settings={"topics": "vicon:/pose"} if named else {})
    vicon = flight.streams["vicon"]
    assert vicon.time.tolist() == TIMES
    np.testing.assert_array_equal(vicon["position"], [[k, 2, 3] for k in range(4)])
    np.testing.assert_allclose(vicon["attitude"], [TILT] * 4)
    assert flight.info["frames"] == {"vicon": "body"}
    if "Pose" not in kind:
        assert flight.info["bodies"] == {"vicon": "base"}


@pytest.mark.parametrize("version", [1, 2])
def test_points_and_velocities_are_read(tmp_path, version):
    with Pen(tmp_path / "b.bag", version) as pen:
        for t in TIMES:
            pen.write("/prism", "geometry_msgs/msg/PointStamped", t, pen.vector([1, 2, 3], "Point"))
            pen.write("/v", "geometry_msgs/msg/TwistStamped", t, pen.twist([4, 5, 6]))
            moved = pen.make("geometry_msgs/msg/TwistWithCovariance", pen.twist([7, 8, 9]), np.zeros(36))
            pen.write("/w", "geometry_msgs/msg/TwistWithCovarianceStamped", t, moved)
            pen.odometry("/odom", t, [0, 0, 0], [np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [2, 1, 0])
    flight = rosbag.load(str(tmp_path / "b.bag"))
    assert set(flight.streams) == {"leica", "vicon"}  # whose axes a twist is in, only its user knows
    assert flight.streams["leica"]["position"][0].tolist() == [1, 2, 3]
    noted(flight, "skipped", "/v (geometry_msgs/msg/TwistStamped, 4 messages)", "/w (", "`topics`")
    noted(flight, "skipped", "vicon: the velocities", "/odom")
    for topic, expected in (("/v", [4, 5, 6]), ("/w", [7, 8, 9]), ("/odom", [-1, 2, 0])):
        flight = rosbag.load(str(tmp_path / "b.bag"), settings={"topics": f"velocity:{topic}"})
        np.testing.assert_allclose(flight.streams["velocity"]["velocity"][0], expected, atol=1e-12)
        if topic != "/odom":
            noted(flight, "assumed", "in the axes of the world", "'body'")


@pytest.mark.parametrize("storage", ["mcap", "sqlite3"])
def test_a_log_of_satellites_and_odometry_keeps_the_covariance_of_each_message(tmp_path, storage):
    """The velocity of an Odometry is turned into its frame, and its covariance with it."""
    told = np.zeros((6, 6))
    told[:3, :3] = [[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.16]]
    place = np.array([[1.0, 0.2, 0.0], [0.2, 2.0, 0.0], [0.0, 0.0, 4.0]])
    left = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    with Pen(tmp_path / "b", storage=storage) as pen:
        for k, t in enumerate(TIMES):
            pen.imu("/imu", t, [0.1, 0.2, 0.3], [0, 0, 9.8])
            pen.fix("/fix", t, 0, 47.4 + 1e-6 * k, 8.5, 430.0, place)
            pen.odometry("/odom", t, [0, 0, 0], left, [2, 1, 0], covariance=told)
    settings = {"topics": "imu:/imu,gps:/fix,gps_velocity:/odom"}
    flight = rosbag.load(str(tmp_path / "b"), settings=settings)
    gps, speed = flight.streams["gps"], flight.streams["gps_velocity"]
    np.testing.assert_array_equal(gps["latitude"], np.radians(47.4 + 1e-6 * np.arange(len(TIMES))))
    np.testing.assert_array_equal(gps["covariance"][0], place)
    np.testing.assert_allclose(speed["velocity"][0], [-1, 2, 0], atol=1e-12)
    turned = [[0.09, -0.01, 0.0], [-0.01, 0.04, 0.0], [0.0, 0.0, 0.16]]
    np.testing.assert_allclose(speed["covariance"][0], turned, atol=1e-12)
    seen = inspected(f"rosbag:{tmp_path / 'b'}", "--set", f"topics={settings['topics']}")
    assert {row["kind"] for row in seen.values()} == {"Imu", "GnssFix", "GnssVelocity"}
    assert {"gnss", "gnss_velocity"} < set(gnss_ins.case(flight).recorded)


def test_motion_capture_has_its_name_before_estimates_and_trees(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.tree("/tf", t, {"base": [9, 9, 9], "wheel": [8, 8, 8]})
            pen.tree("/tf_static", t, {"imu": [0, 0, 0]})
            pen.odometry("/odom", t, [7, 7, 7], TILT, [0, 0, 0])
            pen.pose("/mocap", t, [1, 1, 1])
    flight = rosbag.load(str(tmp_path / "b"))
    assert flight.info["topics"] == {"vicon": "/mocap", "odom": "/odom"}
    noted(flight, "skipped", "/tf (tf2_msgs/msg/TFMessage, 4 messages)", "/tf_static (")


# What was not measured


@pytest.mark.parametrize(
    ("absent", "field", "stream", "leaf"),
    [
        ("gyro", "angular_velocity_covariance", "accelerometer", "force"),
        ("force", "linear_acceleration_covariance", "gyro", "rate"),
    ],
)
@pytest.mark.parametrize("version", [1, 2])
def test_an_imu_that_says_it_has_one_part_only(tmp_path, absent, field, stream, leaf, version):
    """All messages say so: refused, and the other part can be read; some do: they are absent, and counted."""
    for name, flagged in (("all.bag", range(4)), ("some.bag", [2])):
        with Pen(tmp_path / name, version) as pen:
            for k, t in enumerate(TIMES):
                pen.imu("/imu0", t, [0, 0, k], [k, 0, 9.8], absent=absent if k in flagged else "")
    part = "gyroscope" if absent == "gyro" else "accelerometer"
    refused(tmp_path / "all.bag", "/imu0", f"no {part}", f"{field}[0] < 0", f"topics={stream}:/imu0")
    one = rosbag.load(str(tmp_path / "all.bag"), settings={"topics": f"{stream}:/imu0"})
    assert len(one.streams[stream][leaf]) == 4
    some = rosbag.load(str(tmp_path / "some.bag"))
    assert some.streams["imu"].time.tolist() == [t for k, t in enumerate(TIMES) if k != 2]
    assert some.info["absent"] == {"imu": 1}
    noted(some, "skipped", "1 of 4", "/imu0", field)


def test_both_parts_of_an_imu_as_streams_of_their_own(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.imu("/imu", t, [1, 0, 0], [0, 0, 9.8])
    flight = rosbag.load(str(tmp_path / "b"), settings={"topics": "gyro:/imu,accelerometer:/imu"})
    assert flight.streams["gyro"]["rate"][0].tolist() == [1, 0, 0]
    assert flight.streams["accelerometer"]["force"][0].tolist() == [0, 0, 9.8]


@pytest.mark.parametrize("case", ["field", "pose", "twist", "odometry", "fix"])
def test_a_negative_variance_is_not_measured_in_every_message_that_has_one(tmp_path, case):
    with Pen(tmp_path / "b") as pen:
        for k, t in enumerate(TIMES):
            variance = -1.0 if k == 1 else 1e-4
            if case == "field":
                pen.field("/x", t, [2e-5, 0, 4e-5], variance)
            elif case == "pose":
                kind = "geometry_msgs/msg/PoseWithCovarianceStamped"
                pen.write("/x", kind, t, pen.covered([0, 0, 0], TILT, variance))
            elif case == "twist":
                kind = "geometry_msgs/msg/TwistWithCovariance"
                moved = pen.make(kind, pen.twist([1, 2, 3]), np.full(36, variance))
                pen.write("/x", kind + "Stamped", t, moved)
            elif case == "odometry":
                pose = pen.covered([0, 0, 0], TILT, variance)
                moved = pen.make("geometry_msgs/msg/TwistWithCovariance", pen.twist([0, 0, 0]), np.zeros(36))
                pen.write("/x", "nav_msgs/msg/Odometry", t, "base", pose, moved)
            else:
                pen.fix("/x", t, -1 if k == 1 else 0, 45, 90, 10)
    flight = rosbag.load(str(tmp_path / "b"), settings={"topics": "x:/x"})
    assert flight.streams["x"].time.tolist() == [t for k, t in enumerate(TIMES) if k != 1]
    noted(flight, "skipped", "x: 1 of 4 messages of /x")


def test_a_receiver_that_never_had_a_fix_is_refused(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.fix("/gps", t, -1, 0, 0, 0)
    refused(tmp_path / "b", "/gps", "status.status < 0", "all of 4")


@pytest.mark.parametrize(
    ("attitude", "absent", "said"),
    [(TILT, "", True), (TILT, "orientation", False), ((1, 0, 0, 0), "", False), ((0, 0, 0, 0), "", False)],
)
def test_an_orientation_that_is_not_read_is_said(tmp_path, attitude, absent, said):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.imu("/imu", t, [0, 0, 0], [0, 0, 9.8], attitude=attitude, absent=absent)
    flight = rosbag.load(str(tmp_path / "b"))
    assert any("orientations" in n for n in flight.notes) is said


# Bodies and frames


@pytest.mark.parametrize(
    "kind", ["geometry_msgs/msg/TransformStamped", "nav_msgs/msg/Odometry", "tf2_msgs/msg/TFMessage"]
)
def test_two_bodies_in_one_topic_are_listed_and_either_can_be_chosen(tmp_path, kind):
    with Pen(tmp_path / "b") as pen:
        for k, t in enumerate(TIMES):
            write_pose(pen, kind, t, [k, 0, 0], "drone")
            write_pose(pen, kind, t + 10, [k, 70, 0], "wand")
    refused(tmp_path / "b", "/pose", "'drone' (4)", "'wand' (4)", "vicon.body=drone")
    for body, y in (("drone", 0), ("/wand", 70)):
        flight = rosbag.load(str(tmp_path / "b"), settings={"vicon.body": body})
        assert flight.streams["vicon"]["position"][:, 1].tolist() == [y] * 4
        assert flight.info["bodies"] == {"vicon": body.strip("/")}
        noted(flight, "skipped", "vicon: others of /pose", "wand" if y == 0 else "drone")
    both = load_flight(
        f"rosbag:{tmp_path / 'b'}",
        settings={"topics": "drone:/pose,wand:/pose", "drone.body": "drone", "wand.body": "wand"},
    )
    assert both.streams["wand"]["position"][0].tolist() == [0, 70, 0]
    refused(tmp_path / "b", "'hand'", "'wand'", kind=UnknownNameError, **{"vicon.body": "hand"})


def test_two_frames_in_one_topic_are_listed_and_either_can_be_chosen(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for k, t in enumerate(TIMES):
            pen.frame = "/map" if k % 2 else "odom"
            pen.pose("/pose", t, [k, 0, 0])
    refused(tmp_path / "b", "'map' (2)", "'odom' (2)", "vicon.frame=map")
    flight = rosbag.load(str(tmp_path / "b"), settings={"vicon.frame": "map"})
    assert flight.streams["vicon"]["position"][:, 0].tolist() == [1, 3]
    assert flight.info["frames"] == {"vicon": "map"}


def test_a_tree_that_nobody_asked_for_is_passed_over_and_named(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.imu("/imu", t, [0, 0, 0], [0, 0, 9.8])
            pen.tree("/tf", t, {"base": [1, 0, 0], "wheel": [2, 0, 0]})
    flight = rosbag.load(str(tmp_path / "b"))
    assert set(flight.streams) == {"imu"}
    noted(flight, "skipped", "/tf", "'base'", "'wheel'", "vicon.body=")
    refused(tmp_path / "b", "'base' (4)", "'wheel' (4)", topics="imu:/imu,vicon:/tf")
    chosen = rosbag.load(str(tmp_path / "b"), settings={"vicon.body": "wheel"})
    assert chosen.streams["vicon"]["position"][0].tolist() == [2, 0, 0]


def test_what_frames_say_is_passed_on(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.frame = "map_ned"
            pen.pose("/a", t, [0, 0, 0])
            pen.frame = "lab"
            pen.pose("/b", t, [0, 0, 0])
    flight = rosbag.load(str(tmp_path / "b"), settings={"topics": "vicon:/a,truth:/b"})
    noted(flight, "warning", "vicon", "'map_ned'", "z up")
    noted(flight, "assumed", "these frames are one", "vicon in 'map_ned'", "truth in 'lab'")


# Stamps


def test_the_stamps_of_one_stream_can_be_those_of_the_recording(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.imu("/imu", t, [0, 0, 0], [0, 0, 9.8], late=7)
            pen.pose("/pose", t + 5, [0, 0, 0], late=2 * MS)
    given = {"vicon.stamp": "bag", "imu.time_offset": "0.005"}
    flight = load_flight(f"rosbag:{tmp_path / 'b'}", settings=given)
    assert flight.streams["imu"].time.tolist() == [t + 5 * MS for t in TIMES]
    assert flight.streams["vicon"].time.tolist() == [t + 5 + 2 * MS for t in TIMES]
    noted(flight, "info", "imu: stamps shifted by 5000000 ns")
    given = {"stamp": "bag", "vicon.stamp": "header"}
    flight = rosbag.load(str(tmp_path / "b"), settings=given)
    assert flight.streams["imu"].time.tolist() == [t + 7 for t in TIMES]
    assert flight.streams["vicon"].time[0] == TIMES[0] + 5
    refused(tmp_path / "b", "bag", kind=UnknownNameError, **{"imu.stamp": "mine"})
    refused(tmp_path / "b", "imu.time_offset", kind=DeclarationError, **{"imu.time_offset": "soon"})
    for setting in ("body", "frame", "stamp", "time_offset"):
        refused(tmp_path / "b", "'vicn'", "vicon", kind=UnknownNameError, **{f"vicn.{setting}": "1"})


@pytest.mark.parametrize("late", [0, 10**8])
def test_clocks_that_are_apart_are_refused_with_the_clock_of_the_recorder(tmp_path, late):
    """An IMU of the epoch beside a motion capture that counts from its start."""
    now = 1_700_000_000 * 10**9
    with Pen(tmp_path / "b") as pen:
        for t in TIMES:
            pen.imu("/imu", now + t, [0, 0, 0], [0, 0, 9.8])
            pen.pose("/pose", t, [0, 0, 0], late=now + late // 100)
    refused(tmp_path / "b", "no sample of vicon lies within the span of the imu", "stamp=bag")
    flight = rosbag.load(str(tmp_path / "b"), settings={"stamp": "bag"})
    assert flight.streams["vicon"].time.tolist() == [now + t + late // 100 for t in TIMES]


@pytest.mark.parametrize(
    ("stamps", "got"),
    [
        ([0, 0, 0, 0], "4 of 4 are 0"),
        ([0, *TIMES[1:]], None),
        ([0, 1_700_000_000 * 10**9, 1_700_000_001 * 10**9], "1 of 3 are 0"),
        ([5, 5, 5], "5 ns in all 3"),
        ([1 * MS, 0, 0, 2 * MS], "2 of 4 are 0"),
    ],
)
def test_stamps_that_nobody_set_are_refused_with_the_remedy(tmp_path, stamps, got):
    """A clock that starts at 0, as a simulator's, is one."""
    with Pen(tmp_path / "b") as pen:
        for k, t in enumerate(stamps):
            pen.pose("/pose", t, [k, 0, 0], late=5_000_000_000 + k * MS - t)
    if got is None:
        assert len(rosbag.load(str(tmp_path / "b")).streams["vicon"]) == len(stamps)
    else:
        refused(tmp_path / "b", "/pose, message", "are not set", got, "vicon.stamp=bag")
    flight = rosbag.load(str(tmp_path / "b"), settings={"stamp": "bag"})
    assert flight.streams["vicon"].time.tolist() == [5_000_000_000 + k * MS for k in range(len(stamps))]


def test_fixes_and_velocities_keep_their_covariances(tmp_path):
    """Of each message; one that is not known is zero, and the filter takes its own for it."""
    P = np.array([[4.0, 0.5, 0.1], [0.5, 9.0, 0.2], [0.1, 0.2, 16.0]])
    wide = np.zeros((6, 6))
    wide[:3, :3] = 0.25 * P
    with Pen(tmp_path / "b.bag", 1) as pen:
        for k, t in enumerate(TIMES):
            pen.imu("/imu", t, [0, 0, 0], [0, 0, 9.81])
            pen.fix("/gps", t, 0, 47.0, 8.0, 400.0, P * (1 + k) if k else None)
            pen.moving("/vel", t, [1, 2, 3], wide)
    flight = rosbag.load(str(tmp_path / "b.bag"), settings={"topics": "imu:/imu,gps:/gps,gps_velocity:/vel"})
    fixes, speeds = flight.streams["gps"], flight.streams["gps_velocity"]
    np.testing.assert_array_equal(fixes["covariance"], [0.0 * P, 2.0 * P, 3.0 * P, 4.0 * P])
    np.testing.assert_array_equal(speeds["covariance"], [0.25 * P] * 4)
    np.testing.assert_array_equal(speeds["velocity"], [[1.0, 2.0, 3.0]] * 4)
    case = find_graph("gnss_ins").case(flight)
    inputs: Any = case.inputs
    aid = inputs["gnss"]["covariance"]
    np.testing.assert_array_equal(aid[1:], fixes["covariance"][1:])
    assert np.all(np.linalg.eigvalsh(aid[0]) > 0.0)
