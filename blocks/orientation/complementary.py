"""Complementary filters: a gyroscope for what is fast, gravity or a camera for what is slow.

A gyroscope that is integrated follows every turn at once, and drifts; an accelerometer shows the vertical on
average, and is noisy. So the one is high-passed, the other low-passed, with one cut-off, so that the two
shares add up to all of the attitude. On one axis, with w the rate and z the angle seen, this is

    y_k = high_pass(integral of w) + low_pass(z) = a (y_(k-1) + w dt) + (1 - a) z_k

and on rotations the right-hand side becomes a turn by the gyroscope and a step of the share 1 - a on the
shortest way to the attitude seen (`turn_by_gyro`, then `blend`).

Source: R. Mahony, T. Hamel, J.-M. Pflimlin, "Nonlinear complementary filters on the special orthogonal
group", IEEE Trans. Automatic Control 53(5), 2008, secs. II and III; R. Fiszel, thesis (2017), sections on the
complementary filters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    level,
    multiply,
    normalize,
    rotate,
    to_rotation_vector,
)
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.signals import (
    Attitude,
    CoordinateAcceleration,
    Gyro,
    Imu,
    Pose,
    PoseEstimate,
    SpecificForce,
    Thrust,
    WorldForce,
)

__all__ = [
    "turn_by_gyro",
    "carry_to_world",
    "level_near",
    "remove_thrust",
    "blend",
    "dead_reckon",
    "correct_by_pose",
]


# -- the gyroscope's side --------------------------------------------------------------------------------


@block
def turn_by_gyro(  # type: ignore[no-untyped-def]
    last, attitude: Attitude, gyro: Gyro, *, reading: str = "instant", dt: float, xp: Any
) -> tuple[Any, Attitude]:
    """Turn an attitude over `dt` seconds by the mean of the rate before and the rate now.

        q' = q * Exp((w_last + w) dt / 2)

    The mean, since either rate alone leads or lags by half a step; but a `reading` that is the "mean" over
    the step, not of an "instant", turns it alone. With dt = 0, as at the first firing, this is the identity.
    Fires when its inputs do. State: the last rate (3,), rad/s.
    """
    rate = gyro.rate if reading == "mean" else 0.5 * (last + gyro.rate)
    turn = from_rotation_vector(rate * dt, xp=xp)
    return gyro.rate, Attitude(attitude=normalize(multiply(attitude.attitude, turn, xp=xp), xp=xp))


@turn_by_gyro.init
def _(attitude: Any, gyro: Any, **_: Any) -> Any:
    return np.zeros(3)


# -- what gravity shows ----------------------------------------------------------------------------------


@block
def carry_to_world(attitude: Attitude, force: SpecificForce, *, xp: Any) -> WorldForce:
    """The specific force R(q) f in the world, as an attitude says that it is. Fires when its inputs do."""
    return WorldForce(force=rotate(attitude.attitude, force.force, xp=xp))


@block
def level_near(attitude: Attitude, force: WorldForce, *, xp: Any) -> Attitude:
    """The attitude nearest to `attitude` in which `force`, which it carried to the world, points up.

    The smallest rotation that takes the direction of `force` to +z, after `attitude`: it is about a
    horizontal axis, so the heading stays that of `attitude`. A force of zero, as a sensor gives that has not
    started, points nowhere: `attitude` stays. Fires when its inputs do.
    """
    q = attitude.attitude
    in_body = rotate(conjugate(q, xp=xp), force.force, xp=xp)
    points = (xp.linalg.vecdot(in_body, in_body) > 0.0)[..., None]
    up = xp.where(points, in_body, xp.asarray([0.0, 0.0, 1.0]))
    return Attitude(attitude=xp.where(points, level(q, up, xp=xp), q))


@block
def remove_thrust(acceleration: CoordinateAcceleration, thrust: Thrust, *, xp: Any) -> SpecificForce:
    """Gravity's reaction, from what a quadrotor's acceleration is beyond its thrust.

    Thrust and gravity are all the forces there are, R^T a = T e_z + R^T g, so

        -R^T g = T e_z - R^T a

    which is what an accelerometer would read at this attitude if the body did not accelerate. Fires when its
    inputs do.
    """
    a = acceleration.acceleration
    push = thrust.thrust[..., None] * xp.asarray((0.0, 0.0, 1.0), dtype=a.dtype)
    return SpecificForce(force=push - a)


# -- both together ---------------------------------------------------------------------------------------


@block
def blend(attitude: Attitude, seen: Attitude | None, *, alpha: float, xp: Any) -> Attitude:
    """A step of the share 1 - alpha on the shortest way from `attitude` to the one that was seen.

        q' = q * Exp((1 - alpha) Log(q^-1 q_seen))

    Without `seen` the attitude passes through. Fires with `attitude`.
    """
    if seen is None:
        return attitude
    q = _towards(attitude.attitude, seen.attitude, 1.0 - alpha, xp)
    return Attitude(attitude=q)


def _towards(q: Array, seen: Array, share: float, xp: Any) -> Array:
    error = to_rotation_vector(multiply(conjugate(q, xp=xp), seen, xp=xp), xp=xp)
    return normalize(multiply(q, from_rotation_vector(share * error, xp=xp), xp=xp), xp=xp)


@block
def dead_reckon(
    last,
    estimate: PoseEstimate,
    imu: Imu,
    *,
    gravity: tuple[float, float, float] = GRAVITY,
    reading: str = "instant",
    dt: float,
    xp: Any,
) -> tuple[Any, PoseEstimate]:
    """Carry a pose and velocity over `dt` seconds on what an IMU read at both ends of the step.

        q' = q * Exp((w_last + w) dt / 2)       a = (R(q) f_last + R(q') f) / 2 + gravity
        p' = p + v dt + a dt^2 / 2              v' = v + a dt

    (The thesis adds the reading to the velocity as it is, in body coordinates; it is turned to the world
    here.) A `reading` that is the "mean" over the step, not of an "instant", turns by w dt, and its force by
    the attitude half way. With dt = 0 this is the identity. Fires when its inputs do. State: the last
    reading.
    """
    kind = estimate.position.dtype
    if reading == "mean":
        half = from_rotation_vector(0.5 * imu.gyro * dt, xp=xp)
        middle = multiply(estimate.attitude, half, xp=xp)
        q = normalize(multiply(middle, half, xp=xp), xp=xp)
        force = rotate(middle, imu.specific_force, xp=xp)
    else:
        turn = from_rotation_vector(0.5 * (last.gyro + imu.gyro) * dt, xp=xp)
        q = normalize(multiply(estimate.attitude, turn, xp=xp), xp=xp)
        before = rotate(estimate.attitude, last.specific_force, xp=xp)
        now = rotate(q, imu.specific_force, xp=xp)
        force = 0.5 * (before + now)
    step = (force + xp.asarray(gravity, dtype=kind)) * dt
    return imu, PoseEstimate(
        position=estimate.position + (estimate.velocity + 0.5 * step) * dt,
        velocity=estimate.velocity + step,
        attitude=q,
    )


@dead_reckon.init
def _(estimate: Any, imu: Any, *, gravity: tuple[float, float, float] = GRAVITY, **_: Any) -> Any:
    return Imu.at_rest(gravity)


@block
def correct_by_pose(
    state,
    prior: PoseEstimate,
    pose: Pose,
    *,
    alpha: float,
    velocity_alpha: float,
    attitude_alpha: float,
    dt: float,
    xp: Any,
) -> tuple[Any, PoseEstimate]:
    """Complement an estimate with a measured pose, `dt` seconds after the one before.

        p = alpha p- + (1 - alpha) z          q = q- * Exp((1 - alpha_q) Log(q-^-1 q_z))
        v = v- + (1 - alpha_v) ((z - z_last) - (p- - p_last)) / dt

    The velocity is that of the thesis, (1 - alpha) (z - z_last) / dt, compared with like: a difference of
    positions is a mean over the interval, half of it late, so the filter's own mean over the same interval is
    taken off it. At the first pose, dt = 0, the velocity stays.

    Fires when its inputs do. State: the last measured position and the estimate's own, after its correction.
    """
    moved = (pose.position - state["measured"]) - (prior.position - state["own"])
    known = dt > 0.0
    rate = moved * xp.where(known, (1.0 - velocity_alpha) / xp.where(known, dt, 1.0), 0.0)
    position = prior.position + (1.0 - alpha) * (pose.position - prior.position)
    corrected = PoseEstimate(
        position=position,
        velocity=prior.velocity + rate,
        attitude=_towards(prior.attitude, pose.attitude, 1.0 - attitude_alpha, xp),
    )
    return {"measured": pose.position, "own": position}, corrected


@correct_by_pose.init
def _(prior: Any, pose: Any, **_: Any) -> Any:
    return {"measured": np.zeros(3), "own": np.zeros(3)}
