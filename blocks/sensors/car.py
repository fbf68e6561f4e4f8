"""Sensors of a car as blocks: an inertial unit on the turning Earth, satellites, a barometer and wheels."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.geometry.geodetic import from_enu
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    rotate,
    to_rotation_vector,
)
from flowgraph.blocks.inertial.navigation import Earth
from flowgraph.blocks.signals import (
    BodyMotion,
    GnssFix,
    GnssHeading,
    GnssVelocity,
    Height,
    Imu,
    Vector,
    WheelSpeed,
)

__all__ = ["read_fix", "read_heading", "read_height", "read_over_earth", "read_velocity", "read_wheels"]


@block
def read_over_earth(
    before: BodyMotion, motion: BodyMotion, gyro_bias: Vector, accelerometer_bias: Vector, *, gyro: float,
    accelerometer: float, gravity: tuple[float, float, float], earth: Earth, dt: float, draw: Any, xp: Any,
) -> tuple[BodyMotion, Imu]:  # fmt: skip
    """What an inertial unit reads over the time since it was read last, as means: what turned the body, and
    what changed its velocity but for gravity and the turning Earth. The first reading is that of a body at
    rest.

    gyro, accelerometer: standard deviations of a sample, rad/s and m/s^2. gravity: (3,) m/s^2 at the origin;
    it changes with the place by its gradient.

    State: the motion at the reading before."""
    fresh = xp.asarray(dt, dtype=motion.position.dtype) > 0.0
    seconds = xp.where(fresh, xp.asarray(dt, dtype=motion.position.dtype), 1.0)
    p, v, q = (
        xp.where(fresh, old, new)
        for old, new in (
            (before.position, motion.position),
            (before.velocity, motion.velocity),
            (before.attitude, motion.attitude),
        )
    )
    turned = to_rotation_vector(multiply(conjugate(q, xp=xp), motion.attitude, xp=xp), xp=xp)
    turn = xp.asarray(earth.turn, dtype=p.dtype)
    rate = turned / seconds + rotate(conjugate(q, xp=xp), turn, xp=xp)
    half = multiply(q, from_rotation_vector(0.5 * turned, xp=xp), xp=xp)
    strength = float(np.linalg.norm(gravity)) / earth.radius
    gradient = xp.asarray([-strength, -strength, 2.0 * strength], dtype=p.dtype)
    pull = xp.asarray(gravity, dtype=p.dtype) + p * gradient - 2.0 * xp.linalg.cross(turn, v)
    force = rotate(conjugate(half, xp=xp), (motion.velocity - v) / seconds - pull, xp=xp)
    return motion, Imu(
        gyro=rate + gyro_bias.vector + gyro * draw.normal("gyro", (3,)),
        specific_force=force + accelerometer_bias.vector + accelerometer * draw.normal("accelerometer", (3,)),
    )


@read_over_earth.init
def _(motion: Any, gyro_bias: Any, accelerometer_bias: Any, **settings: Any) -> BodyMotion:
    names = ("position", "velocity", "acceleration", "rate")
    return BodyMotion(**{n: np.zeros(3) for n in names}, attitude=np.array([1.0, 0.0, 0.0, 0.0]))


@block
def read_fix(
    motion: BodyMotion, *, noise: float, origin: tuple[float, float, float], draw: Any, xp: Any
) -> GnssFix:
    """A position by satellites, with its covariance: `noise` m east and north, twice that in height."""
    spread = noise * np.array([1.0, 1.0, 2.0])
    found = from_enu(motion.position + spread * draw.normal("noise", (3,)), origin, xp=xp)
    covariance = xp.asarray(np.diag(spread**2), dtype=motion.position.dtype)
    return GnssFix(latitude=found[0], longitude=found[1], height=found[2], covariance=covariance)


@block
def read_velocity(motion: BodyMotion, *, noise: float, draw: Any, xp: Any) -> GnssVelocity:
    """A velocity by satellites, with its covariance; noise in m/s an axis."""
    covariance = xp.asarray(np.eye(3) * noise**2, dtype=motion.position.dtype)
    return GnssVelocity(velocity=motion.velocity + noise * draw.normal("noise", (3,)), covariance=covariance)


@block
def read_heading(motion: BodyMotion, *, noise: float, draw: Any, xp: Any) -> GnssHeading:
    """Where the body's x axis points over the ground, by two antennas; noise in rad."""
    x = _ahead(motion, xp)
    angle = xp.atan2(x[1], x[0]) + noise * draw.normal("noise", ())
    return GnssHeading(angle=angle, deviation=xp.asarray(noise, dtype=x.dtype))


@block
def read_height(motion: BodyMotion, *, noise: float, level: float, draw: Any) -> Height:
    """The height above a level that is `level` m below the origin; noise in m."""
    return Height(height=motion.position[2] + level + noise * draw.normal("noise", ()))


@block
def read_wheels(motion: BodyMotion, *, noise: float, draw: Any, xp: Any) -> WheelSpeed:
    """The speed along the body's x axis; noise in m/s."""
    speed = xp.sum(motion.velocity * _ahead(motion, xp))
    return WheelSpeed(speed=speed + noise * draw.normal("noise", ()))


def _ahead(motion: BodyMotion, xp: Any) -> Any:
    return rotate(motion.attitude, xp.asarray([1.0, 0.0, 0.0], dtype=motion.attitude.dtype), xp=xp)
