"""A particle filter over the fifteen numbers of `euler_ins`: the same model, without a Gaussian.

Each particle is a whole state. It moves with the IMU's reading and noises drawn for it. A measured pose tells
six of fifteen numbers to some per cent of what the cloud expects: of a few thousand particles that are drawn
without it, hardly one is where it says. So the cloud looks at the pose first, as `particles.guided` has it:
kernels about the particles are corrected, weighed and chosen, and the new particles are drawn from them.

Sources: those of `particles.guided`; N. Gordon, D. Salmond and A. Smith, "Novel approach to
nonlinear/non-Gaussian Bayesian state estimation", IEE Proc. F 140, 1993 (bootstrap filter; roughening, sec.
3); resampling: `resampling`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Scalar, block
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.filters import masked
from flowgraph.blocks.kalman.lost import PATIENCE
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.blocks.models.euler_ins import (
    POSE_ANGLES,
    STATE,
    increment_variances,
    increments,
    measured_angles,
    move,
    pose_noise,
    see_pose_angles,
)
from flowgraph.blocks.particles.guided import corrected, drawn, spread_of
from flowgraph.blocks.particles.lost import verdict
from flowgraph.blocks.particles.resampling import ancestor_index, roughening
from flowgraph.blocks.signals import (
    Ancestors,
    Gaussian,
    Imu,
    KalmanInnovation,
    PoseMeasurement,
    StateCloud,
    StateKernels,
)

__all__ = [
    "BANDWIDTH",
    "average_kernels",
    "average_state",
    "correct_states",
    "propagate_states",
    "resample_states",
    "start_states",
]

BANDWIDTH = 0.95
"""Of the kernels, if none is set: nearly a Gaussian filter, as the posterior of a pose is nearly Gaussian."""

_MOVING = np.arange(15) < 9
"""Position, angles and velocity: what of a state may have lost track."""


@block
def propagate_states(
    cloud: StateCloud,
    imu: Imu,
    *,
    order: str,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    draw: Any,
    xp: Any,
) -> StateCloud:
    """Move each particle over `dt` seconds with one IMU reading and noises of its own.

    With dt = 0, as at the first firing, this is the identity. Draws `process` (12, n).

    Args:
        cloud: the belief at the last firing; the weights stay.
        imu: the reading that holds over the step.
        order: "zxy" or "zyx".
        noise: continuous densities of what is drawn.
        gravity: in the world, m/s^2.
    """
    x = cloud.state
    drawn = xp.asarray(draw.normal("process", (12, x.shape[0])), dtype=x.dtype).mT
    shake = drawn * xp.sqrt(xp.asarray(increment_variances(noise), dtype=x.dtype) * dt)
    turn, push = increments(x, imu, dt)
    after = move(x, turn + shake[:, 0:3], push + shake[:, 3:6], dt, order=order, gravity=gravity, xp=xp)
    biases = xp.concat([xp.zeros((x.shape[0], 9), dtype=x.dtype), shake[:, 6:12]], axis=-1)
    return cloud.replace(state=STATE.plus(after, biases, xp))


@block
def correct_states(
    state: Any,
    cloud: StateCloud,
    pose: PoseMeasurement,
    *,
    order: str,
    R: npt.ArrayLike,
    factor: float = 1.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    bandwidth: float = BANDWIDTH,
    gate: float | None = None,
    patience: int = PATIENCE,
    xp: Any,
) -> tuple[Any, tuple[StateKernels, KalmanInnovation]]:
    """Correct kernels about the particles with a measured pose, and weigh them: `particles.guided`.

    z = (p + R(e) lever, e) + noise. A cloud that has lost track (`lost.verdict`) first has
    its variances of position, angles and velocity made larger, so that the pose becomes plausible; biases
    keep what they know. A pose that the gate refuses, or of which nothing can be made, leaves the particles
    as they are, kernels without width. Fires with the pose.

    Args:
        cloud: at the time of the pose.
        pose: measured; an entry that is NaN was not, and a NaN in the quaternion takes all angles with it.
        order: "zxy" or "zyx".
        R, factor, lever: as in `euler_ins.update_pose_angles`.
        bandwidth: of the kernels in deviations of the cloud, 0 to 1; 0 is the bootstrap filter.
        gate, patience: as in `lost.verdict`.

    Returns:
        The kernels, and the innovation of the whole cloud.

    State: how many poses were too far off in a row.
    """
    x, kind = cloud.state, cloud.state.dtype
    mean = _mean(cloud.log_weight, x, xp)
    spread = spread_of(x, xp.exp(cloud.log_weight), mean, space=STATE, xp=xp)
    e = mean[3:6]
    z = xp.concat([pose.position, measured_angles(pose.attitude, e, order=order, xp=xp)], axis=-1)

    see = see_pose_angles(lever, order=order)

    def off(m: Array) -> Array:
        return POSE_ANGLES.minus(z, see(m, xp), xp)

    residual = off(mean)
    present = ~xp.isnan(residual)
    noise = pose_noise(pose, e, R=R, factor=factor, order=order, xp=xp)
    _, H = linearised(see, mean, STATE, xp, seen=POSE_ANGLES)
    H, noise = masked(H, noise, present, xp)
    S = H @ spread.covariance @ H.mT + noise
    count, innovation, grow = verdict(
        state, xp.where(present, residual, 0.0), S, present, gate=gate, patience=patience, at_once=True, xp=xp
    )
    believed = innovation.accepted
    moving = xp.asarray(np.outer(_MOVING, _MOVING), dtype=kind)
    found = corrected(
        mean,
        spread,
        cloud.log_weight,
        lambda m: xp.where(present & believed, off(m), 0.0),
        H,
        noise,
        space=STATE,
        bandwidth=bandwidth,
        wider=spread.covariance * moving * (grow - 1.0),
        xp=xp,
    )
    kernels = StateKernels(
        log_weight=xp.where(believed, found.log_weight, cloud.log_weight),
        state=xp.where(believed, found.middle, x),
        covariance=xp.where(believed, found.covariance, 0.0),
    )
    return count, (kernels, innovation)


@correct_states.init
def _none_refused(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


@block
def resample_states(
    kernels: StateKernels,
    *,
    below: float,
    spread: float,
    scheme: str = "systematic",
    draw: Any,
    xp: Any,
) -> tuple[StateCloud, Scalar, Ancestors]:
    """Choose which kernels live on where their effective sample size is below a part of their number; then
    draw a particle of each, with the mean and covariance of the weighted kernels, and shake the copies apart.

    Draws `place` as the scheme has it, `kernel` (15, n) and `spread` (15, n).

    Args:
        kernels: weighted.
        below: resample when 1 / sum(w^2) < below * n.
        spread: by what part of the range of the sample over n^(1/15) copies are shaken, a normal draw
            (Gordon's roughening); the range does not vanish where one particle has all the weight.
        scheme: as in `resampling`.

    Returns:
        The new cloud, the effective sample size before, and the ancestors.
    """
    x = kernels.state
    n = x.shape[0]
    weight = xp.exp(kernels.log_weight)
    size = 1.0 / (weight @ weight)
    index = ancestor_index(weight, scheme=scheme, draw=draw, xp=xp)
    resampled = size < below * n
    index = xp.where(resampled, index, xp.arange(n, dtype=xp.int64))
    shake = xp.asarray(draw.normal("spread", (15, n)), dtype=x.dtype).mT
    mean = _mean(kernels.log_weight, x, xp)
    about = spread_of(x, weight, mean, space=STATE, xp=xp)
    shake = shake * xp.where(resampled, roughening(about.apart, spread, xp=xp), 0.0)
    normal = xp.asarray(draw.normal("kernel", (15, n)), dtype=x.dtype).mT
    root = covariance_root(kernels.covariance, xp=xp)
    log_weight = xp.where(resampled, -math.log(n), kernels.log_weight)
    fresh = drawn(
        xp.take(x, index, axis=0),
        root,
        normal,
        xp.exp(log_weight),
        mean,
        about.covariance + kernels.covariance,
        space=STATE,
        xp=xp,
    )
    cloud = StateCloud(log_weight=log_weight, state=STATE.plus(fresh, shake, xp))
    return cloud, size, Ancestors(index=xp.astype(index, xp.int32), resampled=resampled)


@block
def average_state(cloud: StateCloud, *, xp: Any) -> Gaussian:
    """The weighted mean (15) and covariance (15, 15) of the particles; angles are averaged on the circle."""
    return _average(cloud.log_weight, cloud.state, xp)


@block
def average_kernels(kernels: StateKernels, *, xp: Any) -> Gaussian:
    """The mean (15) and covariance (15, 15) of weighted kernels, whose own covariance adds to that of their
    means."""
    middle = _average(kernels.log_weight, kernels.state, xp)
    return Gaussian(mean=middle.mean, covariance=middle.covariance + kernels.covariance)


def _average(log_weight: Array, x: Array, xp: Any) -> Gaussian:
    mean = _mean(log_weight, x, xp)
    return Gaussian(
        mean=mean, covariance=spread_of(x, xp.exp(log_weight), mean, space=STATE, xp=xp).covariance
    )


def _mean(log_weight: Array, x: Array, xp: Any) -> Array:
    weight = xp.exp(log_weight)
    flat, e = weight @ x, x[:, 3:6]
    around = xp.atan2(weight @ xp.sin(e), weight @ xp.cos(e))
    return xp.concat([flat[0:3], around, flat[6:15]], axis=-1)


def start_states(particles: int, start: Gaussian, *, seed: int = 0) -> StateCloud:
    """A cloud drawn from a Gaussian over `STATE`, equally weighted."""
    factor = np.asarray(covariance_root(np.asarray(start.covariance), xp=np))
    drawn = np.random.default_rng(seed).normal(size=(particles, 15)) @ factor.T
    return StateCloud(
        log_weight=np.full(particles, -math.log(particles)),
        state=np.asarray(STATE.plus(np.asarray(start.mean)[None, :], drawn, np)),
    )
