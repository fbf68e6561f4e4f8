"""Backward simulation: whole trajectories drawn from what a particle filter believes, given all measurements.

A filter's clouds, each at its own tick, say nothing together: their ancestors have died out a few resamplings
ago. Backward simulation draws a state from the last cloud and goes back; at each tick it draws one of the
particles by how likely it went over to the state that was drawn after it:

    p(x_k = x_i | x_k+1, z_1..z_k)  ~  w_i p(x_k+1 | x_i)

so that a trajectory is one draw from p(x_1..x_n | z_1..z_n), and many are the smoothed belief. The density of
a step is that of the noise about each particle, x_k+1 minus move(x_i, 0) ~ N(0, G G^T) with G = dx'/de,
exact where the noise is added. Runs on the host, after the run: the draws of one tick pick from all particles
at the tick before, which no fixed pipeline would be any faster at.

Source: S. Godsill, A. Doucet, M. West, "Monte Carlo smoothing for nonlinear time series", JASA 99, 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.kalman.smoothing import lag_ticks
from flowgraph.blocks.signals import Gaussian
from flowgraph.blocks.statespace import Motion
from flowgraph.errors import DataError, DeclarationError
from flowgraph.language.checks import need_count
from flowgraph.recorder.derivatives import jacobian

__all__ = ["CloudSteps", "backward_simulation", "smoothed_cloud"]

LEAST = 1e-12
"""Below what part of the largest the smallest variance of a step, each in its own unit, counts as none."""


def backward_simulation(
    cloud: Series, motion: Motion, *, trajectories: int = 200, control: Series | None = None, seed: int = 0
) -> np.ndarray:
    """Trajectories (trajectories, n, size) drawn from the belief about all n ticks, given all measurements.

    Args:
        cloud: the `StateCloud` of each tick, as `filtered(..., method=particles(N), smoothing=True)` collects
            it.
        motion: of the filter.
        trajectories: how many.
        control: which the filter collected, where it has one.
        seed: of the draws.

    Raises:
        DeclarationError: for a motion without noise in some direction: its steps have no density.
        DataError: where a control is not of the ticks of the clouds.
    """
    need_count("backward_simulation", "trajectories", trajectories, least=1)
    if control is not None and not np.array_equal(control.time, cloud.time):
        raise DataError(
            "the controls are not of the ticks of the clouds",
            path="backward_simulation.control",
            expected=f"the times of {cloud!r}",
            got=repr(control),
            fix='give the "control" that the same run collected',
        )
    rng = np.random.default_rng(seed)
    state, log_weight = cloud["state"], cloud["log_weight"]
    n, size = len(cloud), state.shape[-1]
    drawn = np.empty((trajectories, n, size))
    weight = np.exp(log_weight[-1] - log_weight[-1].max())
    drawn[:, -1] = state[-1][rng.choice(len(weight), size=trajectories, p=weight / weight.sum())]
    for k in range(n - 2, -1, -1):
        dt = (cloud.time[k + 1] - cloud.time[k]) * 1e-9
        u = None if control is None else control[k + 1]
        density = _step_density(state[k], drawn[:, k + 1], motion, u, dt)
        score = log_weight[k] + density
        score -= score.max(axis=1, keepdims=True)
        heap = np.cumsum(np.exp(score), axis=1)
        picked = (heap < rng.uniform(size=(trajectories, 1)) * heap[:, -1:]).sum(axis=1)
        drawn[:, k] = state[k][picked]
    return drawn


def smoothed_cloud(
    cloud: Series, motion: Motion, *, trajectories: int = 200, control: Series | None = None, seed: int = 0
) -> Series:
    """The mean and covariance at every tick of so many trajectories of `backward_simulation`."""
    drawn = backward_simulation(cloud, motion, trajectories=trajectories, control=control, seed=seed)
    space, even = motion.space, np.full(trajectories, 1.0 / trajectories)
    points = np.swapaxes(drawn, 0, 1)
    mean = np.asarray(space.mean(points, even, np))
    apart = np.asarray(space.minus(points, mean[:, None, :], np))
    P = apart.mT @ apart / trajectories
    return Series(cloud.time, Gaussian(mean=mean, covariance=P), name="smoothed")


class CloudSteps(NamedTuple):
    """What smooths a run of particles: the `StateCloud` of each tick, the motion, the control of each step,
    and `named`, which makes beliefs with names of what it gives back."""

    cloud: Series
    motion: Motion
    named: Callable[[Series], Series]
    control: Series | None = None

    def smoothed(self) -> Series:
        """The whole run (`smoothed_cloud`)."""
        return smoothed_cloud(self.cloud, self.motion, control=self.control)

    def lagged(self, seconds: float) -> Series:
        """Each tick with what came until so much later: of backward simulation from there, its first.

        Every tick needs trajectories of its own, so this takes as long as `smoothed` times the ticks of a
        lag.
        """
        ends = lag_ticks(self.cloud.time, seconds) + np.arange(len(self.cloud))
        found = []
        for k, end in enumerate(ends):
            part = slice(k, int(end) + 1)
            control = None if self.control is None else self.control[part]
            found.append(smoothed_cloud(self.cloud[part], self.motion, control=control)[:1])
        mean, P = (np.concatenate([one[leaf] for one in found]) for leaf in ("mean", "covariance"))
        return Series(self.cloud.time, Gaussian(mean=mean, covariance=P), name="smoothed")


def _step_density(x: np.ndarray, after: np.ndarray, motion: Motion, control: Any, dt: float) -> np.ndarray:
    """The log of the density (m, n), but for a constant, of each state after (m, size) from each before (n,
    size)."""
    space = motion.space
    root = motion.noise_root(control, dt, x.dtype, np)
    size = 0 if root is None else root.shape[-1]
    if root is None or size < space.tangent:
        raise _no_density(space.tangent, size)
    centre = np.asarray(motion.carry(x, control, np.zeros((len(x), size)), dt, np))
    alone = motion.linear and space.flat  # the noise of one particle is that of all
    some, to = (x[:1], centre[:1]) if alone else (x, centre)
    moved = lambda e, xp: space.minus(motion.carry(some, control, e @ root.mT, dt, xp), to, xp)
    G = np.asarray(jacobian(moved, np.zeros((len(some), size)), np)[1])
    Q = G @ G.mT
    scale = np.sqrt(np.maximum(np.diagonal(Q, axis1=-2, axis2=-1), np.finfo(float).tiny))
    alike = np.linalg.eigvalsh(Q / (scale[:, :, None] * scale[:, None, :]))
    if (alike[:, 0] < LEAST * alike[:, -1]).any():
        raise _no_density(space.tangent, int((alike[0] >= LEAST * alike[0, -1]).sum()))
    L = np.linalg.cholesky(Q)
    if alone:
        a, b = (np.linalg.solve(L[0], (y - centre[0]).T).T for y in (after, centre))
        return np.asarray(a @ b.T - 0.5 * np.sum(b * b, axis=1))
    white = np.linalg.inv(L)
    volume = np.log(np.diagonal(L, axis1=-2, axis2=-1)).sum(axis=-1)
    apart = [np.asarray(space.minus(y[None, :], centre, np)) for y in after]  # one (n, t) a trajectory
    return np.stack([-0.5 * np.sum((white @ d[..., None])[..., 0] ** 2, axis=-1) - volume for d in apart])


def _no_density(wanted: int, got: int) -> DeclarationError:
    return DeclarationError(
        "the steps of this motion have no density to go back by",
        path="backward_simulation.motion",
        expected=f"noise in each of the {wanted} directions of the state",
        got=f"in {got}",
        fix="add a little noise to the others, or take a LinearModel, whose noise reaches all",
    )
