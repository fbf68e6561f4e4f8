"""Banks of motions: the interacting multiple model filter beside another's, and in all engines."""

from __future__ import annotations

import copy

import numpy as np
import pytest
from scipy.linalg import block_diag

from flowgraph import Array, DeclarationError, Series, Signal, Stream, graph, lower, real, simulate
from flowgraph.blocks.filtering import (
    DiscreteModel,
    Gaussian,
    LinearMeasurement,
    extended,
    filtered,
    imm,
    linear,
    mmae,
    particles,
    unscented,
)
from flowgraph.blocks.models.tracking import constant_acceleration, constant_velocity, coordinated_turn
from tests.support import all_engines

SECOND = 1_000_000_000
STAY = np.array([[0.97, 0.03], [0.03, 0.97]])


class Spot(Signal):
    """A position in the plane."""

    position: Array = real(2)


def crassidis(n: int = 600):
    """J. Crassidis and J. Junkins, "Optimal Estimation of Dynamic Systems", 2nd ed., example 4.6."""
    rng = np.random.default_rng(4)
    x, truth = np.array([2000.0, 0.0, 10000.0, -15.0]), []
    for k in range(n):
        x = x + np.array([x[1], 0.0, x[3], 0.0])
        if k >= 400:
            x = x + 0.075 * np.array([0.5, 1.0, 0.5, 1.0])
        truth.append(x[[0, 2]])
    return np.array(truth), np.array(truth) + 100.0 * rng.normal(size=(n, 2))


F = block_diag(*[np.array([[1.0, 1.0, 0.5], [0.0, 1.0, 1.0], [0.0, 0.0, 1.0]])] * 2)
Q = block_diag(*[1e-3 * np.array([[0.05, 0.125, 1 / 6], [0.125, 1 / 3, 0.5], [1 / 6, 0.5, 1.0]])] * 2)
H = np.zeros((2, 6))
H[0, 0] = H[1, 3] = 1.0
START = Gaussian(mean=np.array([2000.0, 0.0, 0.0, 10000.0, -15.0, 0.0]), covariance=1e-12 * np.eye(6))
MOVES, STAYS = DiscreteModel(F, Q), DiscreteModel(F, 0.0 * Q)
SEEN = LinearMeasurement(MOVES.space, H, noise=1e4)


@graph
def both(spot: Stream[Spot], *, method, gate=None):
    """Two motions."""
    return filtered(MOVES, {SEEN: spot}, start=START, method=method, gate=gate)


def test_it_is_that_of_filterpy_on_the_example_of_crassidis():
    from filterpy.kalman import IMMEstimator, KalmanFilter

    truth, z = crassidis()
    one = KalmanFilter(6, 2)
    one.F, one.Q, one.H, one.R = F, Q, H, 1e4 * np.eye(2)
    one.x, one.P = START.mean[:, None].copy(), START.covariance.copy()
    other = copy.deepcopy(one)
    other.Q = 0.0 * Q
    bank = IMMEstimator([one, other], np.array([0.5, 0.5]), STAY)
    means, covariances = [], []
    for k, seen in enumerate(z):
        if k:
            bank.predict()
        bank.update(seen[:, None])
        means.append(bank.x[:, 0].copy())
        covariances.append(bank.P.copy())
    inputs = {"spot": Series(np.arange(len(z)) * SECOND, Spot(position=z))}
    method = imm(MOVES, STAYS, transition=STAY, weights=np.array([0.5, 0.5]) @ STAY, method=linear())
    found = simulate(both.build(method=method), inputs)["output"]
    scale = np.maximum(1.0, np.abs(means))
    assert (np.abs(found["mean"] - means) / scale).max() < 4e-12
    deviations = np.sqrt(np.einsum("nii->ni", np.array(covariances)))
    apart = np.abs(found["covariance"] - covariances) / (deviations[:, :, None] * deviations[:, None, :])
    assert apart.max() < 4e-12
    error = np.sqrt(np.mean(np.sum((found["mean"][300:, [0, 3]] - truth[300:]) ** 2, axis=-1)))
    assert error < 90.0, "a measurement is 141 m off"


@pytest.mark.slow
@pytest.mark.parametrize("method", [linear(), unscented()])
def test_it_is_equal_in_all_engines_and_lowered(method):
    _, z = crassidis(30)
    inputs = {"spot": Series(np.arange(len(z)) * SECOND, Spot(position=z))}
    built = both.build(method=imm(MOVES, STAYS, transition=STAY, method=method), gate=0.999)
    result = all_engines(built, inputs)
    assert len(result["log_likelihood"]) == len(z)
    all_engines(both.build(method=mmae(MOVES, STAYS, method=method)), inputs)
    assert {"filter/predict", "filter/correct", "filter/posterior"} <= {s.path for s in lower(built).stages}


