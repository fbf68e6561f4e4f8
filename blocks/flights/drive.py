"""A drive over hills and around corners, `sim:drive`: a car with an inertial unit of a stated grade and
satellites.

The road is a smooth curve through random places; the car goes along it, stops, and goes on. Readings of the
unit
are means over the time since the one before, made of the exact motion: what turned the body, and what
changed its velocity but for gravity and the turning Earth. So the error of a filter is that of the unit, of
its stated figures, and of the aids, and of nothing else.

Source of the figures of the grades: P. Groves, "Principles of GNSS, inertial, and multisensor integrated
navigation systems", 2nd ed., 2013, tables 4.1-4.3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph import Flight, Series
from flowgraph.blocks.geometry.geodetic import from_enu
from flowgraph.blocks.geometry.rotations import conjugate, multiply, rotate, to_matrix, to_rotation_vector
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.inertial.navigation import earth_at, gravity_at
from flowgraph.blocks.signals import (
    GnssFix,
    GnssHeading,
    GnssVelocity,
    Height,
    Imu,
    MagneticField,
    NavigationState,
    WheelSpeed,
)
from flowgraph.blocks.world import generator
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "GRADES", "SENSORS", "Grade", "load_drive"]


class Grade(NamedTuple):
    """Densities of a unit, and the deviations of its constant biases (rad/s, m/s^2)."""

    noise: ImuNoise
    gyro_bias: float
    accelerometer_bias: float


GRADES: Mapping[str, Grade] = {
    "consumer": Grade(ImuNoise(1.7e-4, 2e-3, 1e-5, 1e-4), 3e-3, 0.1),
    "tactical": Grade(ImuNoise(2.9e-5, 5e-4, 1e-7, 1e-5), 4.8e-5, 1e-2),
    "navigation": Grade(ImuNoise(5.8e-7, 1e-4, 1e-10, 1e-7), 4.8e-8, 2.5e-4),
}
"""Angle random walk 0.6, 0.1 and 0.002 degrees/sqrt(h), biases of 600, 10 and 0.01 degrees/h."""

SENSORS = ("gps", "gps_velocity", "heading", "magnetometer", "barometer", "wheels")

DEFAULTS: Mapping[str, float] = {
    "duration": 120.0,
    "imu.rate": 100.0,
    "gps.rate": 1.0,
    "gps.noise": 1.5,
    "gps_velocity.noise": 0.05,
    "heading.noise": 0.01,
    "magnetometer.rate": 10.0,
    "magnetometer.noise": 5e-7,
    "barometer.rate": 10.0,
    "barometer.noise": 0.3,
    "wheels.rate": 10.0,
    "wheels.noise": 0.05,
}
"""s, Hz, and standard deviations: m an axis, m/s, rad, T, m, m/s. Positions, velocities and headings by
satellites come together."""

ORIGIN = (math.radians(47.4), math.radians(8.55), 430.0)
_FIELD = (0.0, 2.15e-5, -4.3e-5)  # T, east, north, up
_LEVEL = 12.0  # m, of the barometer
_REST = 3.0  # s, at the start


def load_drive(*, seed: int = 0, settings: Mapping[str, Any] | None = None) -> Flight:
    """Make a drive.

    Args:
        seed: of the road and of all noise.
        settings: any of `DEFAULTS`; `road`, its number, that of the seed if left out;
            `unit`, of `GRADES`, consumer if left out; `sensors`, of `SENSORS`,
            comma-separated,
            gps and gps_velocity if left out.

    Returns:
        A `Flight` with `imu` and the sensors; truth: `NavigationState`, east, north, up about
        `info["origin"]`. info: `imu_noise`, `noise`, `magnetic_field`, `gps_lever`, `still` (s).

    Raises:
        UnknownNameError: for a setting, a unit or a sensor that is not there; DeclarationError: for one out
            of range.
    """
    values, grade, sensors = _settings(dict(settings or {}))
    period = round(1e9 / values["imu.rate"])
    time = np.arange(0, round(values["duration"] * 1e9) + 1, period, dtype=np.int64)
    draw = lambda name, *shape: generator(seed, f"drive.{name}").standard_normal(shape)
    road = _Road(seed if values["road"] < 0.0 else round(values["road"]), values["duration"])
    p, v, q = road.at(time * 1e-9)
    dt = period * 1e-9
    n = len(time)
    biases = {}
    for sensor, start, walk in (
        ("gyro", grade.gyro_bias, grade.noise.gyro_bias),
        ("accelerometer", grade.accelerometer_bias, grade.noise.accelerometer_bias),
    ):
        steps = np.concatenate([np.zeros((1, 3)), draw(f"{sensor}.walk", n - 1, 3) * walk * math.sqrt(dt)])
        biases[sensor] = draw(f"{sensor}.bias", 3) * start + np.cumsum(steps, axis=0)
    rate, force = _read(p, v, q, dt)
    imu = Imu(
        gyro=rate + biases["gyro"] + draw("gyro.noise", n, 3) * grade.noise.gyro / math.sqrt(dt),
        specific_force=force
        + biases["accelerometer"]
        + draw("accelerometer.noise", n, 3) * grade.noise.accelerometer / math.sqrt(dt),
    )
    streams = {"imu": Series(time, imu, name="imu")}
    for name in sensors:
        every = round(1e9 / values.get(f"{name}.rate", values["gps.rate"]) / period)
        rows = np.arange(0, n, max(every, 1))
        streams[name] = Series(time[rows], _sensed(name, p[rows], v[rows], q[rows], values, draw), name=name)
    truth = NavigationState(
        position=p,
        velocity=v,
        attitude=q,
        gyro_bias=biases["gyro"],
        accelerometer_bias=biases["accelerometer"],
    )
    info = {
        "imu_noise": grade.noise,
        "imu_period_ns": period,
        "imu_oversample": 2,
        "origin": ORIGIN,
        "magnetic_field": _FIELD,
        "gps_lever": (0.0, 0.0, 0.0),
        "still": _REST,
        "noise": {"magnetometer": {"noise": values["magnetometer.noise"]}},
        "start_spread": (grade.gyro_bias, grade.accelerometer_bias),
    }
    said = note("info", f"simulated with seed {seed}: a drive with a unit of {values['unit']} grade")
    return Flight(f"drive-{seed}", streams, truth=Series(time, truth, name="truth"), info=info, notes=(said,))


def _settings(given: dict[str, Any]) -> tuple[dict[str, Any], Grade, list[str]]:
    unit = str(given.pop("unit", "consumer"))
    if unit not in GRADES:
        raise UnknownNameError("unit", unit, GRADES, path="sim:drive")
    text = str(given.pop("sensors", "gps,gps_velocity"))
    sensors = [s.strip() for s in text.split(",") if s.strip() not in ("", "imu")]
    for name in sensors:
        if name not in SENSORS:
            raise UnknownNameError("sensor", name, ["imu", *SENSORS], path="sim:drive")
    road = given.pop("road", -1)
    values: dict[str, Any] = {**DEFAULTS, "unit": unit, "road": _number_of(road)}
    for name, value in given.items():
        if name not in DEFAULTS:
            raise UnknownNameError("setting", name, ["unit", "sensors", *DEFAULTS], path="sim:drive")
        try:
            values[name] = float(value)
        except (TypeError, ValueError):
            values[name] = math.nan
        if not 0.0 < values[name] < 1e6:
            raise DeclarationError(
                f"setting {name!r} is not usable",
                path="sim:drive",
                expected="a positive number below 1e6",
                got=repr(value),
                fix=f"for example {name}={DEFAULTS[name]:g}",
            )
    return values, GRADES[unit], sensors


def _number_of(road: Any) -> int:
    """The number of a road; -1 for that of the seed.

    Raises:
        DeclarationError: for what is none.
    """
    if str(road) == "-1" or str(road).isdecimal():
        return int(road)
    raise DeclarationError(
        "setting 'road' is not usable",
        path="sim:drive",
        expected="a whole number, not negative",
        got=repr(road),
        fix="for example road=0",
    )


class _Road:
    """A curve through random places, and how far along it the car is."""

    def __init__(self, seed: int, duration: float) -> None:
        draw = generator(seed, "drive.road")
        count = max(6, int(duration * 15.0 / 80.0) + 6)
        turns = np.cumsum(draw.normal(0.0, 0.7, count))
        steps = 80.0 * np.stack([np.cos(turns), np.sin(turns), draw.normal(0.0, 0.03, count)], axis=-1)
        places = np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
        self.curve = scipy.interpolate.make_interp_spline(np.arange(len(places)), places, k=5)
        self.tangent = self.curve.derivative()
        # how fast: at rest, away, around, and one stop on the way
        knots = np.linspace(0.0, max(duration, 1.0), max(int(duration / 6.0), 2) + 1)
        pace = np.clip(draw.normal(0.12, 0.04, len(knots)), 0.05, 0.2)
        if len(pace) > 8:
            pace[len(pace) // 2] = 0.0
        self.knots, self.pace = knots, pace

    def along(self, t: np.ndarray) -> np.ndarray:
        """The parameter of the curve at times: the integral of a pace that begins smoothly after the rest."""
        fine = np.linspace(0.0, max(float(t[-1]), 1e-3), max(int(t[-1] * 200), 2) + 1)
        begun = np.clip((fine - _REST) / 4.0, 0.0, 1.0)
        begun = begun**3 * (10.0 - 15.0 * begun + 6.0 * begun**2)
        spline = scipy.interpolate.make_interp_spline(self.knots, self.pace, k=min(3, len(self.knots) - 1))
        pace = begun * np.clip(spline(fine), 0.0, None)
        whole = scipy.interpolate.make_interp_spline(fine, pace, k=3).antiderivative()
        return np.asarray(whole(t) - whole(0.0))

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, velocities and attitudes; the body's x axis along the road, no roll."""
        s = self.along(t)
        p = np.asarray(self.curve(s))
        step = 1e-4
        v = np.asarray(self.tangent(s)) * ((self.along(t + step) - s) / step)[:, None]
        way = np.asarray(self.tangent(s))
        yaw = np.arctan2(way[:, 1], way[:, 0])
        pitch = np.arctan2(way[:, 2], np.hypot(way[:, 0], way[:, 1]))
        zero = np.zeros_like(yaw)
        about_z = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=-1)
        about_y = np.stack([np.cos(pitch / 2), zero, -np.sin(pitch / 2), zero], axis=-1)
        return p, v, np.asarray(multiply(about_z, about_y, xp=np))


