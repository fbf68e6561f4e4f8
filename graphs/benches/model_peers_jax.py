"""Peers whose functions are the model's own lines on arrays of JAX, which differentiates them.

dynamax does so itself; Stone Soup and filterpy are handed what JAX found. All in double precision.
"""

from __future__ import annotations

import contextlib
import warnings
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from typing import Any

import numpy as np

from flowgraph.graphs.benches.model_problems import Drawn, Problem

__all__ = [
    "control_at",
    "dynamax_extended",
    "dynamax_linear",
    "dynamax_unscented",
    "linearised",
    "stonesoup_iterated",
    "stonesoup_updated",
]

Found = tuple[np.ndarray, np.ndarray]

_FINE = 1e4
"""Measurements are told to dynamax in so small a unit: it adds 1e-9 to the variances that it divides by."""


def control_at(run: Drawn, k: int) -> Any:
    """The control of a step; None where there is none."""
    told = run.inputs.get("control")
    return None if told is None else told[k]


@contextlib.contextmanager
def _double() -> Iterator[Any]:
    """JAX in double precision, for as long as a peer runs."""
    import jax as library  # of the extra `xla`, and of the peers themselves

    jax: Any = library
    before = jax.config.jax_enable_x64
    jax.config.update("jax_enable_x64", True)
    try:
        yield jax
    finally:
        jax.config.update("jax_enable_x64", before)


class _Smooth:
    """`jax.numpy` in which the length of nothing has a slope, 0, where JAX has NaN."""

    def __init__(self, jnp: Any) -> None:
        self._jnp = jnp

    def sqrt(self, x: Any) -> Any:
        some = x > 0.0
        return self._jnp.where(some, self._jnp.sqrt(self._jnp.where(some, x, 1.0)), 0.0)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._jnp, name)


