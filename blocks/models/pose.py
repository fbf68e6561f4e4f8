"""The extended Kalman filter of a pose: ten numbers, of which the quaternion's four are taken as a vector.

State x = (v, p, q): velocity (m/s) and position (m) in the world, attitude body to world. The quaternion
moves and is corrected like any vector, and is scaled back to unit norm after each; the covariance is turned
with it, so that nothing is left along q. The error-state filter of `inertial` needs three numbers where this
one has four.

Sources: R. Fiszel, thesis (2017), section on the extended Kalman filter; J. Solà, "Quaternion kinematics for
the error-state Kalman filter", arXiv:1711.02508, 2017 (eq. 174: how a rotated vector changes with the
quaternion).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Held, Result, Series, Stream, block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    right_product,
    rotate,
    skew,
)  # fmt: skip
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.filters import correct, scaled
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.kalman.smoothing import Steps
from flowgraph.blocks.signals import Gaussian, Imu, KalmanInnovation, Pose, PoseBelief, QuaternionBelief

__all__ = [
    "between_imu",
    "driving",
    "in_tangent_space",
    "move",
    "move_jacobian",
    "observe_jacobian",
    "pose_at_start",
    "pose_belief",
    "pose_steps",
    "predict_pose",
    "quaternion_noise",
    "start_pose",
    "update_pose",
]

POSE = StateSpace(euclidean(3), quaternion())
"""What a motion capture measures; its error is (m, world; rad, body)."""

_VV = np.diag([1.0] * 3 + [0.0] * 3)
_PP = np.diag([0.0] * 3 + [1.0 / 3.0] * 3)
_VP = (np.eye(6, 6, 3) + np.eye(6, 6, -3)) / 2.0
"""What white noise on the acceleration leaves in (v, p): the coefficients of dt, dt^3 and dt^2."""


@block
def between_imu(before: Imu, now: Imu) -> Imu:
    """The mean of the last reading and this one, which a step between their times holds."""
    return Imu(
        gyro=0.5 * (before.gyro + now.gyro),
        specific_force=0.5 * (before.specific_force + now.specific_force),
    )


Reading = Stream[Imu] | Held[Imu]


def driving(last: Reading, control: Reading, reading: str) -> Any:
    """What drives the step to now, of the last control and this one.

    Args:
        reading: "mean" where a reading is the mean over the step since the one before, which is this one;
            "instant" where it is of its stamp: then it is the mean of the two at the ends.
    """
    return control if reading == "mean" else between_imu(last, control)


@block
def predict_pose(
    belief: QuaternionBelief,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> QuaternionBelief:
    """Predict over `dt` seconds with one IMU reading, held over the step.

        a = R(q * Exp(w dt/2)) f + gravity
        v' = v + a dt      p' = p + v dt + a dt^2/2      q' = q * Exp(w dt), scaled to unit norm
        P' = F P F^T + Q

    F is `move_jacobian`. Q: white noise of the force, s_a^2 [dt, dt^2/2; dt^2/2, dt^3/3] on (v, p), and
    `quaternion_noise` on q. With dt = 0, as at the first firing, this is the identity.
    """
    v, p, q = move(belief.velocity, belief.position, belief.attitude, imu, dt, xp, gravity=gravity)
    F = move_jacobian(belief.attitude, imu, dt, xp)
    P = F @ belief.covariance @ F.mT + motion_noise(q, noise, dt, xp)
    return unit(v, p, q, P, xp)


@block
def update_pose(
    prior: QuaternionBelief,
    pose: Pose | None,
    scale: Any = None,
    *,
    position_noise: float,
    attitude_noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[QuaternionBelief, KalmanInnovation | None]:
    """Correct with a measured pose, where there is one; without one the prior passes through.

    z = (p + R(q) lever + noise, q * Exp(noise)), and the residual is z minus its prediction on the manifold:
    (m, world; rad, body), six numbers, so that q and -q are the same. H is `observe_jacobian`. The ten
    numbers move by K r, in Joseph form, and the quaternion is scaled back to unit norm.

    Args:
        prior: the belief at the time of the measurement.
        pose: z; or absent.
        position_noise, attitude_noise: standard deviations, m and rad.
        lever: the point whose position is measured, m, body.
        gate, robust, scale: as in `update_linear`.

    An entry that is NaN was not measured, and the others correct alone; a NaN in the quaternion takes all of
    the attitude with it.
    """
    if pose is None:
        return prior, None
    kind = prior.position.dtype
    arm = xp.asarray(lever, dtype=kind)
    expected = xp.concat([prior.position + rotate(prior.attitude, arm, xp=xp), prior.attitude], axis=-1)
    residual = POSE.minus(xp.concat([pose.position, pose.attitude], axis=-1), expected, xp)
    present = ~xp.isnan(residual)
    residual = xp.where(present, residual, 0.0)
    H = observe_jacobian(prior.attitude, arm, xp)
    R = np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3)
    R = scaled(xp.asarray(R, dtype=kind), scale, xp)
    found = correct(prior.covariance, residual, H, R, present=present, gate=gate, robust=robust, xp=xp)
    d = found.shift
    posterior = unit(
        prior.velocity + d[..., 0:3],
        prior.position + d[..., 3:6],
        prior.attitude + d[..., 6:10],
        found.covariance,
        xp,
    )
    return posterior, found.innovation


@block
def pose_belief(belief: QuaternionBelief, *, xp: Any) -> PoseBelief:
    """The same belief with its covariance in the tangent space (9, 9), in the order of `PoseBelief`."""
    q = belief.attitude
    T = _to_tangent(q, xp)
    P = T @ belief.covariance @ T.mT
    return PoseBelief(
        position=belief.position, velocity=belief.velocity, attitude=q, covariance=0.5 * (P + P.mT)
    )


def move(
    v: Array, p: Array, q: Array, imu: Imu, dt: Any, xp: Any, *, gravity: tuple[float, ...] = GRAVITY
) -> tuple[Array, Array, Array]:
    """(v', p', q') after dt seconds, q' not yet scaled; as in `predict_pose`."""
    half = multiply(q, from_rotation_vector(imu.gyro * (0.5 * dt), xp=xp), xp=xp)
    a = rotate(half, imu.specific_force, xp=xp) + xp.asarray(gravity, dtype=q.dtype)
    turned = multiply(q, from_rotation_vector(imu.gyro * dt, xp=xp), xp=xp)
    return v + a * dt, p + (v + a * (0.5 * dt)) * dt, turned


def move_jacobian(q: Array, imu: Imu, dt: Any, xp: Any) -> Array:
    """The Jacobian (10, 10) of `move` with respect to (v, p, q).

    [I     0  A dt    ]     A = d(R(h) f)/dh M(w dt/2), h = q * Exp(w dt/2)
    [I dt  I  A dt^2/2]
    [0     0  M(w dt) ]     M(v) the matrix of the product with Exp(v) on the right
    """
    turn = from_rotation_vector(imu.gyro * (0.5 * dt), xp=xp)
    by_half = right_product(turn, xp=xp)
    half = (by_half @ q[..., None])[..., 0]
    pull = rotated_jacobian(half, imu.specific_force, xp) @ by_half * dt
    one = np.eye(3)
    stay = xp.asarray(np.block([[one, 0 * one], [0 * one, one]]), dtype=q.dtype)
    drift = xp.asarray(np.block([[0 * one, 0 * one], [one, 0 * one]]), dtype=q.dtype) * dt
    top = xp.concat([stay + drift, xp.concat([pull, pull * (0.5 * dt)], axis=-2)], axis=-1)
    full = right_product(from_rotation_vector(imu.gyro * dt, xp=xp), xp=xp)
    low = xp.concat([xp.asarray(np.zeros((4, 6)), dtype=q.dtype), full], axis=-1)
    return xp.concat([top, low], axis=-2)


def observe_jacobian(q: Array, lever: Array, xp: Any) -> Array:
    """The Jacobian (6, 10) of what a motion capture measures, in its tangent space, with respect to (v, p,
    q).

        [0  I  d(R(q) lever)/dq]
        [0  0  2 V(q^-1)       ]     V(q^-1) d: the vector part of q^-1 * d
    """
    kind = q.dtype
    none, one = np.zeros((3, 3)), np.eye(3)
    turned = rotated_jacobian(q, lever, xp)
    place = xp.concat([xp.asarray(np.hstack([none, one]), dtype=kind), turned], axis=-1)
    turn = xp.concat([xp.asarray(np.hstack([none, none]), dtype=kind), _to_angle(q, xp)], axis=-1)
    return xp.concat([place, turn], axis=-2)


def rotated_jacobian(q: Array, v: Array, xp: Any) -> Array:
    """The Jacobian (3, 4) of R(q) v with respect to q = (w, u).

        2 [w v + u x v,  (u.v) I + u v^T - v u^T - w [v]x]

    Source: Solà 2017, eq. 174.
    """
    w, u = q[..., :1], q[..., 1:]
    column = w * v + (skew(u, xp=xp) @ v[..., None])[..., 0]
    uv = u[..., :, None] * v[..., None, :]
    along = xp.linalg.vecdot(u, v)[..., None, None] * xp.eye(3, dtype=q.dtype)
    rest = along + uv - uv.mT - w[..., None] * skew(v, xp=xp)
    return 2.0 * xp.concat([column[..., :, None], rest], axis=-1)


def motion_noise(q: Array, noise: ImuNoise, dt: Any, xp: Any) -> Array:
    """Q (10, 10) of `predict_pose`, at the attitude after the step."""
    push, kind = noise.accelerometer**2 * dt, q.dtype
    Q_vp = xp.asarray(_VV, dtype=kind) * push + xp.asarray(_VP, dtype=kind) * (push * dt)
    Q_vp = Q_vp + xp.asarray(_PP, dtype=kind) * (push * dt * dt)
    Q_q = quaternion_noise(q, noise.gyro, dt, xp)
    wide = xp.asarray(np.zeros((6, 4)), dtype=kind)
    return xp.concat([xp.concat([Q_vp, wide], axis=-1), xp.concat([wide.mT, Q_q], axis=-1)], axis=-2)


def quaternion_noise(q: Array, density: float, dt: Any, xp: Any) -> Array:
    """The covariance (4, 4) that rate noise of `density` (rad/s/sqrt(Hz)) leaves in q over dt, unscented.

    Six sigma points of the rotation noise e ~ N(0, density^2 dt I), each +-sqrt(3) deviations along an axis,
    go through Y = q * Exp(e); the covariance is that of the Y, taken as deviations from q.

    Source: S. Julier and J. Uhlmann, "A new extension of the Kalman filter to nonlinear systems", 1997.
    """
    axes = xp.asarray(np.vstack([np.eye(3), -np.eye(3)]), dtype=q.dtype)
    points = from_rotation_vector(axes * (density * xp.sqrt(xp.asarray(3.0 * dt))), xp=xp)
    apart = multiply(q + 0.0 * points, points, xp=xp) - q
    apart = apart - xp.mean(apart, axis=-2, keepdims=True)
    return apart.mT @ apart / 6.0


_UNSURE = (0.7, 0.7, 0.3)
"""Deviations of velocity, position and attitude at a start of which nothing else is said: m/s, m, rad."""


def start_pose(
    position: npt.ArrayLike,
    attitude: npt.ArrayLike,
    *,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    position_deviation: float = _UNSURE[1],
    velocity_deviation: float = _UNSURE[0],
    attitude_deviation: float = _UNSURE[2],
) -> QuaternionBelief:
    """A belief to start from, with standard deviations in m, m/s and rad (about each body axis)."""
    v, p, q = (np.asarray(x, dtype=float) for x in (velocity, position, attitude))
    return _started(v, p, q, (velocity_deviation, position_deviation, attitude_deviation), np)


@block
def pose_at_start(
    pose: Pose, *, deviations: tuple[float, float, float] = _UNSURE, xp: Any
) -> QuaternionBelief:
    """`start_pose` at a measured pose and at rest; deviations in m/s, m and rad."""
    return _started(0.0 * pose.position, pose.position, pose.attitude, deviations, xp)


def _started(
    velocity: Array, position: Array, q: Array, deviations: tuple[float, float, float], xp: Any
) -> QuaternionBelief:
    moving = np.diag(np.repeat(deviations[:2], 3) ** 2) @ np.eye(6, 10)
    around = (xp.eye(4, dtype=q.dtype) - q[:, None] * q[None, :]) * (0.5 * deviations[2]) ** 2
    turning = xp.concat([xp.zeros((4, 6), dtype=q.dtype), around], axis=1)
    P = xp.concat([xp.asarray(moving, dtype=q.dtype), turning], axis=0)
    return QuaternionBelief(velocity=velocity, position=position, attitude=q, covariance=P)


def pose_steps(result: Result) -> Steps:
    """Those of a run of `ekf`, which collects `prior`, `posterior` and the `control` of each prediction.

    The state is (position, velocity, attitude), ten numbers, and its errors are the nine of `PoseBelief`.
    """
    prior, posterior = (
        Series(s.time, in_tangent_space(s.values)) for s in (result["prior"], result["posterior"])
    )
    # between the tangent spaces of ten numbers and nine, for all ticks at once
    drive, dt = result["control"][1:].values, np.diff(posterior.time)[:, None] * 1e-9

    def carried(x: Array, xp: Any) -> Array:
        v, p, q = move(x[..., 3:6], x[..., 0:3], x[..., 6:], drive, dt, xp)
        return xp.concat([p, v, q], axis=-1)

    space = StateSpace(euclidean(6), quaternion())
    _, jacobians = linearised(carried, posterior["mean"][:-1], space, np, seen=space)

    def named(smoothed: Series) -> Series:
        p, v, q = np.split(smoothed["mean"], (3, 6), axis=-1)
        return Series(smoothed.time, PoseBelief(p, v, q, smoothed["covariance"]), name=smoothed.name)

    return Steps(prior, posterior, jacobians, space, named)


def in_tangent_space(belief: QuaternionBelief) -> Gaussian:
    """A belief, or one at each tick, over (position, velocity, attitude)."""
    named = pose_belief.step(belief, xp=np)
    mean = np.concatenate([named.position, named.velocity, named.attitude], axis=-1)
    return Gaussian(mean=mean, covariance=named.covariance)


def _to_angle(q: Array, xp: Any) -> Array:
    """The matrix (3, 4) that makes of a small change of q its right rotation vector: 2 V(q^-1)."""
    inverse = conjugate(q, xp=xp)
    w, u = inverse[..., 0:1], inverse[..., 1:]
    vector = w[..., None] * xp.eye(3, dtype=q.dtype) + skew(u, xp=xp)
    return 2.0 * xp.concat([u[..., :, None], vector], axis=-1)


def _to_tangent(q: Array, xp: Any) -> Array:
    """The matrix (9, 10) that makes of a small change of (v, p, q) its error, ordered as in `PoseBelief`."""
    one, wide = np.eye(3), np.zeros((3, 4))
    angle = _to_angle(q, xp)
    none = 0.0 * angle[..., :3]
    swap = xp.asarray(np.block([[0 * one, one, wide], [one, 0 * one, wide]]), dtype=q.dtype)
    swap = xp.broadcast_to(swap, (*q.shape[:-1], 6, 10)) if q.ndim > 1 else swap
    return xp.concat([swap, xp.concat([none, none, angle], axis=-1)], axis=-2)


def unit(v: Array, p: Array, q: Array, P: Array, xp: Any) -> QuaternionBelief:
    """A belief with q scaled to unit norm and its covariance with it: N = (I - q q^T) / |q|."""
    size = xp.sqrt(xp.linalg.vecdot(q, q))[..., None]
    q = q / size
    N = (xp.eye(4, dtype=q.dtype) - q[..., :, None] * q[..., None, :]) / size[..., None]
    top = xp.asarray(np.eye(6, 10), dtype=q.dtype)
    whole = xp.concat([top, xp.concat([xp.asarray(np.zeros((4, 6)), dtype=q.dtype), N], axis=-1)], axis=-2)
    P = whole @ P @ whole.mT
    return QuaternionBelief(velocity=v, position=p, attitude=q, covariance=0.5 * (P + P.mT))
