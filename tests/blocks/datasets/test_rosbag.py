"""Bags of ROS 1 and 2, written here with the rosbags library and played through a filter."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, find_graph, load_flight, simulate
from flowgraph.blocks.datasets import rosbag
from flowgraph.errors import DeclarationError, MissingDependencyError, UnknownNameError
from tests.blocks.datasets.bags import MS, Pen, refused

pytest.importorskip("rosbags", reason="needs the extra ros")


def recorded(flight: Flight, path: Path, version: int = 2) -> None:
    """A simulated flight as a bag: /imu, /vicon and /truth."""
    imu, vicon, truth = flight.streams["imu"], flight.streams["vicon"], flight.truth
    assert truth is not None
    start = 1_700_000_000 * 10**9 + 123
    with Pen(path, version) as pen:
        for t, u in zip(imu.time.tolist(), imu, strict=True):
            pen.imu("/imu", start + t, u.gyro, u.specific_force)
        for t, z in zip(vicon.time.tolist(), vicon, strict=True):
            pen.pose("/vicon", start + t, z.position, z.attitude)
        for t, x in zip(truth.time.tolist(), truth, strict=True):
            pen.transform("/truth", start + t, x.position, x.attitude)


@pytest.mark.parametrize("version", [1, 2])
def test_a_bag_plays_through_ins_eskf_as_the_flight_itself(tmp_path, version):
    """The same numbers in, so the same belief out, at stamps of now."""
    sim = load_flight("sim", seed=4, settings={"duration": "3"})
    path = tmp_path / ("flight.bag" if version == 1 else "flight")
    recorded(sim, path, version)
    noise = sim.info["imu_noise"]
    given = {
        "topics": "imu:/imu,vicon:/vicon,truth:/truth",
        "gyro.noise": str(noise.gyro),
        "accelerometer.noise": str(noise.accelerometer),
        "gyro.walk": str(noise.gyro_bias),
        "accelerometer.walk": str(noise.accelerometer_bias),
        "position.noise": str(sim.info["position_noise"]),
        "attitude.noise": str(sim.info["attitude_noise"]),
    }
    flight = load_flight(f"rosbag:{path}", settings=given)
    assert flight.info["topics"] == {"imu": "/imu", "vicon": "/vicon", "truth": "/truth"}
    assert flight.info["frames"]["imu"] == "body"
    ins_eskf = find_graph("ins_eskf")
    case, ours = ins_eskf.case(flight), ins_eskf.case(sim)
    found, expected = simulate(case.graph, case.inputs), simulate(ours.graph, ours.inputs)
    np.testing.assert_array_equal(np.diff(found["belief"].time), np.diff(expected["belief"].time))
    np.testing.assert_allclose(found["belief"]["position"], expected["belief"]["position"], atol=1e-9)
    assert case.score(found)["position_rmse_m"] == pytest.approx(
        ours.score(expected)["position_rmse_m"], rel=1e-6
    )
    assert case.score(found)["position_rmse_m"] < 0.03


@pytest.mark.parametrize("version", [1, 2])
def test_all_kinds_of_message_are_read_in_si_units(tmp_path, version):
    path = tmp_path / ("b.bag" if version == 1 else "b")
    with Pen(path, version) as pen:
        for k in range(3):
            t = 10**9 + k * 10 * MS + 7
            pen.imu("/imu", t, [0.1, 0, 0], [0, 0, 9.8])
            pen.transform("/body", t, [1, 2, 3], [0.8, 0, 0.6, 0])
            pen.fix("/gps/fix", t, -1 if k == 1 else 0, 45.0, 90.0, 12.0)
            pen.field("/mag", t, [0, 2e-5, -4e-5])
    flight = load_flight(f"rosbag:{path}")
    assert set(flight.streams) == {"imu", "vicon", "gps", "magnetometer"}
    assert flight.streams["imu"].time.tolist() == [10**9 + k * 10 * MS + 7 for k in range(3)]
    np.testing.assert_allclose(flight.streams["vicon"]["attitude"][0], [0.8, 0, 0.6, 0])
    np.testing.assert_allclose(flight.streams["gps"]["latitude"], np.pi / 4)
    assert len(flight.streams["gps"]) == 2  # one message said that there was no fix
    assert flight.info["absent"] == {"gps": 1}
    np.testing.assert_allclose(flight.streams["magnetometer"]["field"][0], [0, 2e-5, -4e-5])
    assert flight.truth is None


def test_several_topics_of_one_kind_keep_their_names(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for k in range(2):
            pen.imu("/left/imu", k * MS, [0, 0, 0], [0, 0, 9.8], late=5)
            pen.imu("/right/imu", k * MS, [0, 0, 0], [0, 0, 9.8])
    assert set(load_flight(f"rosbag:{tmp_path / 'b'}").streams) == {"left_imu", "right_imu"}
    one = load_flight(f"rosbag:{tmp_path / 'b'}", settings={"topics": "imu:/left/imu", "stamp": "bag"})
    assert set(one.streams) == {"imu"}
    assert one.streams["imu"].time.tolist() == [5, MS + 5]


def test_stamps_out_of_order_follow_the_rule(tmp_path):
    with Pen(tmp_path / "b") as pen:
        for k in (0, 2, 1, 3):
            pen.imu("/imu", k * MS, [k, 0, 0], [0, 0, 9.8])
    # the bag is in order of recording, which is that of the stamps: shift them to record late
    with Pen(tmp_path / "late") as pen:
        for n, k in enumerate((0, 2, 1, 3)):
            pen.imu("/imu", k * MS, [k, 0, 0], [0, 0, 9.8], late=(n - k) * MS)
    refused(tmp_path / "late", "/imu, message 3", "time does not increase", "bad_time=sort")
    dropped = rosbag.load(str(tmp_path / "late"), settings={"bad_time": "drop"})
    assert dropped.streams["imu"]["gyro"][:, 0].tolist() == [0, 2, 3]
    ordered = rosbag.load(str(tmp_path / "late"), settings={"bad_time": "sort"})
    assert ordered.streams["imu"]["gyro"][:, 0].tolist() == [0, 1, 2, 3]


def test_a_bag_without_anything_to_read_is_named(tmp_path):
    with Pen(tmp_path / "empty"):
        pass
    refused(tmp_path / "empty", "nothing to read in this bag", "an empty bag", "sensor_msgs/msg/Imu")
    with Pen(tmp_path / "empty.bag", version=1):
        pass
    refused(tmp_path / "empty.bag", "nothing to read in this bag")
    with Pen(tmp_path / "other") as pen:
        pen.write("/p", "geometry_msgs/msg/Vector3Stamped", 0, pen.vector([1, 2, 3]))
    refused(
        tmp_path / "other", "nothing to read in this bag", "/p (geometry_msgs/msg/Vector3Stamped, 1 message)"
    )


def test_a_damaged_bag_is_named_and_nothing_of_it_is_returned(tmp_path):
    refused(tmp_path / "none", "this is no bag", "no such file")
    (tmp_path / "x.txt").write_text("x")
    refused(tmp_path / "x.txt", "this is no bag", "x.txt")
    (tmp_path / "folder").mkdir()
    refused(tmp_path / "folder", "this is no bag", "nothing in it")
    with Pen(tmp_path / "one.bag", version=1) as pen:
        for k in range(50):
            pen.imu("/imu", k * MS, [0, 0, 0], [0, 0, 9.8])
    whole = (tmp_path / "one.bag").read_bytes()
    for kept in (10, 3000, len(whole) // 2, len(whole) - 20):
        (tmp_path / "one.bag").write_bytes(whole[:kept])
        refused(tmp_path / "one.bag", "this bag cannot be read")
    with Pen(tmp_path / "two") as pen:
        for k in range(50):
            pen.imu("/imu", k * MS, [0, 0, 0], [0, 0, 9.8])
    data = next((tmp_path / "two").glob("*.db3"))
    data.write_bytes(data.read_bytes()[:5000])
    refused(tmp_path / "two", "this bag cannot be read")


def test_wrong_units_in_a_bag_are_named(tmp_path):
    with Pen(tmp_path / "g") as pen:
        for k in range(4):
            pen.imu("/imu", k * MS, [0, 0, 0], [0, 0, 1.0])
    refused(tmp_path / "g", "/imu: imu.specific_force", "not in the unit", "in g it is 1")
    refused(tmp_path / "g", "accelerometer.force", "in g it is 1", topics="accelerometer:/imu")
    with Pen(tmp_path / "q") as pen:
        pen.pose("/pose", 0, [0, 0, 0], [0, 0, 0, 0])
    refused(tmp_path / "q", "/pose", "not a unit quaternion")


def test_wrong_settings_are_refused(tmp_path):
    with Pen(tmp_path / "b") as pen:
        pen.imu("/imu", 0, [0, 0, 0], [0, 0, 9.8])
    refused(tmp_path / "b", "no topic is called '/gyro'", kind=UnknownNameError, topics="imu:/gyro")
    refused(tmp_path / "b", "no list of topics", kind=DeclarationError, topics="/imu")
    refused(tmp_path / "b", "named twice", kind=DeclarationError, topics="a:/imu,a:/imu2")
    refused(tmp_path / "b", "bag, both, header", kind=UnknownNameError, stamp="mine")


def test_without_the_library_it_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags", None)
    refused(tmp_path, "bags need the rosbags library", "flowgraph-filters[ros]", kind=MissingDependencyError)


def test_a_bag_tells_when_a_message_was_true_and_when_it_arrived(tmp_path):
    path = tmp_path / "late"
    with Pen(path) as pen:
        for k in range(20):
            t = 10**9 + k * 10 * MS
            pen.imu("/imu", t, [0, 0, 0], [0, 0, 9.8])
            pen.pose("/vicon", t, [k, 0, 0], late=(7 if k % 3 else 30) * MS)
    flight = load_flight(f"rosbag:{path}", settings={"stamp": "both"})
    vicon = flight.streams["vicon"]
    assert sorted(vicon.stamp.tolist()) == [10**9 + k * 10 * MS for k in range(20)]
    late = np.where(vicon["position"][:, 0] % 3 == 0, 30, 7) * MS
    np.testing.assert_array_equal(vicon.time - vicon.stamp, np.maximum(late, vicon.time - vicon.stamp))
    assert (np.abs(vicon.time - vicon.stamp - late) < 100).all()
    assert (np.diff(vicon.time) > 0).all()
    assert any(n.startswith("info: vicon: arrived 0.01") for n in flight.notes)
    plain = load_flight(f"rosbag:{path}", settings={"bad_time": "sort"}).streams["vicon"]
    assert not plain.is_late
    assert (plain.time == np.sort(vicon.stamp)).all()
    moved: Any = {"vicon.time_offset": "0.02", "stamp": "both"}
    refused(path, "arrived before it was true", "vicon.time_offset", **moved)
