"""What of a stream has a place: poses, points and turns in space, and fixes on the Earth.

A viewer of robots draws a frame where there is a `position` in metres and an `attitude`, and a dot on a map
where there are `latitude` and `longitude`. Rows that are not finite have no place, and are counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.data.series import Series
from flowgraph.types import leaves_of


@dataclass(frozen=True)
class Placed:
    """Where something was, in space.

    Args:
        rows: (n,) places in the series; those that are not finite are not among them.
        frame: that the position is in.
        position: (n, 3) m, or None where there is only a turn.
        attitude: (n, 4), w first, body to `frame`, or None where there is only a point.
        lacking: how many rows are not finite.
    """

    rows: np.ndarray
    frame: str
    position: np.ndarray | None
    attitude: np.ndarray | None
    lacking: int


@dataclass(frozen=True)
class Fixes:
    """Where something was, on the Earth.

    Args:
        rows: as of `Placed`.
        latitude, longitude: (n,) rad.
        height: (n,) m above the ellipsoid; zeros where there is none.
        covariance: (n, 3, 3) m^2 east, north, up, or None.
        lacking: as of `Placed`.
    """

    rows: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    height: np.ndarray
    covariance: np.ndarray | None
    lacking: int


def placed(series: Series) -> Placed | None:
    """The poses, points or turns of a stream; None where it has none.

    Fields are `position`, (2,) or (3,) in m or without a unit, and `attitude`, (4,). A position in a plane
    has height 0.
    """
    types = dict(leaves_of(series.type))
    position = attitude = None
    frame = "world"
    where = types.get("position")
    if where is not None and where.shape in ((2,), (3,)) and where.unit in (None, "m"):
        position = np.zeros((len(series), 3))
        position[:, : where.shape[0]] = series.leaves["position"]
        frame = where.frame or frame
    turn = types.get("attitude")
    if turn is not None and turn.shape == (4,):
        attitude = series.leaves["attitude"].astype(np.float64)
        frame = frame if where is not None else (turn.frame or frame).partition("<-")[0]
    parts = [part for part in (position, attitude) if part is not None]
    if not parts:
        return None
    rows = _finite(parts)
    position, attitude = (None if part is None else part[rows] for part in (position, attitude))
    return Placed(rows, frame, position, attitude, len(series) - len(rows))


def fixes(series: Series) -> Fixes | None:
    """The fixes of a stream, with fields `latitude` and `longitude` in rad; None where it has none."""
    types, leaves = dict(leaves_of(series.type)), series.leaves
    for name in ("latitude", "longitude"):
        if name not in types or types[name].shape != () or types[name].unit != "rad":
            return None
    latitude, longitude = leaves["latitude"], leaves["longitude"]
    height = leaves["height"] if "height" in types and types["height"].shape == () else np.zeros(len(series))
    rows = _finite([latitude, longitude, height])
    covariance = None
    if "covariance" in types and types["covariance"].shape == (3, 3):
        covariance = leaves["covariance"][rows]
    return Fixes(rows, latitude[rows], longitude[rows], height[rows], covariance, len(series) - len(rows))


def _finite(parts: list[np.ndarray]) -> np.ndarray:
    good = np.ones(len(parts[0]), bool)
    for part in parts:
        good &= np.isfinite(part).reshape(len(part), -1).all(axis=1)
    return np.flatnonzero(good)


__all__ = ["Fixes", "Placed", "fixes", "placed"]
