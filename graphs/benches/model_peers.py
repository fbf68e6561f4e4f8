"""Other people's filters on the same model and the same measurements, where they are installed.

What each is given is written out by hand: the matrices of a step, and where it asks for them the Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from flowgraph.graphs.benches.model_problems import BEACONS, Drawn, Problem

__all__ = ["PEERS"]

Found = tuple[np.ndarray, np.ndarray]
"""Means (n, size) and covariances (n, t, t)."""


def _step(problem: Problem) -> tuple[np.ndarray, np.ndarray]:
    x = np.asarray(problem.start.mean)
    _, F, Q = problem.motion.linearised(x, None, problem.step, np)
    return np.asarray(F), np.asarray(Q)


def _filterpy_kalman(problem: Problem, run: Drawn) -> Found:
    from filterpy.kalman import KalmanFilter  # a peer, which is there with the extra `bench` alone

    F, Q = _step(problem)
    one = KalmanFilter(4, 2)
    one.F, one.Q, one.H, one.R = F, Q, np.eye(2, 4), np.eye(2)
    return _each(one, problem, run, lambda z: one.update(z[:, None]))


def _range_bearing(x: np.ndarray) -> np.ndarray:
    p = x.ravel()
    return np.array([[np.hypot(p[0], p[1])], [np.arctan2(p[1], p[0])]])


def _range_bearing_jacobian(x: np.ndarray) -> np.ndarray:
    a, b = x.ravel()[:2]
    r = np.hypot(a, b)
    return np.array([[a / r, b / r, 0.0, 0.0], [-b / r**2, a / r**2, 0.0, 0.0]])


def _wrapped(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    d = a - b
    d[1] = np.pi - (np.pi - d[1]) % (2.0 * np.pi)
    return d


def _filterpy_extended(problem: Problem, run: Drawn) -> Found:
    from filterpy.kalman import ExtendedKalmanFilter  # a peer, which is there with the extra `bench` alone

    F, Q = _step(problem)
    one = ExtendedKalmanFilter(4, 2)
    one.F, one.Q, one.R = F, Q, np.diag([4.0, 4e-4])
    update = lambda z: one.update(z[:, None], _range_bearing_jacobian, _range_bearing, residual=_wrapped)
    return _each(one, problem, run, update)


def _each(one: Any, problem: Problem, run: Drawn, update: Callable[[np.ndarray], None]) -> Found:
    one.x, one.P = np.array(problem.start.mean)[:, None], np.array(problem.start.covariance)
    means, covariances = [], []
    for k, z in enumerate(run.inputs["z"]["value"]):
        if k:
            one.predict()
        update(z)
        means.append(one.x[:, 0].copy())
        covariances.append(one.P.copy())
    return np.array(means), np.array(covariances)


def _stone_soup(updater: str, **settings: Any) -> Callable[[Problem, Drawn], Found]:
    def run_it(problem: Problem, run: Drawn) -> Found:
        # a peer, which is there with the extra `bench` alone
        from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
        from stonesoup.types.array import StateVector, StateVectors
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.prediction import GaussianStatePrediction
        from stonesoup.updater import kalman

        class Ranges(NonLinearGaussianMeasurement):
            ndim_meas = 2

            def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
                p = np.array(state.state_vector, dtype=float)[:2]
                z = np.stack([np.hypot(*(p - np.reshape(b, (2, 1)))) for b in BEACONS])
                return z.view(StateVectors) if z.shape[1] > 1 else StateVector(z)

        F, Q = _step(problem)
        seen = Ranges(ndim_state=4, mapping=(0, 1), noise_covar=np.diag([4.0, 4.0]))
        one = getattr(kalman, updater)(measurement_model=seen, **settings)
        x, P = np.array(problem.start.mean)[:, None], np.array(problem.start.covariance)
        now, means, covariances = datetime(2020, 1, 1), [], []
        for k, z in enumerate(run.inputs["z"]["value"]):
            if k:
                x, P = F @ x, F @ P @ F.T + Q
            prior = GaussianStatePrediction(x, P, timestamp=now)
            what = Detection(np.array(z)[:, None], timestamp=now, measurement_model=seen)
            posterior = one.update(SingleHypothesis(prior, what))
            x, P = np.array(posterior.mean, dtype=float), np.array(posterior.covar, dtype=float)
            means.append(x[:, 0].copy())
            covariances.append(P)
            now += timedelta(seconds=problem.step)
        return np.array(means), np.array(covariances)

    return run_it


PEERS: dict[tuple[str, str], tuple[str, Callable[[Problem, Drawn], Found]]] = {
    ("point", "linear"): ("filterpy", _filterpy_kalman),
    ("point", "extended"): ("filterpy", _filterpy_kalman),
    ("point", "unscented"): ("filterpy", _filterpy_kalman),
    ("radar", "extended"): ("filterpy", _filterpy_extended),
    ("ranges", "unscented"): (
        "stonesoup", _stone_soup("UnscentedKalmanUpdater", alpha=1.0, beta=2.0, kappa=0.0)
    ),
    ("ranges", "cubature"): ("stonesoup", _stone_soup("CubatureKalmanUpdater")),
}  # fmt: skip
"""By problem and method: the library, and its run."""
