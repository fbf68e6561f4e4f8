"""When a value arrives and when it was true, which are two times wherever there is a wire between.

A `Series` has both: `time`, at which its values arrive and make ticks, and `stamp`, when they were true. Here
is what makes the one of the other. A graph that asks for the stamps of a source (`stamp_of`) has a second
source beside it, `NAME.stamp`, which is filled from the series; nobody else pays for it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.data.tape import check_stamp
from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from flowgraph.language.clock import nanoseconds
from flowgraph.language.graph import NEVER
from flowgraph.language.stamps import STAMP

__all__ = [
    "LATENCY",
    "Reordered",
    "batched",
    "delayed",
    "delayed_flight",
    "lateness_words",
    "reorder",
    "replayed",
    "stamp_events",
    "timeouts",
    "with_stamps",
]

LATENCY = ".latency"
"""How the setting of a flight ends that delays a stream: `leica.latency=0.135`."""


def delayed(series: Series, latency: Any, *, seed: int = 0, name: str | None = None) -> Series:
    """The values of a series as they arrive later; each keeps the stamp at which it was true.

    Values that overtake others come in the order of their arrival. Two that would arrive together arrive
    1 ns apart, as two events of one source cannot have one time.

    Args:
        series: what is delayed; one that is delayed already is delayed further.
        latency: a duration such as "135ms"; a pair of them, between which each value's own is drawn; or (n,)
            integer nanoseconds.
        seed: of what is drawn.
        name: of the new series; as before if left out.

    Raises:
        DeclarationError: for a latency below 0, a pair in the wrong order, an array of other than whole
            numbers, or an arrival beyond what int64 nanoseconds hold.
    """
    _need_series("delayed", series)
    called = name or series.name
    if isinstance(latency, tuple) and len(latency) == 2:
        low, high = (nanoseconds(part, what="latency") for part in latency)
        key = np.random.SeedSequence([seed, zlib.crc32(f"{called}{LATENCY}".encode())])
        share = np.random.Generator(np.random.Philox(key)).uniform(size=len(series))
        by = low + np.rint(share * (high - low)).astype(np.int64)
    elif isinstance(latency, np.ndarray):
        if latency.dtype.kind not in "iu":
            raise DeclarationError(
                "latencies in an array are integer nanoseconds",
                path=called,
                expected="(n,) of a whole-number type",
                got=f"dtype {latency.dtype}",
                fix="round seconds once: np.rint(seconds * 1e9).astype(np.int64)",
            )
        low, high = int(latency.min(initial=0)), int(latency.max(initial=0))
        by = latency.astype(np.int64)
    else:
        low = high = nanoseconds(latency, what="latency")
        by = np.full(len(series), low, np.int64)
    if not 0 <= low <= high or by.shape != series.time.shape:
        raise DeclarationError(
            "this is no latency",
            path=called,
            expected='0 ns or more: "135ms", a pair ("0ms", "500ms"), or one a value',
            got=repr(latency)[:80],
            fix='write delayed(series, "135ms")',
        )
    _need_room(series, high + len(series), called)
    arrival = series.time + by
    order = np.argsort(arrival, kind="stable")
    moved, stamp = series[order], series.stamp[order]
    time = moved.time + by[order]
    if len(time):  # each after the one before: t_k >= t_j + (k - j)
        count = np.arange(len(time))
        time = np.maximum.accumulate(time - count) + count
    return Series(time, moved.values, type=series.type, name=called, gaps=series.gaps, stamp=stamp)


def _need_series(path: str, given: object) -> None:
    """Refuse what is no recording of a stream."""
    if not isinstance(given, Series):
        raise DataError(
            "this is no series",
            path=path,
            expected="a Series",
            got=f"{type(given).__name__} {given!r}"[:80],
            fix="write Series(time, values), or take flight.streams[name]",
        )


def _need_room(series: Series, by: int, path: str) -> None:
    """Refuse to move the times of a series by so many ns where int64 does not hold them afterwards."""
    times = (
        [int(t) for t in (series.time.min(), series.time.max(), series.stamp.min())] if len(series) else []
    )
    if any(not NEVER < t + by < 2**63 for t in times):
        raise DeclarationError(
            "a time would be beyond what int64 nanoseconds hold",
            path=path,
            expected="times below 2^63 ns, 9.2e9 s, to either side of 0",
            got=f"times from {min(times)} to {max(times)} ns, moved by {by} ns",
            fix='check the units: a duration is written with its own, such as "135ms"',
        )


def delayed_flight(flight: Flight, settings: Mapping[str, Any], *, seed: int = 0) -> Flight:
    """A flight whose streams arrive as settings say: `STREAM.latency`, seconds, or LOW:HIGH for random ones.

    Raises:
        DeclarationError: for a text that is no latency. UnknownNameError: for a stream that is not there.
    """
    streams, said = dict(flight.streams), []
    for key, given in settings.items():
        name = key.removesuffix(LATENCY)
        if name not in streams:
            raise UnknownNameError("stream", name, streams, path=f"{flight.name}.{key}")
        bounds = _seconds(key, given)
        streams[name] = delayed(streams[name], bounds if len(bounds) == 2 else bounds[0], seed=seed)
        text = " to ".join(f"{b * 1e-9:g}" for b in bounds)
        said.append(note("info", f"{name}: each value arrives {text} s after it was true"))
    return replace(flight, streams=streams, notes=(*flight.notes, *said), experiment=None)


def lateness_words(inputs: Flight | Mapping[str, Any] | None) -> dict[str, str]:
    """How late the values of a stream arrive, in words, by name; of those that do."""
    streams = inputs.streams if isinstance(inputs, Flight) else inputs or {}
    words = {}
    for name, series in streams.items():
        if isinstance(series, Series) and len(series):
            late = series.time - series.stamp
            least, most = late.min() * 1e-9, late.max() * 1e-9
            if most > 0.0:
                span = f"{most:.3g}" if most - least < 0.01 * most else f"{least:.3g} to {most:.3g}"
                words[name] = f"{span} s late"
    return words


def _seconds(key: str, given: Any) -> tuple[int, ...]:
    """Nanoseconds, one or two, of "0.135" or "0:0.5"."""
    try:
        found = tuple(round(float(part) * 1e9) for part in str(given).split(":"))
        if len(found) > 2 or "_" in str(given) or not 0 <= found[0] <= found[-1] < 10**15:
            raise ValueError
    except (ValueError, OverflowError):
        raise DeclarationError(
            f"setting {key!r} is not usable",
            path=key,
            expected="seconds, 0 or more; or LOW:HIGH, between which each value's own is drawn",
            got=repr(given),
            fix=f"for example {key}=0.135",
        ) from None
    return found


class Reordered(dict[str, Series]):
    """Streams in order of their stamps; `late` says how many of each came too late, and are left out."""

    late: dict[str, int]


def reorder(inputs: Flight | Mapping[str, Any], max_lag: Any) -> Reordered:
    """Streams held back until they are in order: each value makes its tick `max_lag` after it was true.

    Ticks are as far apart as the stamps, so `dt` is right; what a graph then knows is `max_lag` old. A value
    that arrives later than that is left out and counted. Of two values of one stream with one stamp the
    first that arrived is kept, and the other counted.

    Args:
        inputs: a flight; or series, or (times, values), by name. Those that are not late are held back too.
        max_lag: a duration such as "0.2s".

    Raises:
        DeclarationError: for one below 0, or by which a time is beyond what int64 nanoseconds hold.
        DataError: for what is no recording.
    """
    lag = nanoseconds(max_lag, what="max_lag")
    if lag < 0:
        raise DeclarationError(
            "nothing can be held back for less than no time",
            path="reorder",
            expected="0 ns or more",
            got=repr(max_lag),
            fix='write reorder(inputs, "0.2s")',
        )
    made = Reordered()
    made.late = {}
    streams = inputs.streams if isinstance(inputs, Flight) else inputs
    if not isinstance(streams, Mapping):
        raise DataError(
            "these are no streams by name",
            path="reorder",
            expected="a Flight, or series by name",
            got=f"{type(inputs).__name__} {inputs!r}"[:80],
            fix='write reorder({"imu": series}, "0.2s")',
        )
    for name, given in streams.items():
        pair = isinstance(given, tuple) and len(given) == 2
        series = Series(*given, name=name) if pair else given
        _need_series(f"reorder.{name}", series)
        _need_room(series, lag, name)
        kept = series[series.time - series.stamp <= lag]
        kept = kept[np.argsort(kept.stamp, kind="stable")]
        kept = kept[np.concatenate([[True], np.diff(kept.stamp) > 0])[: len(kept)]]
        made[name] = Series(
            kept.stamp + lag,
            kept.values,
            type=series.type,
            name=series.name,
            gaps=series.gaps,
            stamp=kept.stamp,
        )
        made.late[name] = len(series) - len(kept)
    return made


def timeouts(
    series: Series, after: Any, *, start: int | None = None, until: int | None = None, name: str = "timeouts"
) -> Series:
    """A source of the times at which a stream had not come for `after`: true, once in each silence.

    A silence begins with each value, and with `start`: a stream that does not come within `after` of it, or
    never, has a timeout there too.

    Args:
        series: the stream.
        after: a duration such as "0.5s", above 0.
        start: int64 ns, from when the stream is awaited. Left out, from its first value; for a stream without
            values from time 0, where recordings begin.
        until: int64 ns, the last time at which it is looked. Left out, that of the last value: a stream
            without values then has no timeout, as nobody says how long to wait.

    Raises:
        DeclarationError: for an `after` of 0 or less.
    """
    _need_series(name, series)
    span = nanoseconds(after, what="after")
    if span <= 0:
        raise DeclarationError(
            "a timeout comes after some time",
            path=name,
            expected="more than 0 ns",
            got=repr(after),
            fix='write timeouts(series, "0.5s")',
        )
    end = int(series.time[-1]) if len(series) else NEVER
    if until is not None:
        end = check_stamp(f"{name}.until", until)
    begin = None if len(series) else 0
    if start is not None:
        begin = check_stamp(f"{name}.start", start)
    awaited = series.time if begin is None else np.append(np.int64(begin), series.time[series.time > begin])
    last = awaited <= end - span  # of what has its timeout by then; written so that no sum is beyond int64
    due = awaited[last] + span
    silent = due[due < np.append(awaited[1:], np.int64(2**63 - 1))[last]]
    return Series(silent, np.ones(len(silent), bool), name=name)


def batched(series: Series, function: Callable[[Any], Any], *, name: str | None = None) -> Series:
    """What a function makes of a whole recording at once: a value for each of its values, at their times.

    Each is true when what it was made of was: stamps are kept.

    Args:
        series: the recording.
        function: of all values, with the time axis in front, to as many.
    """
    _need_series("batched", series)
    stamp = series.stamp if series.is_late else None
    made = function(series.values)
    return Series(series.time, made, name=name or series.name, gaps=series.gaps, stamp=stamp)


def replayed(series: Series, *, start: int, name: str | None = None) -> Series:
    """A recording as it is played again: its first value arrives at `start`, int64 ns, all else as far apart.

    What a run gave, or what `batched` made of it, so becomes a source of another run, or later of the same.

    Raises:
        DeclarationError: for a start from which a time is beyond what int64 nanoseconds hold.
    """
    _need_series("replayed", series)
    by = check_stamp("replayed.start", start) - int(series.time[0]) if len(series) else 0
    _need_room(series, by, name or series.name)
    stamp = series.stamp + by if series.is_late else None
    return Series(
        series.time + by,
        series.values,
        type=series.type,
        name=name or series.name,
        gaps=series.gaps,
        stamp=stamp,
    )


def with_stamps(sources: Iterable[str], given: Mapping[str, Any]) -> dict[str, Any]:
    """What was given, and the stamps of those sources of which a graph asks for them.

    Raises:
        DataError: for a source whose events are read as they go, since their stamps have to be given too.
    """
    found = dict(given)
    for name in sources:
        base = name.removesuffix(STAMP)
        if name == base or name in found or base not in found:
            continue
        value = found[base]
        if isinstance(value, tuple) and len(value) == 2:
            found[base] = value = Series(value[0], value[1], name=base)
        if not isinstance(value, Series):
            raise DataError(
                f"this graph asks when the values of {base!r} were true",
                path=name,
                expected="a Series, which has stamps, or a source of stamps beside the values",
                got=type(value).__name__,
                fix=f"write Series(time, values, stamp=...), or give {name!r} too",
            )
        found[name] = Series(value.time, value.stamp, name=name)
    return found


def stamp_events(sources: Iterable[str], time: int, values: dict[str, Any]) -> None:
    """Add to the events of one live tick the stamps that were left out: what arrives is true now.

    Raises:
        DataError: for a stamp without its value, or after the tick.
    """
    for name in sources:
        base = name.removesuffix(STAMP)
        if name == base:
            continue
        if base in values:
            values.setdefault(name, time)
        stamp = values.get(name, time)
        if (name in values and base not in values) or not stamp <= time:
            raise DataError(
                "a stamp comes without its value"
                if base not in values
                else "a value was true after it arrived",
                path=name,
                expected=f"with a value of {base!r}, a time up to that of the tick, {time} ns",
                got=f"{stamp} ns",
                fix="push both in one call",
            )
