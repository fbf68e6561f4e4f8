"""What goes into a run: events of each source, checked against its declared clock, merged into ticks.

A source is given as a `Series`, as a pair `(times, values)` of arrays, or as any iterable of
`(time, value)` pairs, read lazily. All events of one time form one tick. Nothing is repaired in silence:
stamps out of order, two events of one source at one time, values that are not finite, and stamps that do
not keep to the declared clock are refused unless the source names a rule.
"""

from __future__ import annotations

import itertools
import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.series import Flight, Series
from flowgraph.errors import ClockError, DataError, TypeMismatchError, UnknownNameError
from flowgraph.language.clock import Timing, aperiodic, nanoseconds, periodic
from flowgraph.language.graph import NEVER, Graph
from flowgraph.types import DTYPES, StructType, Type, as_value, check_fits, flatten, leaves_of, unflatten

Inputs = Flight | Mapping[str, Any]


def arrays(
    time: npt.ArrayLike,
    values: Any,
    *,
    duplicates: str = "raise",
    not_finite: str = "raise",
    name: str = "source",
) -> Series:
    """A source from arrays, with rules for what is otherwise refused.

    Args:
        time: (n,) integer nanoseconds, in order.
        values: a signal or array with a leading axis of length n.
        duplicates: of two events at one time "raise", or keep the "first" or "last".
        not_finite: where a value is NaN or infinite "raise", or treat the event as "absent"; "keep" lets NaN
            pass as data, for blocks that take it as an entry that was not measured.
    """
    rule = _rule("not_finite", not_finite, ("raise", "absent", "keep"))
    series = Series(time, values, name=name, gaps=rule == "keep")
    if rule == "absent":
        series = series[~_broken_rows(series)]
    if _rule("duplicates", duplicates, ("raise", "first", "last")) != "raise" and len(series):
        same = np.diff(series.time) == 0
        series = series[np.r_[True, ~same] if duplicates == "first" else np.r_[~same, True]]
    return series


def ticks(period: str | int, *, until: str | int, start: int = 0, name: str = "ticks") -> Series:
    """A source that only keeps time: true at `start` (int ns) and each `period` after it, before `until`.

    Args:
        period, until: a duration such as "5ms", or integer nanoseconds; `until` counts from `start`.
    """
    step = nanoseconds(period, what="period")
    time = np.arange(0, nanoseconds(until, what="until"), step, dtype=np.int64) + start
    return Series(time, np.ones(len(time), dtype=bool), name=name)


def timing_of(series: Series) -> Timing:
    """The clock that a recording keeps: periodic where its steps are equal to 1 %, otherwise aperiodic."""
    steps = np.diff(series.time)
    if not len(steps):
        return aperiodic()
    typical = max(int(np.median(steps)), 1)
    spread = int(np.abs(steps - typical).max())
    if spread == 0:
        return periodic(typical, phase=int(series.time[0]) % typical)
    if spread <= typical // 100:
        return periodic(typical, jitter=spread)
    return aperiodic(max_rate=math.ceil(1e9 / max(int(steps.min()), 1)))


def clocks_of(inputs: Mapping[str, Series]) -> dict[str, Any]:
    """`timing_of` each, as `build` takes them."""
    return {name: timing_of(series) for name, series in inputs.items()}


def _rule(what: str, given: str, valid: tuple[str, ...]) -> str:
    if given not in valid:
        raise UnknownNameError(f"rule for {what}", given, valid)
    return given


def _broken_rows(series: Series) -> np.ndarray:
    """(n,) rows with a value that is not finite; where gaps are data, with one that is infinite."""
    broken = np.zeros(len(series), dtype=bool)
    for leaf in series.leaves.values():
        if leaf.dtype.kind == "f":
            wrong = np.isinf(leaf) if series.gaps else ~np.isfinite(leaf)
            broken |= wrong.any(axis=tuple(range(1, leaf.ndim)))
    return broken


@dataclass(frozen=True)
class Tape:
    """Ticks of recorded sources: `time[i]` in ns, and `key[i]` with bit k set where source k is present."""

    time: np.ndarray
    key: np.ndarray
    series: tuple[Series, ...]

    @classmethod
    def of(cls, series: tuple[Series, ...]) -> Tape:
        """The ticks of series that are each in order: their times merged, equal ones made one."""
        time = max((s.time for s in series), key=len, default=np.zeros(0, np.int64))
        rows = [None if len(s) == len(time) else np.searchsorted(time, s.time) for s in series]
        if not all(np.array_equal(_taken(time, r), s.time) for r, s in zip(rows, series, strict=True)):
            time = np.concatenate([s.time for s in series])
            time.sort(kind="stable")  # merges runs that are sorted already
            time = time[np.concatenate([[True], time[1:] != time[:-1]])]
            rows = [np.searchsorted(time, s.time) for s in series]
        key = np.zeros(len(time), np.int64)
        for k, r in enumerate(rows):
            key[... if r is None else r] |= 1 << k
        return cls(time, key, series)

    @property
    def patterns(self) -> tuple[int, ...]:
        """The keys that occur, in order."""
        few = len(self.series) <= 16
        return tuple((np.flatnonzero(np.bincount(self.key)) if few else np.unique(self.key)).tolist())


