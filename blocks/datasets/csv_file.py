"""Tables of one's own: a text file with a row a sample, and settings that say which column is what.

    csv:FILE  time=stamp  time.unit=ns  imu.gyro=wx,wy,wz  imu.gyro.unit=deg/s  imu.specific_force=ax,ay,az

A column is named by the first row, or by its number from 0 where no row names them. Columns that no setting
mentions may hold anything. An empty cell or NaN was not measured: that row is absent from its stream, while
the others keep it, so that sensors of several rates may share a table.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.shape import (
    MEASURED_NOISE,
    NOISE_SETTINGS,
    Recording,
    chosen,
    imu_noise,
    known,
    measured_noise,
    policy,
    stream_settings,
    the_file,
)
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.blocks.signals import (
    Attitude,
    GeodeticPosition,
    Imu,
    MagneticField,
    NavigationState,
    Pose,
    Position,
)
from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = ["SETTINGS", "STREAMS", "load"]

_DEGREE = np.pi / 180.0
_LENGTH = {"m": 1.0, "mm": 1e-3}
_RATE = {"rad/s": 1.0, "deg/s": _DEGREE}
_FORCE = {"m/s^2": 1.0, "g": 9.80665}
_FIELD = {"T": 1.0, "uT": 1e-6, "G": 1e-4}
_ANGLE = {"rad": 1.0, "deg": _DEGREE}
_ORDER = {"wxyz": 1.0, "xyzw": 1.0}

STREAMS: Mapping[str, Mapping[str, tuple[int, Mapping[str, float]]]] = {
    "imu": {"gyro": (3, _RATE), "specific_force": (3, _FORCE)},
    "vicon": {"position": (3, _LENGTH), "attitude": (4, _ORDER)},
    "leica": {"position": (3, _LENGTH)},
    "gps": {"latitude": (1, _ANGLE), "longitude": (1, _ANGLE), "height": (1, _LENGTH)},
    "magnetometer": {"field": (3, _FIELD)},
    "truth": {
        "position": (3, _LENGTH),
        "attitude": (4, _ORDER),
        "velocity": (3, {"m/s": 1.0}),
        "gyro_bias": (3, _RATE),
        "accelerometer_bias": (3, _FORCE),
    },
}
"""The fields of each stream: how many columns, and the units (or orders of a quaternion) that they may have,
the first where nothing is said. All fields of a stream are needed; of the truth, an attitude alone, with a
position, or all five."""

_SIGNALS: Mapping[frozenset[str], Any] = {
    frozenset(STREAMS["imu"]): Imu,
    frozenset(("position", "attitude")): Pose,
    frozenset(("position",)): Position,
    frozenset(("attitude",)): Attitude,
    frozenset(STREAMS["gps"]): GeodeticPosition,
    frozenset(STREAMS["magnetometer"]): MagneticField,
    frozenset(STREAMS["truth"]): NavigationState,
}
_UNITS = {"s": Decimal(10**9), "ms": Decimal(10**6), "us": Decimal(10**3), "ns": Decimal(1)}
_DELIMITERS = {"comma": ",", "semicolon": ";", "tab": "\t", "space": None}

SETTINGS: Mapping[str, str] = {
    "time": "the column of the stamps; the first if left out",
    "time.unit": "of the stamps: " + ", ".join(_UNITS),
    "delimiter": "between columns: " + ", ".join(_DELIMITERS),
    **{
        f"{stream}.{field}": f"{n} columns, comma-separated"
        for stream, fields in STREAMS.items()
        for field, (n, _) in fields.items()
    },
    **{
        f"{stream}.{field}.{'order' if field == 'attitude' else 'unit'}": ", ".join(units)
        for stream, fields in STREAMS.items()
        for field, (_, units) in fields.items()
        if len(units) > 1
    },
    **NOISE_SETTINGS,
    **MEASURED_NOISE,
    **stream_settings(*STREAMS),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams that the settings map columns to.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`; at least one stream.

    Returns:
        A `Flight` with the mapped streams and truth. info: `absent`; with an imu `imu_noise`; and
        `position_noise`, `attitude_noise` where they are given.

    Raises:
        DataError: the file is missing or has no rows; a cell is not a number or a stamp (file, line); stamps
            are out of order; values cannot be of the unit that is said.
        DeclarationError: where no stream is mapped, one lacks a field, or a field has not so many columns.
        UnknownNameError: for a setting, unit or column that is not there; lists the valid ones.
    """
    given = {name: str(value) for name, value in (settings or {}).items()}
    known(given, SETTINGS, "csv")
    mapped = _mapped(given)
    clock = chosen(given, "time.unit", list(_UNITS), "csv")
    unit = _UNITS[clock]
    delimiter = _DELIMITERS[chosen(given, "delimiter", list(_DELIMITERS), "csv")]
    made = Recording(
        Path(argument).stem,
        policy(given, "csv"),
        kind="csv",
        given=given,
        unit=clock,
        units="say its unit with {stream}.{field}.unit={unit}, or convert the file to SI units",
    )
    file = the_file(argument, kind="csv", what="table")
    names, lines, rows = _rows(file, delimiter)
    time = np.array(
        _stamps(file, lines, rows, _column(file, names, given.get("time", "0")), unit), dtype=np.int64
    )
    for stream, fields in mapped.items():
        columns = {}
        for field, chosen_columns in fields.items():
            places = [_column(file, names, name) for name in chosen_columns]
            numbers = _numbers(file, lines, rows, places)
            columns[field] = _converted(given, stream, field, numbers)
        whole = ~np.all([np.isnan(c).reshape(len(time), -1).all(axis=1) for c in columns.values()], axis=0)
        kept = np.flatnonzero(whole)  # a row of another sensor is no gap of this one
        made.add(
            stream,
            str(file),
            time[kept],
            {f: c[kept] for f, c in columns.items()},
            _SIGNALS[frozenset(columns)],
            row=lambda k, kept=kept: f"{file}, line {lines[kept[k]]}",  # type: ignore[misc]
        )
    if "imu" in made.streams:
        made.info["imu_noise"] = imu_noise(given, "csv", made.notes)
    measured_noise(given, "csv", made.info)
    return made.flight()


