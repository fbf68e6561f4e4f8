"""What the settings of a stream do to a flight that was made: as they do to a recording."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, Flight, UnknownNameError, find_graph, load_flight, simulate
from flowgraph.blocks.geometry.rotations import conjugate, multiply


def flight_with(**settings: str) -> Flight:
    given = {"duration": "4", **{n.replace("__", "."): v for n, v in settings.items()}}
    return load_flight("sim", seed=3, settings=given)


def test_stamps_are_shifted_and_readings_left_out():
    plain, moved = flight_with(), flight_with(vicon__time_offset="0.1", imu__every="0.02")
    np.testing.assert_array_equal(moved.streams["vicon"].time, plain.streams["vicon"].time + 100_000_000)
    np.testing.assert_array_equal(moved.streams["vicon"]["position"], plain.streams["vicon"]["position"])
    assert len(moved.streams["imu"]) == pytest.approx(len(plain.streams["imu"]) / 4, abs=1)
    assert any("vicon: stamps shifted by 100000000 ns" in n for n in moved.notes)
    assert any("imu: thinned to one in 0.02 s" in n for n in moved.notes)


def test_a_mount_is_taken_out_and_a_lever_told():
    plain, moved = flight_with(), flight_with(vicon__mount="0,0,90", vicon__lever="0.1,0,0.05")
    assert moved.info["vicon_lever"] == (0.1, 0.0, 0.05)
    quarter = np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])
    want = multiply(plain.streams["vicon"]["attitude"], conjugate(quarter, xp=np), xp=np)
    np.testing.assert_allclose(moved.streams["vicon"]["attitude"], want, atol=1e-12)


def test_a_late_stream_keeps_its_lateness_when_its_clock_is_moved():
    moved = flight_with(vicon__time_offset="0.1", vicon__latency="0.05").streams["vicon"]
    np.testing.assert_array_equal(moved.time - moved.stamp, np.full(len(moved), 50_000_000))


def test_a_clock_that_is_off_makes_a_filter_worse_and_is_found_again():
    case = find_graph("ekf").case(flight_with(vicon__time_offset="0.1"))
    off = case.score(simulate(case.graph, case.inputs))["position_rmse_m"]
    fine = find_graph("ekf").case(flight_with())
    assert off > 3.0 * fine.score(simulate(fine.graph, fine.inputs))["position_rmse_m"]


@pytest.mark.parametrize("data", ["sim", "sim:thesis", "sim:drive"])
def test_every_kind_has_them(data):
    flight = load_flight(data, settings={"duration": "2", "imu.time_offset": "0.5"})
    assert flight.streams["imu"].time[0] >= 500_000_000
    assert flight.experiment is None


@pytest.mark.parametrize(
    ("settings", "error", "said"),
    [
        ({"vico.time_offset": "1"}, UnknownNameError, "did you mean 'vicon'"),
        ({"vicon.lever": "1,2"}, DeclarationError, "three numbers"),
        ({"imu.lever": "1,2,3"}, DeclarationError, "nothing to act on"),
        ({"vicon.mont": "1"}, UnknownNameError, "no setting is called"),
    ],
)
def test_what_cannot_be_placed_is_refused(settings, error, said):
    with pytest.raises(error, match=said):
        load_flight("sim", settings=settings)
