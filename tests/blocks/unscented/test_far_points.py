"""Sigma points of headings and attitudes that are not known: none lies farther than half a turn."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import Series, Stream, delay, graph, real
from flowgraph.blocks.geometry import StateSpace, angle, euclidean, from_rotation_vector, multiply, quaternion
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.unscented import MEANS, SigmaPoints, mean_turn, predict_unscented, update_unscented
from tests.support import all_engines

CAR = StateSpace(euclidean(2), angle())
WIDE = StateSpace(euclidean(12), angle(3))
POSE = StateSpace(euclidean(3), quaternion())


def still(x: Any, u: Any, w: Any, dt: Any, xp: Any) -> Any:
    return x


def predict(mean: Any, P: Any, space: StateSpace | None, move: Any = still, **settings: Any) -> Gaussian:
    return predict_unscented.step(
        Gaussian(np.asarray(mean, dtype=float), np.asarray(P, dtype=float)),
        None, move=move, space=space, dt=0.0, xp=np, **settings,
    )  # fmt: skip


@pytest.mark.parametrize("deviation", [0.3, 1.0, 1.7, 2.0, np.pi, 10.0])
def test_an_unknown_heading_stays_unknown(deviation):
    found = predict([0, 0, 3.0], np.diag([1, 1, deviation**2]), CAR)
    np.testing.assert_allclose(found.covariance, np.diag([1, 1, deviation**2]), atol=1e-12 * deviation**2)
    assert found.mean[2] == pytest.approx(3.0, abs=1e-12)


@pytest.mark.parametrize("deviation", [0.5, 0.9, 2.0])
def test_so_do_three_angles_of_fifteen_states_with_all_their_correlations(deviation):
    root = np.random.default_rng(0).normal(size=(15, 15))
    P = root @ root.T * deviation**2 / 15
    np.testing.assert_allclose(predict(np.zeros(15), P, WIDE).covariance, P, atol=1e-12)


@pytest.mark.parametrize("mean", MEANS)
@pytest.mark.parametrize("deviations", [(0.2, 0.2, np.pi), (1.5, 1.5, 1.5), (0.01, 2.0, 3.0)])
def test_so_does_an_attitude(mean, deviations):
    P = np.diag(np.square([1.0, 2.0, 3.0, *deviations]))
    found = predict([0, 0, 0, 0.5, 0.5, 0.5, 0.5], P, POSE, points=SigmaPoints(mean=mean))
    np.testing.assert_allclose(found.covariance, P, atol=1e-10)


def test_where_all_points_are_near_the_digits_are_those_of_a_vector():
    root = np.random.default_rng(1).normal(size=(3, 3)) * 0.2
    P = root @ root.T
    found = predict([0.0, 0.0, 0.0], P, CAR, noise=np.eye(3), move=lambda x, u, w, dt, xp: x + w)
    plain = predict([0.0, 0.0, 0.0], P, None, noise=np.eye(3), move=lambda x, u, w, dt, xp: x + w)
    np.testing.assert_allclose(found.covariance, plain.covariance, atol=1e-16)


def test_a_heading_that_is_measured_becomes_known():
    prior = Gaussian(np.array([0.0, 0.0, 0.5]), np.diag([1.0, 1.0, np.pi**2]))
    found, _ = update_unscented.step(
        prior, np.array([2.5]), observe=lambda x, xp: x[..., 2:3], R=0.01, space=CAR,
        measured_space=StateSpace(angle()), xp=np,
    )  # fmt: skip
    assert found.mean[2] == pytest.approx(0.5 + 2.0 * np.pi**2 / (np.pi**2 + 0.01), abs=1e-9)
    assert found.covariance[2, 2] == pytest.approx(0.01 * np.pi**2 / (np.pi**2 + 0.01), rel=1e-9)


def drive(x: Any, u: Any, w: Any, dt: Any, xp: Any) -> Any:
    h = x[..., 2:3]
    return xp.concat(
        [x[..., 0:1] + u[0] * dt * xp.cos(h), x[..., 1:2] + u[0] * dt * xp.sin(h), h + u[1] * dt], axis=-1
    )


def turn(x: Any, u: Any, w: Any, dt: Any, xp: Any) -> Any:
    step = from_rotation_vector(xp.concat([u, 0.0 * u[:1]]) * dt, xp=xp)
    return xp.concat([x[..., :3], multiply(x[..., 3:], step, xp=xp)], axis=-1)


@graph
def moving(u: Stream[Annotated[Any, real(2)]], *, start: Gaussian, move, space):
    belief = delay(start, name="belief")
    prior = predict_unscented(belief, u, move=move, space=space)
    belief.feed(prior)
    return {"belief": prior}


@pytest.mark.parametrize(
    ("move", "space", "mean", "P"),
    [
        (drive, CAR, [0.0, 0.0, 3.0], np.diag([1.0, 1.0, np.pi**2])),
        (turn, POSE, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], np.diag([1.0, 1.0, 1.0, 0.1, 0.1, np.pi**2])),
    ],
    ids=["heading", "attitude"],
)
def test_moving_does_not_make_it_known_in_any_engine(move, space, mean, P):
    start = Gaussian(np.array(mean), P)
    inputs = {"u": Series(np.arange(10) * 10**8, np.tile([1.0, 0.5], (10, 1)))}
    result = all_engines(moving.build(start=start, move=move, space=space), inputs)
    t = space.tangent - (1 if space is CAR else 3)
    covariance = result["belief"]["covariance"][-1]
    assert np.linalg.eigvalsh(covariance[t:, t:]).max() == pytest.approx(np.pi**2, rel=1e-9)


@pytest.mark.parametrize("spread", [0.5, 1.5, 2.5])
@pytest.mark.parametrize("seed", range(4))
def test_the_mean_of_attitudes_far_apart_is_the_dominant_eigenvector(spread, seed):
    turns = np.random.default_rng(seed).normal(size=(9, 3)) * spread
    q = np.vstack([[1.0, 0.0, 0.0, 0.0], from_rotation_vector(turns, xp=np)])
    values, vectors = np.linalg.eigh(q.T @ q / 10)
    assert values[-2] < 0.98 * values[-1]
    found = from_rotation_vector(mean_turn(turns, 0.1, "markley", np), xp=np)[0]
    assert abs(found @ vectors[:, -1]) == pytest.approx(1.0, abs=1e-13)


@pytest.mark.parametrize("about", np.eye(3), ids="xyz")
def test_the_mean_may_be_half_a_turn_from_the_central_attitude(about):
    turns = np.pi * about + np.random.default_rng(1).normal(size=(8, 3)) * 0.01
    found = mean_turn(turns, 1 / 9, "markley", np)
    assert np.linalg.norm(np.cross(found[0], about)) < 0.05
    assert np.linalg.norm(found) == pytest.approx(np.pi, abs=0.05)
