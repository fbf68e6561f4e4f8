"""The unscented filter of `euler_ins`: sigma points that are augmented with the noises.

State and noises are independent, so a sigma point moves one of them at a time, along a column of its own
factor: S of P = S S^T for the state, and the square roots of the noises' variances. Points lie in pairs
around the mean, sqrt(3) deviations away. Everything is taken as deviations from the image of the mean: then a
wide spread costs no digits, an angle is never averaged as a number, and the covariance is a sum of squares.

    d_i = Y_i minus Y_0        m = sum d_i / 6        x' = Y_0 plus m
    P' = sum d_i d_i^T / 6 + (beta - alpha^2) m m^T        alpha^2 = 3 / L, beta = 2

L is the number of augmented coordinates. Measurements correct in regression form: H is the slope of the
pairs, and what they leave unexplained adds to the noise, so the Joseph form applies.

Sources: S. Julier and J. Uhlmann, "Unscented filtering and nonlinear estimation", Proc. IEEE 92, 2004; E. Wan
and R. van der Merwe, 2001 (alpha, beta); the report's sec. on its two filters.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.euler import matrix_from_angles
from flowgraph.blocks.euler_ins import STATE, increment_variances, increments, move, moved_by
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.kalman import Gaussian, KalmanInnovation, correct
from flowgraph.blocks.signals import Imu
from flowgraph.blocks.vision.camera import Mount
from flowgraph.blocks.vision.motion import CameraMotion, camera_velocity
from flowgraph.errors import UnknownNameError

__all__ = ["RATES", "predict_unscented_ins", "update_camera_velocity"]

_FAR = math.sqrt(3.0)
_BETA = 2.0

RATES = ("gyro", "camera")
"""Whose rate the body's is taken for: the gyroscope's minus its bias (eq. 10), or the camera's (eq. 9)."""


def sigma_points(x: Array, P: Array, noise: Array, xp: Any) -> tuple[Array, Array, Array]:
    """Sigma points of a state (15) with covariance P, and independent noises with deviations (k).

    Returns:
        Points (2 L, 15), noises (2 L, k), L = 15 + k: first all steps forth, then all back. And the state's
        factor S (15, 15).
    """
    S = xp.linalg.cholesky(P)
    k, n = noise.shape[-1], x.shape[-1]
    steps = xp.concat([S.mT, xp.zeros((k, n), dtype=x.dtype)], axis=0) * _FAR
    shakes = xp.eye(n + k, dtype=x.dtype)[:, n:] * (noise * _FAR)
    points = STATE.plus(x[None, :], xp.concat([steps, -steps], axis=0), xp)
    return points, xp.concat([shakes, -shakes], axis=0), S


@block
def predict_unscented_ins(
    belief: Gaussian, imu: Imu, *, order: str, noise: ImuNoise, dt: float, xp: Any
) -> Gaussian:
    """Predict over `dt` seconds with one IMU reading, through 54 sigma points of state (15) and noise (12).

    With dt = 0, as at the first firing, this is the identity (to rounding).

    Args:
        belief: over `euler_ins.STATE`; its covariance must be positive definite.
        imu: the reading that holds over the step.
        order: "zxy" or "zyx".
        noise: continuous densities; the increments have dt times their squares.
    """
    x = belief.mean
    deviations = xp.sqrt(xp.asarray(increment_variances(noise), dtype=x.dtype) * dt)
    points, shakes, _ = sigma_points(x, belief.covariance, deviations, xp)
    steps = xp.concat([xp.zeros((points.shape[0], 9), dtype=x.dtype), shakes[:, 6:12]], axis=-1)

    def moved(point: Array, shake: Array) -> Array:
        turn, push = increments(point, imu, dt)
        return move(point, turn + shake[..., 0:3], push + shake[..., 3:6], dt, order=order, xp=xp)

    middle = moved(x, xp.zeros((12,), dtype=x.dtype))
    images = moved(points, shakes) + steps
    apart = STATE.minus(images, middle[None, :], xp)
    mean = xp.sum(apart, axis=0) / 6.0
    spread = _BETA - 6.0 / points.shape[0]  # alpha^2 = 3 / L, and there are 2 L points
    P = apart.mT @ apart / 6.0 + spread * (mean[:, None] * mean[None, :])
    return Gaussian(mean=STATE.plus(middle, mean, xp), covariance=0.5 * (P + P.mT))


@block
def update_camera_velocity(
    prior: Gaussian,
    motion: CameraMotion | None,
    imu: Imu,
    *,
    order: str,
    mount: Mount,
    velocity_noise: float,
    rate_noise: float,
    rate: str = "gyro",
    gate: float | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """Correct with a camera's velocity, where there is one; without one the prior passes through.

        v_c = R_cb (R(e)^T v + w x r) + n_v
        w = w_m - b_g - n_w   (rate="gyro", the report's eq. 10)
        w = R_cb^T w_c - n_w  (rate="camera", eq. 9)

    The noises n_v and n_w are part of the sigma points: 42 of state (15) and noises (6).

    Args:
        prior: over `euler_ins.STATE`.
        motion: the camera's velocity, and its rate, which only eq. 9 uses; or absent.
        imu: the reading of now, whose rate eq. 10 uses.
        order: "zxy" or "zyx".
        mount: of the camera in the body.
        velocity_noise: standard deviation of the camera's velocity, m/s.
        rate_noise: of the rate that is taken, rad/s.
        rate: "gyro" or "camera".
        gate: when given, a measurement with a nis above it changes nothing (for three numbers 16.3 is
            99.9 %).

    Raises:
        UnknownNameError: for another source of the rate.
    """
    if rate not in RATES:
        raise UnknownNameError("source of the rate", rate, RATES, path="update_camera_velocity")
    if motion is None:
        return prior, None
    x = prior.mean
    noise = xp.asarray(np.repeat([velocity_noise, rate_noise], 3), dtype=x.dtype)
    points, shakes, S = sigma_points(x, prior.covariance, noise, xp)
    seen = motion.rate @ xp.asarray(mount.rotation, dtype=x.dtype)

    def view(point: Array, shake: Array) -> Array:
        w = (imu.gyro - point[..., 9:12] if rate == "gyro" else seen + 0.0 * point[..., 9:12]) - shake[
            ..., 3:6
        ]
        R = matrix_from_angles(point[..., 3:6], order=order, xp=xp)
        return camera_velocity(point[..., 6:9], R, w, mount=mount, xp=xp) + shake[..., 0:3]

    middle = view(x, xp.zeros((6,), dtype=x.dtype))
    apart = view(points, shakes) - middle
    mean = xp.sum(apart, axis=0) / 6.0
    half = points.shape[0] // 2
    slope = (apart[:15, :] - apart[half : half + 15, :]).mT / (2.0 * _FAR)  # H S
    spread = _BETA - 6.0 / points.shape[0]
    whole = apart.mT @ apart / 6.0 + spread * (mean[:, None] * mean[None, :])
    rest = whole - slope @ slope.mT
    H = xp.linalg.solve(S.mT, slope.mT).mT
    residual = motion.velocity - (middle + mean)
    found = correct(prior.covariance, residual, H, 0.5 * (rest + rest.mT), gate=gate, xp=xp)
    return moved_by(prior, found, xp)
