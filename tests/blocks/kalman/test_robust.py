"""Outliers that count for less, and noise that is learned: their optimum, their limits, and what they buy."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
import pytest
from scipy.optimize import minimize

from flowgraph import DeclarationError, Series, Stream, arrays, block, delay, graph, real, simulate
from flowgraph.blocks.filtering import extended, filtered
from flowgraph.blocks.geometry import StateSpace, euclidean
from flowgraph.blocks.kalman import (
    huber,
    learned_noise,
    student_t,
    update_extended,
    update_learned,
    update_linear,
)
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.statespace import DiscreteModel, LinearMeasurement
from tests.support import all_engines

Two = Annotated[Any, real(2)]
H = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]])
R = np.array([[0.3, 0.1], [0.1, 0.2]])
P = np.diag([0.5, 0.4, 1.0, 1.0]) + 0.1
PRIOR = Gaussian(mean=np.array([1.0, -1.0, 0.5, 0.0]), covariance=P)
ROBUST = [huber(1.5, rounds=60), student_t(3.0, rounds=200)]


def loss(robust: Any, square: float) -> float:
    """-2 log of the density of the noise, of which the weight is the derivative by the square."""
    if hasattr(robust, "freedom"):
        return (robust.freedom + 2) * float(np.log1p(square / robust.freedom))
    limit = robust.threshold * np.sqrt(2.0)
    d = np.sqrt(square)
    return square if d <= limit else 2.0 * limit * d - limit**2


@pytest.mark.parametrize("robust", ROBUST, ids=["huber", "student"])
@pytest.mark.parametrize("off", [[0.1, -0.2], [2.0, 1.0], [6.0, -4.0]])
def test_the_rounds_come_to_the_maximum_of_the_posterior(robust, off):
    z = PRIOR.mean[:2] + off

    def cost(x: np.ndarray) -> float:
        d, e = x - PRIOR.mean, z - H @ x
        return float(d @ np.linalg.solve(P, d)) + loss(robust, float(e @ np.linalg.solve(R, e)))

    posterior, _ = update_linear.step(PRIOR, z, H=H, R=R, robust=robust, xp=np)
    best = minimize(cost, posterior.mean, tol=1e-12)
    assert cost(posterior.mean) <= best.fun + 1e-9
    np.testing.assert_allclose(posterior.mean, best.x, atol=1e-4)


def test_without_outliers_and_with_light_tails_it_is_the_kalman_filter():
    z = PRIOR.mean[:2] + np.array([0.3, -0.1])
    plain, told = update_linear.step(PRIOR, z, H=H, R=R, xp=np)
    for robust in (huber(5.0), student_t(1e9)):
        found, innovation = update_linear.step(PRIOR, z, H=H, R=R, robust=robust, xp=np)
        np.testing.assert_allclose(found.mean, plain.mean, rtol=1e-8)
        np.testing.assert_allclose(found.covariance, plain.covariance, rtol=1e-7)
        assert float(innovation.value.nis) == float(told.value.nis)


@pytest.mark.parametrize("robust", [huber(), student_t()], ids=["huber", "student"])
def test_an_outlier_moves_little_leaves_the_covariance_wide_and_is_seen(robust):
    z = PRIOR.mean[:2] + 50.0
    plain, told = update_linear.step(PRIOR, z, H=H, R=R, xp=np)
    found, innovation = update_linear.step(PRIOR, z, H=H, R=R, robust=robust, xp=np)
    assert np.linalg.norm(found.mean - PRIOR.mean) < 0.1 * np.linalg.norm(plain.mean - PRIOR.mean)
    assert found.covariance[0, 0] > 2.0 * plain.covariance[0, 0]
    assert np.trace(found.covariance) < np.trace(P)
    assert float(innovation.value.nis) == float(told.value.nis) > 1000.0


def test_missing_entries_and_gates_do_as_without():
    part = np.array([PRIOR.mean[0] + 9.0, np.nan])
    found, innovation = update_linear.step(PRIOR, part, H=H, R=R, robust=huber(rounds=60), xp=np)
    alone, _ = update_linear.step(PRIOR, part[:1], H=H[:1], R=R[:1, :1], robust=huber(rounds=60), xp=np)
    np.testing.assert_allclose(found.mean, alone.mean, rtol=1e-9)
    assert float(innovation.value.parts) == 1.0
    shut, innovation = update_linear.step(PRIOR, part, H=H, R=R, robust=huber(), gate=0.999, xp=np)
    np.testing.assert_array_equal(shut.mean, PRIOR.mean)
    assert not innovation.value.accepted


@pytest.mark.parametrize("make", [huber, student_t])
def test_what_is_not_positive_is_refused(make):
    with pytest.raises(DeclarationError, match="this must be positive"):
        make(0.0)
    with pytest.raises(DeclarationError, match="rounds: this must be positive"):
        make(rounds=0)


# -- in a filter -----------------------------------------------------------------------------------------

DT = 100_000_000
STEP = np.eye(4) + 0.1 * np.eye(4, k=2)
SHAKE = np.diag([1e-5, 1e-5, 0.01, 0.01])
CAR = DiscreteModel(STEP, SHAKE)
START = Gaussian(mean=np.zeros(4), covariance=np.eye(4))


def seen(n: int, *, outliers: float = 0.0, spread: float = 0.5, seed: int = 0) -> tuple[np.ndarray, Series]:
    """Where a point moved (n, 2), and measurements of it, some 20 deviations off."""
    rng = np.random.default_rng(seed)
    speed = np.cumsum(rng.normal(size=(n, 2)) * np.sqrt(0.1 * 0.1), axis=0)
    place = np.cumsum(speed * 0.1, axis=0)
    noise = rng.normal(size=(n, 2)) * spread
    noise[rng.random(n) < outliers] *= 20.0
    return place, arrays(np.arange(n) * DT, place + noise)


@pytest.mark.parametrize("robust", [huber(), student_t()], ids=["huber", "student"])
def test_with_outliers_it_is_much_better_and_without_hardly_worse(robust):
    sees = LinearMeasurement(StateSpace(euclidean(4)), H, 0.25)
    errors = {}
    for outliers in (0.0, 0.1):
        place, fixes = seen(400, outliers=outliers)
        for which, method in (("plain", extended()), ("robust", extended(robust=robust))):
            built = tracked.build(method=method, sees=sees)
            mean = simulate(built, {"fix": fixes}).output["mean"]
            errors[outliers, which] = float(np.sqrt(np.mean((mean[50:, :2] - place[50:]) ** 2)))
    assert errors[0.1, "robust"] < 0.5 * errors[0.1, "plain"]
    assert errors[0.0, "robust"] < 1.1 * errors[0.0, "plain"]


@graph
def tracked(fix: Stream[Two], *, method: Any, sees: LinearMeasurement) -> Stream[Gaussian]:
    return filtered(CAR, {sees: fix}, start=START, method=method)  # type: ignore[no-any-return]


@block
def moved(belief: Gaussian, *, xp: Any) -> Gaussian:
    F = xp.asarray(STEP)
    mean = (F @ belief.mean[..., None])[..., 0]
    return Gaussian(mean=mean, covariance=F @ belief.covariance @ F.mT + xp.asarray(SHAKE))


@graph
def learning(fix: Stream[Two], *, first: Any, memory: float, robust: Any = None):
    belief = delay(START, name="belief")
    noise = delay(first, name="noise")
    prior = moved(belief, at=fix)
    observe = lambda x, xp: (x[..., :2], xp.asarray(H))
    posterior, innovation = update_learned(prior, fix, noise, observe=observe, robust=robust)
    belief.feed(posterior)
    learned = learned_noise(noise, innovation, memory=memory)
    noise.feed(learned)
    return {"belief": posterior, "innovation": innovation, "noise": learned}


@pytest.mark.parametrize("told", [0.025, 0.25, 2.5])
def test_the_noise_is_learned_from_either_side(told):
    _, fixes = seen(1500, spread=0.5)
    result = simulate(learning.build(first=np.eye(2) * told, memory=100.0), {"fix": fixes})
    assert np.linalg.eigvalsh(result.noise["value"]).min() > 0.0
    late = result.noise["value"][700:].mean(axis=0)
    np.testing.assert_allclose(np.diag(late), 0.25, rtol=0.25)
    assert abs(late[0, 1]) < 0.05
    assert float(np.mean(result.innovation["nis"][700:])) == pytest.approx(2.0, rel=0.1)


@pytest.mark.slow
def test_the_engines_agree():
    _, fixes = seen(30, outliers=0.2)
    all_engines(learning.build(first=np.eye(2), memory=20.0, robust=student_t(rounds=2)), {"fix": fixes})
    observe = lambda x, xp: (x[..., :2], xp.asarray(H))
    found, _ = update_extended.step(PRIOR, np.array([3.0, 0.0]), observe=observe, R=R, robust=huber(), xp=np)
    same, _ = update_linear.step(PRIOR, np.array([3.0, 0.0]), H=H, R=R, robust=huber(), xp=np)
    np.testing.assert_allclose(found.mean, same.mean, rtol=1e-12)
