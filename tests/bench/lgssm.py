"""A linear Gaussian model of 2,000 steps in XLA, beside the filter of dynamax, which is a scan too.

A point with a velocity in the plane whose place is measured at each step. Both are compiled once and given
the same numbers; what is timed of ours is the loop. The pass over all steps at once, `linear_pass`, stands
beside the same peer: on few cores its tenfold work is no gain, which the row says.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

import numpy as np

from flowgraph import Array, Series, Signal, Stream, block, delay, graph, periodic, real, simulate
from flowgraph.blocks.kalman.parallel import LinearSteps, linear_pass
from tests.bench.rows import Row, interleaved, missing, seconds

DT, PERIOD_NS = 0.01, 10_000_000
F = np.eye(4) + DT * np.eye(4, k=2)
Q = np.diag([1e-6, 1e-6, 1e-3, 1e-3])
H, R = np.eye(2, 4), 0.01 * np.eye(2)
MEAN, COVARIANCE = np.zeros(4), np.eye(4)


class Seen(Signal):
    place: Array = real(2)


class Known(Signal):
    mean: Array = real(4)
    covariance: Array = real(4, 4)


@block
def step(belief: Known, seen: Seen, *, xp: Any) -> Known:
    """Correct by what was measured."""
    S = H @ belief.covariance @ H.T + R
    K = xp.linalg.solve(S, H @ belief.covariance).mT
    off = seen.place - belief.mean[:2]
    return Known(mean=belief.mean + K @ off, covariance=belief.covariance - K @ S @ K.mT)


@block
def move(belief: Known) -> Known:
    """Predict to the next measurement."""
    return Known(mean=F @ belief.mean, covariance=F @ belief.covariance @ F.T + Q)


@graph
def linear(seen: Stream[Seen]):
    """The Kalman filter; `start` is the belief at the first measurement."""
    held = delay(Known(mean=MEAN, covariance=COVARIANCE), name="held")
    found = step(held, seen)
    held.feed(move(found))
    return {"belief": found}


def measured(count: int) -> np.ndarray:
    """(count, 2) places of a body that turns, with noise."""
    angle = np.arange(count) * DT
    noise = np.random.default_rng(0).normal(size=(count, 2)) * 0.1
    return np.stack([np.sin(angle), np.cos(angle)], axis=-1) + noise


def rows(*, steps: int = 2000, repeats: int = 15) -> list[Row]:
    """Microseconds a step of the compiled loop, and of the pass over all steps at once."""
    import jax

    z = measured(steps)
    inputs = {"seen": Series(np.arange(steps) * PERIOD_NS, Seen(place=z), name="seen")}
    built = linear.build(seen=periodic(PERIOD_NS))
    ours = lambda: simulate(built, inputs, engine="xla")
    loop = lambda: ours().wall_s * 1e6 / steps
    name, at_once = f"LGSSM of {steps:,} steps, xla: loop", f"LGSSM of {steps:,} steps, xla: all at once"
    try:
        dynamax = import_module("dynamax.linear_gaussian_ssm")
    except ImportError as error:
        return [missing(name, loop(), "us/step", "dynamax", error)]
    belief = ours()["belief"]
    with jax.enable_x64(True):
        jnp = jax.numpy
        model = dynamax.LinearGaussianSSM(4, 2, has_dynamics_bias=False, has_emissions_bias=False)
        params, _ = model.initialize(
            jax.random.key(0), initial_mean=jnp.asarray(MEAN), initial_covariance=jnp.asarray(COVARIANCE),
            dynamics_weights=jnp.asarray(F), dynamics_covariance=jnp.asarray(Q),
            emission_weights=jnp.asarray(H), emission_covariance=jnp.asarray(R),
        )  # fmt: skip
        filtered = jax.jit(lambda z: dynamax.lgssm_filter(params, z))
        # the first measurement is one of the start: no step comes before it
        each = lambda one, first: np.concatenate([first[None], np.broadcast_to(one, (steps - 1, *one.shape))])
        told = LinearSteps(
            F=each(F, np.eye(4)), u=np.zeros((steps, 4)), Q=each(Q, np.zeros((4, 4))), H=each(H, H),
            R=each(R, R), z=z,
        )  # fmt: skip
        passed = jax.jit(
            lambda told: linear_pass(
                told, jnp.asarray(MEAN), jnp.asarray(COVARIANCE), way="parallel", xp=jnp
            )[:2]
        )

    def peer() -> tuple[np.ndarray, np.ndarray]:
        with jax.enable_x64(True):
            found = filtered(z)
            return np.asarray(found.filtered_means), np.asarray(found.filtered_covariances)

    def joined() -> tuple[np.ndarray, np.ndarray]:
        with jax.enable_x64(True):
            mean, covariance = passed(told)
            return np.asarray(mean), np.asarray(covariance)

    for mean, covariance in (peer(), joined()):
        np.testing.assert_allclose(
            belief["mean"], mean, rtol=0.0, atol=1e-6
        )  # dynamax adds 1e-9 to what it solves
        np.testing.assert_allclose(belief["covariance"], covariance, rtol=0.0, atol=1e-6)
    np.testing.assert_allclose(belief["mean"], joined()[0], rtol=0.0, atol=1e-9)
    cost = lambda work: lambda: seconds(work) * 1e6 / steps
    against = "dynamax lgssm_filter"
    mine, theirs, ratio = interleaved(loop, cost(peer), repeats)
    found = [Row(name, mine, theirs, "us/step", against, ratio, "ratio <= 1", ratio <= 1.0)]
    mine, theirs, ratio = interleaved(cost(joined), cost(peer), repeats)
    return [*found, Row(at_once, mine, theirs, "us/step", against, ratio)]
