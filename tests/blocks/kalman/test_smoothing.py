"""Smoothers: the numbers of filterpy and pykalman, lags between filter and smoother, and curved states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, Series
from flowgraph.blocks.geometry import StateSpace, angle, euclidean, quaternion
from flowgraph.blocks.kalman import (
    LinearModel,
    cross_covariance,
    fixed_lag,
    predict_linear,
    rauch_tung_striebel,
    smoother_gain,
    smoothing_pass,
    update_linear,
)
from flowgraph.blocks.signals import CrossCovariance, Gaussian
from flowgraph.blocks.unscented import SigmaPoints, predict_unscented, unscented_crossing, update_unscented

MODEL = LinearModel([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], np.diag([0.0, 0.5]))
STEPS = np.random.default_rng(3).integers(5, 40, 80)  # ms: ticks need not be even


def filtered(offset: float = 0.0, space: StateSpace | None = None) -> tuple[Series, Series, np.ndarray]:
    """Priors and posteriors of a track with a measurement at every third tick, and the truth."""
    rng = np.random.default_rng(4)
    time = np.cumsum(STEPS) * 1_000_000
    dt = np.r_[0.0, np.diff(time) * 1e-9]
    truth, priors, posteriors = np.array([offset, 1.0]), [], []
    belief = Gaussian(mean=truth + 0.3, covariance=np.eye(2) * 0.1)
    where: list[np.ndarray] = []
    options: dict[str, Any] = {"H": [[1.0, 0.0]], "R": [[0.01]], "space": space, "xp": np}
    if space is not None:
        options["measured_space"] = StateSpace(angle())
    for k, step in enumerate(dt):
        F, _, Q = MODEL.discrete(step, np, float)
        truth = F @ truth + (np.linalg.cholesky(Q) @ rng.normal(size=2) if step else 0.0)
        where.append(truth)
        belief = predict_linear.step(belief, np.zeros(1), model=MODEL, dt=step, xp=np)
        if space is not None:
            belief = belief.replace(mean=space.plus(belief.mean, np.zeros(2), np))
        priors.append(belief)
        z = truth[:1] + rng.normal(size=1) * 0.1
        if k % 3 == 0:
            belief = update_linear.step(belief, z, **options)[0]
        posteriors.append(belief)
    stacked = [
        Series(time, Gaussian(*(np.stack([getattr(b, f) for b in bs]) for f in ("mean", "covariance"))))
        for bs in (priors, posteriors)
    ]
    return stacked[0], stacked[1], np.stack(where)


def test_it_is_the_smoother_of_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    prior, posterior, _ = filtered()
    steps = [MODEL.discrete(dt, np, float) for dt in np.diff(posterior.time) * 1e-9]
    peer = kalman.KalmanFilter(dim_x=2, dim_z=1)
    Fs = [np.eye(2), *(F for F, _, _ in steps)]  # its F[k + 1] leads from k to k + 1
    Qs = [np.zeros((2, 2)), *(Q for _, _, Q in steps)]
    mean, P, *_ = peer.rts_smoother(posterior["mean"], posterior["covariance"], Fs=Fs, Qs=Qs)
    smooth = rauch_tung_striebel(prior, posterior, MODEL)
    np.testing.assert_allclose(smooth["mean"], mean, atol=1e-10)
    np.testing.assert_allclose(smooth["covariance"], P, atol=1e-10)


def test_it_is_the_smoother_of_pykalman_with_its_lag_one_covariances():
    pykalman = pytest.importorskip("pykalman")
    prior, posterior, _ = filtered()
    steps = [MODEL.discrete(dt, np, float) for dt in np.diff(posterior.time) * 1e-9]
    peer = pykalman.standard
    F = np.stack([step[0] for step in steps])
    mean, P, gains = peer._smooth(
        F, posterior["mean"], posterior["covariance"],
        np.r_[prior["mean"]], np.r_[prior["covariance"]],
    )  # fmt: skip
    pairwise = peer._smooth_pair(P, gains)
    smooth = rauch_tung_striebel(prior, posterior, MODEL)
    np.testing.assert_allclose(smooth["mean"], mean, atol=1e-9)
    np.testing.assert_allclose(smooth["covariance"], P, atol=1e-9)
    np.testing.assert_allclose(smooth["lag_one"][:-1], pairwise[1:], atol=1e-9)
    assert not smooth["lag_one"][-1].any()


def test_all_covariances_are_those_of_the_whole_track_at_once():
    """The posterior of the stacked states of twelve ticks, by one solution of all of it."""
    before, after, _ = filtered()
    prior, posterior = before[:12], after[:12]
    assert isinstance(prior, Series)
    assert isinstance(posterior, Series)
    F = MODEL.transitions(prior.time)
    Q = [MODEL.discrete(dt, np, float)[2] for dt in np.diff(prior.time) * 1e-9]
    n, information = 12, np.zeros((24, 24))
    information[:2, :2] = np.linalg.inv(prior["covariance"][0])
    for k in range(n):
        at, to = slice(2 * k, 2 * k + 2), slice(2 * k + 2, 2 * k + 4)
        if k % 3 == 0:
            information[at, at] += [[1.0 / 0.01, 0.0], [0.0, 0.0]]
        if k < n - 1:
            W = np.linalg.inv(Q[k])
            information[at, at] += F[k].T @ W @ F[k]
            information[at, to] -= F[k].T @ W
            information[to, at] -= W @ F[k]
            information[to, to] += W
    whole = np.linalg.inv(information)
    smooth = rauch_tung_striebel(prior, posterior, MODEL)
    for k in range(n):
        at = slice(2 * k, 2 * k + 2)
        np.testing.assert_allclose(smooth["covariance"][k], whole[at, at], atol=1e-8)
        if k < n - 1:
            np.testing.assert_allclose(smooth["lag_one"][k], whole[2 * k + 2 : 2 * k + 4, at], atol=1e-8)


def swing(x: Any, control: Any, w: Any, dt: Any, xp: Any) -> Any:
    angle, rate = x[..., :1], x[..., 1:]
    faster = rate - 9.81 * xp.sin(angle) * dt
    return xp.concat([angle + faster * dt, faster], axis=-1)


def test_an_unscented_smoother_is_that_of_filterpy():
    kalman = pytest.importorskip("filterpy.kalman")
    Q, R, dt = np.diag([1e-4, 1e-2]), 0.05, 0.02
    points = SigmaPoints(alpha=0.7, beta=2.0, kappa=1.0)
    z = np.sin(0.1 * np.arange(60)) + np.random.default_rng(0).normal(size=60) * 0.2
    belief, priors, posteriors, crosses = Gaussian(np.array([0.8, 0.0]), np.eye(2) * 0.2), [], [], []
    crossing = unscented_crossing(swing, None, None, points)
    for k in range(60):
        step = dt if k else 0.0
        crosses.append(cross_covariance.step(belief, None, crossing=crossing, dt=step, xp=np).covariance)
        belief = predict_unscented.step(belief, None, move=swing, Q=Q / dt, points=points, dt=step, xp=np)
        priors.append(belief)
        see = lambda x, xp: xp.sin(x[..., :1])
        belief, _ = update_unscented.step(belief, z[k : k + 1], observe=see, R=[[R]], points=points, xp=np)
        posteriors.append(belief)
    time = np.arange(60) * 20_000_000
    prior, posterior = (
        Series(time, Gaussian(*(np.stack([getattr(b, f) for b in bs]) for f in ("mean", "covariance"))))
        for bs in (priors, posteriors)
    )
    cross = Series(time, CrossCovariance(covariance=np.stack(crosses)))
    smooth = rauch_tung_striebel(prior, posterior, cross)
    move = lambda x, dt: swing(x, None, None, dt, np)
    peer = kalman.UnscentedKalmanFilter(
        2, 1, dt, lambda x: np.sin(x[:1]), move, kalman.MerweScaledSigmaPoints(2, 0.7, 2.0, 1.0)
    )
    peer.Q = Q
    mean, P, _ = peer.rts_smoother(posterior["mean"], posterior["covariance"], dts=[dt] * 60)
    np.testing.assert_allclose(smooth["mean"], mean, atol=1e-9)
    np.testing.assert_allclose(smooth["covariance"], P, atol=1e-9)
    assert np.abs(smooth["mean"] - posterior["mean"]).max() > 0.01


def test_it_is_better_than_the_filter_and_knows_it():
    prior, posterior, truth = filtered()
    smooth = rauch_tung_striebel(prior, posterior, MODEL)
    before, after = (np.sqrt(np.mean((s["mean"] - truth) ** 2)) for s in (posterior, smooth))
    assert after < 0.8 * before
    difference = posterior["covariance"] - smooth["covariance"]
    assert np.linalg.eigvalsh(difference).min() > -1e-12


@pytest.mark.parametrize("lag", [1, 7, 30])
def test_a_fixed_lag_is_the_smoother_of_a_run_that_ends_there(lag):
    prior, posterior, _ = filtered()
    late = fixed_lag(prior, posterior, MODEL, lag)
    for k in (0, 10, 48, 78):
        end = min(k + lag, len(posterior) - 1) + 1
        whole = rauch_tung_striebel(prior[:end], posterior[:end], MODEL)
        np.testing.assert_allclose(late["mean"][k], whole["mean"][k], atol=1e-12)
        np.testing.assert_allclose(late["covariance"][k], whole["covariance"][k], atol=1e-12)


def test_no_lag_is_the_filter_and_a_long_one_the_smoother():
    prior, posterior, _ = filtered()
    for lag, other in ((0, posterior), (500, rauch_tung_striebel(prior, posterior, MODEL))):
        found = fixed_lag(prior, posterior, MODEL, lag)
        for leaf in ("mean", "covariance"):
            np.testing.assert_allclose(found[leaf], other[leaf], atol=1e-14)


def test_an_angle_is_smoothed_across_half_a_turn():
    space = StateSpace(angle(), euclidean(1))
    plain = [rauch_tung_striebel(*filtered()[:2], MODEL), fixed_lag(*filtered()[:2], MODEL, 5)]
    prior, posterior, _ = filtered(3.0, space)
    assert np.abs(np.diff(posterior["mean"][:, 0])).max() > 6.0  # it does jump
    turned = [
        rauch_tung_striebel(prior, posterior, MODEL, space=space),
        fixed_lag(prior, posterior, MODEL, 5, space=space),
    ]
    for a, b in zip(plain, turned, strict=True):
        apart = b["mean"][:, :1] - a["mean"][:, :1] - 3.0
        np.testing.assert_allclose(StateSpace(angle()).minus(apart, 0.0 * apart, np), 0.0, atol=1e-9)


def test_transitions_may_be_given_one_by_one():
    prior, posterior, _ = filtered()
    F = MODEL.transitions(prior.time)
    found = rauch_tung_striebel(prior, posterior, F)
    np.testing.assert_array_equal(found["mean"], rauch_tung_striebel(prior, posterior, MODEL)["mean"])
    with pytest.raises(DataError, match=r"transitions do not fit[\s\S]*expected: +shape \(79, 2, 2\)"):
        rauch_tung_striebel(prior, posterior, F[1:])


def test_what_does_not_belong_together_is_refused():
    prior, posterior, _ = filtered()
    with pytest.raises(DataError, match="not of the same ticks"):
        rauch_tung_striebel(prior[1:], posterior[:-1], MODEL)
    with pytest.raises(DataError, match="a lag cannot be negative"):
        fixed_lag(prior, posterior, MODEL, -1)


def test_what_is_known_exactly_learns_nothing():
    P = np.diag([2.0, 0.0, 3.0])
    P[0, 2] = P[2, 0] = 1.0
    cross = P.copy()
    gain = smoother_gain(cross, P, np)
    np.testing.assert_allclose(gain, np.diag([1.0, 0.0, 1.0]), atol=1e-14)


def test_the_crosses_must_be_of_the_same_ticks():
    prior, posterior, _ = filtered()
    cross = Series(prior.time[1:], CrossCovariance(covariance=np.zeros((79, 2, 2))))
    with pytest.raises(DataError, match="not of the same ticks"):
        rauch_tung_striebel(prior, posterior, cross)


@pytest.mark.parametrize("spread", [1.0, 0.5])
def test_on_a_curved_state_it_knows_its_errors(spread):
    """Many attitudes at once, of which the last is measured: corrections are of half a radian."""
    rng, space, n, runs = np.random.default_rng(0), StateSpace(quaternion()), 6, 8000
    P0, D, R = (spread**2 * np.diag(d) for d in ([0.04, 0.25, 0.16], [0.004, 0.06, 0.016], [0.001] * 3))
    draw = lambda P: rng.normal(size=(runs, 3)) * np.sqrt(np.diag(P))
    truth = [space.plus(np.tile(space.rest, (runs, 1)), draw(P0), np)]
    for _ in range(n - 1):
        truth.append(space.plus(truth[-1], draw(D), np))
    seen = space.plus(truth[-1], draw(R), np)
    P = np.stack([np.tile(P0 + k * D, (runs, 1, 1)) for k in range(n)])
    rest = np.tile(space.rest, (n, runs, 1))
    gain = P[-1] @ np.linalg.inv(P[-1] + R)
    mean, posterior = rest.copy(), P.copy()
    mean[-1] = space.plus(rest[-1], (gain @ space.minus(seen, rest[-1], np)[..., None])[..., 0], np)
    posterior[-1] = (np.eye(3) - gain) @ P[-1]
    x, S, _ = smoothing_pass(smoother_gain(P[:-1], P[1:], np), rest, P, mean, posterior, space)
    for k in range(n):
        error = space.minus(truth[k], x[k], np)[..., None]
        nees = np.mean((error.mT @ np.linalg.solve(S[k], error))[..., 0, 0])
        assert 2.9 < nees < 3.0 + 0.4 * spread**2
