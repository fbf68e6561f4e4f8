"""Smoothers: filterpy's numbers, lags between filter and smoother, and states on a circle."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, Series
from flowgraph.blocks.geometry import StateSpace, angle, euclidean
from flowgraph.blocks.kalman import LinearModel, fixed_lag, predict_linear, rauch_tung_striebel, update_linear
from flowgraph.blocks.signals import Gaussian

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
