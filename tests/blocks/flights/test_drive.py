"""`sim:drive`: a run of its graph, the same in every engine; a smooth road, and readings as exact as said."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, aperiodic, load_flight, simulate
from flowgraph.blocks.flights.drive import GRADES, ORIGIN, SENSORS, drive
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    rotate,
    to_rotation_vector,
)
from flowgraph.blocks.inertial.navigation import earth_at, gravity_at
from flowgraph.blocks.world import road_of
from flowgraph.data.inputs import clocks_of
from flowgraph.data.notes import note
from flowgraph.errors import FlowgraphError


def load(seed: int = 0, **settings: Any) -> Flight:
    named = {n.replace("__", "."): f"{v}" for n, v in settings.items()}
    return load_flight("sim:drive", seed=seed, settings={"sensors": ",".join(SENSORS), **named})


def truth_at(flight: Flight, time: np.ndarray) -> Any:
    assert flight.truth is not None
    return flight.truth[np.searchsorted(flight.truth.time, time)]


def in_graph(flight: Flight, seed: int, engine: str) -> Any:
    made_by = flight.experiment
    assert made_by is not None
    assert made_by.world is drive
    built = drive.build(**clocks_of(made_by.ticks), road=aperiodic(), **made_by.settings)
    return simulate(built, {**made_by.ticks, **made_by.given(seed)}, engine=engine, seed=seed)


@pytest.mark.parametrize("engine", ["numpy", "python", "reference", "c"])
def test_in_a_graph_it_is_what_was_recorded(engine: str) -> None:
    flight = load(3, duration=8, imu__rate=50, gps__rate=5)
    found = in_graph(flight, 3, engine)
    for name, series in {**flight.streams, "truth": flight.truth}.items():
        assert series is not None
        np.testing.assert_array_equal(found[name].time, series.time)
        for leaf, values in series.leaves.items():
            if engine == "numpy":
                np.testing.assert_array_equal(found[name][leaf], values)
            np.testing.assert_allclose(found[name][leaf], values, rtol=1e-9, atol=1e-9, err_msg=leaf)


def test_positions_velocities_and_attitudes_are_of_one_smooth_motion() -> None:
    """Central differences of positions are velocities, but for a sixth of the jerk times the step squared;
    the body's x axis is along the velocity."""
    for seed in range(5):
        truth = load(seed, duration=90, imu__rate=400).truth
        assert truth is not None
        position, velocity = truth["position"], truth["velocity"]
        slope = (position[2:] - position[:-2]) / 0.005
        np.testing.assert_allclose(slope, velocity[1:-1], atol=2e-4)
        assert np.abs(np.diff(velocity, axis=0)).max() < 0.1, "at most 40 m/s^2: nothing jumps"
        speed = np.linalg.norm(velocity, axis=-1)
        assert speed[truth.time <= 3 * 10**9].max() == 0.0
        assert speed[(truth.time > 7 * 10**9) & (truth.time < 30 * 10**9)].min() > 0.5
        assert speed[truth.time == 48 * 10**9] < 1e-9, "it stops at the middle one of 16 paces"
        ahead = rotate(truth["attitude"], np.tile([1.0, 0.0, 0.0], (len(speed), 1)), xp=np)
        np.testing.assert_allclose(ahead * speed[:, None], velocity, atol=1e-9)


def test_readings_of_the_unit_integrate_to_the_motion() -> None:
    """Of an almost perfect unit at 20 Hz: attitude by its rate less the Earth's, and velocity by its force,
    are those of the truth after each step, to the noise."""
    flight = load(1, unit="navigation", duration=40, imu__rate=20)
    truth, imu, grade = flight.truth, flight.streams["imu"], GRADES["navigation"]
    assert truth is not None
    p, v, q = (truth[n][:-1] for n in ("position", "velocity", "attitude"))
    dt, earth, gravity = 0.05, earth_at(ORIGIN[0]), np.asarray(gravity_at(ORIGIN[0], ORIGIN[2]))
    back = lambda vector: rotate(conjugate(q, xp=np), np.broadcast_to(vector, p.shape), xp=np)
    turn = (imu["gyro"] - truth["gyro_bias"])[1:] - back(np.asarray(earth.turn))
    turned = multiply(q, from_rotation_vector(turn * dt, xp=np), xp=np)
    off = to_rotation_vector(multiply(conjugate(turned, xp=np), truth["attitude"][1:], xp=np), xp=np)
    assert 0.9 < off.std() / (grade.noise.gyro * np.sqrt(dt)) < 1.1
    half = multiply(q, from_rotation_vector(0.5 * turn * dt, xp=np), xp=np)
    force = (imu["specific_force"] - truth["accelerometer_bias"])[1:]
    strength = np.linalg.norm(gravity) / earth.radius
    pull = gravity + p * strength * np.array([-1.0, -1.0, 2.0]) - 2.0 * np.cross(earth.turn, v)
    off = truth["velocity"][1:] - v - (rotate(half, force, xp=np) + pull) * dt
    assert 0.9 < off.std() / (grade.noise.accelerometer * np.sqrt(dt)) < 1.1


