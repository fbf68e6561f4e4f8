"""The outdoor cloud: each step against a Kalman filter of one particle with a numerical Jacobian, and the
draw against the Gaussian that it is drawn from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import GRAVITY, ImuNoise
from flowgraph.blocks.outdoor import (
    cloud_biases,
    correct_distance,
    correct_field,
    correct_flow,
    correct_position,
    predict_outdoor,
    take_picture,
)
from flowgraph.blocks.signals import Imu, MagneticField, OpticalFlow, OutdoorCloud, Position, Range, Weights
from flowgraph.recorder.random import NumpyDraw, seed_words

N = 4
EARTH = np.array([0.0, 25e-6, -43e-6])
READING = Imu(gyro=np.array([0.3, -1.2, 0.7]), specific_force=np.array([1.0, -2.0, 12.0]))
LEVER = (0.3, -0.2, 0.1)

State = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Motion (9), attitude (4) and picture (4) of one particle."""


def a_cloud(seed: int = 0, n: int = N) -> OutdoorCloud:
    rng = np.random.default_rng(seed)
    unit = lambda q: q / np.linalg.norm(q, axis=0)
    attitude = unit(np.array([[1.0], [0.2], [-0.3], [0.4]]) + 0.1 * rng.normal(size=(4, n)))
    root = rng.normal(size=(n, 12, 12)) * np.repeat([0.2, 0.01], [9, 3])[:, None]
    motion = rng.normal(size=(9, n))
    motion[5] = 4.0 + 0.3 * rng.normal(size=n)
    w = rng.random(n)
    return OutdoorCloud(
        log_weight=np.log(w / w.sum()),
        attitude=attitude,
        picture=unit(attitude + 0.02 * rng.normal(size=(4, n))),
        motion=motion,
        covariance=np.moveaxis(root @ root.mT, 0, -1),
    )


def one(cloud: OutdoorCloud, i: int) -> State:
    return cloud.motion[:, i], cloud.attitude[:, i], cloud.picture[:, i]


def shifted(state: State, d: np.ndarray) -> State:
    """The state with the error d (12) put in: the turn in the world, on the left."""
    motion, attitude, picture = state
    return motion + d[:9], g.multiply(g.from_rotation_vector(d[9:], xp=np), attitude, xp=np), picture


def jacobian(f: Callable[[np.ndarray], np.ndarray], size: int = 12) -> np.ndarray:
    step = 1e-5
    return np.stack([(f(d) - f(-d)) / (2.0 * step) for d in np.eye(size) * step], axis=1)


