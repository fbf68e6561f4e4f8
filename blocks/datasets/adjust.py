"""What a setting can do to a stream of any recording: shift its clock, thin it, turn it, and pass over rows.

vicon.time_offset=-0.12     s, added to the stamps
imu.mount=0,0,90            rotation vector in degrees that turns the sensor's axes into the body's
vicon.lever=0.1,0,0.05      m, where the sensor sits in the body
imu.every=0.01              s, one reading of each
vicon.lost=absent           rows of all zeros, as a motion capture writes them that lost the body
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph.blocks.datasets.settings import MOST_OFFSET, chosen, number, offset
from flowgraph.blocks.geometry.rotations import conjugate, multiply, rotate
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = [
    "LOST",
    "MEANT",
    "TURNED",
    "Adjustment",
    "adjustment",
    "check_settings",
    "lost_rows",
    "shifted",
    "stream_settings",
    "thinned",
    "three_numbers",
    "turned",
]

LOST = ("raise", "absent", "repeated")
"""What to do with rows of zeros: refuse those that are no attitude; leave all out; and also those that repeat
the row before, as some systems write while they do not see the body."""

MEANT = {
    "time_offset": "s, added to the stamps",
    "every": "s, thins it: one sample of each",
    "lost": "rows of a lost body: " + ", ".join(LOST),
    "lever": "where it sits in the body: three numbers, m",
    "mount": "how it is turned in the body: rotation vector, three numbers, degrees",
}
"""The settings of a stream and what they mean."""

TURNED = ("attitude", "gyro", "rate", "specific_force", "force", "field")
"""The fields that are of a sensor's axes."""


def stream_settings(*streams: str, only: Iterable[str] = MEANT) -> dict[str, str]:
    """The settings of streams of these names, all or some; a stream "STREAM" stands for any."""
    return {f"{stream}.{name}": MEANT[name] for stream in streams for name in only}


@dataclass(frozen=True)
class Adjustment:
    """What the settings of a stream say.

    Args:
        shift: ns, added to the stamps.
        every: ns; 0 keeps all.
        lost: one of `LOST`.
        lever: m, body; None where nothing is said.
        mount: quaternion, sensor to body; None where nothing is said.
    """

    shift: int
    every: int
    lost: str
    lever: tuple[float, ...] | None
    mount: np.ndarray | None


def adjustment(given: Mapping[str, Any], name: str, path: str) -> Adjustment:
    """The settings of the stream `name`.

    Raises:
        DeclarationError: for one that is not usable. UnknownNameError: for another way with lost rows.
    """
    turn = three_numbers(given, f"{name}.mount", path)
    mount = None
    if turn is not None:
        turned = scipy.spatial.transform.Rotation.from_rotvec(turn, degrees=True)
        x, y, z, w = turned.as_quat(canonical=True).tolist()
        mount = np.array([w, x, y, z])
    return Adjustment(
        shift=offset(given, f"{name}.time_offset", path),
        every=round(1e9 * number(given, f"{name}.every", 0.0, path)),
        lost=chosen({"lost": given[f"{name}.lost"]} if f"{name}.lost" in given else {}, "lost", LOST, path),
        lever=three_numbers(given, f"{name}.lever", path),
        mount=mount,
    )


def check_settings(given: Mapping[str, Any], path: str) -> None:
    """Refuse settings of streams that are not usable, before any file is opened.

    Raises:
        DeclarationError, UnknownNameError: as `adjustment`.
    """
    for setting in given:
        stream, _, what = str(setting).rpartition(".")
        if stream and what in MEANT:
            adjustment(given, stream, path)


def three_numbers(given: Mapping[str, Any], name: str, path: str) -> tuple[float, ...] | None:
    """The setting `name`, three numbers with commas between; None where it is left out.

    Raises:
        DeclarationError: where it is something else.
    """
    if name not in given:
        return None
    value = given[name]
    try:
        parts = value.split(",") if isinstance(value, str) else list(value)
        found = tuple(float(part) for part in parts)
        if len(found) != 3 or not np.abs(found).max() < 1e6 or "_" in str(value):
            raise ValueError
    except (TypeError, ValueError):
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected="three numbers, comma-separated",
            got=repr(value),
            fix=f"for example {name}=0,0,90" if name.endswith("mount") else f"for example {name}=0.1,0,0.05",
        ) from None
    return found


