"""Tables of time-stamped numbers in text files: fast, exact in time, and precise about a bad row.

The whole file is read in one go by NumPy's C parser, stamps as integers. Only if that fails is it gone
through line by line, to find the row to blame.
"""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np

from flowgraph.blocks.datasets.stamps import (
    POLICIES,
    UNITS,
    as_nanoseconds,
    in_order,
    likely_unit,
    nanoseconds,
    strictly_later,
)
from flowgraph.errors import DataError

__all__ = ["POLICIES", "UNITS", "in_order", "nanoseconds", "read_table", "strictly_later"]

_WORDS = {"s": "seconds", "ms": "milliseconds", "us": "microseconds", "ns": "nanoseconds"}


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
    """Read rows of a stamp and `columns` numbers. Empty lines and lines that start with # are passed over.

    Args:
        file: a text file.
        columns: how many numbers follow the stamp.
        bad_time: one of `POLICIES`.
        delimiter: between columns; None for white space.
        unit: of the stamps, of `UNITS`: whole numbers of ns, decimal numbers of others.
        gaps: whether a NaN is data, a number that was not measured; otherwise it is refused.
        lines: to be filled with the line of each row, from 1; then rows stay as they are in the file, and
            their order is left to the caller.

    Returns:
        Times (n,) int64 ns, increasing; numbers (n, columns) float64; and notes on what was left out or
        moved.

    Raises:
        DataError: the file has no rows, or a row is malformed or out of order; names the file and the line.
    """
    text = file.read_text(encoding="utf-8-sig", errors="replace").splitlines()  # some editors write a mark
    held = [i for i, line in enumerate(text) if line and not line.isspace() and line[0] != "#"]
    rows = [text[i] for i in held]
    if not rows:
        raise DataError(
            "no rows",
            path=str(file),
            expected=f"rows of a stamp and {columns} numbers",
            got=f"{len(text)} lines, all empty or comments",
            fix="restore the file",
        )
    stamp = "i8" if unit == "ns" else "U40"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a stamp like 1e9 is parsed through a float, with a warning
            dtype = np.dtype([("time", stamp), ("x", "f8", (columns,))])
            table = np.loadtxt(rows, delimiter=delimiter, dtype=dtype, comments=None, ndmin=1)
        time = np.array(
            table["time"] if unit == "ns" else [as_nanoseconds(t, unit) for t in table["time"]],
            dtype=np.int64,
        )
        x = np.ascontiguousarray(table["x"])
    except (ValueError, OverflowError, Warning) as error:
        _blame(file, text, held, columns, delimiter, unit, gaps)
        raise DataError(
            "this is not a table of numbers",
            path=f"{file}, lines {held[0] + 1} to {held[-1] + 1}",
            expected=f"rows of a stamp and {columns} numbers",
            got=str(error),
            fix="mend or delete the row",
        ) from error
    if np.isinf(x).any() or (not gaps and np.isnan(x).any()):
        _blame(file, text, held, columns, delimiter, unit, gaps)
    if lines is not None:
        lines.extend(i + 1 for i in held)
        return time, x, []
    where = "/".join(file.parts[-2:])
    return in_order(where, lambda k: f"{file}, line {held[k] + 1}", time, x, bad_time)


def _blame(
    file: Path,
    text: list[str],
    lines: list[int],
    columns: int,
    delimiter: str | None,
    unit: str,
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
            stamp = int(cells[0]) if unit == "ns" else as_nanoseconds(cells[0], unit)
            if "_" in cells[0] or not -(2**63) <= stamp < 2**63:
                raise ValueError
        except ValueError:
            likely = likely_unit(cells[0]) if unit != "ns" else None
            raise DataError(
                "the stamp is not a time",
                path=where,
                expected=f"decimal {_WORDS.get(unit, unit)}"
                if unit != "ns"
                else "integer nanoseconds, within 64 bits",
                got=repr(cells[0]),
                fix=f"these look like {_WORDS[likely]} since 1970: time.unit={likely}"
                if likely
                else "mend or delete the row",
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