def _taken(time: np.ndarray, rows: np.ndarray | None) -> np.ndarray:
    """`time[rows]`; all of it without rows, and the last where a row is past the end."""
    return time if rows is None else time.take(rows, mode="clip")


def need_inputs(graph: Graph, inputs: object) -> None:
    """Refuse what is neither a flight nor data by source name."""
    if not isinstance(inputs, Flight | Mapping):
        raise DataError(
            "these are no inputs",
            path=graph.name,
            expected="a Flight, or data by source name: " + ", ".join(graph.sources),
            got=f"{type(inputs).__name__} {inputs!r}"[:80],
            fix="write simulate(graph, {" + ", ".join(f"{n!r}: Series(...)" for n in graph.sources) + "})",
        )


def prepare(
    graph: Graph, inputs: Inputs, last: Mapping[str, int] | None = None
) -> dict[str, Series | Iterator[tuple[int, Any]]]:
    """The inputs by source name, in declaration order: checked `Series`, or iterators read as they go.

    `last` holds the last time of each source in a run that goes on; nothing may come before the last of them.

    Raises:
        UnknownNameError, DataError, ClockError, TypeMismatchError: naming the source.
    """
    need_inputs(graph, inputs)
    given = dict(inputs.streams) if isinstance(inputs, Flight) else dict(inputs)
    if not isinstance(inputs, Flight):
        for name in given:
            if name not in graph.sources:
                raise UnknownNameError("source", name, graph.sources, path=graph.name)
    found: dict[str, Series | Iterator[tuple[int, Any]]] = {}
    before = dict(last or dict.fromkeys(graph.sources, NEVER))
    resumed = max(before.values(), default=NEVER)
    for name, node in graph.sources.items():
        if name not in given:
            raise DataError(
                f"source {name!r} has no data",
                path=graph.name,
                expected=f"events of {node.type}",
                got=", ".join(given) or "no inputs",
                fix=f"pass inputs={{{name!r}: Series(time, values)}}",
            )
        value = given[name]
        if isinstance(value, tuple) and len(value) == 2:
            value = Series(value[0], value[1], name=name)
        if isinstance(value, Series):
            series = _typed(name, value, node.type)
            if len(series):
                _check_after(name, int(series.time[0]), resumed)
            found[name] = _checked(name, series, node.clock.timing, before[name])
        elif isinstance(value, Iterable):
            found[name] = _events(name, value, node.type, node.clock.timing, before[name], resumed)
        else:
            raise DataError(
                f"source {name!r} is given something that holds no events",
                path=graph.name,
                expected="a Series, (times, values), or an iterable of (time, value)",
                got=type(value).__name__,
                fix="write Series(time, values)",
            )
    return found


def _typed(name: str, series: Series, wanted: Type) -> Series:
    if series.type == wanted:
        return series
    if isinstance(wanted, StructType) != isinstance(series.type, StructType):
        raise TypeMismatchError(
            f"the data of source {name!r} are of another type",
            path=name,
            expected=str(wanted),
            got=str(series.type),
            fix=f"pack the arrays: Series(time, {wanted}(...))",
        )
    more: dict[str, Any] = {"name": name, "gaps": series.gaps}
    as_real = Series(series.time, series.values, type=_as_wanted(series.type, wanted), **more)
    check_fits(as_real.type, wanted, given_at=f"the data of {name}", wanted_at=f"source {name}", sizes={})
    return Series(series.time, series.values, type=wanted, **more)


def _as_wanted(given: Type, wanted: Type) -> Type:
    """`given`, with integers taken as reals where reals are wanted."""
    if isinstance(given, StructType) or isinstance(wanted, StructType):
        return given
    kind = wanted.dtype if wanted.dtype == "real" and given.dtype != "bool" else given.dtype
    return type(given)(given.shape, kind, given.unit, given.frame)


def _check_after(name: str, time: int, resumed: int) -> None:
    if time <= resumed:
        raise DataError(
            "time goes backwards",
            path=f"{name}, event 0",
            expected=f"events after {resumed} ns, where the state was saved",
            got=f"t = {time} ns",
            fix="give a resumed run the inputs that come after: series[series.time > time]",
        )


def _checked(name: str, series: Series, timing: Timing, before: int = NEVER) -> Series:
    check_finite(name, series)
    check_times(name, series.time, timing, before)
    return series


def check_finite(name: str, series: Series) -> None:
    """Refuse a recording with values that are NaN or infinite."""
    sound = all(np.isfinite(leaf).all() for leaf in series.leaves.values() if leaf.dtype.kind == "f")
    if not sound and (broken := _broken_rows(series)).any():
        row = int(np.flatnonzero(broken)[0])
        _not_finite(name, int(series.time[row]), f"row {row} ({int(broken.sum())} in all)")


def _not_finite(name: str, time: int, where: str) -> None:
    raise DataError(
        "a value is not finite",
        path=f"{name}, {where}",
        expected="finite numbers",
        got=f"NaN or infinity at t = {time} ns",
        fix='drop such events: arrays(time, values, not_finite="absent"), or "keep" NaN as data',
    )


