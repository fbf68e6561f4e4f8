"""Flights through the simulated world: `sim:thesis`, `sim:roundtrip` and `sim:hover`, with any of its
sensors.

`sensors` names the streams, comma-separated (or all); each sensor has settings of its own, `NAME.rate` and so
on, that are refused where the flight has no such sensor. Left out, they are those of the thesis: variances
per sample of 0.1 for gyroscope and accelerometer at 200 Hz, as continuous densities here, and of 0.01 for the
motion capture at 4 Hz; no biases, no latency. The inertial unit of `sim:roundtrip` is another: see `TRIP`.
Rates of `sim:thesis` are of the step since the last reading: see `OF_STEPS`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache, partial
from typing import Any

import numpy as np

from flowgraph import Flight, Graph, Series, aperiodic, simulate, ticks
from flowgraph.blocks.flights.sensed import begins, late, period, sensed
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.sensors import earth_field
from flowgraph.blocks.signals import Drawn
from flowgraph.blocks.world import Hover, Limits, RoundTrip, World, figures, thesis, thesis_flight
from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import clocks_of
from flowgraph.data.notes import note
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["MOST_SAMPLES", "OF_STEPS", "SENSORS", "SETTINGS", "TRIP", "WORLDS", "check_samples", "load_world"]

MOST_SAMPLES = 10_000_000
"""The most samples of one simulated sensor: 14 hours at 200 Hz."""

_CLOCK = {"phase": 0.0, "latency": 0.0, "jitter": 0.0}
_DRIFT = {"bias": 0.0, "walk": 0.0}
_TURN_DRIFT = {"attitude_bias": 0.0, "attitude_walk": 0.0}
_LOOKS = {"oversample": 1.0}
_TURN = {"turn": 0.0}
_EARTH = {"geodetic": 0.0, "latitude": 0.0, "longitude": 0.0, "height": 0.0}
_THESIS = math.sqrt(0.1 / 200.0)  # the density of a variance of 0.1 per sample at 200 Hz
_DEVIATION = math.sqrt(0.1)
_LEVER = {"lever_x": 0.0, "lever_y": 0.0, "lever_z": 0.0}

SENSORS: Mapping[str, Mapping[str, float]] = {
    "imu": {"rate": 200.0, **_CLOCK, **_LOOKS},
    "gyro": {"rate": 200.0, **_CLOCK, **_LOOKS, **_TURN, "noise": _THESIS, **_DRIFT, "step": 0.0},
    "accelerometer": {"rate": 200.0, **_CLOCK, **_LOOKS, "noise": _THESIS, **_DRIFT},
    "coordinate_acceleration": {"rate": 200.0, **_CLOCK, **_LOOKS, "noise": _THESIS, **_DRIFT},
    "position": {"rate": 4.0, **_CLOCK, "noise": 0.1, **_DRIFT, **_LEVER},
    "attitude": {"rate": 4.0, **_CLOCK, "noise": 0.1, **_DRIFT},
    "vicon": {"rate": 4.0, **_CLOCK, "noise": 0.1, **_DRIFT, "attitude_noise": 0.1, **_TURN_DRIFT},
    "gps": {"rate": 2.0, **_CLOCK, "noise": _DEVIATION, **_DRIFT, **_LEVER, **_EARTH},
    "gps2": {"rate": 1.25, **_CLOCK, "noise": _DEVIATION, **_DRIFT, **_LEVER, **_EARTH},
    "magnetometer": {
        **{"rate": 50.0, **_CLOCK, "noise": 5e-7, **_DRIFT},
        **{"declination": 0.0, "dip": math.radians(60.0), "strength": 50e-6},
    },
    "magnetic_attitude": {"rate": 50.0, **_CLOCK, "noise": _DEVIATION, **_DRIFT},
    "altimeter": {"rate": 80.0, **_CLOCK, "noise": 0.1, **_DRIFT, "most_tilt": math.radians(75.0)},
    "optical_flow": {
        **{"rate": 20.0, **_CLOCK, "noise": 0.01, **_DRIFT, "attitude_noise": 0.01, **_TURN_DRIFT}
    },
    "thrust": {"rate": 200.0, **_CLOCK, "noise": _DEVIATION, **_DRIFT},
    "body_rate": {"rate": 200.0, **_CLOCK, **_TURN, "noise": _DEVIATION, **_DRIFT},
}
"""What each sensor can be set to, and what it is when left out, in SI units and radians. `noise` is a
continuous density for gyro, accelerometer and coordinate_acceleration (the imu has theirs), and for all
others a standard deviation per sample; `bias` is the standard deviation of a constant, `walk` the density of
its random walk, and `step` the deviation of the walk's steps from reading to reading, which adds to it;
`oversample` is how many looks a reading is the mean of, and with `turn` 1 a rate is that of the turn since
the last reading. A GPS with geodetic=1 gives latitude, longitude and height, of a world whose origin is at
`latitude`, `longitude` (rad) and `height` (m)."""

WORLDS: Mapping[str, Mapping[str, float]] = {
    "thesis": {"duration": 20.0, "least_thrust": 5.0, "most_thrust": 20.0, "most_rate": 20.0},
    "roundtrip": {"duration": 20.0, "angle": 1.0, "trip": 5.0, "rest": 1.0},
    "hover": {"duration": 20.0, "drift": 0.0},
}
"""The settings of each world: s, m/s^2, rad/s, rad, m."""

TRIP: Mapping[str, float] = {"gyro.noise": 3e-4, "gyro.bias": 0.02, "accelerometer.noise": 1e-3}
"""What the inertial unit of `roundtrip` is when left out, where a filter of attitude is judged: a fair unit
whose gyroscope is biased. Its specific force alone shows roll and pitch to 0.002 rad a sample, and its rate,
integrated with the bias, is off by some tenths of a rad within 20 s: the figures with which such data were
first published."""

OF_STEPS: Mapping[str, float] = {"gyro.turn": 1.0, "body_rate.turn": 1.0, "imu.oversample": 10.0}
"""What `thesis` reads when left out: its gyroscope measures the rotation over the last step. The rate jumps
there at each key point, and two readings of an instant do not tell when. Its accelerometers read an instant;
the `imu`, which is not of the thesis, gives the means of both over the step."""

SETTINGS: Mapping[str, str | float] = {
    "sensors": "imu,vicon",
    **{name: value for world in WORLDS.values() for name, value in world.items()},
    **{f"{sensor}.{part}": value for sensor, parts in SENSORS.items() for part, value in parts.items()},
}
"""All settings of `load_world`, and their values when left out."""

_POSITIVE = ("duration", "least_thrust", "most_thrust", "most_rate", "trip", "rate", "strength", "most_tilt")
_SIGNED = ("angle", "declination", "dip", "latitude", "longitude", "height", *_LEVER)
_SWITCHES = ("geodetic", "turn")
_MOST_LOOKS = 1000
"""The most looks that make one reading."""

_PARTS_OF_IMU = ("gyro", "accelerometer")
_OWN = {"roundtrip": TRIP, "thesis": OF_STEPS}

Numbers = Mapping[str, float]


def load_world(kind: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Make a flight through a world.

    Args:
        kind: thesis, roundtrip or hover.
        seed: of the world and of all noise; each noise has a random stream of its own name.
        settings: any of `SETTINGS` that concern this world and its sensors.

    Returns:
        A `Flight`: a stream for each sensor, by time of arrival. truth: `NavigationState` at the times of the
        fastest sensor, with the biases of the gyroscope and accelerometer. info:
        `world` (the `World`); `still` (s at rest at the start); `noise` (the settings of each sensor);
        `NAME_period_ns`; `NAME_oversample` of an inertial sensor; `NAME_turn` of one that reads
        rates; `stamps` (when each reading of a late sensor was true, int64 ns, row by row);
        `imu_noise` (`ImuNoise`), `position_noise` (m), `attitude_noise` (rad), `vicon_lever`, `gps_lever`,
        `gps2_lever`, `position_lever` (m, body), `magnetic_field` (T, world) and, where it is geodetic,
        `gps_origin` and `gps2_origin` (latitude and longitude in rad, height in m) where there are such
        sensors; `across` (m/s^2, the root mean square of the specific force across body z: zero for a
        vehicle carried by its thrust).
        notes: of each late sensor, how late, and how far the body has gone meanwhile.

    Raises:
        UnknownNameError: for a setting, sensor or world that is not there.
        DeclarationError: for a setting out of its range, or of a sensor that the flight does not have.
    """
    if kind not in WORLDS:
        raise UnknownNameError("simulated world", kind, WORLDS, path="sim")
    path = f"sim:{kind}"
    given = dict(settings or {})
    chosen = _chosen(str(given.pop("sensors", SETTINGS["sensors"])), path)
    numbers = _numbers(kind, chosen, given, path)
    steps = numbers["gyro.step"] * math.sqrt(numbers["imu.rate" if "imu" in chosen else "gyro.rate"])
    numbers["gyro.walk"] = math.hypot(numbers["gyro.walk"], steps) if steps else numbers["gyro.walk"]
    check_samples(numbers, [f"{name}.rate" for name in chosen], path)
    made_by = _made_by(kind, tuple(chosen), tuple(numbers.items()))
    inputs, end = {**made_by.ticks, **made_by.given(seed)}, round(numbers["duration"] * 1e9)
    world, sensors = made_by.settings["world"], made_by.settings["sensors"]
    flown = simulate(_built(kind, tuple(chosen), tuple(numbers.items())), inputs, engine="numpy", seed=seed)
    if world.numbers:
        world = world.shaped(flown["shape"]["numbers"][0])

    streams: dict[str, Series] = {}
    stamps: dict[str, np.ndarray] = {}
    still = _still(kind, numbers)
    info: dict[str, Any] = {"world": world, "still": still, "noise": {}, "stamps": stamps}
    for name in chosen:
        n = sensors[name]
        streams[name] = flown[name]
        info["noise"][name] = dict(n)
        info[f"{name}_period_ns"] = period(n)
        if n["jitter"]:
            streams[name], stamps[name] = _delivered(flown[name], flown[f"{name}_lateness"], n, end)
        elif n["latency"]:
            stamps[name] = flown[name].time - round(n["latency"] * 1e9)
        info.update(_calibration(name, sensors))
    for part in _PARTS_OF_IMU if "imu" in chosen else ():
        info["noise"][part] = dict(sensors[part])
    if kind == "roundtrip" and "imu" in chosen and steps:
        info["orientation_noise"] = _orientation_noise(numbers)
    truth = flown["truth"]
    across = world.at(truth.time / 1e9).specific_force[:, :2]
    info["across"] = float(np.sqrt(np.mean(np.square(across).sum(-1))))
    notes = [note("info", f"simulated with seed {seed}: {figures(world)}")]
    notes += [_late(name, streams[name], stamp, world) for name, stamp in stamps.items() if len(stamp)]
    experiment = None if any(sensors[name]["jitter"] for name in chosen) else made_by
    return Flight(f"sim-{kind}-{seed}", streams, truth, info, tuple(notes), experiment=experiment)


