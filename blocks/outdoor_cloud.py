"""The particles of an outdoor filter: attitude by particles; velocity, position and displacement Gaussian
given each.

A sensor is fused in one of two ways. What is linear once the attitude is known (a position, a distance to the
ground, a displacement) is a partial Kalman update of each particle, which also says how likely the reading
was. What sees the attitude only (a magnetic field, a turn) weighs the particles. Each block takes one sensor,
passes the cloud through where there is no reading, and leaves the weights normalised; so sensors may come in
any order, at any time.

Optical flow measures from one picture to the next. Each particle keeps its attitude at the last picture and,
in its Kalman state, how far it has moved since, which is zero and certain when a picture is taken.

Source: A. Doucet, N. de Freitas, K. Murphy and S. Russell, "Rao-Blackwellised particle filtering for dynamic
Bayesian networks", UAI 2000; for the sensors and their two kinds of update: R. Fiszel's thesis on reactive
pose estimation, Stanford 2017.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Array, Signal, block, real
from flowgraph.blocks import lanes
from flowgraph.blocks.inertial import GRAVITY, ImuNoise
from flowgraph.blocks.outdoor import OutdoorStart
from flowgraph.blocks.particles import log_sum_exp, start_cloud
from flowgraph.blocks.signals import Ancestors, Cloud, Imu, MagneticField, OpticalFlow, Position, Range

__all__ = [
    "OutdoorCloud",
    "as_cloud",
    "correct_distance",
    "correct_flow",
    "correct_position",
    "predict_outdoor",
    "start_outdoor_cloud",
    "take_outdoor_ancestors",
    "weigh_field",
]

ORIGIN = (0.0, 0.0, 0.0)
_VELOCITY, _POSITION, _MOVED = slice(0, 3), slice(3, 6), slice(6, 9)
_LEAST_UPRIGHT = 0.05
"""cos(tilt) below which a beam along body z does not meet the ground for any practical purpose."""


def _blocks(entries: dict[tuple[int, int], float]) -> np.ndarray:
    """A (9, 9) matrix of multiples of I (3, 3), by block."""
    small = np.zeros((3, 3))
    for at, value in entries.items():
        small[at] = value
    return np.kron(small, np.eye(3))


_DRIFT = _blocks({(1, 0): 1.0, (2, 0): 1.0})
"""d(position, displacement)/dt is the velocity."""

_WHITE = (
    _blocks({(0, 0): 1.0}),
    _blocks({(0, 1): 0.5, (0, 2): 0.5, (1, 0): 0.5, (2, 0): 0.5}),
    _blocks({(i, j): 1.0 / 3.0 for i in (1, 2) for j in (1, 2)}),
)
"""What white noise on the acceleration leaves: the coefficients of dt, dt^2 and dt^3."""


class OutdoorCloud(Signal):
    """A Rao-Blackwellized cloud whose particles remember the last picture. The particle is the last axis.

    log_weight: natural logarithm of the weights, which add up to 1. attitude: of now; picture: at the last
    picture. motion: the mean of (velocity in m/s, position in m, displacement since the last picture in m),
    world; covariance: of it.
    """

    log_weight: Array = real("particles")
    attitude: Array = real(4, "particles", unit="1", frame="world<-body")
    picture: Array = real(4, "particles", unit="1", frame="world<-body")
    motion: Array = real(9, "particles", frame="world")
    covariance: Array = real(9, 9, "particles")


@block
def predict_outdoor(
    cloud: OutdoorCloud,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    draw: Any,
    xp: Any,
) -> OutdoorCloud:
    """Carry the cloud over `dt` seconds: each attitude by a drawn turn, the rest by a Kalman prediction.

        turn = gyro dt + noise.gyro sqrt(dt) e,  e ~ N(0, I) for each particle
        q' = q * Exp(turn)      a = R(q * Exp(turn/2)) specific_force + gravity
        v' = v + a dt      p' = p + v dt + a dt^2/2      s' = s + v dt + a dt^2/2      P' = F P F^T + Q

    s is the displacement since the last picture. Q is white noise on the acceleration, noise.accelerometer^2
    [dt, dt^2/2; dt^2/2, dt^3/3] on v and on p and s, which move alike. Fires when its inputs do; with dt = 0,
    as at the first firing, this is the identity. Draws `gyro` (3, n).

    Args:
        cloud: the belief at the last firing.
        imu: the reading that held since then: rad/s and m/s^2, body.
        noise: densities.
    """
    kind, n = cloud.motion.dtype, cloud.log_weight.shape[-1]
    errors = xp.asarray(draw.normal("gyro", (3, n)), dtype=kind)
    turn = imu.gyro[:, None] * dt + errors * (noise.gyro * xp.sqrt(dt))
    half = lanes.exponential(0.5 * turn, xp=xp)
    middle = lanes.multiply(cloud.attitude, half, xp=xp)
    attitude = lanes.normalize(lanes.multiply(middle, half, xp=xp), xp=xp)
    down = xp.asarray(gravity, dtype=kind)[:, None]
    step = (lanes.rotate(middle, imu.specific_force, xp=xp) + down) * dt
    path = (cloud.motion[_VELOCITY, :] + 0.5 * step) * dt
    F = xp.eye(9, dtype=kind) + xp.asarray(_DRIFT, dtype=kind) * dt
    W, W2, W3 = (xp.asarray(table * noise.accelerometer**2, dtype=kind) for table in _WHITE)
    Q = (W + (W2 + W3 * dt) * dt) * dt
    return cloud.replace(
        attitude=attitude,
        motion=cloud.motion + xp.concat([step, path, path], axis=0),
        covariance=_between(F, cloud.covariance, xp) + Q[:, :, None],
    )


def _between(F: Array, P: Array, xp: Any) -> Array:
    """F P F^T for each particle: F (9, 9), P (9, 9, n) symmetric."""
    n = P.shape[-1]
    left = lambda A: xp.reshape(F @ xp.reshape(A, (9, 9 * n)), (9, 9, n))
    return left(lanes.transpose(left(P), xp=xp))


@block
def correct_position(
    cloud: OutdoorCloud,
    position: Position | None,
    *,
    noise: float,
    lever: tuple[float, float, float] = ORIGIN,
    xp: Any,
) -> OutdoorCloud:
    """A partial Kalman update of each particle with a measured position: z = p + R(q) lever + N(0, noise^2
    I).

    Args:
        position: z, m, world, of a point fixed to the body; without one the cloud passes through.
        noise: standard deviation, m.
        lever: the point in body coordinates, m.
    """
    if position is None:
        return cloud
    residual = position.position[:, None] - cloud.motion[_POSITION, :]
    if lever != ORIGIN:
        arm = xp.asarray(lever, dtype=residual.dtype)
        residual = residual - lanes.rotate(cloud.attitude, arm, xp=xp)
    return _corrected(cloud, residual, _POSITION, noise**2, xp)


@block
def correct_distance(cloud: OutdoorCloud, distance: Range | None, *, noise: float, xp: Any) -> OutdoorCloud:
    """A partial Kalman update of each particle with a distance to the ground (world z = 0) along body -z.

    z = p_z / R_33(q) + N(0, noise^2): given the attitude, linear in the position.

    Args:
        distance: z, m; without one the cloud passes through.
        noise: standard deviation, m, along the beam.
    """
    if distance is None:
        return cloud
    q = cloud.attitude
    upright = 1.0 - 2.0 * (q[1, :] * q[1, :] + q[2, :] * q[2, :])
    h = 1.0 / xp.maximum(upright, _LEAST_UPRIGHT)
    height = cloud.covariance[5, :, :]  # (9, n): of everything with p_z
    residual = distance.distance - cloud.motion[5, :] * h
    S = height[5, :] * h * h + noise**2
    gain = height * (h / S)
    covariance = cloud.covariance - gain[:, None, :] * (height * h)[None, :, :]
    log_likelihood = -0.5 * (residual * residual / S + xp.log(S) + math.log(2.0 * math.pi))
    return cloud.replace(
        log_weight=_weighed(cloud.log_weight, log_likelihood, xp),
        motion=cloud.motion + gain * residual,
        covariance=0.5 * (covariance + lanes.transpose(covariance, xp=xp)),
    )


@block
def weigh_field(
    cloud: OutdoorCloud,
    field: MagneticField | None,
    *,
    earth: tuple[float, float, float],
    noise: float,
    xp: Any,
) -> OutdoorCloud:
    """Weigh each particle by a measured magnetic field: z = R(q)^T earth + N(0, noise^2 I).

    Args:
        field: z, T, body; without one the cloud passes through.
        earth: the field in the world, T.
        noise: standard deviation of each component, T.
    """
    if field is None:
        return cloud
    away = _inverse(cloud.attitude, xp)
    # in units of the noise: squares of tesla are too small for single precision
    seen = lanes.rotate(away, xp.asarray([m / noise for m in earth], dtype=away.dtype), xp=xp)
    return _weighed_by(cloud, (field.field / noise)[:, None] - seen, 1.0, xp)


@block
def correct_flow(
    cloud: OutdoorCloud, flow: OpticalFlow | None, *, displacement: float, turn: float, xp: Any
) -> OutdoorCloud:
    """Fuse how the body moved and turned since the last picture, and take a new picture.

        displacement = R(q_0)^T s + N(0, displacement^2 I)      a partial Kalman update of each particle
        turn = q_0^-1 q * Exp(N(0, turn^2 I))                   a weight

    q_0 is the particle's attitude at the last picture and s its displacement since. Then q_0 = q, and s = 0
    with no variance.

    Args:
        flow: over the time since the reading before it, or since the start; without one the cloud passes
            through.
        displacement, turn: standard deviations, m and rad.
    """
    if flow is None:
        return cloud
    moved = lanes.rotate(cloud.picture, flow.displacement, xp=xp)
    cloud = _corrected(cloud, moved - cloud.motion[_MOVED, :], _MOVED, displacement**2, xp)
    own = lanes.multiply(_inverse(cloud.picture, xp), cloud.attitude, xp=xp)
    cloud = _weighed_by(cloud, lanes.rotation_vectors_to(own, flow.turn, xp=xp), turn, xp)
    keep = xp.asarray([1.0] * 6 + [0.0] * 3, dtype=cloud.motion.dtype)
    return cloud.replace(
        picture=cloud.attitude,
        motion=cloud.motion * keep[:, None],
        covariance=cloud.covariance * (keep[:, None] * keep[None, :])[:, :, None],
    )


def _corrected(cloud: OutdoorCloud, residual: Array, part: slice, variance: float, xp: Any) -> OutdoorCloud:
    """The Kalman update and the weights for z = part of the motion + N(0, variance I); residual (3, n)."""
    across = cloud.covariance[part, :, :]  # (3, 9, n)
    own = across[:, part, :] + xp.asarray((np.eye(3) * variance)[:, :, None], dtype=residual.dtype)
    inverse, determinant = lanes.inverse_and_determinant(own, xp=xp)
    u = xp.sum(inverse * residual[None, :, :], axis=1)
    solved = sum(inverse[:, k, None, :] * across[None, k, :, :] for k in range(3))  # (3, 9, n)
    less = sum(across[k, :, None, :] * solved[k, None, :, :] for k in range(3))
    covariance = cloud.covariance - less
    log_likelihood = -0.5 * (
        xp.sum(residual * u, axis=0) + xp.log(determinant) + 3.0 * math.log(2.0 * math.pi)
    )
    return cloud.replace(
        log_weight=_weighed(cloud.log_weight, log_likelihood, xp),
        motion=cloud.motion + xp.sum(across * u[:, None, :], axis=0),
        covariance=0.5 * (covariance + lanes.transpose(covariance, xp=xp)),
    )


def _inverse(q: Array, xp: Any) -> Array:
    """The inverse attitudes (4, n)."""
    return q * xp.asarray([[1.0], [-1.0], [-1.0], [-1.0]], dtype=q.dtype)


def _weighed(log_weight: Array, log_likelihood: Array, xp: Any) -> Array:
    both = log_weight + log_likelihood
    return both - log_sum_exp(both, xp=xp)


def _weighed_by(cloud: OutdoorCloud, error: Array, noise: float, xp: Any) -> OutdoorCloud:
    """Weights for an error (3, n) ~ N(0, noise^2 I); what is the same for all particles is left out."""
    log_likelihood = xp.sum(error * error, axis=0) * (-0.5 / noise**2)
    return cloud.replace(log_weight=_weighed(cloud.log_weight, log_likelihood, xp))


@block
def as_cloud(cloud: OutdoorCloud) -> Cloud:
    """The cloud without its pictures: what averages and resampling need."""
    P = cloud.covariance
    return Cloud(
        log_weight=cloud.log_weight,
        attitude=cloud.attitude,
        velocity=cloud.motion[_VELOCITY, :],
        position=cloud.motion[_POSITION, :],
        velocity_covariance=P[_VELOCITY, _VELOCITY, :],
        cross_covariance=P[_POSITION, _VELOCITY, :],
        position_covariance=P[_POSITION, _POSITION, :],
    )


@block
def take_outdoor_ancestors(cloud: OutdoorCloud, ancestors: Ancestors, *, xp: Any) -> OutdoorCloud:
    """The cloud of the chosen particles; equally weighted if it was resampled."""
    n = cloud.log_weight.shape[-1]
    copy = lambda field: xp.take(field, ancestors.index, axis=-1)
    return OutdoorCloud(
        log_weight=xp.where(ancestors.resampled, -math.log(n), cloud.log_weight),
        attitude=copy(cloud.attitude),
        picture=copy(cloud.picture),
        motion=copy(cloud.motion),
        covariance=copy(cloud.covariance),
    )


def start_outdoor_cloud(particles: int, start: OutdoorStart, *, seed: int = 0) -> OutdoorCloud:
    """A cloud to start from, equally weighted and at rest, with a picture taken."""
    plain = start_cloud(
        particles, seed=seed, position=start.position, attitude=start.attitude, spread=start.spread
    )
    variance = np.repeat([start.spread.velocity**2, start.spread.position**2, 0.0], 3)
    return OutdoorCloud(
        log_weight=plain.log_weight,
        attitude=plain.attitude,
        picture=plain.attitude,
        motion=np.concatenate([plain.velocity, plain.position, np.zeros((3, particles))]),
        covariance=np.repeat(np.diag(variance)[:, :, None], particles, axis=2),
    )
