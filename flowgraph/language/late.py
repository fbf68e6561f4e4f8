"""Joins in which it counts when values came last, or when they were true.

`zip_last` pairs what is new on both sides, `resample_at` gives one stream at the times of another, and
`absent_for` tells at the ticks of a clock for how long a stream has been silent. None of them makes a tick: a
value between two others is known when the second has come, and a silence is seen when somebody looks. Timers
that look are sources (`ticks`, `timeouts`).
"""

from __future__ import annotations

import math
import typing
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, TypeMismatchError
from flowgraph.language.block import Block, block, when
from flowgraph.language.checks import need_count, need_reals, need_stream, need_streams, with_xp
from flowgraph.language.clock import Clock, Source, clock_of, nanoseconds, root_of, share_of_root
from flowgraph.language.graph import NEVER
from flowgraph.language.queues import FULL, drop_first, empty_queue, push
from flowgraph.language.stream import Stream
from flowgraph.types import ArrayType, Type, flatten, leaves_of, tuple_type, unflatten, zeros

__all__ = ["HOW", "absent_for", "label_data", "resample_at", "zip_last"]

HOW = ("linear", "slerp", "hold")
"""What lies between two values: a straight line, with attitudes along the arc, or the first of them."""


@block(name="zip_last", output=lambda types, _: tuple_type(types))
def _zip_last(state, a=None, b=None, *, types):  # type: ignore[no-untyped-def]
    """Present where both have come since the last pair. State: the last of each, and whether it is new."""
    new_a = state["new_a"] if a is None else np.True_
    new_b = state["new_b"] if b is None else np.True_
    a, b = state["a"] if a is None else a, state["b"] if b is None else b
    ready = new_a & new_b
    return {"a": a, "b": b, "new_a": new_a & ~ready, "new_b": new_b & ~ready}, when(ready, (a, b))


@_zip_last.init
def _(a: Type, b: Type, *, types: Any) -> Any:
    return {"a": zeros(types[0]), "b": zeros(types[1]), "new_a": np.False_, "new_b": np.False_}


def zip_last(a: Stream[Any], b: Stream[Any], *, name: str | None = None) -> Stream[Any]:
    """Pairs of the last of each, as soon as both have come since the pair before; each is used once at most.

    A value that is followed by another of its stream before the other side has come is passed over. No queue
    and no bound on rates. Remembers one value of each.
    """
    need_streams(name or "zip_last", a=a, b=b)
    return typing.cast("Stream[Any]", _zip_last(a, b, types=(a.type, b.type), name=name))


# -- one stream at the times of another ------------------------------------------------------------------


def _timed_type(types: list[Type], _: Any) -> Type:
    return tuple_type([ArrayType((), "int64", "ns"), types[0]])


@block(name="resample_at", output=_timed_type, fault=("overflow", "too many times wait for a value"))
def _between(state, x=None, asked=None, *, kind, turned, size, full, t, xp):  # type: ignore[no-untyped-def]
    """Present where a time in the queue has its value; takes the oldest. The known come first.

    State: the last value and its time; a queue of (time that was asked for, value), of which the first
    `known` have theirs. A full queue gives up its oldest, which is an overflow where `full` is "error".
    """
    queue, known, expired = state["queue"], state["known"], state["expired"]
    if x is not None:
        queue, known = _answered(state, x, kind, turned, t, xp), queue["count"]
    if asked is not None:
        came = state["came"] if x is None else xp.asarray(True)
        queue = push(queue, [t, *flatten(state["last"] if x is None else x, kind)], came, xp)
        known = known if x is None else known + np.int32(1)
        expired = expired + xp.astype(~came, xp.int32)
    ready = known > 0
    taken = xp.astype(ready, xp.int32)
    gone = xp.maximum(taken, queue["count"] - np.int32(size))
    over = (gone > taken) & xp.asarray(full == "error") & (state["overflow"] == NEVER)
    time, *leaves = (leaf[0, ...] for leaf in queue["items"])
    new = {
        "last": state["last"] if x is None else x,
        "at": state["at"] if x is None else t,
        "came": state["came"] if x is None else np.True_,
        "queue": drop_first(queue, gone, xp),
        "known": xp.maximum(known - gone, np.int32(0)),
        "expired": expired + gone - taken,
        "overflow": xp.where(over, t, state["overflow"]),
    }
    return new, when(ready, (time, unflatten(kind, iter(leaves))))


@_between.init
def _(x: Type, asked: Type, *, kind: Type, turned: Any, size: int, full: str) -> Any:
    none = np.int32(0)
    return {
        "last": zeros(kind),
        "at": np.int64(0),
        "came": np.False_,
        "queue": empty_queue(tuple_type([ArrayType((), "int64"), kind]), size + 1),
        "known": none,
        "expired": none,
        "overflow": np.int64(NEVER),
    }


