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
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks import sensors as s
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.signals import NavigationState
from flowgraph.blocks.world import Hover, Limits, RoundTrip, World, figures, thesis_flight
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
    world, still = _world(kind, numbers, seed, path)
    end = round(numbers["duration"] * 1e9)

    streams: dict[str, Series] = {}
    stamps: dict[str, np.ndarray] = {}
    made: dict[str, s.Sensor] = {}
    info: dict[str, Any] = {"world": world, "still": still, "noise": {}, "stamps": stamps}
    for name in chosen:
        made[name] = sensor = _sensor(name, numbers)
        recording = sensor.record(world, seed=seed, until=end)
        streams[name] = recording.series
        info["noise"][name] = _of(name, numbers)
        info[f"{name}_period_ns"] = sensor.period
        if sensor.latency or sensor.jitter:
            stamps[name] = recording.stamp
        info.update(_calibration(sensor))
        if info["noise"][name].get("geodetic"):
            n = info["noise"][name]
            origin = n["latitude"], n["longitude"], n["height"]
            streams[name], info[f"{name}_origin"] = s.as_geodetic(recording.series, origin), origin
    for part in _PARTS_OF_IMU if "imu" in chosen else ():
        info["noise"][part] = _of(part, numbers)

    time = np.arange(0, end + 1, min(sensor.period for sensor in made.values()), dtype=np.int64)
    motion = world.at(time / 1e9)
    truth = NavigationState(
        position=motion.position,
        velocity=motion.velocity,
        attitude=motion.attitude,
        gyro_bias=_bias("gyro", made, time, numbers, seed),
        accelerometer_bias=_bias("accelerometer", made, time, numbers, seed),
    )
    if kind == "roundtrip" and "imu" in chosen and steps:
        info["orientation_noise"] = _orientation_noise(numbers)
    info["across"] = float(np.sqrt(np.mean(np.square(motion.specific_force[:, :2]).sum(-1))))
    notes = [note("info", f"simulated with seed {seed}: {figures(world)}")]
    notes += [_late(name, streams[name], stamp, world) for name, stamp in stamps.items() if len(stamp)]
    return Flight(f"sim-{kind}-{seed}", streams, Series(time, truth, name="truth"), info, tuple(notes))


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


def _world(kind: str, n: Numbers, seed: int, path: str) -> tuple[World, float]:
    """The world, and for how many seconds the body is at rest at first."""
    if kind == "roundtrip":
        shape = RoundTrip(n["duration"], angle=n["angle"], trip=n["trip"], rest=n["rest"])
        return shape, min(n["rest"], n["duration"])
    if kind == "hover":
        at_rest = n["drift"] == 0.0
        return Hover(n["duration"], drift=n["drift"], seed=seed), n["duration"] if at_rest else 0.0
    flight = thesis_flight(seed, limits=Limits(n["least_thrust"], n["most_thrust"], n["most_rate"]))
    if n["duration"] > flight.duration:
        raise DeclarationError(
            "the thesis's flights are shorter",
            path=path,
            expected=f"duration at most {flight.duration:g} s",
            got=f"{n['duration']:g}",
            fix="leave duration out, or use sim:roundtrip or sim:hover",
        )
    return flight, 0.0


def _noise(n: Numbers, *, density: bool = False, white: str = "noise") -> s.Noise:
    kind = {"density" if density else "deviation": n[white]}
    kind["bias"], kind["walk"] = (n.get(white.replace("noise", part), 0.0) for part in ("bias", "walk"))
    return s.Noise(**kind)


def _sensor(name: str, numbers: Numbers) -> s.Sensor:
    n = _of(name, numbers)
    common: dict[str, Any] = {"name": name, "rate": n["rate"], **{k: n[k] for k in _CLOCK}}
    if "oversample" in n:
        common["oversample"] = int(n["oversample"])
    if "turn" in n:
        common["turn"] = bool(n["turn"])
    if name == "imu":
        gyro, push = (_noise(_of(part, numbers), density=True) for part in _PARTS_OF_IMU)
        return s.InertialUnit(**common, gyro=gyro, accelerometer=push)
    common["noise"] = _noise(n, density=name in ("gyro", "accelerometer", "coordinate_acceleration"))
    if name in ("vicon", "optical_flow"):
        common["attitude_noise"] = _noise(n, white="attitude_noise")
    if "lever_x" in n:
        common["lever"] = tuple(n[k] for k in _LEVER)
    common.update({k: n[k] for k in ("declination", "dip", "strength", "most_tilt") if k in n})
    return _MAKERS[name](**common)


_MAKERS: Mapping[str, Callable[..., s.Sensor]] = {
    "gyro": s.Gyroscope,
    "accelerometer": s.Accelerometer,
    "coordinate_acceleration": s.CoordinateAccelerometer,
    "position": s.PositionSensor,
    "attitude": s.AttitudeSensor,
    "vicon": s.Vicon,
    "gps": s.Gps,
    "gps2": s.Gps,
    "magnetometer": s.Magnetometer,
    "magnetic_attitude": s.MagneticAttitude,
    "altimeter": s.Altimeter,
    "optical_flow": s.OpticalFlowSensor,
    "thrust": s.ThrustInput,
    "body_rate": s.BodyRateInput,
}


def _calibration(sensor: s.Sensor) -> dict[str, Any]:
    """What a filter may know of a sensor, under the names that recorded flights use too."""
    if isinstance(sensor, s.InertialUnit):
        return {"imu_noise": sensor.densities, "imu_oversample": sensor.oversample}
    if isinstance(sensor, s.RateSensor):
        return {f"{sensor.name}_oversample": sensor.oversample, f"{sensor.name}_turn": sensor.turn}
    if isinstance(sensor, s.InertialSensor):
        return {f"{sensor.name}_oversample": sensor.oversample}
    if isinstance(sensor, s.Vicon):
        noise = {"position_noise": sensor.noise.deviation, "attitude_noise": sensor.attitude_noise.deviation}
        return {**noise, "vicon_lever": (0.0, 0.0, 0.0)}
    if isinstance(sensor, s.Magnetometer):
        return {"magnetic_field": s.earth_field(sensor.declination, sensor.dip, sensor.strength)}
    if isinstance(sensor, s.PositionSensor):
        return {f"{sensor.name}_lever": sensor.lever}
    return {}


def _bias(
    part: str, made: Mapping[str, s.Sensor], time: np.ndarray, numbers: Numbers, seed: int
) -> np.ndarray:
    """The bias (n, 3) that a reading at or before each time had; zero without such a sensor."""
    reader = made.get("imu") or made.get(part)
    if reader is None:
        return np.zeros((len(time), 3))
    stamp = np.arange(round(reader.phase * 1e9), int(time[-1]) + reader.period, reader.period)
    drift = _noise(_of(part, numbers), density=True).drift(part, seed, stamp / 1e9, 3)
    return drift[np.maximum(np.searchsorted(stamp, time, side="right") - 1, 0)]


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
        wrong, kind = number not in range(1, s.MOST_LOOKS + 1), f"a whole number from 1 to {s.MOST_LOOKS}"
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