def test_a_bank_without_transitions_is_its_filters_weighed_by_their_likelihood():
    _, z = crassidis(50)
    inputs = {"spot": Series(np.arange(len(z)) * SECOND, Spot(position=z))}
    alone, weight = [], []
    for motion in (MOVES, STAYS):

        @graph
        def single(spot: Stream[Spot], *, motion=motion):
            """One motion."""
            return filtered(motion, {SEEN: spot}, start=START, method=linear())

        result = simulate(single.build(), inputs)
        alone.append(result["output"]["mean"][-1])
        weight.append(result["log_likelihood"]["value"].sum())
    share = np.exp(np.array(weight) - max(weight))
    share /= share.sum()
    for bank in (
        imm(MOVES, STAYS, transition=np.eye(2), method=linear()),
        mmae(MOVES, STAYS, method=linear()),
    ):
        result = simulate(both.build(method=bank), inputs)
        expected = share @ np.array(alone)
        np.testing.assert_allclose(result["output"]["mean"][-1], expected, rtol=1e-12, atol=1e-9)
        whole = result["log_likelihood"]["value"].sum()
        assert whole == pytest.approx(np.logaddexp(*weight) - np.log(2.0), abs=1e-9)


def test_a_bank_without_transitions_is_that_of_filterpy():
    from filterpy.kalman import KalmanFilter, MMAEFilterBank

    _, z = crassidis(60)
    filters = []
    for noise in (Q, 0.0 * Q):
        one = KalmanFilter(6, 2)
        one.F, one.Q, one.H, one.R = F, noise, H, 1e4 * np.eye(2)
        one.x, one.P = START.mean[:, None].copy(), START.covariance.copy()
        filters.append(one)
    bank, means = MMAEFilterBank(filters, [0.3, 0.7], 6, H), []
    for k, seen in enumerate(z):
        if k:
            bank.predict()
        bank.update(seen[:, None])
        means.append(bank.x[:, 0].copy())
    inputs = {"spot": Series(np.arange(len(z)) * SECOND, Spot(position=z))}
    method = mmae(MOVES, STAYS, weights=[0.3, 0.7], method=linear())
    found = simulate(both.build(method=method), inputs)["output"]["mean"]
    assert (np.abs(found - means) / np.maximum(1.0, np.abs(means))).max() < 1e-12


@pytest.mark.filterwarnings("ignore:divide by zero encountered in log")
def test_a_motion_that_lost_does_no_harm():
    """Its weight is zero after a while, and the bank is the filter of the other."""
    wild = DiscreteModel(F, 1e12 * Q + 1e-6 * np.eye(6))
    _, z = crassidis(400)
    inputs = {"spot": Series(np.arange(len(z)) * SECOND, Spot(position=z))}
    found = simulate(both.build(method=mmae(STAYS, wild, method=linear())), inputs)
    alone = simulate(both.build(method=mmae(STAYS, STAYS, method=linear())), inputs)
    assert np.isfinite(found["output"]["mean"]).all()
    np.testing.assert_allclose(found["output"]["mean"][-1], alone["output"]["mean"][-1], rtol=1e-12)


def test_what_is_no_bank_is_refused():
    with pytest.raises(DeclarationError, match=r"this is no bank of motions[\s\S]*1 motions"):
        imm(MOVES)
    with pytest.raises(DeclarationError, match=r"this is no bank of motions"):
        imm(MOVES, STAYS, transition=[[0.9, 0.2], [0.0, 1.0]])
    with pytest.raises(DeclarationError, match=r"mmae: this is no bank of motions[\s\S]*weights"):
        mmae(MOVES, STAYS, weights=[0.5, 0.6])
    with pytest.raises(DeclarationError, match=r"mmae.method: the filters of a bank keep a mean"):
        mmae(MOVES, STAYS, method=particles(10))
    with pytest.raises(DeclarationError, match=r"keep a mean and a covariance"):
        imm(MOVES, STAYS, method=particles(10))
    with pytest.raises(DeclarationError, match=r"the motions of a bank are not of one state"):
        both.build(method=imm(MOVES, constant_velocity(1.0)))
    turn = coordinated_turn(1.0, 0.1)
    with pytest.raises(DeclarationError, match=r"the Kalman filter needs a model that is linear"):
        both.build(method=imm(turn, turn, method=linear()))
    assert imm(constant_acceleration(1.0), constant_acceleration(0.1), method=extended()) is not None
