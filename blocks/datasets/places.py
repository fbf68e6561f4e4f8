"""What files of satellites share: fixes with their covariance, axes of aircraft, and what a fix quality is
worth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from flowgraph import Series
from flowgraph.blocks.datasets.shape import Recording
from flowgraph.blocks.signals import GnssFix, GnssVelocity

__all__ = ["QUALITY", "add_fixes", "add_velocities", "diagonal", "from_frd", "from_ned"]

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
    made: Recording, place: str, time: np.ndarray, degrees: np.ndarray, covariance: np.ndarray, row=None
) -> Series:  # type: ignore[no-untyped-def]
    """The stream `gps`: latitude and longitude in degrees and height in m (n, 3), and their covariance (n,
    3, 3) east, north, up, zeros where nothing is known of it."""
    columns = {
        "latitude": np.radians(degrees[:, 0]),
        "longitude": np.radians(degrees[:, 1]),
        "height": degrees[:, 2],
        "covariance": covariance,
    }
    return made.add("gps", place, time, columns, GnssFix, row=row)


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
