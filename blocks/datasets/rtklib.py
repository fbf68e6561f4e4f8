"""Solutions of RTKLIB, `.pos`: positions with their covariance, and perhaps velocities, a row an epoch.

    %  GPST  latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s)
    ratio

Times are dates or weeks and seconds, of GPS time or UTC; the file says which, and a note does. The square of
a mixed deviation with its sign is a covariance. Solutions in other coordinates than latitude and longitude
are refused.

Source: T. Takasu, RTKLIB ver. 2.4.2 Manual, app. B.1.
"""

from __future__ import annotations

import datetime
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.places import add_fixes, add_velocities, diagonal
from flowgraph.blocks.datasets.shape import Recording, known, policy, stream_settings, the_file
from flowgraph.blocks.datasets.stamps import POLICIES
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["SETTINGS", "load"]

SETTINGS: Mapping[str, str] = {
    **stream_settings("gps", "gps_velocity"),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

_WEEKS = 315_964_800  # s, of 1970 to 1980-01-06


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams `gps` (`GnssFix`) and, where the file has velocities, `gps_velocity` (`GnssVelocity`).

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Raises:
        DataError: the file is missing, in other coordinates, has no row, or a row that is malformed (line).
        UnknownNameError: for a setting.
    """
    given = dict(settings or {})
    known(given, SETTINGS, "rtklib")
    file = the_file(argument, kind="rtklib", what="solution of RTKLIB", endings=(".pos",))
    text = file.read_text(errors="replace").splitlines()
    head = next((line for line in text if line.startswith("%") and "Q" in line.split()), "")
    if "latitude(deg)" not in head:
        raise DataError(
            "this solution is not in latitude and longitude",
            path=str(file),
            expected="a head with latitude(deg) longitude(deg) height(m)",
            got=head.strip("% ")[:80] or "no head",
            fix="write solutions as Lat/Lon/Height in degrees (out-solformat =llh, out-degform =deg)",
        )
    clock = head.strip("% ").split()[0]
    rows: list[list[float]] = []
    time: list[int] = []
    lines: list[int] = []
    for number, line in enumerate(text, start=1):
        if line.startswith("%") or not line.strip():
            continue
        cells = line.replace(",", " ").split()
        try:
            time.append(_stamp(cells[0], cells[1]))
            rows.append([float(c) for c in cells[2:]])
            if len(rows[-1]) < 11 or len(rows[-1]) != len(rows[0]):
                raise ValueError
        except (ValueError, IndexError, InvalidOperation):
            raise DataError(
                "this is no row of a solution",
                path=f"{file}, line {number}",
                expected="a time, latitude, longitude, height, Q, ns and six deviations",
                got=line.strip()[:80],
                fix="mend or delete the row",
            ) from None
        lines.append(number)
    if not rows:
        raise DataError(
            "this solution has no position",
            path=str(file),
            expected="a row an epoch",
            got="a head alone",
            fix="choose another file",
        )
    made = Recording(file.stem, policy(given, "rtklib"), kind="rtklib", given=given, place=str(file))
    made.notes.append(note("info", f"stamps are of {clock}"))
    x = np.array(rows)
    n, e, u, ne, eu, un = x[:, 5:11].T
    signed = lambda s: np.sign(s) * s**2
    P = diagonal(np.stack([e, n, u], axis=-1))
    for (a, b), s in {(0, 1): ne, (0, 2): eu, (1, 2): un}.items():
        P[:, a, b] = P[:, b, a] = signed(s)
    stamps = np.array(time, dtype=np.int64)
    add_fixes(made, str(file), stamps, x[:, :3], P, lambda k: f"{file}, line {lines[k]}")
    if "vn(m/s)" in head and x.shape[1] >= 19:
        velocity = x[:, [14, 13, 15]]
        deviations = x[:, [17, 16, 18]]
        add_velocities(made, str(file), stamps, velocity, diagonal(deviations))
    return made.flight()


def _stamp(one: str, two: str) -> int:
    """ns of a date and a time, or of a week and its seconds."""
    if "/" in one:
        day = datetime.datetime.strptime(one, "%Y/%m/%d").date()
        hours, minutes, seconds = two.split(":")
        whole = (day - datetime.date(1970, 1, 1)).days * 86_400 + int(hours) * 3600 + int(minutes) * 60
        return whole * 10**9 + round(Decimal(seconds) * 10**9)
    return (_WEEKS + int(one) * 604_800) * 10**9 + round(Decimal(two) * 10**9)
