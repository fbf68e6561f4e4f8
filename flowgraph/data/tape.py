"""Ticks: the events of all sources put in one order, where all events of one time form one tick.

Recorded series become a `Tape`, whole and at once, with array operations; what comes as it goes is merged
tick by tick (`merged`). Either way a tick is a time and a key, with bit k set where source k is present.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.errors import DataError
from flowgraph.language.graph import NEVER, Graph
from flowgraph.types import DTYPES, ArrayType, StructType, Type, flatten, leaves_of, unflatten

_WIDE = 64
_FIRST, _MANY, _STRETCH = 1024, 32, 65_536
Rows = slice | np.ndarray


@dataclass(frozen=True)
class Tape:
    """Ticks of recorded sources: `time[i]` in ns, and `key[i]` with bit k set where source k is present.

    The keys are of the smallest kind of integer that has so many bits.
    """

    time: np.ndarray
    key: np.ndarray
    series: tuple[Series, ...]
    found: tuple[Rows, ...] | None = field(default=None, repr=False, compare=False)

    @classmethod
    def of(cls, series: tuple[Series, ...]) -> Tape:
        """The ticks of series that are each in order: their times merged, equal ones made one."""
        longest = max(series, key=len, default=None)
        time = np.zeros(0, np.int64) if longest is None else longest.time
        rows: list[Any] = [_rows(longest, s) for s in series] if longest is not None else []
        if any(r is None for r in rows):
            time = np.concatenate([s.time for s in series])
            time.sort(kind="stable")  # merges runs that are sorted already
            time = time[np.concatenate([[True], time[1:] != time[:-1]])]
            time.flags.writeable = False  # outputs share it
            rows = [_looked_up(time, s.time) for s in series]
        if len(time):
            need_near(int(time[0]), int(time[-1]))
        key = np.zeros(len(time), bits(len(series)))
        for k, r in enumerate(rows):
            key[r] |= 1 << k
        return cls(time, key, series, tuple(rows))

    def first(self, ticks: int) -> Tape:
        """The tape of the first ticks alone."""
        return self.part(0, ticks)

    def part(self, first: int, last: int) -> Tape:
        """The tape of the ticks from `first` on, before `last`."""
        before, key = self.key[:first], self.key[first:last]
        rows = [(int((before >> k & 1).sum()), int((key >> k & 1).sum())) for k in range(len(self.series))]
        series = tuple(s[n : n + count] for s, (n, count) in zip(self.series, rows, strict=True))
        return Tape(self.time[first:last], key, series)

    def times(self, patterns: Collection[int], first: int = 0, last: int | None = None) -> np.ndarray:
        """The times of the ticks with these patterns, from tick `first` on and before `last`."""
        time, key = self.time[first:last], self.key[first:last]
        asked = np.array(sorted(patterns), self.key.dtype)
        return time if set(patterns_of(key)) <= set(patterns) else time[np.isin(key, asked)]

    @property
    def rows(self) -> tuple[Rows, ...]:
        """For each source at which ticks it is present: a slice where that is each n-th, or their places."""
        if self.found is not None:
            return self.found
        return tuple(np.flatnonzero(self.key >> k & 1) for k in range(len(self.series)))

    @property
    def patterns(self) -> tuple[int, ...]:
        """The keys that occur, in order."""
        return patterns_of(self.key)


def bits(sources: int) -> Any:
    """The smallest kind of integer with a bit for each of so many sources."""
    return next((k for k in (np.uint8, np.uint16, np.uint32) if np.iinfo(k).bits >= sources), np.int64)


def patterns_of(key: np.ndarray) -> tuple[int, ...]:
    """The keys that occur, in order: of each stretch those at its start, and what else is behind them."""
    found: set[int] = set()
    for first in range(0, len(key), _STRETCH):
        rest = key[first : first + _STRETCH]
        while len(rest):
            others = np.ones(len(rest), dtype=bool)
            for known in found:
                others &= rest != known
            if not others.any():
                break
            rest = rest[others]
            found.update(rest[:_FIRST].tolist())
            if len(found) > _MANY:
                return tuple(sorted(found.union(np.unique(key).tolist())))
    return tuple(sorted(found))


def check_stamp(name: str, time: Any) -> int:
    """A time as it arrives with an event, as an int.

    Raises:
        DataError: where it is no whole number of ns within 64 bits.
    """
    if not isinstance(time, int | np.integer) or isinstance(time, bool):
        raise DataError(
            "times must be integer nanoseconds",
            path=name,
            expected="an int",
            got=f"{type(time).__name__} {time!r}",
            fix="round float seconds once, at the source: round(seconds * 1e9)",
        )
    if not NEVER < time < 2**63:
        raise DataError(
            "this time does not fit 64 bits",
            path=name,
            expected="nanoseconds between -2^63 and 2^63, some 292 years to either side",
            got=str(time) if abs(int(time)) < 10**30 else "a number of more than 30 digits",
            fix="count nanoseconds from a nearer day",
        )
    return int(time)


def need_near(first: int, time: int) -> None:
    """Refuse a tick whose distance from the first of a run is none that int64 nanoseconds hold.

    Raises:
        DataError: naming both times.
    """
    if time - first >= 2**63:
        raise DataError(
            "two ticks of a run are too far apart",
            path=f"t = {time} ns",
            expected="less than 2^63 ns, 292 years, between the first and the last",
            got=f"{time - first} ns",
            fix="check the unit and the origin of the stamps: one source may count from another time",
        )


def _rows(every: Series, some: Series) -> Rows | None:
    """Where the times of some values lie among those of a longer series; None if one is not there."""
    time, wanted = every.time, some.time
    if wanted is time or (len(wanted) == len(time) and np.array_equal(wanted, time)):
        return slice(None)
    if _is_even(every) and _is_even(some):
        return _each_nth(int(wanted[0]) - int(time[0]), some.steps[0], len(wanted), every)
    if len(wanted) > 1:
        first, second = np.searchsorted(time, wanted[:2]).tolist()
        ticks = slice(first, first + (second - first) * len(wanted), max(second - first, 1))
        if np.array_equal(time[ticks], wanted):
            return ticks
    rows = _looked_up(time, wanted)
    return rows if np.array_equal(time.take(rows, mode="clip"), wanted) else None


def _is_even(series: Series) -> bool:
    """Whether its times are equally far apart."""
    least, most = series.steps
    return least == most > 0


def _each_nth(after: int, period: int, count: int, every: Series) -> slice | None:
    """The ticks of `count` values, the first `after` that of an even series; None where one has none."""
    first, past = divmod(after, every.steps[0])
    step, rest = divmod(period, every.steps[0])
    if past or rest or first < 0 or first + step * (count - 1) >= len(every):
        return None
    return slice(first, first + step * count, step)


def _looked_up(time: np.ndarray, some: np.ndarray) -> np.ndarray:
    """Rows of `some` times among all; counted where these are equally far apart, and else looked for."""
    if len(time) > 1 and len(some) and time[0] <= some[0] and some[-1] <= time[-1]:
        step = (int(time[-1]) - int(time[0])) // (len(time) - 1)
        if step > 0 and int(time[-1]) - int(time[0]) < 2**63:
            rows = (some - time[0]) // step
            if rows[-1] < len(time) and np.array_equal(time.take(rows, mode="clip"), some):
                return np.asarray(rows)
    return np.searchsorted(time, some)


def tape(
    prepared: Mapping[str, Series | Iterator[tuple[int, Any]]], graph: Graph, *, like: Tape | None = None
) -> Tape:
    """All events as a tape; iterables are read to their end first.

    With `like`, a tape of the same graph, its arrays of ticks are taken where all times are the same.
    """
    series = tuple(
        s if isinstance(s, Series) else read_all(name, s, graph.sources[name].type)
        for name, s in prepared.items()
    )
    if like is not None and all(
        s.time is other.time or np.array_equal(s.time, other.time)
        for s, other in zip(series, like.series, strict=True)
    ):
        return Tape(like.time, like.key, series, like.found)
    return Tape.of(series)


def read_all(name: str, events: Iterable[tuple[int, Any]], type_: Type) -> Series:
    """A series from an iterable of (time, value)."""
    return stack(*_columns(events), type_, name)


def _columns(events: Iterable[tuple[int, Any]]) -> tuple[list[int], list[Any]]:
    pairs = list(events)
    return [t for t, _ in pairs], [v for _, v in pairs]


def stack(times: Sequence[int] | np.ndarray, values: list[Any], type_: Type, name: str) -> Series:
    """A series from times and single values."""
    leaves = leaves_of(type_)
    if len(leaves) == 1 and not isinstance(type_, StructType):
        columns: Iterable[Any] = [values]
    elif (
        values
        and isinstance(type_, StructType)
        and all(not isinstance(t, StructType) for _, t in type_.fields)
    ):
        getter: Callable[[Any, str], Any] = (
            getattr if type_.cls not in (tuple, dict) else lambda v, n: v[int(n) if type_.cls is tuple else n]
        )
        columns = [[getter(v, n) for v in values] for n, _ in type_.fields]
    else:
        columns = [list(c) for c in zip(*(flatten(v, type_) for v in values), strict=True)] or [
            [] for _ in leaves
        ]
    return joined(times, columns, type_, name)


def joined(times: Sequence[int] | np.ndarray, columns: Iterable[list[Any]], type_: Type, name: str) -> Series:
    """A series from times and a list of values for each leaf."""
    made = [_stacked(column, leaf) for column, (_, leaf) in zip(columns, leaves_of(type_), strict=True)]
    return Series(np.asarray(times, dtype=np.int64), unflatten(type_, iter(made)), type=type_, name=name)


def _stacked(column: Any, leaf: ArrayType) -> np.ndarray:
    """One array (n, ...) of n values of a leaf."""
    kind = DTYPES[leaf.dtype]
    wide = math.prod(d for d in leaf.shape if isinstance(d, int)) >= _WIDE
    if wide and column and all(type(x) is np.ndarray and x.shape == leaf.shape for x in column):
        whole = np.concatenate(column)  # copies whole arrays, where `asarray` asks each for its numbers
        return whole.astype(kind, copy=False).reshape(len(column), *leaf.shape)
    return np.asarray(column, dtype=kind).reshape(len(column), *leaf.shape)


def merged(
    prepared: Mapping[str, Series | Iterator[tuple[int, Any]]],
) -> tuple[Iterator[tuple[int, int]], list[Callable[[], Any]]]:
    """Ticks `(time, key)` in order, and for each source a function that gives its next value.

    Recorded series are merged at once with array operations; an iterable is read one event ahead.
    """
    if all(isinstance(s, Series) for s in prepared.values()):
        recorded = [s for s in prepared.values() if isinstance(s, Series)]
        ticks_ = Tape.of(tuple(recorded))
        return (
            zip(ticks_.time.tolist(), ticks_.key.tolist(), strict=True),
            [iter(s).__next__ for s in recorded],
        )
    feeds = [zip(s.time.tolist(), s, strict=True) if isinstance(s, Series) else s for s in prepared.values()]
    waiting: list[deque[Any]] = [deque() for _ in feeds]  # ticks may be read ahead of the values

    def ticks() -> Iterator[tuple[int, int]]:
        heads = [next(f, None) for f in feeds]
        first: int | None = None
        while any(h is not None for h in heads):
            now = min(h[0] for h in heads if h is not None)
            first = now if first is None else first
            need_near(first, now)
            key = 0
            for k, head in enumerate(heads):
                if head is not None and head[0] == now:
                    key |= 1 << k
                    waiting[k].append(head[1])
            yield now, key
            heads = [next(feeds[k], None) if key >> k & 1 else h for k, h in enumerate(heads)]

    return ticks(), [queue.popleft for queue in waiting]


def batches(ticks: Iterator[tuple[int, int]], size: int) -> Iterator[list[tuple[int, int]]]:
    """Ticks in lists of at most `size`."""
    while batch := list(itertools.islice(ticks, size)):
        yield batch
