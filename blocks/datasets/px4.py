"""Logs of the PX4 autopilot, `.ulg`: its inertial unit, satellites, magnetometer and barometer.

    sensor_combined       gyro_rad, accelerometer_m_s2                          forward, right, down
    vehicle_gps_position  lat, lon (1e-7 degrees), alt (mm), eph, epv, vel_*    or latitude_deg,
    altitude_msl_m vehicle_magnetometer  magnetometer_ga (G)                                   forward,
    right, down vehicle_air_data      baro_alt_meter

Stamps are microseconds of the autopilot's clock. Axes are turned into forward, left, up, and east, north,
up. A fix below 3-D is left out. What the autopilot estimated itself is not read.

Source: PX4, "ULog File Format", by way of pyulog.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.places import add_fixes, add_velocities, diagonal, from_frd, from_ned
from flowgraph.blocks.datasets.shape import (
    NOISE_SETTINGS,
    Recording,
    imu_noise,
    known,
    policy,
    stream_settings,
    the_file,
)
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.blocks.signals import Height, Imu, MagneticField
from flowgraph.data.notes import note
from flowgraph.errors import DataError, MissingDependencyError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    **NOISE_SETTINGS,
    **stream_settings("imu", "gps", "gps_velocity", "magnetometer", "barometer"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

_SOURCES = {
    "imu": ("sensor_combined",),
    "gps": ("vehicle_gps_position", "sensor_gps"),
    "magnetometer": ("vehicle_magnetometer",),
    "barometer": ("vehicle_air_data",),
}
_GAUSS = 1e-4  # T


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read `imu`, and what there is of `gps` (`GnssFix`), `gps_velocity`, `magnetometer` and `barometer`.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing or no log, or has no inertial unit; values cannot be of their unit.
        MissingDependencyError: without pyulog. UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "px4")
    file = the_file(argument, kind="px4", what="log of PX4", endings=(".ulg",))
    try:
        from pyulog import ULog  # optional
    except ImportError:
        raise MissingDependencyError(
            "logs of PX4 need the pyulog library",
            path=str(file),
            expected="the Python package pyulog",
            got="it cannot be imported",
            fix='pip install "flowgraph-filters[px4]"',
        ) from None
    if file.read_bytes()[:7] != b"ULog\x01\x12\x35":
        raise DataError(
            "this is no log of PX4",
            path=str(file),
            expected="a file that begins with ULog",
            got=repr(file.read_bytes()[:8]),
            fix="choose the .ulg itself",
        )
    topics = {data.name: data.data for data in reversed(ULog(str(file)).data_list)}
    found = {stream: next((n for n in names if n in topics), None) for stream, names in _SOURCES.items()}
    if found["imu"] is None:
        raise DataError(
            "this log has no inertial unit",
            path=str(file),
            expected="the topic sensor_combined",
            got=", ".join(sorted(topics))[:200] or "no topic",
            fix="log sensor_combined (SDLOG_PROFILE)",
        )
    made = Recording(file.stem, policy(given, "px4"), kind="px4", given=given, place=str(file))
    place = lambda stream: f"{file}: {found[stream]}"
    imu = topics[found["imu"]]
    readings = {
        "gyro": from_frd(_vector(imu, "gyro_rad")),
        "specific_force": from_frd(_vector(imu, "accelerometer_m_s2")),
    }
    made.add("imu", place("imu"), _time(imu), readings, Imu)
    if found["gps"] is not None:
        _satellites(made, topics[found["gps"]], place("gps"))
    if found["magnetometer"] is not None:
        topic = topics[found["magnetometer"]]
        field = from_frd(_vector(topic, "magnetometer_ga")) * _GAUSS
        made.add("magnetometer", place("magnetometer"), _time(topic), {"field": field}, MagneticField)
    if found["barometer"] is not None:
        topic = topics[found["barometer"]]
        height = np.asarray(topic["baro_alt_meter"], dtype=float)
        made.add("barometer", place("barometer"), _time(topic), {"height": height}, Height)
    used = set(found.values())
    made.notes.append(note("skipped", f"{file.name}: {len(set(topics) - used)} topics of other kinds"))
    made.info["imu_noise"] = imu_noise(given, "px4", made.notes)
    return made.flight()


def _satellites(made: Recording, gps: Mapping[str, Any], place: str) -> None:
    """Positions and velocities of the fixes in space."""
    good = np.asarray(gps["fix_type"]) >= 3 if "fix_type" in gps else np.ones(len(gps["timestamp"]), bool)
    if not good.any():
        made.notes.append(note("skipped", f"gps: none of {len(good)} fixes is one in space"))
        return
    if not good.all():
        left = int((~good).sum())
        made.notes.append(note("skipped", f"gps: {left} of {len(good)} fixes are none in space"))
    column = lambda *names: next(
        np.asarray(gps[n], dtype=float)[good] * scale for n, scale in names if n in gps
    )
    degrees = np.stack(
        [
            column(("latitude_deg", 1.0), ("lat", 1e-7)),
            column(("longitude_deg", 1.0), ("lon", 1e-7)),
            column(
                ("altitude_ellipsoid_m", 1.0), ("alt_ellipsoid", 1e-3), ("altitude_msl_m", 1.0), ("alt", 1e-3)
            ),
        ],
        axis=-1,
    )
    level, up = column(("eph", 1.0)), column(("epv", 1.0))
    time = _time(gps)[good]
    add_fixes(made, place, time, degrees, diagonal(np.stack([level, level, up], axis=-1)))
    velocity = from_ned(np.stack([column((f"vel_{a}_m_s", 1.0)) for a in "ned"], axis=-1))
    noise = column(("s_variance_m_s", 1.0))
    add_velocities(made, place, time, velocity, diagonal(np.stack([noise] * 3, axis=-1)))


def _time(topic: Mapping[str, Any]) -> np.ndarray:
    return np.asarray(topic["timestamp"], dtype=np.int64) * 1000


def _vector(topic: Mapping[str, Any], name: str) -> np.ndarray:
    return np.stack([np.asarray(topic[f"{name}[{k}]"], dtype=float) for k in range(3)], axis=-1)