def test_errors_of_the_sensors_are_white_and_as_large_as_said() -> None:
    found: dict[str, list[np.ndarray]] = {}
    for seed in range(4):
        flight = load(seed, duration=60, imu__rate=10, gps__rate=10, gps__noise=2.0, wheels__noise=0.1)
        for name, series in flight.streams.items():
            real = truth_at(flight, series.time)
            x = rotate(real["attitude"], np.tile([1.0, 0.0, 0.0], (len(series), 1)), xp=np)
            if name == "gps":
                angles = np.stack([series[n] for n in ("latitude", "longitude", "height")], axis=-1)
                error = (to_enu(angles, ORIGIN) - real["position"]) / [2.0, 2.0, 4.0]
                np.testing.assert_array_equal(series["covariance"][-1], np.diag([4.0, 4.0, 16.0]))
            elif name == "gps_velocity":
                error = (series["velocity"] - real["velocity"]) / 0.05
            elif name == "heading":
                angle = series["angle"] - np.arctan2(x[:, 1], x[:, 0])
                error = np.angle(np.exp(1j * angle)) / 0.01
            elif name == "magnetometer":
                field = np.tile(flight.info["magnetic_field"], (len(series), 1))
                error = (series["field"] - rotate(conjugate(real["attitude"], xp=np), field, xp=np)) / 5e-7
            elif name == "barometer":
                error = (series["height"] - real["position"][:, 2] - 12.0) / 0.3
            elif name == "wheels":
                error = (series["speed"] - np.sum(real["velocity"] * x, axis=-1)) / 0.1
            else:
                continue
            found.setdefault(name, []).append(np.asarray(error).ravel())
    assert set(found) == set(SENSORS)
    for name, parts in found.items():
        errors = np.concatenate(parts)
        bound = 4.0 / np.sqrt(errors.size)
        assert abs(errors.std() - 1.0) < bound, name
        assert abs(errors.mean()) < bound, name


def test_a_road_has_its_number_and_noise_its_seed() -> None:
    one, other = (load(seed, duration=20, road=7) for seed in (0, 1))
    assert one.truth is not None
    assert other.truth is not None
    np.testing.assert_array_equal(one.truth["position"], other.truth["position"])
    assert (one.streams["gps"]["latitude"] != other.streams["gps"]["latitude"]).all()
    assert (one.truth["gyro_bias"] != other.truth["gyro_bias"]).all()
    alone = load(0, duration=20, sensors="gps")
    np.testing.assert_array_equal(
        alone.streams["gps"]["latitude"], load(0, duration=20).streams["gps"]["latitude"]
    )


@pytest.mark.parametrize("duration", [0.01, 1.0, 2.5, 3.0, 5.0, 6.0 + 1e-9, 11.9, 17.9, 48.0, 1800.0])
def test_pieces_follow_on_one_another_whatever_the_duration(duration: float) -> None:
    """Where one ends the next begins, and the road reaches as far as the car."""
    for number in range(5):
        pieces = road_of(duration, number)
        ends = pieces["along"].sum(axis=-1)
        np.testing.assert_allclose(ends[:-1], pieces["along"][1:, 0], rtol=0.0, atol=1e-12)
        assert ((pieces["along"][:, 0] >= pieces["first"]) & (ends <= pieces["first"] + 3.0)).all()
        np.testing.assert_allclose(pieces["begin"][1:], (pieces["begin"] + pieces["length"])[:-1], rtol=1e-12)
        joints = pieces["road"].sum(axis=2)[:, :-1]
        np.testing.assert_allclose(joints, pieces["road"][:, 1:, 0], rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("sensors", ["", "imu", "gps,gps"])
def test_few_sensors_are_enough(sensors: str) -> None:
    flight = load(duration=1, sensors=sensors)
    assert list(flight.streams) == ["imu", *dict.fromkeys(s for s in sensors.split(",") if s == "gps")]
    assert flight.notes == (note("info", "simulated with seed 0: a drive with a unit of consumer grade"),)


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"unit": "toy"}, "unit"),
        ({"sensors": "sonar"}, "sensor"),
        ({"gps__nois": 1}, "setting"),
        ({"road": "-2"}, "whole number"),
        ({"duration": 0}, "positive number"),
        ({"imu__rate": "fast"}, "positive number"),
    ],
)
def test_what_is_not_usable_is_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(FlowgraphError, match=said):
        load(**settings)
