"""The inertial filter's maths: Jacobians, covariances, updates, and a real flight."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from flowgraph.blocks.datasets import euroc
from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import (
    GRAVITY,
    ImuNoise,
    StartSpread,
    aid_attitude,
    aid_position,
    level_attitude,
    predict,
    start_belief,
)
from flowgraph.blocks.metrics import interpolate_pose
from flowgraph.blocks.signals import Attitude, Belief, Imu, Position, SpecificForce
from tests.bench import direct_eskf

NONE = ImuNoise(0.0, 0.0, 0.0, 0.0)
NOISE = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
LEVER = (0.3, -0.2, 0.1)


def a_belief(seed: int, dtype: type = np.float64) -> Belief:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    root = rng.normal(size=(15, 15)) * 0.1
    parts = rng.normal(size=3), rng.normal(size=3), q / np.linalg.norm(q)
    biases = rng.normal(size=3) * 0.05, rng.normal(size=3) * 0.2
    return Belief(*(x.astype(dtype) for x in (*parts, *biases, root @ root.T)))


def an_imu(seed: int, dtype: type = np.float64) -> Imu:
    rng = np.random.default_rng(seed + 100)
    return Imu(gyro=rng.normal(size=3).astype(dtype), specific_force=(rng.normal(size=3) * 8).astype(dtype))


def moved(belief: Belief, error: np.ndarray) -> Belief:
    """The belief with an error put into its nominal state."""
    return Belief(
        position=belief.position + error[0:3],
        velocity=belief.velocity + error[3:6],
        attitude=g.multiply(belief.attitude, g.from_rotation_vector(error[6:9], xp=np), xp=np),
        gyro_bias=belief.gyro_bias + error[9:12],
        accelerometer_bias=belief.accelerometer_bias + error[12:15],
        covariance=belief.covariance,
    )


def difference(a: Belief, b: Belief) -> np.ndarray:
    """The error that makes b of a."""
    turn = g.to_rotation_vector(g.multiply(g.conjugate(a.attitude, xp=np), b.attitude, xp=np), xp=np)
    return np.concatenate(
        [
            b.position - a.position,
            b.velocity - a.velocity,
            turn,
            b.gyro_bias - a.gyro_bias,
            b.accelerometer_bias - a.accelerometer_bias,
        ]
    )


def differences(function, size: float = 1e-6) -> np.ndarray:
    """The Jacobian of a function of a 15-vector at zero, by central differences."""
    columns = [(function(size * e) - function(-size * e)) / (2 * size) for e in np.eye(15)]
    return np.stack(columns, axis=-1)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("dt", [0.001, 0.005, 0.02])
def test_covariance_moves_by_the_jacobian_of_the_step(seed, dt):
    belief, imu = a_belief(seed), an_imu(seed)
    step = lambda b: predict.step(b, imu, noise=NONE, dt=dt, xp=np)
    base = step(belief)
    F = differences(lambda e: difference(base, step(moved(belief, e))))
    # without noise P' = F P F^T; F itself neglects terms of third order in w dt
    np.testing.assert_allclose(base.covariance, F @ belief.covariance @ F.T, atol=max(1e-8, dt**3))


@pytest.mark.parametrize("seed", range(3))
def test_no_time_changes_nothing(seed):
    belief = a_belief(seed)
    after = predict.step(belief, an_imu(seed), noise=NOISE, dt=0.0, xp=np)
    assert np.abs(difference(belief, after)).max() < 1e-15
    np.testing.assert_allclose(after.covariance, belief.covariance, atol=1e-16)


def test_at_rest_the_nominal_state_stays():
    belief = start_belief((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    after = predict.step(belief, Imu.at_rest(), noise=NOISE, dt=0.01, xp=np)
    assert np.abs(difference(belief, after)).max() < 1e-15


def test_noise_grows_as_the_continuous_model_says():
    """Small steps approach the integral of white acceleration: t^3/3, t^2/2, t in position and velocity."""
    noise, seconds, n = ImuNoise(0.0, 0.1, 0.0, 0.0), 2.0, 400
    belief = start_belief(np.zeros(3), (1.0, 0.0, 0.0, 0.0), spread=StartSpread(*[0.0] * 6))
    for _ in range(n):
        belief = predict.step(belief, Imu.at_rest(), noise=noise, dt=seconds / n, xp=np)
    P, q = belief.covariance, 0.1**2
    np.testing.assert_allclose(
        [P[0, 0], P[0, 3], P[3, 3]], [q * seconds**3 / 3, q * seconds**2 / 2, q * seconds], rtol=1e-4
    )


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_covariance_stays_symmetric_positive_and_of_its_precision(dtype):
    belief = a_belief(1, dtype)
    for k in range(200):
        belief = predict.step(belief, an_imu(k, dtype), noise=NOISE, dt=0.005, xp=np)
        if k % 10 == 0:
            z = Position(position=belief.position + dtype(0.01))
            belief, innovation = aid_position.step(belief, z, noise=0.003, lever=LEVER, xp=np)
            assert innovation is not None
    P = belief.covariance
    assert all(getattr(belief, name).dtype == dtype for name in belief._fields)
    assert (P == P.T).all()
    assert np.linalg.eigvalsh(P.astype(float)).min() > -10 * np.finfo(dtype).eps * np.abs(P).max()
    assert abs(np.linalg.norm(belief.attitude) - 1.0) < 10 * np.finfo(dtype).eps


@pytest.mark.parametrize("seed", range(4))
def test_position_update_is_the_textbook_one(seed):
    prior = a_belief(seed)
    z = prior.position + g.rotate(prior.attitude, np.array(LEVER), xp=np) + [0.02, -0.01, 0.03]
    post, innovation = aid_position.step(prior, Position(position=z), noise=0.1, lever=LEVER, xp=np)

    def predicted(error):
        state = moved(prior, error)
        return state.position + g.rotate(state.attitude, np.array(LEVER), xp=np)

    H = differences(predicted)
    P = prior.covariance
    S = H @ P @ H.T + 0.01 * np.eye(3)
    K = P @ H.T @ np.linalg.inv(S)
    np.testing.assert_allclose(innovation.covariance, S, atol=1e-8)
    np.testing.assert_allclose(innovation.residual, [0.02, -0.01, 0.03], atol=1e-12)
    np.testing.assert_allclose(
        innovation.nis, innovation.residual @ np.linalg.solve(S, innovation.residual), rtol=1e-6
    )
    d = K @ innovation.residual
    np.testing.assert_allclose(difference(prior, post), d, atol=1e-8)
    G = np.eye(15)
    G[6:9, 6:9] -= g.skew(d[6:9] / 2, xp=np)
    np.testing.assert_allclose(post.covariance, G @ (np.eye(15) - K @ H) @ P @ G.T, atol=1e-7)


@pytest.mark.parametrize("seed", range(4))
def test_attitude_update_goes_towards_the_measurement(seed):
    prior = a_belief(seed)
    error = np.array([0.02, -0.01, 0.015])
    mount = (0.5, 0.5, 0.5, 0.5)
    measured = g.multiply(prior.attitude, g.from_rotation_vector(error, xp=np), xp=np)
    seen = Attitude(attitude=g.multiply(measured, np.array(mount), xp=np))
    post, innovation = aid_attitude.step(prior, seen, noise=1e-5, mount=mount, xp=np)
    np.testing.assert_allclose(innovation.residual, error, atol=1e-12)
    assert g.geodesic_angle(post.attitude, measured) < 1e-4
    S = prior.covariance[6:9, 6:9] + np.eye(3) * 1e-10
    np.testing.assert_allclose(innovation.covariance, S, atol=1e-12)


@pytest.mark.parametrize("aid", [aid_position, aid_attitude])
def test_without_a_measurement_the_prior_passes_through(aid):
    prior = a_belief(0)
    assert aid.step(prior, None, noise=0.1, xp=np) == (prior, None)


def test_gate_keeps_an_outlier_out():
    prior = a_belief(2)
    far = Position(position=prior.position + 1000.0)
    post, innovation = aid_position.step(prior, far, noise=0.1, gate=16.3, xp=np)
    assert innovation.nis > 16.3
    np.testing.assert_allclose(difference(prior, post), 0.0, atol=1e-15)
    np.testing.assert_allclose(post.covariance, prior.covariance, atol=1e-15)


def test_batches_are_rows():
    many = [a_belief(s) for s in range(3)]
    stacked = Belief(*(np.stack([getattr(b, n) for b in many]) for n in Belief._fields))
    imus = Imu(*(np.stack([getattr(an_imu(s), n) for s in range(3)]) for n in Imu._fields))
    ahead = predict.step(stacked, imus, noise=NOISE, dt=0.01, xp=np)
    z = Position(position=stacked.position + 0.1)
    post, innovation = aid_position.step(ahead, z, noise=0.1, lever=LEVER, gate=1e9, xp=np)
    for s, one in enumerate(many):
        single = predict.step(one, an_imu(s), noise=NOISE, dt=0.01, xp=np)
        single, alone = aid_position.step(
            single, Position(position=one.position + 0.1), noise=0.1, lever=LEVER, xp=np
        )
        for name in Belief._fields:
            np.testing.assert_allclose(getattr(post, name)[s], getattr(single, name), atol=1e-13)
        np.testing.assert_allclose(innovation.nis[s], alone.nis, rtol=1e-9)


def test_noise_per_sample_and_scaled():
    noise = ImuNoise.per_sample(100.0, gyro=4.0, accelerometer=9.0, gyro_bias=0.01, accelerometer_bias=0.04)
    np.testing.assert_allclose(
        [noise.gyro, noise.accelerometer, noise.gyro_bias, noise.accelerometer_bias], [0.2, 0.3, 1.0, 2.0]
    )
    assert noise.scaled(gyro=10.0) == ImuNoise(noise.gyro * 10.0, *list(vars(noise).values())[1:])
    with pytest.raises(ValueError, match="rate > 0"):
        ImuNoise.per_sample(0.0, gyro=1.0, accelerometer=1.0)


def test_levelling_keeps_the_heading_of_its_reference():
    reference = g.from_rotation_vector(np.array([0.0, 0.0, 0.7]), xp=np)
    tilted = g.multiply(reference, g.from_rotation_vector(np.array([0.1, -0.2, 0.0]), xp=np), xp=np)
    force = -np.array(GRAVITY) @ g.to_matrix(tilted, xp=np)
    out = level_attitude.step(SpecificForce(force=force), nearest=tuple(reference.tolist()), xp=np)
    tilt, _ = g.tilt_and_heading(out.attitude, tilted)
    assert tilt < 1e-6
    assert g.geodesic_angle(out.attitude, tilted) < 2.0


def test_start_belief_spreads_tilt_and_heading_about_world_axes():
    q = g.from_rotation_vector(np.array([1.0, 2.0, -0.5]), xp=np)
    P = start_belief(np.zeros(3), q, spread=StartSpread(tilt=0.1, heading=0.3)).covariance[6:9, 6:9]
    R = g.to_matrix(q, xp=np)
    np.testing.assert_allclose(R @ P @ R.T, np.diag([0.01, 0.01, 0.09]), atol=1e-12)


def test_a_real_flight_stays_within_its_bounds_and_the_direct_filter_agrees():
    """30 s of a EuRoC flight: the blocks and the hand-written loop give one estimate, near the truth."""
    root = Path(__file__).resolve().parents[3]
    data = Path(os.environ.get("FLOWGRAPH_DATA", root.parent / "shared" / "datasets"))
    if not (data / "euroc" / "MH_01_easy").is_dir():
        pytest.skip("the EuRoC sequence MH_01_easy is not here; set FLOWGRAPH_DATA to the folder of datasets")
    flight = euroc.load(str(data / "euroc" / "MH_01_easy"), settings={"leica.time_offset": -0.135})
    imu, leica, truth = flight.streams["imu"], flight.streams["leica"], flight.truth
    assert truth is not None
    end = truth.time[0] + 30_000_000_000
    imu = imu[(imu.time >= truth.time[0]) & (imu.time <= end)]
    leica = leica[(leica.time >= imu.time[0]) & (leica.time <= end)]
    noise = flight.info["imu_noise"].scaled(gyro=15.0, accelerometer=20.0)
    start = start_belief(
        truth.position[0], truth.attitude[0], specific_force=imu.specific_force[0], spread=StartSpread()
    )
    time, imu_index, position_index = direct_eskf.ticks(imu.time, leica.time)
    states, covariances, nis = direct_eskf.run(
        time,
        imu_index,
        position_index,
        np.concatenate([imu.gyro, imu.specific_force], axis=-1),
        leica.position,
        start=tuple(getattr(start, name) for name in Belief._fields),
        densities=(noise.gyro, noise.accelerometer, noise.gyro_bias, noise.accelerometer_bias),
        position_noise=0.004,
        lever=flight.info["leica_lever"],
    )
    belief, before, found = start, int(time[0]), []
    for k in range(2000):
        held = imu[int(imu_index[: k + 1].max())]
        belief = predict.step(belief, held, noise=noise, dt=(int(time[k]) - before) * 1e-9, xp=np)
        z = leica[int(position_index[k])] if position_index[k] >= 0 else None
        belief, _ = aid_position.step(belief, z, noise=0.004, lever=flight.info["leica_lever"], xp=np)
        before = int(time[k])
        found.append(np.concatenate([getattr(belief, name) for name in Belief._fields[:5]]))
    np.testing.assert_allclose(found, states[:2000], atol=1e-9)
    np.testing.assert_allclose(belief.covariance, covariances[1999], atol=1e-12)

    settled = time >= time[0] + 1_000_000_000
    position, attitude = interpolate_pose(truth, time[settled])
    error = states[settled, :3] - position
    tilt, heading = g.tilt_and_heading(states[settled, 6:10], attitude)
    assert np.sqrt((error**2).sum(-1).mean()) < 0.0075
    assert np.sqrt((tilt**2).mean()) < 0.5
    assert np.sqrt((heading**2).mean()) < 3.0
    sigma = np.sqrt(np.einsum("nii->ni", covariances[settled][:, :3, :3]))
    assert (np.abs(error) <= 3.0 * sigma).mean() > 0.98
    assert np.nanmean(nis) < 4.0
