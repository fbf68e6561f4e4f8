"""Tables of time-stamped numbers in text files: fast, exact in time, and precise about a bad row.

The whole file is read in one go by NumPy's C parser, stamps as integers. Only if that fails is it gone
through cell by cell, to find what dialect it is in, or the row to blame.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from flowgraph.blocks.datasets.cells import decimal_mark, numbers, stamps
from flowgraph.blocks.datasets.dialect import Sheet, lines_of, read_sheet, text_of
from flowgraph.blocks.datasets.stamps import POLICIES, in_order, nanoseconds, strictly_later
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["POLICIES", "in_order", "nanoseconds", "read_table", "strictly_later"]


def read_table(
    file: Path,
    *,
    columns: int,
    bad_time: str = "raise",
    delimiter: str | None = ",",
    unit: str = "ns",
    gaps: bool = False,
    lines: list[int] | None = None,
) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Read rows of a stamp and `columns` numbers. Empty lines and comments are passed over.

    What is not as expected, such as another delimiter, a decimal comma or a row of names, is read as
    `dialect.read_sheet` finds it.

    Args:
        file: a text file.
        columns: how many numbers follow the stamp.
        bad_time: one of `POLICIES`.
        delimiter: between columns, where nothing speaks against it; None for white space.
        unit: of the stamps, of `units.TIME`: whole numbers of ns; of others decimal numbers, or dates.
        gaps: whether a NaN is data, a number that was not measured; otherwise it is refused.
        lines: to be filled with the line of each row, from 1; then rows stay as they are in the file, and
            their order is left to the caller.

    Returns:
        Times (n,) int64 ns, increasing; numbers (n, columns) float64; and notes on what was left out or
        moved.

    Raises:
        DataError: the file has no rows, or a row is malformed or out of order; names the file and the line.
    """
    text, said = text_of(file)
    held = [(i, line) for i, line in enumerate(lines_of(text), start=1) if line.strip() and line[0] != "#"]
    try:
        at, rows = [i for i, _ in held], [line for _, line in held]
        if not rows:
            raise ValueError
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a stamp like 1e9 is parsed through a float, with a warning
            dtype = np.dtype([("time", "i8" if unit == "ns" else "U40"), ("x", "f8", (columns,))])
            table = np.loadtxt(rows, delimiter=delimiter, dtype=dtype, comments=None, ndmin=1)
        time = table["time"]
        if unit != "ns":
            time, clock = stamps(table["time"].tolist(), lambda k: f"{file}, line {at[k]}", unit=unit)
            said = [*said, *filter(None, [clock])]
        x = np.ascontiguousarray(table["x"])
        if np.isinf(x).any() or (not gaps and np.isnan(x).any()):
            raise ValueError
    except (ValueError, OverflowError, Warning):
        at, time, x, more = _in_dialect(file, columns, delimiter, unit, gaps)
        said = [*said, *more]
    if lines is not None:
        lines.extend(at)
        return time, x, said
    where = "/".join(file.parts[-2:])
    time, x, moved = in_order(where, lambda k: f"{file}, line {at[k]}", time, x, bad_time)
    return time, x, [*said, *moved]


def _in_dialect(
    file: Path, columns: int, delimiter: str | None, unit: str, gaps: bool
) -> tuple[list[int], np.ndarray, np.ndarray, list[str]]:
    """Lines, times, numbers and notes of a table that is not plain.

    Raises:
        DataError: for the first malformed row.
    """
    sheet = read_sheet(file, width=columns + 1, otherwise=delimiter)
    for k, row in enumerate(sheet.rows):
        if len(row) > columns + 1 and not any(row[columns + 1 :]):
            del row[columns + 1 :]
        if len(row) != columns + 1:
            raise DataError(
                "wrong number of columns",
                path=sheet.where(k),
                expected=f"{columns + 1}: a stamp and {columns} numbers",
                got=f"{len(row)}: {', '.join(row)[:60]!r}",
                fix="mend or delete the row",
            )
    cells = [sheet.cells(k) for k in range(columns + 1)]
    decimal, said = decimal_mark(cells, sheet.where, None)
    clock = ""
    if unit == "ns" and not any(c in cells[0][0] for c in ":T/"):
        time = _whole(cells[0], sheet)
    else:
        time, clock = stamps(cells[0], sheet.where, unit=unit, decimal=decimal)
    x = np.empty((len(time), columns))
    for k in range(columns):
        x[:, k] = numbers(cells[k + 1], sheet.where, k + 1, decimal=decimal, blank=False)
        absent = np.flatnonzero(np.isnan(x[:, k]))
        if len(absent) and not gaps:
            raise DataError(
                f"column {k + 2} is not a finite number",
                path=sheet.where(int(absent[0])),
                expected="a finite number",
                got=repr(cells[k + 1][absent[0]]),
                fix="mend or delete the row",
            )
    passed = note("skipped", f"{file.name}: ")  # what a plain table may have, and is not said of it
    notes = [n for n in sheet.notes if not (n.startswith(passed) and n.endswith("of comment"))]
    return sheet.lines, time, x, [*notes, *filter(None, [said, clock])]


def _whole(cells: list[str], sheet: Sheet) -> np.ndarray:
    """Stamps that are whole nanoseconds.

    Raises:
        DataError: for the first that is not.
    """
    for k, cell in enumerate(cells):
        try:
            if "_" in cell or not -(2**63) <= int(cell) < 2**63:
                raise ValueError
        except ValueError:
            raise DataError(
                "the stamp is not a time",
                path=sheet.where(k),
                expected="integer nanoseconds, within 64 bits",
                got=repr(cell),
                fix="mend or delete the row",
            ) from None
    return np.array([int(c) for c in cells], dtype=np.int64)
