"""World and sensors as blocks: the figure in a graph, in every engine, and what its sensors read of it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, Series, Stream, Tick, graph, latest, load_flight, simulate, ticks
from flowgraph.blocks.flights.figure import figure
from flowgraph.blocks.geometry.rotations import conjugate, geodesic_angle, multiply, to_rotation_vector
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.sensors import (
    bias_at_start,
    drift,
    read_altimeter,
    read_attitude,
    read_flow,
    read_magnetometer,
    read_position,
)
from flowgraph.blocks.signals import FigureShape, Vector
from flowgraph.blocks.world import figure_motion, figure_shape
from tests.support import MS, all_engines, both_quick

QUIET: dict[str, Any] = {
    "rate": 100.0,
    "noise": ImuNoise(0.0, 0.0, 0.0, 0.0),
    "gyro_bias": 0.0,
    "accelerometer_bias": 0.0,
    "position_noise": 0.0,
    "attitude_noise": 0.0,
}


def clocks(until: str, imu: str = "10ms", vicon: str = "250ms"):
    end = round(float(until.removesuffix("s")) * 1e9) + 1
    return {
        "start": ticks(end, until=end),
        "imu": ticks(imu, until=end),
        "vicon": ticks(vicon, until=end),
    }


def truth_of(flight: Flight) -> Series:
    assert flight.truth is not None
    return flight.truth


@pytest.mark.parametrize("engine", ["c", pytest.param("xla", marks=pytest.mark.slow)])
def test_a_flight_by_a_graph_is_the_same_in_every_engine(engine: str) -> None:
    noisy: dict[str, Any] = {
        **QUIET,
        "noise": ImuNoise(0.01, 0.1, 1e-3, 1e-2),
        "gyro_bias": 0.1,
        "attitude_noise": 0.1,
    }
    built = figure.build(**noisy)
    given = clocks("1.6s", imu="20ms")
    want = both_quick(built, given, seed=7)
    got = simulate(built, given, engine=engine, seed=7)
    for name in ("imu", "vicon", "truth"):
        for leaf, values in want[name].leaves.items():
            np.testing.assert_allclose(got[name][leaf], values, rtol=1e-9, atol=1e-9, err_msg=leaf)


def test_perfect_sensors_read_the_motion() -> None:
    flown = simulate(figure.build(**QUIET), clocks("5s"), engine="c", seed=2)
    imu, truth = flown["imu"], flown["truth"]
    truth = truth[np.isin(truth.time, imu.time)]
    turn = to_rotation_vector(
        multiply(conjugate(truth["attitude"][:-1], xp=np), truth["attitude"][1:], xp=np), xp=np
    )
    mean = 0.5 * (imu["gyro"][1:] + imu["gyro"][:-1])
    np.testing.assert_allclose(turn / 0.01, mean, atol=2e-3)
    R = truth["attitude"]
    force = np.array([0.0, 0.0, 9.81]) + np.gradient(truth["velocity"], 0.01, axis=0)
    back = multiply(multiply(conjugate(R, xp=np), np.c_[np.zeros(len(R)), force], xp=np), R, xp=np)[:, 1:]
    np.testing.assert_allclose(back[1:-1], imu["specific_force"][1:-1], atol=2e-3)
    assert np.abs(imu["specific_force"][:, :2]).max() < 1e-9, "a quadrotor is carried by its thrust"
    assert np.ptp(truth["position"], axis=0).min() > 0.3
    seen = flown["vicon"]
    held = np.isin(truth.time, seen.time)
    np.testing.assert_allclose(seen["position"], truth["position"][held], atol=1e-12)


@pytest.mark.slow
def test_biases_and_noise_are_as_large_as_told() -> None:
    flights = [
        load_flight(
            "sim",
            seed=seed,
            settings={"duration": "4", "gyro.bias": "0.02", "gyro.walk": "0.01", "gyro.noise": "0"},
        )
        for seed in range(12)
    ]
    bias = np.stack([truth_of(f)["gyro_bias"] for f in flights])
    assert bias[:, 0].std() == pytest.approx(0.02, rel=0.35)
    walked = bias[:, -1] - bias[:, 0]
    assert walked.std() == pytest.approx(0.01 * math.sqrt(4.0), rel=0.35)
    own = {"duration": "4", "gyro.bias": "0.02", "gyro.walk": "0.01", "gyro.noise": "0.01"}
    quiet, noisy = flights[1], load_flight("sim", seed=1, settings=own)
    white = noisy.streams["imu"]["gyro"] - quiet.streams["imu"]["gyro"]
    assert white.std() == pytest.approx(0.01 * math.sqrt(200.0), rel=0.1)
    np.testing.assert_array_equal(truth_of(noisy)["gyro_bias"], truth_of(quiet)["gyro_bias"])


FIELD = (0.2e-6, 20e-6, -40e-6)


@graph
def others(start: Stream[Tick], imu: Stream[Tick]):
    none = FigureShape(
        **{n: np.zeros((3, 3)) for n in ("sizes", "frequencies", "phases", "origin")},
        **{n: np.zeros(2) for n in ("yaw_phases", "yaw_origin")},
    )
    motion = figure_motion(latest(figure_shape(at=start), init=none), at=imu)
    first = latest(bias_at_start(at=start, deviation=0.3), init=Vector(vector=np.zeros(3)))
    drawn = bias_at_start(at=start, deviation=1e-6, name="iron", draws="iron")
    iron = latest(drawn, init=Vector(vector=np.zeros(3)), name="iron_now")
    return {
        "motion": motion,
        "range": read_altimeter(motion, noise=0.0, most_tilt=0.2),
        "position": read_position(motion, noise=0.0, lever=(0.0, 0.0, 1.0)),
        "attitude": read_attitude(motion, noise=0.05),
        "field": read_magnetometer(motion, iron, field=FIELD, noise=0.0),
        "flow": read_flow(motion, noise=0.0, turn_noise=0.0),
        "bias": drift(first, at=imu, walk=0.0),
        "iron": drawn,
    }


def test_other_sensors_read_what_they_say() -> None:
    given = {n: s for n, s in clocks("3s", imu="50ms").items() if n != "vicon"}
    found = all_engines(others.build(), given, seed=5)
    motion = found["motion"]
    tilt = np.degrees(np.arccos(1.0 - 2.0 * (motion["attitude"][:, 1:3] ** 2).sum(1)))
    low = tilt <= np.degrees(0.2)
    assert 0 < low.sum() < len(tilt)
    np.testing.assert_array_equal(found["range"].time, motion.time[low])
    want = motion["position"][low, 2] / np.cos(np.radians(tilt[low]))
    np.testing.assert_allclose(found["range"]["distance"], want, rtol=1e-9)
    up = found["position"]["position"] - motion["position"]
    np.testing.assert_allclose(up[:, 2], np.cos(np.radians(tilt)), atol=1e-9)
    off = geodesic_angle(found["attitude"]["attitude"], motion["attitude"])
    assert np.sqrt(np.mean(off**2)) == pytest.approx(np.degrees(0.05 * math.sqrt(3.0)), rel=0.2)
    q = motion["attitude"]
    world = multiply(
        multiply(q, np.c_[np.zeros(len(q)), found["field"]["field"] - found["iron"]["vector"]], xp=np),
        conjugate(q, xp=np),
        xp=np,
    )
    np.testing.assert_allclose(world[:, 1:], np.broadcast_to(FIELD, (len(q), 3)), atol=1e-18)
    flow = found["flow"]
    np.testing.assert_array_equal(flow.time, motion.time[1:])
    np.testing.assert_allclose(flow["interval"], 0.05, rtol=1e-12)
    place, turned = motion["position"][0], q[0]
    for k in range(len(flow)):  # displacements and turns compose to where the body is
        moved = multiply(
            multiply(turned, np.r_[0.0, flow["displacement"][k]], xp=np), conjugate(turned, xp=np), xp=np
        )
        place, turned = place + moved[1:], multiply(turned, flow["turn"][k], xp=np)
    np.testing.assert_allclose(place, motion["position"][-1], atol=1e-9)
    assert geodesic_angle(turned[None], q[-1:])[0] < 1e-6
    assert (found["bias"]["vector"] == found["bias"]["vector"][0]).all()
    assert found["bias"]["vector"][0].std() > 0.0
    assert motion.time[1] == 50 * MS
