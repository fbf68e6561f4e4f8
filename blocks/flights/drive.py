"""A drive over hills and around corners, `sim:drive`: a car with an inertial unit of a stated grade and
satellites.

A flight is a run of the graph `drive`; its road is drawn on the host (`road_of`) and handed to it. Readings
of the unit are means over the time since the one before, made of the exact motion: what turned the body, and
what changed its velocity but for gravity and the turning Earth. So the error of a filter is that of the unit,
of its stated figures, and of the aids, and of nothing else.

Source of the figures of the grades: P. Groves, "Principles of GNSS, inertial, and multisensor integrated
navigation systems", 2nd ed., 2013, tables 4.1-4.3.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache, partial
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Flight, Graph, Series, Stream, Tick, aperiodic, graph, latest, simulate, ticks
from flowgraph.blocks import sensors as s
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.inertial.navigation import earth_at, gravity_at
from flowgraph.blocks.signals import BodyMotion, RoadPiece, Vector
from flowgraph.blocks.world import NO_ROAD, REST_OF_DRIVE, drive_motion, road_of
from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import clocks_of
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["DEFAULTS", "GRADES", "SENSORS", "Grade", "drive", "load_drive"]


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
    values, sensors = _settings(dict(settings or {}))
    grade = GRADES[values["unit"]]
    told = tuple(values.items()), tuple(sensors)
    made_by = _made_by(*told)
    inputs = {**made_by.ticks, **made_by.given(seed)}
    flown = simulate(_built(*told), inputs, engine="numpy", seed=seed)
    info = {
        "imu_noise": grade.noise,
        "imu_period_ns": _period(values),
        "imu_oversample": 2,
        "origin": ORIGIN,
        "magnetic_field": _FIELD,
        "gps_lever": (0.0, 0.0, 0.0),
        "still": REST_OF_DRIVE,
        "noise": {"magnetometer": {"noise": values["magnetometer.noise"]}},
        "start_spread": (grade.gyro_bias, grade.accelerometer_bias),
    }
    said = note("info", f"simulated with seed {seed}: a drive with a unit of {values['unit']} grade")
    streams = {name: flown[name] for name in ("imu", *sensors)}
    return Flight(f"drive-{seed}", streams, flown["truth"], info, (said,), experiment=made_by)


@graph
def drive(
    start: Stream[Tick],
    road: Stream[RoadPiece],
    imu: Stream[Tick],
    gps: Stream[Tick] | None = None,
    gps_velocity: Stream[Tick] | None = None,
    heading: Stream[Tick] | None = None,
    magnetometer: Stream[Tick] | None = None,
    barometer: Stream[Tick] | None = None,
    wheels: Stream[Tick] | None = None,
    *,
    grade: Grade,
    rate: float,
    noise: Mapping[str, float],
) -> dict[str, Stream[Any]]:
    """A car on a `road` that comes piece by piece, with an inertial unit at `rate` Hz and the sensors that
    have clocks; `noise` has the standard deviation of each.

    `start` ticks once, at 0, where the constant biases are drawn. There is a truth at every reading of the
    unit. All other clocks are multiples of its: between two of its readings the car is where it was.
    """
    motion = drive_motion(latest(road, init=NO_ROAD, name="piece"), at=imu)
    now = {}
    for part, deviation, walk in (
        ("gyro", grade.gyro_bias, grade.noise.gyro_bias),
        ("accelerometer", grade.accelerometer_bias, grade.noise.accelerometer_bias),
    ):
        first = s.bias_at_start(at=start, deviation=deviation, name=f"{part}_start", draws=f"{part}_start")
        held = latest(first, init=Vector(vector=np.zeros(3)), name=f"{part}_bias")
        now[part] = s.drift(held, at=imu, walk=walk, name=f"{part}_drift", draws=f"{part}_drift")
    biases = now["gyro"], now["accelerometer"]
    made: dict[str, Stream[Any]] = {
        "imu": s.read_over_earth(
            motion, *biases, at=imu, gravity=gravity_at(ORIGIN[0], ORIGIN[2]), earth=earth_at(ORIGIN[0]),
            gyro=grade.noise.gyro * math.sqrt(rate), draws="imu", name="imu_reading",
            accelerometer=grade.noise.accelerometer * math.sqrt(rate),
        )
    }  # fmt: skip
    here = latest(motion, init=_NOWHERE, name="here")
    for name, clock, read in (
        ("gps", gps, partial(s.read_fix, origin=ORIGIN)),
        ("gps_velocity", gps_velocity, s.read_velocity),
        ("heading", heading, s.read_heading),
        ("magnetometer", magnetometer, partial(s.read_magnetometer, field=_FIELD)),
        ("barometer", barometer, partial(s.read_height, level=_LEVEL)),
        ("wheels", wheels, s.read_wheels),
    ):
        if clock is not None:
            made[name] = read(here, at=clock, noise=noise[name], name=f"{name}_reading", draws=name)
    made["truth"] = s.true_state(motion, *biases)
    return made


_NOWHERE = BodyMotion(
    **{name: np.zeros(3) for name in ("position", "velocity", "acceleration", "rate")},
    attitude=np.array([1.0, 0.0, 0.0, 0.0]),
)


@lru_cache(maxsize=8)
def _made_by(settings: tuple[tuple[str, Any], ...], sensors: tuple[str, ...]) -> Experiment:
    n = dict(settings)
    end, period = round(n["duration"] * 1e9), _period(n)
    clocks = {"start": end + 1, "imu": period}
    for name in sensors:
        every = round(1e9 / n.get(f"{name}.rate", n["gps.rate"]) / period)
        clocks[name] = max(every, 1) * period
    told = {
        "grade": GRADES[n["unit"]],
        "rate": 1e9 / period,
        "noise": {name: n[f"{name}.noise"] for name in sensors},
    }
    made = {name: ticks(each, until=end + 1, name=name) for name, each in clocks.items()}
    return Experiment(drive, made, told, partial(_handed, duration=n["duration"], road=n["road"]))


@lru_cache(maxsize=8)
def _built(settings: tuple[tuple[str, Any], ...], sensors: tuple[str, ...]) -> Graph:
    made_by = _made_by(settings, sensors)
    return drive.build(**clocks_of(made_by.ticks), road=aperiodic(), **made_by.settings)


def _handed(seed: int, *, duration: float, road: int) -> dict[str, Series]:
    return {"road": road_of(duration, seed if road < 0 else road)}


def _period(n: Mapping[str, Any]) -> int:
    """ns, between the readings of the unit."""
    return round(1e9 / float(n["imu.rate"]))


def _settings(given: dict[str, Any]) -> tuple[dict[str, Any], list[str]]:
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
    return values, list(dict.fromkeys(sensors))


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