def _read(p: np.ndarray, v: np.ndarray, q: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
    """What an ideal unit reads over each step: rate (n, 3) and force (n, 3); the first stands for a step at
    rest."""
    earth, gravity = earth_at(ORIGIN[0]), np.asarray(gravity_at(ORIGIN[0], ORIGIN[2]))
    turn = np.asarray(earth.turn)
    R = to_matrix(q, xp=np)
    body_turn = to_rotation_vector(multiply(conjugate(q[:-1], xp=np), q[1:], xp=np), xp=np) / dt
    rate = body_turn + (R[:-1].transpose(0, 2, 1) @ turn[:, None])[..., 0]
    half = np.asarray(multiply(q[:-1], _half(body_turn * dt), xp=np))
    strength = np.linalg.norm(gravity) / earth.radius
    pull = gravity + p[:-1] * (-strength, -strength, 2.0 * strength) - 2.0 * np.cross(turn, v[:-1])
    force = rotate(conjugate(half, xp=np), np.diff(v, axis=0) / dt - pull, xp=np)
    first_rate = R[:1].transpose(0, 2, 1) @ turn[:, None]
    first_force = rotate(conjugate(q[:1], xp=np), -gravity[None], xp=np)
    return np.concatenate([first_rate[..., 0], rate]), np.concatenate([first_force, force])


def _half(turns: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(turns, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 4), turns * 0.25 * np.sinc(angle / 4 / np.pi)], axis=-1)


