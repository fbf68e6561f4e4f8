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
motion of then (`late` of `world_motion`), or a `delay` of it.

Two things are called acceleration. A real accelerometer reads the *specific force* R^T (a - gravity), 9.81
m/s^2 upwards at rest. The thesis's reads the *coordinate acceleration* R^T a, zero at rest (gravity taken off
by an attitude that nobody has). They are two sensors with two signal types. What an inertial sensor takes
over a time, and not of an instant, is a motion of its own: `motion_over`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import block, when
from flowgraph.blocks.geometry.geodetic import from_enu
from flowgraph.blocks.geometry.rotations import conjugate, from_rotation_vector, multiply, rotate
from flowgraph.blocks.signals import (
    GRAVITY,
    Attitude,
    BodyMotion,
    BodyRate,
    CoordinateAcceleration,
    GeodeticPosition,
    Gyro,
    Imu,
    MagneticField,
    NavigationState,
    OpticalFlow,
    Pose,
    Position,
    Range,
    SpecificForce,
    Thrust,
    Vector,
)

__all__ = [
    "bias_at_start",
    "drift",
    "to_geodetic",
    "read_acceleration",
    "read_accelerometer",
    "read_altimeter",
    "read_attitude",
    "read_body_rate",
    "read_flow",
    "read_gyro",
    "read_imu",
    "read_magnetometer",
    "read_pose",
    "read_position",
    "read_thrust",
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


def _biased(value: Any, bias: Vector | None) -> Any:
    return value if bias is None else value + bias.vector


def _body_force(motion: BodyMotion, gravity: tuple[float, float, float], xp: Any) -> Any:
    push = motion.acceleration - xp.asarray(gravity, dtype=motion.acceleration.dtype)
    return rotate(conjugate(motion.attitude, xp=xp), push, xp=xp)


@block
def read_imu(
    motion: BodyMotion, gyro_bias: Vector | None = None, accelerometer_bias: Vector | None = None, *,
    gyro: float, accelerometer: float, gravity: tuple[float, float, float] = GRAVITY, draw: Any, xp: Any,
) -> Imu:  # fmt: skip
    """Rate and specific force R^T (a - gravity), each with its bias, if it has one, and white noise.

    gyro, accelerometer: standard deviations of one reading, rad/s and m/s^2 (a density times the root of the
    rate)."""
    force = _biased(_body_force(motion, gravity, xp), accelerometer_bias)
    white = draw.normal("white", (6,))
    rate = _biased(motion.rate, gyro_bias) + gyro * white[:3]
    return Imu(gyro=rate, specific_force=force + accelerometer * white[3:])


@block
def read_gyro(motion: BodyMotion, bias: Vector | None = None, *, noise: float, draw: Any) -> Gyro:
    """The rate of the body, with bias and white noise, rad/s."""
    return Gyro(rate=_biased(motion.rate, bias) + noise * draw.normal("noise", (3,)))


@block
def read_body_rate(motion: BodyMotion, bias: Vector | None = None, *, noise: float, draw: Any) -> BodyRate:
    """The rate that the flight controller commands, rad/s. The vehicle follows it; what differs stands for
    rotors and wind."""
    return BodyRate(rate=_biased(motion.rate, bias) + noise * draw.normal("noise", (3,)))


@block
def read_accelerometer(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float,
    gravity: tuple[float, float, float] = GRAVITY, draw: Any, xp: Any,
) -> SpecificForce:  # fmt: skip
    """The specific force R^T (a - gravity), with bias and white noise, m/s^2."""
    force = _biased(_body_force(motion, gravity, xp), bias)
    return SpecificForce(force=force + noise * draw.normal("noise", (3,)))


@block
def read_acceleration(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float, draw: Any, xp: Any
) -> CoordinateAcceleration:
    """The coordinate acceleration R^T a, with bias and white noise, m/s^2: the thesis's accelerometer."""
    seen = _biased(_body_force(motion, (0.0, 0.0, 0.0), xp), bias)
    return CoordinateAcceleration(acceleration=seen + noise * draw.normal("noise", (3,)))


@block
def read_thrust(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float,
    gravity: tuple[float, float, float] = GRAVITY, draw: Any, xp: Any,
) -> Thrust:  # fmt: skip
    """The thrust per mass that is commanded: the specific force along body z, with bias and noise, m/s^2."""
    force = _biased(_body_force(motion, gravity, xp), bias)
    return Thrust(thrust=force[2] + noise * draw.normal("noise", ()))


@block
def read_pose(
    motion: BodyMotion, position_bias: Vector | None = None, attitude_bias: Vector | None = None, *,
    position_noise: float, attitude_noise: float, draw: Any, xp: Any,
) -> Pose:  # fmt: skip
    """Position (m) and attitude q * Exp(error), error in rad, as motion capture gives them."""
    error = _biased(attitude_noise * draw.normal("attitude", (3,)), attitude_bias)
    place = _biased(motion.position, position_bias) + position_noise * draw.normal("position", (3,))
    turned = multiply(motion.attitude, from_rotation_vector(error, xp=xp), xp=xp)
    return Pose(position=place, attitude=turned)


@block
def read_position(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float,
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0), draw: Any, xp: Any,
) -> Position:  # fmt: skip
    """Where a point of the body is, p + R lever + error, m: of a prism or an antenna."""
    arm = rotate(motion.attitude, xp.asarray(lever, dtype=motion.position.dtype), xp=xp)
    return Position(position=_biased(motion.position + arm, bias) + noise * draw.normal("noise", (3,)))


