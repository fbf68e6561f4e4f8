"""Text that other tools read: a trajectory as TUM, the streams of a flight as one csv table.

Times go out as exactly as they came: all nanoseconds of a stamp are written.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flowgraph.data.files import put
from flowgraph.data.flight import Flight
from flowgraph.data.frames import part_words
from flowgraph.data.series import Series
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.types import leaves_of


def write_tum(series: Series, file: str | Path) -> None:
    """Write a trajectory as TUM text, `t x y z qx qy qz qw` a row, t in seconds with nine decimals.

    Trajectory tools such as evo read it. A series of attitudes alone is written with positions of zero, and
    says so in its first line.

    Args:
        series: with a field `attitude` (w, x, y, z, body to world), and mostly `position` (m).
        file: to be written.

    Raises:
        UnknownNameError: where there is no attitude.
        DataError: where there is no row, or one that is not finite.
        OutputError: where the file cannot be written.
    """
    if "attitude" not in series.leaves:
        raise UnknownNameError("field", "attitude", series.leaves, path=series.name)
    q = series["attitude"]
    placed = "position" in series.leaves
    p = series["position"] if placed else np.zeros((len(series), 3))
    table = np.concatenate([p, q[:, [1, 2, 3, 0]]], axis=1)
    broken = np.flatnonzero(~np.isfinite(table).all(axis=1))
    if not len(series) or len(broken):
        raise DataError(
            "this is no trajectory that can be written",
            path=f"{series.name}, row {broken[0]}" if len(broken) else series.name,
            expected="at least one row, all finite",
            got="a row that is not finite" if len(broken) else "no row",
            fix="write the part that is known: write_tum(series[mask], file)",
        )
    lines = ["# t[s] x[m] y[m] z[m] qx qy qz qw" + ("" if placed else "; attitude only, positions are zero")]
    for time, row in zip(series.time.tolist(), table.tolist(), strict=True):
        lines.append(f"{_seconds(time)} " + " ".join(map(repr, row)))
    put(file, "\n".join(lines) + "\n")


def write_table(flight: Flight, file: str | Path) -> None:
    """Write the streams and the truth of a flight as one csv table, which `table:FILE` reads.

    The head is `time`, in seconds with nine decimals, and a column a number, with its unit:
    `fix.position.0 [m]`. A row is a time at which any of them has a value; what has none then is empty. What
    is true is 1, what is not 0.

    Args:
        flight: of streams of numbers.
        file: to be written.

    Raises:
        OutputError: where the file cannot be written.
    """
    streams = {**flight.streams, **({} if flight.truth is None else {"truth": flight.truth})}
    times = np.unique(np.concatenate([s.time for s in streams.values()]))
    names, columns = ["time"], []
    for stream, series in streams.items():
        rows = np.searchsorted(times, series.time)
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            unit = f" [{type_.unit}]" if type_.unit and "," not in type_.unit else ""
            for at in np.ndindex(*array.shape[1:]):
                word = [] if field == "value" else [field]
                names.append(".".join([stream, *word, *part_words(field, array.shape[1:], at)]) + unit)
                column = [""] * len(times)
                part = array[(slice(None), *at)]
                values = (part.astype(np.int64) if part.dtype == bool else part).tolist()
                for row, value in zip(rows.tolist(), values, strict=True):
                    column[row] = repr(value) if value == value else ""
                columns.append(column)
    lines = [",".join(names)]
    lines += [",".join([_seconds(t), *row]) for t, *row in zip(times.tolist(), *columns, strict=True)]
    put(file, "\n".join(lines) + "\n")


def _seconds(time: int) -> str:
    """A time in ns as decimal seconds, to the last digit."""
    sign, (seconds, rest) = "-" if time < 0 else "", divmod(abs(time), 10**9)
    return f"{sign}{seconds}.{rest:09d}"


__all__ = ["write_table", "write_tum"]
