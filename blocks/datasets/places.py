"""What files of satellites share: fixes with their covariance, axes of aircraft, and what a fix quality is
worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flowgraph import Series
from flowgraph.blocks.datasets.shape import Recording
from flowgraph.blocks.datasets.turns import from_angles, from_ned_attitude
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.signals import GnssFix, GnssVelocity, Pose

__all__ = [
    "GPS_EPOCH",
    "QUALITY",
    "add_fixes",
    "add_solution",
    "add_velocities",
    "diagonal",
    "from_frd",
    "from_ned",
]

GPS_EPOCH = 315_964_800 * 10**9
"""ns, of 1970 to 1980-01-06, where the weeks of GPS begin."""

QUALITY: Mapping[int, float] = {1: 2.5, 2: 1.0, 3: 2.5, 4: 0.02, 5: 0.3}
"""m, an axis, by the quality of NMEA: alone, differential, PPS, RTK fixed, RTK float."""


def from_frd(v: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of forward, right, down as forward, left, up."""
    return np.asarray(v) * (1.0, -1.0, -1.0)


def from_ned(v: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of north, east, down as east, north, up."""
    return np.asarray(v)[:, [1, 0, 2]] * (1.0, 1.0, -1.0)


def diagonal(deviations: np.ndarray) -> np.ndarray:
    """Covariances (n, 3, 3) of deviations (n, 3)."""
    return np.asarray(np.square(deviations)[:, :, None] * np.eye(3))


def add_fixes(
    made: Recording,
    place: str,
    time: np.ndarray,
    degrees: np.ndarray,
    covariance: np.ndarray,
    row: Callable[[int], str] | None = None,
    *,
    radians: np.ndarray | None = None,
) -> Series:
    """The stream `gps`: latitude and longitude in degrees and height in m (n, 3), and their covariance (n,
    3, 3) east, north, up, zeros where nothing is known of it; `radians` (n, 2) where they come so."""
    angles = np.radians(degrees[:, :2]) if radians is None else radians
    columns = {
        "latitude": angles[:, 0],
        "longitude": angles[:, 1],
        "height": degrees[:, 2],
        "covariance": covariance,
    }
    return made.add("gps", place, time, columns, GnssFix, row=row)


def add_solution(
    made: Recording,
    place: str,
    time: np.ndarray,
    places: np.ndarray,
    angles: np.ndarray,
    origin: tuple[float, ...],
    row: Callable[[int], str] | None,
) -> Series:
    """The truth: latitude and longitude (rad) and height (n, 3) about an origin of the same kind, and roll,
    pitch and yaw (n, 3, rad) of forward, right, down in north, east, down."""
    attitude = from_ned_attitude(from_angles(angles, "zyx"))
    latitude, longitude, height = origin
    made.info["origin"] = latitude, longitude, height
    pose = {"position": to_enu(places, (latitude, longitude, height)), "attitude": attitude}
    return made.add("truth", place, time, pose, Pose, row=row)


def add_velocities(
    made: Recording, place: str, time: np.ndarray, velocity: np.ndarray, covariance: np.ndarray
) -> Series:
    """The stream `gps_velocity` (n, 3), east, north, up; a component may be NaN. Rows without any are left
    out."""
    seen = np.isfinite(velocity).any(axis=1)
    later = np.ones(len(time), dtype=bool)
    later[1:] = np.diff(np.maximum.accumulate(time)) > 0
    seen &= later
    values = GnssVelocity(velocity=velocity[seen], covariance=covariance[seen])
    return made.take(Series(time[seen], values, name="gps_velocity", gaps=True), place)
