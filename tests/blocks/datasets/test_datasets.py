"""The dataset loaders: one shape, what is absent is counted, and what is wrong is named."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from flowgraph import Flight, Series, load_flight, write_tum
from flowgraph.blocks.datasets import broad, csv_file, ese650, tum
from flowgraph.blocks.datasets.matfile import read_mat
from flowgraph.blocks.signals import Attitude, Imu, Pose
from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from tests.recordings import recordings

MS = 1_000_000


def truth_of(flight: Flight) -> Series:
    assert flight.truth is not None
    return flight.truth


def fails(spec: str, *parts: str, kind: type = DataError, **settings: str) -> None:
    """The flight is refused, with all parts of the message; settings have _ for ."""
    with pytest.raises(kind) as caught:
        load_flight(spec, settings={name.replace("__", "."): value for name, value in settings.items()})
    for part in (*parts, "expected:", "got:", "fix:"):
        assert part in str(caught.value)


# -- BROAD ---------------------------------------------------------------------------------------------


def trial(file: Path, **changes: Any) -> str:
    """A trial of 8 samples at 200 Hz; None leaves a field out."""
    n = 8
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    q[3] = np.nan
    fields = {
        "imu_gyr": np.full((n, 3), 0.1),
        "imu_acc": np.tile([0.0, 0.0, 9.8], (n, 1)),
        "imu_mag": np.tile([0.0, 20.0, -40.0], (n, 1)),
        "opt_quat": q,
        "opt_pos": np.zeros((n, 3)),
        "movement": np.array([0, 0, 1, 1, 1, 1, 1, 0], dtype=np.uint8),
        "sampling_rate": 200.0,
    }
    savemat(file, {k: v for k, v in {**fields, **changes}.items() if v is not None}, do_compression=True)
    return f"broad:{file}"


def test_a_trial_of_broad_is_read_in_si_units_and_its_gaps_are_counted(tmp_path):
    flight = load_flight(trial(tmp_path / "t.mat"))
    assert flight.name == "t"
    assert flight.streams["imu"].time.tolist() == [5 * MS * k for k in range(8)]
    np.testing.assert_allclose(flight.streams["magnetometer"]["field"][0], [0.0, 20e-6, -40e-6])
    assert np.isnan(truth_of(flight)["attitude"]).all(axis=1).tolist() == [k == 3 for k in range(8)]
    assert flight.info["absent"] == {"truth": 1}
    assert "skipped: truth: 1 of 8 rows hold NaN, masked" in flight.notes
    assert flight.info["scored"]["value"].tolist() == [False, False, True, False, True, True, True, False]
    assert flight.info["imu_period_ns"] == 5 * MS


def test_a_sample_that_is_nan_is_absent_from_its_stream_alone(tmp_path):
    acc = np.tile([0.0, 0.0, 9.8], (8, 1))
    acc[2, 1] = np.nan
    flight = load_flight(trial(tmp_path / "t.mat", imu_acc=acc))
    assert len(flight.streams["imu"]) == 7
    assert 10 * MS not in flight.streams["imu"].time
    assert len(flight.streams["magnetometer"]) == 8
    assert flight.info["absent"] == {"imu": 1, "truth": 1}


def test_a_trial_can_be_shortened(tmp_path):
    flight = load_flight(trial(tmp_path / "t.mat"), settings={"duration": "0.02"})
    assert len(flight.streams["imu"]) == 5
    fails(trial(tmp_path / "t.mat"), "duration", kind=DeclarationError, duration="long")


@pytest.mark.parametrize(
    ("changes", "parts"),
    [
        ({"imu_mag": None}, ["field 'imu_mag' is missing", "imu_gyr"]),
        ({"imu_acc": np.zeros((8, 2))}, ["field 'imu_acc' is not what it should be", "n x 3", "8 x 2"]),
        ({"imu_acc": np.zeros((7, 3))}, ["another length", "7 rows"]),
        ({"imu_acc": np.tile([0.0, 0.0, 1.0], (8, 1))}, ["not in the unit", "m/s^2", "in g it is 1"]),
        ({"imu_mag": np.tile([0.0, 2e-5, -4e-5], (8, 1))}, ["not in the unit", "from 5e-06 to 0.0005"]),
        ({"imu_gyr": np.full((8, 3), 100.0)}, ["not in the unit", "rad/s"]),
        ({"imu_gyr": np.full((8, 3), np.inf)}, ["infinite", "row 1"]),
        ({"imu_gyr": np.full((8, 3), np.nan)}, ["holds nothing that was measured"]),
        ({"opt_quat": np.ones((8, 4))}, ["not a unit quaternion", "row 1"]),
        ({"sampling_rate": 0.0}, ["no rate"]),
        ({"imu_gyr": "text"}, ["field 'imu_gyr' is not what it should be"]),
    ],
)
def test_a_bad_trial_is_named(tmp_path, changes, parts):
    fails(trial(tmp_path / "t.mat", **changes), str(tmp_path / "t.mat"), *parts)


@pytest.mark.parametrize("kept", [0, 60, 128, 200, 400, -40])
def test_a_truncated_mat_file_is_named_and_nothing_of_it_is_returned(tmp_path, kept):
    file = tmp_path / "t.mat"
    trial(file)
    file.write_bytes(file.read_bytes()[:kept])
    with pytest.raises(DataError) as caught:
        broad.load(str(file))
    assert str(file) in str(caught.value)
    assert "whole .mat file" in str(caught.value) or "is missing" in str(caught.value)


def test_other_files_are_no_mat_files(tmp_path):
    file = tmp_path / "t.mat"
    file.write_text("hello " * 100)
    fails(f"broad:{file}", "no whole .mat file")
    file.write_bytes(b"MATLAB 7.3 MAT-file".ljust(124) + b"\x00\x02IM" + b"\x89HDF\r\n\x1a\n" * 20)
    fails(f"broad:{file}", "version 7.3", "-v7")
    fails(f"broad:{tmp_path}", "a folder")
    fails("broad:", "broad:FILE")
    fails(f"broad:{tmp_path / 'x.mat'}", "no such file")
    with pytest.raises(DataError, match=r"x\.mat is missing"):
        read_mat(tmp_path / "x.mat", {"a": ()})


def test_a_real_trial():
    file = recordings("broad") / "01_undisturbed_slow_rotation_A.mat"
    flight = load_flight(f"broad:{file}")
    assert len(flight.streams["imu"]) == 56940
    assert flight.info["absent"] == {"truth": 162}
    assert flight.info["imu_period_ns"] == 3_500_000
    strength = np.linalg.norm(flight.streams["magnetometer"]["field"], axis=1)
    assert 30e-6 < np.median(strength) < 60e-6


# -- ESE 650 -------------------------------------------------------------------------------------------


def course(folder: Path, n: int, seconds: float = 12.0, **changes: Any) -> np.ndarray:
    """A made set: a known calibration, motion about all axes; returns the attitudes. None leaves a field
    out."""
    rng = np.random.default_rng(n)
    fine = np.arange(0.0, seconds, 0.001)
    rate = np.stack([np.sin((0.7 + 0.3 * k + 0.1 * n) * fine + k) * 1.5 for k in range(3)], axis=1)
    turns = [Rotation.identity()]
    for w in rate[:-1]:
        turns.append(turns[-1] * Rotation.from_rotvec(w * 0.001))
    attitude = Rotation.concatenate(turns)
    force = attitude.inv().apply([0.0, 0.0, 9.81])
    ours = slice(3, None, 10)
    gyro = np.rint(370.0 + 2.0 * np.arange(3) + rate[ours] / 0.016)
    counts = np.rint(np.array([511.0, 500.0, 505.0]) + force[ours] / np.array([-0.092, -0.094, 0.093]))
    stamps = 100.0 + fine[ours] + rng.normal(size=len(gyro)) * 3e-4
    imu = {"vals": np.column_stack([counts, gyro[:, [2, 0, 1]]]).T.astype(np.uint16), "ts": stamps[None]}
    rots = attitude.as_matrix()[::10].transpose(1, 2, 0).copy()
    rots[:, :, 50:53] = np.nan
    vicon = {"rots": rots, "ts": 100.0 + fine[None, ::10] + 0.01}
    for file, fields in ((folder / f"imuRaw{n}.mat", imu), (folder / f"viconRot{n}.mat", vicon)):
        named = {k: changes.get(k, v) for k, v in fields.items()}
        savemat(file, {k: v for k, v in named.items() if v is not None})
    return np.asarray(attitude.as_quat()[::10][:, [3, 0, 1, 2]])


def test_a_set_is_calibrated_by_the_others(tmp_path):
    for n in (1, 2, 3):
        course(tmp_path, n)
    flight = load_flight(f"ese650:{tmp_path}:2")
    assert set(flight.streams) == {"counts", "imu"}
    assert flight.info["calibrated_by"] == (1, 3)
    assert flight.info["absent"] == {"truth": 3}
    found = flight.info["calibration"]
    np.testing.assert_allclose(np.diag(found.gyro), 0.016, rtol=0.01)
    np.testing.assert_allclose(found.gyro_zero, [370.0, 372.0, 374.0], atol=0.3)
    np.testing.assert_allclose(np.diag(found.force), [-0.092, -0.094, 0.093], rtol=0.01)
    imu = flight.streams["imu"]
    assert 9.5 < np.median(np.linalg.norm(imu["specific_force"], axis=1)) < 10.1


def test_the_calibration_does_not_see_the_set_itself(tmp_path):
    for n in (1, 2, 3):
        course(tmp_path, n)
    before = load_flight(f"ese650:{tmp_path}:2").info["calibration"]
    course(tmp_path, 2, seconds=9.0)
    assert load_flight(f"ese650:{tmp_path}:2").info["calibration"] == before
    by_one = load_flight(f"ese650:{tmp_path}:2", settings={"calibration": "1"})
    assert by_one.info["calibrated_by"] == (1,)
    assert by_one.info["calibration"] != before
    sheet = load_flight(f"ese650:{tmp_path}:2", settings={"calibration": "data_sheet"})
    assert sheet.info["calibration"] == ese650.DATA_SHEET


def test_a_set_that_is_not_whole_is_named(tmp_path):
    for n in (1, 2):
        course(tmp_path, n)
    spec = f"ese650:{tmp_path}:1"
    fails(f"ese650:{tmp_path}:3", "there is no set 3", "sets 1, 2")
    fails(f"ese650:{tmp_path}", "names no set")
    fails(spec, "names no sets", kind=DeclarationError, calibration="mine")
    fails(spec, "there is no set 9", calibration="9")
    course(tmp_path, 2, vals=None)
    fails(spec, "imuRaw2.mat", "field 'vals' is missing")
    (tmp_path / "imuRaw2.mat").unlink()
    fails(spec, "no other set to be calibrated with", "data_sheet")
    course(tmp_path, 2)
    course(tmp_path, 1, vals=np.full((6, 1200), 2000))
    fails(spec, "no counts of a 10-bit converter", "2000")
    course(tmp_path, 1, ts=np.zeros((1, 5)))
    fails(spec, "does not have one stamp a sample")
    course(tmp_path, 1, rots=np.ones((3, 3, 1200)))
    fails(spec, "viconRot1.mat", "a matrix is no rotation")


def test_stamps_of_a_set_that_are_out_of_order_follow_the_rule(tmp_path):
    for n in (1, 2):
        course(tmp_path, n)
    stamps = 100.0 + np.arange(1200) * 0.01
    stamps[[20, 21]] = stamps[[21, 20]]
    course(tmp_path, 1, ts=stamps[None])
    spec = f"ese650:{tmp_path}:1"
    fails(spec, "time does not increase", "row 22", "bad_time=sort")
    assert len(load_flight(spec, settings={"bad_time": "drop"}).streams["imu"]) == 1199
    assert len(load_flight(spec, settings={"bad_time": "sort"}).streams["imu"]) == 1200


def test_the_real_sets_agree_on_their_calibration():
    folder = recordings("ese650")
    found = [load_flight(f"ese650:{folder}:{n}").info["calibration"] for n in range(1, 7)]
    scales = np.array([np.diag(c.gyro) for c in found])
    assert (np.ptp(scales, axis=0) < 0.01 * scales.mean(axis=0)).all()
    zeros = np.array([c.gyro_zero for c in found])
    np.testing.assert_allclose(zeros, np.tile([373.6, 375.4, 369.7], (6, 1)), atol=0.2)  # what stands at rest
    scales = np.array([np.diag(c.force) for c in found])
    assert (np.ptp(scales, axis=0) < 0.01 * np.abs(scales.mean(axis=0))).all()
    zeros = np.array([c.force_zero for c in found])
    np.testing.assert_allclose(zeros, np.tile([511.7, 500.5, 502.3], (6, 1)), atol=0.3)
    assert load_flight(f"ese650:{folder}:6").info["absent"] == {"truth": 129}


# -- TUM -----------------------------------------------------------------------------------------------


def test_what_is_written_as_tum_is_read_back_to_the_bit(tmp_path):
    rng = np.random.default_rng(0)
    q = rng.normal(size=(4, 4))
    pose = Pose(position=rng.normal(size=(4, 3)), attitude=q / np.linalg.norm(q, axis=1, keepdims=True))
    series = Series(np.array([-MS, 0, 1403636579, 1403636580]), pose)
    write_tum(series, tmp_path / "t.tum")
    flight = load_flight(f"tum:{tmp_path / 't.tum'}")
    found = flight.streams["vicon"]
    assert found.time.tolist() == series.time.tolist()
    np.testing.assert_array_equal(found["position"], series["position"])
    np.testing.assert_allclose(found["attitude"], series["attitude"], atol=1e-16)
    truth = tum.load(str(tmp_path / "t.tum"), settings={"role": "truth", "time_offset": "1"})
    assert truth.notes[0] == "info: truth: stamps shifted by 1000000000 ns"
    assert not truth.streams
    assert truth_of(truth).time[1] == 1_000_000_000


def test_a_trajectory_with_gaps_is_masked_and_a_bad_one_named(tmp_path):
    file = tmp_path / "t.tum"
    file.write_text("0.0 1 2 3 0 0 0 1\n0.1 nan 2 3 0 0 0 1\n0.2 1 2 3 0 0 0 1\n")
    flight = load_flight(f"tum:{file}")
    assert len(flight.streams["vicon"]) == 2
    assert flight.info["absent"] == {"vicon": 1}
    file.write_text("0.0 1 2 3 0 0 0 1\n0.1 inf 2 3 0 0 0 1\n")
    fails(f"tum:{file}", "line 2", "column 2 is not a finite number")
    file.write_text("0.2 1 2 3 0 0 0 1\n0.1 1 2 3 0 0 0 1\n")
    fails(f"tum:{file}", "line 2", "time does not increase")
    fails(f"tum:{file}", "no role is called", kind=UnknownNameError, role="hope")
    with pytest.raises(UnknownNameError, match="no setting is called 'rate'"):
        tum.load(str(file), settings={"rate": 1})


# -- CSV -----------------------------------------------------------------------------------------------

TABLE = """stamp,note,wx,wy,wz,ax,ay,az,lat,lon,h
1000,a,180,0,0,0,0,1,,,
2000,b,180,0,0,0,0,1,45,90,7
3000,c,180,nan,0,0,0,1,,,
4000,d,180,0,0,0,0,1,46,90,8
"""
MAP = {
    "time": "stamp",
    "time.unit": "us",
    "imu.gyro": "wx,wy,wz",
    "imu.gyro.unit": "deg/s",
    "imu.specific_force": "ax, ay, az",
    "imu.specific_force.unit": "g",
    "gps.latitude": "lat",
    "gps.latitude.unit": "deg",
    "gps.longitude": "9",
    "gps.longitude.unit": "deg",
    "gps.height": "h",
    "gyro.noise": "1e-3",
}


def table(folder: Path, text: str = TABLE) -> str:
    (folder / "log.csv").write_text(text)
    return f"csv:{folder / 'log.csv'}"


def test_columns_are_mapped_to_streams_in_si_units(tmp_path):
    flight = load_flight(table(tmp_path), settings=MAP)
    imu, gps = flight.streams["imu"], flight.streams["gps"]
    assert imu.time.tolist() == [1 * MS, 2 * MS, 4 * MS]  # the one with a NaN is absent
    np.testing.assert_allclose(imu["gyro"][0], [np.pi, 0.0, 0.0])
    np.testing.assert_allclose(imu["specific_force"][0], [0.0, 0.0, 9.80665])
    assert gps.time.tolist() == [2 * MS, 4 * MS]
    np.testing.assert_allclose(gps["latitude"], np.radians([45.0, 46.0]))
    assert gps["height"].tolist() == [7.0, 8.0]
    assert flight.info["absent"] == {"imu": 1}
    assert flight.info["imu_noise"].gyro == 1e-3
    assert any("assumed: imu: noise of a typical unit: accelerometer.noise=" in note for note in flight.notes)


def test_a_table_without_names_has_numbers_and_quaternions_of_either_order(tmp_path):
    text = "# a comment\n0.5 0 0 0.6 0.8 1 2 3\n0.6 0 0 0.6 0.8 1 2 3\n"
    given = {
        "delimiter": "space",
        "truth.attitude": "1,2,3,4",
        "truth.attitude.order": "xyzw",
        "truth.position": "5,6,7",
    }
    flight = load_flight(table(tmp_path, text), settings=given)
    np.testing.assert_allclose(truth_of(flight)["attitude"][0], [0.8, 0.0, 0.0, 0.6])
    only = {k: v for k, v in given.items() if "position" not in k}
    alone = truth_of(load_flight(table(tmp_path, text), settings=only))
    assert isinstance(alone.values, Attitude)


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("2000,b,180", "2000,b,fast", ["line 3", "column 3 is not a finite number", "'fast'"]),
        ("2000,b,180", "2000,b,inf", ["line 3", "column 3 is not a finite number"]),
        ("2000,b", "soon,b", ["line 3", "the stamp is not a time", "time.unit"]),
        ("2000,b,180,0,0,0,0,1,45,90,7", "2000,b,180", ["line 3", "wrong number of columns"]),
        ("3000,c", "1500,c", ["line 4", "time does not increase"]),
        (TABLE.partition("\n")[2], "", ["no rows"]),
    ],
)
def test_a_bad_row_of_a_table_is_named(tmp_path, old, new, parts):
    spec = table(tmp_path, TABLE.replace(old, new))
    if "increase" in parts[-1]:
        spec = table(tmp_path, TABLE.replace("3000,c,180,nan", "1500,c,180,0"))
    with pytest.raises(DataError) as caught:
        load_flight(spec, settings=MAP)
    for part in (*parts, "log.csv"):
        assert part in str(caught.value)


@pytest.mark.parametrize(
    ("change", "kind", "parts"),
    [
        ({"imu.specific_force.unit": "m/s^2"}, DataError, ["not in the unit", "m/s^2", "median length of 1"]),
        ({"imu.gyro.unit": "rad/s"}, DataError, ["not in the unit", "rad/s"]),
        ({"imu.gyro.unit": "rpm"}, UnknownNameError, ["deg/s, rad/s"]),
        ({"time.unit": "ns", "time": "when"}, UnknownNameError, ["no column is called 'when'", "stamp"]),
        ({"imu.gyro": "wx,wy"}, DeclarationError, ["has not so many columns", "3 columns"]),
        ({"imu.mass": "wx"}, UnknownNameError, ["no setting is called 'imu.mass'"]),
        ({"gyro.noise": "loud"}, DeclarationError, ["'gyro.noise' is not usable"]),
        ({"delimiter": "dash"}, UnknownNameError, ["comma"]),
        ({"bad_time": "hope"}, UnknownNameError, ["drop, raise, sort"]),
    ],
)
def test_a_wrong_mapping_is_refused(tmp_path, change, kind, parts):
    with pytest.raises(kind) as caught:
        load_flight(table(tmp_path), settings={**MAP, **change})
    for part in parts:
        assert part in str(caught.value)


def test_a_mapping_must_be_whole(tmp_path):
    with pytest.raises(DeclarationError, match=r"no column is mapped to a stream(.|\n)*first line .*stamp"):
        load_flight(table(tmp_path))
    with pytest.raises(DeclarationError, match="imu lacks a field"):
        csv_file.load(table(tmp_path)[4:], settings={"imu.gyro": "wx,wy,wz"})
    with pytest.raises(DataError, match="this is no table"):
        load_flight(f"csv:{tmp_path / 'none.csv'}", settings=MAP)


# -- all of them ---------------------------------------------------------------------------------------


def test_a_library_of_a_format_is_imported_when_it_is_needed():
    program = (
        "import sys; import flowgraph.blocks.datasets; from flowgraph.data.registry import flight_names;"
        "flight_names(); assert not {'rosbags', 'scipy.io'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", program], check=True)


def test_euroc_leaves_out_what_was_not_measured(tmp_path):
    from tests.blocks.datasets.test_euroc import IMU, SENSOR, START, TUM

    (tmp_path / "imu0").mkdir()
    (tmp_path / "imu0" / "sensor.yaml").write_text(SENSOR)
    (tmp_path / "imu0" / "data.csv").write_text(f"{IMU}\n{START + 25 * MS},nan,0,0,0,0,9.81\n")
    (tmp_path / "groundtruth.tum").write_text(TUM + "1403636579.77 nan nan nan nan nan nan nan\n")
    flight = load_flight(f"euroc:{tmp_path}")
    assert len(flight.streams["imu"]) == 5
    assert isinstance(flight.streams["imu"].values, Imu)
    assert len(truth_of(flight)) == 2
    assert flight.info["absent"] == {"imu": 1, "truth": 1}
    assert "skipped: imu: 1 of 6 rows hold NaN, left out as absent" in flight.notes
