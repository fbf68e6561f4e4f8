"""What a fixed gain leaves of noise: the covariance of filters that do not compute one for themselves.

A complementary filter weighs by shares that are set by hand, so it needs no covariance. But its error is a
linear function of all noise so far, and how large it is follows from the same recursion as for any gain K,
good or bad:

    predict   P- = F P F^T + Q                  correct   P = (I - K H) P- (I - K H)^T + K R K^T

Nothing here reaches the estimate. What it tells is as honest as the noise that it is told; what the filter
takes for noise and is none, such as an accelerating body's specific force where the vertical is meant, is not
in it.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 5.2.3 (the Joseph form, valid for any gain).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import skew, to_matrix
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.signals import (
    Attitude,
    AttitudeBelief,
    Imu,
    Pose,
    PoseBelief,
    PoseEstimate,
    SpecificForce,
)

__all__ = ["AttitudeNoise", "PoseNoise", "attitude_spread", "pose_spread"]

UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class AttitudeNoise:
    """What an attitude by a gyroscope and a direction suffers from.

    Args:
        gyro: rad/s/sqrt(Hz).
        force: m/s^2, the standard deviation of one reading on each body axis, independent of the one before.
        start: rad, of the first attitude about each axis.
        heading: rad, about the vertical in its place.
    """

    gyro: float
    force: tuple[float, float, float]
    start: float
    heading: float | None = None


@dataclass(frozen=True)
class PoseNoise:
    """What a pose by an IMU and a motion capture suffers from.

    Args:
        imu: its densities; its biases are left out.
        position, attitude: m and rad, of a measured pose.
        start: of position (m), velocity (m/s) and attitude (rad) at first, on each axis.
    """

    imu: ImuNoise
    position: float
    attitude: float
    start: tuple[float, float, float]


@block
def attitude_spread(
    spread,
    attitude: Attitude,
    up: SpecificForce | None,
    *,
    alpha: float,
    noise: AttitudeNoise,
    heading: str = "gyroscope",
    dt: float,
    xp: Any,
) -> tuple[Any, AttitudeBelief]:
    """The covariance of an attitude that a gyroscope turns and a direction that is up corrects.

    In the world, where the share of the gyroscope is the same whatever the attitude:

        P' = M (P + s_w^2 dt I) M^T + (1 - alpha)^2 J S J^T        S = diag(force noise^2)

    With heading "gyroscope" M = diag(alpha, alpha, 1), for the heading is not corrected, and J = [e_z]x R
    / |f|: what an error of the force does to the direction. With "shortest_arc" M = alpha I, and J is the
    derivative of that arc, which reaches the heading too. Without `up` there is no correction. Fires with
    `attitude`.

    State: P (3, 3), world.

    Args:
        attitude: the filter's output at this tick.
        up: the force (m/s^2, body) that it took for up in this tick, if any.
        alpha: the gyroscope's share.
        noise: of both sensors, and of the start.
        heading: "gyroscope" or "shortest_arc".
    """
    q = attitude.attitude
    one = xp.eye(3, dtype=q.dtype)
    R = to_matrix(q, xp=xp)
    P = spread + noise.gyro**2 * dt * one
    if up is not None:
        size = xp.sqrt(xp.linalg.vecdot(up.force, up.force))[..., None]
        if heading == "gyroscope":
            keep = xp.asarray(np.diag([alpha, alpha, 1.0]), dtype=q.dtype)
            J = xp.asarray(np.asarray(skew(UP, xp=np)), dtype=q.dtype) @ R / size[..., None]
        else:
            keep = alpha * one
            J = _arc_jacobian(up.force / size, xp) / size[..., None]
        J = J * xp.asarray(noise.force, dtype=q.dtype) * (1.0 - alpha)
        P = keep @ P @ keep + J @ J.mT
    return P, AttitudeBelief(attitude=q, covariance=_symmetric(R.mT @ P @ R))


@attitude_spread.init
def _(attitude: Any, up: Any, *, noise: AttitudeNoise, **_: Any) -> Any:
    heading = noise.start if noise.heading is None else noise.heading
    return np.eye(3) * np.square([noise.start, noise.start, heading])


def _arc_jacobian(n: Array, xp: Any) -> Array:
    """How the shortest arc from n (..., 3) to +z turns, about world axes, when n moves: (..., 3, 3).

        r = (n_y' - n_z' n_y / (1 + n_z), -n_x' + n_z' n_x / (1 + n_z), -(n_y n_x' - n_x n_y') / (1 + n_z))

    with n' the part of the move that is across n. As in `world.quadrotor`, where the arc goes the other way.
    """
    x, y, up = n[..., 0:1], n[..., 1:2], 1.0 + n[..., 2:3]
    zero, one = 0.0 * x, 0.0 * x + 1.0
    rows = ([zero, one, -y / up], [-one, zero, x / up], [-y / up, x / up, zero])
    whole = xp.stack([xp.concat(row, axis=-1) for row in rows], axis=-2)
    return whole - (whole @ n[..., None]) * n[..., None, :]


@block
def pose_spread(
    state,
    previous: PoseEstimate,
    imu: Imu,
    estimate: PoseEstimate,
    pose: Pose | None,
    *,
    alpha: float,
    velocity_alpha: float,
    attitude_alpha: float,
    noise: PoseNoise,
    dt: float,
    xp: Any,
) -> tuple[Any, PoseBelief]:
    """The covariance of `augmented_complementary`, whose errors e = (p, v, theta) move and are corrected as

        p' = p + v dt + A theta dt/2      v' = v + A theta             theta' = theta - [w dt]x theta
        p = alpha p- - (1 - alpha) n      v = v- - c (p- + n - d)      theta = a_q theta- - (1 - a_q) m

    with A = -R [f]x dt, the noise n of a position and m of an attitude, and c = (1 - alpha_v) / (time since
    the last pose), 0 at the first. The velocity is corrected with a difference of two poses, so the noise of
    the last one comes back: d = p + n after the last correction, three numbers more, whose covariance is
    carried along.

    State: covariance (12, 12) of (p, v, theta, d), the seconds since the last pose, and whether there was
    one. Fires with its main inputs.

    Args:
        previous, estimate: the output of the tick before and of this one.
        imu: the reading that led from one to the other.
        pose: the measurement in this tick, if any.
        alpha, velocity_alpha, attitude_alpha: the IMU's shares.
        noise: of both sensors, and of the start.
    """
    kind = estimate.position.dtype
    one, none = xp.eye(3, dtype=kind), 0.0 * xp.eye(3, dtype=kind)
    A = to_matrix(previous.attitude, xp=xp) @ skew(imu.specific_force * -dt, xp=xp)
    turn = one - skew(imu.gyro * dt, xp=xp)
    F = _blocks(
        [[one, one * dt, A * (0.5 * dt), none], [none, one, A, none], [none, none, turn, none],
         [none, none, none, one]], xp,
    )  # fmt: skip
    Q = motion_noise(noise.imu, one, dt, xp)
    P, since, seen = F @ state["covariance"] @ F.mT + Q, state["since"] + dt, state["seen"]
    if pose is not None:
        c = xp.where(since > 0.0, (1.0 - velocity_alpha) / xp.where(since > 0.0, since, 1.0), 0.0) * seen
        keep = _blocks(
            [[one * alpha, none, none, none], [one * -c, one, none, one * c],
             [none, none, one * attitude_alpha, none], [one * alpha, none, none, none]], xp,
        )  # fmt: skip
        gain = _blocks(
            [[one * (alpha - 1.0), none], [one * -c, none], [none, one * (attitude_alpha - 1.0)],
             [one * alpha, none]], xp,
        )  # fmt: skip
        gain = gain * xp.asarray([noise.position] * 3 + [noise.attitude] * 3, dtype=kind)
        P = keep @ P @ keep.mT + gain @ gain.mT
        since, seen = 0.0 * since, 0.0 * seen + 1.0
    P = _symmetric(P)
    belief = PoseBelief(
        position=estimate.position,
        velocity=estimate.velocity,
        attitude=estimate.attitude,
        covariance=P[..., :9, :9],
    )
    return {"covariance": P, "since": since, "seen": seen}, belief


def motion_noise(noise: ImuNoise, one: Array, dt: Any, xp: Any) -> Array:
    """What a step of `pose_spread` adds (12, 12); one (3, 3)."""
    none, push, rate = 0.0 * one, noise.accelerometer**2 * dt, noise.gyro**2 * dt
    return _blocks(
        [[one * (push * dt * dt / 3.0), one * (push * dt / 2.0), none, none],
         [one * (push * dt / 2.0), one * push, none, none], [none, none, one * rate, none],
         [none, none, none, none]], xp,
    )  # fmt: skip


@pose_spread.init
def _(previous: Any, imu: Any, estimate: Any, pose: Any, *, noise: PoseNoise, **_: Any) -> Any:
    spread = np.repeat([*noise.start, 0.0], 3) ** 2
    return {"covariance": np.diag(spread), "since": np.float64(0.0), "seen": np.float64(0.0)}


def _blocks(rows: list[list[Array]], xp: Any) -> Array:
    return xp.concat([xp.concat(row, axis=-1) for row in rows], axis=-2)


def _symmetric(P: Array) -> Array:
    return 0.5 * (P + P.mT)