def _sensed(
    name: str, p: np.ndarray, v: np.ndarray, q: np.ndarray, values: Mapping[str, Any], draw: Any
) -> Any:
    """What a sensor reads at some times."""
    n = len(p)
    noise = values.get(f"{name}.noise", 0.0)
    if name == "gps":
        spread = noise * np.array([1.0, 1.0, 2.0])
        latitude, longitude, height = from_enu(p + draw("gps", n, 3) * spread, ORIGIN).T
        covariance = np.tile(np.diag(spread**2), (n, 1, 1))
        return GnssFix(latitude=latitude, longitude=longitude, height=height, covariance=covariance)
    if name == "gps_velocity":
        seen = v + draw(name, n, 3) * noise
        return GnssVelocity(velocity=seen, covariance=np.tile(np.eye(3) * noise**2, (n, 1, 1)))
    x = rotate(q, np.tile([1.0, 0.0, 0.0], (n, 1)), xp=np)
    if name == "heading":
        angle = np.arctan2(x[:, 1], x[:, 0]) + draw(name, n) * noise
        return GnssHeading(angle=angle, deviation=np.full(n, noise))
    if name == "magnetometer":
        field = rotate(conjugate(q, xp=np), np.tile(_FIELD, (n, 1)), xp=np)
        return MagneticField(field=field + draw(name, n, 3) * noise)
    if name == "barometer":
        return Height(height=p[:, 2] + _LEVEL + draw(name, n) * noise)
    return WheelSpeed(speed=(v * x).sum(axis=-1) + draw(name, n) * noise)
