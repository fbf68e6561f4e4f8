"""What files of satellites share: fixes with their covariance, axes of aircraft, and what a fix quality is
worth."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flowgraph import Series
from flowgraph.blocks.datasets.shape import NOISE_SETTINGS, Recording, stream_settings
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.blocks.datasets.turns import from_angles, from_ned_attitude
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.signals import GnssFix, GnssVelocity, Pose
from flowgraph.errors import DataError

__all__ = [
    "GPS_EPOCH",
    "NAVIGATION_SETTINGS",
    "QUALITY",
    "add_fixes",
    "add_solution",
    "add_velocities",
    "diagonal",
    "from_frd",
    "from_ned",
    "height_of_pressure",
]

GPS_EPOCH = 315_964_800 * 10**9
"""ns, of 1970 to 1980-01-06, where the weeks of GPS begin."""

NAVIGATION_SETTINGS: Mapping[str, str] = {
    **NOISE_SETTINGS,
    **stream_settings("imu", "gps", "gps_velocity", "truth"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""Of a recording of a unit and satellites with a solution, and what they mean."""

QUALITY: Mapping[int, float] = {1: 2.5, 2: 1.0, 3: 2.5, 4: 0.02, 5: 0.3}
"""m, an axis, by the quality of NMEA: alone, differential, PPS, RTK fixed, RTK float."""


def from_frd(v: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of forward, right, down as forward, left, up."""
    return np.asarray(v) * (1.0, -1.0, -1.0)


def from_ned(v: np.ndarray) -> np.ndarray:
    """Vectors (n, 3) of north, east, down as east, north, up."""
    return np.asarray(v)[:, [1, 0, 2]] * (1.0, 1.0, -1.0)


def height_of_pressure(pressure: np.ndarray, where: Callable[[int], str]) -> np.ndarray:
    """Heights (n,) m of pressures (n,) Pa in the standard atmosphere, above where it is 101,325 Pa:

        h = T0/L (1 - (p/p0)^(R L/(g M)))      T0 = 288.15 K, L = 6.5 K/km, R L/(g M) = 0.190263

    which holds up to 11 km. The weather moves that level by some hundred metres, so that differences count;
    as far as the air is warmer than the standard's, by 1 % in 3 K, they are too small.

    Args:
        where: what to call row k in a message.

    Raises:
        DataError: for a pressure that is none of that air.

    Source: ISO 2533:1975, Standard atmosphere, eq. 12 (ICAO Doc 7488/3).
    """
    off = np.flatnonzero((pressure < 22_632.0) | (pressure > 120_000.0))
    if len(off):
        value = float(pressure[off[0]])
        raise DataError(
            "this is no pressure of the air up to 11 km",
            path=where(int(off[0])),
            expected="from 22,632 to 120,000 Pa",
            got=f"{value:.6g} Pa",
            fix="say its unit with barometer.pressure.unit=hPa, or check the column",
        )
    return np.asarray(288.15 / 0.0065 * (1.0 - (pressure / 101_325.0) ** 0.190263))


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
