"""Late measurements, applied at their own time: a filter that goes back, and through what came since again.

A filter is a graph whose ticks come in order of time. `rewind` runs such a graph over events that do not:
it keeps what the graph remembered after each of its last ticks, and what happened at each. An event that was
true before the last tick is put among these at its own time, and the ticks from there on are made again. So
what is known after it is what the graph would have made of the events in order.

    rewound = rewind(ins_eskf, {"imu": imu, "position": leica}, late=("position",), max_lag="0.5s", size=128,
                     start=..., noise=...)
    return {"belief": rewound.now["belief"]}

The history is a ring of a fixed size, so that all of this lowers: registers, and at a tick at most as many
turns as the ring has places. A tick without a late event takes one turn.

Source: T. Larsen, N. Andersen, O. Ravn, N. Poulsen, "Incorporation of time delayed measurements in a
discrete-time Kalman filter", CDC 1998, which calls it recalculation and takes it as the optimum.
"""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Stream, apply, block, delay, lower, stamp_of, when
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.builder import builder
from flowgraph.language.clock import Clock, Timing, clock_of, nanoseconds
from flowgraph.language.declare import GraphFunction
from flowgraph.language.graph import NEVER, Graph
from flowgraph.pipeline.turns import Layout, Turns, packed, turns_of
from flowgraph.recorder.loop import Loop
from flowgraph.types import Type, flatten, unflatten

__all__ = ["OLDER", "Rewound", "rewind"]

OLDER = ("refuse", "fuse")
"""What becomes of an event that is older than the history."""

_MOST_PLACES = 2**16


class Rewound(NamedTuple):
    """What a rewound graph gives, by the names of its outputs.

    now: at the ticks of the streams that come on time (of all, where none does): as of the newest event.
    then: at each tick that a late stream made, as of the time at which its value was true, that value
        applied. stamp: that time, int64 ns.
    """

    now: Mapping[str, Stream[Any]]
    then: Mapping[str, Stream[Any]]
    stamp: Stream[Any]


class Ring(NamedTuple):
    """What happened, in places that follow each other around a ring; and what this tick changed.

    rows: (N, m) what happened at each place. times: (N,) int64 ns. newest: the place of the newest. filled:
    how many places hold something, beside the one before them, from which it all starts. back: how many
    places before the newest the first change of this tick lies; -1 for none. applied, refused, fused: late
    events of this tick.
    """

    rows: Any
    times: Any
    newest: Any
    filled: Any
    back: Any
    applied: Any
    refused: Any
    fused: Any


@block
def insert(
    ring: Any, event: Any | None, *, bit: int, columns: tuple[int, int], lag: int, older: str, t: Any, xp: Any
):  # type: ignore[no-untyped-def]
    """The ring with an event at its own time: in a place of its own, or with others of that very time.

    One that is older than `lag` ns or than the ring reaches back is refused or, where `older` is "fuse", put
    at the oldest time that can be. A second event of one source at one time is refused.

    Args:
        ring: as `Ring`.
        event: (time of validity, int64 ns; what is in it, as reals), or absent.
        bit: of the source, in the key of a row.
        columns: of the source's part of a row.
        lag, older: see `rewind`.
    """
    if event is None:
        return ring
    rows, times, newest, filled, back, applied, refused, fused = ring
    places = rows.shape[0]
    at = xp.arange(places, dtype=xp.int32)
    held = _ago(newest, at, places, xp) < filled
    full = filled >= np.int32(places - 1)
    oldest = xp.where(full, xp.min(xp.where(held, times, np.int64(2**63 - 1))), np.int64(NEVER))
    first = xp.maximum(t - np.int64(lag), oldest)
    stamp, part = event
    old = stamp < first
    time = xp.maximum(stamp, first)
    ahead = xp.astype(xp.sum(xp.astype(held & (times > time), xp.int32)), xp.int32)
    same = held & (times == time)
    share = np.float64(2**bit)
    there = xp.remainder(xp.floor(rows[:, 0] / share), 2.0) == 1.0
    taken = xp.any(same & there)
    accepted = ~taken if older == "fuse" else ~(taken | old)
    merged = accepted & xp.any(same)
    fresh = accepted & ~merged

    newest = xp.where(fresh, _wrapped(newest + np.int32(1), places, xp), newest)
    ago = _ago(newest, at, places, xp)
    moved = xp.where(fresh & (ago < ahead), _wrapped(at - np.int32(1), places, xp), at)
    rows, times = xp.take(rows, moved, axis=0), xp.take(times, moved, axis=0)
    here = fresh & (ago == ahead)
    hit = here | (merged & same)
    blank = xp.concat(
        [np.zeros(1), *packed(time, _TIME, xp), np.zeros(rows.shape[1] - 1 - _TIME.pieces)], axis=0
    )
    rows = xp.where(here[:, None], blank[None, :], rows)
    key = rows[:, :1] + xp.where(hit, share, 0.0)[:, None]
    start, stop = columns
    inside = xp.where(hit[:, None], part[None, :], rows[:, start:stop])
    rows = xp.concat([key, rows[:, 1:start], inside, rows[:, stop:]], axis=1)
    times = xp.where(here, time, times)
    back = xp.where(fresh & (back >= ahead), back + np.int32(1), back)
    back = xp.where(accepted, xp.maximum(back, ahead), back)
    filled = xp.minimum(filled + xp.astype(fresh, xp.int32), np.int32(places - 1))
    late = stamp < t
    return (
        rows, times, newest, filled, back,
        applied + xp.astype(accepted & late & ~old, xp.int32),
        refused + xp.astype(~accepted, xp.int32),
        fused + xp.astype(accepted & old, xp.int32),
    )  # fmt: skip


