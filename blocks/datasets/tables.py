"""Tables of time-stamped numbers in text files: fast, exact in time, and precise about a bad row.

The whole file is read in one go by NumPy's C parser, stamps as integers. Only if that fails is it gone
through line by line, to find the row to blame.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from flowgraph.errors import DataError

__all__ = ["POLICIES", "in_order", "nanoseconds", "read_table", "strictly_later"]

POLICIES = ("raise", "drop", "sort")
"""What to do with rows whose time does not increase: refuse them; leave them out; sort, and of equal times
keep the first."""


def nanoseconds(seconds: str) -> int:
    """Decimal seconds as an integer of nanoseconds, rounded once and never through a float.

    Raises:
        ValueError: when the text is not a finite number, or beyond 64 bits.
    """
    try:
        number = Decimal(seconds)
        if "_" in seconds or not -9_223_372_036 < number < 9_223_372_036:
            raise ValueError
        return int((number * 1_000_000_000).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f"not a finite number below 9.2e9: {seconds!r}") from error


def read_table(
    file: Path,
    *,
    columns: int,
    bad_time: str = "raise",
    delimiter: str | None = ",",
    seconds: bool = False,
    quaternion: int | None = None,
    gaps: bool = False,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read rows of a stamp and `columns` numbers. Empty lines and lines that start with # are passed over.

    Args:
        file: a text file.
        columns: how many numbers follow the stamp.
        bad_time: one of `POLICIES`.
        delimiter: between columns; None for white space.
        seconds: whether a stamp is decimal seconds instead of integer nanoseconds.
        quaternion: the first of four columns that must have a norm within 1 % of 1; they are normalised.
        gaps: whether a NaN is data, a number that was not measured; otherwise it is refused.

    Returns:
        Times (n,) int64 ns, increasing; numbers (n, columns) float64; and notes on what was left out or
        moved.

    Raises:
        DataError: the file has no rows, or a row is malformed or out of order; names the file and the line.
    """
    text = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()  # some editors write a mark
    lines = [i for i, line in enumerate(text) if line and not line.isspace() and line[0] != "#"]
    rows = [text[i] for i in lines]
    if not rows:
        raise DataError(
            "no rows",
            path=str(file),
            expected=f"rows of a stamp and {columns} numbers",
            got=f"{len(text)} lines, all empty or comments",
            fix="restore the file",
        )
    stamp = "U40" if seconds else "i8"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a stamp like 1e9 is parsed through a float, with a warning
            dtype = np.dtype([("time", stamp), ("x", "f8", (columns,))])
            table = np.loadtxt(rows, delimiter=delimiter, dtype=dtype, comments=None, ndmin=1)
        time = np.array([nanoseconds(t) for t in table["time"]] if seconds else table["time"], dtype=np.int64)
        x = np.ascontiguousarray(table["x"])
    except (ValueError, OverflowError, Warning) as error:
        _blame(file, text, lines, columns, delimiter, seconds, gaps)
        raise DataError(
            "this is not a table of numbers",
            path=f"{file}, lines {lines[0] + 1} to {lines[-1] + 1}",
            expected=f"rows of a stamp and {columns} numbers",
            got=str(error),
            fix="mend or delete the row",
        ) from error
    if np.isinf(x).any() or (not gaps and np.isnan(x).any()):
        _blame(file, text, lines, columns, delimiter, seconds, gaps)
    if quaternion is not None:
        part = x[:, quaternion : quaternion + 4]
        norm = np.linalg.norm(part, axis=-1, keepdims=True)
        off = np.flatnonzero(np.abs(norm[:, 0] - 1.0) > 0.01)
        if len(off):
            raise DataError(
                "an attitude is not a unit quaternion",
                path=f"{file}, line {lines[off[0]] + 1}",
                expected="a norm within 1 % of 1",
                got=f"{norm[off[0], 0]:.6g}",
                fix="mend or delete the row",
            )
        x[:, quaternion : quaternion + 4] = part / norm
    where = "/".join(file.parts[-2:])
    return in_order(where, lambda k: f"{file}, line {lines[k] + 1}", time, x, bad_time)


def in_order(
    name: str, row: Callable[[int], str], time: np.ndarray, x: np.ndarray, bad_time: str
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Times (n,) and rows (n, ...) with increasing time, as `bad_time` (of `POLICIES`) says, and notes.

    Args:
        name: what the notes are about.
        row: what to call row k in a message.

    Raises:
        DataError: with bad_time="raise", for the first row that is not later than all before it.
    """
    before = np.concatenate([[np.iinfo(np.int64).min], np.maximum.accumulate(time)[:-1]])
    bad = np.flatnonzero(time <= before) if len(time) else time[:0]
    if not len(bad):
        return time, x, []
    if bad_time == "raise":
        k = int(bad[0])
        raise DataError(
            "time does not increase",
            path=row(k),
            expected=f"a stamp after {before[k]} ns",
            got=f"{time[k]} ns",
            fix="bad_time=drop leaves such rows out, bad_time=sort sorts them in",
        )
    if bad_time == "drop":
        kept = time > before
        return time[kept], x[kept], [f"{name}: {len(bad)} rows out of order left out"]
    times, first = np.unique(time, return_index=True)
    twice = len(time) - len(times)
    note = f"{name}: sorted, {len(bad)} rows were out of order"
    return times, x[first], [note + (f", {twice} of equal time left out" if twice else "")]


def _blame(
    file: Path,
    text: list[str],
    lines: list[int],
    columns: int,
    delimiter: str | None,
    seconds: bool,
    gaps: bool,
) -> None:
    """Raise a DataError for the first malformed row."""
    for i in lines:
        cells = text[i].strip().split(delimiter)
        where = f"{file}, line {i + 1}"
        if len(cells) != columns + 1:
            raise DataError(
                "wrong number of columns",
                path=where,
                expected=f"{columns + 1}: a stamp and {columns} numbers",
                got=f"{len(cells)}: {text[i][:60]!r}",
                fix="mend or delete the row",
            )
        try:
            stamp = nanoseconds(cells[0]) if seconds else int(cells[0])
            if "_" in cells[0] or not -(2**63) <= stamp < 2**63:
                raise ValueError
        except ValueError:
            raise DataError(
                "the stamp is not a time",
                path=where,
                expected="decimal seconds" if seconds else "integer nanoseconds, within 64 bits",
                got=repr(cells[0]),
                fix="mend or delete the row",
            ) from None
        for column, cell in enumerate(cells[1:], start=2):
            try:
                number = float(cell)
                finite = "_" not in cell and bool(np.isfinite(number) or (gaps and np.isnan(number)))
            except ValueError:
                finite = False
            if not finite:
                raise DataError(
                    f"column {column} is not a finite number",
                    path=where,
                    expected="a finite number",
                    got=repr(cell),
                    fix="mend or delete the row",
                )


def strictly_later(seconds: np.ndarray, what: str, file: Path) -> tuple[np.ndarray, list[str]]:
    """Which rows (n,) come after all before them, and notes that name those that do not."""
    stamps = np.rint(np.asarray(seconds) * 1e9)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(stamps)[:-1]])
    keep = stamps > before
    bad = np.flatnonzero(~keep)
    if not len(bad):
        return keep, []
    first = int(bad[0])
    step = 1e3 * float(seconds[first] - seconds[first - 1])
    more = f"; {len(bad)} rows in all are not after those before them" if len(bad) > 1 else ""
    note = f"{file.name}: {what}, row {first + 1} is {step:+.3f} ms after the one before{more}: left out"
    return keep, [note]
