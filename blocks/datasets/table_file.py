"""Tables whose head says what they hold: streams of any name and signal, as `Series.to_pandas` calls columns.

    time, steering.rate, steering.acceleration, fix.position.x, fix.position.y, truth.heading

A column is STREAM.FIELD, or STREAM.FIELD.PART with a part a number or one of x, y, z, w; one without a dot is
a stream of single numbers. The columns of a field go together in their order. Another head is told by
settings, `fix.position=gps_x,gps_y`, for what the head does not name itself. The stream `truth` is the
truth. An empty cell or NaN was not measured: a row in which a stream has nothing is none of that stream.

What the signals mean is the graph's affair, which takes streams and fields by their names (`scoring.own`). A
unit in brackets behind a name, `fix.position.x [cm]`, is brought to SI units; without one the numbers are
taken as they are.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Array, Flight, Signal, real
from flowgraph.blocks.datasets.adjust import stream_settings
from flowgraph.blocks.datasets.cells import decimal_mark, numbers, stamps
from flowgraph.blocks.datasets.dialect import DELIMITERS, Sheet, read_sheet
from flowgraph.blocks.datasets.shape import Recording, chosen, policy, the_file
from flowgraph.blocks.datasets.tables import POLICIES
from flowgraph.blocks.datasets.units import KINDS, TIME, split_unit, unit_of
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = ["SETTINGS", "load"]

_TIMES = ("time", "t", "stamp", "timestamp")
_PART = re.compile(r"[xyzw]|\d+(?:\.\d+)?")
_WORD = re.compile(r"[A-Za-z]\w*")

SETTINGS: Mapping[str, str] = {
    "time": "the column of the stamps; one called " + ", ".join(_TIMES) + " if left out",
    "time.unit": "of the stamps: " + ", ".join(TIME) + "; s if neither this nor the head says it",
    "delimiter": "between columns: " + ", ".join(DELIMITERS) + "; found if left out",
    "STREAM.FIELD": "the columns of a field of a stream, comma-separated",
    **stream_settings("STREAM", only=("time_offset", "every")),
    "bad_time": "rows out of order: " + ", ".join(POLICIES),
}
"""The settings of `load` and what they mean."""

_FIXED = ("time", "time.unit", "delimiter", "bad_time")


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams that the head of a table names, or settings.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`.

    Returns:
        A `Flight` whose streams have a field a group of columns, (n), (n, k) or (n, k, k).

    Raises:
        DataError: the file is missing or has no rows; it names no stream; a cell is no number or stamp (file,
            line); stamps are out of order.
        UnknownNameError: for a column that is not there; lists those that are.
        DeclarationError: for a setting that is not usable.
    """
    given = {name: str(value) for name, value in (settings or {}).items()}
    mapped = {n: [c.strip() for c in v.split(",")] for n, v in given.items() if _maps(n)}
    adjusted = {n: v for n, v in given.items() if n not in mapped}
    made = Recording(Path(argument).stem, policy(adjusted, "table"), kind="table", given=adjusted)
    file = the_file(argument, kind="table", what="table")
    wanted = [c for columns in mapped.values() for c in columns]
    clock = [given["time"]] if "time" in given else list(_TIMES)
    delimiter = chosen(given, "delimiter", list(DELIMITERS), "table") if "delimiter" in given else None
    sheet = read_sheet(file, delimiter=delimiter, wanted=[*wanted, *clock])
    made.notes.extend(sheet.notes)
    at = _clock(sheet, given)
    fields = _fields(sheet, at, mapped)
    cells = {k: sheet.cells(k) for k in sorted({at, *(k for group in fields.values() for k in group)})}
    decimal, said = decimal_mark(list(cells.values()), sheet.where, None)
    made.notes.extend([said] if said else [])
    made.unit = unit = _unit(sheet, given, at)
    time, said = stamps(cells[at], sheet.where, unit=unit, decimal=decimal)
    made.notes.extend([said] if said else [])
    for stream in dict.fromkeys(s for s, _ in fields):
        columns, units = {}, {}
        for field, group in ((f, group) for (s, f), group in fields.items() if s == stream):
            units[field], factor = _unit_of(sheet, group)
            parts = [numbers(cells[k], sheet.where, k, decimal=decimal) for k in group]
            columns[field] = _shaped(sheet, np.stack(parts, axis=1), group) * factor
        flat = np.concatenate([c.reshape(len(time), -1) for c in columns.values()], axis=1)
        kept = np.flatnonzero(~np.isnan(flat).all(axis=1))
        if not len(kept):
            made.notes.append(note("skipped", f"{stream}: no row of {file.name} holds anything of it"))
            continue
        made.add(
            stream,
            str(file),
            time[kept],
            {f: c[kept] for f, c in columns.items()},
            _signal(stream, {f: real(*c.shape[1:], unit=units[f]) for f, c in columns.items()}),
            row=lambda k, kept=kept: sheet.where(kept[k]),  # type: ignore[misc]
            raw=True,
            exact=True,
        )
    return made.flight()


