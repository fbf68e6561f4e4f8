"""Inertial navigation with Euler angles: fifteen numbers, of which three are angles.

    x = (p, e, v, b_g, b_a)     p, v: m and m/s, world; e = (phi, theta, psi): rad; biases: rad/s, m/s^2, body

    dp/dt = v
    de/dt = G(e)^-1 (w_m - b_g - n_g)
    dv/dt = R(e) (a_m - b_a - n_a) + gravity
    db_g/dt = n_bg        db_a/dt = n_ba

w_m and a_m are what gyroscope and accelerometer read. G is the matrix of the rate in the body (`euler`), in
either convention. The noises have spectral densities Q; over dt they leave increments of covariance dt Q, so
a step is written in increments: of angle, d = (w_m - b_g) dt + n_g, and of velocity. The angles go to the
middle of the step first, which makes it second order.

Sources: the course's process model (Z-X-Y) and the report's eqs. 2-7 (Z-Y-X); the biases, which the course's
printed dx/dt leaves out of the second and third line, are in both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Result, Series, block
from flowgraph.blocks.geometry.euler import (
    NEAR,
    angles_from_matrix,
    angles_from_quaternion,
    body_rate_matrix,
    inverse_rate_jacobian,
    inverse_rate_matrix,
    matrix_from_angles,
    need_order,
    quaternion_from_angles,
    singular_cosine,
)
from flowgraph.blocks.geometry.manifold import StateSpace, angle, euclidean
from flowgraph.blocks.geometry.rotations import skew, to_matrix
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.filters import Correction, correct, scaled
from flowgraph.blocks.kalman.matrices import noise_matrix
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.kalman.smoothing import Steps, steps_of
from flowgraph.blocks.signals import Belief, EulerAngles, Gaussian, Imu, KalmanInnovation, PoseMeasurement

__all__ = [
    "STATE",
    "euler_angles",
    "euler_steps",
    "extended_crossing",
    "measured_angles",
    "move",
    "move_jacobians",
    "navigation_belief",
    "predict_extended",
    "start_gaussian",
    "update_pose_angles",
]

STATE = StateSpace(euclidean(3), angle(3), euclidean(9))
"""(p, e, v, b_g, b_a)."""

POSE_ANGLES = StateSpace(euclidean(3), angle(3))


def increments(x: Array, imu: Imu, dt: Any) -> tuple[Array, Array]:
    """What turns and pushes the body over dt, without noise: (..., 3) rad and m/s, both in the body."""
    return (imu.gyro - x[..., 9:12]) * dt, (imu.specific_force - x[..., 12:15]) * dt


def move(
    x: Array,
    turn: Array,
    push: Array,
    dt: Any,
    *,
    order: str,
    gravity: tuple[float, float, float] = GRAVITY,
    xp: Any,
) -> Array:
    """The state (..., 15) after dt seconds in which the body turned and was pushed by these increments.

        e_m = e + G(e)^-1 turn/2      e' = e + G(e_m)^-1 turn
        v' = v + R(e_m) push + gravity dt      p' = p + (v + v') dt/2

    Angles are not wrapped yet.
    """
    p, e, v = x[..., 0:3], x[..., 3:6], x[..., 6:9]
    middle = e + 0.5 * (inverse_rate_matrix(e, order=order, xp=xp) @ turn[..., None])[..., 0]
    after = e + (inverse_rate_matrix(middle, order=order, xp=xp) @ turn[..., None])[..., 0]
    gained = (matrix_from_angles(middle, order=order, xp=xp) @ push[..., None])[..., 0]
    gained = gained + xp.asarray(gravity, dtype=x.dtype) * dt
    return xp.concat([p + (v + 0.5 * gained) * dt, after, v + gained, x[..., 9:15]], axis=-1)


def move_jacobians(
    x: Array, turn: Array, push: Array, dt: Any, *, order: str, xp: Any
) -> tuple[Array, Array]:
    """The Jacobians of `move`: (15, 15) with respect to x, and (15, 12) to the noises (n_g, n_a, n_bg, n_ba).

    Biases act through the increments, by -dt; noises are taken as additions to the increments, whose sign
    does not matter, and as steps of the biases.
    """
    e = x[..., 3:6]
    W = inverse_rate_matrix(e, order=order, xp=xp)
    middle = e + 0.5 * (W @ turn[..., None])[..., 0]
    W_m = inverse_rate_matrix(middle, order=order, xp=xp)
    D, D_m = (inverse_rate_jacobian(a, turn, order=order, xp=xp) for a in (e, middle))
    R = matrix_from_angles(middle, order=order, xp=xp)
    # d(R push)/de = R [G_k x push]_k = -R [push]x G
    B = -R @ skew(push, xp=xp) @ body_rate_matrix(middle, order=order, xp=xp)
    one, none = xp.eye(3, dtype=x.dtype), xp.zeros((3, 3), dtype=x.dtype)
    middle_by_e = one + 0.5 * D
    e_by_e, e_by_turn = one + D_m @ middle_by_e, W_m + 0.5 * (D_m @ W)
    v_by_e, v_by_turn = B @ middle_by_e, 0.5 * (B @ W)
    half = 0.5 * dt
    row = lambda *parts: xp.concat(list(parts), axis=-1)
    F = xp.concat(
        [
            row(one, v_by_e * half, one * dt, v_by_turn * (-half * dt), R * (-half * dt)),
            row(none, e_by_e, none, e_by_turn * (-dt), none),
            row(none, v_by_e, one, v_by_turn * (-dt), R * (-dt)),
            xp.asarray(np.eye(6, 15, 9), dtype=x.dtype),
        ],
        axis=-2,
    )
    L = xp.concat(
        [
            row(v_by_turn * half, R * half, none, none),
            row(e_by_turn, none, none, none),
            row(v_by_turn, R, none, none),
            xp.asarray(np.eye(6, 12, 6), dtype=x.dtype),
        ],
        axis=-2,
    )
    return F, L


def increment_variances(noise: ImuNoise) -> np.ndarray:
    """The variances (12) a second of (n_g, n_a, n_bg, n_ba): Q, whose dt Q is of increments."""
    parts = (noise.gyro, noise.accelerometer, noise.gyro_bias, noise.accelerometer_bias)
    return np.array([density**2 for density in parts for _ in range(3)])


@block
def predict_extended(
    belief: Gaussian,
    imu: Imu,
    *,
    order: str,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> Gaussian:
    """Predict over `dt` seconds with one IMU reading: the extended Kalman filter.

        x' = move(x)        P' = F P F^T + L (dt Q) L^T

    With dt = 0, as at the first firing, this is the identity.

    Args:
        belief: over `STATE`, mean (15) and covariance (15, 15).
        imu: the reading that holds over the step.
        order: "zxy" or "zyx".
        noise: continuous densities.
        gravity: in the world, m/s^2.
    """
    x = belief.mean
    turn, push = increments(x, imu, dt)
    F, L = move_jacobians(x, turn, push, dt, order=order, xp=xp)
    Q = xp.asarray(increment_variances(noise), dtype=x.dtype) * dt
    P = F @ belief.covariance @ F.mT + (L * Q) @ L.mT
    moved = move(x, turn, push, dt, order=order, gravity=gravity, xp=xp)
    return Gaussian(mean=STATE.plus(moved, xp.zeros_like(x), xp), covariance=0.5 * (P + P.mT))


def extended_crossing(order: str) -> Callable[..., Array]:
    """What `cross_covariance` asks of a filter that predicts with `predict_extended`."""

    def crossing(belief: Gaussian, imu: Imu, dt: Any, xp: Any) -> Array:
        turn, push = increments(belief.mean, imu, dt)
        F, _ = move_jacobians(belief.mean, turn, push, dt, order=order, xp=xp)
        return belief.covariance @ F.mT

    return crossing


def measured_angles(attitude: Array, prior: Array, *, order: str, xp: Any) -> Array:
    """The angles (..., 3) of a measured quaternion: of the two triples that mean it, the one nearer to the
    prior's.

    (phi, theta, psi) and, beyond the singularity, (pi - phi, pi + theta, pi + psi) for "zxy" or (pi + phi,
    pi - theta, pi + psi) for "zyx" are one attitude.
    """
    e = angles_from_quaternion(attitude, order=order, xp=xp)
    signs = np.array([-1.0, 1.0, 1.0] if order == "zxy" else [1.0, -1.0, 1.0])
    other = np.pi + xp.asarray(signs, dtype=e.dtype) * e
    part = angle(3)
    size = lambda a: xp.sum(part.minus(a, prior, xp) ** 2, axis=-1)
    return xp.where((size(e) <= size(other))[..., None], e, other)


def pose_noise(
    pose: PoseMeasurement, e: Array, *, R: npt.ArrayLike, factor: float, order: str, xp: Any
) -> Array:
    """The covariance (6, 6) of a measured (position, angles): R, and `factor` times the measurement's own."""
    kind = e.dtype
    one, none = xp.eye(3, dtype=kind), xp.zeros((3, 3), dtype=kind)
    W = inverse_rate_matrix(e, order=order, xp=xp)
    T = xp.concat([xp.concat([one, none], axis=-1), xp.concat([none, W], axis=-1)], axis=-2)
    return noise_matrix(R, 6, "R", kind=kind, xp=xp) + factor * (T @ pose.covariance @ T.mT)


def seen_place(x: Array, lever: tuple[float, float, float], *, order: str, xp: Any) -> Array:
    """Where the measured point (..., 3) of a body in the states x (..., 15) is: p + R(e) lever."""
    if not any(lever):
        return x[..., 0:3]
    arm = xp.asarray(lever, dtype=x.dtype)
    return x[..., 0:3] + (matrix_from_angles(x[..., 3:6], order=order, xp=xp) @ arm[:, None])[..., 0]


def see_pose_angles(lever: tuple[float, float, float], *, order: str) -> Callable[[Array, Any], Array]:
    """What a measured pose would be of states (..., 15): the place of the point, and the angles (..., 6)."""

    def see(x: Array, xp: Any) -> Array:
        return xp.concat([seen_place(x, lever, order=order, xp=xp), x[..., 3:6]], axis=-1)

    return see


@block
def update_pose_angles(
    prior: Gaussian,
    pose: PoseMeasurement | None,
    scale: Any = None,
    *,
    order: str,
    R: npt.ArrayLike,
    factor: float = 1.0,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """Correct with a measured pose, z = (p + R(e) lever, e) + noise; without one the prior passes through.

    Without a lever the measurement is linear in the state, and with one nearly so, for it measures the angles
    too: an extended and an unscented filter correct alike. Differences of angles are wrapped.

    Args:
        prior: over `STATE`.
        pose: measured; or absent.
        order: "zxy" or "zyx".
        R: covariance (6, 6) of (position, angles), m and rad, its diagonal (6), or one variance.
        factor: on the measurement's own covariance, which is added to R.
        lever: the point in the body whose position is measured, m.
        gate, robust, scale: as in `update_linear` (for six numbers a nis of 22.5 is 99.9 %).
    """
    if pose is None:
        return prior, None
    e = prior.mean[..., 3:6]
    z = xp.concat([pose.position, measured_angles(pose.attitude, e, order=order, xp=xp)], axis=-1)
    expected, H = linearised(see_pose_angles(lever, order=order), prior.mean, STATE, xp, seen=POSE_ANGLES)
    residual = POSE_ANGLES.minus(z, expected, xp)
    noise = scaled(pose_noise(pose, e, R=R, factor=factor, order=order, xp=xp), scale, xp)
    return moved_by(prior, correct(prior.covariance, residual, H, noise, gate=gate, robust=robust, xp=xp), xp)


def moved_by(prior: Gaussian, found: Correction, xp: Any) -> tuple[Gaussian, KalmanInnovation]:
    """The posterior of a correction."""
    mean = STATE.plus(prior.mean, found.shift, xp)
    return Gaussian(mean=mean, covariance=found.covariance), found.innovation


@block
def navigation_belief(belief: Gaussian, *, order: str, xp: Any) -> Belief:
    """The same belief as a `Belief`: a quaternion, and the covariance of (p, v, right rotation vector, b_g,
    b_a). A small change d of the angles is the rotation vector G(e) d."""
    x = belief.mean
    kind = x.dtype
    G = body_rate_matrix(x[..., 3:6], order=order, xp=xp)
    wide = np.zeros((15, 15))
    wide[0:3, 0:3], wide[3:6, 6:9], wide[9:15, 9:15] = np.eye(3), np.eye(3), np.eye(6)
    lift = xp.asarray(np.eye(15, 3, -6), dtype=kind)
    drop = xp.asarray(np.eye(3, 15, 3), dtype=kind)
    T = xp.asarray(wide, dtype=kind) + lift @ G @ drop
    P = T @ belief.covariance @ T.mT
    return Belief(
        position=x[..., 0:3],
        velocity=x[..., 6:9],
        attitude=quaternion_from_angles(x[..., 3:6], order=order, xp=xp),
        gyro_bias=x[..., 9:12],
        accelerometer_bias=x[..., 12:15],
        covariance=0.5 * (P + P.mT),
    )


def euler_steps(result: Result, order: str) -> Steps:
    """Those of a run of a filter over `STATE` that was wired for a smoother."""

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        values = navigation_belief.step(belief, order=order, xp=np)
        return Series(smoothed.time, values, name=smoothed.name)

    return steps_of(result, STATE)._replace(named=named)


@block
def euler_angles(belief: Gaussian, *, order: str, xp: Any) -> EulerAngles:
    """The angles of a belief, with their deviations, and the cosine of the one that must not reach 90
    degrees."""
    e, P = belief.mean[..., 3:6], belief.covariance
    variance = xp.sum(P * xp.eye(15, dtype=P.dtype), axis=-1)[..., 3:6]
    return EulerAngles(
        angles=e,
        cosine=singular_cosine(e, order=order, xp=xp),
        deviations=xp.sqrt(xp.maximum(variance, 0.0)),
    )


def singularity_warning(cosine: np.ndarray, order: str) -> str | None:
    """What to say of a run whose cosine (n,) came near to zero; None where it did not."""
    if not len(cosine) or np.abs(cosine).min() >= 5.0 * NEAR:
        return None
    name = {"zxy": "phi (roll)", "zyx": "theta (pitch)"}[order]
    return (
        f"the attitude came near the singularity of {order}, {name} = +-90 degrees"
        f" (least cosine {np.abs(cosine).min():.3g}): angles and their rates are not to be trusted there;"
        f" use the other convention, or ins_eskf"
    )


def start_gaussian(
    position: npt.ArrayLike,
    attitude: npt.ArrayLike,
    *,
    order: str,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    deviations: tuple[float, float, float, float, float] = (0.05, 0.05, 0.3, 0.03, 0.15),
) -> Gaussian:
    """A belief to start from, of a position and a quaternion, with zero biases.

    Args:
        deviations: of position, angles, velocity, gyroscope and accelerometer bias, each on three axes.

    Raises:
        UnknownNameError: for a convention that does not exist.
    """
    need_order(order)
    R = np.asarray(to_matrix(np.asarray(attitude, dtype=float), xp=np))
    e = angles_from_matrix(R, order=order, xp=np)
    mean = np.concatenate([np.asarray(position, float), e, np.asarray(velocity, float), np.zeros(6)])
    return Gaussian(mean=mean, covariance=np.diag(np.repeat(np.square(deviations), 3)))


def with_heading(start: Gaussian, deviation: float | None) -> Gaussian:
    """The belief, whose yaw has such a deviation, rad; as it is for None."""
    P = np.array(start.covariance)
    P[5, 5] = P[5, 5] if deviation is None else deviation**2
    return Gaussian(mean=start.mean, covariance=P)
