"""Particles and the Kalman filter that each carries, against textbook forms one particle at a time."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, multivariate_normal

from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import GRAVITY, StartSpread, subtract_rest_bias
from flowgraph.blocks.particles import (
    attitude_likelihood,
    average_attitude,
    average_pose,
    correct_motion,
    dominant_eigenvector,
    effective_sample_size,
    predict_motion,
    propagate_attitude,
    reweight,
    start_cloud,
    weights,
)
from flowgraph.blocks.signals import Attitude, Cloud, Imu, LogLikelihood, Pose, Weights
from flowgraph.recorder.random import NumpyDraw, seed_words

N = 5
READING = Imu(gyro=np.array([0.3, -0.2, 1.0]), specific_force=np.array([1.0, 0.5, 9.0]))
MEASURED = Pose(position=np.array([0.2, -0.1, 0.3]), attitude=np.array([0.8, 0.0, 0.6, 0.0]))


def a_cloud(seed: int = 0, n: int = N) -> Cloud:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(4, n))
    root = rng.normal(size=(n, 6, 6)) * 0.3
    P = np.moveaxis(root @ root.mT, 0, -1)
    w = rng.random(n)
    return Cloud(
        log_weight=np.log(w / w.sum()),
        attitude=q / np.linalg.norm(q, axis=0),
        velocity=rng.normal(size=(3, n)),
        position=rng.normal(size=(3, n)),
        velocity_covariance=P[:3, :3],
        cross_covariance=P[3:, :3],
        position_covariance=P[3:, 3:],
    )


def motion(cloud: Cloud, i: int) -> tuple[np.ndarray, np.ndarray]:
    """Mean (6) and covariance (6, 6) of (velocity, position) of one particle."""
    V, C, P = cloud.velocity_covariance, cloud.cross_covariance, cloud.position_covariance
    mean = np.concatenate([cloud.velocity[:, i], cloud.position[:, i]])
    return mean, np.block([[V[..., i], C[..., i].T], [C[..., i], P[..., i]]])


def draw(time: int = 0) -> NumpyDraw:
    return NumpyDraw("test", seed_words(1), time)


def test_attitudes_turn_by_the_rate_and_a_drawn_error():
    n, dt, density = 20_000, 0.04, 0.5
    start = start_cloud(n, attitude=(1.0, 0.0, 0.0, 0.0), spread=StartSpread(tilt=0.0, heading=0.0))
    turned = propagate_attitude.step(start, READING, gyro_noise=density, dt=dt, draw=draw(), xp=np)
    turn = g.to_rotation_vector(turned.attitude.T, xp=np)
    assert turn.mean(axis=0) == pytest.approx(READING.gyro * dt, abs=5 * density * np.sqrt(dt / n))
    assert np.cov(turn.T) == pytest.approx(density**2 * dt * np.eye(3), abs=5 * density**2 * dt / np.sqrt(n))
    assert turned.velocity is start.velocity
    np.testing.assert_allclose(np.linalg.norm(turned.attitude, axis=0), 1.0, atol=1e-15)


def test_the_first_firing_predicts_nothing():
    cloud = a_cloud()
    after = propagate_attitude.step(cloud, READING, gyro_noise=1.0, dt=0.0, draw=draw(), xp=np)
    after = predict_motion.step(after, READING, accelerometer_noise=1.0, dt=0.0, xp=np)
    for name, field in cloud.__dict__.items():
        np.testing.assert_allclose(getattr(after, name), field, atol=1e-15, err_msg=name)


@pytest.mark.parametrize("noise", [0.7, (0.3, 0.7, 1.1)])
def test_motion_is_predicted_as_by_one_kalman_filter_a_particle(noise):
    cloud, dt = a_cloud(), 0.3
    after = predict_motion.step(cloud, READING, accelerometer_noise=noise, dt=dt, xp=np)
    F = np.block([[np.eye(3), np.zeros((3, 3))], [dt * np.eye(3), np.eye(3)]])
    B = np.concatenate([dt * np.eye(3), 0.5 * dt**2 * np.eye(3)])
    for i in range(N):
        mean, P = motion(cloud, i)
        R = g.to_matrix(cloud.attitude[:, i], xp=np)
        W = R @ np.diag(np.square(np.broadcast_to(noise, 3))) @ R.T
        Q = np.block([[W * dt, W * dt**2 / 2], [W * dt**2 / 2, W * dt**3 / 3]])
        expected_mean = F @ mean + B @ (R @ READING.specific_force + GRAVITY)
        found_mean, found = motion(after, i)
        np.testing.assert_allclose(found_mean, expected_mean, atol=1e-13)
        np.testing.assert_allclose(found, F @ P @ F.T + Q, atol=1e-13)


@pytest.mark.parametrize("lever", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.1)])
def test_motion_is_corrected_as_by_one_kalman_filter_a_particle(lever):
    cloud, sigma = a_cloud(), 0.2
    after, likelihood = correct_motion.step(cloud, MEASURED, noise=sigma, lever=lever, xp=np)
    H = np.concatenate([np.zeros((3, 3)), np.eye(3)], axis=1)
    for i in range(N):
        mean, P = motion(cloud, i)
        arm = g.to_matrix(cloud.attitude[:, i], xp=np) @ lever
        S = H @ P @ H.T + sigma**2 * np.eye(3)
        K = P @ H.T @ np.linalg.inv(S)
        found_mean, found = motion(after, i)
        np.testing.assert_allclose(found_mean, mean + K @ (MEASURED.position - H @ mean - arm), atol=1e-12)
        np.testing.assert_allclose(found, (np.eye(6) - K @ H) @ P, atol=1e-12)
        expected = multivariate_normal(H @ mean + arm, S).logpdf(MEASURED.position)
        assert likelihood.value[i] == pytest.approx(expected, abs=1e-9)


def test_the_likelihood_of_an_attitude_is_normal_in_the_rotation_vector():
    cloud = a_cloud()
    found = attitude_likelihood.step(cloud, MEASURED, noise=0.4, xp=np).value
    for i in range(N):
        relative = g.multiply(g.conjugate(cloud.attitude[:, i], xp=np), MEASURED.attitude, xp=np)
        error = g.to_rotation_vector(relative, xp=np)
        assert found[i] == pytest.approx(multivariate_normal(np.zeros(3), 0.16 * np.eye(3)).logpdf(error))


@pytest.mark.parametrize("noise", [0.01, 0.05, 0.15, 1.0])
def test_attitudes_that_are_far_from_the_best_are_64_behind_it(noise):
    cloud = start_cloud(400, attitude=MEASURED.attitude, spread=StartSpread(tilt=0.05, heading=1.5))
    signs = np.where(np.arange(400) % 2 == 1, -1.0, 1.0)  # q and -q are one attitude
    cloud = cloud.replace(attitude=cloud.attitude * signs)
    found = attitude_likelihood.step(cloud, MEASURED, noise=noise, xp=np).value
    back = g.conjugate(cloud.attitude.T, xp=np)
    error = g.to_rotation_vector(g.multiply(back, MEASURED.attitude, xp=np), xp=np)
    expected = multivariate_normal(np.zeros(3), noise**2 * np.eye(3)).logpdf(error)
    far = expected < expected.max() - 64.0
    assert (far.sum() > 20) == (noise < 0.3)
    np.testing.assert_allclose(found, np.maximum(expected, expected.max() - 64.0), rtol=1e-9, atol=1e-9)


def test_an_attitude_that_was_not_measured_tells_no_particle_from_another():
    half = MEASURED.replace(attitude=np.array([0.8, np.nan, 0.6, 0.0]))
    found = attitude_likelihood.step(a_cloud(n=50), half, noise=0.01, xp=np).value
    np.testing.assert_array_equal(found, found[0])
    assert np.isfinite(found[0])


def test_weights_stay_normalised_however_unlikely_all_particles_are():
    cloud = a_cloud()
    hopeless = LogLikelihood(value=np.array([-1e4, -1e4 - 1.0, -2e4, -3e4, -1e6]))
    nothing = LogLikelihood(value=np.zeros(N))
    weight = np.exp(reweight.step(cloud, hopeless, nothing, xp=np).log_weight)
    assert weight.sum() == pytest.approx(1.0, abs=1e-11)  # a logarithm of 1e4 is rounded by 1e-12
    before = np.exp(cloud.log_weight)
    assert weight[1] / weight[0] == pytest.approx(before[1] / before[0] * np.exp(-1.0), rel=1e-9)


def test_the_effective_sample_size_lies_between_one_and_all():
    cloud = a_cloud()
    size = lambda w: effective_sample_size.step(cloud.replace(log_weight=np.log(w)), xp=np)
    assert size(np.full(N, 1.0 / N)) == pytest.approx(N)
    assert size(np.array([1.0, 1e-300, 1e-300, 1e-300, 1e-300])) == pytest.approx(1.0)
    assert size(np.array([0.5, 0.5, 1e-300, 1e-300, 1e-300])) == pytest.approx(2.0)


@pytest.mark.parametrize("spread", [0.01, 0.3, 0.8])
def test_the_average_attitude_is_the_dominant_eigenvector(spread):
    middle = np.array([0.1, -0.7, 0.5, 0.5])
    cloud = start_cloud(200, attitude=middle / np.linalg.norm(middle), spread=StartSpread(tilt=spread))
    w = np.random.default_rng(0).random(200)
    given = Weights(weight=w / w.sum())
    found = average_attitude.step(cloud, given, xp=np).attitude
    _, vectors = np.linalg.eigh((cloud.attitude * given.weight) @ cloud.attitude.T)
    assert abs(found @ vectors[:, -1]) == pytest.approx(1.0, abs=1e-14)
    signs = np.where(np.arange(200) % 3 == 1, -1.0, 1.0)  # q and -q are one attitude
    again = average_attitude.step(cloud.replace(attitude=cloud.attitude * signs), given, xp=np).attitude
    np.testing.assert_allclose(again, found, atol=1e-14)


def test_an_average_over_all_headings_is_still_an_attitude():
    cloud = start_cloud(100)
    found = average_attitude.step(cloud, weights.step(cloud, xp=np), xp=np).attitude
    assert np.linalg.norm(found) == pytest.approx(1.0)
    assert np.all(np.isfinite(found))


def test_the_average_pose_is_the_weighted_mean():
    cloud = a_cloud()
    weight = weights.step(cloud, xp=np)
    pose = average_pose.step(cloud, weight, Attitude(attitude=MEASURED.attitude))
    np.testing.assert_allclose(pose.position, np.average(cloud.position, axis=1, weights=weight.weight))
    np.testing.assert_allclose(pose.velocity, np.average(cloud.velocity, axis=1, weights=weight.weight))


def test_an_unknown_yaw_is_spread_over_the_circle():
    n = 500
    cloud = start_cloud(n, seed=3)
    yaw = 2.0 * np.arctan2(cloud.attitude[3], cloud.attitude[0])
    np.testing.assert_array_equal(np.floor(yaw / (2.0 * np.pi) * n), np.arange(n))  # one in each arc
    assert kstest(yaw / (2.0 * np.pi) * n % 1.0, "uniform").pvalue > 1e-3
    np.testing.assert_array_equal(cloud.attitude[1:3], 0.0)
    np.testing.assert_array_equal(start_cloud(n, seed=3).attitude, cloud.attitude)
    assert not np.array_equal(start_cloud(n, seed=4).attitude, cloud.attitude)


def test_a_given_attitude_is_spread_about_the_world_axes():
    spread = StartSpread(tilt=0.02, heading=0.1, position=0.5, velocity=0.3)
    cloud = start_cloud(20_000, attitude=MEASURED.attitude, position=(1.0, 2.0, 3.0), spread=spread)
    turn = g.world_error(cloud.attitude.T, np.broadcast_to(MEASURED.attitude, (20_000, 4)))
    assert turn.std(axis=0) == pytest.approx([0.02, 0.02, 0.1], rel=0.05)
    np.testing.assert_array_equal(cloud.position[:, 7], [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(cloud.position_covariance[..., 7], np.eye(3) * 0.25)
    np.testing.assert_array_equal(cloud.velocity_covariance[..., 7], np.eye(3) * 0.3**2)


def test_a_bias_is_the_mean_reading_at_rest_and_then_stays():
    rng = np.random.default_rng(0)
    bias, level = np.array([0.1, 0.2, 0.3, -0.1, -0.2, 0.4]), np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    state = subtract_rest_bias.initial([None], {})
    seen = []
    for k in range(300):
        moving = np.ones(6) if k > 200 else np.zeros(6)
        reading = level + bias + moving + 0.01 * rng.normal(size=6)
        seen.append(reading)
        state, out = subtract_rest_bias.step(
            state,
            Imu(gyro=reading[:3], specific_force=reading[3:]),
            seconds=1.0,
            t=10**9 + k * 5_000_000,
            xp=np,
        )
        mean = np.mean(seen[:201], axis=0) - level  # so far, and no more than the first second
        np.testing.assert_allclose(np.concatenate([out.gyro, out.specific_force]), reading - mean, atol=1e-13)
    assert state["count"] == 201
    assert state["bias"] == pytest.approx(bias, abs=5 * 0.01 / np.sqrt(201))


def test_the_average_attitude_needs_no_lucky_first_particle():
    identity, turned = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
    np.testing.assert_allclose(dominant_eigenvector(np.outer(identity, identity), turned, xp=np), identity)
    M = 0.01 * np.outer(turned, turned) + 0.99 * np.outer(identity, identity)
    np.testing.assert_allclose(dominant_eigenvector(M, turned, xp=np), identity, atol=1e-12)
    for kind in (np.float32, np.float64):
        alike = dominant_eigenvector(
            np.full(4, 0.25, dtype=kind) * np.eye(4, dtype=kind), turned.astype(kind), xp=np
        )
        np.testing.assert_allclose(alike, turned)
