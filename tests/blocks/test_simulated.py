"""The simulated flight: its derivatives belong together, its noise is what it says, and it repeats."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks import geometry as g
from flowgraph.blocks.flights.simulated import DEFAULTS, load, trajectory
from flowgraph.blocks.metrics import pose_errors
from flowgraph.errors import DataError, UnknownNameError


@pytest.mark.parametrize("seed", range(3))
def test_trajectory_derivatives_belong_together(seed):
    t, h = np.linspace(0.01, 20.0, 1500), 1e-4  # beside 1 s and 3 s, where the snap jumps
    now, before, after = (trajectory(t + d, seed=seed) for d in (0.0, -h, h))
    slope = lambda name: (after[name] - before[name]) / (2 * h)
    np.testing.assert_allclose(now["velocity"], slope("position"), atol=1e-6)
    world_force = g.rotate(now["attitude"], now["force"], xp=np)
    np.testing.assert_allclose(world_force, slope("velocity") + np.array([0.0, 0.0, 9.81]), atol=1e-5)
    turn = g.multiply(g.conjugate(before["attitude"], xp=np), after["attitude"], xp=np)
    np.testing.assert_allclose(now["rate"], g.to_rotation_vector(turn, xp=np) / (2 * h), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_it_starts_at_rest_and_then_moves_briskly_but_upright(seed):
    motion = trajectory(np.arange(0.0, 20.0, 0.01), seed=seed)
    assert np.abs(motion["velocity"][:100]).max() == 0.0
    assert np.abs(motion["rate"][:100]).max() == 0.0
    np.testing.assert_allclose(motion["position"][0], 0.0, atol=1e-12)
    acceleration = g.rotate(motion["attitude"], motion["force"], xp=np) - [0.0, 0.0, 9.81]
    assert 2.0 < np.linalg.norm(acceleration, axis=-1).max() < 15.0
    assert g.to_matrix(motion["attitude"], xp=np)[:, 2, 2].min() > 0.3
    steps = np.einsum("ni,ni->n", motion["attitude"][1:], motion["attitude"][:-1])
    assert steps.min() > 0.9  # the sign of the quaternion does not jump


def test_streams_have_their_rates_and_integer_times():
    flight = load(settings={"duration": "3", "imu.rate": 100, "vicon.rate": 10.0})
    imu, vicon = flight.streams["imu"], flight.streams["vicon"]
    assert imu.time.dtype == np.int64
    assert len(imu) == 301
    assert set(np.diff(imu.time)) == {10_000_000}
    assert set(np.diff(vicon.time)) == {100_000_000}
    assert flight.truth is not None
    assert (flight.truth.time == imu.time).all()


def test_noise_is_what_the_settings_say():
    flight = load(seed=5, settings={"duration": 100.0})
    imu, truth = flight.streams["imu"], flight.truth
    assert truth is not None
    motion = trajectory(imu.seconds, seed=5)
    white = imu.gyro - motion["rate"] - truth.gyro_bias
    np.testing.assert_allclose(white.std() / np.sqrt(200.0), DEFAULTS["gyro.noise"], rtol=0.02)
    steps = np.diff(truth.accelerometer_bias, axis=0)
    np.testing.assert_allclose(steps.std() * np.sqrt(200.0), DEFAULTS["accelerometer.walk"], rtol=0.02)
    errors = pose_errors(flight.streams["vicon"], truth, settle=0.0)
    np.testing.assert_allclose(errors["position_rmse_m"], np.sqrt(3) * 0.01, rtol=0.1)
    np.testing.assert_allclose(errors["attitude_rmse_deg"], np.degrees(np.sqrt(3) * 0.01), rtol=0.1)


def test_a_seed_repeats_and_settings_do_not_move_other_draws():
    first, again, other = load(seed=1), load(seed=1), load(seed=2)
    assert (first.streams["imu"].gyro == again.streams["imu"].gyro).all()
    assert (first.streams["imu"].gyro != other.streams["imu"].gyro).any()
    quiet = load(seed=1, settings={"accelerometer.noise": 0.0, "position.noise": 0.0})
    assert (quiet.streams["imu"].gyro == first.streams["imu"].gyro).all()
    assert (quiet.streams["vicon"].attitude == first.streams["vicon"].attitude).all()


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(UnknownNameError, match=r"vicon\.rate"):
        load(settings={"vicon_rate": 3})
    with pytest.raises(UnknownNameError, match="quadrotor"):
        load("helicopter")


@pytest.mark.parametrize("value", ["fast", "nan", "-1", "0", float("inf")])
def test_bad_settings_are_refused(value):
    with pytest.raises(DataError, match=r"setting 'imu\.rate' is not usable") as caught:
        load(settings={"imu.rate": value})
    assert "positive number" in str(caught.value)
    assert "imu.rate=200" in str(caught.value)