def _answered(state: Any, x: Any, kind: Type, turned: tuple[bool, ...], t: Any, xp: Any) -> dict[str, Any]:
    """The queue, with what lies between the last value and `x` at each time in it that waited."""
    queue = state["queue"]
    times, *values = queue["items"]
    place = xp.arange(times.shape[0], dtype=xp.int32)
    waits = (place >= state["known"]) & (place < queue["count"])
    gap = xp.astype(xp.where(state["came"], t - state["at"], np.int64(1)), xp.float64)
    share = xp.astype(xp.where(waits, times - state["at"], np.int64(0)), xp.float64) / gap
    made = [times]
    for old, p, q, arc in zip(values, flatten(state["last"], kind), flatten(x, kind), turned, strict=True):
        along = (len(times),) + (1,) * (old.ndim - 1)
        part = xp.reshape(xp.astype(share, old.dtype), along)
        found = _along_arc(p, q, part, xp) if arc else p + (q - p) * part
        made.append(xp.where(xp.reshape(waits, along), found, old))
    return {"items": tuple(made), "count": queue["count"]}


def _along_arc(p: Any, q: Any, share: Any, xp: Any) -> Any:
    """(n, 4) at (n, 1) shares: K. Shoemake, "Animating rotation with quaternion curves", 1985."""
    dot = xp.sum(p * q)
    q = xp.where(dot < 0.0, -q, q)
    angle = xp.acos(xp.minimum(xp.abs(dot), xp.asarray(1.0)))
    sine = xp.sin(angle)
    near = sine < 1e-9
    whole = xp.where(near, 1.0, sine)
    first = xp.where(near, 1.0 - share, xp.sin((1.0 - share) * angle) / whole)
    second = xp.where(near, share, xp.sin(share * angle) / whole)
    mixed = first * p + second * q
    norm = xp.sqrt(xp.sum(mixed * mixed, axis=1, keepdims=True))
    return mixed / xp.where(norm > 0.0, norm, 1.0)


@block(name="resample_at", output=_timed_type)
def _held_at(state, x=None, asked=None, *, kind, t, xp):  # type: ignore[no-untyped-def]
    """Present at the times that are asked for, once a value came. State: the last value."""
    last, came = (state["last"], state["came"]) if x is None else (x, np.True_)
    missed = np.int32(0) if asked is None else xp.astype(~came, xp.int32)
    new = {"last": last, "came": came, "expired": state["expired"] + missed}
    return new, None if asked is None else when(came, (xp.asarray(t), last))


@_held_at.init
def _(x: Type, asked: Type, *, kind: Type) -> Any:
    return {"last": zeros(kind), "came": np.False_, "expired": np.int32(0)}


_tick: Block[Any] = Block(lambda *, xp: xp.asarray(True), name="tick")


def _ticks_of(at: object) -> Stream[Any]:
    return at if isinstance(at, Stream) else typing.cast("Stream[Any]", _tick(at=clock_of(at)))