@lru_cache(maxsize=8)
def _made_by(kind: str, chosen: tuple[str, ...], numbers: tuple[tuple[str, float], ...]) -> Experiment:
    n = dict(numbers)
    end = round(n["duration"] * 1e9)
    used = (*chosen, *(_PARTS_OF_IMU if "imu" in chosen else ()))
    sensors = {name: _of(name, n) for name in used}
    world = _world(kind, n)
    clocks = {"truth": (0, min(period(sensors[name]) for name in chosen))}
    if begins(world, sensors, planned=kind == "thesis"):
        clocks["start"] = 0, end + 1
    for name in chosen:
        first = round(sensors[name]["phase"] * 1e9) + round(late(sensors[name]) * 1e9)
        clocks[name] = first, period(sensors[name])
    made = {
        name: ticks(step, start=first, until=max(end + 1 - first, 0), name=name)
        for name, (first, step) in clocks.items()
    }
    told = {"world": world, "sensors": sensors}
    if kind == "thesis":
        return Experiment(sensed, made, told, partial(_planned, numbers=n))
    return Experiment(sensed, made, told)


@lru_cache(maxsize=8)
def _built(kind: str, chosen: tuple[str, ...], numbers: tuple[tuple[str, float], ...]) -> Graph:
    made_by = _made_by(kind, chosen, numbers)
    world, clocks = made_by.settings["world"], clocks_of(made_by.ticks)
    planned: dict[str, Any] = {"plan": aperiodic()} if kind == "thesis" else {}
    return sensed.build(**clocks, **planned, **made_by.settings, sizes={"n": world.numbers})