def check_times(name: str, time: np.ndarray, timing: Timing, before: int = NEVER) -> None:
    """Check stamps (int64 ns) of one source against its declared clock; `before` is the stamp that came last.

    Raises:
        DataError: out of order, or two at one time. ClockError: not as declared.
    """
    stamps = time if before == NEVER else np.r_[before, time]
    steps = np.diff(stamps)
    least, most = int(steps.min(initial=2**63 - 1)), int(steps.max(initial=0))
    if least <= 0:
        row = int(np.flatnonzero(steps <= 0)[0])
        twice = steps[row] == 0
        raise DataError(
            "two events at one time" if twice else "time goes backwards",
            path=f"{name}, event {row + 1}",
            expected="increasing time stamps",
            got=f"{int(stamps[row])} ns, then {int(stamps[row + 1])} ns",
            fix='name a rule: arrays(time, values, duplicates="last")'
            if twice
            else "sort the events at the source, or drop the late one",
        )
    if timing.period is not None:
        if max(timing.period - least, most - timing.period) > timing.jitter:
            row = int(np.flatnonzero(np.abs(steps - timing.period) > timing.jitter)[0])
            raise ClockError(
                "the data do not keep the declared period",
                path=f"{name}, event {row + 1}",
                expected=f"{timing.period} ns"
                + (f" +- {timing.jitter} ns" if timing.jitter else "")
                + " after the one before",
                got=f"{int(steps[row])} ns (t = {int(stamps[row + 1])} ns)",
                fix=f'declare {name}=periodic(..., jitter="...") or {name}=aperiodic(max_rate=...)',
            )
        # the others come whole periods after the first, and are in phase if it is
        phase = None if timing.jitter or not len(time) else timing.phase
        if phase is not None and (int(time[0]) - phase) % timing.period != 0:
            raise ClockError(
                "the data do not keep the declared phase",
                path=f"{name}, event 0",
                expected=f"a multiple of {timing.period} ns plus {timing.phase} ns",
                got=f"t = {int(time[0])} ns",
                fix="leave the phase out, or shift the stamps",
            )
    if timing.max_rate is not None and least < int(1e9 / timing.max_rate):
        row = int(np.flatnonzero(steps < int(1e9 / timing.max_rate))[0])
        raise ClockError(
            "events come closer than the declared highest rate",
            path=f"{name}, event {row + 1}",
            expected=f"at least {int(1e9 / timing.max_rate)} ns apart ({timing.max_rate:g} Hz)",
            got=f"{int(steps[row])} ns (t = {int(stamps[row + 1])} ns)",
            fix=f"declare {name}=aperiodic(max_rate={1e9 / max(int(steps[row]), 1):.0f}) or more",
        )


def check_event(
    name: str, time: Any, value: Any, type_: Type, timing: Timing, before: int
) -> tuple[int, Any]:
    """Check one event as it arrives; returns it with an integer time and read-only arrays."""
    if not isinstance(time, int | np.integer) or isinstance(time, bool):
        raise DataError(
            "times must be integer nanoseconds",
            path=name,
            expected="an int",
            got=f"{type(time).__name__} {time!r}",
            fix="round float seconds once, at the source: round(seconds * 1e9)",
        )
    check_times(name, np.asarray([time], dtype=np.int64), timing, before)
    made = as_value(value, type_, path=f"source {name}")
    for leaf in flatten(made, type_):
        if leaf.dtype.kind == "f" and not np.isfinite(leaf).all():
            _not_finite(name, int(time), "this event")
    return int(time), made


def _events(
    name: str, events: Iterable[Any], type_: Type, timing: Timing, before: int, resumed: int
) -> Iterator[tuple[int, Any]]:
    for event in events:
        if not isinstance(event, tuple) or len(event) != 2:
            raise DataError(
                "an event is not a pair",
                path=name,
                expected="(time, value)",
                got=repr(event)[:80],
                fix="yield (nanoseconds, value)",
            )
        before, value = check_event(name, event[0], event[1], type_, timing, before)
        _check_after(name, before, resumed)
        yield before, value


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
        return Tape(like.time, like.key, series)
    return Tape.of(series)


def read_all(name: str, events: Iterable[tuple[int, Any]], type_: Type) -> Series:
    """A series from an iterable of (time, value)."""
    return stack(*_columns(events), type_, name)


def _columns(events: Iterable[tuple[int, Any]]) -> tuple[list[int], list[Any]]:
    pairs = list(events)
    return [t for t, _ in pairs], [v for _, v in pairs]


def stack(times: list[int], values: list[Any], type_: Type, name: str) -> Series:
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
    made: list[np.ndarray] = [
        np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
        for column, (_, leaf) in zip(columns, leaves, strict=True)
    ]
    return Series(np.asarray(times, dtype=np.int64), unflatten(type_, iter(made)), type=type_, name=name)


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
        while any(h is not None for h in heads):
            now = min(h[0] for h in heads if h is not None)
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
