"""Other people's filters on the same model and the same measurements, where they are installed.

A peer is given the matrices of a step and, where it asks for them, the derivatives, which JAX takes of the
model's own lines (`model_peers_jax`): so a row compares with another library both the filter and the
Jacobians. Where a peer has noise that is added only, a noise inside a motion is a part of its state for the
step, which is the same set of sigma points.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.graphs.benches.model_peers_jax import (
    control_at,
    dynamax_extended,
    dynamax_linear,
    dynamax_unscented,
    linearised,
    stonesoup_iterated,
    stonesoup_updated,
)
from flowgraph.graphs.benches.model_problems import Drawn, Problem

__all__ = ["PEERS", "volatility_log_likelihood"]

Found = tuple[np.ndarray, np.ndarray]
"""Means (n, size) and covariances (n, t, t)."""

Peer = Callable[[Problem, Drawn], Found]


def _matrices(problem: Problem) -> tuple[np.ndarray, ...]:
    """F, Q, H and R of a linear problem."""
    x = np.asarray(problem.start.mean)
    _, F, Q = problem.motion.linearised(x, None, problem.step, np)
    _, H, R = problem.measurement.linearised(x, 0.0 * x, None, np)
    return tuple(np.asarray(a) for a in (F, Q, H, R))


def _followed(problem: Problem, run: Drawn, predict: Callable, update: Callable, found: Callable) -> Found:
    means, covariances = [], []
    for k, z in enumerate(run.inputs["z"]["value"]):
        if k:
            predict(control_at(run, k))
        update(z)
        mean, covariance = found()
        means.append(np.ravel(mean).copy())
        covariances.append(np.array(covariance))
    return np.array(means), np.array(covariances)


def _filterpy_linear(kind: str) -> Peer:
    def run_it(problem: Problem, run: Drawn) -> Found:
        import filterpy.kalman  # a peer, which is there with the extra `bench` alone

        F, Q, H, R = _matrices(problem)
        one = getattr(filterpy.kalman, kind)(F.shape[0], H.shape[0])
        one.F, one.Q, one.H = F, Q, H
        one.x = np.array(problem.start.mean)[:, None]
        P = np.array(problem.start.covariance)
        if kind == "InformationFilter":
            one.R_inv, one.P_inv = np.linalg.inv(R), np.linalg.inv(P)
            one.compute_log_likelihood = False
            found = lambda: (one.x, np.linalg.inv(one.P_inv))
        else:
            one.R, one.P = R, P
            found = lambda: (one.x, one.P)
        return _followed(problem, run, lambda u: one.predict(), lambda z: one.update(z[:, None]), found)

    return run_it


def _filterpy_extended(problem: Problem, run: Drawn) -> Found:
    """On the error of the state, so that it can be an attitude: each correction is folded in."""
    from filterpy.kalman import ExtendedKalmanFilter  # a peer, which is there with the extra `bench` alone

    space = problem.motion.space
    move, see = linearised(problem)
    x, t = np.array(problem.start.mean), space.tangent
    _, _, R = see(x)
    one = ExtendedKalmanFilter(t, R.shape[0])
    one.R, one.P, one.x = R, np.array(problem.start.covariance), np.zeros((t, 1))

    def predict(u: Any) -> None:
        nonlocal x
        x, one.F, one.Q = move(x, u)
        one.predict()

    def update(z: np.ndarray) -> None:
        nonlocal x
        seen, H, _ = see(x)
        apart = problem.measurement.apart(z, seen, np)[:, None]
        one.update(z[:, None], lambda d: H, lambda d: apart, residual=lambda z, apart: apart)
        d = one.x[:, 0]
        turn = space.reset(d, np)
        if turn is not None:
            one.P = turn @ one.P @ turn.T
        x, one.x = np.asarray(space.plus(x, d, np)), np.zeros((t, 1))

    return _followed(problem, run, predict, update, lambda: (x, one.P))


def _filterpy_points(cubature: bool) -> Peer:
    def run_it(problem: Problem, run: Drawn) -> Found:
        # a peer, which is there with the extra `bench` alone
        from filterpy.kalman import CubatureKalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
        from filterpy.kalman.CubatureKalmanFilter import spherical_radial_sigmas

        motion, seen, t = problem.motion, problem.measurement, problem.motion.space.tangent
        R = np.asarray(seen.covariance(None, run.inputs["z"]["value"].shape[-1], np.float64, np))
        shaken = motion.noise_root(control_at(run, 0), problem.step, np.float64, np)
        wide = t + shaken.shape[-1]
        see = lambda s: np.asarray(seen.seen(s, None, None, np))
        apart = lambda a, b: np.reshape(seen.apart(np.ravel(a), np.ravel(b), np), np.shape(a))

        def made(n: int, go: Any) -> Any:
            if cubature:
                return CubatureKalmanFilter(n, len(R), problem.step, hx=see, fx=go, residual_z=apart)
            points = MerweScaledSigmaPoints(n, 1.0, 2.0, 0.0)
            return UnscentedKalmanFilter(n, len(R), problem.step, see, go, points, residual_z=apart)

        now: list[Any] = [None]
        go = lambda s, dt: np.concatenate([np.asarray(motion.carry(s[:t], now[0], s[t:], dt, np)), s[t:]])
        moving, seeing = made(wide, go), made(t, lambda s, dt: s)
        moving.Q = np.zeros((wide, wide))
        flat = (lambda a: a[:, None]) if cubature else (lambda a: a)
        seeing.x, seeing.P, seeing.R = (
            flat(np.array(problem.start.mean)),
            np.array(problem.start.covariance),
            R,
        )

        def predict(u: Any) -> None:
            now[0] = u
            root = motion.noise_root(u, problem.step, np.float64, np)
            moving.x = flat(np.concatenate([np.ravel(seeing.x), np.zeros(wide - t)]))
            moving.P = np.block(
                [[seeing.P, np.zeros((t, wide - t))], [np.zeros((wide - t, t)), root @ root.T]]
            )
            moving.predict()
            seeing.x, seeing.P = flat(np.ravel(moving.x)[:t]), moving.P[:t, :t].copy()

        def update(z: np.ndarray) -> None:
            if cubature:
                seeing.sigmas_f = spherical_radial_sigmas(seeing.x, seeing.P)
            else:
                seeing.sigmas_f = seeing.points_fn.sigma_points(seeing.x, seeing.P)
            seeing.update(z[:, None] if cubature else z)

        return _followed(problem, run, predict, update, lambda: (seeing.x, seeing.P))

    return run_it


def _pykalman(root: bool) -> Peer:
    def run_it(problem: Problem, run: Drawn) -> Found:
        # a peer, which is there with the extra `bench` alone
        from pykalman import KalmanFilter
        from pykalman.sqrt import CholeskyKalmanFilter

        F, Q, H, R = _matrices(problem)
        one = (CholeskyKalmanFilter if root else KalmanFilter)(
            transition_matrices=F,
            observation_matrices=H,
            transition_covariance=Q,
            observation_covariance=R,
            initial_state_mean=problem.start.mean,
            initial_state_covariance=problem.start.covariance,
        )
        means, covariances = one.filter(run.inputs["z"]["value"])
        return np.asarray(means), np.asarray(covariances)

    return run_it


def volatility_log_likelihood(problem: Problem, run: Drawn) -> float:
    """Of the measurements of a state of one number, by sums over a fine grid of it: no peer, but exact."""
    start, motion, seen = problem.start, problem.motion, problem.measurement
    x = np.linspace(-6.0, 6.0, 1201)[:, None]
    moved = np.asarray(motion.carry(x, None, None, problem.step, np))[:, 0]
    root = motion.noise_root(None, problem.step, np.float64, np)[0, 0]
    one = np.ones((len(x), 1))
    deviation = np.asarray(seen.seen(x, one, None, np))[:, 0]
    kernel = np.exp(-0.5 * ((x - moved) / root) ** 2)
    kernel /= kernel.sum(axis=0)
    mass = np.exp(-0.5 * (x[:, 0] - start.mean[0]) ** 2 / start.covariance[0, 0])
    mass, total = mass / mass.sum(), 0.0
    for k, z in enumerate(run.inputs["z"]["value"][:, 0]):
        mass = kernel @ mass if k else mass
        mass = mass * np.exp(-0.5 * (z / deviation) ** 2) / (np.sqrt(2.0 * np.pi) * deviation)
        total += np.log(mass.sum())
        mass = mass / mass.sum()
    return float(total)


_POINTS = ("filterpy", _filterpy_points(cubature=False))
_CUBATURE = ("filterpy", _filterpy_points(cubature=True))
_EXTENDED = ("filterpy", _filterpy_extended)
_ITERATED = ("stonesoup", stonesoup_iterated(3))
_KALMAN = [
    ("filterpy", _filterpy_linear("KalmanFilter")),
    ("pykalman", _pykalman(root=False)),
    ("dynamax", dynamax_linear),
]
_DYNAMAX = ("dynamax", dynamax_extended), ("dynamax", dynamax_unscented)

PEERS: dict[tuple[str, str], list[tuple[str, Peer]]] = {
    ("point", "linear"): _KALMAN,
    ("point", "extended"): [*_KALMAN, _DYNAMAX[0]],
    ("point", "iterated"): [_ITERATED],
    ("point", "square_root"): [
        ("filterpy", _filterpy_linear("SquareRootKalmanFilter")),
        ("pykalman", _pykalman(root=True)),
    ],
    ("point", "information"): [("filterpy", _filterpy_linear("InformationFilter"))],
    ("point", "unscented"): [_POINTS, _DYNAMAX[1]],
    ("point", "cubature"): [_CUBATURE],
    **{
        (problem, method): peers
        for problem in ("radar", "ranges", "turn", "bicycle", "pendulum")
        for method, peers in (
            ("extended", [_EXTENDED]),
            ("square_root", [_EXTENDED]),
            ("information", [_EXTENDED]),
            ("iterated", [_ITERATED]),
            ("unscented", [_POINTS]),
            ("cubature", [_CUBATURE]),
        )
    },
    **{("pose", method): [_EXTENDED] for method in ("extended", "square_root", "information")},
    ("radar", "extended"): [_EXTENDED, _DYNAMAX[0]],
    ("ranges", "extended"): [_EXTENDED, _DYNAMAX[0]],
    ("turn", "extended"): [_EXTENDED, _DYNAMAX[0]],
    ("radar", "unscented"): [_POINTS, _DYNAMAX[1]],
    ("ranges", "unscented"): [
        _POINTS,
        _DYNAMAX[1],
        ("stonesoup", stonesoup_updated("UnscentedKalmanUpdater", alpha=1.0, beta=2.0, kappa=0.0)),
    ],
    ("ranges", "cubature"): [_CUBATURE, ("stonesoup", stonesoup_updated("CubatureKalmanUpdater"))],
}
"""By problem and method: the libraries that have it, each with its run."""
