"""Recordings and what a run gave back, in forms that other tools read: TUM text, tables, xarray.

Times go out as exactly as they came: all nanoseconds of a stamp are written.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.data.files import put
from flowgraph.data.frames import part_words
from flowgraph.data.series import Flight, Series
from flowgraph.errors import DataError, MissingDependencyError, UnknownNameError
from flowgraph.types import leaves_of

if TYPE_CHECKING:
    from flowgraph.data.result import Result


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
    `fix.position.0 [m]`. A row is a time at which any of them has a value; what has none then is empty.

    Args:
        flight: of streams of real numbers.
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
                values = array[(slice(None), *at)].tolist()
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


_AXES = {3: ["x", "y", "z"], 4: ["w", "x", "y", "z"]}


def to_xarray(result: Result) -> Any:
    """An `xarray.DataTree` with a dataset a stream, each with a `time` of its own.

    A variable has the dimension `time` (int64 ns), and one more for each axis of its field, named
    FIELD_axis, or FIELD_axis0 and so on; vectors and attitudes have coordinates x, y, z and w, x, y, z. Unit
    and frame are attributes.

    Raises:
        MissingDependencyError: without xarray.
    """
    try:
        import xarray  # may be absent
    except ImportError:
        raise MissingDependencyError(
            "to_xarray needs xarray",
            expected="the Python package xarray",
            got="it cannot be imported",
            fix='pip install "flowgraph-filters[xarray]"',
        ) from None
    about = {"graph": result.graph, "engine": result.engine, "ticks": result.ticks, **result.stats}
    streams = {}
    for name, series in result.series.items():
        variables: dict[str, Any] = {}
        coordinates: dict[str, Any] = {"time": ("time", series.time, {"long_name": "time", "units": "ns"})}
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            many = len(type_.shape) > 1
            dims = [f"{field}_axis{k if many else ''}" for k in range(len(type_.shape))]
            said = {k: v for k, v in (("units", type_.unit), ("frame", type_.frame)) if v}
            variables[field] = (["time", *dims], array, said)
            words = ("attitude", "quaternion", "orientation")
            if len(dims) == 1 and (
                array.shape[1] == 3 or (array.shape[1] == 4 and any(w in field for w in words))
            ):
                coordinates[dims[0]] = (dims[0], _AXES[array.shape[1]])
        streams[name] = xarray.Dataset(variables, coordinates)
    tree = xarray.DataTree.from_dict(streams, name=result.graph)
    tree.attrs.update(about)
    return tree


__all__ = ["to_xarray", "write_table", "write_tum"]