def _delivered(series: Series, lateness: Series, n: Numbers, end: int) -> tuple[Series, np.ndarray]:
    """Readings by time of arrival, and when each was true: one may overtake another, and two that would
    arrive at one nanosecond are set one apart. What arrives after the end is not in the recording."""
    stamp = series.time
    spread = lateness["value"][np.searchsorted(lateness.time, stamp)] * n["jitter"]
    arrival = stamp + np.rint(np.maximum(n["latency"] + spread, 0.0) * 1e9).astype(np.int64)
    order = np.argsort(arrival, kind="stable")
    place = np.arange(len(order))
    arrival = np.maximum.accumulate(arrival[order] - place) + place
    order, arrival = order[arrival <= end], arrival[arrival <= end]
    values = series[order].values
    return Series(arrival, values, type=series.type, name=series.name), stamp[order]


def _orientation_noise(n: Numbers) -> dict[str, float]:
    """What one reading is worth to a filter of the attitude alone, rad/s and m/s^2, of a body in its place:
    the gyroscope's with its drift (root mean square), the accelerometer's white noise."""
    rate = n["imu.rate"]
    drift = math.hypot(n["gyro.bias"], n["gyro.walk"] * math.sqrt(0.5 * n["duration"]))
    return {
        "gyro": math.hypot(n["gyro.noise"] * math.sqrt(rate), drift),
        "force": max(n["accelerometer.noise"] * math.sqrt(rate), 1e-3),
    }


