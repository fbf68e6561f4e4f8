"""What all datasets share: settings, order in time, samples that are not there, and units that can be.

A `Recording` gathers streams and what there is to say about them, and becomes a `Flight` at the end: when
anything is wrong, an error has been raised and there is no flight, so nothing half-read is ever returned.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight, Series
from flowgraph.blocks.datasets.tables import POLICIES, in_order, nanoseconds
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = [
    "MOST_OFFSET",
    "NOISE_SETTINGS",
    "Recording",
    "chosen",
    "imu_noise",
    "known",
    "number",
    "present",
    "offset",
    "policy",
    "split_argument",
    "the_file",
    "unit_quaternions",
]

MOST_OFFSET = 1_000_000
"""The largest time offset in s, 11 days: clocks of one recording are not farther apart."""

PLAUSIBLE: Mapping[str, tuple[float, float, str, str]] = {
    "specific_force": (2.0, 100.0, "m/s^2", "9.81 at rest; in g it is 1"),
    "gyro": (0.0, 40.0, "rad/s", "2000 deg/s, as fast as most units go, is 35 rad/s"),
    "field": (5e-6, 5e-4, "T", "the Earth's is 25e-6 to 65e-6"),
}
"""Between what a median length must lie, of which unit, and why."""


def known(given: Mapping[str, Any], valid: Mapping[str, str], path: str) -> None:
    """Refuse a setting that a loader does not have.

    Raises:
        UnknownNameError: listing the valid ones.
    """
    for name in given:
        if name not in valid:
            raise UnknownNameError("setting", name, valid, path=path)


def chosen(given: Mapping[str, Any], name: str, valid: Sequence[str], path: str) -> str:
    """The setting `name`, one of `valid`; the first where it is left out.

    Raises:
        UnknownNameError: listing the valid ones.
    """
    value = str(given.get(name, valid[0]))
    if value not in valid:
        raise UnknownNameError(name, value, valid, path=path)
    return value


def policy(given: Mapping[str, Any], path: str) -> str:
    """The setting `bad_time`."""
    return chosen(given, "bad_time", POLICIES, path)


def offset(given: Mapping[str, Any], name: str, path: str) -> int:
    """The setting `name`, seconds to add to stamps, in nanoseconds; 0 where it is left out.

    Raises:
        DeclarationError: when it is not a number, or beyond `MOST_OFFSET`.
    """
    value = given.get(name, 0)
    try:
        found = nanoseconds(str(value))
        if abs(found) > MOST_OFFSET * 10**9:
            raise ValueError
    except ValueError:
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected=f"a number of seconds, at most {MOST_OFFSET} either way",
            got=repr(value),
            fix=f"for example {name}=-0.135",
        ) from None
    return found


def number(
    given: Mapping[str, Any],
    name: str,
    otherwise: float,
    path: str,
    *,
    positive: bool = False,
    signed: bool = False,
) -> float:
    """The setting `name`, a number below 1e9; `otherwise` where it is left out.

    Not below zero; with `positive` above it, and with `signed` as far either way.

    Raises:
        DeclarationError: when it is not one.
    """
    value = given.get(name, otherwise)
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = float("nan")
    if not (abs(found) < 1e9 and (signed or found > 0.0 or (found == 0.0 and not positive))):
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected="a positive number" if positive else "a number" + ("" if signed else " not below zero"),
            got=repr(value),
            fix=f"for example {name}={otherwise:g}",
        )
    return found


def split_argument(argument: str, form: str) -> tuple[Path, Path | None]:
    """FILE and perhaps SECOND of "FILE[:SECOND]".

    Raises:
        DeclarationError: without a FILE.
    """
    first, _, second = argument.partition(":")
    if not first:
        raise DeclarationError(
            "which file?",
            path=form.partition(":")[0],
            expected=form,
            got=repr(argument),
            fix="name the file after the colon",
        )
    return Path(first).expanduser(), Path(second).expanduser() if second else None


NOISE_SETTINGS: Mapping[str, str] = {
    "gyro.noise": "white noise density of the gyroscope, rad/s/sqrt(Hz)",
    "accelerometer.noise": "white noise density of the accelerometer, m/s^2/sqrt(Hz)",
    "gyro.walk": "random walk of its bias, rad/s^2/sqrt(Hz)",
    "accelerometer.walk": "random walk of its bias, m/s^3/sqrt(Hz)",
}
"""For recordings that say nothing of their unit's noise."""

_TYPICAL = ImuNoise(gyro=2e-4, accelerometer=2e-3, gyro_bias=2e-5, accelerometer_bias=3e-3)


def imu_noise(given: Mapping[str, Any], path: str, notes: list[str]) -> ImuNoise:
    """The unit's noise from `NOISE_SETTINGS`; where one is left out a typical unit's, and a note says so."""
    typical = vars(_TYPICAL)
    names = dict(
        zip(NOISE_SETTINGS, ("gyro", "accelerometer", "gyro_bias", "accelerometer_bias"), strict=True)
    )
    assumed = [f"{s}={typical[f]:g}" for s, f in names.items() if s not in given]
    if assumed:
        notes.append("imu: noise of a typical unit assumed: " + ", ".join(assumed))
    return ImuNoise(**{f: number(given, s, typical[f], path) for s, f in names.items()})