@block
def to_geodetic(position: Position, *, origin: tuple[float, float, float], xp: Any) -> GeodeticPosition:
    """A position (east, north, up) as latitude, longitude (rad) and height (m), about an origin of these."""
    found = from_enu(position.position, origin, xp=xp)
    return GeodeticPosition(latitude=found[0], longitude=found[1], height=found[2])


@block
def read_attitude(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float, draw: Any, xp: Any
) -> Attitude:
    """The attitude q * Exp(error), error in rad, body."""
    error = _biased(noise * draw.normal("noise", (3,)), bias)
    return Attitude(attitude=multiply(motion.attitude, from_rotation_vector(error, xp=xp), xp=xp))


@block
def read_altimeter(
    motion: BodyMotion, bias: Vector | None = None, *, noise: float,
    most_tilt: float = math.radians(75.0), draw: Any, xp: Any,
) -> Range | None:  # fmt: skip
    """The distance (m) to flat ground along body z, p_z / R_33 + error; nothing beyond `most_tilt` (rad).

    Tilted, it sees farther than the height; below the ground, where simulated flights may come, it reads a
    negative distance. Its bias is the one along z. (The thesis prints sin(pitch) times the height: that is
    neither the cosine nor the quotient.)"""
    q = motion.attitude
    upright = 1.0 - 2.0 * (q[1] * q[1] + q[2] * q[2])
    here = upright >= math.cos(min(most_tilt, math.radians(89.9)))
    error = noise * draw.normal("noise", ()) + (0.0 if bias is None else bias.vector[2])
    return when(here, Range(distance=motion.position[2] / xp.where(here, upright, 1.0) + error))  # type: ignore[return-value]


@block
def read_magnetometer(
    motion: BodyMotion, hard_iron: Vector | None = None, *, field: tuple[float, float, float], noise: float,
    draw: Any, xp: Any,
) -> MagneticField:  # fmt: skip
    """The field R^T m + hard iron + error (3), T, in the body; `field` is m in the world (`earth_field`)."""
    there = rotate(conjugate(motion.attitude, xp=xp), xp.asarray(field, dtype=motion.attitude.dtype), xp=xp)
    return MagneticField(field=_biased(there, hard_iron) + noise * draw.normal("noise", (3,)))


@block
def read_flow(
    before: Pose, motion: BodyMotion, bias: Vector | None = None, turn_bias: Vector | None = None, *,
    noise: float, turn_noise: float, dt: float, draw: Any, xp: Any,
) -> tuple[Pose, OpticalFlow | None]:  # fmt: skip
    """How the body moved and turned since this fired last, R(q0)^T (p1 - p0) + error and q0^-1 q1 Exp(error).

    A camera knows no world, so the displacement is in body coordinates of the picture before, and its
    companion distance sensor makes it metres; displacements and turns compose. (The thesis prints q0 q1,
    without the inverse, and a difference in the world.)

    noise, turn_noise: standard deviations, m and rad. Nothing comes of the first picture.

    State: the pose at the picture before."""
    back = conjugate(before.attitude, xp=xp)
    moved = rotate(back, motion.position - before.position, xp=xp)
    moved = _biased(moved, bias) + noise * draw.normal("place", (3,))
    error = _biased(turn_noise * draw.normal("turn", (3,)), turn_bias)
    turn = multiply(multiply(back, motion.attitude, xp=xp), from_rotation_vector(error, xp=xp), xp=xp)
    seconds = xp.asarray(dt, dtype=moved.dtype)
    flow = OpticalFlow(displacement=moved, turn=turn, interval=seconds)
    return Pose(position=motion.position, attitude=motion.attitude), when(seconds > 0.0, flow)  # type: ignore[return-value]


@read_flow.init
def _(motion: Any, bias: Any = None, turn_bias: Any = None, *, noise: float, turn_noise: float) -> Pose:
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
