"""A run on the Earth as KML, GeoJSON, GPX and a table: read back, they are where the run was."""

from __future__ import annotations

import csv
import io
import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.patches import ArrowStyle

from flowgraph import Series
from flowgraph.blocks.geometry.geodetic import to_earth, to_enu
from flowgraph.blocks.outdoor.tracks import as_geojson, as_gpx, as_kml, as_table, track_files
from flowgraph.blocks.signals import Position
from flowgraph.drawing.trajectory import plot_map
from tests.cli.test_cli import invoke

ORIGIN = (np.radians(47.4), np.radians(8.55), 420.0)
START = 1_700_000_000_000_000_000


def walk(begin: int = START) -> Series:
    """20 readings a second for two seconds, 3 m/s to the north-east and upwards."""
    t = np.arange(41)
    place = np.stack([2.0 * t, 1.0 * t, 0.2 * t], axis=-1) * 0.05
    return Series(begin + t * 50_000_000, Position(position=place), name="belief")


def enu(places: list[Any]) -> np.ndarray:
    """Of longitude, latitude in degrees and height."""
    table = np.array(places)
    return to_enu(np.stack([np.radians(table[:, 1]), np.radians(table[:, 0]), table[:, 2]], axis=-1), ORIGIN)


def test_geojson_and_kml_are_where_the_run_was():
    line = json.loads(as_geojson(walk(), ORIGIN, "a"))["features"][0]
    assert line["properties"]["begin"] == "2023-11-14T22:13:20.000Z"
    np.testing.assert_allclose(line["properties"]["seconds"], np.arange(21) * 0.1)
    np.testing.assert_allclose(enu(line["geometry"]["coordinates"]), walk()["position"][::2], atol=2e-4)
    root = ElementTree.fromstring(as_kml(walk(), ORIGIN, "a & <b>"))
    text = next(root.iter("{http://www.opengis.net/kml/2.2}coordinates")).text or ""
    rows = [tuple(map(float, row.split(","))) for row in text.split()]
    np.testing.assert_allclose(enu(rows), walk()["position"][::2], atol=2e-4)
    assert next(root.iter("{http://www.opengis.net/kml/2.2}name")).text == "a & <b>"


@pytest.mark.parametrize(("begin", "first"), [(START, "2023-11-14T22:13:20.000Z"), (5_000_000_000, None)])
def test_gpx_has_times_where_there_is_a_calendar(begin, first):
    space = "{http://www.topografix.com/GPX/1/1}"
    points = list(ElementTree.fromstring(as_gpx(walk(begin), ORIGIN, "a")).iter(f"{space}trkpt"))
    rows = [
        (float(p.attrib["lon"]), float(p.attrib["lat"]), float(p.findtext(f"{space}ele", ""))) for p in points
    ]
    np.testing.assert_allclose(enu(rows), walk()["position"][::2], atol=2e-4)
    assert points[0].findtext(f"{space}time") == first


def test_the_table_has_three_frames_at_every_tick():
    rows = list(csv.DictReader(io.StringIO(as_table(walk(), ORIGIN))))
    assert len(rows) == 41
    assert rows[1]["time [s]"] == "1700000000.050000000"
    last = {key: float(value) for key, value in rows[-1].items()}
    assert (last["north [m]"], last["east [m]"], last["down [m]"]) == pytest.approx((2.0, 4.0, -0.4))
    geodetic = [np.radians(last["latitude [deg]"]), np.radians(last["longitude [deg]"]), last["height [m]"]]
    np.testing.assert_allclose(to_enu(np.array(geodetic), ORIGIN), [4.0, 2.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(
        [last[f"ecef_{k} [m]"] for k in "xyz"], to_earth(np.array(geodetic)), atol=1e-6
    )


def test_a_map_has_a_scale_and_a_north(tmp_path: Path):
    figure = plot_map(walk(), None, tmp_path / "map.png")
    told = [text.get_text() for text in figure.axes[0].texts]
    assert told == ["1 m", "N"]
    north: Any = figure.axes[0].texts[-1]
    assert north.xy[1] > north.xyann[1]
    assert isinstance(north.arrow_patch.get_arrowstyle(), ArrowStyle.CurveB), "its head is where it points"
    assert (tmp_path / "map.png").stat().st_size > 5_000


def test_without_a_place_on_the_earth_there_are_a_map_and_a_table_of_metres():
    assert set(track_files(None, "a", None)) == {"map.png", "track.csv"}
    rows = list(csv.DictReader(io.StringIO(as_table(walk()))))
    assert set(rows[0]) == {"time [s]", "north [m]", "east [m]", "down [m]"}
    assert float(rows[-1]["east [m]"]) == pytest.approx(4.0)
    names = {"map.png", "track.geojson", "track.kml", "track.gpx", "track.csv"}
    assert set(track_files(ORIGIN, "a", None)) == names


def test_a_run_outdoors_writes_them(tmp_path: Path):
    given = ("gnss_ins", "--data", "sim:drive", "--set", "duration=3", "--engine", "reference")
    done = invoke("run", *given, "--out", str(tmp_path))
    assert done.exit_code == 0, done.output
    assert {"map.png", "track.kml", "track.gpx", "track.geojson", "track.csv"} <= {
        f.name for f in tmp_path.iterdir()
    }