def present(
    name: str,
    place: str,
    time: np.ndarray,
    table: np.ndarray,
    notes: list[str],
    absent: dict[str, int],
) -> tuple[np.ndarray, np.ndarray]:
    """The rows (n, ...) without a NaN, and their times; what is left out is counted in `notes` and `absent`.

    Of the truth, rows with a NaN stay where they lie between others, all NaN: they say that nothing is known
    there, and keep errors from being measured against what would be interpolated.

    Raises:
        DataError: when no row is left.
    """
    broken = np.isnan(table).any(axis=1)
    if broken.any():
        done = "masked" if name == "truth" else "left out as absent"
        notes.append(f"{name}: {int(broken.sum())} of {len(time)} rows hold NaN, {done}")
        absent[name] = int(broken.sum())
    if broken.all():
        raise DataError(
            f"{name} holds nothing that was measured",
            path=place,
            expected="at least one row without NaN",
            got=f"{len(time)} rows" + (", all with NaN" if len(time) else ""),
            fix="choose another recording",
        )
    if name == "truth":
        known = np.flatnonzero(~broken)
        table = np.where(broken[:, None], np.nan, table)[known[0] : known[-1] + 1]
        return time[known[0] : known[-1] + 1], table
    return time[~broken], table[~broken]


def the_file(argument: str, *, kind: str, what: str, endings: tuple[str, ...] = ()) -> Path:
    """The file that a flight's argument names.

    Raises:
        DataError: when there is no such file, or its name ends otherwise.
    """
    file = Path(argument).expanduser()
    if not argument or not file.is_file() or (endings and file.suffix.lower() not in endings):
        got = (
            "a folder" if file.is_dir() and argument else "no such file" if not file.is_file() else file.name
        )
        raise DataError(
            f"this is no {what}",
            path=str(file) if argument else kind,
            expected=f"{kind}:FILE with a {what}" + (f" ({', '.join(endings)})" if endings else ""),
            got=got,
            fix="check the path",
        )
    return file


def unit_quaternions(q: np.ndarray, place: str) -> np.ndarray:
    """Attitudes (n, 4) scaled to unit norm; rows of NaN stay.

    Raises:
        DataError: for a row whose norm is farther than 1 % from 1.
    """
    norm = np.linalg.norm(q, axis=-1)
    off = np.flatnonzero(np.abs(norm - 1.0) > 0.01)
    if len(off):
        raise DataError(
            "an attitude is not a unit quaternion",
            path=f"{place}, row {off[0] + 1}",
            expected="a norm within 1 % of 1",
            got=f"{norm[off[0]]:.6g}",
            fix="mend or delete the row",
        )
    return np.asarray(q / norm[:, None])


class Recording:
    """A flight in the making.

    Args:
        name: of the flight.
        bad_time: one of `POLICIES`.
    """

    def __init__(self, name: str, bad_time: str = POLICIES[0]) -> None:
        self.name, self.bad_time = name, bad_time
        self.streams: dict[str, Series] = {}
        self.truth: Series | None = None
        self.info: dict[str, Any] = {"absent": {}}
        self.notes: list[str] = []

    def add(
        self,
        name: str,
        place: str,
        time: np.ndarray,
        columns: Mapping[str, np.ndarray],
        signal: Callable[..., Any],
        *,
        row: Callable[[int], str] | None = None,
        checked: bool = True,
    ) -> Series:
        """A stream, or the truth where `name` is "truth".

        Rows are brought in order as `bad_time` says; rows with a NaN are left out, and counted in a note and
        in `info["absent"]`; lengths of what `PLAUSIBLE` knows are checked.

        Args:
            name: of the stream.
            place: the file (and field) it is from, for messages.
            time: (n,) int64 ns.
            columns: arrays (n, ...) by field of the signal.
            signal: made of the columns, such as `Imu`.
            row: what to call row k in a message; "row k+1" of `place` where it is left out.
            checked: whether units are.

        Raises:
            DataError: for stamps out of order, infinite values, implausible units, or when no row is left.
        """
        names = list(columns)
        arrays = [np.asarray(columns[n], dtype=float).reshape(len(time), -1) for n in names]
        widths = np.cumsum([a.shape[1] for a in arrays])[:-1]
        table = np.concatenate(arrays, axis=1)
        where = row or (lambda k: f"{place}, row {k + 1}")
        endless = np.flatnonzero(np.isinf(table).any(axis=1))
        if len(endless):
            raise DataError(
                "a value is infinite",
                path=where(int(endless[0])),
                expected="finite numbers, or NaN for what was not measured",
                got=str(table[endless[0]].tolist())[:80],
                fix="mend or delete the row",
            )
        time, table, said = in_order(place, where, time, table, self.bad_time)
        self.notes.extend(said)
        time, table = present(name, place, time, table, self.notes, self.info["absent"])
        parts = {
            n: part.reshape(len(time), *np.shape(columns[n])[1:])
            for n, part in zip(names, np.split(table, widths, axis=1), strict=True)
        }
        if checked:
            for field, part in parts.items():
                plausible(field, part, f"{place}: {name}.{field}")
        series = Series(time, signal(**parts), name=name, gaps=name == "truth")
        if name == "truth":
            self.truth = series
        else:
            self.streams[name] = series
        return series

    def flight(self) -> Flight:
        """The flight, when all of it was read."""
        return Flight(self.name, self.streams, truth=self.truth, info=self.info, notes=tuple(self.notes))


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
            got=f"a median length of {middle:.4g}",
            fix=fix,
        )
