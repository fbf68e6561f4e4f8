"""What each sensor of `gnss_ins` sees of its state, as a batch estimate takes it.

The filter's own corrections stand in `inertial.outdoors`; these are the same equations as functions of the
state, whose derivatives are taken of themselves. Where a velocity depends on how fast the body turns, what
the gyroscope read then is in the message.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.geometry.rotations import conjugate, rotate, skew
from flowgraph.blocks.inertial.navigation import places
from flowgraph.blocks.inertial.outdoors import Antenna
from flowgraph.blocks.signals import TurningSpeed, TurningVelocity
from flowgraph.blocks.statespace import MeasurementModel

__all__ = [
    "antenna_seen",
    "antennas_seen",
    "compass_seen",
    "height_seen",
    "turning",
    "velocity_seen",
    "wheels_seen",
]

Space = Any


def turning(series: Series, imu: Series) -> Series:
    """Velocities or speeds of wheels, each with the gyroscope's rate, on the line between its readings."""
    good = np.isfinite(imu["gyro"]).all(axis=-1)
    since = lambda time: (time - imu.time[0]).astype(float)
    columns = imu["gyro"][good].T
    gyro = np.stack([np.interp(since(series.time), since(imu.time[good]), c) for c in columns], axis=-1)
    leaves = series.leaves
    return series.holding((TurningVelocity if "velocity" in leaves else TurningSpeed)(**leaves, gyro=gyro))


def _lever(x: Any, antenna: Antenna, estimated: tuple[str, ...], xp: Any) -> Array:
    where = places(estimated)
    return x.parameters[..., where["lever"]] if "lever" in where else _fixed(antenna.lever, x, xp)


def _fixed(vector: Any, x: Any, xp: Any) -> Array:
    return xp.asarray(vector, dtype=x.position.dtype)


def _cross(a: Array, b: Array, xp: Any) -> Array:
    return (skew(a, xp=xp) @ b[..., None])[..., 0]


def antenna_seen(space: Space, antenna: Antenna, estimated: tuple[str, ...]) -> MeasurementModel:
    """The position of an antenna, as `aid_gnss_position` sees it, with the covariance of the message."""
    where = places(estimated)

    def observe(x: Any, xp: Any) -> Array:
        late = x.parameters[..., where["time_offset"]] if "time_offset" in where else antenna.late
        return x.position + rotate(x.attitude, _lever(x, antenna, estimated, xp), xp=xp) - x.velocity * late

    return MeasurementModel(space, observe, noise=lambda fix: fix.covariance, read=lambda fix: fix.position)


def velocity_seen(space: Space, antenna: Antenna, estimated: tuple[str, ...]) -> MeasurementModel:
    """The velocity of an antenna, as `aid_gnss_velocity` sees it: `TurningVelocity`."""

    def observe(x: Any, fix: TurningVelocity, xp: Any) -> Array:
        swing = _cross(fix.gyro - x.gyro_bias, _lever(x, antenna, estimated, xp), xp)
        return x.velocity + rotate(x.attitude, swing, xp=xp)

    return MeasurementModel(space, observe, noise=lambda fix: fix.covariance, read=lambda fix: fix.velocity)


def height_seen(space: Space, noise: float, estimated: tuple[str, ...]) -> MeasurementModel:
    """A height by the pressure of the air, as `aid_height` sees it (m)."""
    where = places(estimated)

    def observe(x: Any, xp: Any) -> Array:
        up = x.position[..., 2:3]
        return up + x.parameters[..., where["height_offset"]] if "height_offset" in where else up

    return MeasurementModel(space, observe, noise=np.array([noise**2]))


def _directed(
    space: Space, vector: Callable[[Any, Any, Any], Array], angle: Callable[[Any], Any], variance: Any
) -> MeasurementModel:
    """That a vector of the body points along an angle over the ground: 0 is how far it is off."""

    def observe(x: Any, message: Any, xp: Any) -> Array:
        m = rotate(x.attitude, vector(x, message, xp), xp=xp)
        s, c = xp.sin(xp.asarray(angle(message))), xp.cos(xp.asarray(angle(message)))
        across, along = c * m[..., 1:2] - s * m[..., 0:1], c * m[..., 0:1] + s * m[..., 1:2]
        return xp.atan2(across, along)

    read = lambda message: 0.0 * _first(message)
    return MeasurementModel(space, observe, noise=variance, read=read)


def _first(message: Any) -> Array:
    """One number of a message (1)."""
    return message.field[..., :1] if hasattr(message, "field") else message.angle[..., None]


def compass_seen(space: Space, north: float, noise: float) -> MeasurementModel:
    """The direction of the magnetic field, as `aid_compass` sees it."""
    return _directed(space, lambda x, z, xp: z.field, lambda z: north, np.array([noise**2]))


def antennas_seen(space: Space, baseline: tuple[float, float, float]) -> MeasurementModel:
    """The direction from one antenna to another, as `aid_antennas` sees it."""
    variance = lambda z: (z.deviation**2)[..., None, None]
    return _directed(space, lambda x, z, xp: _fixed(baseline, x, xp), lambda z: z.angle, variance)


def wheels_seen(
    space: Space, noise: float, slip: float, axle: tuple[float, float, float]
) -> MeasurementModel:
    """How a vehicle rolls, as `aid_wheels` sees it: `TurningSpeed`."""

    def observe(x: Any, message: TurningSpeed, xp: Any) -> Array:
        speed = rotate(conjugate(x.attitude, xp=xp), x.velocity, xp=xp)
        return speed + _cross(message.gyro - x.gyro_bias, _fixed(axle, x, xp), xp)

    def read(message: TurningSpeed) -> tuple[Array, Array]:
        still = 0.0 * message.gyro[..., :2]
        return message.speed[..., None], still

    return MeasurementModel(space, observe, noise=np.square([noise, slip, slip]), read=read)