def shifted(name: str, place: str, time: np.ndarray, shift: int) -> np.ndarray:
    """Stamps (n,) moved by `shift` ns.

    Raises:
        DataError: where they would leave 64 bits.
    """
    reach = 2**63 - 1 - MOST_OFFSET * 10**9
    if shift and len(time) and not -reach <= time.min() <= time.max() <= reach:
        raise DataError(
            "shifted stamps do not fit 64 bits",
            path=place,
            expected=f"stamps between {-reach} and {reach} ns",
            got=f"{time.min()} to {time.max()} ns, shifted by {shift} ns",
            fix=f"leave {name}.time_offset out, and mend the stamps",
        )
    return time + shift


def lost_rows(
    name: str, policy: str, columns: Mapping[str, np.ndarray], row: Callable[[int], str], notes: list[str]
) -> np.ndarray:
    """Which rows (n,) are of a lost body; what is left out or stands still is said in `notes`.

    Args:
        name: of the stream.
        policy: one of `LOST`.
        columns: (n, k) by field.
        row: what to call row k in a message.
        notes: to be added to.

    Raises:
        DataError: with "raise", for an attitude of zeros.
    """
    table = np.concatenate(list(columns.values()), axis=1)
    n = len(table)
    judged = columns.get("attitude", table)
    zeros = (judged == 0.0).all(axis=1)
    with np.errstate(invalid="ignore"):
        still = np.concatenate([[False], (table[1:] == table[:-1]).all(axis=1)]) if n else zeros
    if policy == "raise":
        if "attitude" in columns and zeros.any():
            raise DataError(
                "an attitude is not a unit quaternion",
                path=row(int(np.flatnonzero(zeros)[0])),
                expected="a norm within 1 % of 1",
                got="0, as where the body was lost" + f" ({int(zeros.sum())} of {n} rows)",
                fix=f"{name}.lost=absent leaves such rows out",
            )
        longest, first = _run(still)
        if name != "truth" and ("position" in columns or "attitude" in columns) and longest >= 5:
            sentence = f"{name}: {longest} rows repeat the one before, from {row(first)} on"
            notes.append(note("warning", f"{sentence}; {name}.lost=repeated leaves such rows out"))
        return np.zeros(n, dtype=bool)
    lost = zeros | still if policy == "repeated" else zeros
    if lost.any():
        done = "masked" if name == "truth" else "left out as absent"
        what = "of a lost body" + (" or repeated" if policy == "repeated" else "")
        sentence = (
            f"{name}: {int(lost.sum())} of {n} rows {what} {done}, the first {row(int(np.argmax(lost)))}"
        )
        notes.append(note("skipped", sentence))
    return np.asarray(lost)


def _run(flags: np.ndarray) -> tuple[int, int]:
    """The length of the longest run of true, and where it begins."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], flags.astype(int), [0]])))
    lengths = edges[1::2] - edges[::2]
    k = int(np.argmax(lengths)) if len(lengths) else 0
    return (int(lengths[k]), int(edges[2 * k])) if len(lengths) else (0, 0)


def thinned(name: str, time: np.ndarray, every: int, notes: list[str]) -> np.ndarray:
    """Which rows (n,) are the first of their interval of `every` ns."""
    keep = np.ones(len(time), dtype=bool)
    if not every or len(time) < 2:
        return keep
    since = time - time[0] + int(np.median(np.diff(time))) // 2
    keep[1:] = np.diff(since // every) > 0
    gone = int((~keep).sum())
    notes.append(
        note("info", f"{name}: thinned to one in {every / 1e9:g} s: {gone} of {len(time)} rows left out")
    )
    return keep


def turned(parts: Mapping[str, np.ndarray], mount: np.ndarray) -> dict[str, np.ndarray]:
    """Readings of a sensor that is turned by `mount` (quaternion, sensor to body), as those of the body.

    Vectors of the sensor's axes are turned into the body's; of an attitude the mount is taken out.
    """
    found = dict(parts)
    for field in parts:
        if field == "attitude":
            found[field] = np.asarray(multiply(parts[field], conjugate(mount, xp=np), xp=np))
        elif field in TURNED:
            found[field] = np.asarray(rotate(mount, parts[field], xp=np))
    return found
