"""A particle filter over the fifteen numbers of `euler_ins`: the same model, without a Gaussian.

Each particle is a whole state. It moves with the IMU's reading and noises drawn for it, and a measured pose
weighs it by how well it explains the pose: the bootstrap filter. Fifteen dimensions are many for particles.
Two things keep a few thousand of them alive: the noise of the process is drawn larger than the IMU's, and
after each resampling the copies are shaken apart a little (regularisation).

Sources: N. Gordon, D. Salmond and A. Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation", IEE Proc. F 140, 1993 (bootstrap filter, roughening, sec. 3); resampling: `resampling`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Scalar, block
from flowgraph.blocks.geometry.manifold import angle
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.blocks.models.euler_ins import (
    STATE,
    increment_variances,
    increments,
    measured_angles,
    move,
    pose_noise,
    seen_place,
)
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.blocks.particles.resampling import ancestor_index
from flowgraph.blocks.signals import Ancestors, Gaussian, Imu, PoseMeasurement, StateCloud

__all__ = [
    "average_state",
    "propagate_states",
    "resample_states",
    "start_states",
    "weigh_states",
]


@block
def propagate_states(
    cloud: StateCloud, imu: Imu, *, order: str, noise: ImuNoise, dt: float, draw: Any, xp: Any
) -> StateCloud:
    """Move each particle over `dt` seconds with one IMU reading and noises of its own.

    With dt = 0, as at the first firing, this is the identity. Draws `process` (12, n).

    Args:
        cloud: the belief at the last firing; the weights stay.
        imu: the reading that holds over the step.
        order: "zxy" or "zyx".
        noise: continuous densities of what is drawn.
    """
    x = cloud.state
    drawn = xp.asarray(draw.normal("process", (12, x.shape[0])), dtype=x.dtype).mT
    shake = drawn * xp.sqrt(xp.asarray(increment_variances(noise), dtype=x.dtype) * dt)
    turn, push = increments(x, imu, dt)
    after = move(x, turn + shake[:, 0:3], push + shake[:, 3:6], dt, order=order, xp=xp)
    biases = xp.concat([xp.zeros((x.shape[0], 9), dtype=x.dtype), shake[:, 6:12]], axis=-1)
    return cloud.replace(state=STATE.plus(after, biases, xp))


@block
def weigh_states(
    cloud: StateCloud,
    pose: PoseMeasurement,
    *,
    order: str,
    R: npt.ArrayLike,
    factor: float = 1.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    xp: Any,
) -> StateCloud:
    """Multiply the weights by the likelihood of a measured pose, and normalise.

        log w' = log w - r^T R^-1 r / 2 + constant      r = (position, angles) measured minus the particle's

    Args:
        cloud: at the time of the pose.
        pose: measured.
        order: "zxy" or "zyx".
        R, factor, lever: as in `euler_ins.update_pose_angles`.
    """
    middle = _circular_mean(cloud, xp)
    z = measured_angles(pose.attitude, middle, order=order, xp=xp)
    turn = angle(3).minus(z, cloud.state[:, 3:6], xp)
    seen = seen_place(cloud.state, lever, order=order, xp=xp)
    r = xp.concat([pose.position - seen, turn], axis=-1)
    noise = pose_noise(pose, middle, R=R, factor=factor, order=order, xp=xp)
    squared = xp.sum(r * xp.linalg.solve(noise, r.mT).mT, axis=-1)
    log_weight = cloud.log_weight - 0.5 * squared
    return cloud.replace(log_weight=log_weight - log_sum_exp(log_weight, xp=xp))


@block
def resample_states(
    cloud: StateCloud,
    *,
    below: float,
    spread: float,
    scheme: str = "systematic",
    draw: Any,
    xp: Any,
) -> tuple[StateCloud, Scalar, Ancestors]:
    """Draw the cloud anew where its effective sample size is below a part of its size, and shake the copies.

    Draws `place` as the scheme has it, and `spread` (15, n).

    Args:
        cloud: weighted.
        below: resample when 1 / sum(w^2) < below * n.
        spread: by what part of the weighted deviation of each coordinate the copies are shaken, a normal
            draw.
        scheme: as in `resampling`.

    Returns:
        The new cloud, the effective sample size before, and the ancestors.
    """
    x = cloud.state
    n = x.shape[0]
    weight = xp.exp(cloud.log_weight)
    size = 1.0 / (weight @ weight)
    index = ancestor_index(weight, scheme=scheme, draw=draw, xp=xp)
    resampled = size < below * n
    index = xp.where(resampled, index, xp.arange(n, dtype=xp.int64))
    apart = STATE.minus(x, _mean(cloud, xp)[None, :], xp)
    deviation = xp.sqrt(xp.sum(weight[:, None] * apart * apart, axis=0))
    drawn = xp.asarray(draw.normal("spread", (15, n)), dtype=x.dtype).mT
    shaken = STATE.plus(xp.take(x, index, axis=0), drawn * (spread * deviation), xp)
    fresh = StateCloud(
        log_weight=xp.where(resampled, -math.log(n), cloud.log_weight), state=xp.where(resampled, shaken, x)
    )
    return fresh, size, Ancestors(index=xp.astype(index, xp.int32), resampled=resampled)


@block
def average_state(cloud: StateCloud, *, xp: Any) -> Gaussian:
    """The weighted mean (15) and covariance (15, 15) of the particles; angles are averaged on the circle."""
    mean = _mean(cloud, xp)
    weight = xp.exp(cloud.log_weight)
    apart = STATE.minus(cloud.state, mean[None, :], xp)
    P = (apart * weight[:, None]).mT @ apart
    return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))


def _circular_mean(cloud: StateCloud, xp: Any) -> Array:
    weight = xp.exp(cloud.log_weight)
    e = cloud.state[:, 3:6]
    return xp.atan2(weight @ xp.sin(e), weight @ xp.cos(e))


def _mean(cloud: StateCloud, xp: Any) -> Array:
    weight = xp.exp(cloud.log_weight)
    flat = weight @ cloud.state
    return xp.concat([flat[0:3], _circular_mean(cloud, xp), flat[6:15]], axis=-1)


def start_states(particles: int, start: Gaussian, *, seed: int = 0) -> StateCloud:
    """A cloud drawn from a Gaussian over `STATE`, equally weighted."""
    factor = np.asarray(covariance_root(np.asarray(start.covariance), xp=np))
    drawn = np.random.default_rng(seed).normal(size=(particles, 15)) @ factor.T
    return StateCloud(
        log_weight=np.full(particles, -math.log(particles)),
        state=np.asarray(STATE.plus(np.asarray(start.mean)[None, :], drawn, np)),
    )
