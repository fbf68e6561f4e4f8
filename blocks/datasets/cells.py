"""Cells of a table as numbers and as times.

A number may have a decimal comma, an exponent as Fortran writes it, or be one of the many words for a value
that was not measured. A time is a number of some unit, a date with a clock, or a span; it becomes whole
nanoseconds without passing through a float.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta, timezone
from decimal import Decimal, DecimalException

import numpy as np

from flowgraph.blocks.datasets.units import TIME
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["BLANKS", "MISSING", "decimal_mark", "is_date", "is_datum", "numbers", "stamps"]

BLANKS = ("", "-", "--")
"""Cells that may hold nothing in rows of names, of units and of numbers alike."""

_ABSENT = (
    "na n/a #n/a #na <na> nan +nan -nan nan(ind) -nan(ind) nan(snan) 1.#qnan -1.#qnan 1.#ind -1.#ind 1.#nan"
    " null none nil nat missing undefined #num! #value! #div/0! #ref! #name? #null! ? ."
)
MISSING = frozenset((*_ABSENT.split(" "), *BLANKS))
"""Words for what was not measured, in small letters."""

_NUMBER = re.compile(r"[+-]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eEdD][+-]?\d+)?", re.ASCII)
_ENDLESS = re.compile(r"[+-]?(?:inf|infinity|1\.#inf)", re.IGNORECASE)
_THOUSANDS = re.compile(r"[+-]?\d{1,3}(?:([,.' \u00a0\u202f])\d{3})(?:\1\d{3})*(?:[.,]\d*)?", re.ASCII)
_MAYBE_THOUSANDS = re.compile(r"[+-]?[1-9]\d{0,2},\d{3}", re.ASCII)
_ZONE = r"\s*(?P<zone>Z|UTC|GMT|[+-]\d{2}(?::?\d{2})?)?"
_CLOCK = r"(?P<h>\d{2}):(?P<m>\d{2})(?::(?P<s>\d{2})(?:[.,](?P<f>\d+))?)?"
_ISO = re.compile(rf"(?P<y>\d{{4}})([-/])(?P<mo>\d\d?)\2(?P<d>\d\d?)(?:[T ,_]\s*{_CLOCK})?{_ZONE}", re.ASCII)
_BASIC = re.compile(
    rf"(?P<y>\d{{4}})(?P<mo>\d{{2}})(?P<d>\d{{2}})T(?P<h>\d{{2}})(?P<m>\d{{2}})(?P<s>\d{{2}})(?:[.,](?P<f>\d+))?{_ZONE}",
    re.ASCII,
)
_WORDED = re.compile(
    rf"(?P<d>\d\d?)[- ](?P<word>[A-Za-z]{{3}})[- ](?P<y>\d{{4}})(?: {_CLOCK})?{_ZONE}", re.ASCII
)
_SPAN = re.compile(
    r"(?P<sign>-?)(?:(?P<d>\d+) days?,? )?[+]?(?P<h>\d+):(?P<m>\d{2}):(?P<s>\d{2})(?:[.,](?P<f>\d+))?",
    re.ASCII,
)
_UNCLEAR = re.compile(r"\d{1,2}[./-]\d{1,2}[./-]\d{2,4}\b.*", re.ASCII)
_MONTHS = ("jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec")
_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)


def _plain(cell: str) -> str:
    return cell.replace("\u2212", "-")  # a minus sign that is no hyphen


def is_datum(cell: str) -> bool:
    """Whether a cell holds a number, a time, or a word for what was not measured; blanks may be anything."""
    if cell in BLANKS:
        return False
    cell = _plain(cell)
    if _NUMBER.fullmatch(cell) or cell.lower() in MISSING or _ENDLESS.fullmatch(cell):
        return True
    return is_date(cell) or bool(_THOUSANDS.fullmatch(cell) or _UNCLEAR.fullmatch(cell))


def is_date(cell: str) -> bool:
    """Whether a cell holds a date with a clock, or a span."""
    return cell[:1] in tuple("0123456789-") and any(p.fullmatch(cell) for p in (_ISO, _BASIC, _WORDED, _SPAN))


def decimal_mark(
    columns: Sequence[Sequence[str]], where: Callable[[int], str], said: str | None
) -> tuple[str, str]:
    """The decimal mark of some columns, and a note where nobody said that it is a comma, else "".

    Args:
        columns: of cells.
        where: what to call row k in a message.
        said: "point" or "comma", where a setting says it.

    Raises:
        DataError: where both are found, where commas may be thousands separators, or not as is said.
    """
    comma = point = clear = None
    for cells in columns:
        if not ("," in (text := "\n".join(cells)) or (said == "comma" and "." in text)):
            continue
        for k, cell in enumerate(cells):
            if "," in cell and "." in cell and _THOUSANDS.fullmatch(_plain(cell)):
                _refuse_thousands(where(k), cell)
            if cell.count(",") > 1 and _THOUSANDS.fullmatch(_plain(cell)):
                _refuse_thousands(where(k), cell)
            if "," in cell and _NUMBER.fullmatch(_plain(cell)):
                comma = comma or (k, cell)
                clear = clear or not _MAYBE_THOUSANDS.fullmatch(_plain(cell))
    if comma or said == "comma":
        for cells in columns:
            for k, cell in enumerate(cells):
                if "." in cell and _NUMBER.fullmatch(_plain(cell)):
                    point = point or (k, cell)
    if (said == "point" and comma) or (said != "point" and point):
        k, cell = (comma if said == "point" else point) or (0, "")
        raise DataError(
            "a decimal comma or a decimal point?",
            path=where(k),
            expected="one decimal mark in all numbers",
            got=repr(cell) + (f", and {comma[1]!r} elsewhere" if comma and said != "point" else ""),
            fix="write the table anew with a decimal point and no thousands separators",
        )
    if comma and said is None and not clear:
        _refuse_thousands(where(comma[0]), comma[1])
    return ("," if comma or said == "comma" else "."), (
        note("assumed", "numbers have a decimal comma") if comma and said is None else ""
    )


def _refuse_thousands(place: str, cell: str) -> None:
    raise DataError(
        "this number has thousands separators, or a decimal comma: it can be read in two ways",
        path=place,
        expected="digits and one decimal mark",
        got=repr(cell),
        fix="write the table without thousands separators; decimal=comma says that it is a decimal comma",
    )


def numbers(
    cells: Sequence[str], where: Callable[[int], str], column: int, *, decimal: str = ".", blank: bool = True
) -> np.ndarray:
    """A column (n,) of floats; NaN where nothing was measured.

    Args:
        cells: of the column.
        where: what to call row k in a message.
        column: its number from 0, for messages.
        decimal: the decimal mark.
        blank: whether an empty cell is a value that was not measured.

    Raises:
        DataError: for a cell that is no finite number.
    """
    try:
        found = np.array(cells, dtype=np.float64)
        if np.isfinite(found).all() and not any("_" in c for c in cells):
            return found
    except ValueError:
        pass
    found = np.empty(len(cells))
    for k, cell in enumerate(cells):
        plain = _plain(cell)
        if (cell or blank) and plain.lower() in MISSING:
            found[k] = np.nan
            continue
        if _NUMBER.fullmatch(plain) and ("," not in plain or decimal == ","):
            found[k] = float(plain.replace(",", ".").replace("D", "e").replace("d", "e"))
            if np.isfinite(found[k]):
                continue
        if _THOUSANDS.fullmatch(plain) and not _ENDLESS.fullmatch(plain):
            _refuse_thousands(where(k), cell)
        raise DataError(
            f"column {column + 1} is not a finite number",
            path=where(k),
            expected="a finite number" + (", or nothing where none was measured" if blank else ""),
            got=repr(cell),
            fix="mend or delete the row",
        )
    return found


def stamps(
    cells: Sequence[str], where: Callable[[int], str], *, unit: str = "s", decimal: str = "."
) -> tuple[np.ndarray, str]:
    """Times (n,) int64 ns, and a note or "".

    A date with a clock is of UTC where it names no zone, and the note says so. A span (`0 days 00:00:01.5`)
    counts from zero.

    Args:
        cells: numbers, dates or spans, all of one kind.
        where: what to call row k in a message.
        unit: of numbers, one of `units.TIME`.
        decimal: the decimal mark.

    Raises:
        DataError: for a cell that is no time, or beyond 64 bits of nanoseconds.
    """
    size = TIME[unit]
    if cells and not _NUMBER.fullmatch(_plain(cells[0])):
        return _dates(cells, where, unit)
    found = []
    for k, cell in enumerate(cells):
        plain = _plain(cell)
        try:
            if plain.isdecimal() and plain.isascii():
                stamp = int(plain) * size
            else:
                if not _NUMBER.fullmatch(plain) or ("," in plain and decimal != ","):
                    raise ValueError
                exact = Decimal(re.sub("[dD]", "e", plain.replace(",", "."))) * size
                if not -(2**63) <= exact < 2**63:  # an int of 1e560001 would take its time
                    raise ValueError
                stamp = int(exact.to_integral_value())
            if not -(2**63) <= stamp < 2**63:
                raise ValueError
        except (DecimalException, OverflowError, ValueError):
            raise _no_time(where(k), cell, unit) from None
        found.append(stamp)
    return np.array(found, dtype=np.int64), ""


def _no_time(place: str, cell: str, unit: str) -> DataError:
    fix = "mend the row, or say the unit: time.unit=" + " or ".join(TIME)
    if _UNCLEAR.fullmatch(cell):
        fix = "write dates as 2024-01-31 12:00:00.5: which of the numbers is the day is not said"
    elif _NUMBER.fullmatch(cell) and "," not in cell and "d" not in cell.lower():
        for smaller in ("ms", "us", "ns"):  # a clock that counts from 1970 tells its unit
            if 1e8 <= abs(float(cell)) * TIME[smaller] / 1e9 < 4e9 and smaller != unit:
                fix = f"these look like {smaller} since 1970: time.unit={smaller}"
    return DataError(
        "the stamp is not a time",
        path=place,
        expected=f"decimal {_WORDS.get(unit, unit)}, within 64 bits of nanoseconds, or a date such as"
        " 2024-01-31T12:00:00.5Z",
        got=repr(cell) + (f" {unit}" if _NUMBER.fullmatch(cell) else ""),
        fix=fix,
    )


def _dates(cells: Sequence[str], where: Callable[[int], str], unit: str) -> tuple[np.ndarray, str]:
    """Dates or spans, all of one kind, in whole nanoseconds."""
    found, zones = [], set()
    for k, cell in enumerate(cells):
        match = next((m for p in (_ISO, _BASIC, _WORDED, _SPAN) if (m := p.fullmatch(_plain(cell)))), None)
        try:
            if match is None:
                raise ValueError
            stamp, zone = _span(match) if match.re is _SPAN else _date(match)
            if not -(2**63) <= stamp < 2**63:
                raise ValueError
        except (OverflowError, ValueError):
            raise _no_time(where(k), cell, unit) from None
        zones.add(zone)
        if len(zones) > 1:
            raise DataError(
                "stamps are of two kinds",
                path=where(k),
                expected="all with a zone, or all without, or all spans",
                got=f"{cells[0]!r} and {cell!r}",
                fix="write all stamps in one way",
            )
        found.append(stamp)
    said = note("assumed", "stamps name no zone, and are taken for UTC") if zones == {"date"} else ""
    return np.array(found, dtype=np.int64), said


def _fraction(digits: str | None) -> int:
    return int((Decimal("0." + digits) * 10**9).to_integral_value()) if digits else 0


def _date(match: re.Match[str]) -> tuple[int, str]:
    part = match.groupdict()
    month = _MONTHS.index(part["word"].lower()) + 1 if part.get("word") else int(part["mo"])
    zone = UTC
    if part["zone"] and part["zone"][0] in "+-":
        digits = part["zone"][1:].replace(":", "").ljust(4, "0")
        shift = timedelta(hours=int(digits[:2]), minutes=int(digits[2:]))
        zone = timezone(-shift if part["zone"][0] == "-" else shift)  # type: ignore[assignment]
    h, m, sec = (int(part[n] or 0) for n in "hms")
    whole = datetime(int(part["y"]), month, int(part["d"]), h, m, sec, tzinfo=zone) - _EPOCH
    seconds = whole.days * 86400 + whole.seconds
    return seconds * 10**9 + _fraction(part["f"]), "zone" if part["zone"] else "date"


def _span(match: re.Match[str]) -> tuple[int, str]:
    part = match.groupdict()
    seconds = int(part["d"] or 0) * 86400 + int(part["h"]) * 3600 + int(part["m"]) * 60 + int(part["s"])
    whole = seconds * 10**9 + _fraction(part["f"])
    if part["sign"] and part["d"]:  # as pandas writes -1 days +23:59:59
        whole -= 2 * int(part["d"]) * 86400 * 10**9
    elif part["sign"]:
        whole = -whole
    return whole, "span"