_TIME = Layout([((), "real"), ((), "int64")]).slots[1]


def _wrapped(place: Any, places: int, xp: Any) -> Any:
    return xp.remainder(place, np.int32(places))


def _ago(newest: Any, at: Any, places: int, xp: Any) -> Any:
    """How many places before the newest each place is."""
    return _wrapped(newest - at, places, xp)


@block
def replay(history: Any, ring: Any, *, loop: Any, xp: Any):
    """The history (N, k) made anew from the first change of this tick on.

    Args:
        history: what was remembered after each place of the ring.
        ring: as `Ring`.
        loop: with the turn that makes one row of the history of the row before.
    """
    places = ring[0].shape[0]
    first = _wrapped(ring[2] - ring[4], places, xp)
    return loop(history, ring[0], first, ring[4] + np.int32(1), xp=xp)


@block
def settle(ring: Any):
    """The ring, to be kept for the next tick, in which nothing has changed yet."""
    none = np.int32(0)
    return (*ring[:4], np.int32(-1), none, none, none)


@block
def count_late(state: Any, ring: Any):
    """How many late events were applied at their time, refused, and fused at another, so far."""
    total = {name: state[name] + n for name, n in zip(state, ring[5:], strict=True)}
    return total, ring[5]


@count_late.init
def _(ring: Any):  # type: ignore[no-untyped-def]
    return {"late_applied": np.int32(0), "late_refused": np.int32(0), "late_fused": np.int32(0)}


def _place(history, ring, *, then, xp):  # type: ignore[no-untyped-def]
    """The row of the history at the newest place, or at the first that this tick changed."""
    back = xp.maximum(ring[4], np.int32(0)) if then else np.int32(0)
    return xp.take(history, _wrapped(ring[2] - back, ring[0].shape[0], xp), axis=0)


def _time_of(ring, *, xp):  # type: ignore[no-untyped-def]
    """When the first place that this tick changed was."""
    place = _wrapped(ring[2] - xp.maximum(ring[4], np.int32(0)), ring[0].shape[0], xp)
    return when(ring[4] >= np.int32(0), xp.take(ring[1], place, axis=0))


def _read(row, back, *, turns, number, type_, then, xp):  # type: ignore[no-untyped-def]
    """An output, as it lies in a row of the history; present where it was at that tick."""
    flag, places = turns.outputs[number]
    present = turns.history.unpack(row, flag, xp)
    value = unflatten(type_, iter([turns.history.unpack(row, k, xp) for k in places]))
    return when(present & (back >= np.int32(0)) if then else present, value)


def rewind(
    graph: GraphFunction,
    streams: Mapping[str, Stream[Any]],
    *,
    late: Sequence[str],
    max_lag: str | int,
    size: int | None = None,
    older: str = "refuse",
    name: str = "rewind",
    **settings: Any,
) -> Rewound:
    """A graph over events that come late and out of order, as if they had come in order: a sub-graph.

    Args:
        graph: a `@graph` function; its ticks are those of its events in order of their stamps.
        streams: by the name of each of its sources, the stream of events.
        late: names of those that may come late; they have to be sources, which have stamps. The others are
            true when they come.
        max_lag: the longest delay for which an event is applied at its own time.
        size: places of the ring: how many different times there can be within `max_lag`, and two more. Found
            from the rates that the sources declare, if left out.
        older: what becomes of an event that is older than `max_lag`, or than the ring reaches back: "refuse",
            or "fuse", which applies it at the oldest time that can be. Both are counted in `run.stats`, as
            are those applied (`NAME/late.late_applied`, `late_refused`, `late_fused`).
        name: of the sub-graph.
        **settings: of the graph.

    Returns:
        The outputs of the graph by name; see `Rewound`.

    Raises:
        DeclarationError: where the size cannot be found, or a setting is not usable; for a late stream that
            is no source.
        LoweringError: for a graph that cannot be replayed: with random numbers, a queue that can be full, a
            block for the host, or steps that only Python can run.
    """
    inner, turns = _inner(graph, streams, late, settings)
    lag = nanoseconds(max_lag, what="max_lag")
    if older not in OLDER or lag < 0:
        raise DeclarationError(
            "this is no way with late events",
            path=name,
            expected=f"max_lag of 0 or more, and older one of {', '.join(OLDER)}",
            got=f"max_lag={max_lag!r}, older={older!r}",
            fix='write max_lag="0.5s", older="refuse"',
        )
    places = _places(name, size, streams, lag)
    ticks = functools.reduce(operator.or_, (clock_of(s) for s in streams.values()))
    prompt = [clock_of(s) for n, s in streams.items() if n not in late]
    tardy = functools.reduce(operator.or_, [clock_of(streams[n]) for n in late])
    with builder("rewind").scope(name, given=name != "rewind"):
        none, start = np.int32(0), np.int32(-1)
        rows, times = np.zeros((places, turns.row.size)), np.full(places, NEVER, np.int64)
        kept = delay((rows, times, none, none, start, none, none, none), name="ring")
        ring: Any = kept.at(ticks, name="ring_before")
        for k, source in enumerate(inner.sources):
            stream = streams[source]
            event = _event(stream, source in late, turns, k)
            slots = [turns.row.slots[i] for i in turns.leaves[k]]
            ring = insert(
                ring, event, bit=k, columns=(slots[0].start, slots[-1].stop), lag=lag, older=older,
                name=f"insert_{source}",
            )  # fmt: skip
        past = delay(np.tile(turns.start, (places, 1)), name="history")
        history = replay(past, ring, loop=Loop(turns.body), name="replay")
        past.feed(history)
        kept.feed(settle(ring, name="settle"))
        count_late(ring, name="late")
        now_at = functools.reduce(operator.or_, prompt) if prompt else ticks
        now = _outputs(inner, turns, history, ring, now_at, then=False)
        then = _outputs(inner, turns, history, ring, tardy, then=True)
        held = _sampled(ring, tardy, "changed")
        stamp = apply(_time_of, held, name="stamp")
    return Rewound(now, then, stamp)


