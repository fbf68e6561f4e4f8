"""Smoothers of banks and ensembles: laws, how near the exact mixture they come, and refusals."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Series, Stream, graph, simulate
from flowgraph.blocks.filtering import (
    LinearMeasurement,
    bank_steps_of,
    ensemble,
    extended,
    filtered,
    imm,
    linear,
    mmae,
    rao_blackwellized,
    smooth,
    unscented,
)
from flowgraph.blocks.models.tracking import constant_velocity
from flowgraph.blocks.signals import PlanePosition
from tests.blocks.filtering.turning import MOTION, built, driven
from tests.support import all_engines

CALM, WILD, ONE = constant_velocity(0.2), constant_velocity(6.0), constant_velocity(1.0)
SEEN = LinearMeasurement(CALM.space, np.eye(2, 4), noise=0.09)
BEGIN = CALM.space.gaussian(position=((0.0, 0.0), 0.5), velocity=((1.0, 0.0), 0.5))
STAY = np.array([[0.9, 0.1], [0.2, 0.8]])


@graph
def followed(position: Stream[PlanePosition], *, method, motion=CALM):
    return filtered(motion, {SEEN: position}, start=BEGIN, method=method, smoothing=True)


def places(
    n: int, seed: int = 0, step: float = 0.2, wild: float = 6.0
) -> tuple[np.ndarray, dict[str, Series]]:
    """A point that now and then turns sharply, and where it is seen."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) * step
    turns = np.where((t // 2.0).astype(int) % 2 == 0, 0.2, wild)
    v = np.array([1.0, 0.0]) + np.cumsum(rng.normal(size=(n, 2)) * turns[:, None] * step**0.5, axis=0)
    truth = np.cumsum(v * step, axis=0)
    seen = truth + 0.3 * rng.normal(size=truth.shape)
    return truth, {"position": Series.from_seconds(t, PlanePosition(position=seen))}


def alike(a: Series, b: Series, tolerance: float = 1e-9) -> None:
    for leaf in ("mean", "covariance"):
        np.testing.assert_allclose(a[leaf], b[leaf], atol=tolerance, err_msg=leaf)


def whole(result, *, lag=None):
    steps = bank_steps_of(result, CALM.space)
    return steps.smoothed() if lag is None else steps.lagged(lag)


@pytest.mark.parametrize("lag", [None, 0.6])
def test_a_bank_of_one_motion_twice_is_one_filter_smoothed(lag):
    _, inputs = places(20)
    one = simulate(followed.build(method=linear()), inputs)
    two = simulate(followed.build(method=imm(CALM, CALM, transition=STAY, method=linear())), inputs)
    alike(whole(two, lag=lag), smooth(one, CALM.space, lag=lag))


def test_where_nothing_goes_over_it_is_each_filter_smoothed_and_weighed_at_the_end():
    _, inputs = places(20)
    each = [simulate(followed.build(method=linear(), motion=m), inputs) for m in (CALM, WILD)]
    bank = simulate(followed.build(method=mmae(CALM, WILD, method=linear())), inputs)
    found, weight = whole(bank), bank["bank"]["weight"][-1]
    smoothed = [smooth(one, CALM.space) for one in each]
    mean = sum(w * s["mean"] for w, s in zip(weight, smoothed, strict=True))
    np.testing.assert_allclose(found["mean"], mean, atol=1e-9)
    assert 0.01 < weight[0] < 0.99 or weight.max() > 0.99


def exact(z: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """The mean (n, 4) given all measurements, and given those by then, of the mixture over all ways through
    the motions: a Kalman filter and smoother each."""
    n = len(z)
    models = [m.discrete(step, np, np.float64) for m in (CALM, WILD)]
    H, R = np.eye(2, 4), 0.09 * np.eye(2)
    logs, means, by_then, then = [], [], [], []
    for way in itertools.product((0, 1), repeat=n - 1):
        x, P, log = BEGIN.mean, BEGIN.covariance, 0.0
        run, so_far = [], []
        for k in range(n):
            F, Q = np.eye(4), np.zeros((4, 4))
            if k:
                F, _, Q = models[way[k - 1]]
                before = np.array([0.5, 0.5]) if k == 1 else STAY[way[k - 2]]
                log += np.log((np.array([0.5, 0.5]) @ STAY)[way[0]] if k == 1 else before[way[k - 1]])
            x_, P_ = F @ x, F @ P @ F.T + Q
            S = H @ P_ @ H.T + R
            r = z[k] - H @ x_
            log += -0.5 * (r @ np.linalg.solve(S, r) + np.linalg.slogdet(S)[1])
            K = P_ @ H.T @ np.linalg.inv(S)
            x, P = x_ + K @ r, P_ - K @ S @ K.T
            run.append((x, P, x_, P_, F))
            so_far.append(log)
        found = [run[-1][0]]
        for (x, P, *_), (_, _, x_, P_, F) in zip(run[-2::-1], run[:0:-1], strict=True):
            found.append(x + P @ F.T @ np.linalg.solve(P_, found[-1] - x_))
        logs.append(log)
        means.append(found[::-1])
        by_then.append(so_far)
        then.append([x for x, *_ in run])
    weigh = lambda log: (
        np.exp(np.array(log) - np.max(log, axis=0)) / np.exp(np.array(log) - np.max(log, axis=0)).sum(axis=0)
    )
    w, v = weigh(logs), weigh(by_then)
    return np.einsum("w,wnk->nk", w, np.array(means)), np.einsum("wn,wnk->nk", v, np.array(then))


def test_it_is_near_the_exact_mixture():
    """Of all 512 ways through the motions: what is off is little of what the later measurements tell."""
    step = 0.4
    off_smoothed, off_filter, scale = 0.0, 0.0, 0.0
    for seed in range(3):
        _, inputs = places(10, seed, step)
        found = simulate(followed.build(method=imm(CALM, WILD, transition=STAY, method=linear())), inputs)
        best, by_then = exact(inputs["position"]["position"], step)
        off_smoothed += np.mean((whole(found)["mean"] - best) ** 2)
        off_filter += np.mean((found["posterior"]["mean"] - by_then) ** 2)
        scale += np.mean((by_then - best) ** 2)
    assert off_smoothed < 0.05 * scale


def test_it_is_better_than_the_filter_and_honest():
    error, filters, nees = [], [], []
    for seed in range(4):
        truth, inputs = places(60, seed)
        run = simulate(followed.build(method=imm(CALM, WILD, transition=STAY, method=linear())), inputs)
        smoothed, late = whole(run), whole(run, lag=0.6)
        off = smoothed["mean"][:, :2] - truth
        error.append([np.mean(off**2), np.mean((late["mean"][:, :2] - truth) ** 2)])
        filters.append(np.mean((run["posterior"]["mean"][:, :2] - truth) ** 2))
        P = smoothed["covariance"][:, :2, :2]
        nees.append(np.mean(np.einsum("ni,nij,nj->n", off, np.linalg.inv(P), off)))
    whole_run, lagged = np.mean(error, axis=0)
    assert whole_run < 0.7 * np.mean(filters)
    assert whole_run < 1.3 * lagged
    assert 1.2 < np.mean(nees) < 3.0


def test_a_bank_on_a_curved_state_and_in_all_engines():
    inputs = {"position": driven(12)[0]}
    result = all_engines(built(imm(MOTION, MOTION, method=extended())), inputs)
    space = MOTION.space
    one = simulate(built(extended()), inputs)
    alike(bank_steps_of(result, space).smoothed(), smooth(one, space), 1e-7)


def test_an_ensemble_is_smoothed_as_the_exact_one_is():
    """Within the error of its sample, which falls with its root."""
    _, inputs = places(20, wild=1.0)
    best = smooth(simulate(followed.build(method=linear(), motion=ONE), inputs), CALM.space)
    deviations = np.sqrt(np.einsum("nii->ni", best["covariance"]))
    off = []
    for n in (100, 1600):
        found = smooth(simulate(followed.build(method=ensemble(n), motion=ONE), inputs), CALM.space)
        off.append(np.sqrt(np.mean(((found["mean"] - best["mean"]) / deviations) ** 2)))
    assert off[1] < 0.12
    assert off[1] < 0.5 * off[0]


def test_what_cannot_be_smoothed_says_so():
    _, inputs = places(3)
    with pytest.raises(DeclarationError, match=r"no smoother[\s\S]*an ensemble or particles"):
        followed.build(method=rao_blackwellized(50, linear="velocity"))
    run = simulate(followed.build(method=unscented()), inputs)
    with pytest.raises(DataError, match=r"smoother of a bank needs[\s\S]*method=imm"):
        bank_steps_of(run, CALM.space)
