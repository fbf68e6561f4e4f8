"""Matrix settings: a vector is a diagonal, what does not fit is refused, and singular covariances go on."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest

from flowgraph import DeclarationError, Series, Stream, delay, graph, real
from flowgraph.blocks.geometry import StateSpace, angle, euclidean
from flowgraph.blocks.kalman import (
    covariance_root,
    semidefinite_root,
    update_extended,
    update_extended_root,
    update_linear,
    update_root,
)
from flowgraph.blocks.models.particle_ins import start_states
from flowgraph.blocks.signals import Gaussian, GaussianRoot
from flowgraph.blocks.unscented import predict_unscented, update_unscented
from tests.support import all_engines

H = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, -0.3]])
P = np.array([[2.0, 0.3, 0.1], [0.3, 1.0, 0.2], [0.1, 0.2, 1.5]])
MEAN = np.array([0.4, -0.2, 0.1])
SEEN: dict[str, tuple[Any, dict[str, Any]]] = {
    "linear": (update_linear, {"H": H}),
    "root": (update_root, {"H": H}),
    "extended": (update_extended, {"observe": lambda x, xp: (H @ x, H)}),
    "extended root": (update_extended_root, {"observe": lambda x, xp: (H @ x, H)}),
    "unscented": (update_unscented, {"observe": lambda x, xp: x @ H.T}),
}


def corrected(which: str, R: Any, **more: Any) -> tuple[np.ndarray, np.ndarray]:
    block, settings = SEEN[which]
    rooted = "root" in which
    prior = GaussianRoot(MEAN, np.linalg.cholesky(P)) if rooted else Gaussian(MEAN, P)
    posterior, _ = block.step(prior, np.array([1.0, 2.0]), xp=np, R=R, **{**settings, **more})
    return posterior.mean, posterior.root @ posterior.root.T if rooted else posterior.covariance


def moved(Q: Any, **more: Any) -> np.ndarray:
    move = lambda x, u, w, dt, xp: x if w is None else x + w
    settings = {"move": move, "Q": Q, "dt": 0.5, "xp": np, **more}
    return np.asarray(predict_unscented.step(Gaussian(MEAN, P), None, **settings).covariance)


@pytest.mark.parametrize("which", SEEN)
def test_a_vector_of_noise_is_a_diagonal_and_a_number_is_that_of_each_entry(which):
    by_hand = P - P @ H.T @ np.linalg.solve(H @ P @ H.T + np.diag([0.1, 0.4]), H @ P)
    np.testing.assert_allclose(corrected(which, [0.1, 0.4])[1], by_hand, atol=1e-13)
    for given, meant in (([0.1, 0.4], np.diag([0.1, 0.4])), (0.3, np.eye(2) * 0.3), (0, np.zeros((2, 2)))):
        for a, b in zip(corrected(which, given), corrected(which, meant), strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("which", SEEN)
@pytest.mark.parametrize("R", [np.eye(3), [[0.1, 0.4]], [0.1, 0.2, 0.3], np.ones((2, 1)), [[0.3]]])
def test_noise_of_another_shape_is_refused(which, R):
    with pytest.raises(DeclarationError, match=r"the noise does not fit[\s\S]*\(2, 2\)[\s\S]*shape \("):
        corrected(which, R)


@pytest.mark.parametrize("R", [-0.1, [0.1, -0.2], [[1.0, 0.5], [0.1, 1.0]], [[np.nan, 0.0], [0.0, 1.0]]])
def test_what_is_no_covariance_is_refused(R):
    with pytest.raises(DeclarationError, match="no covariance of noise"):
        corrected("linear", R)


@pytest.mark.parametrize("which", ["linear", "root"])
@pytest.mark.parametrize("wrong", [H[0], H.T, H[:, :2], H[:1]])
def test_an_observation_of_another_shape_is_refused(which, wrong):
    with pytest.raises(DeclarationError, match=r"does not fit[\s\S]*shape \(2, 3\)"):
        corrected(which, [0.1, 0.4], H=wrong)


def test_the_noise_of_a_prediction_is_a_matrix_too():
    np.testing.assert_allclose(moved([0.1, 0.2, 0.4]), P + np.diag([0.05, 0.1, 0.2]), atol=1e-14)
    np.testing.assert_allclose(moved(0.2), P + 0.1 * np.eye(3), atol=1e-14)
    np.testing.assert_allclose(moved(None, noise=[0.1, 0.2, 0.4]), moved([0.1, 0.2, 0.4]), atol=1e-14)
    for wrong in (np.eye(2), [0.1, 0.2], np.ones((1, 3))):
        with pytest.raises(DeclarationError, match=r"predict_unscented.Q"):
            moved(wrong)
    with pytest.raises(DeclarationError, match=r"predict_unscented.noise"):
        moved(None, noise=np.ones((2, 3)))


@pytest.mark.parametrize(
    "singular",
    [np.zeros((3, 3)), np.diag([0.0, 0.0, 0.01]), np.outer(MEAN, MEAN), np.diag([1.0, -1e-18, 2.0])],
    ids=["none", "two known", "a line", "below zero"],
)
def test_the_root_of_a_covariance_that_is_singular(singular):
    root = covariance_root(singular, xp=np)
    np.testing.assert_allclose(root @ root.T, singular, atol=1e-15)


def test_the_root_has_the_digits_of_cholesky_where_there_is_one():
    scales = np.diag([1e3, 1.0, 1e-7])
    for matrix in (P, scales @ P @ scales, np.stack([P, 2 * P])):
        np.testing.assert_array_equal(covariance_root(matrix, xp=np), np.linalg.cholesky(matrix))
    small = scales @ P @ scales
    np.testing.assert_allclose(semidefinite_root(small, xp=np), np.linalg.cholesky(small), rtol=1e-12)


def drive(x: Any, u: Any, w: Any, dt: Any, xp: Any) -> Any:
    h = x[..., 2:3]
    return xp.concat(
        [x[..., 0:1] + u[0] * dt * xp.cos(h), x[..., 1:2] + u[0] * dt * xp.sin(h), h + u[1] * dt], axis=-1
    )


PLACE = StateSpace(euclidean(2), angle())


@graph
def car(u: Stream[Annotated[Any, real(2)]], *, start: Gaussian):
    belief = delay(start, name="belief")
    prior = predict_unscented(belief, u, move=drive, Q=np.zeros((3, 3)), space=PLACE)
    posterior, _ = update_unscented(
        prior, u, observe=lambda x, xp: x[..., :2], R=[0.5, 0.5], space=PLACE, name="update"
    )
    belief.feed(posterior)
    return {"prior": prior, "belief": posterior}


@pytest.mark.parametrize("variances", [(0, 0, 0.01), (0, 0, 0), (1.0, 0, 0.04)])
def test_a_start_that_is_known_goes_on_in_every_engine(variances):
    start = Gaussian(np.array([0.1, 0.2, 0.3]), np.diag(np.array(variances, dtype=float)))
    inputs = {"u": Series(np.arange(5) * 10**8, np.tile([1.0, 0.2], (5, 1)))}
    result = all_engines(car.build(start=start), inputs)
    for covariance in (result["prior"]["covariance"], result["belief"]["covariance"]):
        assert np.isfinite(covariance).all()
        assert np.linalg.eigvalsh(covariance).min() > -1e-15


def test_a_cloud_starts_from_a_known_position():
    P = np.diag([0.0] * 3 + [0.01] * 12)
    state = start_states(50, Gaussian(np.arange(15) * 0.1, P), seed=1).state
    assert (state[:, :3] == [0.0, 0.1, 0.2]).all()
    assert 0.05 < state[:, 5].std() < 0.2
