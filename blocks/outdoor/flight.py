"""Outdoors: which sensors a vehicle carries there, how good they are, and how a filter starts on them.

An inertial unit, and any of a magnetometer, two GPS receivers, an altimeter and optical flow, each keep a
clock of their own. What a filter must know of them beforehand is one object, so that two filters on the same
streams can be given the very same knowledge, and be compared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from flowgraph import Flight, Series
from flowgraph.blocks.geometry.rotations import level
from flowgraph.blocks.inertial.alignment import StartSpread, need_usable, usable
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = [
    "AIDS",
    "STREAMS",
    "OutdoorSensors",
    "OutdoorStart",
    "attitude_of_two",
    "outdoor_flight",
    "without_gaps",
]

AIDS = ("gps", "gps2", "altimeter", "magnetometer", "optical_flow")
"""What an outdoor flight has any of, by name."""

STREAMS = ("imu", *AIDS)
"""All that an outdoor flight can have."""

LOST = 100.0
"""m: how far off a start may be whose position nobody tells."""

Vector = tuple[float, float, float]


@dataclass(frozen=True)
class OutdoorSensors:
    """What is known of the sensors. Deviations are of one sample, each the same on its axes; None of a sensor
    that is not there.

    Args:
        imu: densities of the inertial unit; it has no bias.
        gps, gps2: m.
        altimeter: m, along the beam.
        magnetometer: T.
        displacement, turn: of optical flow, m and rad.
        field: the Earth's field in the world, T.
        gps_lever, gps2_lever: the antennas in the body, m.

    Raises:
        DeclarationError: for a deviation that is not positive, or a field of zero.
    """

    imu: ImuNoise
    gps: float | None = None
    gps2: float | None = None
    altimeter: float | None = None
    magnetometer: float | None = None
    displacement: float | None = None
    turn: float | None = None
    field: Vector = (0.0, 1.0, 0.0)
    gps_lever: Vector = (0.0, 0.0, 0.0)
    gps2_lever: Vector = (0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        names = ("gps", "gps2", "altimeter", "magnetometer", "displacement", "turn")
        said = {n: getattr(self, n) for n in names if getattr(self, n) is not None}
        wrong = [f"{n}={value!r}" for n, value in said.items() if not 0.0 < value < np.inf]
        if wrong or not np.any(self.field):
            raise DeclarationError(
                "these sensors cannot be used",
                path="OutdoorSensors",
                expected="positive standard deviations, and a magnetic field that is not zero",
                got=", ".join([*wrong, f"field={self.field}"]),
                fix="give each sensor the noise of one of its samples, for example gps=0.3",
            )

    def noise(self, name: str) -> float:
        """The deviation of a sensor that is there.

        Raises:
            DeclarationError: where nobody says it.
        """
        value: float | None = getattr(self, name)
        if value is None:
            raise DeclarationError(
                "nobody says the noise of this sensor", path=f"OutdoorSensors.{name}",
                expected="a standard deviation", got="None", fix=f"write OutdoorSensors(..., {name}=...)",
            )  # fmt: skip
        return value


@dataclass(frozen=True)
class OutdoorStart:
    """Where a filter starts: position (3,) m, attitude (4,) body to world; it is taken to be at rest.

    spread: how sure that is.
    """

    position: np.ndarray
    attitude: np.ndarray
    spread: StartSpread


def attitude_of_two(force: npt.ArrayLike, field: npt.ArrayLike, *, earth: npt.ArrayLike) -> np.ndarray:
    """The attitude (4,) of a body at rest, from its specific force (+z) and the magnetic field it reads.

    Force, and the part of the field across it, are one orthogonal frame in the body and another one in the
    world; the attitude turns one into the other. The force is believed, the field gives the heading only.

    Source: H. D. Black, "A passive system for determining the attitude of a satellite", AIAA Journal 2(7),
    1964 (TRIAD).
    """
    from scipy.spatial.transform import Rotation  # slow to import, and only a start needs it

    def frame(up: np.ndarray, along: np.ndarray) -> np.ndarray:
        z = up / np.linalg.norm(up)
        x = np.cross(np.cross(z, along), z)
        x = x / np.linalg.norm(x)
        return np.stack([x, np.cross(z, x), z], axis=1)

    body = frame(np.asarray(force, dtype=float), np.asarray(field, dtype=float))
    world = frame(np.array([0.0, 0.0, 1.0]), np.asarray(earth, dtype=float))
    x, y, z, w = Rotation.from_matrix(world @ body.T).as_quat()
    return np.array([w, x, y, z])


def outdoor_flight(
    flight: Flight, graph: str
) -> tuple[dict[str, Series], OutdoorSensors, OutdoorStart, tuple[str, ...]]:
    """The streams of a flight by name, what is known of its sensors, where to start, and notes on that.

    The position is that of the first reading of a receiver, the attitude that of the first force and field;
    readings that are not finite, and a force or field of nearly no length, are passed over. What no sensor
    tells of these is the truth's, where there is one, and else taken for the origin and north, with a
    deviation that says so.

    Args:
        flight: with `imu` and any of `AIDS`; a reading of optical flow covers the time since the one before
            it, the first one that since the flight's first reading. info: `imu_noise`, `noise`, and
            `magnetic_field` where there is a magnetometer.
        graph: who asks, for messages.

    Raises:
        DataError: where a stream or what should be known of it is missing, optical flow has a gap, or no
            reading of a sensor can start a filter.
    """
    streams = flight.need(graph, "imu")
    streams |= {name: flight.streams[name] for name in AIDS if len(flight.streams.get(name, ()))}
    if len(streams) == 1:
        raise DataError(
            f"this flight lacks what {graph} needs beside an inertial unit",
            path=flight.name,
            expected=f"one or more of {', '.join(AIDS)}",
            got=", ".join(flight.streams),
            fix=f"choose another flight, such as sim:thesis with sensors={','.join(STREAMS)}",
        )
    info = flight.info
    wanted = ("imu_noise", "noise", *(["magnetic_field"] if "magnetometer" in streams else []))
    missing = [name for name in wanted if name not in info]
    if missing:
        raise DataError(
            f"this flight does not say what {graph} must know of its sensors",
            path=flight.name,
            expected=f"info with {', '.join(wanted)}",
            got=f"no {', '.join(missing)}",
            fix="add them to the flight's info, or build the graph with sensors=OutdoorSensors(...)",
        )
    without_gaps(flight.name, streams)
    noise = info["noise"]
    known = {name: noise[name]["noise"] for name in AIDS[:-1] if name in streams}
    if "optical_flow" in streams:
        flow = noise["optical_flow"]
        known |= {"displacement": flow["noise"], "turn": flow["attitude_noise"]}
    if "magnetic_field" in info:
        known["field"] = _three(info["magnetic_field"])
    sensors = OutdoorSensors(
        imu=info["imu_noise"],
        gps_lever=_three(info.get("gps_lever", (0.0, 0.0, 0.0))),
        gps2_lever=_three(info.get("gps2_lever", (0.0, 0.0, 0.0))),
        **known,
    )
    return streams, sensors, *_start(flight, streams, sensors)


def _start(
    flight: Flight, streams: dict[str, Series], sensors: OutdoorSensors
) -> tuple[OutdoorStart, tuple[str, ...]]:
    """Where to start, and what is assumed for it."""
    notes, spread = [], _spread(sensors, streams["imu"])
    truth = flight.truth
    receiver = next((name for name in ("gps", "gps2") if name in streams), None)
    place = np.zeros(3)
    if receiver is not None:
        place = _first(flight, receiver, "position", -1.0)
    elif truth is not None and "position" in truth.leaves:
        place = truth["position"][0]
        notes.append(note("assumed", "the position at the start is the truth's: no receiver tells it"))
    else:
        spread = replace(spread, position=LOST)
        notes.append(note("assumed", "the start is the origin, for all that is known: no receiver is there"))
    forces = streams["imu"]["specific_force"]
    force = forces[np.argmax(need_usable(forces, f"{flight.name}: imu"))]
    if "magnetometer" in streams:
        turn = attitude_of_two(force, _first(flight, "magnetometer", "field", 0.0), earth=sensors.field)
    elif truth is not None and "attitude" in truth.leaves:
        turn = np.asarray(level(truth["attitude"][0], force, xp=np))
        spread = replace(spread, heading=StartSpread().heading)
        notes.append(note("assumed", "the heading at the start is the truth's: no magnetometer tells it"))
    else:
        turn = np.asarray(level(np.array([1.0, 0.0, 0.0, 0.0]), force, xp=np))
        spread = replace(spread, heading=math.pi)
        notes.append(note("assumed", "the heading at the start is 0, for all that is known"))
    return OutdoorStart(place, turn, spread), tuple(notes)


def _first(flight: Flight, name: str, field: str, least: float) -> np.ndarray:
    """The first reading (3) of a stream that is finite and longer than that."""
    readings = flight.streams[name][field]
    shown = usable(readings, least)
    if not shown.any():
        raise DataError(
            f"no reading of {name} can start a filter",
            path=f"{flight.name}: {name}",
            expected="one that is finite" + (", and no field of zero" if least == 0.0 else ""),
            got=f"none in {len(readings)} readings",
            fix=f"check the columns of {name} and their unit",
        )
    return np.asarray(readings[np.argmax(shown)])


def _spread(sensors: OutdoorSensors, imu: Series) -> StartSpread:
    """How wrong an attitude of one force and one field is; what tilts the field turns the heading too."""
    period = float(np.median(np.diff(imu.time))) * 1e-9 if len(imu) > 1 else 1.0
    tilt = max(sensors.imu.accelerometer / math.sqrt(period) / 9.81, 0.01)
    if sensors.magnetometer is None:
        return StartSpread(tilt=tilt)
    x, y, z = sensors.field
    across = max(math.hypot(x, y), 1e-12)
    heading = math.hypot(sensors.magnetometer / across, tilt * z / across)
    return StartSpread(tilt=tilt, heading=min(heading, math.pi))


def _three(values: npt.ArrayLike) -> Vector:
    x, y, z = np.asarray(values, dtype=float).tolist()
    return x, y, z


def without_gaps(name: str, streams: dict[str, Series]) -> None:
    """Refuse optical flow of which a reading does not begin where the one before it ended."""
    flow = streams.get("optical_flow")
    if flow is None:
        return
    first = min(int(s.time[0]) for s in streams.values())
    since = np.diff(flow.time, prepend=first) * 1e-9
    gap = np.flatnonzero(np.abs(since - flow["interval"]) > 1e-6)
    if len(gap):
        k = int(gap[0])
        raise DataError(
            "optical flow has a gap",
            path=f"{name}, optical_flow, row {k}",
            expected=f"a reading over the {since[k]:g} s since the one before, or since the start",
            got=f"interval={flow['interval'][k]:g} s",
            fix="start the flight at a picture, and give it every reading, without latency",
        )