def _late(name: str, series: Series, stamp: np.ndarray, world: World) -> str:
    """What a filter gets wrong that takes a late reading for one of the time when it arrived."""
    then, now = world.at(stamp / 1e9), world.at(np.minimum(series.time / 1e9, world.duration))
    gone = np.sqrt(np.mean(np.square(now.position - then.position).sum(-1)))
    turned = np.sqrt(np.mean(np.square(geodesic_angle(then.attitude, now.attitude))))
    sentence = (
        f"{name} arrives {np.mean(series.time - stamp) * 1e-6:.1f} ms late on average; a filter that takes "
        f"it as fresh is told where the body was {gone:.3f} m and {turned:.1f} deg ago (root mean squares)"
    )
    return note("info", sentence)


def check_samples(numbers: Numbers, rates: Iterable[str], path: str) -> None:
    """Refuse a flight with more samples of a sensor than memory holds, or faster than nanoseconds tell."""
    for rate in rates:
        if numbers[rate] > 1e9 or numbers["duration"] * max(numbers[rate], 1e-3) > MOST_SAMPLES:
            raise DeclarationError(
                "this simulated flight is too large",
                path=path,
                expected=f"{rate} at most 1e9 Hz, and at most {MOST_SAMPLES:,} samples in the whole duration",
                got=f"duration={numbers['duration']:g}, {rate}={numbers[rate]:g}",
                fix="choose a shorter duration or a lower rate",
            )


def _world(kind: str, n: Numbers) -> World:
    """The world, but for what is drawn."""
    if kind == "roundtrip":
        return RoundTrip(n["duration"], angle=n["angle"], trip=n["trip"], rest=n["rest"])
    if kind == "hover":
        return Hover(n["duration"], drift=n["drift"])
    if n["duration"] > thesis.AVERAGE.duration:
        raise DeclarationError(
            "the thesis's flights are shorter",
            path="sim:thesis",
            expected=f"duration at most {thesis.AVERAGE.duration:g} s",
            got=f"{n['duration']:g}",
            fix="leave duration out, or use sim:roundtrip or sim:hover",
        )
    return thesis.AVERAGE


def _still(kind: str, n: Numbers) -> float:
    """For how many seconds the body is at rest at first."""
    if kind == "roundtrip":
        return min(n["rest"], n["duration"])
    return n["duration"] if kind == "hover" and n["drift"] == 0.0 else 0.0


