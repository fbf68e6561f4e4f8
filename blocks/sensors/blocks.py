"""Sensors as blocks: what a sensor reads of a `BodyMotion`, drawn tick by tick in the graph itself.

Each fires at its own clock, a source without data (`ticks`), and draws its errors by the counter-based
generator, by the name of the block and the time; so a flight is its seed, in every engine. A bias is two
blocks: `bias_at_start` draws it once, `drift` lets it walk. A sensor of one's own is a block as short as
these:

    @block
    def read_speed(motion: BodyMotion, *, noise: float, draw, xp) -> Scalar:
        speed = xp.sqrt(xp.linalg.vecdot(motion.velocity, motion.velocity))
        return speed + noise * draw.normal("noise", ())

A reading that arrives late is one of a body that moved on: let the sensor fire when it arrives, and read the
motion of then, or a `delay` of it.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import block, when
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, rotate
from flowgraph.blocks.signals import (
    GRAVITY,
    Attitude,
    BodyMotion,
    Imu,
    MagneticField,
    NavigationState,
    OpticalFlow,
    Pose,
    Position,
    Range,
    Vector,
)

__all__ = [
    "bias_at_start",
    "drift",
    "read_altimeter",
    "read_attitude",
    "read_flow",
    "read_imu",
    "read_magnetometer",
    "read_pose",
    "read_position",
    "true_state",
]


@block
def bias_at_start(*, deviation: float, draw: Any) -> Vector:
    """A constant bias (3), drawn where it fires: give it a clock that ticks once."""
    return Vector(vector=deviation * draw.normal("bias", (3,)))


@block
def drift(
    walked: Vector, start: Vector, *, walk: float, dt: float, draw: Any, xp: Any
) -> tuple[Vector, Vector]:
    """A bias (3) that walks from `start`, by walk sqrt(dt) a step; it has not moved where it fires first.

    State: how far it has walked, from 0. Output: `start` and that."""
    step = walk * xp.sqrt(xp.asarray(dt, dtype=walked.vector.dtype)) * draw.normal("walk", (3,))
    new = walked.vector + step
    return Vector(vector=new), Vector(vector=start.vector + new)


@drift.init
def _(start: Any, *, walk: float) -> Vector:
    return Vector(vector=np.zeros(3))


@block
def read_imu(
    motion: BodyMotion, gyro_bias: Vector | None = None, accelerometer_bias: Vector | None = None, *,
    gyro: float, accelerometer: float, gravity: tuple[float, float, float] = GRAVITY, draw: Any, xp: Any,
) -> Imu:  # fmt: skip
    """Rate and specific force R^T (a - gravity), each with its bias, if it has one, and white noise.

    gyro, accelerometer: standard deviations of one reading, rad/s and m/s^2 (a density times the root of the
    rate)."""
    push = motion.acceleration - xp.asarray(gravity, dtype=motion.acceleration.dtype)
    force = rotate(conjugate(motion.attitude, xp=xp), push, xp=xp)
    rate = motion.rate if gyro_bias is None else motion.rate + gyro_bias.vector
    force = force if accelerometer_bias is None else force + accelerometer_bias.vector
    white = draw.normal("white", (6,))
    return Imu(gyro=rate + gyro * white[:3], specific_force=force + accelerometer * white[3:])


@block
def read_pose(
    motion: BodyMotion, *, position_noise: float, attitude_noise: float, draw: Any, xp: Any
) -> Pose:
    """Position (m) and attitude q * Exp(error), error in rad, as motion capture gives them."""
    turn = from_rotation_vector(attitude_noise * draw.normal("attitude", (3,)), xp=xp)
    return Pose(
        position=motion.position + position_noise * draw.normal("position", (3,)),
        attitude=multiply(motion.attitude, turn, xp=xp),
    )


@block
def read_position(
    motion: BodyMotion,
    *,
    noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    draw: Any,
    xp: Any,
) -> Position:
    """Where a point of the body is, p + R lever + error, m: of a prism or an antenna."""
    arm = rotate(motion.attitude, xp.asarray(lever, dtype=motion.position.dtype), xp=xp)
    return Position(position=motion.position + arm + noise * draw.normal("noise", (3,)))


@block
def read_attitude(motion: BodyMotion, *, noise: float, draw: Any, xp: Any) -> Attitude:
    """The attitude q * Exp(error), error in rad, body."""
    turn = from_rotation_vector(noise * draw.normal("noise", (3,)), xp=xp)
    return Attitude(attitude=multiply(motion.attitude, turn, xp=xp))


@block
def read_altimeter(
    motion: BodyMotion, *, noise: float, most_tilt: float = math.radians(75.0), draw: Any, xp: Any
) -> Range | None:
    """The distance (m) to flat ground along body z, p_z / R_33 + error; nothing beyond `most_tilt` (rad)."""
    q = motion.attitude
    upright = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    here = upright >= math.cos(min(most_tilt, math.radians(89.9)))
    distance = motion.position[2] / xp.where(here, upright, 1.0) + noise * draw.normal("noise", ())
    return when(here, Range(distance=distance))  # type: ignore[return-value]


@block
def read_magnetometer(
    motion: BodyMotion,
    *,
    field: tuple[float, float, float],
    hard_iron: tuple[float, float, float] = (0.0, 0.0, 0.0),
    noise: float,
    draw: Any,
    xp: Any,
) -> MagneticField:
    """The field R^T m + hard iron + error (3), T, in the body; `field` is m in the world (`earth_field`)."""
    there = rotate(conjugate(motion.attitude, xp=xp), xp.asarray(field, dtype=motion.attitude.dtype), xp=xp)
    body = xp.asarray(hard_iron, dtype=there.dtype)
    return MagneticField(field=there + body + noise * draw.normal("noise", (3,)))


@block
def read_flow(
    before: Pose, motion: BodyMotion, *, noise: float, turn_noise: float, dt: float, draw: Any, xp: Any
) -> tuple[Pose, OpticalFlow | None]:
    """How the body moved and turned since this fired last, R(q0)^T (p1 - p0) + error and q0^-1 q1 Exp(error).

    noise, turn_noise: standard deviations, m and rad. Nothing comes of the first picture.

    State: the pose at the picture before."""
    back = conjugate(before.attitude, xp=xp)
    moved = rotate(back, motion.position - before.position, xp=xp) + noise * draw.normal("place", (3,))
    error = from_rotation_vector(turn_noise * draw.normal("turn", (3,)), xp=xp)
    turn = multiply(multiply(back, motion.attitude, xp=xp), error, xp=xp)
    seconds = xp.asarray(dt, dtype=moved.dtype)
    flow = OpticalFlow(displacement=moved, turn=turn, interval=seconds)
    return Pose(position=motion.position, attitude=motion.attitude), when(seconds > 0.0, flow)  # type: ignore[return-value]


@read_flow.init
def _(motion: Any, *, noise: float, turn_noise: float) -> Pose:
    return Pose(position=np.zeros(3), attitude=np.array([1.0, 0.0, 0.0, 0.0]))


@block
def true_state(
    motion: BodyMotion, gyro_bias: Vector | None = None, accelerometer_bias: Vector | None = None, *, xp: Any
) -> NavigationState:
    """What a full truth holds; a bias that is not there is 0."""
    none = xp.zeros_like(motion.rate)
    return NavigationState(
        position=motion.position,
        velocity=motion.velocity,
        attitude=motion.attitude,
        gyro_bias=none if gyro_bias is None else gyro_bias.vector,
        accelerometer_bias=none if accelerometer_bias is None else accelerometer_bias.vector,
    )