def _maps(setting: str) -> bool:
    stream, _, field = setting.partition(".")
    other = setting in _FIXED or field in ("time_offset", "every", "lost", "lever", "mount")
    return bool(not other and _WORD.fullmatch(stream) and _WORD.fullmatch(field))


def _clock(sheet: Sheet, given: Mapping[str, str]) -> int:
    if "time" in given:
        return sheet.column(given["time"])
    bare = [split_unit(n)[0].lower() for n in sheet.names]
    found = [k for k, n in enumerate(bare) if n in _TIMES]
    if len(found) != 1:
        raise DataError(
            "no column is the time" if not found else "several columns may be the time",
            path=str(sheet.file),
            expected="one column called " + ", ".join(_TIMES),
            got=", ".join(sheet.names) or "no names",
            fix="say which: time=COLUMN",
        )
    return found[0]


def _unit(sheet: Sheet, given: Mapping[str, str], clock: int) -> str:
    if "time.unit" in given:
        return chosen(given, "time.unit", list(TIME), "table")
    written = unit_of(sheet.units[clock]) if sheet.units and sheet.units[clock] else ""
    return written if written in TIME else "s"


def _fields(sheet: Sheet, clock: int, mapped: Mapping[str, list[str]]) -> dict[tuple[str, str], list[int]]:
    """The columns of each field of each stream, those that settings name before those of the head."""
    found: dict[tuple[str, str], list[int]] = {}
    for name, columns in mapped.items():
        stream, _, field = name.partition(".")
        found[stream, field] = [sheet.column(c) for c in columns]
    taken = {clock, *(k for group in found.values() for k in group)}
    told = {s for s, _ in found}
    for k, column in enumerate(sheet.names):
        stream, _, rest = split_unit(column)[0].partition(".")
        field, _, part = rest.partition(".")
        if k in taken or not _WORD.fullmatch(stream) or (stream, field or "value") in mapped:
            continue
        if rest and not (_WORD.fullmatch(field) and (not part or _PART.fullmatch(part))):
            continue
        if not rest and told:  # where settings say what is what, other columns are nothing
            continue
        found.setdefault((stream, field or "value"), []).append(k)
    if not found:
        raise DataError(
            "this table names no stream",
            path=str(sheet.file),
            expected="columns such as fix.position.x and fix.position.y",
            got=", ".join(sheet.names) or "no names",
            fix="say which columns hold what: --set fix.position=" + ",".join(sheet.names[1:3] or ["1", "2"]),
        )
    return found


def _shaped(sheet: Sheet, columns: np.ndarray, group: list[int]) -> np.ndarray:
    """(n), (n, k), or (n, k, k) where the names count in two numbers."""
    names = [split_unit(sheet.names[k])[0] if sheet.names else "" for k in group]
    parts = [n.split(".", 2)[2] if n.count(".") >= 2 else "" for n in names]
    if len(group) == 1 and not parts[0]:
        return columns[:, 0]
    if not all(re.fullmatch(r"\d+\.\d+", p) for p in parts):
        return columns
    places = [tuple(map(int, p.split("."))) for p in parts]
    shape = tuple(max(p[axis] for p in places) + 1 for axis in (0, 1))
    if sorted(places) != [(i, j) for i in range(shape[0]) for j in range(shape[1])]:
        raise DataError(
            "a matrix lacks an entry, or has one twice",
            path=str(sheet.file),
            expected=f"{names[0].rsplit('.', 2)[0]}.I.J for all of {shape[0]} x {shape[1]}",
            got=", ".join(names),
            fix="name each entry once",
        )
    whole = np.empty((len(columns), *shape))
    for k, place in enumerate(places):
        whole[(slice(None), *place)] = columns[:, k]
    return whole


_SI = {name: (next(iter(kind)), factor) for kind in KINDS for name, factor in kind.items()}


def _unit_of(sheet: Sheet, group: list[int]) -> tuple[str | None, float]:
    """The SI unit of the columns of a field, as the head says it, and the factor to it."""
    units = sheet.units or [split_unit(n)[1] for n in sheet.names]
    written = {units[k] for k in group} if units else {""}
    if len(written) > 1:
        raise DataError(
            "the columns of a field have several units",
            path=str(sheet.file),
            expected="one unit a field",
            got=", ".join(sorted(w or "none" for w in written)),
            fix="give each a field of its own",
        )
    text = written.pop()
    return _SI.get(unit_of(text), (text or None, 1.0))


def _signal(stream: str, fields: Mapping[str, Any]) -> Any:
    """A signal with these fields."""
    try:
        return type(stream, (Signal,), {"__annotations__": dict.fromkeys(fields, Array), **fields})
    except (SyntaxError, TypeError) as error:
        raise DeclarationError(
            "a field cannot be called this",
            path=f"table.{stream}",
            expected="names that Python has for variables",
            got=", ".join(fields),
            fix="name the columns by a setting: " + stream + ".FIELD=...",
        ) from error
