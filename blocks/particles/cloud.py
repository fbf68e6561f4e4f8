"""Particles: a belief as weighted samples, carried forward by drawing and corrected by weighing.

Weights live in the log domain, where a likelihood may be e^-1000, and are normalised by log-sum-exp. The
particle is the last axis of every array. Here is what any filter over attitudes needs; what is Gaussian given
a particle is in `rao_blackwell`, resampling in `resampling`.

Source: A. Doucet and A. M. Johansen, "A tutorial on particle filtering and smoothing: fifteen years later",
2009, sec. 3; average attitude: F. L. Markley, Y. Cheng, J. L. Crassidis and Y. Oshman, "Averaging
quaternions", Journal of Guidance, Control, and Dynamics 30(4), 2007.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Scalar, block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.inertial.alignment import StartSpread
from flowgraph.blocks.signals import (
    Attitude,
    Cloud,
    Imu,
    LogLikelihood,
    Pose,
    PoseBelief,
    PoseEstimate,
    Weights,
)
from flowgraph.recorder.random import NumpyDraw, seed_words

__all__ = [
    "attitude_likelihood",
    "average_attitude",
    "average_pose",
    "cloud_at_start",
    "dominant_eigenvector",
    "effective_sample_size",
    "log_sum_exp",
    "cloud_belief",
    "propagate_attitude",
    "reweight",
    "start_cloud",
    "weights",
    "within_depth",
]

START_DRAWS = "start_cloud"
"""What the draws of a cloud to start from are called."""

DEPTH = 64.0
"""How far a particle falls behind the best in one reading at most: exp(-64) is nothing in a sum."""

_BEYOND = 1.01  # times the distance at which a particle no longer matters: surely so

_SQUARINGS = 5
_ALONG = 1e-6  # squared cosine of the angle between the start and the answer, below which it will not do
_SPREAD = StartSpread()


@block
def propagate_attitude(cloud: Cloud, imu: Imu, *, gyro_noise: float, dt: float, draw: Any, xp: Any) -> Cloud:
    """Turn each particle by the measured rate and a drawn error of it (thesis, the proposal of the filter).

        q' = q * Exp(gyro dt + gyro_noise sqrt(dt) e),  e ~ N(0, I) for each particle

    Fires when its inputs do; with dt = 0, as at the first firing, this is the identity. Draws `gyro` (3, n).

    Args:
        cloud: the belief at the last firing; only its attitude changes.
        imu: the reading that held since then; its rate in rad/s, body.
        gyro_noise: white noise of the rate, a density in rad/s/sqrt(Hz).
    """
    errors = draw.normal("gyro", (3, cloud.log_weight.shape[-1]))
    turn = imu.gyro[:, None] * dt + xp.asarray(errors, dtype=imu.gyro.dtype) * (gyro_noise * xp.sqrt(dt))
    return cloud.replace(attitude=lanes.turned(cloud.attitude, turn, xp=xp))


@block
def attitude_likelihood(cloud: Cloud, pose: Pose, *, noise: float, xp: Any) -> LogLikelihood:
    """How well each particle explains a measured attitude z = q * Exp(error), error ~ N(0, noise^2 I).

        log p(z | q) = -|Log(q^-1 * z)|^2 / (2 noise^2) - 3 log(noise) - 3/2 log(2 pi)

    An attitude with a NaN in it was not measured: all particles explain it alike. What is more than 64 below
    the best particle's is put there.

    Args:
        noise: standard deviation about each body axis, rad; small, so that the circle does not matter.
    """
    constant = 3.0 * math.log(noise) + 1.5 * math.log(2.0 * math.pi)
    missing = xp.any(xp.isnan(pose.attitude))
    measured = xp.where(missing, cloud.attitude[:, 0], pose.attitude)
    # who is too far to matter is put aside before the numbers that tell: in words that hold half turns and
    # their squares, the last bit is much beside turns of a few degrees. |e|^2 grows by at least 4 s^2
    sine = lanes.relative_to(cloud.attitude, measured, xp=xp)[1:, :]
    squared = xp.sum(sine * sine, axis=0)
    near = missing | (squared <= xp.min(squared) + _BEYOND * (0.5 * DEPTH * noise**2))
    kept = xp.where(near[None, :], cloud.attitude, measured[:, None])
    error = lanes.rotation_vectors(lanes.relative_to(kept, measured, xp=xp), xp=xp)
    error = xp.where(missing, 0.0, error)
    scaled = xp.sum(error * error, axis=0) * (-0.5 / noise**2)
    least = xp.min(xp.where(near, scaled, 0.0))
    value = xp.where(near, scaled, least - 2.0 * DEPTH)  # which `within_depth` brings up
    return LogLikelihood(value=within_depth(value - constant, xp=xp))


@block
def reweight(cloud: Cloud, position: LogLikelihood, attitude: LogLikelihood, *, xp: Any) -> Cloud:
    """Multiply the weights by the likelihoods of two independent measurements, and normalise.

    log w' = log w + log p_1 + log p_2 - log(sum over all particles), the largest less 64 at least.
    """
    log_weight = within_depth(cloud.log_weight + position.value + attitude.value, xp=xp)
    return cloud.replace(log_weight=log_weight - log_sum_exp(log_weight, xp=xp))


def within_depth(x: Array, *, xp: Any) -> Array:
    """Logarithms of likelihoods or weights (n), those far below the largest put at `DEPTH` below it.

    A weight of exp(-64) adds nothing to any sum. But where a few particles are 1e5 below, words of a fixed
    number of bits that hold these hold the others to 0.001 alone.
    """
    least = xp.max(x) - DEPTH
    return xp.where(x > least, x, least)


def log_sum_exp(x: Array, *, xp: Any) -> Array:
    """log(sum(exp(x))) of x (n): the largest is taken out first, so that nothing overflows."""
    largest = xp.max(x)
    return largest + xp.log(xp.sum(xp.exp(x - largest)))


@block
def weights(cloud: Cloud, *, xp: Any) -> Weights:
    """The weights out of the log domain."""
    return Weights(weight=xp.exp(cloud.log_weight))


@block
def effective_sample_size(cloud: Cloud, *, xp: Any) -> Scalar:
    """1 / sum(w^2): how many equally weighted particles would be as good, from 1 to n (Kong 1992)."""
    weight = xp.exp(cloud.log_weight)
    return 1.0 / (weight @ weight)


@block
def average_attitude(cloud: Cloud, weights: Weights, *, xp: Any) -> Attitude:
    """The average attitude: the unit q that minimises the weighted squared chordal distance to all particles.

    It is the dominant eigenvector of M = sum(w_i q_i q_i^T), 4 x 4 (Markley eqs. 12-13), in which q and -q
    are the same. The sign is that of the first particle.
    """
    moment = (cloud.attitude * weights.weight) @ cloud.attitude.mT
    return Attitude(attitude=dominant_eigenvector(moment, cloud.attitude[:, 0], xp=xp))


def dominant_eigenvector(M: Array, start: Array, *, xp: Any) -> Array:
    """The unit eigenvector (4) of the largest eigenvalue of M (4, 4), symmetric positive, of trace 1.

    M^32 start, by five squarings: of the other eigenvectors remains a share of (l_2 / l_1)^32, 1e-20 for
    attitudes that spread by 0.7 rad. Where all directions are alike, as for a heading of which nothing is
    known, the result is near `start`; where `start` is orthogonal to the answer, the largest column of M^32
    stands in for it.
    """
    M = 2.0 * M  # the largest eigenvalue is then in [1/2, 2], and no power vanishes or overflows in float32
    for _ in range(_SQUARINGS):
        M = M @ M
    q = M @ start
    parts = xp.reshape(M, (16,))[::5]
    q = xp.where(q @ q > _ALONG * (parts @ parts), q, xp.take(M, xp.argmax(parts), axis=1))
    return q / xp.sqrt(q @ q)


@block
def average_pose(cloud: Cloud, weights: Weights, attitude: Attitude) -> PoseEstimate:
    """The expectation of the pose: weighted means of the particles' means, and the average attitude given."""
    return PoseEstimate(
        position=cloud.position @ weights.weight,
        velocity=cloud.velocity @ weights.weight,
        attitude=attitude.attitude,
    )


