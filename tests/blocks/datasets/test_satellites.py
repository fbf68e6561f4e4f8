"""Files of satellites and autopilots: what a test writes is read back to the bit, and what is wrong is
named."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import Series, load_flight
from flowgraph.cli import app
from flowgraph.errors import DataError, UnknownNameError

S = 10**9
DAY = 1_717_113_600 * S  # 2024-05-31


def refused(spec: str, *parts: str, kind: type = DataError) -> None:
    with pytest.raises(kind) as caught:
        load_flight(spec)
    for part in (*parts, "expected:", "got:", "fix:"):
        assert part in str(caught.value)


def inspected(spec: str, *options: str) -> dict[str, Any]:
    """What `flowgraph inspect` says of it, by stream."""
    done = CliRunner().invoke(app, ["inspect", spec, *options, "--json"])
    assert done.exit_code == 0, done.stderr
    return {row["name"]: row for row in json.loads(done.stdout)["streams"]}


def deviations(gps: Series) -> np.ndarray:
    return np.sqrt(np.einsum("nii->ni", gps["covariance"]))


# -- NMEA ----------------------------------------------------------------------------------------------


def sentence(text: str) -> str:
    check = 0
    for letter in text:
        check ^= ord(letter)
    return f"${text}*{check:02X}"


def receiver(file: Path, *, dated: bool = True) -> str:
    pytest.importorskip("pynmea2")
    lines = []
    for k, quality in enumerate((4, 5, 0, 1)):
        clock = f"23595{8 + k}.00" if k < 2 else f"00000{k - 2}.00"
        date = "310524" if k < 2 else "010624"
        if dated:
            lines.append(sentence(f"GNRMC,{clock},A,4723.8600,N,00832.7400,E,10.0,90.0,{date},,,A"))
        lines.append(
            sentence(f"GNGGA,{clock},4723.8600,N,00832.7400,E,{quality},12,0.8,{440 + k}.5,M,48.25,M,,")
        )
    lines.append("$GNGGA,235959.00,4723.8600,N,00832.7400,E,4,12,0.8,440.5,M,48.25,M,,*00")
    file.write_text("\r\n".join(lines) + "\r\n")
    return f"nmea:{file}"


def test_sentences_of_nmea_give_positions_velocities_and_their_worth(tmp_path):
    flight = load_flight(receiver(tmp_path / "log.nmea"))
    gps, speed = flight.streams["gps"], flight.streams["gps_velocity"]
    np.testing.assert_array_equal(gps.time, DAY + np.array([86398, 86399, 86401]) * S)
    assert gps["latitude"][0] == np.radians(47 + 23.86 / 60)
    assert gps["longitude"][0] == np.radians(8 + 32.74 / 60)
    np.testing.assert_array_equal(gps["height"], [488.75, 489.75, 491.75])
    np.testing.assert_allclose(deviations(gps), [[d, d, 2 * d] for d in (0.02, 0.3, 2.5)], rtol=1e-15)
    np.testing.assert_allclose(speed["velocity"][:, :2], np.tile([10 * 1852 / 3600, 0.0], (4, 1)), atol=1e-12)
    assert np.isnan(speed["velocity"][:, 2]).all()
    assert any("1 sentences that are broken" in n for n in flight.notes)
    assert any("1 positions without a fix" in n for n in flight.notes)
    assert inspected(f"nmea:{tmp_path / 'log.nmea'}")["gps"]["count"] == 3


def test_without_a_date_the_day_is_said_to_be_unknown(tmp_path):
    spec = receiver(tmp_path / "log.nmea", dated=False)
    with pytest.raises(DataError):  # midnight passes, and no day tells it
        load_flight(spec)
    text = (tmp_path / "log.nmea").read_text().splitlines()
    (tmp_path / "log.nmea").write_text("\n".join(text[:2]) + "\n")
    flight = load_flight(spec)
    assert flight.streams["gps"].time[0] == 86398 * S
    assert any("unknown day" in n for n in flight.notes)


def test_a_file_without_a_fix_is_no_file_of_positions(tmp_path):
    pytest.importorskip("pynmea2")
    (tmp_path / "log.nmea").write_text(sentence("GNGGA,120000.00,,,,,0,00,99.9,,M,,M,,") + "\n")
    refused(f"nmea:{tmp_path / 'log.nmea'}", "has no position", "1 without")


# -- RTKLIB --------------------------------------------------------------------------------------------

HEAD = (
    "%  GPST   latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    "  sdne(m)  sdeu(m)  sdun(m) age(s)  ratio"
)
FAST = "    vn(m/s)    ve(m/s)    vu(m/s)      sdvn     sdve     sdvu    sdvne    sdveu    sdvun"


def solution(file: Path, *, week: bool = False, moving: bool = True, head: str = HEAD) -> str:
    lines = ["% program   : RTKLIB", head + (FAST if moving else "")]
    for k in range(3):
        clock = f"2316 {475200 + k}.250" if week else f"2024/05/31 12:00:0{k}.250"
        row = f"{clock}  47.3977000{k}  8.545599900 488.017{k} 1 9 0.01 0.02 0.03 -0.005 0.004 0.003 0.0 3.0"
        lines.append(row + (" 1.5 -2.5 0.25 0.1 0.2 0.3 0 0 0" if moving else ""))
    file.write_text("\n".join(lines) + "\n")
    return f"rtklib:{file}"


@pytest.mark.parametrize("week", [False, True])
def test_a_solution_of_rtklib_is_read_with_its_covariance(tmp_path, week):
    flight = load_flight(solution(tmp_path / "a.pos", week=week))
    gps, speed = flight.streams["gps"], flight.streams["gps_velocity"]
    np.testing.assert_array_equal(gps.time, DAY + (43200 + np.arange(3)) * S + S // 4)
    np.testing.assert_array_equal(gps["latitude"], np.radians([47.39770000, 47.39770001, 47.39770002]))
    np.testing.assert_array_equal(gps["height"], [488.0170, 488.0171, 488.0172])
    P = [[0.02**2, -(0.005**2), 0.004**2], [-(0.005**2), 0.01**2, 0.003**2], [0.004**2, 0.003**2, 0.03**2]]
    np.testing.assert_allclose(gps["covariance"][0], P, rtol=1e-15)
    np.testing.assert_array_equal(speed["velocity"][0], [-2.5, 1.5, 0.25])
    np.testing.assert_allclose(np.sqrt(np.diagonal(speed["covariance"][0])), [0.2, 0.1, 0.3])
    assert any("GPST" in n for n in flight.notes)
    fields = inspected(f"rtklib:{tmp_path / 'a.pos'}")["gps"]["fields"]
    assert {field["unit"] for field in fields} == {"rad", "m", "m^2"}


def test_solutions_in_other_coordinates_and_broken_rows_are_refused(tmp_path):
    other = HEAD.replace("latitude(deg) longitude(deg)  height(m)", "x-ecef(m) y-ecef(m) z-ecef(m)")
    refused(solution(tmp_path / "a.pos", head=other), "not in latitude and longitude", "x-ecef")
    spec = solution(tmp_path / "b.pos")
    text = (tmp_path / "b.pos").read_text().replace("488.0171", "about488")
    (tmp_path / "b.pos").write_text(text)
    refused(spec, "b.pos, line 4", "no row of a solution")
    assert "gps_velocity" not in load_flight(solution(tmp_path / "c.pos", moving=False)).streams
    with pytest.raises(UnknownNameError, match="speed"):
        load_flight(spec, settings={"speed": "1"})


# -- KITTI ---------------------------------------------------------------------------------------------


def oxts(folder: Path, *, count: int = 4, numbers: int = 30, scale: float = 1.0) -> str:
    (folder / "oxts" / "data").mkdir(parents=True)
    stamps = [f"2011-09-26 13:02:20.{5 + k}94360375" for k in range(count)]
    (folder / "oxts" / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for k in range(count):
        x = [49.0 + 1e-5 * k, 8.4, 112.5, 0.02, -0.01, 1.5, 3.0, 4.0, 5.0, 0.0, 0.25]
        x += [0.5 * scale, -0.25 * scale, 9.75 * scale, *(0.0,) * 3, 0.1, 0.2, 0.3, *(0.0,) * 3, 0.05, 0.02]
        x += [4, 9, 4, 4, 0]
        (folder / "oxts" / "data" / f"{k:010d}.txt").write_text(" ".join(map(str, x[:numbers])) + "\n")
    return f"kitti:{folder}"


def test_a_drive_of_kitti_is_read(tmp_path):
    flight = load_flight(oxts(tmp_path / "drive"))
    imu, gps = flight.streams["imu"], flight.streams["gps"]
    assert imu.time[0] == 1_317_042_140 * S + 594_360_375
    np.testing.assert_array_equal(imu["specific_force"][0], [0.5, -0.25, 9.75])
    np.testing.assert_array_equal(imu["gyro"][0], [0.1, 0.2, 0.3])
    np.testing.assert_array_equal(gps["latitude"], np.radians(49.0 + 1e-5 * np.arange(4)))
    np.testing.assert_array_equal(flight.streams["gps_velocity"]["velocity"][0], [4.0, 3.0, 0.25])
    np.testing.assert_allclose(deviations(gps)[0], 0.05)
    assert flight.truth is not None
    north = flight.truth["position"][:, 1]
    np.testing.assert_allclose(north, 1.112 * np.arange(4), rtol=1e-3, atol=1e-9)
    q = flight.truth["attitude"][0]
    assert 2.0 * np.arctan2(q[3], q[0]) == pytest.approx(1.5, abs=0.02)
    assert inspected(f"kitti:{tmp_path / 'drive'}")["imu"]["rate_hz"] == 10.0


def test_broken_folders_of_kitti_are_refused(tmp_path):
    refused(oxts(tmp_path / "short", numbers=29), "0000000000.txt", "29 numbers")
    refused(oxts(tmp_path / "g", scale=1 / 9.81), "not in the unit")
    spec = oxts(tmp_path / "times")
    (tmp_path / "times" / "oxts" / "timestamps.txt").write_text("2011-09-26 13:02:25.5\n")
    refused(spec, "not one time a file")
    refused(f"kitti:{tmp_path}", "no navigation unit")


# -- PX4 -----------------------------------------------------------------------------------------------


def ulog(file: Path, topics: dict[str, tuple[str, list[tuple[Any, ...]]]]) -> str:
    """Writes a log: by topic the fields as its format has them, and rows that begin with the stamp."""
    codes = {"uint64_t": "Q", "float": "f", "int32_t": "i", "uint8_t": "B", "double": "d"}

    def message(kind: bytes, body: bytes) -> bytes:
        return struct.pack("<HB", len(body), kind[0]) + body

    made = b"ULog\x01\x12\x35\x01" + struct.pack("<Q", 0)
    made += message(b"B", bytes(40))
    for name, (fields, _) in topics.items():
        made += message(b"F", f"{name}:{fields};".encode())
    data = b""
    for number, (name, (fields, rows)) in enumerate(topics.items()):
        made += message(b"A", struct.pack("<BH", 0, number) + name.encode())
        code = "<"
        for part in fields.split(";"):
            kind, _, size = part.split()[0].partition("[")
            code += (size.rstrip("]") or "") + codes[kind]
        for row in rows:
            data += message(b"D", struct.pack("<H", number) + struct.pack(code, *row))
    file.write_bytes(made + data)
    return f"px4:{file}"


FIX = (
    "uint64_t timestamp;int32_t lat;int32_t lon;int32_t alt;float eph;float epv;float vel_n_m_s;"
    "float vel_e_m_s;float vel_d_m_s;float s_variance_m_s;uint8_t fix_type"
)


def autopilot(file: Path, *, scale: float = 1.0, without: str = "") -> str:
    pytest.importorskip("pyulog")
    t = [1_000_000 + 4000 * k for k in range(50)]
    topics: dict[str, tuple[str, list[tuple[Any, ...]]]] = {
        "sensor_combined": (
            "uint64_t timestamp;float[3] gyro_rad;float[3] accelerometer_m_s2",
            [(k, 0.5, 0.25, -0.125, 0.5 * scale, 0.25 * scale, -9.75 * scale) for k in t],
        ),
        "vehicle_gps_position": (
            FIX,
            [
                (t[k], 473977418, 85455939, 488_250 + k, 0.5, 1.0, 1.5, -2.5, 0.25, 0.125, 3 if k else 1)
                for k in range(0, 50, 10)
            ],
        ),
        "vehicle_magnetometer": (
            "uint64_t timestamp;float[3] magnetometer_ga",
            [(k, 0.25, 0.0, 0.5) for k in t[::5]],
        ),
        "vehicle_air_data": ("uint64_t timestamp;float baro_alt_meter", [(k, 500.5) for k in t[::5]]),
        "battery_status": ("uint64_t timestamp;float voltage_v", [(t[0], 12.0)]),
    }
    topics.pop(without, None)
    return ulog(file, topics)


def test_a_log_of_px4_is_read_in_our_axes(tmp_path):
    flight = load_flight(autopilot(tmp_path / "log.ulg"))
    s = flight.streams
    np.testing.assert_array_equal(s["imu"].time, 10**9 + 4_000_000 * np.arange(50))
    np.testing.assert_array_equal(s["imu"]["gyro"][0], [0.5, -0.25, 0.125])
    np.testing.assert_array_equal(s["imu"]["specific_force"][0], [0.5, -0.25, 9.75])
    np.testing.assert_array_equal(s["gps"]["latitude"], np.radians(np.full(4, 473977418 * 1e-7)))
    np.testing.assert_array_equal(s["gps"]["height"], np.array([488_260, 488_270, 488_280, 488_290]) * 1e-3)
    np.testing.assert_array_equal(deviations(s["gps"])[0], [0.5, 0.5, 1.0])
    np.testing.assert_array_equal(s["gps_velocity"]["velocity"][0], [-2.5, 1.5, -0.25])
    np.testing.assert_array_equal(s["magnetometer"]["field"][0], np.array([0.25, 0.0, -0.5]) * 1e-4)
    np.testing.assert_array_equal(s["barometer"]["height"], np.full(10, 500.5))
    assert any("1 of 5 fixes are none in space" in n for n in flight.notes)
    assert any("1 topics of other kinds" in n for n in flight.notes)
    assert set(inspected(f"px4:{tmp_path / 'log.ulg'}")) == set(s)


def test_logs_that_are_none_or_lack_a_unit_or_are_in_g_are_refused(tmp_path):
    refused(autopilot(tmp_path / "a.ulg", without="sensor_combined"), "no inertial unit", "vehicle_air_data")
    refused(autopilot(tmp_path / "b.ulg", scale=1 / 9.81), "not in the unit")
    (tmp_path / "c.ulg").write_bytes(b"PK\x03\x04 a zip")
    refused(f"px4:{tmp_path / 'c.ulg'}", "begins with ULog")
    (tmp_path / "log.bin").write_bytes(b"")
    refused(f"px4:{tmp_path / 'log.bin'}", ".ulg")
