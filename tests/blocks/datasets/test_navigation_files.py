"""Logs of ArduPilot, folders of KF-GINS, data of NaveGo: what a test writes is read back to the bit, and what
is wrong is named."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from flowgraph import DataError, load_flight, simulate
from flowgraph.blocks.datasets.turns import from_angles, from_ned_attitude
from flowgraph.blocks.geometry.rotations import rotate, to_matrix
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.graphs.gnss_ins import gnss_ins
from tests.blocks.datasets.test_satellites import S, deviations, inspected, refused

WEEK = 315_964_800 * S + 2316 * 604_800 * S


def test_attitudes_of_aircraft_are_turned():
    """Heading east, level: forward is x, left is y. Nose up by 0.1 rad: forward climbs."""
    q = from_ned_attitude(
        from_angles(np.array([[0.0, 0.0, np.pi / 2], [0.0, 0.1, 0.0], [np.nan] * 3]), "zyx")
    )
    np.testing.assert_allclose(rotate(q[0], np.array([1.0, 0.0, 0.0]), xp=np), [1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(rotate(q[0], np.array([0.0, 1.0, 0.0]), xp=np), [0, 1, 0], atol=1e-12)
    ahead = rotate(q[1], np.array([1.0, 0.0, 0.0]), xp=np)
    np.testing.assert_allclose(ahead, [0.0, np.cos(0.1), np.sin(0.1)], atol=1e-12)
    assert np.isnan(q[2]).all()


# -- ArduPilot -----------------------------------------------------------------------------------------

KINDS = {
    "IMU": (129, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ", "<QBffffff"),
    "GPS": (130, "QBBIHBcLLeffffB", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw,U",
            "<QBBIHBhiiiffffB"),
    "GPA": (131, "QBCCCC", "TimeUS,I,VDop,HAcc,VAcc,SAcc", "<QBHHHH"),
    "MAG": (132, "QBhhh", "TimeUS,I,MagX,MagY,MagZ", "<QBhhh"),
    "BARO": (133, "QBff", "TimeUS,I,Alt,Press", "<QBff"),
    "ATT": (134, "QccC", "TimeUS,Roll,Pitch,Yaw", "<QhhH"),
    "MSG": (135, "QZ", "TimeUS,Message", "<Q64s"),
}  # fmt: skip


def described(name: str, codes: str | None = None) -> bytes:
    number, own, fields, form = KINDS[name]
    size = struct.calcsize(form) + 3
    text = name.encode().ljust(4, b"\0") + (codes or own).encode().ljust(16, b"\0")
    return b"\xa3\x95\x80" + bytes([number, size]) + text + fields.encode().ljust(64, b"\0")


def said(name: str, *values: Any) -> bytes:
    number, _, _, form = KINDS[name]
    return b"\xa3\x95" + bytes([number]) + struct.pack(form, *values)


def flown(*, scale: float = 1.0, accurate: bool = True, without: str = "", units: int = 2) -> bytes:
    """2 s: two units and a receiver that has its fix from the second epoch on."""
    made = b"".join(described(name) for name in KINDS)
    made += said("MSG", 0, b"ArduCopter")
    for k in range(100):
        t = 1_000_000 + 20_000 * k
        for unit in range(units if without != "IMU" else 0):
            force = (0.5 * scale, 0.25 * scale, -9.75 * scale)
            made += said("IMU", t, unit, 0.5 + unit, 0.25, -0.125, *force)
        made += said("ATT", t, 1000, 0, 9000)
        if k % 20 == 0:
            made += said(
                "GPS",
                t,
                0,
                3 if k else 1,
                0,
                2316,
                9,
                80,
                473977000 + k,
                85455999,
                48801 + k,
                5.0,
                90.0,
                -0.5,
                0,
                1,
            )
            made += said("GPA", t, 0, 120, 50 + k, 75, 20) if accurate else b""
            made += said("MAG", t, 0, 200, 30, 400)
            made += said("BARO", t, 0, 12.5 + k, 95000.0)
    return made  # fmt: skip


def log(file: Path, content: bytes) -> str:
    file.write_bytes(content)
    return f"ardupilot:{file}"


def test_a_log_of_ardupilot_is_read(tmp_path):
    spec = log(tmp_path / "a.bin", flown())
    flight = load_flight(spec)
    imu, gps, speed = (flight.streams[n] for n in ("imu", "gps", "gps_velocity"))
    np.testing.assert_array_equal(imu.time, (1_000_000 + 20_000 * np.arange(100)) * 1000)
    np.testing.assert_array_equal(imu["gyro"], np.tile([0.5, -0.25, 0.125], (100, 1)))
    np.testing.assert_array_equal(imu["specific_force"], np.tile([0.5, -0.25, 9.75], (100, 1)))
    k = np.array([20, 40, 60, 80])
    np.testing.assert_array_equal(gps["latitude"], np.radians((473977000 + k) * 1e-7))
    np.testing.assert_array_equal(gps["height"], (48801 + k) * 0.01)
    np.testing.assert_allclose(
        deviations(gps), np.stack([0.5 + k / 100, 0.5 + k / 100, 0.75 + 0 * k], 1), rtol=1e-12
    )
    np.testing.assert_allclose(speed["velocity"], np.tile([5.0, 0.0, 0.5], (4, 1)), atol=1e-12)
    np.testing.assert_allclose(deviations(speed), 0.2)
    field = flight.streams["magnetometer"]["field"]
    np.testing.assert_array_equal(field, np.tile(np.array([200.0, -30.0, -400.0]) * 1e-7, (5, 1)))
    np.testing.assert_array_equal(flight.streams["barometer"]["height"], 12.5 + 20.0 * np.arange(5))
    assert flight.truth is None
    for part in ("1 of 5 fixes", "IMU: the units 1"):
        assert any(part in n for n in flight.notes), part
    told = inspected(spec)
    assert set(told) == {"imu", "gps", "gps_velocity", "magnetometer", "barometer"}
    assert told["imu"]["rate_hz"] == 50.0
    case = gnss_ins.case(flight)
    assert np.isfinite(simulate(case.graph, case.inputs)["belief"]["position"]).all()


def test_another_unit_is_chosen_and_the_autopilots_attitude_is_the_truth_only_where_it_is_asked_for(tmp_path):
    spec = log(tmp_path / "a.bin", flown())
    flight = load_flight(spec, settings={"truth": "attitude"})
    assert flight.truth is not None
    up = rotate(flight.truth["attitude"][0], np.array([0.0, 0.0, 1.0]), xp=np)
    np.testing.assert_allclose(up, [0.0, -np.sin(np.radians(10.0)), np.cos(np.radians(10.0))], atol=1e-12)
    assert any("what the autopilot estimated" in n for n in flight.notes)
    other = load_flight(spec, settings={"imu.instance": "1"})
    np.testing.assert_array_equal(other.streams["imu"]["gyro"], np.tile([1.5, -0.25, 0.125], (100, 1)))
    assert len(other.streams["gps"]) == 4  # of the receiver there is one only
    with pytest.raises(DataError, match="no such unit"):
        load_flight(spec, settings={"imu.instance": "2"})
    with pytest.raises(UnknownNameError, match="units"):
        load_flight(spec, settings={"units": "1"})


def test_a_log_without_accuracies_says_so(tmp_path):
    flight = load_flight(log(tmp_path / "a.bin", flown(accurate=False)))
    assert not flight.streams["gps"]["covariance"].any()
    assert any("does not say how good fixes are" in n for n in flight.notes)


def test_logs_that_end_within_a_message_or_hold_a_bad_patch_are_read_and_it_is_said(tmp_path):
    whole = flown()
    flight = load_flight(log(tmp_path / "cut.bin", whole[:-5]))
    assert any("which the end cuts off" in n for n in flight.notes)
    at = whole.index(said("ATT", 1_400_000, 1000, 0, 9000))
    patched = load_flight(log(tmp_path / "patch.bin", whole[:at] + b"\x00\xa3\x95\x07\xff" * 4 + whole[at:]))
    assert any("20 bytes that are of no message" in n for n in patched.notes)
    np.testing.assert_array_equal(
        patched.streams["imu"].time, load_flight(log(tmp_path / "w.bin", whole)).streams["imu"].time
    )


def test_what_is_no_log_of_ardupilot_is_refused(tmp_path):
    refused(log(tmp_path / "none.bin", b"ULog\x01" + bytes(50)), "no log of ArduPilot", "55 4c 6f 67")
    refused(log(tmp_path / "empty.bin", b""), "no log of ArduPilot", "an empty file")
    refused(log(tmp_path / "bad.bin", flown() + bytes(9000)), "much of it is no message")
    wrong = flown().replace(described("IMU"), described("IMU", "QBfffff"))
    refused(log(tmp_path / "codes.bin", wrong), "does not fit its size", "IMU")
    refused(log(tmp_path / "imu.bin", flown(without="IMU")), "no inertial unit", "GPS")
    refused(log(tmp_path / "g.bin", flown(scale=1 / 9.81)), "not in the unit")
    lacks = flown().replace(b"AccX", b"AcqX")
    refused(log(tmp_path / "lacks.bin", lacks), "lacks a field", "AcqX")
    refused(f"ardupilot:{tmp_path / 'no.bin'}", "no such file")


# -- KF-GINS -------------------------------------------------------------------------------------------


def folder(path: Path, *, scale: float = 1.0, moving: bool = True, solved: bool = True) -> str:
    """1 s of a unit at 100 Hz: level, heading east, turning left at 0.5 rad/s."""
    path.mkdir()
    row = lambda *x: " ".join(repr(float(v)) for v in x)
    unit = [row(357473 + 0.01 * k, 0, 0, -0.005, 0.0025, 0, -0.0975 * scale) for k in range(101)]
    (path / "ADIS16465.txt").write_text("\n".join(unit) + "\n")
    fast = (1.5, -2.5, 0.25, 0.1, 0.2, 0.3) if moving else ()
    fixes = [row(357473 + 0.5 * k, 30.5 + 1e-5 * k, 114.25, 20.5, 0.01, 0.02, 0.03, *fast) for k in range(3)]
    (path / "GNSS_RTK.txt").write_text("\n".join(fixes) + "\n")
    nav = [row(2316, 357473 + 0.1 * k, 30.5, 114.25, 20.5 + k, 0, 0, 0, 0, 0, 90) for k in range(11)]
    if solved:
        (path / "truth.nav").write_text("\n".join(nav) + "\n")
    (path / "README.txt").write_text("notes\n")
    return f"gins:{path}"


def test_a_folder_of_kf_gins_is_read(tmp_path):
    spec = folder(tmp_path / "car")
    flight = load_flight(spec, settings={"gps.lever": "0.1,0.2,0.3"})
    imu, gps, speed = (flight.streams[n] for n in ("imu", "gps", "gps_velocity"))
    assert imu.time[0] == WEEK + 357473 * S
    np.testing.assert_allclose(imu["gyro"], np.tile([0.0, 0.0, 0.5], (101, 1)), rtol=1e-12)
    np.testing.assert_allclose(imu["specific_force"][5], [0.25, 0.0, 9.75], rtol=1e-12)
    np.testing.assert_array_equal(gps["latitude"], np.radians([30.5, 30.5 + 1e-5, 30.5 + 2e-5]))
    np.testing.assert_allclose(deviations(gps)[0], [0.02, 0.01, 0.03], rtol=1e-15)
    np.testing.assert_array_equal(speed["velocity"][0], [-2.5, 1.5, -0.25])
    np.testing.assert_allclose(deviations(speed)[0], [0.2, 0.1, 0.3], rtol=1e-15)
    assert flight.info["gps_lever"] == (0.1, 0.2, 0.3)
    assert flight.truth is not None
    np.testing.assert_allclose(flight.truth["position"][:, 2], np.arange(11.0), atol=1e-6)
    np.testing.assert_allclose(np.abs(flight.truth["attitude"]), np.tile([1.0, 0, 0, 0], (11, 1)), atol=1e-12)
    assert inspected(spec)["imu"]["rate_hz"] == pytest.approx(100.0)


def test_what_a_folder_of_kf_gins_lacks_is_said(tmp_path):
    flight = load_flight(folder(tmp_path / "a", moving=False, solved=False))
    assert set(flight.streams) == {"imu", "gps"}
    assert flight.truth is None
    assert flight.streams["imu"].time[0] == 357473 * S
    for part in ("an unknown week", "gps.lever"):
        assert any(part in n for n in flight.notes), part


def test_broken_folders_of_kf_gins_are_refused(tmp_path):
    refused(folder(tmp_path / "g", scale=0.005), "not in the unit")
    refused(folder(tmp_path / "rates", scale=100.0), "not in the unit")  # no increments
    spec = folder(tmp_path / "two")
    (tmp_path / "two" / "ADIS2.txt").write_bytes((tmp_path / "two" / "ADIS16465.txt").read_bytes())
    refused(spec, "more than one file of a unit", "ADIS2.txt", "gins:DIR:IMU")
    assert "imu" in load_flight(f"{spec}:ADIS2").streams
    spec = folder(tmp_path / "word")
    text = (tmp_path / "word" / "ADIS16465.txt").read_text()
    (tmp_path / "word" / "ADIS16465.txt").write_text(text.replace("357473.05", "abc"))
    refused(spec, "ADIS16465.txt, line 6")
    spec = folder(tmp_path / "wide")
    (tmp_path / "wide" / "GNSS_RTK.txt").write_text("1 2 3 4 5 6 7 8\n2 2 3 4 5 6 7 8\n")
    refused(spec, "another width", "7 or 13")
    refused(f"gins:{tmp_path}", "no folder of KF-GINS")


# -- NaveGo --------------------------------------------------------------------------------------------


def structs(*, scale: float = 1.0) -> dict[str, Any]:
    t, slow = 0.01 * np.arange(101), 0.25 * np.arange(5)
    unit = {
        "t": t[:, None],
        "wb": np.tile([0.1, 0.2, 0.3], (101, 1)),
        "fb": np.tile([0.5, 0.25, -9.75], (101, 1)) * scale,
        "arw": np.full(3, 1e-4),
        "vrw": np.full(3, 2e-3),
    }
    place = {
        "lat": 0.8 + 1e-8 * np.arange(5)[:, None],
        "lon": np.full((5, 1), 0.15),
        "h": np.full((5, 1), 430.5),
    }
    gnss = {
        "t": slow[:, None],
        **place,
        "vel": np.tile([1.5, -2.5, 0.25], (5, 1)),
        "stdm": np.array([1.0, 2.0, 3.0]),
        "stdv": np.array([0.1, 0.2, 0.3]),
        "larm": np.array([0.5, 0.25, -0.75])[:, None],
    }
    turn = {
        n: np.full((5, 1), x) for n, x in zip(("roll", "pitch", "yaw"), (0.0, 0.0, np.pi / 2), strict=True)
    }
    return {"imu1": unit, "gnss": gnss, "ref": {"t": slow[:, None], **place, **turn}}


@pytest.mark.parametrize("split", [False, True])
def test_data_of_navego_are_read_from_a_file_or_a_folder(tmp_path, split):
    path = tmp_path / ("d" if split else "d.mat")
    if split:
        path.mkdir()
        for name, value in structs().items():
            savemat(path / f"{name}.mat", {name: value})
    else:
        savemat(path, structs())
    flight = load_flight(f"navego:{path}")
    imu, gps, speed = (flight.streams[n] for n in ("imu", "gps", "gps_velocity"))
    np.testing.assert_array_equal(imu["gyro"], np.tile([0.1, -0.2, -0.3], (101, 1)))
    np.testing.assert_array_equal(imu["specific_force"], np.tile([0.5, -0.25, 9.75], (101, 1)))
    np.testing.assert_array_equal(gps["latitude"], 0.8 + 1e-8 * np.arange(5))
    np.testing.assert_array_equal(gps["longitude"], 0.15)
    np.testing.assert_allclose(deviations(gps), np.tile([2.0, 1.0, 3.0], (5, 1)), rtol=1e-15)
    np.testing.assert_array_equal(speed["velocity"][0], [-2.5, 1.5, -0.25])
    assert flight.info["gps_lever"] == (0.5, -0.25, 0.75)
    assert (flight.info["imu_noise"].gyro, flight.info["imu_noise"].accelerometer) == (1e-4, 2e-3)
    assert flight.truth is not None
    np.testing.assert_allclose(np.abs(flight.truth["attitude"]), np.tile([1.0, 0, 0, 0], (5, 1)), atol=1e-12)
    north = flight.truth["position"][:, 1]
    np.testing.assert_allclose(north, 0.0637 * np.arange(5), rtol=2e-3, atol=1e-6)
    assert inspected(f"navego:{path}")["gps"]["count"] == 5


def test_what_is_no_data_of_navego_is_refused(tmp_path):
    file = tmp_path / "a.mat"
    spec = f"navego:{file}"
    savemat(file, {"x": 1.0})
    refused(spec, "no data of NaveGo")
    savemat(file, structs(scale=1 / 9.81))
    refused(spec, "not in the unit")
    two = structs()
    savemat(file, {**two, "imu2": two["imu1"]})
    refused(spec, "no one unit", "imu1, imu2", "navego:PATH:IMU")
    assert "imu" in load_flight(f"{spec}:imu2").streams
    refused(f"{spec}:imu3", "no one unit")
    bad = structs()
    bad["imu1"]["wb"] = np.zeros((101, 2))
    savemat(file, bad)
    refused(spec, "another shape", "'wb'")
    file.write_bytes(file.read_bytes()[:300])
    refused(spec, "no whole .mat file")


# -- tables --------------------------------------------------------------------------------------------


def test_a_table_has_velocities_heights_and_wheels_in_units_of_its_own(tmp_path):
    file = tmp_path / "log.csv"
    rows = ["t,wx,wy,wz,ax,ay,az,vn [km/h],ve [km/h],vd [km/h],baro [ft],wheel,mx,my,mz"]
    rows += [f"{0.02 * k:.2f},0,0,0.1,0,0,9.8,36,18,-3.6,100,250,0.2,0,-0.4" for k in range(50)]
    file.write_text("\n".join(rows) + "\n")
    names = {
        "imu.gyro": "wx,wy,wz", "imu.specific_force": "ax,ay,az", "gps_velocity.velocity": "vn,ve,vd",
        "gps_velocity.axes": "ned", "barometer.height": "baro", "wheels.speed": "wheel",
        "wheels.speed.unit": "cm/s", "magnetometer.field": "mx,my,mz", "magnetometer.field.unit": "G",
    }  # fmt: skip
    flight = load_flight(f"csv:{file}", settings=names)
    np.testing.assert_allclose(flight.streams["gps_velocity"]["velocity"][0], [5.0, 10.0, 1.0], rtol=1e-15)
    assert flight.streams["barometer"]["height"][0] == 100 * 0.3048
    assert flight.streams["wheels"]["speed"][0] == 2.5
    np.testing.assert_allclose(flight.streams["magnetometer"]["field"][0], [2e-5, 0.0, -4e-5])
    assert set(gnss_ins.case(flight).recorded) == {
        "imu",
        "gnss_velocity",
        "barometer",
        "wheels",
        "magnetometer",
    }
    with pytest.raises(UnknownNameError, match="gps_velocity.axes"):
        load_flight(f"csv:{file}", settings={**names, "gps_velocity.axes": "nwu"})
    with pytest.raises(DataError, match="cannot be those of wheels.speed"):
        load_flight(f"csv:{file}", settings={**names, "wheels.speed": "baro"})


def a_table(file, head, row, count=50):
    """A table with a unit at rest and more columns."""
    rows = [f"t,wx,wy,wz,ax,ay,az,{head}"]
    rows += [f"{0.02 * k:.2f},0,0,0.1,0,0,9.8,{row}" for k in range(count)]
    file.write_text("\n".join(rows) + "\n")
    return {"imu.gyro": "wx,wy,wz", "imu.specific_force": "ax,ay,az"}


@pytest.mark.parametrize(
    ("pressure", "unit", "height"),
    [  # of the tables of ISO 2533
        (101325.0, "Pa", 0.0),
        (898.746, "hPa", 1000.0),
        (54.0199, "kPa", 5000.0),
        (264.363, "mbar", 10000.0),
        (1.07478, "bar", -500.0),
    ],
)
def test_a_pressure_is_a_height_of_the_standard_atmosphere(tmp_path, pressure, unit, height):
    file = tmp_path / "log.csv"
    names = {**a_table(file, "p", pressure), "barometer.pressure": "p"}
    flight = load_flight(f"csv:{file}", settings={**names, "barometer.pressure.unit": unit})
    assert set(flight.streams["barometer"].leaves) == {"height"}
    np.testing.assert_allclose(flight.streams["barometer"]["height"], height, atol=1.2)
    assert "barometer" in gnss_ins.case(flight).recorded


def test_a_pressure_in_another_unit_is_refused(tmp_path):
    file = tmp_path / "log.csv"
    names = {**a_table(file, "p,h,b [hPa]", "1013.25,3,1000"), "barometer.pressure": "p"}
    with pytest.raises(DataError, match=r"line 2, column p[\s\S]*no pressure of the air[\s\S]*unit=hPa"):
        load_flight(f"csv:{file}", settings=names)
    with pytest.raises(DeclarationError, match="barometer has its height twice"):
        load_flight(f"csv:{file}", settings={**names, "barometer.height": "h"})
    told = load_flight(f"csv:{file}", settings={**names, "barometer.pressure": "b"})
    assert any("barometer.pressure.unit: hPa, as line 1" in n for n in told.notes)
    np.testing.assert_allclose(told.streams["barometer"]["height"], 110.9, atol=0.1)
    less = {k: v for k, v in names.items() if k != "barometer.pressure"}
    with pytest.raises(DataError, match="cannot be those of barometer.height"):
        load_flight(f"csv:{file}", settings={**less, "barometer.height": "b"})


def test_two_antennas_tell_a_heading_in_a_table(tmp_path):
    """As a compass has it or as the world does; with a deviation of each, of all, or one that is assumed."""
    file = tmp_path / "log.csv"
    names = {**a_table(file, "yaw,sd", "30,0.5"), "heading.angle": "yaw", "heading.angle.unit": "deg"}
    read = lambda **more: load_flight(
        f"csv:{file}", settings={**names, **{k.replace("__", "."): v for k, v in more.items()}}
    )
    plain = read()
    np.testing.assert_allclose(plain.streams["heading"]["angle"], np.radians(30.0))
    np.testing.assert_allclose(plain.streams["heading"]["deviation"], 0.02)
    assert any("heading: its deviation is 0.02 rad" in n for n in plain.notes)
    compass = read(heading__axes="ned", heading__noise="0.01")
    np.testing.assert_allclose(compass.streams["heading"]["angle"], np.radians(60.0))
    np.testing.assert_allclose(compass.streams["heading"]["deviation"], 0.01)
    assert not any("heading:" in n for n in compass.notes)
    across = gnss_ins.case(read(heading__axes="ned", heading__baseline="0,1,0"))  # the second one to the left
    R = to_matrix(simulate(across.graph, across.inputs)["belief"]["attitude"][-1], xp=np)
    # the body has turned by 0.1 rad/s for a second, and its antennas say that it stands
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(np.radians(-30.0), abs=0.02)
    with pytest.raises(DeclarationError, match=r"heading\.baseline"):
        read(heading__baseline="0,1")
    each = read(heading__deviation="sd", heading__deviation__unit="deg")
    np.testing.assert_allclose(each.streams["heading"]["deviation"], np.radians(0.5))
    assert "heading" in gnss_ins.case(each).recorded
    alone = {k: v for k, v in names.items() if not k.startswith("heading")}
    case = gnss_ins.case(compass)
    assert any(
        n.startswith("info: the heading at the start is that of two antennas: known to") for n in case.notes
    )
    R = to_matrix(simulate(case.graph, case.inputs)["belief"]["attitude"][0], xp=np)
    assert np.arctan2(R[1, 0], R[0, 0]) == pytest.approx(np.radians(60.0), abs=0.01)
    with pytest.raises(DeclarationError, match=r"heading lacks a field[\s\S]*heading.angle"):
        load_flight(f"csv:{file}", settings={**alone, "heading.deviation": "sd"})
    with pytest.raises(UnknownNameError, match="heading.axes"):
        read(heading__axes="nwu")
    with pytest.raises(DeclarationError, match=r"heading\.noise"):
        read(heading__noise="0")


def test_a_slow_stream_of_a_table_with_a_fast_one_is_no_index_of_rows(tmp_path):
    """Positions at whole seconds, in a table whose other rows tell its clock; alone they are doubtful."""
    file = tmp_path / "log.csv"
    rows = [f"{0.5 * k},0,0,0.1,0,0,9.8," + ("1,2,3" if k % 2 == 0 else ",,") for k in range(40)]
    file.write_text("\n".join(["t,wx,wy,wz,ax,ay,az,x,y,z", *rows]) + "\n")
    place = {"leica.position": "x,y,z"}
    names = {**place, "imu.gyro": "wx,wy,wz", "imu.specific_force": "ax,ay,az"}
    doubted = lambda flight: any("as an index of rows is" in n for n in flight.notes)
    assert not doubted(load_flight(f"csv:{file}", settings=names))
    assert doubted(load_flight(f"csv:{file}", settings=place))
