"""Tables of one's own: a text file with a row a sample, and settings that say which column is what.

    csv:FILE  time=stamp  time.unit=ns  imu.gyro=wx,wy,wz  imu.gyro.unit=deg/s  imu.specific_force=ax,ay,az

A column is named by the head of the file, or by its number from 0 where no row names them. Columns that no
setting mentions may hold anything. An empty cell or NaN was not measured: that row is absent from its stream,
while the others keep it, so that sensors of several rates may share a table. What a file says of its own
units is taken, and said.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight
from flowgraph.blocks.datasets.adjust import three_numbers
from flowgraph.blocks.datasets.cells import decimal_mark, is_date, numbers, stamps
from flowgraph.blocks.datasets.csv_columns import OPTIONAL, SETTINGS, STREAMS, TURNS, WAYS, said_by
from flowgraph.blocks.datasets.dialect import DELIMITERS, Sheet, read_sheet
from flowgraph.blocks.datasets.places import from_ned, height_of_pressure
from flowgraph.blocks.datasets.shape import (
    Recording,
    chosen,
    imu_noise,
    known,
    measured_noise,
    number,
    policy,
    the_file,
)
from flowgraph.blocks.datasets.turns import ORDERS, from_angles, from_matrices
from flowgraph.blocks.datasets.units import (
    TIME,
    split_unit,
    unit_of,
)
from flowgraph.blocks.signals import (
    Attitude,
    GeodeticPosition,
    GnssHeading,
    Height,
    Imu,
    MagneticField,
    NavigationState,
    Pose,
    Position,
    Velocity,
    WheelSpeed,
)
from flowgraph.data.notes import note
from flowgraph.errors import DataError, DeclarationError

__all__ = ["SETTINGS", "STREAMS", "claims", "load"]

_SIGNALS: Mapping[frozenset[str], Any] = {
    frozenset(STREAMS["imu"]): Imu,
    frozenset(("position", "attitude")): Pose,
    frozenset(("position",)): Position,
    frozenset(("attitude",)): Attitude,
    frozenset(STREAMS["gps"]): GeodeticPosition,
    frozenset(STREAMS["gps_velocity"]): Velocity,
    frozenset(STREAMS["magnetometer"]): MagneticField,
    frozenset(("height",)): Height,
    frozenset(STREAMS["heading"]): GnssHeading,
    frozenset(STREAMS["wheels"]): WheelSpeed,
    frozenset(STREAMS["truth"]) - {"angles", "matrix"}: NavigationState,
}
_TRUTHS = [
    frozenset(("attitude",)),
    frozenset(("position",)),
    frozenset(("position", "attitude")),
    frozenset(STREAMS["truth"]) - {"angles", "matrix"},
]
_TIMES = ("t", "time", "stamp", "timestamp", "timestamps", "time_stamp", "datetime", "date_time", "date")
"""Names, in small letters and without their unit, of a column that is a clock where no setting names one."""
_HEADING_NOISE = 0.02
"""rad: of two antennas a metre apart whose ambiguities are fixed, with their paths and their mast."""

_INDEX = ("index", "row", "row.names")


def load(argument: str, *, seed: int = 0, settings: Mapping[str, str | float] | None = None) -> Flight:
    """Read the streams that the settings map columns to.

    Args:
        argument: the file.
        seed: not used; every loader has one.
        settings: any of `SETTINGS`; at least one stream.

    Returns:
        A `Flight` with the mapped streams and truth. info: `absent`; with an imu `imu_noise`; and
        `position_noise`, `attitude_noise`, `heading_baseline` where they are given.

    Raises:
        DataError: the file is missing or has no rows; a cell is not a number or a stamp (file, line); stamps
            are out of order; values cannot be of the unit that is said; a name is ambiguous.
        DeclarationError: where no stream is mapped, one lacks a field, a field has not so many columns, or
            the file says another unit than the setting.
        UnknownNameError: for a setting, unit or column that is not there; lists the valid ones.
    """
    given = {name: str(value) for name, value in (settings or {}).items()}
    known(given, SETTINGS, "csv")
    mapped = _mapped(given)
    made = Recording(
        Path(argument).stem,
        policy(given, "csv"),
        kind="csv",
        given=given,
        units="say its unit with {stream}.{field}.unit={unit}, or convert the file to SI units",
    )
    file = the_file(argument, kind="csv", what="table")
    if not mapped:
        _refuse_unmapped(file, given)
    sheet = _sheet(file, given, mapped)
    made.notes.extend(sheet.notes)
    clock = _clock(sheet, given, mapped, made.notes)
    places = {
        (stream, field): [sheet.column(name) for name in names]
        for stream, fields in mapped.items()
        for field, names in fields.items()
    }
    used = {clock, *(k for group in places.values() for k in group)}
    cells = {k: sheet.cells(k) for k in sorted(used)}
    mark = chosen(given, "decimal", ("point", "comma"), "csv") if "decimal" in given else None
    decimal, said = decimal_mark(list(cells.values()), sheet.where, mark)
    if said:
        made.notes.append(said.replace("numbers", f"{file.name}: numbers"))
    made.unit = unit = _time_unit(sheet, given, clock, made.notes)
    time, said = stamps(cells[clock], sheet.where, unit=unit, decimal=decimal)
    if said:
        made.notes.append(said.replace("stamps", f"{file.name}: stamps"))
    for stream, fields in mapped.items():
        columns = {}
        for field in fields:
            group = places[stream, field]
            parts = [numbers(cells[k], sheet.where, k, decimal=decimal) for k in group]
            name, values = _converted(given, sheet, stream, field, group, np.stack(parts, axis=1), made.notes)
            columns[name] = values
        if f"{stream}.axes" in SETTINGS:
            columns = _turned(given, stream, columns, made.notes)
        whole = ~np.all([np.isnan(c).reshape(len(time), -1).all(axis=1) for c in columns.values()], axis=0)
        kept = np.flatnonzero(whole)  # a row of another sensor is no gap of this one
        if len(kept) < len(time):
            less = f"{stream}: {len(time) - len(kept)} of {len(time)} rows of {file.name} hold nothing of it"
            made.notes.append(note("skipped", less))
        made.add(
            stream,
            str(file),
            time[kept],
            {f: c[kept] for f, c in columns.items()},
            _SIGNALS[frozenset(columns)],
            row=lambda k, kept=kept: sheet.where(kept[k]),  # type: ignore[misc]
        )
    if "imu" in made.streams:
        made.info["imu_noise"] = imu_noise(given, "csv", made.notes)
    measured_noise(given, "csv", made.info)
    baseline = three_numbers(given, "heading.baseline", "csv")
    if baseline is not None:
        made.info["heading_baseline"] = baseline
    return made.flight()


def claims(argument: str, settings: Mapping[str, str]) -> set[str]:
    """Which of the settings of a flight of several parts are for this file: those of streams all of whose
    columns it has, and all that are not of a stream."""
    given = {n: v for n, v in settings.items() if n in SETTINGS}
    mapped = {n: _listed(v) for n, v in given.items() if n.count(".") == 1 and n.split(".")[0] in STREAMS}
    mapped = {n: columns for n, columns in mapped.items() if n.split(".")[1] in STREAMS[n.split(".")[0]]}
    file = the_file(argument, kind="csv", what="table")
    wanted = [c for columns in mapped.values() for c in columns]
    sheet = read_sheet(file, delimiter=_delimiter(given), comment=given.get("comment"), wanted=wanted)
    elsewhere = {n.split(".")[0] for n, columns in mapped.items() if not all(map(sheet.matches, columns))}
    lost = {n for n in given if n.split(".")[0] in elsewhere}
    if "time" in given and not sheet.matches(given["time"]):
        lost.add("time")
    return set(given) - lost


def _listed(text: str) -> list[str]:
    return [" ".join(c.split()) for c in text.split(",")]


def _delimiter(given: Mapping[str, str]) -> str | None:
    return chosen(given, "delimiter", list(DELIMITERS), "csv") if "delimiter" in given else None


def _sheet(file: Path, given: Mapping[str, str], mapped: Mapping[str, Mapping[str, list[str]]]) -> Sheet:
    wanted = [name for fields in mapped.values() for names in fields.values() for name in names]
    clock = [given["time"]] if "time" in given else list(_TIMES)
    return read_sheet(
        file, delimiter=_delimiter(given), comment=given.get("comment"), wanted=[*wanted, *clock]
    )


def _mapped(given: Mapping[str, str]) -> dict[str, dict[str, list[str]]]:
    """The columns of each field of each stream that a setting names."""
    mapped: dict[str, dict[str, list[str]]] = {}
    for stream, fields in STREAMS.items():
        for field, (n, _) in fields.items():
            text = given.get(f"{stream}.{field}")
            if text is None:
                continue
            columns = _listed(text)
            if len(columns) != n:
                other = next((f for f in TURNS if field in TURNS and TURNS[f][0] == len(columns)), field)
                raise DeclarationError(
                    f"{stream}.{field} has not so many columns",
                    path=f"csv.{stream}.{field}",
                    expected=f"{n} column{'s' if n > 1 else ''}, comma-separated",
                    got=f"{len(columns)}: {text}",
                    fix=f"write {stream}.{field}=" + ",".join("abcdefghi"[:n])
                    if other == field
                    else f"write {stream}.{other}={text} if they are "
                    + ("roll, pitch and yaw" if other == "angles" else f"a {other}"),
                )
            mapped.setdefault(stream, {})[field] = columns
    for stream, found in mapped.items():
        kinds = [WAYS.get(f, f) for f in found]
        twice = next((kind for kind in kinds if kinds.count(kind) > 1), None)
        needed = {WAYS.get(f, f) for f in STREAMS[stream]}
        if twice or set(kinds) not in (_TRUTHS if stream == "truth" else [needed, needed - OPTIONAL]):
            others = [f for f in STREAMS[stream] if f not in needed]
            raise DeclarationError(
                f"{stream} has its {twice} twice" if twice else f"{stream} lacks a field",
                path=f"csv.{stream}",
                expected=", ".join(f"{stream}.{f}" for f in STREAMS[stream] if f in needed)
                + (f" ({', '.join(f'or {f}' for f in others)})" if others else ""),
                got=", ".join(f"{stream}.{f}" for f in found),
                fix="leave one of them out" if twice else "name the columns of the others too",
            )
    return mapped


def _refuse_unmapped(file: Path, given: Mapping[str, str]) -> None:
    """Say what the columns of a file are called, where nobody has said what they hold."""
    with open(file, encoding="utf-8-sig", errors="replace") as stream:
        head = stream.readline(2000).strip()
    said = ", ".join(f"{k}={v}" for k, v in given.items()) or "no settings"
    raise DeclarationError(
        "no column is mapped to a stream",
        path=f"csv: {file}",
        expected="settings such as imu.gyro=wx,wy,wz and imu.specific_force=ax,ay,az",
        got=f"{said}; the first line of the file is {head[:300]!r}",
        fix="say with --set which columns hold what; of " + ", ".join(STREAMS),
    )


def _clock(
    sheet: Sheet,
    given: Mapping[str, str],
    mapped: Mapping[str, Mapping[str, list[str]]],
    notes: list[str],
) -> int:
    """The column of the stamps.

    Raises:
        DataError: where several may be it, or the first is the index of a table and no other is named as one.
        UnknownNameError: for a column that is not there.
    """
    if "time" in given:
        return sheet.column(" ".join(given["time"].split()))
    if not sheet.names:
        return 0
    taken = {
        k for fields in mapped.values() for names in fields.values() for n in names for k in sheet.matches(n)
    }
    found = [k for k, n in enumerate(sheet.names) if k not in taken and _base(n) in _TIMES]
    if len(found) > 1:
        names = [sheet.names[k] for k in found]
        raise DataError(
            "several columns may be the time",
            path=str(sheet.file),
            expected="one column with a name such as t, time or stamp",
            got=", ".join(names),
            fix="say which: " + " or ".join(f"time={n}" for n in dict.fromkeys(names)),
        )
    if found:
        if found[0]:
            notes.append(note("assumed", f"{sheet.file.name}: column {sheet.names[found[0]]!r} is the time"))
        return found[0]
    first = sheet.names[0]
    if first == "" and is_date(sheet.cells(0)[0]):  # as pandas writes an index of times
        notes.append(note("assumed", f"{sheet.file.name}: the first column, without a name, is the time"))
    elif first == "" or first.lower().startswith("unnamed:") or first.lower() in _INDEX:
        raise DataError(
            "the first column is an index of rows, not a time",
            path=str(sheet.file),
            expected="a column of stamps",
            got=f"the name {first!r} and {', '.join(sheet.cells(0)[:3])} ...",
            fix="name the column of the stamps: time="
            + " or ".join(dict.fromkeys(filter(None, sheet.names[1:4]))),
        )
    return 0


def _base(name: str) -> str:
    """The name of a clock without its unit, which may also be its last part: `timestamp_ns`."""
    plain, _, last = split_unit(name)[0].lower().rpartition("_")
    return plain if plain and last in TIME else split_unit(name)[0].lower()


def _time_unit(sheet: Sheet, given: Mapping[str, str], clock: int, notes: list[str]) -> str:
    """The unit of the stamps: as the setting or the file says; seconds where neither does."""
    if "time.unit" in given:
        chosen(given, "time.unit", list(TIME), "csv")
    found = _units(sheet, given, "time.unit", [clock], TIME, notes)
    if not found and sheet.names:
        last = sheet.names[clock].lower().rpartition("_")[2]
        if "_" in sheet.names[clock] and last in TIME and last != "s" and "time.unit" not in given:
            notes.append(note("info", f"time.unit: {last}, as the name {sheet.names[clock]!r} says"))
            return last
    return found or given.get("time.unit", "s")


def _units(
    sheet: Sheet,
    given: Mapping[str, str],
    key: str,
    places: list[int],
    valid: Mapping[str, Any],
    notes: list[str],
) -> str:
    """What the file says of the unit of columns, "" where it says nothing that is understood.

    Raises:
        DeclarationError: where the setting says another; DataError: where it cannot be the unit of these.
    """
    texts = [sheet.units[k] for k in places] if sheet.units else []
    written = {unit_of(t) for t in texts if t}
    path = f"{sheet.file}, line {sheet.said_at}"
    if "" in written:
        unclear = next(t for t in texts if t and not unit_of(t))
        notes.append(
            note("skipped", f"{sheet.file.name}: line {sheet.said_at}, unit {unclear!r} not understood")
        )
    written -= {"", "none"}
    if not written:
        return ""
    if len(written) > 1 or not written <= set(valid):
        raise DataError(
            f"the units of these columns cannot be those of {key.rsplit('.', 1)[0]}",
            path=path,
            expected="one of " + ", ".join(valid),
            got=", ".join(texts),
            fix="check the columns, or mend the units in the file",
        )
    (unit,) = written
    if given.get(key, unit) != unit:
        raise DeclarationError(
            f"the file says another unit than {key}",
            path=path,
            expected=f"{key}={unit}, as the file says",
            got=f"{key}={given[key]}",
            fix=f"leave {key} out, or mend the file",
        )
    if key not in given and unit != next(iter(valid)):
        notes.append(note("info", f"{key}: {unit}, as line {sheet.said_at} of {sheet.file.name} says"))
    return unit


def _converted(
    given: Mapping[str, str],
    sheet: Sheet,
    stream: str,
    field: str,
    places: list[int],
    values: np.ndarray,
    notes: list[str],
) -> tuple[str, np.ndarray]:
    """The name of the field, and its values in SI units: a quaternion scalar first; a lone column without its
    axis."""
    width, units = STREAMS[stream][field]
    key = f"{stream}.{field}.{said_by(field)}"
    unit = chosen(given, key, list(units), "csv")
    if field == "attitude":
        return field, values[:, [3, 0, 1, 2]] if unit == "xyzw" else values
    if field == "matrix":
        return "attitude", from_matrices(values, sheet.where, by_rows=unit == "rows")
    said = _units(sheet, given, key, places, units, notes)
    if field in ("latitude", "longitude", "angle", "pressure") and not said and key not in given:
        notes.append(note("assumed", f"{stream}.{field} is in {unit}; {key} says it"))
    if field == "pressure":
        where = lambda k: f"{sheet.where(k)}, column {sheet.names[places[0]] if sheet.names else places[0]}"
        return "height", height_of_pressure(values[:, 0] * units[said or unit], where)
    if field != "angles":
        values = values * units[said or unit]
        return field, values[:, 0] if width == 1 else values
    if not said and key not in given:
        said = "deg" if np.nanmax(np.abs(values), initial=0.0) > 2.0 * np.pi else "rad"
        notes.append(note("assumed", f"{stream}.angles are in {said}; {key} says it"))
    order = chosen(given, f"{stream}.angles.order", ORDERS, "csv")
    if f"{stream}.angles.order" not in given:
        notes.append(note("assumed", f"{stream}.angles are roll, pitch, yaw, turned in the order {order}"))
    return "attitude", from_angles(values * units[said or unit], order)


def _turned(
    given: Mapping[str, str], stream: str, columns: dict[str, np.ndarray], notes: list[str]
) -> dict[str, np.ndarray]:
    """A velocity or a heading in a world of east, north, up, with the deviation that a heading has."""
    ned = chosen(given, f"{stream}.axes", ("enu", "ned"), "csv") == "ned"
    if stream != "heading":
        return {"velocity": from_ned(columns["velocity"])} if ned else columns
    angle = 0.5 * np.pi - columns["angle"] if ned else columns["angle"]
    deviation = columns.get("deviation")
    if deviation is None:
        if "heading.noise" not in given:
            said = (
                f"heading: its deviation is {_HEADING_NOISE} rad; heading.noise or heading.deviation says it"
            )
            notes.append(note("assumed", said))
        noise = number(given, "heading.noise", _HEADING_NOISE, "csv", positive=True)
        deviation = np.where(np.isnan(angle), np.nan, noise)
    return {"angle": angle, "deviation": deviation}
