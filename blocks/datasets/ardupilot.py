"""Logs of the ArduPilot autopilot, `.bin`: its inertial unit, satellites, magnetometer and barometer.

    IMU   TimeUS, GyrX, GyrY, GyrZ (rad/s), AccX, AccY, AccZ (m/s^2)                    forward, right, down
    GPS   TimeUS, Status, Lat, Lng (degrees), Alt (m), Spd (m/s), GCrs (degrees from north), VZ (m/s, down)
    GPA   HAcc, VAcc (m), SAcc (m/s)                                 how good the fix of the same time is
    MAG   TimeUS, MagX, MagY, MagZ (mG)                                                 forward, right, down
    BARO  TimeUS, Alt (m)
    ATT   TimeUS, Roll, Pitch, Yaw (degrees, of north, east, down)

Stamps are microseconds of the autopilot's clock. Axes are turned into forward, left, up, and east, north, up.
Of several units of a kind the first is read, or that of imu.instance. A fix below 3-D is left out. What the
autopilot itself estimated is no measurement: its attitude is read with truth=attitude alone.

Source: ArduPilot, "Log messages", https://ardupilot.org/copter/docs/logmessages.html.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.dataflash import read_dataflash
from flowgraph.blocks.datasets.places import add_fixes, add_velocities, diagonal, from_frd, from_ned
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    policy,
    stream_settings,
    the_file,
)
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.blocks.datasets.turns import from_angles, from_ned_attitude
from flowgraph.blocks.datasets.units import FIELD
from flowgraph.blocks.signals import Attitude, Height, Imu, MagneticField
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    "imu.instance": "the number of the inertial unit, where there are several; the least if left out",
    "truth": "none (left out), or attitude: what the autopilot estimated",
    **NOISE_SETTINGS,
    **stream_settings("imu", "gps", "gps_velocity", "magnetometer", "barometer", "truth"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

_NEEDED: Mapping[str, tuple[str, ...]] = {
    "IMU": ("TimeUS", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ"),
    "GPS": ("TimeUS", "Status", "Lat", "Lng", "Alt", "Spd", "GCrs", "VZ"),
    "MAG": ("TimeUS", "MagX", "MagY", "MagZ"),
    "BARO": ("TimeUS", "Alt"),
    "GPA": ("TimeUS", "HAcc", "VAcc", "SAcc"),
    "ATT": ("TimeUS", "Roll", "Pitch", "Yaw"),
}

_Fields = Mapping[str, np.ndarray]


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read `imu`, and what there is of `gps` (`GnssFix`), `gps_velocity`, `magnetometer` and `barometer`.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing or no log, has no inertial unit, or a message lacks a field; values
            cannot be of their unit. UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "ardupilot")
    role = chosen(given, "truth", ("none", "attitude"), "ardupilot")
    file = the_file(argument, kind="ardupilot", what="log of ArduPilot", endings=(".bin",))
    log = read_dataflash(file, *_NEEDED)
    made = Recording(file.stem, policy(given, "ardupilot"), kind="ardupilot", given=given, place=str(file))
    instance = None if "imu.instance" not in given else str(given["imu.instance"])
    parts = {name: _one(made, str(file), name, fields, instance) for name, fields in log.messages.items()}
    if "IMU" not in parts:
        raise DataError(
            "this log has no inertial unit",
            path=str(file),
            expected="messages IMU",
            got=", ".join(sorted(n for n, k in log.kinds.items() if k))[:200] or "no message",
            fix="log IMU (LOG_BITMASK), or choose the log of a flight",
        )
    place = lambda name: f"{file}: {name}"
    imu = parts["IMU"]
    readings = {
        "gyro": from_frd(_vector(imu, "GyrX", "GyrY", "GyrZ")),
        "specific_force": from_frd(_vector(imu, "AccX", "AccY", "AccZ")),
    }
    made.add("imu", place("IMU"), _time(imu), readings, Imu)
    if "GPS" in parts:
        _satellites(made, parts["GPS"], parts.get("GPA"), place("GPS"))
    if "MAG" in parts:
        field = from_frd(_vector(parts["MAG"], "MagX", "MagY", "MagZ")) * FIELD["mG"]
        made.add("magnetometer", place("MAG"), _time(parts["MAG"]), {"field": field}, MagneticField)
    if "BARO" in parts:
        height = np.asarray(parts["BARO"]["Alt"], dtype=float)
        made.add("barometer", place("BARO"), _time(parts["BARO"]), {"height": height}, Height)
    if role == "attitude":
        _estimated(made, parts.get("ATT"), place("ATT"))
    rest = sum(1 for name, count in log.kinds.items() if count and name not in parts)
    made.notes.append(note("skipped", f"{file.name}: {rest} kinds of messages of others"))
    if log.passed:
        made.notes.append(note("skipped", f"{file.name}: {log.passed} bytes that are of no message"))
    if log.cut:
        made.notes.append(note("skipped", f"{file.name}: the last message, which the end cuts off"))
    made.info["imu_noise"] = imu_noise(given, "ardupilot", made.notes)
    return made.flight()


def _one(made: Recording, place: str, name: str, fields: _Fields, instance: str | None) -> _Fields:
    """The messages of one unit.

    Raises:
        DataError: where a field is missing, or there is no such unit.
    """
    lacking = [n for n in _NEEDED[name] if n not in fields]
    if lacking:
        raise DataError(
            "a message lacks a field",
            path=f"{place}: {name}",
            expected=", ".join(_NEEDED[name]),
            got=", ".join(fields),
            fix="logs of ArduPilot from version 3.3 on are read",
        )
    if "I" not in fields or name == "ATT":
        return fields
    there = np.unique(fields["I"])
    which = str(there[0]) if instance is None or name != "IMU" else instance
    if which not in map(str, there):
        raise DataError(
            "there is no such unit",
            path=f"{place}: {name}",
            expected="imu.instance=" + " or ".join(map(str, there)),
            got=f"imu.instance={which}",
            fix="choose one that is there",
        )
    if len(there) > 1 and name != "GPA":
        others = ", ".join(n for n in map(str, there) if n != which)
        another = "; imu.instance=NUMBER reads another" if name == "IMU" else ""
        made.notes.append(note("skipped", f"{name}: the units {others}{another}"))
    kept = fields["I"] == int(which)
    return {n: x[kept] for n, x in fields.items()}


def _satellites(made: Recording, gps: _Fields, accuracy: _Fields | None, place: str) -> None:
    """Positions and velocities of the fixes in space, each as good as the message of its time says."""
    good = np.asarray(gps["Status"]) >= 3
    if not good.all():
        left = int((~good).sum())
        made.notes.append(note("skipped", f"gps: {left} of {len(good)} fixes are none in space"))
    if not good.any():
        return
    time, column = _time(gps)[good], lambda name: np.asarray(gps[name], dtype=float)[good]
    worth = np.zeros((len(time), 3))
    if accuracy is not None:
        rows = {int(t): k for k, t in enumerate(_time(accuracy))}
        at = np.array([rows.get(int(t), -1) for t in time])
        told = _vector(accuracy, "HAcc", "VAcc", "SAcc")
        worth = np.where((at >= 0)[:, None], told[at], 0.0)
    else:
        made.notes.append(note("skipped", "gps: the log does not say how good fixes are"))
    level, up, speed = worth.T
    degrees = np.stack([column("Lat"), column("Lng"), column("Alt")], axis=-1)
    add_fixes(made, place, time, degrees, diagonal(np.stack([level, level, up], axis=-1)))
    course = np.radians(column("GCrs"))
    over = column("Spd")
    velocity = from_ned(np.stack([over * np.cos(course), over * np.sin(course), column("VZ")], axis=-1))
    add_velocities(made, place, time, velocity, diagonal(np.stack([speed] * 3, axis=-1)))


def _estimated(made: Recording, attitude: _Fields | None, place: str) -> None:
    """The autopilot's attitude, as the truth."""
    if attitude is None:
        made.notes.append(note("skipped", "truth=attitude: the log has no message ATT"))
        return
    angles = np.radians(_vector(attitude, "Roll", "Pitch", "Yaw"))
    turned = from_ned_attitude(from_angles(angles, "zyx"))
    made.add("truth", place, _time(attitude), {"attitude": turned}, Attitude)
    made.notes.append(
        note("info", "the truth is what the autopilot estimated: errors tell how alike the two are")
    )


def _time(fields: _Fields) -> np.ndarray:
    return np.asarray(fields["TimeUS"]).astype(np.int64) * 1000


def _vector(fields: _Fields, *names: str) -> np.ndarray:
    return np.stack([np.asarray(fields[n], dtype=float) for n in names], axis=-1)
