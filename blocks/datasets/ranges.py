"""What numbers can be: the unit of a field, the range of a geodetic position, and digits that are not there.

A reading in g, a latitude in degrees that was said to be in radians, a motion capture in millimetres: each
is a column of good numbers. They are told by what they would mean, and refused where they cannot be meant,
or named in a note where they hardly are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.errors import DataError

__all__ = ["PLAUSIBLE", "doubtful", "geodetic", "plausible", "upright"]

PLAUSIBLE: Mapping[str, tuple[float, float, str, str]] = {
    "specific_force": (2.0, 100.0, "m/s^2", "9.81 at rest; in g it is 1"),
    "gyro": (0.0, 40.0, "rad/s", "2000 deg/s, as fast as most units go, is 35 rad/s"),
    "field": (5e-6, 5e-4, "T", "the Earth's is 25e-6 to 65e-6"),
}
"""Between what a median length must lie, of which unit, and why."""

_GRAVITY = (7.0, 14.0)  # m/s^2; the median of what is carried by the ground or by air
_SPEED = 100.0  # m/s; the median step of positions
_HEIGHT = (-500.0, 1e5)  # m
_FAR = 1e5  # m; beyond, single precision resolves no better than 8 mm


def plausible(field: str, values: np.ndarray, place: str, fix: str = "convert the file to SI units") -> None:
    """Refuse values that cannot be of the unit that a field has.

    Raises:
        DataError: naming the unit.
    """
    if field not in PLAUSIBLE or not len(values):
        return
    least, most, unit, why = PLAUSIBLE[field]
    middle = float(np.nanmedian(np.linalg.norm(values, axis=-1)))
    if not least <= middle <= most:
        raise DataError(
            "these values are not in the unit they should be in",
            path=place,
            expected=f"{unit}, with a median length from {least:g} to {most:g} ({why})",
            got=f"a median length of {middle:.4g}"
            + (", as where gravity was taken out" if field == "specific_force" and middle < 0.5 else ""),
            fix=fix,
        )


def geodetic(
    name: str,
    parts: Mapping[str, np.ndarray],
    row: Callable[[int], str],
    fix: Callable[[str], str],
) -> tuple[dict[str, np.ndarray], list[str]]:
    """Latitudes and longitudes (rad) and heights (m) within their ranges, and notes.

    Longitudes from half a turn to a whole one are taken round; a position of exactly 0, 0 is none, and
    becomes NaN.

    Args:
        name: of the stream.
        parts: by field: (n,) or (n, 1).
        row: what to call row k in a message.
        fix: of a field, what to do where its unit is another.

    Raises:
        DataError: for a latitude beyond a quarter turn, or a longitude beyond a whole one.
    """
    found = dict(parts)
    notes = []
    for field, most in (("latitude", np.pi / 2.0), ("longitude", 2.0 * np.pi)):
        values = np.ravel(found[field])
        off = np.flatnonzero(np.abs(values) > most * (1.0 + 1e-9))
        if not len(off):
            continue
        value = float(values[off[0]])
        by = {"degrees": 1.0, "1e-7 degrees": 1e-7}
        meant = next(
            (f"; as {w} it could be" for w, s in by.items() if abs(value) * s <= most * 180.0 / np.pi), ""
        )
        other = np.ravel(found["longitude"])
        swapped = (
            field == "latitude" and np.pi / 2.0 < abs(value) <= np.pi and np.abs(other[off[0]]) <= np.pi / 2.0
        )
        raise DataError(
            f"no {field} is {value:.6g} rad",
            path=row(int(off[0])),
            expected=f"{field}s of at most {most:.4f} rad ({most * 180.0 / np.pi:.0f} deg) either way",
            got=f"{value:.6g} rad ({value * 180.0 / np.pi:.6g} deg)"
            + ("; latitude and longitude may be exchanged" if swapped else meant),
            fix="check the columns" if swapped else fix(field),
        )
    latitude, longitude = np.ravel(found["latitude"]), np.ravel(found["longitude"])
    nowhere = (latitude == 0.0) & (longitude == 0.0)
    if nowhere.any():
        notes.append(
            note("skipped", f"{name}: {int(nowhere.sum())} of {len(latitude)} rows at 0, 0 hold no fix")
        )
        for field, values in found.items():
            found[field] = np.where(nowhere.reshape(np.shape(values)), np.nan, values)
    beyond = np.abs(longitude) > np.pi
    if beyond.any():
        notes.append(
            note("info", f"{name}: {int(beyond.sum())} longitudes beyond half a turn taken round by one")
        )
        turned = np.where(beyond, longitude - np.sign(longitude) * 2.0 * np.pi, longitude)
        found["longitude"] = turned.reshape(np.shape(found["longitude"]))
    known = ~nowhere & np.isfinite(latitude) & np.isfinite(longitude)
    if known.any():
        if (
            np.abs(latitude[known]).max() < np.pi**2 / 360.0
            and np.abs(longitude[known]).max() < np.pi**2 / 180.0
        ):
            notes.append(
                note("warning", f"{name}: all positions lie within 2 deg of 0, 0: radians taken for degrees?")
            )
        degrees = {"latitude": latitude[known], "longitude": longitude[known]}
        notes += _single(name, {field: values * (180.0 / np.pi) for field, values in degrees.items()})
    return found, notes


def _single(name: str, degrees: Mapping[str, np.ndarray]) -> list[str]:
    """A note where degrees hold no more than single precision does."""
    said = []
    for field, values in degrees.items():
        if len(np.unique(values)) < 5:
            continue
        coarse = values.astype(np.float32).astype(float)
        if np.allclose(values, coarse, rtol=1e-9, atol=0.0):
            step = float(np.spacing(np.float32(np.abs(values).max()))) * 111e3
            said.append(
                note(
                    "warning", f"{name}: {field} holds single precision, steps of {step:.2g} m on the ground"
                )
            )
    return said


def doubtful(name: str, time: np.ndarray, parts: Mapping[str, np.ndarray]) -> list[str]:
    """Notes on values (n, k) by field that can be, and hardly are."""
    notes = []
    if "specific_force" in parts:
        middle = float(np.nanmedian(np.linalg.norm(parts["specific_force"], axis=-1)))
        if not _GRAVITY[0] <= middle <= _GRAVITY[1]:
            sentence = (
                f"{name}: the median specific force is {middle:.3g} m/s^2, and 9.81 at rest: check its scale"
            )
            notes.append(note("warning", sentence))
        nothing = int(sum((np.hstack([parts[f] for f in parts]) == 0.0).all(axis=1)))
        if nothing:
            notes.append(
                note(
                    "warning",
                    f"{name}: {nothing} rows read 0 in all columns; {name}.lost=absent leaves them out",
                )
            )
    if "height" in parts:
        heights = np.ravel(parts["height"])
        if np.nanmin(heights) < _HEIGHT[0] or np.nanmax(heights) > _HEIGHT[1]:
            span = f"{np.nanmin(heights):.4g} m to {np.nanmax(heights):.4g} m"
            notes.append(note("warning", f"{name}: heights of {span}: check their unit"))
    if "position" in parts and parts["position"].ndim == 2 and len(time) > 2:
        notes += _placed(name, time, parts["position"], alone="attitude" not in parts)
    return notes


def _placed(name: str, time: np.ndarray, position: np.ndarray, alone: bool) -> list[str]:
    notes = []
    step = np.linalg.norm(np.diff(position, axis=0), axis=-1) / (np.diff(time) / 1e9)
    speed = float(np.nanmedian(step)) if np.isfinite(step).any() else 0.0
    if speed > _SPEED:
        notes.append(
            note("warning", f"{name}: the median speed from row to row is {speed:.3g} m/s: are these metres?")
        )
    far = float(np.nanmax(np.abs(position)))
    if far > _FAR:
        coarse = float(np.spacing(np.float32(far)))
        held = np.isclose(position, position.astype(np.float32), rtol=1e-10, atol=0.0, equal_nan=True)
        sentence = (
            f"{name}: positions reach {far:.3g} m, where single precision has steps of {1e3 * coarse:.3g} mm"
        )
        sentence += ", and hold no more" if held.all() else "; take an origin near the flight"
        notes.append(note("warning", sentence))
    nothing = (position == 0.0).all(axis=1)
    if alone and 2 < nothing.sum() < len(nothing) and nothing[1:-1].any() and not nothing[:2].all():
        sentence = f"{name}: {int(nothing.sum())} of {len(nothing)} positions are exactly 0, 0, 0"
        notes.append(note("warning", f"{sentence}; {name}.lost=absent leaves them out"))
    return notes


def upright(imu: Series, poses: Series, name: str) -> list[str]:
    """Notes where attitudes do not turn what is read upwards, or not as fast as the gyroscope says.

    Over a flight the specific force is gravity's in the mean. Where the attitudes turn it elsewhere, their
    quaternions are in another order, or the accelerometer's axes or sign are others.
    """
    known = np.flatnonzero(np.isfinite(poses["attitude"]).all(axis=1))
    inside = known[(poses.time[known] >= imu.time[0]) & (poses.time[known] <= imu.time[-1])]
    if len(inside) < 10:
        return []
    notes = []
    chosen = inside[:: max(len(inside) // 500, 1)]
    rows = np.searchsorted(imu.time, poses.time[chosen]).clip(0, len(imu) - 1)
    q = poses["attitude"][chosen]
    w, v = q[:, :1], q[:, 1:]
    force = imu["specific_force"][rows]
    across = 2.0 * np.cross(v, force)
    up = (force + w * across + np.cross(v, across)).mean(axis=0)
    length = float(np.linalg.norm(up))
    if (length > 4.0 and up[2] < 0.5 * length) or length < 4.0:
        where = ", ".join(f"{x:.3g}" for x in up)
        sentence = f"{name}: its attitudes turn the mean specific force to ({where}) m/s^2, not upwards"
        notes.append(
            note("warning", f"{sentence}: check the order of the quaternion and the axes of the imu")
        )
    if "gyro" in imu.leaves and len(inside) > 2:
        near, far = poses["attitude"][inside[:-1]], poses["attitude"][inside[1:]]
        half = np.arccos(np.abs(np.sum(near * far, axis=1)).clip(0.0, 1.0))
        spun = float(np.sum(2.0 * half))
        passed = np.linalg.norm(imu["gyro"], axis=1)
        steps = np.diff(imu.time) / 1e9
        between = (imu.time[:-1] >= poses.time[inside[0]]) & (imu.time[:-1] <= poses.time[inside[-1]])
        read = float(np.sum((passed[:-1] * steps)[between]))
        if spun > 0.5 and read > 20.0 * spun:
            sentence = (
                f"imu: its gyroscope turns by {read:.3g} rad while {name} turns by {spun:.3g}: in deg/s?"
            )
            notes.append(note("warning", sentence))
        elif read > 0.5 and spun > 20.0 * read:
            sentence = (
                f"imu: its gyroscope turns by {read:.3g} rad while {name} turns by {spun:.3g}: in turns/s?"
            )
            notes.append(note("warning", sentence))
    return notes
