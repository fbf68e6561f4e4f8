"""A point in the plane that is followed by particles: the smallest problem on which a particle filter can be
judged.

What is measured is linear in the position and all noise is Gaussian, so the exact belief is known, `exact`,
and what a particle filter adds to its error is the cost of sampling alone.

Source: N. Gordon, D. Salmond and A. Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation", IEE Proceedings F 140(2), 1993 (the bootstrap filter).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Flight, Result, Scalar, Series, block
from flowgraph.blocks.filtering.simulation import CloudSteps
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.blocks.particles.resampling import ancestor_index
from flowgraph.blocks.signals import (
    Ancestors,
    PlaneBelief,
    PlaneCloud,
    PlanePosition,
    PlaneVelocity,
    StateCloud,
)
from flowgraph.recorder.random import NumpyDraw, seed_words

__all__ = [
    "average_plane",
    "cloud_steps",
    "exact",
    "move_plane",
    "plane_sample_size",
    "plane_states",
    "resample_plane",
    "start_plane",
    "weigh_plane",
]


@block
def move_plane(
    cloud: PlaneCloud, velocity: PlaneVelocity, *, noise: float, dt: float, draw: Any, xp: Any
) -> PlaneCloud:
    """Move each point by the velocity and a drawn error: x' = x + v dt + noise sqrt(dt) e, e ~ N(0, I).

    Fires when its inputs do; with dt = 0, as at the first firing, this is the identity. Draws `error` (2, n).

    Args:
        velocity: that of the time since the last firing, m/s.
        noise: density of its error, m/s/sqrt(Hz).
    """
    error = xp.asarray(draw.normal("error", cloud.position.shape), dtype=cloud.position.dtype)
    moved = cloud.position + velocity.velocity[:, None] * dt
    return cloud.replace(position=moved + error * (noise * xp.sqrt(dt)))


@block
def weigh_plane(cloud: PlaneCloud, measured: PlanePosition, *, noise: float, xp: Any) -> PlaneCloud:
    """Multiply the weights by the likelihood of z = x + N(0, noise^2 I), and normalise.

    Args:
        measured: z, m; an entry that is NaN was not measured.
        noise: standard deviation on each axis, m.
    """
    error = measured.position[:, None] - cloud.position
    error = xp.where(xp.isnan(error), 0.0, error)
    log_weight = cloud.log_weight - xp.sum(error * error, axis=0) * (0.5 / noise**2)
    return cloud.replace(log_weight=log_weight - log_sum_exp(log_weight, xp=xp))


@block
def plane_sample_size(cloud: PlaneCloud, *, xp: Any) -> Scalar:
    """1 / sum(w^2): how many equally weighted points would be as good, from 1 to n."""
    weight = xp.exp(cloud.log_weight)
    return 1.0 / (weight @ weight)


@block
def resample_plane(
    cloud: PlaneCloud, effective_sample_size: Scalar, *, below: float, scheme: str, draw: Any, xp: Any
) -> tuple[PlaneCloud, Ancestors]:
    """Draw the points anew, as often as their weights say, where effective_sample_size < below n.

    Args:
        below: a fraction of the number of points; 0 never resamples, above 1 always.
        scheme: systematic, stratified, residual or multinomial.
    """
    n = cloud.log_weight.shape[-1]
    drawn = ancestor_index(xp.exp(cloud.log_weight), scheme=scheme, draw=draw, xp=xp)
    resampled = effective_sample_size < below * n
    index = xp.astype(xp.where(resampled, drawn, xp.arange(n, dtype=xp.int64)), xp.int32)
    fresh = PlaneCloud(
        log_weight=xp.where(resampled, -math.log(n), cloud.log_weight),
        position=xp.take(cloud.position, index, axis=-1),
    )
    return fresh, Ancestors(index=index, resampled=resampled)


@block
def average_plane(cloud: PlaneCloud, *, xp: Any) -> PlaneBelief:
    """The weighted mean and covariance of the points."""
    weight = xp.exp(cloud.log_weight)
    mean = cloud.position @ weight
    apart = cloud.position - mean[:, None]
    return PlaneBelief(position=mean, covariance=(apart * weight) @ apart.mT)


@block
def plane_states(cloud: PlaneCloud) -> StateCloud:
    """The points as states, one a row."""
    return StateCloud(log_weight=cloud.log_weight, state=cloud.position.mT)


def cloud_steps(result: Result, noise: float) -> CloudSteps:
    """What smooths a run of `particle` that was wired for it.

    Args:
        noise: density of the velocity's error, m/s/sqrt(Hz).
    """

    def named(smoothed: Series) -> Series:
        belief = PlaneBelief(position=smoothed["mean"], covariance=smoothed["covariance"])
        return Series(smoothed.time, belief, name=smoothed.name)

    moves = LinearModel(np.zeros((2, 2)), np.eye(2), np.full(2, noise**2))
    control = result["control"]
    return CloudSteps(result["cloud"], moves, named, control.holding(control["velocity"]))


def start_plane(
    particles: int, *, seed: int = 0, position: npt.ArrayLike = (0.0, 0.0), spread: float = 1.0
) -> PlaneCloud:
    """Equally weighted points (n) about a position (2,), with a standard deviation on each axis, m."""
    draw = NumpyDraw("start_plane", seed_words(seed), 0)
    middle = np.asarray(position, dtype=float)[:, None]
    points = middle + spread * draw.normal("position", (2, particles))
    return PlaneCloud(log_weight=np.full(particles, -math.log(particles)), position=points)


def exact(flight: Flight, *, spread: float) -> Series:
    """The belief that no filter can better, `PlaneBelief` at every tick: a Kalman filter.

    Args:
        flight: of `sim:plane`; info: `velocity_noise` (m/s/sqrt(Hz)) and `position_noise` (m).
        spread: standard deviation of the start, about the origin, m.
    """
    velocity, position = flight.streams["velocity"], flight.streams["position"]
    q, r = flight.info["velocity_noise"] ** 2, flight.info["position_noise"] ** 2
    time = np.union1d(velocity.time, position.time)
    held = np.searchsorted(velocity.time, time, side="right") - 1
    seen = np.searchsorted(position.time, time)
    x, p, before = np.zeros(2), spread**2, int(time[0])
    means, variances = [], []
    for k, now in enumerate(time):
        dt = (int(now) - before) * 1e-9
        x, p, before = x + velocity["velocity"][held[k]] * dt, p + q * dt, int(now)
        if seen[k] < len(position) and position.time[seen[k]] == now:
            gain = p / (p + r)
            x, p = x + gain * (position["position"][seen[k]] - x), (1.0 - gain) * p
        means.append(x)
        variances.append(p * np.eye(2))
    belief = PlaneBelief(position=np.array(means), covariance=np.array(variances))
    return Series(time, belief, name="exact")