def linearised(problem: Problem) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """`move(x, u) -> (x', F, Q)` and `see(x) -> (z, H, R)`, with the derivatives of JAX."""
    motion, seen, dt = problem.motion, problem.measurement, problem.step
    space, t = motion.space, motion.space.tangent

    with _double() as jax:
        jnp = _Smooth(jax.numpy)

        def moved(c: Any, x: Any, after: Any, told: dict[str, Any] | None) -> Any:
            makes: Any = problem.control_type
            u = None if told is None else makes(**told)
            start = space.plus(x[None, :], c[None, :t], jnp)
            return space.minus(motion.carry(start, u, c[None, t:], dt, jnp), after[None, :], jnp)[0]

        def apart(d: Any, x: Any, z: Any) -> Any:
            return seen.apart(seen.seen(space.plus(x[None, :], d[None, :], jnp), None, None, jnp), z, jnp)[0]

        move_by, see_by = jax.jit(jax.jacfwd(moved)), jax.jit(jax.jacfwd(apart))

    def move(x: np.ndarray, u: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        root = motion.noise_root(u, dt, np.float64, np)
        still = np.zeros((1, root.shape[-1]))
        after = np.asarray(motion.carry(x[None, :], u, still, dt, np))[0]
        told = None if u is None else {name: np.asarray(getattr(u, name)) for name in u._fields}
        with _double():
            both = np.asarray(move_by(np.zeros(t + root.shape[-1]), x, after, told))
        G = both[:, t:] @ root
        return after, both[:, :t], G @ G.T

    def see(x: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        z = np.asarray(seen.seen(x[None, :], None, None, np))[0]
        with _double():
            H = np.asarray(see_by(np.zeros(t), x, z))
        return z, H, np.asarray(seen.covariance(None, len(H), np.float64, np))

    return move, see


def _dynamax(problem: Problem, run: Drawn) -> tuple[Any, Any]:
    """The parameters and the measurements, of a motion whose noise is added."""
    from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM  # a peer, with the extra `bench` alone

    with _double() as jax:
        jnp = _Smooth(jax.numpy)
        motion, seen, dt = problem.motion, problem.measurement, problem.step
        move, see = linearised(problem)
        _, _, Q = move(np.array(problem.start.mean), None)
        _, _, R = see(np.array(problem.start.mean))
        n = motion.noise_root(None, dt, np.float64, np).shape[-1]
        still = jnp.zeros((1, n))
        params = ParamsNLGSSM(
            initial_mean=jnp.asarray(problem.start.mean),
            initial_covariance=jnp.asarray(problem.start.covariance),
            dynamics_function=lambda x: motion.carry(x[None, :], None, still, dt, jnp)[0],
            dynamics_covariance=jnp.asarray(Q),
            emission_function=lambda x: _FINE * seen.seen(x[None, :], None, None, jnp)[0],
            emission_covariance=jnp.asarray(_FINE**2 * R),
        )
        return params, _FINE * jnp.asarray(run.inputs["z"]["value"])


def dynamax_extended(problem: Problem, run: Drawn) -> Found:
    """The extended filter of dynamax."""
    from dynamax.nonlinear_gaussian_ssm import extended_kalman_filter  # a peer, as above

    with _double():
        params, z = _dynamax(problem, run)
        found = extended_kalman_filter(params, z)
        return np.asarray(found.filtered_means), np.asarray(found.filtered_covariances)


def dynamax_unscented(problem: Problem, run: Drawn) -> Found:
    """The unscented filter of dynamax, whose points are those of a motion that is linear."""
    # a peer, as above
    from dynamax.nonlinear_gaussian_ssm import UKFHyperParams, unscented_kalman_filter

    with _double():
        params, z = _dynamax(problem, run)
        found = unscented_kalman_filter(params, z, UKFHyperParams(alpha=1.0, beta=2, kappa=0))
        return np.asarray(found.filtered_means), np.asarray(found.filtered_covariances)


def dynamax_linear(problem: Problem, run: Drawn) -> Found:
    """The Kalman filter of dynamax."""
    from dynamax.linear_gaussian_ssm import LinearGaussianSSM, lgssm_filter  # a peer, as above

    with _double() as jax:
        params, z = _dynamax(problem, run)
        move, see = linearised(problem)
        x = np.array(problem.start.mean)
        model = LinearGaussianSSM(len(x), z.shape[-1])
        made, _ = model.initialize(
            jax.random.PRNGKey(0),
            initial_mean=params.initial_mean,
            initial_covariance=params.initial_covariance,
            dynamics_weights=jax.numpy.asarray(move(x, None)[1]),
            dynamics_covariance=params.dynamics_covariance,
            emission_weights=_FINE * jax.numpy.asarray(see(x)[1]),
            emission_covariance=params.emission_covariance,
        )
        found = lgssm_filter(made, z)
        return np.asarray(found.filtered_means), np.asarray(found.filtered_covariances)


def stonesoup_iterated(iterations: int) -> Callable[[Problem, Drawn], Found]:
    """The iterated update of Stone Soup, linearised so often."""
    return stonesoup_updated("IteratedKalmanUpdater", tolerance=0.0, max_iterations=iterations - 2)


def stonesoup_updated(updater: str, **settings: Any) -> Callable[[Problem, Drawn], Found]:
    """An update of Stone Soup, after predictions with the derivatives of JAX; of vectors and angles."""

    def run_it(problem: Problem, run: Drawn) -> Found:
        # a peer, which is there with the extra `bench` alone
        from stonesoup.models.measurement.nonlinear import NonLinearGaussianMeasurement
        from stonesoup.types.array import StateVector, StateVectors
        from stonesoup.types.detection import Detection
        from stonesoup.types.hypothesis import SingleHypothesis
        from stonesoup.types.prediction import GaussianStatePrediction
        from stonesoup.updater import iterated, kalman

        move, see = linearised(problem)
        x, P = np.array(problem.start.mean), np.array(problem.start.covariance)
        R = see(x)[2]

        class Seen(NonLinearGaussianMeasurement):
            ndim_meas = len(R)

            def function(self, state: Any, noise: Any = False, **_: Any) -> Any:
                rows = np.array(state.state_vector, dtype=float).T
                z = np.asarray(problem.measurement.seen(rows, None, None, np)).T
                return z.view(StateVectors) if z.shape[1] > 1 else StateVector(z)

            def jacobian(self, state: Any, **_: Any) -> Any:
                return see(np.array(state.state_vector, dtype=float)[:, 0])[1]

        seen = Seen(ndim_state=len(x), mapping=tuple(range(len(x))), noise_covar=R)
        makes = getattr(kalman, updater, None) or getattr(iterated, updater)
        one = makes(measurement_model=seen, **settings)
        now, means, covariances = datetime(2020, 1, 1), [], []
        for k, z in enumerate(run.inputs["z"]["value"]):
            if k:
                x, F, Q = move(x, control_at(run, k))
                P = F @ P @ F.T + Q
            prior = GaussianStatePrediction(x[:, None], P, timestamp=now)
            what = Detection(np.array(z)[:, None], timestamp=now, measurement_model=seen)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # it says that its iteration was ended
                posterior = one.update(SingleHypothesis(prior, what))
            x = np.array(posterior.mean, dtype=float)[:, 0]
            P = np.array(posterior.covar, dtype=float)
            means.append(x.copy())
            covariances.append(P)
            now += timedelta(seconds=problem.step)
        return np.array(means), np.array(covariances)

    return run_it
