"""pandas: recordings out of data frames, and results into them, column by column.

A frame's clock is its index or one of its columns: dates and spans of any resolution become whole nanoseconds
without a float. An index that only counts rows is no clock. A missing value (NA, None, NaN) is NaN.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import DataError, DeclarationError, MissingDependencyError, UnknownNameError
from flowgraph.types import ArrayType, StructType, Type, leaves_of, struct_type

__all__ = ["columns_of", "frame_of", "part_words", "signal_of", "stamps_of"]

UNITS = {"ns": 1, "us": 10**3, "ms": 10**6, "s": 10**9}
"""Of numbers that are stamps, in ns."""

_AXES = {"xyz": "xyz", "wxyz": "wxyz"}


def stamps_of(frame: Any, time: str | None, unit: str | None, name: str) -> np.ndarray:
    """The times (n,) int64 ns of a pandas frame or series.

    Args:
        frame: a `DataFrame`, or a `Series` whose index is its clock.
        time: the column of the stamps; the index if left out.
        unit: of stamps that are numbers, of `UNITS`; whole numbers are ns if it is left out.
        name: for messages.

    Raises:
        DataError: where the index only counts rows, or a stamp is missing, no time or beyond 64 bits.
    """
    pandas = _pandas("Series.from_pandas")
    if unit is not None and unit not in UNITS:
        raise UnknownNameError("unit of time", unit, UNITS, path=name)
    index = frame.index if time is None else pandas.Index(_column(frame, time, name))
    if index.nlevels > 1:
        raise _no_clock(
            name, "one stamp a row", f"an index of {index.nlevels} levels", "name its column: time="
        )
    counted = index.name is None and index.dtype.kind in "iu" and len(index) > 1
    spaced = unit is not None and getattr(index, "step", 1) != 1  # 0, 10, 20 of ms are evenly spaced stamps
    if time is None and (
        (isinstance(index, pandas.RangeIndex) and not spaced)
        or (counted and np.array_equal(index, np.arange(len(index))))
    ):
        raise DataError(
            "this index counts rows: it is no clock",
            path=name,
            expected="an index of times, or the name of a column of stamps",
            got=f"{type(index).__name__} from {index[0]} to {index[-1]}" if len(index) else "no rows",
            fix='say which column has the stamps: from_pandas(frame, time="t")',
        )
    if index.hasnans:
        raise _no_clock(name, "a stamp in each row", "a missing stamp", "drop such rows: frame.dropna()")
    if isinstance(index, pandas.DatetimeIndex | pandas.TimedeltaIndex):
        try:
            return np.array(index.as_unit("ns").asi8)
        except (ValueError, OverflowError) as error:
            raise _no_clock(name, "times from 1677 to 2262", str(error), "drop such rows") from None
    kind = index.dtype.kind
    if kind in "iu":
        size = UNITS[unit or "ns"]
        if len(index) and not -(2**63) <= int(index.min()) * size <= int(index.max()) * size < 2**63:
            raise _no_clock(name, "stamps within 64 bits of ns", f"up to {index.max()}", "check their unit")
        return np.asarray(index.to_numpy(dtype=np.int64) * size)
    if kind == "f" and unit is not None:
        stamps = np.rint(index.to_numpy(dtype=np.float64) * UNITS[unit])
        if not (np.abs(stamps) < 2.0**63).all():
            raise _no_clock(name, "stamps within 64 bits of ns", "one beyond", "check their unit")
        return np.asarray(stamps.astype(np.int64))
    fix = (
        "from_pandas(frame, ..., unit=...) says their unit"
        if kind == "f"
        else "convert them: pandas.to_datetime"
    )
    raise _no_clock(name, "dates, spans, whole numbers, or numbers of a unit", f"dtype {index.dtype}", fix)


def _no_clock(name: str, expected: str, got: str, fix: str) -> DataError:
    return DataError("these are no times", path=name, expected=expected, got=got, fix=fix)


def signal_of(
    frame: Any,
    signal: Any,
    columns: Sequence[str] | Mapping[str, str | Sequence[str]] | None,
    time: str | None,
    name: str,
) -> Any:
    """The values of a pandas frame: a signal, or an array (n,) or (n, k) where no signal is named.

    Args:
        frame: a `DataFrame` or a `Series`.
        signal: the class of the signal, or None.
        columns: by field of the signal, or of the array; if left out, `FIELD.x`, `FIELD.0` and so on, as
            `frame_of` names them, or all columns.
        time: the column of the stamps, which is no value.
        name: for messages.

    Raises:
        UnknownNameError: for a column that is not there; DataError: for one that holds no numbers.
    """
    if signal is None:
        if not hasattr(frame, "columns"):
            return _numbers(frame, name)
        if isinstance(columns, Mapping):
            raise DeclarationError(
                "columns by field are of a signal",
                path=name,
                expected="from_pandas(frame, Signal, columns={...}), or a list of columns",
                got="columns by field, and no signal",
                fix="name the signal",
            )
        if isinstance(columns, str):
            return _numbers(_column(frame, columns, name), name)
        chosen = [c for c in frame.columns if c != time] if columns is None else list(columns)
        arrays = [_numbers(_column(frame, c, name), f"{name}.{c}") for c in chosen]
        return arrays[0] if len(arrays) == 1 and columns is None else np.stack(arrays, axis=1)
    given = columns if isinstance(columns, Mapping) else None
    if columns is not None and given is None:
        raise DeclarationError(
            "the columns of a signal go by its fields",
            path=name,
            expected="{" + ", ".join(f"{n!r}: [...]" for n, _ in struct_type(signal).fields) + "}",
            got=repr(columns)[:80],
            fix="give a mapping from field to columns",
        )
    return _made(frame, struct_type(signal), given, "", name)


def _made(frame: Any, type_: StructType, given: Mapping[str, Any] | None, prefix: str, name: str) -> Any:
    parts = {}
    for field, inner in type_.fields:
        path = prefix + field
        if isinstance(inner, StructType):
            parts[field] = _made(frame, inner, given, path + ".", name)
        elif given is None:
            parts[field] = _named(frame, path, name)
        elif path not in given:
            raise DataError(
                f"no columns are given for {path!r}",
                path=name,
                expected="columns for " + ", ".join(n for n, _ in leaves_of(type_)),
                got=", ".join(given),
                fix=f"add {path!r} to columns",
            )
        elif isinstance(given[path], str):
            parts[field] = _numbers(_column(frame, given[path], name), f"{name}.{path}")
        else:
            arrays = [_numbers(_column(frame, c, name), f"{name}.{path}") for c in given[path]]
            parts[field] = np.stack(arrays, axis=1)
    return type_.cls(**parts)


def _named(frame: Any, path: str, name: str) -> np.ndarray:
    """The columns `PATH`, or `PATH.x`, `PATH.0.1` and so on, as one array."""
    if path in frame.columns:
        return _numbers(_column(frame, path, name), f"{name}.{path}")
    found = {str(c)[len(path) + 1 :]: c for c in frame.columns if str(c).startswith(path + ".")}
    letters = "".join(sorted(found, key="wxyz".find))
    if letters in _AXES and len(found) == len(letters):
        arrays = [_numbers(_column(frame, found[axis], name), f"{name}.{path}") for axis in letters]
        return np.stack(arrays, axis=1)
    places = {tuple(map(int, s.split("."))): c for s, c in found.items() if re.fullmatch(r"\d+(\.\d+)*", s)}
    if not places or len({len(p) for p in places}) > 1:
        raise UnknownNameError("column", path, [str(c) for c in frame.columns], path=name)
    shape = tuple(max(axis) + 1 for axis in zip(*places, strict=True))
    whole = np.empty((len(frame), *shape))
    for at in np.ndindex(*shape):
        if at not in places:
            raise UnknownNameError(
                "column", ".".join([path, *map(str, at)]), [str(c) for c in frame.columns], path=name
            )
        whole[(slice(None), *at)] = _numbers(_column(frame, places[at], name), f"{name}.{path}")
    return whole


def _column(frame: Any, column: Any, name: str) -> Any:
    if not hasattr(frame, "columns") or column not in frame.columns:
        raise UnknownNameError(
            "column", str(column), [str(c) for c in getattr(frame, "columns", ())], path=name
        )
    found = frame[column]
    if hasattr(found, "columns"):
        raise DataError(
            f"{column!r} is ambiguous: several columns have this name",
            path=name,
            expected="a name that one column has",
            got=f"{len(found.columns)} columns",
            fix="rename the columns of the frame",
        )
    return found


def _numbers(column: Any, name: str) -> np.ndarray:
    """A column as an array; NaN where a value is missing."""
    if isinstance(column.dtype, np.dtype) and column.dtype.kind in "iufb":
        return np.asarray(column.to_numpy())
    try:
        if column.dtype.kind in "iub" and not column.isna().any():
            return np.asarray(column.to_numpy(dtype=np.dtype(column.dtype.kind + str(column.dtype.itemsize))))
        return np.asarray(column.to_numpy(dtype=np.float64, na_value=np.nan))
    except (TypeError, ValueError) as error:
        raise DataError(
            "this column holds no numbers",
            path=name,
            expected="numbers, or NA where nothing was measured",
            got=f"dtype {column.dtype}: {error}",
            fix="convert it: pandas.to_numeric",
        ) from None


def frame_of(time: np.ndarray, leaves: Mapping[str, np.ndarray], type_: Type) -> Any:
    """A pandas frame with a column a number: `position.x`, `covariance.0.1`; the index is int64 ns, `time`.

    Raises:
        MissingDependencyError: without pandas.
    """
    pandas = _pandas("to_pandas")
    return pandas.DataFrame(columns_of(leaves, type_), index=pandas.Index(time, name="time"))


def columns_of(leaves: Mapping[str, np.ndarray], type_: Type) -> dict[str, np.ndarray]:
    """A column (n,) a number, by the name of its field and part: `position.x`, `covariance.0.1`."""
    columns: dict[str, np.ndarray] = {}
    for name, array in leaves.items():
        lone = isinstance(type_, ArrayType)
        for at in np.ndindex(*array.shape[1:]):
            words = [] if lone else [name]
            words += part_words(name, array.shape[1:], at)
            columns[".".join(words) or name] = array[(slice(None), *at)]
    return columns


def part_words(name: str, shape: tuple[int, ...], at: tuple[int, ...]) -> list[str]:
    """What to call a number of a field."""
    turn = any(word in name for word in ("attitude", "quaternion", "orientation"))
    if shape == (3,) or (shape == (4,) and turn):
        return [("xyz" if shape == (3,) else "wxyz")[at[0]]]
    return list(map(str, at))


def _pandas(who: str) -> Any:
    try:
        import pandas  # may be absent
    except ImportError:
        raise MissingDependencyError(
            f"{who} needs pandas",
            expected="the Python package pandas",
            got="it cannot be imported",
            fix='pip install "flowgraph-filters[pandas]"',
        ) from None
    return pandas