def _mapped(given: Mapping[str, str]) -> dict[str, dict[str, list[str]]]:
    """The columns of each field of each stream that a setting names."""
    mapped: dict[str, dict[str, list[str]]] = {}
    for stream, fields in STREAMS.items():
        for field, (n, _) in fields.items():
            text = given.get(f"{stream}.{field}")
            if text is None:
                continue
            columns = [c.strip() for c in text.split(",")]
            if len(columns) != n:
                raise DeclarationError(
                    f"{stream}.{field} has not so many columns",
                    path=f"csv.{stream}.{field}",
                    expected=f"{n} column{'s' if n > 1 else ''}, comma-separated",
                    got=f"{len(columns)}: {text}",
                    fix=f"write {stream}.{field}=" + ",".join("abcd"[:n]),
                )
            mapped.setdefault(stream, {})[field] = columns
    for stream, found in mapped.items():
        if frozenset(found) not in _SIGNALS or (stream != "truth" and set(found) != set(STREAMS[stream])):
            raise DeclarationError(
                f"{stream} lacks a field",
                path=f"csv.{stream}",
                expected=", ".join(f"{stream}.{f}" for f in STREAMS[stream]),
                got=", ".join(f"{stream}.{f}" for f in found),
                fix="name the columns of the others too",
            )
    if not mapped:
        raise DeclarationError(
            "no column is mapped to a stream",
            path="csv",
            expected="settings such as imu.gyro=wx,wy,wz and imu.specific_force=ax,ay,az",
            got=", ".join(f"{k}={v}" for k, v in given.items()) or "no settings",
            fix="say with --set which columns hold what; of " + ", ".join(STREAMS),
        )
    return mapped


