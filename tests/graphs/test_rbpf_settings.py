"""The indoor filter in the six settings of the thesis, beside an error-state filter on the same readings.

Flights of `sim:thesis`, whose accelerometer reads the coordinate acceleration: the filters are built without
gravity. A setting names the motion capture, accelerometer and gyroscope, H for the smaller of two variances.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, Series, periodic
from flowgraph.blocks.flights.worlds import load_world
from flowgraph.blocks.inertial.alignment import StartSpread, start_belief
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.particles.cloud import start_cloud
from flowgraph.blocks.signals import Attitude, Imu, Position
from flowgraph.data.batch import Runs
from flowgraph.engines.many import simulate_many
from flowgraph.graphs.ins_eskf import ins_eskf
from flowgraph.graphs.rbpf_indoor import rbpf_indoor

SETTINGS = ("HHH", "HHL", "HLL", "LHH", "LHL", "LLL")
VICON, READING = {"H": 0.01, "L": 0.1}, {"H": 0.1, "L": 1.0}
BOUND = {"HH": 0.080, "HL": 0.109, "LH": 0.179, "LL": 0.252}
"""m: a Kalman filter that is told the exact attitude, for motion capture and accelerometer."""

SPREAD = StartSpread(0.1, 0.1, 0.1, 0.1, gyro_bias=0.0, accelerometer_bias=0.0)
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
IMU, CAPTURE = periodic("5ms", phase=0), periodic("250ms", phase=0)


@functools.cache
def flight(setting: str, seed: int, duration: float) -> Flight:
    capture, push, turn = list(setting)
    deviation = math.sqrt(VICON[capture])
    return load_world("thesis", seed=seed, settings={
        "duration": duration,
        "sensors": "gyro,coordinate_acceleration,vicon",
        "gyro.noise": math.sqrt(READING[turn] / 200.0),
        "coordinate_acceleration.noise": math.sqrt(READING[push] / 200.0),
        "vicon.noise": deviation,
        "vicon.attitude_noise": deviation,
    })  # fmt: skip


def inputs(f: Flight) -> dict[str, Series]:
    gyro, push, vicon = (f.streams[n] for n in ("gyro", "coordinate_acceleration", "vicon"))
    imu = Imu(gyro=gyro["rate"], specific_force=push["acceleration"])
    return {
        "imu": Series(gyro.time, imu, name="imu"),
        "vicon": vicon,
        "position": Series(vicon.time, Position(position=vicon["position"]), name="position"),
        "attitude": Series(vicon.time, Attitude(attitude=vicon["attitude"]), name="attitude"),
    }


def chosen(setting: str, seed: int, duration: float, *names: str) -> dict[str, Series]:
    made = inputs(flight(setting, seed, duration))
    return {name: made[name] for name in names}


def rmse(found: Runs, setting: str, seeds: range, duration: float) -> float:
    """m, over all flights and all ticks from 1 s on."""
    squares = []
    for k, seed in enumerate(seeds):
        truth = flight(setting, seed, duration).truth
        assert truth is not None
        late = found.time >= 1_000_000_000
        there = truth["position"][np.searchsorted(truth.time, found.time[late])]
        squares.append(np.mean(np.sum((found.position[k][late] - there) ** 2, axis=-1)))
    return float(np.sqrt(np.mean(squares)))


def errors(setting: str, particles: int, seeds: range, duration: float = 20.0) -> tuple[float, float]:
    """The position RMSE of the particles and of the error-state filter, m."""
    deviation = math.sqrt(VICON[setting[0]])
    common: dict[str, Any] = {
        "imu": IMU,
        "noise": ImuNoise.per_sample(200.0, gyro=READING[setting[2]], accelerometer=READING[setting[1]]),
        "position_noise": deviation,
        "attitude_noise": deviation,
        "gravity": (0.0, 0.0, 0.0),
    }
    cloud = rbpf_indoor.build(
        vicon=CAPTURE, start=start_cloud(particles, attitude=LEVEL, spread=SPREAD), **common
    )
    eskf = ins_eskf.build(
        position=CAPTURE, attitude=CAPTURE, start=start_belief(np.zeros(3), LEVEL, spread=SPREAD), **common
    )
    ours = simulate_many(
        cloud, lambda s: chosen(setting, s, duration, "imu", "vicon"), seeds, keep=["pose"],
        engine="c",
    )["pose"]  # fmt: skip
    theirs = simulate_many(
        eskf,
        lambda s: chosen(setting, s, duration, "imu", "position", "attitude"),
        seeds,
        keep=["belief"],
        engine="c",
    )["belief"]
    return rmse(ours, setting, seeds, duration), rmse(theirs, setting, seeds, duration)


@pytest.mark.slow
def test_in_one_setting_it_is_nearly_as_good_as_an_error_state_filter():
    ours, theirs = errors("HHH", 300, range(3), duration=8.0)
    assert ours < 1.25 * theirs


@pytest.mark.slow
@pytest.mark.parametrize("setting", SETTINGS)
@pytest.mark.parametrize(("particles", "flights", "factor"), [(1000, 20, 1.12), (10_000, 6, 1.03)])
def test_it_is_nearly_as_good_as_an_error_state_filter_in_each_setting(setting, particles, flights, factor):
    ours, theirs = errors(setting, particles, range(flights))
    assert BOUND[setting[:2]] < ours < factor * theirs
    assert BOUND[setting[:2]] < theirs
