"""What goes into a run: events of each source, checked against its declared clock.

A source is given as a `Series`, as a pair `(times, values)` of arrays, or as any iterable of
`(time, value)` pairs, or of `Series` one after the other, read lazily. Nothing is repaired in silence:
stamps out of order, two events of one source at one time, values that are not finite, and stamps that do not
keep to the declared clock are refused unless the source names a rule.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.arrival import with_stamps
from flowgraph.data.finite import finite
from flowgraph.data.flight import Flight
from flowgraph.data.series import Series, unmasked
from flowgraph.data.stamps import extreme_steps
from flowgraph.data.tape import check_stamp, need_near
from flowgraph.errors import ClockError, DataError, DeclarationError, TypeMismatchError, UnknownNameError
from flowgraph.language.clock import Timing, aperiodic, nanoseconds, periodic
from flowgraph.language.graph import NEVER, Graph
from flowgraph.types import StructType, Type, as_value, check_fits, flatten

Inputs = Flight | Mapping[str, Any]

NOT_FINITE = ("raise", "absent", "keep")
"""What a value with a NaN or an infinity may be: an error, no event, or data."""


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
        not_finite: where a value is NaN, masked or infinite "raise", or treat the event as "absent"; "keep"
            lets NaN pass as data, for blocks that take it as an entry that was not measured.
    """
    rule = rule_of("not_finite", not_finite, NOT_FINITE)
    series = Series(time, values, name=name, gaps=rule == "keep")
    if rule == "absent":
        series = series[~_broken_rows(series)]
    if rule_of("duplicates", duplicates, ("raise", "first", "last")) != "raise" and len(series):
        same = np.diff(series.time) == 0
        series = series[np.r_[True, ~same] if duplicates == "first" else np.r_[~same, True]]
    return series


MOST_TICKS = 1_000_000_000
"""Of a source that only keeps time: nine bytes each."""