def _inner(
    graph: GraphFunction, streams: Mapping[str, Stream[Any]], late: Sequence[str], settings: Mapping[str, Any]
) -> tuple[Graph, Turns]:
    """The graph that is rewound, and its tick as a turn."""
    known = graph.parameters[0]
    for wanted in (*streams, *late):
        if wanted not in known:
            raise UnknownNameError("source", wanted, known, path=graph.name)
    if not late or not set(late) <= set(streams):
        raise DeclarationError(
            "nothing that comes late is named",
            path=graph.name,
            expected="late=, names of some of " + ", ".join(streams),
            got=repr(tuple(late)),
            fix=f"write late=({next(iter(streams), 'position')!r},)",
        )
    timings: dict[str, Any] = dict.fromkeys(streams, Timing())
    inner = graph.build(**timings, **settings)
    return inner, turns_of(lower(inner))


def _places(name: str, size: int | None, streams: Mapping[str, Stream[Any]], lag: int) -> int:
    """How many places the ring has."""
    if size is None:
        rates = [_rate(clock_of(s)) for s in streams.values()]
        size = 2 + sum(math.ceil(lag * 1e-9 * r) + 1 for r in rates) if all(rates) else None
    if not isinstance(size, int) or isinstance(size, bool) or not 3 <= size <= _MOST_PLACES:
        raise DeclarationError(
            "rewind needs the size of its history",
            path=name,
            expected=f"size=, a whole number from 3 to {_MOST_PLACES}, or sources that declare their rates",
            got=repr(size),
            fix="write size=128: how many different times there can be within max_lag, and two more",
        )
    return size


def _rate(clock: Clock) -> float:
    """Events a second of a source; 0 where it does not say."""
    timing = getattr(clock, "timing", Timing())
    if timing.period is not None:
        return 1e9 / max(timing.period - timing.jitter, 1)
    return float(timing.max_rate or 0.0)


def _event(stream: Stream[Any], is_late: bool, turns: Turns, k: int) -> Stream[Any]:
    """The times at which values were true, with the values as reals."""
    layout = Layout((turns.row.slots[i].shape, turns.row.slots[i].dtype) for i in turns.leaves[k])
    type_ = stream.type
    label = stream.label.rpartition("/")[2]

    def late_event(value, stamp, *, xp):  # type: ignore[no-untyped-def]
        return stamp, layout.pack(flatten(value, type_), xp)

    def prompt_event(value, *, t, xp):  # type: ignore[no-untyped-def]
        return xp.asarray(t), layout.pack(flatten(value, type_), xp)

    if is_late:
        return apply(late_event, stream, stamp_of(stream), name=f"event_{label}")
    return apply(prompt_event, stream, name=f"event_{label}")


def _sampled(value: Any, at: Clock, name: str) -> Stream[Any]:
    """A stream at a clock within its own."""
    return apply(lambda v: v, value, at=at, name=name)


def _outputs(
    inner: Graph, turns: Turns, history: Any, ring: Any, at: Clock, *, then: bool
) -> dict[str, Stream[Any]]:
    tense = "then" if then else "now"
    row = apply(_place, history, ring, at=at, name=f"row_{tense}", then=then)
    back = apply(lambda ring: ring[4], ring, at=at, name=f"back_{tense}")
    found = {}
    for number, collected in enumerate(inner.collected):
        kind: Type = inner.port(collected.wire).type
        found[collected.name] = apply(
            _read, row, back, name=f"{collected.name.replace('/', '_')}_{tense}", out=kind,
            turns=turns, number=number, type_=kind, then=then,
        )  # fmt: skip
    return found
