"""What a receiver of satellites writes as text: sentences of NMEA 0183, in any order, of any talker.

    $GNGGA  time, latitude, longitude, quality, satellites, HDOP, height above the sea, the sea above the
    ellipsoid $GNRMC  time, status, latitude, longitude, speed in knots, course in degrees, date

Of each epoch the position is that of GGA, with the height above the ellipsoid, and the velocity over the
ground that of RMC. A position's deviation is that of its quality (`QUALITY`). Only RMC knows the date:
without one stamps are seconds of a day that is not known. Sentences with a wrong checksum and positions
without a fix are left out and counted.

Source: NMEA 0183, by way of pynmea2.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.places import QUALITY, add_fixes, add_velocities, diagonal
from flowgraph.blocks.datasets.shape import Recording, known, policy, stream_settings, the_file
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.data.notes import note
from flowgraph.errors import DataError, MissingDependencyError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    **stream_settings("gps", "gps_velocity"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

_KNOT = 1852.0 / 3600.0
_DAY = 86_400 * 10**9


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams `gps` (`GnssFix`) and, where there is RMC, `gps_velocity` (`GnssVelocity`).

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing, or has no position. MissingDependencyError: without pynmea2.
        UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "nmea")
    file = the_file(argument, kind="nmea", what="file of NMEA sentences")
    try:
        import pynmea2  # optional
    except ImportError:
        raise MissingDependencyError(
            "NMEA needs the pynmea2 library",
            path=str(file),
            expected="the Python package pynmea2",
            got="it cannot be imported",
            fix='pip install "flowgraph-filters[nmea]"',
        ) from None
    made = Recording(file.stem, policy(given, "nmea"), kind="nmea", given=given, place=str(file))
    fixes: list[tuple[int, float, float, float, float]] = []
    lines: list[int] = []
    speeds: list[tuple[int, float, float]] = []
    day: int | None = None
    dated, broken, lost, last = False, 0, 0, -1
    for number, line in enumerate(file.read_text(errors="replace").splitlines(), start=1):
        if "$" not in line:
            continue
        try:
            said = pynmea2.parse(line[line.index("$") :].strip(), check=True)
        except (pynmea2.ParseError, ValueError):
            broken += 1
            continue
        kind = getattr(said, "sentence_type", "")
        if kind not in ("GGA", "RMC") or not isinstance(said.timestamp, datetime.time):
            continue
        since = _since_midnight(said.timestamp)
        if kind == "RMC" and isinstance(said.datestamp, datetime.date):
            day = (said.datestamp - datetime.date(1970, 1, 1)).days * _DAY
            dated = True
        elif since < last - _DAY // 2 and day is not None:
            day += _DAY
        last = since
        stamp = since + (day or 0)
        if kind == "RMC":
            if said.status == "A" and said.spd_over_grnd is not None and said.true_course is not None:
                course, speed = np.radians(float(said.true_course)), float(said.spd_over_grnd) * _KNOT
                speeds.append((stamp, speed * np.sin(course), speed * np.cos(course)))
        elif int(said.gps_qual or 0) not in QUALITY:
            lost += 1
        else:
            up = float(said.altitude or np.nan) + float(said.geo_sep or 0.0)
            fixes.append((stamp, said.latitude, said.longitude, up, QUALITY[int(said.gps_qual)]))
            lines.append(number)
    _say(made, broken, lost, dated, file.name)
    if not fixes:
        raise DataError(
            "this file has no position",
            path=str(file),
            expected="GGA sentences with a fix",
            got=f"{lost} without, and {broken} sentences that are broken",
            fix="choose another file",
        )
    table = np.array(fixes)
    time = np.array([f[0] for f in fixes], dtype=np.int64)
    row = lambda k: f"{file}, line {lines[k]}"
    add_fixes(made, str(file), time, table[:, 1:4], diagonal(table[:, 4:5] * (1.0, 1.0, 2.0)), row)
    if speeds:
        velocity = np.array([[e, n, np.nan] for _, e, n in speeds])
        stamps = np.array([s[0] for s in speeds], dtype=np.int64)
        noise = diagonal(np.full((len(speeds), 3), 0.2))
        add_velocities(made, str(file), stamps, velocity, noise)
    return made.flight()


def _since_midnight(at: datetime.time) -> int:
    return ((at.hour * 60 + at.minute) * 60 + at.second) * 10**9 + at.microsecond * 1000


def _say(made: Recording, broken: int, lost: int, dated: bool, name: str) -> None:
    if broken:
        made.notes.append(note("skipped", f"{name}: {broken} sentences that are broken"))
    if lost:
        made.notes.append(note("skipped", f"{name}: {lost} positions without a fix"))
    if not dated:
        made.notes.append(note("assumed", f"{name}: no RMC tells the date: stamps are of an unknown day"))
    made.notes.append(note("assumed", "gps: deviations by the quality of a fix, m: " + ", ".join(
        f"{q}={d:g}" for q, d in QUALITY.items()) + "; twice as much upwards"))  # fmt: skip