def ticks(period: str | int, *, until: str | int, start: str | int = 0, name: str = "ticks") -> Series:
    """A source that only keeps time: true at `start` and each `period` after it, before `until`.

    Args:
        period, until, start: a duration such as "5ms", or integer nanoseconds; `until` counts from `start`.

    Raises:
        DeclarationError: for a period below 1 ns, an `until` below 0, or more ticks than `MOST_TICKS`.
            DataError: for a start that is no whole number, or an end that int64 nanoseconds do not hold.
    """
    step, end = nanoseconds(period, what="period", least=1), nanoseconds(until, what="until", least=0)
    begin = check_stamp(
        f"{name}.start", nanoseconds(start, what="start") if isinstance(start, str) else start
    )
    check_stamp(f"{name}.until", begin + end)
    if (count := -(-end // step)) > MOST_TICKS:
        raise DeclarationError(
            "these are too many ticks",
            path=name,
            expected=f"at most {MOST_TICKS:,}, which are kept in memory",
            got=f"{count:,}: one each {step:,} ns until {end:,} ns",
            fix=f'take a period of at least "{-(-end // MOST_TICKS)}ns", or an earlier end',
        )
    time = np.arange(0, end, step, dtype=np.int64) + begin
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


def rule_of(what: str, given: str, valid: tuple[str, ...]) -> str:
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


def need_graph(graph: object, path: str) -> None:
    """Refuse what is no graph."""
    if not isinstance(graph, Graph):
        getattr(graph, "sources", None)  # a @graph function says for itself that it was not built
        raise DeclarationError(
            "this is no graph",
            path=path,
            expected="a built graph",
            got=f"{type(graph).__name__} {graph!r}"[:80],
            fix="declare a function with @graph, and build it: f.build(...)",
        )


def need_inputs(graph: Graph, inputs: object) -> None:
    """Refuse what is no graph, and inputs that are neither a flight nor data by source name."""
    need_graph(graph, "simulate")
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
    before = dict(last or dict.fromkeys(graph.sources, NEVER))
    resumed = max(before.values(), default=NEVER)
    found: dict[str, Series | Iterator[tuple[int, Any]]] = {}
    for name, given in sources_of(graph, inputs).items():
        node = graph.sources[name]
        check = check_recording if isinstance(given, Series) else single_events
        found[name] = check(name, given, node.type, node.clock.timing, before[name], resumed)
    return found


def sources_of(graph: Graph, inputs: Inputs) -> dict[str, Any]:
    """What each source is given, in declaration order: a `Series`, or an iterable of events or of `Series`.

    Raises:
        UnknownNameError, DataError: naming a source that is not there, or that is given no events.
    """
    need_inputs(graph, inputs)
    given = dict(inputs.streams) if isinstance(inputs, Flight) else dict(inputs)
    if not isinstance(inputs, Flight):
        for name in given:
            if name not in graph.sources:
                raise UnknownNameError("source", name, graph.sources, path=graph.name)
    given = with_stamps(graph.sources, given)
    found: dict[str, Any] = {}
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
        if not isinstance(value, Iterable):
            raise DataError(
                f"source {name!r} is given something that holds no events",
                path=graph.name,
                expected="a Series, (times, values), or an iterable of (time, value)",
                got=type(value).__name__,
                fix="write Series(time, values)",
            )
        found[name] = value
    return found


def check_recording(
    name: str, given: Series, type_: Type, timing: Timing, before: int, resumed: int
) -> Series:
    """Check the events of a source, all or the next of them; returns them as of its type.

    Args:
        name, given, type_, timing: the source, its events, and what it is declared to be.
        before: the stamp of the source's event before these, or `NEVER`.
        resumed: the time at which a state was saved, or `NEVER`; nothing may come before it.
    """
    series = _typed(name, given, type_)
    if len(series):
        _check_after(name, int(series.time[0]), resumed)
    check_finite(name, series)
    check_times(name, series.time, timing, before, series.steps)
    return series


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


def check_finite(name: str, series: Series) -> None:
    """Refuse a recording with values that are NaN or infinite."""
    if not all(map(finite, series.leaves.values())) and (broken := _broken_rows(series)).any():
        row = int(np.flatnonzero(broken)[0])
        _not_finite(name, int(series.time[row]), f"row {row} ({int(broken.sum())} in all)")


def _not_finite(name: str, time: int, where: str, *, live: bool = False) -> None:
    raise DataError(
        "a value is not finite",
        path=f"{name}, {where}",
        expected="finite numbers",
        got=f"NaN or infinity at t = {time} ns",
        fix='start the run with not_finite="absent", or "keep" where NaN is data'
        if live
        else 'drop such events: arrays(time, values, not_finite="absent"), or "keep" NaN as data',
    )


def check_times(
    name: str,
    time: np.ndarray,
    timing: Timing,
    before: int = NEVER,
    extremes: tuple[int, int] | None = None,
) -> None:
    """Check stamps (int64 ns) of one source against its declared clock.

    Args:
        name, time, timing: of the source.
        before: the stamp that came last.
        extremes: the shortest and the longest step of these, where they are known.

    Raises:
        DataError: out of order, or two at one time. ClockError: not as declared.
    """
    least, most = extremes or extreme_steps(time)
    stamps = time
    if before != NEVER:
        first, last = extreme_steps(np.array([before, *time[:1]], np.int64))
        least, most, stamps = min(least, first), max(most, last), np.r_[before, time]
    if least <= 0:
        steps = np.diff(stamps)
        row = int(np.flatnonzero(steps <= 0)[0])
        need_near(int(stamps[row]), int(stamps[row + 1]))  # a step beyond int64 comes out negative
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
            steps = np.diff(stamps)
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
        steps = np.diff(stamps)
        row = int(np.flatnonzero(steps < int(1e9 / timing.max_rate))[0])
        raise ClockError(
            "events come closer than the declared highest rate",
            path=f"{name}, event {row + 1}",
            expected=f"at least {int(1e9 / timing.max_rate)} ns apart ({timing.max_rate:g} Hz)",
            got=f"{int(steps[row])} ns (t = {int(stamps[row + 1])} ns)",
            fix=f"declare {name}=aperiodic(max_rate={1e9 / max(int(steps[row]), 1):.0f}) or more",
        )


def periods_lost(name: str, time: int, timing: Timing, before: int) -> int:
    """How many events of a live periodic source did not come between two that did: packets are lost.

    Args:
        time, before: stamps of this event and of the one that came last, `NEVER` where there was none.

    Raises:
        DataError, ClockError: where the step is no whole number of periods, each within the jitter.
    """
    step = time - before
    if before != NEVER and step > 0 and _as_declared(step, timing):
        return 0  # without an array: this is asked for each event
    if before != NEVER and timing.period is not None and step > timing.period + timing.jitter:
        periods = round(step / timing.period)
        if abs(step - periods * timing.period) <= periods * timing.jitter:
            return periods - 1
    check_times(name, np.asarray([time], dtype=np.int64), timing, before)
    return 0


def _as_declared(step: int, timing: Timing) -> bool:
    """Whether a step from one event to the next is one that the declared clock makes."""
    if timing.period is not None:
        return abs(step - timing.period) <= timing.jitter
    return timing.max_rate is None or step >= int(1e9 / timing.max_rate)


def check_event(
    name: str, time: Any, value: Any, type_: Type, timing: Timing, before: int
) -> tuple[int, Any]:
    """Check one event as it arrives; returns it with an integer time and read-only arrays."""
    time = check_stamp(name, time)
    if before == NEVER or time <= before or not _as_declared(time - before, timing):
        check_times(name, np.asarray([time], dtype=np.int64), timing, before)
    return time, check_value(name, time, value, type_)


def check_value(name: str, time: int, value: Any, type_: Type, not_finite: str | None = None) -> Any:
    """The value of one event as read-only arrays; None for one that is not finite, where that is "absent".

    Args:
        name, time, value, type_: the source, and the event.
        not_finite: the rule of a live run; None where events are read as a recording goes.
    """
    made = as_value(unmasked(value, name, np.float64), type_, path=f"source {name}")
    for leaf in flatten(made, type_):
        if leaf.dtype.kind == "f" and not_finite != "keep" and not np.isfinite(leaf).all():
            if not_finite == "absent":
                return None
            _not_finite(name, time, "this event", live=not_finite is not None)
    return made


def single_events(
    name: str, events: Iterable[Any], type_: Type, timing: Timing, before: int, resumed: int
) -> Iterator[tuple[int, Any]]:
    """The events of an iterable as they are read, each checked; of a `Series` among them one after the other.

    Args: as of `check_recording`.
    """
    for event in events:
        if isinstance(event, Series):
            part = check_recording(name, event, type_, timing, before, resumed)
            before = int(part.time[-1]) if len(part) else before
            yield from zip(part.time.tolist(), part, strict=True)
            continue
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
