"""The batch estimate: a general optimiser's trajectory and covariance, robust losses, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from flowgraph import DataError, DeclarationError, Series, UnknownNameError, simulate
from flowgraph.blocks.filtering import (
    LinearMeasurement,
    Loss,
    MeasurementModel,
    MotionModel,
    cauchy,
    estimate_batch,
    extended,
    huber,
    smooth,
)
from flowgraph.blocks.geometry import StateSpace, quaternion
from flowgraph.blocks.models.tracking import TURNING, constant_velocity
from flowgraph.blocks.signals import Attitude, Gaussian, PlanePosition
from tests.blocks.filtering.turning import GPS, MOTION, NOISE, START, built, driven, missed


def smoothed(seen: Series) -> Series:
    return smooth(simulate(built(extended()), {"position": seen}), TURNING)


def test_it_is_what_a_general_optimiser_finds():
    """Over the start and the noise of every step; the covariance is that of its Jacobian."""
    seen, _ = driven(15)
    z, dt = seen["position"], 0.1
    root = np.asarray(MOTION.noise_root(None, dt, np.float64, np))

    def track(v: np.ndarray) -> np.ndarray:
        x = [START.mean + v[:5]]
        for e in v[5:].reshape(14, 3):
            x.append(np.asarray(MOTION.carry(x[-1], None, root @ e, dt, np)))
        return np.stack(x)

    def residuals(v: np.ndarray) -> np.ndarray:
        first = v[:5] / np.sqrt(np.diag(START.covariance))
        return np.concatenate([first, v[5:], ((z - track(v)[:, :2]) / NOISE).ravel()])

    found = least_squares(residuals, np.zeros(5 + 42), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    batch = estimate_batch(MOTION, {GPS: seen}, start=START, around=smoothed(seen), settled=1e-7)
    np.testing.assert_allclose(batch["mean"], track(found.x), atol=2e-6)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:5, :5]
    np.testing.assert_allclose(batch["covariance"][0], covariance, atol=2e-5)
    assert np.abs(batch["mean"] - smoothed(seen)["mean"]).max() > 1e-3  # and no smoother's


def test_of_a_linear_model_it_is_the_smoother():
    rng = np.random.default_rng(0)
    motion = constant_velocity(1.0)
    seeing = LinearMeasurement(motion.space, np.eye(2, 4), noise=0.01)
    start = motion.space.gaussian(position=((0.0, 0.0), 1.0), velocity=((0.0, 0.0), 1.0))
    seen = Series.from_seconds(np.arange(20) * 0.1, PlanePosition(position=rng.normal(size=(20, 2))))
    rest = Series(seen.time, Gaussian(np.zeros((20, 4)), np.tile(np.eye(4), (20, 1, 1))))
    far = Series(seen.time, Gaussian(rng.normal(size=(20, 4)), np.tile(np.eye(4), (20, 1, 1))))
    one, other = (estimate_batch(motion, {seeing: seen}, start=start, around=a) for a in (rest, far))
    for leaf in ("mean", "covariance", "lag_one"):
        np.testing.assert_allclose(one[leaf], other[leaf], atol=1e-9)


def test_a_loss_makes_little_of_outliers():
    seen, truth = driven(40)
    places = seen["position"].copy()
    places[::10] += 5.0
    wrong = Series(seen.time, PlanePosition(position=places), name="position")
    around, clean = smoothed(wrong), missed(smoothed(seen), truth)
    assert missed(around, truth) > 3.0 * clean
    for loss in (huber(), cauchy()):
        robust = estimate_batch(MOTION, {GPS: wrong}, start=START, around=around, loss=loss, settled=0.02)
        assert missed(robust, truth) < 1.6 * clean


def test_a_loss_weighs_as_its_formula_says():
    for loss, rho in (
        (huber(2.0), lambda e: np.where(e < 2.0, e**2, 4.0 * e - 4.0)),
        (cauchy(2.0), lambda e: 4.0 * np.log1p(e**2 / 4.0)),
    ):
        e, h = np.linspace(0.1, 9.0, 50), 1e-6
        slope = (rho(e + h) - rho(e - h)) / (2.0 * h)
        np.testing.assert_allclose(loss.weight(e**2, np), slope / (2.0 * e), rtol=1e-6)
        assert loss.weight(np.zeros(1), np) == 1.0


def test_on_a_curved_state_it_is_what_a_general_optimiser_finds():
    """An attitude that turns as it likes, 0.4 rad from where it was thought to be."""
    space = StateSpace(attitude=quaternion())
    deviation, density, noise = np.array([0.3, 0.6, 0.4]), np.array([0.1, 0.3, 0.2]), 0.1
    motion = MotionModel(space, lambda x, w, dt, xp: space.plus(x, velocity=(w,), dt=dt), density=density)
    R = np.repeat(noise**2, 3)
    see = MeasurementModel(space, lambda x, xp: x.attitude, noise=R, measured_space=space)
    start = space.gaussian(attitude=((1.0, 0.0, 0.0, 0.0), deviation))
    turns = np.tile(np.asarray(space.plus(space.rest, np.array([0.2, 0.4, 0.3]), np)), (4, 1))
    turns[:-1] = np.nan  # only the last is measured
    seen = Series.from_seconds(np.arange(4) * 0.3, Attitude(attitude=turns), gaps=True)

    def track(v: np.ndarray) -> np.ndarray:
        x = [space.plus(space.rest, deviation * v[:3], np)]
        for e in v[3:].reshape(3, 3):
            x.append(space.plus(x[-1], np.sqrt(density * 0.3) * e, np))
        return np.stack(x)

    residuals = lambda v: np.concatenate([v, space.minus(turns[-1], track(v)[-1], np) / noise])
    found = least_squares(residuals, np.zeros(12), xtol=1e-14, ftol=1e-14, gtol=1e-14)
    around = Series(seen.time, Gaussian(np.tile(space.rest, (4, 1)), np.tile(np.eye(3), (4, 1, 1))))
    batch = estimate_batch(motion, {see: seen}, start=start, around=around, settled=1e-7)
    np.testing.assert_allclose(batch["mean"], track(found.x), atol=1e-5)
    assert np.abs(batch["mean"] - turns[-1]).max() > 0.05


def test_what_it_cannot_do_it_refuses():
    seen, _ = driven(10)
    around = smoothed(seen)
    late = Series(seen.time + 1, seen.values, name="late")
    with pytest.raises(DataError, match=r"at no tick of the trajectory[\s\S]*10 of 10"):
        estimate_batch(MOTION, {GPS: late}, start=START, around=around)
    with pytest.raises(DataError, match=r"does not settle[\s\S]*within 1 rounds"):
        estimate_batch(MOTION, {GPS: seen}, start=START, around=around, rounds=1, settled=1e-12)
    with pytest.raises(UnknownNameError, match="no loss is called 'tukey'"):
        Loss("tukey", 1.0)
    with pytest.raises(DeclarationError, match="a loss has a width"):
        huber(0.0)
