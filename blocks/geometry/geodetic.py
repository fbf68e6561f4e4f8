"""Places on the Earth: latitude, longitude and height to east, north, up, and back.

The ellipsoid is that of WGS84. East, north and up are a Cartesian frame at an origin on it: x, y and z of our
world. Through Earth-centred coordinates, so both ways are exact at any distance.

Source: B. Hofmann-Wellenhof, H. Lichtenegger, J. Collins, "GPS: theory and practice", 5th ed., secs.
10.2-10.3 and, for the way back, B. Bowring, "Transformation from spatial to geographical coordinates", Survey
Review 1976.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.signals import GeodeticPosition, Position

__all__ = ["SEMI_MAJOR_AXIS", "FLATTENING", "as_geodetic", "as_position", "from_enu", "to_earth", "to_enu"]

SEMI_MAJOR_AXIS = 6378137.0
"""m, WGS84."""

FLATTENING = 1.0 / 298.257223563
"""WGS84."""

_E2 = FLATTENING * (2.0 - FLATTENING)  # first eccentricity squared


def to_enu(geodetic: np.ndarray, origin: tuple[float, float, float]) -> np.ndarray:
    """East, north, up (..., 3) in m, from latitude (rad), longitude (rad), height (m) (..., 3) and the
    origin's."""
    start = to_earth(np.array(origin, dtype=float))
    return np.asarray((to_earth(np.asarray(geodetic, dtype=float)) - start) @ _axes(origin).T)


def from_enu(enu: Array, origin: tuple[float, float, float], *, xp: Any = np) -> Array:
    """Latitude (rad), longitude (rad), height (m) (..., 3), from east, north, up (..., 3) in m and the
    origin's.

    Exact to the precision of the numbers (below a micrometre) from 50 km under the ellipsoid upwards.
    """
    earth = to_earth(np.array(origin, dtype=float)) + xp.asarray(enu) @ _axes(origin)
    x, y, z = (earth[..., k] for k in range(3))
    across = xp.hypot(x, y)
    b = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    sine, cosine = SEMI_MAJOR_AXIS * z, b * across  # of the reduced latitude
    for _ in range(4):  # each step gains six digits
        size = xp.hypot(sine, cosine)
        s, c = sine / size, cosine / size
        up = z + _E2 / (1.0 - _E2) * b * s**3
        out = across - _E2 * SEMI_MAJOR_AXIS * c**3
        sine, cosine = (1.0 - FLATTENING) * up, out
    latitude = xp.atan2(up, out)
    s, c = xp.sin(latitude), xp.cos(latitude)
    # free of singularities: along the normal, less the distance of the ellipsoid there
    height = across * c + z * s - SEMI_MAJOR_AXIS * xp.sqrt(1.0 - _E2 * s**2)
    return xp.stack([latitude, xp.atan2(y, x), height], axis=-1)


def as_geodetic(position: Series, origin: tuple[float, float, float]) -> Series:
    """A series of `Position` (east, north, up) as `GeodeticPosition`."""
    latitude, longitude, height = from_enu(position["position"], origin).T
    values = GeodeticPosition(latitude=latitude, longitude=longitude, height=height)
    return Series(position.time, values, name=position.name)


def as_position(geodetic: Series, origin: tuple[float, float, float]) -> Series:
    """A series of `GeodeticPosition`, as a receiver gives it, as `Position` (east, north, up)."""
    places = np.stack([geodetic[n] for n in ("latitude", "longitude", "height")], axis=-1)
    return Series(geodetic.time, Position(position=to_enu(places, origin)), name=geodetic.name)


def to_earth(geodetic: np.ndarray) -> np.ndarray:
    """Earth-centred, Earth-fixed coordinates (..., 3), m."""
    latitude, longitude, height = np.moveaxis(geodetic, -1, 0)
    s, c = np.sin(latitude), np.cos(latitude)
    normal = SEMI_MAJOR_AXIS / np.sqrt(1.0 - _E2 * s**2)
    out = (normal + height) * c
    return np.stack(
        [out * np.cos(longitude), out * np.sin(longitude), (normal * (1.0 - _E2) + height) * s], -1
    )


def _axes(origin: tuple[float, float, float]) -> np.ndarray:
    """East, north and up at the origin, in Earth-fixed coordinates, as rows."""
    (s, c), (sl, cl) = ((np.sin(a), np.cos(a)) for a in origin[:2])
    return np.array([[-sl, cl, 0.0], [-s * cl, -s * sl, c], [c * cl, c * sl, s]])
