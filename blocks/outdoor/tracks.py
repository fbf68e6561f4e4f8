"""A run on the Earth, in forms that people take away: KML, GeoJSON and GPX, and a table in several frames.

A filter believes in metres of east, north and up about an origin. Here these become latitude, longitude and
height over the ellipsoid of WGS84 (not over the sea, which GPX readers may take it for), north, east, down
about the same origin, and Earth-centred coordinates. Tracks are thinned to ten points a second; the table has
every tick.

Sources: OGC 12-007r2 (KML 2.3); RFC 7946 (GeoJSON); Topografix, "GPX 1.1 schema", 2004.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Result, Series
from flowgraph.blocks.geometry.geodetic import from_enu, to_earth
from flowgraph.data.files import put
from flowgraph.drawing.trajectory import plot_map

__all__ = ["as_geojson", "as_gpx", "as_kml", "as_table", "track_files"]

Origin = tuple[float, float, float]

_STEP = 100_000_000  # ns
_ABSOLUTE = 946_684_800_000_000_000  # ns, the first second of 2000: stamps from then on are of a calendar


def _places(estimate: Series, origin: Origin) -> tuple[np.ndarray, list[tuple[float, float, float]]]:
    """Stamps (n,), and longitude and latitude in degrees with the height in m, thinned."""
    step = (estimate.time - estimate.time[0]) // _STEP
    kept = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    latitude, longitude, height = from_enu(estimate["position"][kept], origin).T
    places = np.stack([np.degrees(longitude), np.degrees(latitude), height], axis=-1)
    return estimate.time[kept], [(a, b, c) for a, b, c in places.tolist()]


def _when(time: int) -> str | None:
    """A stamp as ISO 8601 in UTC; None of a clock of its own."""
    if time < _ABSOLUTE:
        return None
    moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=time // 1000)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def as_geojson(estimate: Series, origin: Origin, name: str) -> str:
    """One feature, a line; coordinates are longitude, latitude (degrees) and height (m).

    Args:
        estimate: with `position` (3), m, east, north, up.
        origin: its latitude and longitude (rad) and height (m).
        name: of the track.
    """
    time, places = _places(estimate, origin)
    told: dict[str, Any] = {"name": name, "seconds": ((time - time[0]) * 1e-9).round(3).tolist()}
    if (begin := _when(int(time[0]))) is not None:
        told["begin"] = begin
    line = {
        "type": "LineString",
        "coordinates": [[round(a, 9), round(b, 9), round(c, 4)] for a, b, c in places],
    }
    feature = {"type": "Feature", "properties": told, "geometry": line}
    return json.dumps({"type": "FeatureCollection", "features": [feature]}, indent=1) + "\n"


def as_kml(estimate: Series, origin: Origin, name: str) -> str:
    """One placemark, a line at absolute heights; arguments as of `as_geojson`."""
    _, places = _places(estimate, origin)
    rows = "\n".join(f"          {a:.9f},{b:.9f},{c:.4f}" for a, b, c in places)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<kml xmlns="http://www.opengis.net/kml/2.2">
  <Document>
    <Placemark>
      <name>{_plain(name)}</name>
      <LineString>
        <altitudeMode>absolute</altitudeMode>
        <coordinates>
{rows}
        </coordinates>
      </LineString>
    </Placemark>
  </Document>
</kml>
"""


def as_gpx(estimate: Series, origin: Origin, name: str) -> str:
    """One track of one segment, with times where stamps are of a calendar; arguments as of `as_geojson`."""
    time, places = _places(estimate, origin)
    rows = []
    for stamp, (longitude, latitude, height) in zip(time.tolist(), places, strict=True):
        when = _when(stamp)
        told = "" if when is None else f"<time>{when}</time>"
        rows.append(
            f'   <trkpt lat="{latitude:.9f}" lon="{longitude:.9f}"><ele>{height:.4f}</ele>{told}</trkpt>'
        )
    lines = "\n".join(rows)
    return f"""<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="flowgraph" xmlns="http://www.topografix.com/GPX/1/1">
 <trk>
  <name>{_plain(name)}</name>
  <trkseg>
{lines}
  </trkseg>
 </trk>
</gpx>
"""


def _plain(name: str) -> str:
    return name.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


_HEAD = (
    "time [s]", "latitude [deg]", "longitude [deg]", "height [m]", "north [m]", "east [m]", "down [m]",
    "ecef_x [m]", "ecef_y [m]", "ecef_z [m]",
)  # fmt: skip


def as_table(estimate: Series, origin: Origin | None = None) -> str:
    """Every tick as a row of csv: geodetic, north-east-down about the origin, and Earth-centred; without an
    origin north-east-down alone."""
    enu = estimate["position"]
    numbers = np.stack([enu[:, 1], enu[:, 0], -enu[:, 2]], axis=-1)
    head: tuple[str, ...] = (_HEAD[0], *_HEAD[4:7])
    if origin is not None:
        geodetic, head = from_enu(enu, origin), _HEAD
        degrees = np.concatenate([np.degrees(geodetic[:, :2]), geodetic[:, 2:]], axis=1)
        numbers = np.concatenate([degrees, numbers, to_earth(geodetic)], axis=1)
    lines = [",".join(head)]
    for time, row in zip(estimate.time.tolist(), numbers.tolist(), strict=True):
        lines.append(f"{time // 10**9}.{time % 10**9:09d}," + ",".join(map(repr, row)))
    return "\n".join(lines) + "\n"


def _put(result: Result, file: Path, *, write: Callable[[Series], str], stream: str) -> None:
    put(file, write(result[stream]))


def _drawn(result: Result, file: Path, *, truth: Series | None, stream: str) -> None:
    plot_map(result[stream], truth, file)


def track_files(
    origin: Origin | None, name: str, truth: Series | None, stream: str = "belief"
) -> Mapping[str, Callable[[Result, Path], None]]:
    """What `--out` writes of a run outdoors, by the name of the file: the table, the map, and where the world
    has a place on the Earth the tracks."""

    found: dict[str, Callable[[Result, Path], None]] = {
        "map.png": partial(_drawn, truth=truth, stream=stream),
        "track.csv": partial(_put, write=partial(as_table, origin=origin), stream=stream),
    }
    if origin is not None:
        for ending, write in (("geojson", as_geojson), ("kml", as_kml), ("gpx", as_gpx)):
            found[f"track.{ending}"] = partial(
                _put, write=partial(write, origin=origin, name=name), stream=stream
            )
    return found