def _planned(seed: int, *, numbers: Numbers) -> dict[str, Series]:
    """The way of a flight of the thesis, told once, at 0."""
    n = numbers
    flight = thesis_flight(seed, limits=Limits(n["least_thrust"], n["most_thrust"], n["most_rate"]))
    drawn = Drawn(numbers=flight.primitives.coefficients.reshape(1, -1))
    return {"plan": Series(np.zeros(1, dtype=np.int64), drawn, name="plan")}


def _calibration(name: str, sensors: Mapping[str, Numbers]) -> dict[str, Any]:
    """What a filter may know of a sensor, under the names that recorded flights use too."""
    n = sensors[name]
    found: dict[str, Any] = {}
    if name == "imu":
        densities = [sensors[part][kind] for kind in ("noise", "walk") for part in _PARTS_OF_IMU]
        found["imu_noise"] = ImuNoise(*densities)
    if "oversample" in n or "turn" in n:
        found[f"{name}_oversample"] = int(n.get("oversample", 1))
    if "turn" in n:
        found[f"{name}_turn"] = bool(n["turn"])
    if name == "vicon":
        found |= {"position_noise": n["noise"], "attitude_noise": n["attitude_noise"]}
        found["vicon_lever"] = (0.0, 0.0, 0.0)
    if name == "magnetometer":
        found["magnetic_field"] = earth_field(n["declination"], n["dip"], n["strength"])
    if "lever_x" in n:
        found[f"{name}_lever"] = tuple(n[k] for k in _LEVER)
    if n.get("geodetic"):
        found[f"{name}_origin"] = n["latitude"], n["longitude"], n["height"]
    return found


def _of(name: str, numbers: Numbers) -> dict[str, float]:
    return {part: numbers[f"{name}.{part}"] for part in SENSORS[name]}


def _chosen(text: str, path: str) -> list[str]:
    names = [name.strip() for name in text.split(",") if name.strip()]
    names = list(SENSORS) if names == ["all"] else list(dict.fromkeys(names))
    for name in names:
        if name not in SENSORS:
            raise UnknownNameError("sensor", name, [*SENSORS, "all"], path=path)
    if not names:
        raise DeclarationError(
            "a flight needs a sensor",
            path=path,
            expected="sensors: names with commas between, of " + ", ".join(SENSORS),
            got=repr(text),
            fix="for example sensors=imu,vicon",
        )
    return names


def _numbers(kind: str, chosen: list[str], given: Mapping[str, str | float], path: str) -> dict[str, float]:
    used = [*chosen, *(_PARTS_OF_IMU if "imu" in chosen else ())]
    known = {f"{name}.{part}": value for name, parts in SENSORS.items() for part, value in parts.items()}
    known.update({**WORLDS[kind], **_OWN.get(kind, {})})
    for name, text in given.items():
        if name not in known:
            raise UnknownNameError("setting", name, ["sensors", *known], path=path)
        sensor, dot, part = name.rpartition(".")
        if dot and sensor not in used:
            raise DeclarationError(
                f"setting {name!r} is of a sensor that this flight does not have",
                path=path,
                expected="settings of " + ", ".join(used),
                got=f"{name}={text}",
                fix=f"name the sensor too: sensors={','.join([*chosen, sensor])}",
            )
        known[name] = _number(name, part, text, known[name], path)
    return known


def _number(name: str, part: str, text: str | float, otherwise: float, path: str) -> float:
    try:
        number = float(text)
    except (TypeError, ValueError):
        number = math.nan
    least = -math.inf if part in _SIGNED else 0.0
    wrong = not math.isfinite(number) or number < least or (part in _POSITIVE and number == 0.0)
    if part in _SWITCHES:
        wrong, kind = number not in (0.0, 1.0), "0 or 1"
    elif part in _LOOKS:
        wrong, kind = number not in range(1, _MOST_LOOKS + 1), f"a whole number from 1 to {_MOST_LOOKS}"
    else:
        kind = "a positive number" if part in _POSITIVE else "a number that is not negative"
    if wrong:
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected="a number" if part in _SIGNED else kind,
            got=repr(text),
            fix=f"for example {name}={otherwise:g}",
        )
    return number