def turn_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The world rotation vector from attitude a to b."""
    return g.to_rotation_vector(g.multiply(b, g.conjugate(a, xp=np), xp=np), xp=np)


def carried(state: State, dt: float, reading: Imu = READING) -> State:
    motion, q, picture = state
    half = g.from_rotation_vector(reading.gyro * (0.5 * dt), xp=np)
    middle = g.multiply(q, half, xp=np)
    a = g.rotate(middle, reading.specific_force, xp=np) + GRAVITY
    path = motion[:3] * dt + 0.5 * a * dt**2
    return motion + np.concatenate([a * dt, path, path]), g.multiply(middle, half, xp=np), picture


def test_prediction_is_that_of_one_kalman_filter_a_particle():
    noise, dt, cloud = ImuNoise(0.3, 0.7, 0.0, 0.0), 0.05, a_cloud()
    after = predict_outdoor.step(cloud, READING, noise=noise, dt=dt, xp=np)
    G = np.concatenate([np.eye(3), np.zeros((9, 3))])
    E = np.concatenate([np.zeros((9, 3)), np.eye(3)])
    path = np.concatenate([np.zeros((3, 3)), np.eye(3), np.eye(3), np.zeros((3, 3))])
    Q = dt * G @ G.T + dt**2 / 2 * (G @ path.T + path @ G.T) + dt**3 / 3 * path @ path.T
    half = 0.5 * dt * noise.gyro**2 * E @ E.T
    for i in range(N):
        state = one(cloud, i)
        motion, attitude, _ = expected = carried(state, dt)

        def off(d: np.ndarray, state: State = state, expected: State = expected) -> np.ndarray:
            moved = carried(shifted(state, d), dt)
            return np.concatenate([moved[0] - expected[0], turn_between(expected[1], moved[1])])

        F = jacobian(off)
        np.testing.assert_allclose(after.motion[:, i], motion, atol=1e-13)
        np.testing.assert_allclose(after.attitude[:, i], attitude, atol=1e-13)
        found = F @ (cloud.covariance[..., i] + half) @ F.T + half + Q * noise.accelerometer**2
        np.testing.assert_allclose(after.covariance[..., i], found, atol=1e-8)


def test_with_biases_the_prediction_is_that_of_one_kalman_filter_a_particle():
    noise, dt, rng = ImuNoise(0.3, 0.7, 0.02, 0.05), 0.02, np.random.default_rng(4)
    root = rng.normal(size=(N, 18, 18)) * np.repeat([0.2, 0.01, 0.02, 0.2], [9, 3, 3, 3])[:, None]
    biases, plain = rng.normal(size=(6, N)) * 0.3, a_cloud()
    cloud = plain.replace(
        motion=np.concatenate([plain.motion, biases]), covariance=np.moveaxis(root @ root.mT, 0, -1)
    )
    after = predict_outdoor.step(cloud, READING, noise=noise, dt=dt, xp=np)
    still = plain.replace(covariance=0.0 * plain.covariance)
    Q = np.pad(
        predict_outdoor.step(still, READING, noise=ImuNoise(0.0, 0.7, 0.0, 0.0), dt=dt, xp=np).covariance,
        ((0, 6), (0, 6), (0, 0)),
    )
    walk = np.diag(np.repeat([0.0, 0.02**2, 0.05**2], [12, 3, 3])) * dt
    half = np.diag(np.repeat([0.0, 0.5 * dt * noise.gyro**2, 0.0], [9, 3, 6]))
    for i in range(N):
        state, b = one(plain, i), biases[:, i]

        def go(d: np.ndarray, state: State = state, b: np.ndarray = b) -> State:
            gyro, force = READING.gyro - b[:3] - d[12:15], READING.specific_force - b[3:] - d[15:]
            return carried(shifted(state, d[:12]), dt, Imu(gyro=gyro, specific_force=force))

        motion, attitude, _ = go(np.zeros(18))
        np.testing.assert_allclose(after.motion[:, i], np.concatenate([motion, b]), atol=1e-13)
        np.testing.assert_allclose(after.attitude[:, i], attitude, atol=1e-13)

        def off(
            d: np.ndarray, go: Any = go, motion: np.ndarray = motion, q: np.ndarray = attitude
        ) -> np.ndarray:
            moved = go(d)
            return np.concatenate([moved[0] - motion, turn_between(q, moved[1]), d[12:]])

        F = jacobian(off, 18)
        found = F @ (cloud.covariance[..., i] + half) @ F.T + half + Q[..., i] + walk
        np.testing.assert_allclose(after.covariance[..., i], found, atol=1e-6)


def test_a_draw_of_the_attitude_conditions_the_biases():
    """What is left of them, and how far they moved, over many particles is what there was of them before."""
    n, rng = 10_000, np.random.default_rng(1)
    root = np.tril(rng.normal(size=(18, 18))) * 0.1
    P = root @ root.T
    cloud = OutdoorCloud(
        log_weight=np.full(n, -np.log(n)),
        attitude=np.repeat([[1.0], [0.0], [0.0], [0.0]], n, axis=1),
        picture=np.repeat([[1.0], [0.0], [0.0], [0.0]], n, axis=1),
        motion=np.zeros((15, n)),
        covariance=np.repeat(P[:, :, None], n, axis=2),
    )
    after = take_picture.step(cloud, True, draw=NumpyDraw("test", seed_words(1), 0), xp=np)
    left, moved = after.covariance[12:, 12:, 0], np.cov(after.motion[9:])
    np.testing.assert_allclose(left + moved, P[12:, 12:], atol=0.04 * np.abs(P).max())
    assert np.trace(left) < 0.9 * np.trace(P[12:, 12:])
    weights = Weights(weight=np.exp(after.log_weight))
    told = cloud_biases.step(after, weights, xp=np)
    np.testing.assert_allclose(told.covariance, P[12:, 12:], atol=0.04 * np.abs(P).max())


def test_the_first_firing_predicts_nothing():
    cloud = a_cloud()
    after = predict_outdoor.step(cloud, READING, noise=ImuNoise(0.3, 0.7, 0.0, 0.0), dt=0.0, xp=np)
    for name, field in cloud.__dict__.items():
        np.testing.assert_allclose(getattr(after, name), field, atol=1e-15, err_msg=name)


def position(state: State) -> np.ndarray:
    return state[0][3:6] + g.rotate(state[1], np.array(LEVER), xp=np)


def distance(state: State) -> np.ndarray:
    return state[0][5:6] / g.to_matrix(state[1], xp=np)[2, 2]


def field(state: State) -> np.ndarray:
    return g.to_matrix(state[1], xp=np).T @ EARTH / 5e-7


SENSORS = {
    "position": (position, np.array([0.4, -0.3, 4.2]), 0.3),
    "distance": (distance, np.array([6.0]), 0.1),
    "field": (field, np.array([10.0, 60.0, -80.0]), 1.0),
}


def sensed(name: str, cloud: OutdoorCloud, z: np.ndarray, noise: float) -> OutdoorCloud:
    earth = tuple(EARTH)
    _, (after, _) = {
        "position": lambda: correct_position.step(
            0.0, cloud, Position(position=z), noise=noise, lever=LEVER, xp=np
        ),
        "distance": lambda: correct_distance.step(0.0, cloud, Range(distance=z[0]), noise=noise, xp=np),
        "field": lambda: correct_field.step(
            0.0, cloud, MagneticField(field=z * 5e-7), earth=earth, noise=5e-7, xp=np
        ),
    }[name]()
    return after


def flowed(cloud: OutdoorCloud, flow: OpticalFlow, turn: float) -> OutdoorCloud:
    _, (after, _) = correct_flow.step(0.0, cloud, flow, displacement=0.05, turn=turn, xp=np)
    return after


def check_update(
    cloud: OutdoorCloud, after: OutdoorCloud, minus: Callable[[State], np.ndarray], R: np.ndarray
) -> None:
    """One Kalman update with the residual `minus` (of a state), whose noise has the covariance R."""
    log_weight = np.empty(N)
    for i in range(N):
        state, P = one(cloud, i), cloud.covariance[..., i]

        def moved(d: np.ndarray, state: State = state) -> np.ndarray:
            return minus(shifted(state, d))

        H = -jacobian(moved)
        S = H @ P @ H.T + R
        K = P @ H.T @ np.linalg.inv(S)
        r = minus(state)
        motion, attitude, _ = shifted(state, K @ r)
        np.testing.assert_allclose(after.motion[:, i], motion, atol=2e-6)
        np.testing.assert_allclose(np.abs(after.attitude[:, i] @ attitude), 1.0, atol=1e-10)
        np.testing.assert_allclose(after.covariance[..., i], P - K @ S @ K.T, atol=2e-6)
        log_weight[i] = cloud.log_weight[i] + multivariate_normal(np.zeros(len(r)), S).logpdf(r)
    expected = log_weight - np.log(np.exp(log_weight - log_weight.max()).sum()) - log_weight.max()
    np.testing.assert_allclose(after.log_weight, expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("name", SENSORS)
def test_a_sensor_corrects_as_one_kalman_filter_a_particle(name):
    h, z, noise = SENSORS[name]
    cloud = a_cloud(1)
    after = sensed(name, cloud, z, noise)
    check_update(cloud, after, lambda state: z - h(state), np.eye(len(z)) * noise**2)


def test_optical_flow_corrects_as_one_kalman_filter_a_particle():
    cloud = a_cloud(2)
    flow = OpticalFlow(
        displacement=np.array([0.2, -0.1, 0.3]),
        turn=g.from_rotation_vector(np.array([0.01, -0.02, 0.015]), xp=np),
        interval=np.array(0.05),
    )
    after = flowed(cloud, flow, 0.01)

    def minus(state: State) -> np.ndarray:
        motion, q, picture = state
        moved = g.rotate(picture, flow.displacement, xp=np) - motion[6:9]
        turn = turn_between(q, g.multiply(picture, flow.turn, xp=np))
        return np.concatenate([moved, turn])

    first = flowed(cloud, flow, 1e6)  # no turn to speak of
    check_update(cloud, first, lambda state: minus(state)[:3], np.eye(3) * 0.05**2)
    exact = one(first, 0)
    r = minus(exact)[3:]
    P = first.covariance[..., 0]
    S = P[9:, 9:] + np.eye(3) * 0.01**2
    motion, attitude, _ = shifted(exact, P[:, 9:] @ np.linalg.solve(S, r))
    np.testing.assert_allclose(after.motion[:, 0], motion, atol=1e-9)
    np.testing.assert_allclose(np.abs(after.attitude[:, 0] @ attitude), 1.0, atol=1e-12)
    np.testing.assert_allclose(
        after.covariance[..., 0], P - P[:, 9:] @ np.linalg.solve(S, P[9:, :]), atol=1e-9
    )


def a_flow() -> OpticalFlow:
    return OpticalFlow(displacement=np.zeros(3), turn=np.array([1.0, 0.0, 0.0, 0.0]), interval=np.array(0.05))


def test_a_picture_draws_the_turn_and_keeps_the_distribution():
    n = 40_000
    cloud = a_cloud(3, n=1)
    many = OutdoorCloud(**{k: np.repeat(v, n, axis=-1) for k, v in cloud.__dict__.items()})
    after = take_picture.step(many, a_flow(), draw=NumpyDraw("test", seed_words(1), 0), xp=np)
    P, most = cloud.covariance[..., 0], 6.0 / np.sqrt(n)
    e = turn_between(many.attitude.T, after.attitude.T)
    scale = np.sqrt(np.diag(P))
    drawn = (
        np.concatenate([after.motion[:6], e.T]) - np.concatenate([cloud.motion[:6, 0], np.zeros(3)])[:, None]
    )
    keep = [*range(6), 9, 10, 11]
    inside = after.covariance[..., 0][np.ix_(keep, keep)]
    found = (inside + np.cov(drawn)) / np.outer(scale[keep], scale[keep])
    np.testing.assert_allclose(drawn.mean(axis=1) / scale[keep], 0.0, atol=most)
    np.testing.assert_allclose(
        found, P[np.ix_(keep, keep)] / np.outer(scale[keep], scale[keep]), atol=2 * most
    )
    assert np.all(after.motion[6:] == 0.0)
    assert np.all(after.covariance[6:] == 0.0)
    assert np.all(after.picture == after.attitude)


def test_a_turn_that_is_certain_is_drawn_where_it_is():
    cloud = a_cloud(4)
    keep = np.repeat([1.0, 0.0], [9, 3])
    certain = cloud.replace(covariance=cloud.covariance * (keep[:, None] * keep)[..., None])
    after = take_picture.step(certain, a_flow(), draw=NumpyDraw("test", seed_words(1), 0), xp=np)
    np.testing.assert_allclose(after.attitude, cloud.attitude, atol=1e-15)
    np.testing.assert_allclose(after.motion[:6], cloud.motion[:6], atol=1e-15)
    np.testing.assert_allclose(after.covariance[:6, :6], cloud.covariance[:6, :6], atol=1e-15)


def test_without_a_reading_the_cloud_passes_through():
    cloud = a_cloud()
    state, found = correct_flow.step(2.0, cloud, None, displacement=0.1, turn=0.1, xp=np)
    assert state == 2.0
    assert found == (cloud, None)
    _, found = correct_field.step(2.0, cloud, None, earth=tuple(EARTH), noise=1e-6, xp=np)
    assert found == (cloud, None)
    assert take_picture.step(cloud, None, draw=NumpyDraw("test", seed_words(1), 0), xp=np) is cloud