def resample_at(
    stream: Stream[Any], at: object, *, how: str = "linear", size: int | None = None, full: str = "error",
    name: str | None = None,
) -> Stream[Any]:  # fmt: skip
    """The values of a stream at the ticks of a clock, each with its time: pairs (int64 ns, value).

    Between two values, one is known when the second comes; at a time at which the stream itself has a value,
    at once. A tick of either gives one pair, the oldest that is known: of ten times between two values the
    first comes with the second value, and each other with a tick after it. So a pair is present in a tick
    that may be later than the time in it, and pairs are never out of order. Remembers the last value, and up
    to `size` times. A time before the first value is passed over, and counted in `run.stats` (`expired`).

    Args:
        stream: of real arrays, or signals or tuples of them; of any type where `how` is "hold".
        at: a stream or clock whose ticks are the times.
        how: "linear"; "slerp", where quaternions (leaves of four numbers called `attitude`, or a stream of
            nothing else) go along the arc; or "hold", the last value, which is known at once.
        size: how many times may wait. Left out, as many as come in four periods of the stream (by its
            `max_rate` where it is aperiodic), which is three lost values; at least 64, or 8 where both are
            periodic, and at most 1024. Nothing waits for "hold".
        full: what one more does: "error", or "drop_oldest", where the oldest is passed over and counted. A
            live run raises the error once and goes on, with the oldest dropped from then on.

    Raises:
        DeclarationError: for another `how` or `full`, or a size below 1. TypeMismatchError: for "slerp"
            without a quaternion. FifoOverflowError: by a run, where more than `size` times wait.
    """
    operation = name or "resample_at"
    need_stream(operation, stream)
    if how not in HOW:
        raise DeclarationError(
            "this is no way between two values",
            path=operation,
            expected=" or ".join(map(repr, HOW)),
            got=repr(how),
            fix='write how="linear"',
        )
    if full not in FULL:
        raise DeclarationError(
            "this is not what a full queue can do",
            path=operation,
            expected=" or ".join(map(repr, FULL)),
            got=repr(full),
            fix='write full="drop_oldest" where the stream may fall silent',
        )
    asked = _ticks_of(at)
    room = _usual_size(stream.clock, asked.clock) if size is None else size
    need_count(operation, "size", room, least=1)
    if how == "hold":
        return typing.cast("Stream[Any]", _held_at(stream, asked, kind=stream.type, name=name))
    need_reals(operation, stream)
    leaves = leaves_of(stream.type)
    turned = tuple(
        how == "slerp" and leaf.shape == (4,) and leaf_name.rpartition(".")[2] in ("attitude", "value")
        for leaf_name, leaf in leaves
    )
    if how == "slerp" and not any(turned):
        raise TypeMismatchError(
            "nothing here turns",
            path=operation,
            expected="a quaternion: four numbers, called attitude where there are others",
            got=str(stream.type),
            fix='write how="linear"',
        )
    made = _between(stream, asked, kind=stream.type, turned=turned, size=room, full=full, name=name)
    return typing.cast("Stream[Any]", made)


def _usual_size(stream: Clock, asked: Clock) -> int:
    """How many times come in four steps of the stream, as far as the clocks tell."""
    step, each = _step(stream), _step(asked)
    count = 0 if step is None or each is None else math.ceil(4 * step / each)
    roots = [root_of(stream), root_of(asked)]
    steady = all(isinstance(root, Source) and root.timing.period for root in roots)
    return min(max(8 if steady else 64, count), 1024)


def _step(clock: Clock) -> Fraction | None:
    """Nanoseconds between two ticks, in the mean or at the highest rate; None if unknown."""
    root = root_of(clock)
    if not isinstance(root, Source) or not (root.timing.period or root.timing.max_rate):
        return None
    step = root.timing.period or 1e9 / typing.cast(float, root.timing.max_rate)
    return Fraction(step) / share_of_root(clock)


# -- silence ---------------------------------------------------------------------------------------------


def _asked_clock(firing: Clock, arguments: list[Clock], _: dict[str, Any]) -> Clock:
    return arguments[1]


@block(name="absent_for", clock=_asked_clock, output=lambda *_: ArrayType((), "bool"))
def _absent_for(state, x=None, asked=None, *, span, t, xp):  # type: ignore[no-untyped-def]
    """Present with `asked`: whether `x` has not come for longer than `span`. State: when it last came."""
    since = t if x is not None else xp.where(state == NEVER, t, state)
    return since, None if asked is None else t - since > span


@_absent_for.init
def _(x: Type, asked: Type, *, span: int) -> Any:
    return np.int64(NEVER)


def absent_for(stream: Stream[Any], span: str | int, *, at: object, name: str | None = None) -> Stream[Any]:
    """Whether a stream has not come for longer than `span`, at the ticks of `at`.

    Before the first value, silence is counted from the first tick of either. Remembers one time. It fires
    nothing by itself: let `at` be a timer, a source that ticks whether the stream comes or not.

    Args:
        span: a duration such as "0.5s".
        at: a stream or clock.

    Raises:
        DeclarationError: for a span below 0.
    """
    need_stream(name or "absent_for", stream)
    length = nanoseconds(span, what="span")
    if length < 0:
        raise DeclarationError(
            "a silence has a length", path=name or "absent_for", expected="0 ns or more", got=span,
            fix='write absent_for(stream, "0.5s", at=timer)',
        )  # fmt: skip
    return typing.cast("Stream[Any]", _absent_for(stream, _ticks_of(at), span=length, name=name))


def label_data(stream: Stream[Any], function: Callable[..., Any], *, name: str | None = None) -> Stream[Any]:
    """Pairs of each value and `function(t)` of its tick, int64 ns: data with what they are known to be.

    `function` may take `xp`, the array namespace, by keyword. No memory.
    """
    need_stream(name or "label_data", stream)
    label = with_xp(function)

    def labelled(x, *, t, xp):  # type: ignore[no-untyped-def]
        return x, label(t, xp=xp)

    return typing.cast("Stream[Any]", Block(labelled, name="label_data")(stream, name=name))