@block
def cloud_belief(cloud: Cloud, weights: Weights, pose: PoseEstimate, *, xp: Any) -> PoseBelief:
    """The pose with its covariance (9, 9): that of the particles' means, and the mean of their covariances.

        cov = sum(w_i (d_i d_i^T + P_i)),   d_i = (p_i - p, v_i - v, Log(q^-1 q_i))

    in the order of `PoseBelief`. P_i, of position and velocity, is the particle's own; an attitude that is
    drawn has none.
    """
    q, w = pose.attitude, weights.weight
    turn = -lanes.rotation_vectors_to(cloud.attitude, q, xp=xp)  # Log(q^-1 q_i) = -Log(q_i^-1 q)
    apart = xp.concat(
        [cloud.position - pose.position[:, None], cloud.velocity - pose.velocity[:, None], turn], axis=0
    )
    P, C, V = (
        xp.sum(part * w, axis=-1)
        for part in (cloud.position_covariance, cloud.cross_covariance, cloud.velocity_covariance)
    )
    own = xp.concat([xp.concat([P, C], axis=-1), xp.concat([C.mT, V], axis=-1)], axis=-2)
    wide = xp.asarray(np.eye(6, 9), dtype=q.dtype)
    total = (apart * w) @ apart.mT + wide.mT @ own @ wide
    return PoseBelief(
        position=pose.position, velocity=pose.velocity, attitude=q, covariance=0.5 * (total + total.mT)
    )


