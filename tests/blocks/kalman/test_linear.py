"""Linear models over long steps: those of the matrix exponential, whatever A is."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest
from scipy.linalg import expm

from flowgraph import Series, Stream, delay, graph, real
from flowgraph.blocks.kalman import LinearModel, predict_linear
from flowgraph.blocks.signals import Gaussian
from tests.support import all_engines

TURN, TAU = 0.8, 1.5
MODELS = {
    "decay": [[-2.0]],
    "Singer": [[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / TAU]],
    "turn": [[0, 1, 0, 0], [0, 0, 0, -TURN], [0, 0, 0, 1], [0, TURN, 0, 0]],
    "oscillator": [[0.0, 1.0], [-4.0, -0.1]],
    "unstable": [[0.1, 1.0], [0.0, 0.2]],
    "stiff": [[-100.0, 1.0], [0.0, -0.01]],
}


def model(name: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    A = np.array(MODELS[name], dtype=float)
    n = len(A)
    root = np.random.default_rng(n).normal(size=(n, n))
    return A, np.ones((n, 1)), root @ root.T


def exact(
    A: np.ndarray, B: np.ndarray, D: np.ndarray, dt: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """By SciPy's exponential: F and G of the augmented matrix, Q of its own linear equation."""
    n = len(A)
    whole = expm(np.block([[A, B], [np.zeros((1, n + 1))]]) * dt)
    F = whole[:n, :n]
    # d/dt of Q is A Q + Q A^T + D: one linear system of n^2 numbers, integrated by an exponential of its own
    L = np.kron(A, np.eye(n)) + np.kron(np.eye(n), A)
    grown = expm(np.block([[L, D.reshape(-1, 1)], [np.zeros((1, n * n + 1))]]) * dt)
    return F, whole[:n, n:], grown[:-1, -1].reshape(n, n)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("dt", [1e-4, 0.01, 0.3, 1.0, 5.0, 20.0])
def test_a_model_is_exact_over_any_step(name, dt):
    A, B, D = model(name)
    for found, right in zip(LinearModel(A, B, D).discrete(dt, np, float), exact(A, B, D, dt), strict=True):
        np.testing.assert_allclose(found, right, rtol=1e-9, atol=1e-11 * np.abs(right).max() + 1e-14)


def test_over_an_hour_a_decay_has_come_to_rest():
    F, G, Q = LinearModel([[-0.5]], [[1.0]], [[3.0]]).discrete(3600.0, np, float)
    assert abs(F[0, 0]) < 1e-14
    assert G[0, 0] == pytest.approx(2.0, rel=1e-12)
    assert Q[0, 0] == pytest.approx(3.0, rel=1e-12)


def test_the_transitions_of_many_steps_are_those_of_each():
    A, B, D = model("Singer")
    time = np.array([0, 10, 300, 300, 5000, 60000], dtype=np.int64) * 10**6
    for F, dt in zip(LinearModel(A, B, D).transitions(time), np.diff(time) * 1e-9, strict=True):
        np.testing.assert_allclose(F, expm(A * dt), rtol=1e-11, atol=1e-13)


@graph
def predicted(u: Stream[Annotated[Any, real(1)]], *, start: Gaussian, model: LinearModel):
    belief = delay(start, name="belief")
    now = predict_linear(belief, u, model=model)
    belief.feed(now)
    return {"belief": now}


def test_long_steps_are_the_same_in_every_engine():
    A, B, D = model("Singer")
    start = Gaussian(np.array([1.0, -1.0, 0.5]), np.eye(3))
    time = np.cumsum([0, 10, 500, 10, 5000]) * 10**6
    result = all_engines(
        predicted.build(start=start, model=LinearModel(A, B, D)), {"u": Series(time, np.zeros((5, 1)))}
    )
    F, _, Q = exact(A, B, D, 5.52)
    np.testing.assert_allclose(result["belief"]["mean"][-1], F @ start.mean, rtol=1e-10)
    np.testing.assert_allclose(result["belief"]["covariance"][-1], F @ F.T + Q, rtol=1e-10)
