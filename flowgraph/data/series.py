"""A recorded signal: integer times and one array a field, and the flights made of them.

`Series` is the one form of recorded data: what a dataset loader returns, what a run consumes and what a
run gives back. Signals are batch-first: each leaf has the time axis in front.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.by_name import ByName
from flowgraph.data.frames import frame_of, signal_of, stamps_of
from flowgraph.data.stamps import extreme_steps, from_dates, settled
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.types import (
    DTYPES,
    ArrayType,
    Signal,
    StructType,
    Type,
    flatten,
    leaves_of,
    struct_type,
    type_of,
    unflatten,
)
from flowgraph.verbs import verb


class Series(ByName[Any]):
    """`n` values of one signal with their times.

    Args:
        time: (n,) int64 nanoseconds, or datetime64 or timedelta64, increasing.
        values: a `Signal`, tuple or array whose leaves have a leading axis of length n. A masked entry of a
            masked array is NaN.
        type: the type of one value; found from `values` where it is left out.
        name: what to call it in messages.
        gaps: whether a NaN is data, an entry that was not measured; otherwise a run refuses it.
        stamp: (n,) int64 ns, when each value was true, where that is before `time`, when it arrived and makes
            a tick; in any order. Left out, a value is true when it arrives, and nothing is kept.

    A leaf is an attribute (`series.position`) or an item (`series["pose.position"]`).

    Raises:
        DataError: when lengths differ, or a value was true after it arrived.
    """

    def __init__(
        self,
        time: npt.ArrayLike,
        values: Any,
        *,
        type: Type | None = None,
        name: str = "series",
        gaps: bool = False,
        stamp: npt.ArrayLike | None = None,
    ) -> None:
        if isinstance(time, np.ma.MaskedArray) and np.ma.is_masked(time):
            raise _only_real(f"{name}: time")
        stamps = _array(time, name)
        if stamps.dtype.kind in "mM":
            stamps = from_dates(stamps, name)
        if stamps.size and stamps.dtype.kind not in "iu":
            raise DataError(
                "times must be integer nanoseconds",
                path=name,
                expected="an int64 array",
                got=f"dtype {stamps.dtype}",
                fix="round float seconds once, at the source: Series.from_seconds(seconds, values)",
            )
        if stamps.ndim != 1:
            raise DataError(
                "times must be one array",
                path=name,
                expected="shape (n,)",
                got=f"shape {stamps.shape}",
                fix="flatten them: one time stamp a value",
            )
        if stamps.dtype == np.uint64 and len(stamps) and stamps.max() >= 2**63:
            raise DataError(
                "a time is beyond what int64 nanoseconds hold",
                path=f"{name}, row {int(stamps.argmax())}",
                expected="times below 2^63 ns",
                got=str(stamps.max()),
                fix="check the unit of the stamps: they are nanoseconds",
            )
        self.time = settled(stamps)
        self._steps: tuple[int, int] | None = None
        self._stamp = None if stamp is None else _true_at(stamp, self.time, name)
        self.name, self.gaps = name, gaps
        self.type = type if type is not None else _one_of(values, name)
        self._leaves: list[np.ndarray] = []
        for leaf, (leaf_name, leaf_type) in zip(
            flatten(values, self.type), leaves_of(self.type), strict=True
        ):
            array: np.ndarray = _array(leaf, name, DTYPES[leaf_type.dtype])
            if array.shape != (len(self.time), *leaf_type.shape):
                raise DataError(
                    f"field {leaf_name!r} does not have one value a time stamp",
                    path=name,
                    expected=f"shape {(len(self.time), *leaf_type.shape)}",
                    got=f"shape {array.shape}",
                    fix="give every field a leading axis of the same length as time",
                )
            view = array.view()
            view.flags.writeable = False  # a block must not change what others read
            self._leaves.append(view)

    @classmethod
    def from_seconds(cls, seconds: npt.ArrayLike, values: Any, **more: Any) -> Series:
        """A series from float seconds, each rounded once to the nearest nanosecond."""
        given = _array(seconds, f"{more.get('name', 'series')}: time", np.float64)
        stamps = np.rint(given * 1e9)
        if not (np.abs(stamps) < 2.0**63).all():
            raise DataError(
                "a time is not finite, or beyond what int64 nanoseconds hold",
                path=str(more.get("name", "series")), expected="seconds below 9.2e9",
                got=repr(float(given[~(np.abs(stamps) < 2.0**63)][0])), fix="drop such rows at the source",
            )  # fmt: skip
        return cls(stamps.astype(np.int64), values, **more)

    @classmethod
    def from_pandas(
        cls,
        frame: Any,
        signal: Any = None,
        *,
        columns: Any = None,
        time: str | None = None,
        unit: str | None = None,
        **more: Any,
    ) -> Series:
        """A series from a pandas `DataFrame` or `Series`.

        Args:
            frame: with a row a sample.
            signal: the class of the signal; without it, the values are an array.
            columns: by field of the signal, `{"gyro": ["wx", "wy", "wz"]}`, or of the array; if left out,
                the names that `to_pandas` gives, or all columns.
            time: the column of the stamps; the index if left out, which must not only count rows.
            unit: "s", "ms", "us" or "ns" of stamps that are numbers; whole numbers are ns if left out.
            more: `name`, `gaps` or `type`, as of `Series`.

        Raises:
            DataError: for an index that is no clock, or columns that hold no numbers.
            UnknownNameError: for a column or a unit that is not there.
        """
        name = str(more.get("name", "series"))
        stamps = stamps_of(frame, time, unit, name)
        return cls(stamps, signal_of(frame, signal, columns, time, name), **more)

    def to_pandas(self) -> Any:
        """A pandas `DataFrame` with a column a number (`position.x`), by `time` in int64 ns. Needs pandas."""
        return frame_of(self.time, self.leaves, self.type)

    @property
    def leaves(self) -> dict[str, np.ndarray]:
        """The leaf arrays by dotted name, in declaration order; a lone leaf is called "value"."""
        return {name: a for (name, _), a in zip(leaves_of(self.type), self._leaves, strict=True)}

    @property
    def values(self) -> Any:
        """All values at once: one signal with a leading time axis on each field."""
        return unflatten(self.type, iter(self._leaves))

    @property
    def stamp(self) -> np.ndarray:
        """(n,) int64 ns, when each value was true; `time` where nothing else was said."""
        return self.time if self._stamp is None else self._stamp

    @property
    def steps(self) -> tuple[int, int]:
        """The shortest and the longest time from one value to the next, in ns; looked for once."""
        if self._steps is None or self.time.flags.writeable:
            self._steps = extreme_steps(self.time)
        return self._steps

    @property
    def is_late(self) -> bool:
        """Whether stamps of its own say when its values were true."""
        return self._stamp is not None

    @property
    def seconds(self) -> np.ndarray:
        """(n,) times in seconds since the first."""
        return (self.time - self.time[0]) * 1e-9 if len(self.time) else np.zeros(0)

    def holding(self, values: Any, name: str | None = None) -> Series:
        """Other values at the times and stamps of this series, with its rule for gaps."""
        return Series(self.time, values, name=name or self.name, gaps=self.gaps, stamp=self._stamp)

    def __len__(self) -> int:
        return len(self.time)

    def __getitem__(self, key: Any) -> Any:
        """A leaf or inner struct by dotted name, one value by index, or a part by slice or mask."""
        if isinstance(key, str):
            part: Any = self.values
            type_: Type = self.type
            if isinstance(type_, ArrayType) and key == "value":
                return part
            for name in key.split("."):
                names = [n for n, _ in type_.fields] if isinstance(type_, StructType) else []
                if name not in names:
                    raise UnknownNameError("field", key, self.leaves, path=self.name)
                index = names.index(name)
                part = (
                    part[index]
                    if isinstance(part, tuple)
                    else part[name]
                    if isinstance(part, dict)
                    else getattr(part, name)
                )
                type_ = type_.fields[index][1] if isinstance(type_, StructType) else type_
            return part
        picked = [leaf[key] for leaf in self._leaves]
        if np.ndim(self.time[key]) == 0:
            return unflatten(self.type, iter(picked))
        part = unflatten(self.type, iter(picked))
        stamp = None if self._stamp is None else self._stamp[key]
        return Series(self.time[key], part, type=self.type, name=self.name, gaps=self.gaps, stamp=stamp)

    def _names(self) -> Iterable[str]:
        return {name.partition(".")[0] for name in self.leaves}

    def _repr_html_(self) -> str:
        return str(verb("Series._repr_html_")(self))

    def __iter__(self) -> Iterator[Any]:
        """One value after the other, as a block sees them."""
        if (
            isinstance(self.type, StructType)
            and issubclass(self.type.cls, Signal)
            and not any(isinstance(t, StructType) for _, t in self.type.fields)
        ):
            return map(self.type.cls, *self._leaves)  # the common case, at the speed of map
        if isinstance(self.type, ArrayType):
            return iter(self._leaves[0])
        return (unflatten(self.type, iter(row)) for row in zip(*self._leaves, strict=True))

    def __repr__(self) -> str:
        span = f"{(self.time[-1] - self.time[0]) * 1e-9:.3f} s" if len(self) else "empty"
        return f"<Series {self.name}: {len(self)} x {self.type}, {span}>"


def chained(parts: Sequence[Series]) -> Series:
    """Series of one type, one after the other, as one; named as the last, with its rule for gaps."""
    last = parts[-1]
    time, *leaves = (
        np.concatenate(arrays) for arrays in zip(*((p.time, *p.leaves.values()) for p in parts), strict=True)
    )
    time.flags.writeable = False  # nobody else has it: no copy is made
    stamp = np.concatenate([p.stamp for p in parts]) if any(p.is_late for p in parts) else None
    values = unflatten(last.type, iter(leaves))
    return Series(time, values, type=last.type, name=last.name, gaps=last.gaps, stamp=stamp)


def _array(values: Any, name: str, dtype: Any = None) -> np.ndarray:
    """An array of what was given, if it is one; NaN where it is masked."""
    values = unmasked(values, name, dtype)
    try:
        return np.asarray(values, dtype=dtype)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(
            "this is no array of numbers",
            path=name,
            expected="numbers, the same shape in every row",
            got=str(error),
            fix="give rows of one length, padded where they are shorter",
        ) from None


def _true_at(stamp: npt.ArrayLike, time: np.ndarray, name: str) -> np.ndarray:
    """The times of validity (n,) of values that arrived at `time`."""
    found = _array(stamp, f"{name}.stamp")
    if found.shape != time.shape or found.dtype.kind not in "iu":
        raise DataError(
            "the stamps are not one a value",
            path=f"{name}.stamp",
            expected=f"int64 ns of shape {time.shape}",
            got=f"{found.dtype} of shape {found.shape}",
            fix="give the time of validity of each value, or leave stamp out",
        )
    early = np.flatnonzero(found > time)
    if len(early):
        row = int(early[0])
        raise DataError(
            "a value was true only after it arrived",
            path=f"{name}.stamp, row {row} ({len(early)} in all)",
            expected=f"at most {int(time[row])} ns, its arrival",
            got=f"{int(found[row])} ns",
            fix="bring both times to one clock: STREAM.time_offset moves the stamps of a recording",
        )
    found = found.astype(np.int64)
    found.flags.writeable = False
    return found


def unmasked(values: Any, name: str, dtype: Any = None) -> Any:
    """Values without a mask, in signals and tuples too: what was masked is NaN, and goes by `not_finite`.

    Args:
        values: of any kind; what has no mask is given back as it is.
        name: for messages.
        dtype: what they will be; whole numbers can be masked where it is real.

    Raises:
        DataError: where what is masked is not real.
    """
    if isinstance(values, Signal):
        parts = {n: getattr(values, n) for n, _ in struct_type(type(values)).fields}
        plain = {n: unmasked(v, f"{name}.{n}", dtype) for n, v in parts.items()}
        same = all(plain[n] is v for n, v in parts.items())
        return values if same else type(values)(**plain)
    if isinstance(values, Mapping):
        return {n: unmasked(v, f"{name}.{n}", dtype) for n, v in values.items()}
    if isinstance(values, list | tuple):
        inner: Sequence[Any] = values
        if isinstance(values, list) and any(isinstance(v, np.ma.MaskedArray) for v in inner):
            values = np.ma.stack([np.ma.asanyarray(v) for v in inner])
        elif isinstance(values, tuple) and any(
            isinstance(v, np.ma.MaskedArray | Signal | tuple) for v in inner
        ):
            return tuple(unmasked(v, f"{name}.{i}", dtype) for i, v in enumerate(inner))
    if not isinstance(values, np.ma.MaskedArray):
        return values
    if not np.ma.is_masked(values):
        return values.data
    if values.dtype.kind != "f":
        if values.dtype.kind not in "iu" or dtype is None or np.dtype(dtype).kind != "f":
            raise _only_real(name)
        values = values.astype(np.float64)
    return values.filled(np.nan)


def _only_real(name: str) -> DataError:
    return DataError(
        "a masked entry is no real number",
        path=name,
        expected="masks of real numbers only: what is masked becomes NaN",
        got="a mask of times, whole numbers or booleans",
        fix="leave such rows out, or convert them: values.astype(float)",
    )


def _one_of(values: Any, name: str) -> Type:
    """The type of one value, given values with a leading axis."""
    if isinstance(values, Signal):
        declared = struct_type(type(values))
        parts = tuple(
            (
                n,
                _one_of(getattr(values, n), f"{name}.{n}")
                if isinstance(t, StructType)
                else _drop_axis(t, getattr(values, n), f"{name}.{n}"),
            )
            for n, t in declared.fields
        )
        return StructType(declared.name, parts, declared.cls)
    if isinstance(values, tuple):
        return StructType(
            "tuple", tuple((str(i), _one_of(v, f"{name}.{i}")) for i, v in enumerate(values)), tuple
        )
    return _drop_axis(None, values, name)


def _drop_axis(declared: ArrayType | None, values: Any, name: str) -> ArrayType:
    real = declared is not None and declared.dtype == "real"
    array = _array(unmasked(values, name, np.float64 if real else None), name)
    if array.dtype.kind in "iu" and declared is not None and declared.dtype == "real":
        array = array.astype(np.float64)
    batch = type_of(array)
    assert isinstance(batch, ArrayType)
    if declared is not None:
        return ArrayType(batch.shape[1:], declared.dtype, declared.unit, declared.frame)
    return ArrayType(batch.shape[1:], batch.dtype)
