"""Flights of the outdoor quadrotor: units, axes, the two clocks, thinning, and what is wrong with a
folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flowgraph import load_flight
from flowgraph.errors import DataError, UnknownNameError
from tests.recordings import recordings

IMU = "time,Euler_X,Euler_Y,Euler_Z,Acc_X,Acc_Y,Acc_Z,Gyr_X,Gyr_Y,Gyr_Z"
GT = (
    "time,distance(meters),speed(m/s), compass_heading(degrees), pitch(degrees), roll(degrees),"
    "height_above_takeoff(meters),North,East,Down"
)


def folder(path: Path, *, seconds: float = 4.0, g: float = 9.8, imu: str = IMU, repeat: bool = False) -> Path:
    """A flight of some seconds: 120 Hz, RTK at 10 Hz; north 1 m/s, east 2, and 0.5 upwards."""
    path.mkdir(exist_ok=True)
    for unit in (1, 2):
        rows = [
            f"{k / 120!r},1,2,3,0.5,-0.25,{g},{10.0 * unit},-20.5,30.0" for k in range(int(seconds * 120))
        ]
        if repeat:
            rows.insert(5, rows[4])
        (path / f"IMU_{unit}.csv").write_text("\n".join([imu, *rows]) + "\n")
    fixes = [
        f"{k / 10!r},9,1,250,0,0,17,{0.1 * k!r},{0.2 * k!r},{-0.05 * k!r}" for k in range(int(seconds * 10))
    ]
    (path / "GT.csv").write_text("\n".join([GT, *fixes]) + "\n")
    return path


def test_readings_are_in_si_units_and_positions_east_north_up(tmp_path):
    flight = load_flight(f"outdoor_quadrotor:{folder(tmp_path / 'path_1')}:2")
    imu, rtk = flight.streams["imu"], flight.streams["rtk"]
    np.testing.assert_array_equal(imu["gyro"][0], np.radians([20.0, -20.5, 30.0]))
    np.testing.assert_array_equal(imu["specific_force"][0], [0.5, -0.25, 9.8])
    np.testing.assert_array_equal(rtk["position"], [[0.2 * k, 0.1 * k, 0.05 * k] for k in range(40)])
    assert flight.truth is not None
    np.testing.assert_array_equal(flight.truth["position"], rtk["position"])
    assert imu.time[1] == 8_333_333
    assert flight.info["position_noise"] == 0.02
    assert any("columns of angles" in n for n in flight.notes)


def test_the_first_unit_is_read_where_none_is_named(tmp_path):
    flight = load_flight(f"outdoor_quadrotor:{folder(tmp_path / 'path_1')}")
    assert flight.streams["imu"]["gyro"][0, 0] == np.radians(10.0)


def test_positions_are_thinned_and_the_truth_keeps_all_on_the_same_clock(tmp_path):
    where = folder(tmp_path / "path_1")
    flight = load_flight(
        f"outdoor_quadrotor:{where}", settings={"rtk.every": "1", "rtk.time_offset": "-0.34"}
    )
    assert flight.truth is not None
    np.testing.assert_array_equal(flight.streams["rtk"].time, np.arange(4) * 10**9 - 340_000_000)
    np.testing.assert_array_equal(flight.truth.time, np.arange(40) * 10**8 - 340_000_000)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"g": 1.0}, "not in the unit"),
        ({"repeat": True}, "time does not increase"),
    ],
)
def test_wrong_units_and_stamps_are_refused(tmp_path, changes, expected):
    where = folder(tmp_path / "path_1", **changes)
    with pytest.raises(DataError, match=expected):
        load_flight(f"outdoor_quadrotor:{where}")


def test_a_repeated_row_is_left_out_on_request(tmp_path):
    where = folder(tmp_path / "path_1", repeat=True)
    flight = load_flight(f"outdoor_quadrotor:{where}", settings={"bad_time": "drop"})
    assert len(flight.streams["imu"]) == 480


def test_what_is_missing_is_named(tmp_path):
    where = folder(tmp_path / "path_1")
    with pytest.raises(DataError, match="no such file; there are flights path_1"):
        load_flight(f"outdoor_quadrotor:{tmp_path}")
    with pytest.raises(DataError, match="there are units 1, 2"):
        load_flight(f"outdoor_quadrotor:{where}:7")
    with pytest.raises(UnknownNameError, match="Gyr_Z"):
        load_flight(f"outdoor_quadrotor:{folder(tmp_path / 'other', imu=IMU.replace('Gyr_Z', 'W'))}")
    with pytest.raises(UnknownNameError, match=r"rtk\.sometimes"):
        load_flight(f"outdoor_quadrotor:{where}", settings={"rtk.sometimes": "1"})


def test_a_recorded_flight_is_read():
    flight = load_flight(f"outdoor_quadrotor:{recordings('outdoor_quadrotor') / 'path_2'}:1")
    assert len(flight.streams["imu"]) == 5281
    assert len(flight.streams["rtk"]) == 441
    assert 9.0 < float(np.median(np.linalg.norm(flight.streams["imu"]["specific_force"], axis=1))) < 13.0


def test_heights_in_coarse_steps_are_a_note(tmp_path):
    """As the heights of these recordings are; what is written finely is none."""
    where = folder(tmp_path / "path_1")
    table = where / "GT.csv"
    head, *rows = table.read_text().splitlines()
    coarse = lambda step: [f"{r.rpartition(',')[0]},{-step * (k // 4)!r}" for k, r in enumerate(rows)]
    for step, said in ((0.1, True), (0.25, True), (0.01, False)):
        table.write_text("\n".join([head, *coarse(step)]) + "\n")
        notes = load_flight(f"outdoor_quadrotor:{where}").notes
        assert any(f"Down is written in steps of {step:g} m" in n for n in notes) == said