def start_cloud(
    particles: int,
    *,
    seed: int = 0,
    position: npt.ArrayLike = (0.0, 0.0, 0.0),
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    attitude: npt.ArrayLike | None = None,
    spread: StartSpread = _SPREAD,
) -> Cloud:
    """A cloud to start from, equally weighted.

    Args:
        particles: how many.
        seed: of the draws: the same particles for the same seed.
        position, velocity: (3,) means, m and m/s, world; the same for all particles.
        attitude: (4,) unit quaternion, body to world, about which the particles are drawn with the spread's
            tilt and heading. Left out: roll and pitch zero, and the yaw uniform over the circle, one drawn in
            each of as many equal arcs.
        spread: standard deviations. A heading of infinity is uniform over the circle in the same way.
    """
    draw = NumpyDraw(START_DRAWS, seed_words(seed), 0)
    n = particles
    if attitude is None:
        q = _about_the_vertical(n, draw, np)
    else:
        sigma = np.array([[spread.tilt], [spread.tilt], [spread.heading]])  # about world axes: on the left
        even = math.isinf(spread.heading)
        sigma[2] = 0.0 if even else sigma[2]
        turn = lanes.exponential(sigma * draw.normal("attitude", (3, n)), xp=np)
        if even:
            turn = lanes.multiply(_about_the_vertical(n, draw, np), turn, xp=np)
        q = lanes.multiply(turn, np.repeat(np.asarray(attitude, dtype=float)[:, None], n, axis=1), xp=np)
    return _cloud(np.asarray(velocity, dtype=float), np.asarray(position, dtype=float), q, spread, np)


@block
def cloud_at_start(first: Pose, *, particles: int, draw: Any, xp: Any) -> Cloud:
    """`start_cloud` at a measured position, with an unknown yaw and at rest: drawn as there, where its draws
    are called `START_DRAWS` and it fires at time 0."""
    q = _about_the_vertical(particles, draw, xp)
    return _cloud(0.0 * first.position, first.position, q, _SPREAD, xp)


def _cloud(velocity: Array, position: Array, q: Array, spread: StartSpread, xp: Any) -> Cloud:
    n = q.shape[-1]
    alike = xp.zeros((1, n), dtype=q.dtype)
    covariance = lambda d: xp.asarray(np.repeat(np.eye(3)[:, :, None] * d**2, n, axis=2), dtype=q.dtype)
    return Cloud(
        log_weight=xp.full((n,), -math.log(n), dtype=q.dtype),
        attitude=q,
        velocity=velocity[:, None] + alike,
        position=position[:, None] + alike,
        velocity_covariance=covariance(spread.velocity),
        cross_covariance=xp.zeros((3, 3, n), dtype=q.dtype),
        position_covariance=covariance(spread.position),
    )


def _about_the_vertical(n: int, draw: Any, xp: Any) -> Array:
    """Turns (4, n), one drawn in each of n equal arcs of the circle."""
    there = draw.uniform("yaw", (n,))
    half = math.pi * (xp.asarray(np.arange(n), dtype=there.dtype) + there) / n
    return xp.stack([xp.cos(half), 0.0 * half, 0.0 * half, xp.sin(half)])
