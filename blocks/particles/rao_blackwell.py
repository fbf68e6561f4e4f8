"""The part of a Rao-Blackwellized filter that needs no sampling: one Kalman filter a particle.

Given a particle's attitude, velocity and position are linear in the measured specific force and in each
other, with Gaussian noise, so their belief is a mean and a covariance, exactly. Each step here is a Kalman
step for all particles at once, in closed form along the last axis.

Source: A. Doucet, N. de Freitas, K. Murphy and S. Russell, "Rao-Blackwellised particle filtering for dynamic
Bayesian networks", UAI 2000, sec. 4; for an attitude drawn through the gyroscope: R. Fiszel's thesis on
reactive pose estimation, Stanford 2017.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.particles.cloud import within_depth
from flowgraph.blocks.signals import Cloud, Imu, LogLikelihood, Pose

__all__ = ["correct_motion", "predict_motion"]

ORIGIN = (0.0, 0.0, 0.0)
_EYE = np.eye(3)[:, :, None]
"""(3, 3, 1): the same for each particle."""


@block
def predict_motion(
    cloud: Cloud,
    imu: Imu,
    *,
    accelerometer_noise: float | tuple[float, float, float],
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> Cloud:
    """Predict velocity and position of each particle over `dt` seconds, with the force turned by its
    attitude.

        a = R(q) specific_force + gravity          V' = V + W dt
        v' = v + a dt                              C' = C + V dt + W dt^2/2
        p' = p + v dt + a dt^2/2                   P' = P + (C + C^T) dt + V dt^2 + W dt^3/3

    V, C, P are the velocity, cross (position, velocity) and position covariance, and W = R(q) diag(noise^2)
    R(q)^T is the accelerometer's spectral density in the world. With equal noise on the three axes W is the
    same for all attitudes. With dt = 0, as at the first firing, this is the identity. Fires when its inputs
    do.

    Args:
        cloud: with the attitude of now, and the motion of the last firing.
        imu: the reading that held since then; specific force in m/s^2, body.
        accelerometer_noise: density, m/s^2/sqrt(Hz), of all axes or of each body axis.
    """
    kind = cloud.position.dtype
    down = xp.asarray(gravity, dtype=kind)[:, None]
    step = (lanes.rotate(cloud.attitude, imu.specific_force, xp=xp) + down) * dt
    W = _density_in_world(cloud.attitude, accelerometer_noise, xp)
    V, C, P = cloud.velocity_covariance, cloud.cross_covariance, cloud.position_covariance
    drifted = C + V * dt
    return cloud.replace(
        velocity=cloud.velocity + step,
        position=cloud.position + (cloud.velocity + 0.5 * step) * dt,
        velocity_covariance=V + W * dt,
        cross_covariance=drifted + W * (0.5 * dt * dt),
        position_covariance=P + (drifted + lanes.transpose(C, xp=xp)) * dt + W * (dt * dt * dt / 3.0),
    )


def _density_in_world(q: Array, noise: float | tuple[float, ...], xp: Any) -> Array:
    """R diag(noise^2) R^T: (3, 3, n), or (3, 3, 1) where all axes are alike."""
    if not isinstance(noise, tuple):
        return xp.asarray(_EYE * noise**2, dtype=q.dtype)
    R = lanes.rotation_matrices(q, xp=xp)
    power = xp.asarray([[[s * s] for s in noise]], dtype=q.dtype)
    return lanes.matrix_product(R * power, lanes.transpose(R, xp=xp))


@block
def correct_motion(
    cloud: Cloud,
    pose: Pose,
    *,
    noise: float,
    lever: tuple[float, float, float] = ORIGIN,
    xp: Any,
) -> tuple[Cloud, LogLikelihood]:
    """Correct each particle's velocity and position with a measured position, and say how likely it was.

    z = p + R(q) lever + N(0, r I), r = noise^2. With the residual e = z - p - R(q) lever, its covariance S =
    P + r I and u = S^-1 e, the Kalman update written so that nothing cancels is

        v' = v + C^T u      V' = V - C^T S^-1 C        log p(z) = -(e . u + log det S + 3 log(2 pi)) / 2
        p' = p + P u        C' = r S^-1 C
                            P' = r S^-1 P

    An entry of z that is NaN was not measured: e is 0 there, with a noise whose variance is 1e8 times what is
    known, so that nothing is learned of it; r I is then a diagonal matrix.

    Args:
        pose: the measured position, m, world, of a point fixed to the body; its attitude is not used here.
        noise: standard deviation, m.
        lever: the point in body coordinates, m.

    Returns:
        The cloud with corrected motion and its weights as they were, and the log-likelihoods for `reweight`,
        those more than 64 below the best particle's put there.
    """
    kind = cloud.position.dtype
    V, C, P = cloud.velocity_covariance, cloud.cross_covariance, cloud.position_covariance
    one = xp.asarray(_EYE, dtype=kind)
    residual = pose.position[:, None] - cloud.position
    if lever != ORIGIN:
        residual = residual - lanes.rotate(cloud.attitude, xp.asarray(lever, dtype=kind), xp=xp)
    missing = xp.any(xp.isnan(residual), axis=1)
    residual = xp.where(missing[:, None], 0.0, residual)
    vague = 1e8 * (xp.max(xp.sum(P * one, axis=1), axis=-1) + noise**2)
    r = xp.where(missing, vague, noise**2)[:, None, None]
    known = xp.concat([P, C, residual[:, None, :]], axis=1)
    solved, log_determinant = lanes.solve_and_log_determinant(P + one * r, known, xp=xp)
    own, across, u = solved[:, :3, :], solved[:, 3:6, :], solved[:, 6, :]
    distance = xp.sum(residual * u, axis=0)
    corrected = cloud.replace(
        velocity=cloud.velocity + xp.sum(C * u[:, None, :], axis=0),
        position=cloud.position + xp.sum(P * u[None, :, :], axis=1),
        velocity_covariance=_symmetric(V - lanes.matrix_product(lanes.transpose(C, xp=xp), across), xp),
        cross_covariance=r * across,
        position_covariance=_symmetric(r * own, xp),
    )
    log_likelihood = -0.5 * (distance + log_determinant + 3.0 * math.log(2.0 * math.pi))
    return corrected, LogLikelihood(value=within_depth(log_likelihood, xp=xp))


def _symmetric(a: Array, xp: Any) -> Array:
    return 0.5 * (a + lanes.transpose(a, xp=xp))