def _rows(file: Path, delimiter: str | None) -> tuple[list[str], list[int], list[list[str]]]:
    """The names of the columns (or none), and the line number and cells of each row."""
    text = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()
    held = [(i, line) for i, line in enumerate(text, start=1) if line.strip()]
    split = [
        (i, line.split() if delimiter is None else next(csv.reader([line], delimiter=delimiter)))
        for i, line in held
    ]
    cells = [(i, [c.strip() for c in row]) for i, row in split]
    names: list[str] = []
    remarks = [(i, row) for i, row in cells if row[0].startswith("#")]
    cells = [(i, row) for i, row in cells if not row[0].startswith("#")]
    if cells and not _is_number(cells[0][1][0]):
        names, cells = cells[0][1], cells[1:]
    elif cells and remarks and remarks[0][0] < cells[0][0]:  # names behind a #, or just a remark
        words = [c.strip() for c in [remarks[0][1][0].lstrip("#"), *remarks[0][1][1:]]]
        words = words if words[0] else words[1:]
        names = words if len(words) == len(cells[0][1]) else []
    if not cells:
        raise DataError(
            "no rows",
            path=str(file),
            expected="rows of a stamp and numbers",
            got=f"{len(text)} lines, all empty, comments or names",
            fix="restore the file",
        )
    return names, [i for i, _ in cells], [row for _, row in cells]


def _is_number(cell: str) -> bool:
    try:
        Decimal(cell)
    except InvalidOperation:
        return False
    return True


def _column(file: Path, names: list[str], name: str) -> int:
    if name in names:
        return names.index(name)
    if name.isdecimal() and (not names or int(name) < len(names)):
        return int(name)
    raise UnknownNameError("column", name, names or ["0", "1", "..."], path=str(file))


def _cell(file: Path, line: int, row: list[str], place: int) -> str:
    if place >= len(row):
        raise DataError(
            "wrong number of columns",
            path=f"{file}, line {line}",
            expected=f"at least {place + 1}",
            got=f"{len(row)}",
            fix="mend or delete the row, or check the delimiter",
        )
    return row[place]


def _stamps(file: Path, lines: list[int], rows: list[list[str]], place: int, unit: Decimal) -> list[int]:
    found = []
    for line, row in zip(lines, rows, strict=True):
        cell = _cell(file, line, row, place)
        try:
            stamp = Decimal(cell) * unit
            if "_" in cell or not -(2**63) <= stamp < 2**63:
                raise ValueError
            found.append(int(stamp.to_integral_value()))
        except (InvalidOperation, ValueError):
            raise DataError(
                "the stamp is not a time",
                path=f"{file}, line {line}",
                expected="a number within 64 bits of nanoseconds",
                got=repr(cell),
                fix="mend the row, or say the unit: time.unit=" + " or ".join(_UNITS),
            ) from None
    return found


def _numbers(file: Path, lines: list[int], rows: list[list[str]], places: list[int]) -> np.ndarray:
    table = np.empty((len(rows), len(places)))
    for k, (line, row) in enumerate(zip(lines, rows, strict=True)):
        for j, place in enumerate(places):
            cell = _cell(file, line, row, place)
            try:
                table[k, j] = float(cell) if cell else np.nan
                if "_" in cell or np.isinf(table[k, j]):
                    raise ValueError
            except ValueError:
                raise DataError(
                    f"column {place + 1} is not a finite number",
                    path=f"{file}, line {line}",
                    expected="a finite number, or nothing where none was measured",
                    got=repr(cell),
                    fix="mend or delete the row",
                ) from None
    return table


def _converted(given: Mapping[str, str], stream: str, field: str, numbers: np.ndarray) -> np.ndarray:
    """In SI units; a quaternion scalar first; a lone column without its axis."""
    width, units = STREAMS[stream][field]
    key = f"{stream}.{field}.{'order' if field == 'attitude' else 'unit'}"
    unit = chosen(given, key, list(units), "csv")
    if field == "attitude":
        return numbers[:, [3, 0, 1, 2]] if unit == "xyzw" else numbers
    numbers = numbers * units[unit]
    return numbers[:, 0] if width == 1 else numbers
