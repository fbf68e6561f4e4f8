"""Pairs: two streams put together one to one, by count or by time, through queues of fixed size.

`zip` takes the first with the first and the second with the second; how far one may get ahead follows from
the clocks, so the bound is derived. `match` takes what was true at nearly one time; its queue has the size
that is asked for, and what expires is counted. `zip_latest` and `zip_latest_right` hold the last value of the
other stream and need no queue.
"""

from __future__ import annotations

import builtins
import math
import typing
from typing import Any

import numpy as np

from flowgraph.errors import ClockError, DeclarationError
from flowgraph.language import clock as clocks
from flowgraph.language.block import Block, block, when
from flowgraph.language.checks import need_streams
from flowgraph.language.clock import Clock, Counted, Source, nanoseconds
from flowgraph.language.graph import NEVER
from flowgraph.language.joins import latest
from flowgraph.language.queues import FULL, drop_first, empty_queue, push
from flowgraph.language.stream import Stream
from flowgraph.types import ArrayType, Type, flatten, tuple_type, unflatten


def _ranks(clock: Clock, root: Clock, ticks: int) -> list[int]:
    """Which of the first `ticks` ticks of `root` belong to `clock`, by number."""
    if clock == root:
        return list(range(ticks))
    assert isinstance(clock, Counted)
    if clock.parent == root:
        return [
            start + o for start in range(0, ticks, clock.period) for o in clock.offsets if start + o < ticks
        ]
    inner = _ranks(clock.parent, root, ticks)
    return [tick for number, tick in enumerate(inner) if number % clock.period in clock.offsets]


def _over(root: Clock, clock: Clock) -> Clock:
    """The same part of another root."""
    if isinstance(clock, Counted):
        return Counted(_over(root, clock.parent), clock.period, clock.offsets)
    return root


def _span(clock: Clock) -> int:
    return clock.period * _span(clock.parent) if isinstance(clock, Counted) else 1


def _zip_plan(a: Clock, b: Clock, label: str) -> tuple[int, Clock]:
    """The queue size that a zip needs, and the clock of its pairs.

    Raises:
        ClockError: where the rates differ, are only nominally equal, or cannot be known.
    """
    root = clocks.root_of(a)
    if root != clocks.root_of(b) and clocks.equal(root, clocks.root_of(b)):
        b = _over(root, b)  # one clock by two names
    if root != clocks.root_of(b):
        sources = [c for c in (root, clocks.root_of(b)) if isinstance(c, Source)]
        rates = {f"{c.timing.period}" for c in sources if c.timing.period is not None}
        same = len(sources) == 2 and len(rates) == 1 and all(c.timing.period for c in sources)
        raise ClockError(
            "two devices whose rates are only nominally equal drift apart"
            if same
            else "the rates cannot be proven equal",
            path=label,
            expected="streams derived from one source at equal rates",
            got=f"{a} and {b}",
            fix="pair by time with match(a, b, tolerance=..., size=...)"
            + ("" if same else ", or hold one with latest(b, init=...)"),
        )
    span = math.lcm(_span(a), _span(b))
    of_a, of_b = (clocks.share_of_root(clock) * 2 * span for clock in (a, b))
    if of_a != of_b:
        raise ClockError(
            "the rates are unequal, so a queue would grow without bound",
            path=label,
            expected="equal rates",
            got=f"{a}: {of_a} of {2 * span}, {b}: {of_b} of {2 * span} ticks of {root}",
            fix="hold the slower one: latest(slow, init=...)",
        )
    in_a, in_b = set(_ranks(a, root, 2 * span)), set(_ranks(b, root, 2 * span))
    depth, ahead, pairs = 1, 0, []
    for i in sorted(in_a | in_b):
        x, y = i in in_a, i in in_b
        before = ahead
        ahead += x - y
        depth = max(depth, abs(ahead))
        if (y and before > 0) or (x and before < 0) or (x and y):
            pairs.append(i)
    return depth, clocks.counted(root, span, [i for i in pairs if i < span])  # both rounds are alike


def _pair_type(types: list[Type], _: Any) -> Type:
    return tuple_type(types)


def _zip_clock(firing: Clock, args: list[Clock], settings: dict[str, Any]) -> Clock:
    return typing.cast(Clock, settings["clock"])


@block(name="zip", clock=_zip_clock, output=_pair_type, fault=("overflow", "the queue is full"))
def _zip(state, a=None, b=None, *, size, types, clock, t, xp):  # type: ignore[no-untyped-def]
    """Present where both queues hold a value; takes the oldest of each. State: two queues."""
    left = _arrive(state["a"], a, types[0], xp)
    right = _arrive(state["b"], b, types[1], xp)
    ready = (left["count"] > 0) & (right["count"] > 0)
    out = tuple(
        unflatten(kind, iter([leaf[0, ...] for leaf in queue["items"]]))
        for kind, queue in builtins.zip(types, (left, right), strict=True)
    )
    gone = xp.astype(xp.asarray(ready), xp.int32)
    over = (left["count"] - gone > size) | (right["count"] - gone > size)
    new = {
        "a": drop_first(left, gone, xp),
        "b": drop_first(right, gone, xp),
        "overflow": xp.where(over & (state["overflow"] == NEVER), t, state["overflow"]),
    }
    return new, when(ready, out)


@_zip.init
def _(a: Type, b: Type, *, size: int, types: Any, clock: Any) -> Any:
    return {
        "a": empty_queue(types[0], size + 1),
        "b": empty_queue(types[1], size + 1),
        "overflow": np.int64(NEVER),
    }


def _arrive(queue: dict[str, Any], value: Any, type_: Type, xp: Any) -> dict[str, Any]:
    return queue if value is None else push(queue, flatten(value, type_), True, xp)


@block(name="zip")
def _pair(a, b):  # type: ignore[no-untyped-def]
    """Both values; streams of one clock need no queue."""
    return a, b


_pair_latest: Block[Any] = Block(_pair.step, name="zip_latest")


def zip(a: Stream[Any], b: Stream[Any], *, name: str | None = None) -> Stream[Any]:
    """Pairs in order: the k-th of `a` with the k-th of `b`. Two queues, whose size follows from the clocks.

    Raises:
        ClockError: where rates are unequal (use `latest`) or only nominally equal (use `match`).
    """
    need_streams(name or "zip", a=a, b=b)
    label = name or f"zip({a.label}, {b.label})"
    if clocks.equal(a.clock, b.clock):
        return typing.cast("Stream[Any]", _pair(a, b, name=name))
    size, clock = _zip_plan(a.clock, b.clock, label)
    return typing.cast("Stream[Any]", _zip(a, b, size=size, types=(a.type, b.type), clock=clock, name=name))


def zip_latest(a: Stream[Any], b: Stream[Any], *, init: Any, name: str | None = None) -> Stream[Any]:
    """Pairs whenever either comes, with the last value of the other; `init` is the pair before the first."""
    need_streams(name or "zip_latest", a=a, b=b)
    if not isinstance(init, tuple | list) or len(init) != 2:
        raise DeclarationError(
            "zip_latest starts from a pair",
            path=name or f"zip_latest({a.label}, {b.label})",
            expected="init=(value of a, value of b)",
            got=repr(init),
            fix="write init=(0.0, 0.0)",
        )
    first, second = init
    left, right = latest(a, init=first), latest(b, init=second)
    return typing.cast("Stream[Any]", _pair_latest(left, right, at=a | b, name=name))


def zip_latest_right(a: Stream[Any], b: Stream[Any], *, init: Any, name: str | None = None) -> Stream[Any]:
    """Pairs whenever `a` comes, with the last value of `b`; `init` is the value of `b` before its first."""
    need_streams(name or "zip_latest_right", a=a, b=b)
    return typing.cast("Stream[Any]", _pair_latest(a, latest(b, init=init), name=name))


@block(name="match", output=_pair_type, fault=("overflow", "the queue is full"))
def _match(state, a=None, b=None, *, tolerance, size, full, types, t, xp):  # type: ignore[no-untyped-def]
    """Present where an arriving value finds one of the other stream within `tolerance`; takes the nearest.

    State: two queues of (time, value); what is passed over or grows too old is counted as expired. A full
    queue gives up its oldest value, which is an overflow where `full` is "error".
    """
    stamped = [tuple_type([ArrayType((), "int64"), kind]) for kind in types]
    state_a, state_b = state["a"], state["b"]
    left = state_a if a is None else push(state_a, [t, *flatten(a, types[0])], True, xp)
    right = state_b if b is None else push(state_b, [t, *flatten(b, types[1])], True, xp)
    # only one queue can hold older values, except in the tick in which both arrive
    pick_a, near_a = _nearest(left, t, tolerance, xp)
    pick_b, near_b = _nearest(right, t, tolerance, xp)
    fresh_a, fresh_b = a is not None, b is not None
    if fresh_a and fresh_b:
        pick_a, pick_b, ready = left["count"] - 1, right["count"] - 1, xp.asarray(True)
    elif fresh_a:
        pick_a, ready = left["count"] - 1, near_b
    else:
        pick_b, ready = right["count"] - 1, near_a
    value = tuple(
        unflatten(kind, iter([xp.take(leaf, xp.maximum(pick, 0), axis=0) for leaf in queue["items"]]))[1]
        for kind, queue, pick in ((stamped[0], left, pick_a), (stamped[1], right, pick_b))
    )
    stale_a = _stale(left, t, tolerance, xp) if fresh_b else xp.asarray(np.int32(0))
    stale_b = _stale(right, t, tolerance, xp) if fresh_a else xp.asarray(np.int32(0))
    gone_a = xp.where(ready, xp.astype(pick_a, xp.int32) + 1, stale_a)
    gone_b = xp.where(ready, xp.astype(pick_b, xp.int32) + 1, stale_b)
    taken = xp.astype(ready, xp.int32)
    over = (left["count"] - gone_a > size) | (right["count"] - gone_b > size)
    over = over & xp.asarray(full == "error")
    gone_a = xp.maximum(gone_a, left["count"] - np.int32(size))
    gone_b = xp.maximum(gone_b, right["count"] - np.int32(size))
    new = {
        "a": drop_first(left, gone_a, xp),
        "b": drop_first(right, gone_b, xp),
        "expired_a": state["expired_a"] + gone_a - taken,
        "expired_b": state["expired_b"] + gone_b - taken,
        "overflow": xp.where(over & (state["overflow"] == NEVER), t, state["overflow"]),
    }
    return new, when(ready, value)


@_match.init
def _(a: Type, b: Type, *, tolerance: int, size: int, full: str, types: Any) -> Any:
    stamp = ArrayType((), "int64")
    left, right = (empty_queue(tuple_type([stamp, kind]), size + 1) for kind in types)
    none = np.int32(0)
    return {"a": left, "b": right, "expired_a": none, "expired_b": none, "overflow": np.int64(NEVER)}


_EMPTY_SLOT_AGE = 2**62  # ns: older than any tolerance, so an empty slot is never near
_LONGEST_QUEUE = 2**24


def _distances(queue: dict[str, Any], t: Any, xp: Any) -> tuple[Any, Any]:
    held = xp.arange(queue["items"][0].shape[0], dtype=xp.int32) < queue["count"]
    return held, t - queue["items"][0]


def _nearest(queue: dict[str, Any], t: Any, tolerance: int, xp: Any) -> tuple[Any, Any]:
    """Place of the value nearest in time, and whether it is within the tolerance."""
    held, age = _distances(queue, t, xp)
    gap = xp.where(held, age, _EMPTY_SLOT_AGE)
    return xp.argmin(gap), xp.min(gap) <= tolerance


def _stale(queue: dict[str, Any], t: Any, tolerance: int, xp: Any) -> Any:
    """How many values are too old for anything that can still come."""
    held, age = _distances(queue, t, xp)
    return xp.astype(xp.sum(xp.astype(held & (age > tolerance), xp.int32)), xp.int32)


def match(
    a: Stream[Any], b: Stream[Any], *, tolerance: str | int, size: int | None = None, full: str = "error",
    name: str | None = None,
) -> Stream[Any]:  # fmt: skip
    """Pairs of values whose time stamps agree within `tolerance`; each arriving value takes the nearest.

    A value expires once the other stream has passed it, which `run.stats` counts (`expired_a`, `expired_b`).

    Args:
        tolerance: a duration such as "5ms".
        size: how many values of one stream may wait.
        full: what one more does: "error", or "drop_oldest", where the oldest expires and is counted. A live
            run raises the error once and goes on, with the oldest dropped from then on.

    Raises:
        DeclarationError: without a size, with a tolerance that is no duration, or another word for `full`.
    """
    need_streams(name or "match", a=a, b=b)
    if full not in FULL:
        raise DeclarationError(
            "this is not what a full queue can do",
            path=name or f"match({a.label}, {b.label})",
            expected=" or ".join(map(repr, FULL)),
            got=repr(full),
            fix='write full="drop_oldest" where the other stream may fall silent',
        )
    label = name or f"match({a.label}, {b.label})"
    if not isinstance(size, int) or isinstance(size, bool) or not 1 <= size <= _LONGEST_QUEUE:
        raise DeclarationError(
            "match needs the size of its queues",
            path=label,
            expected=f"size=, a whole number from 1 to {_LONGEST_QUEUE}",
            got=repr(size),
            fix="write match(a, b, tolerance=..., size=8): how many values may wait for a partner",
        )
    span = nanoseconds(tolerance, what="tolerance")
    if not 0 <= span < _EMPTY_SLOT_AGE:
        raise DeclarationError(
            "this tolerance cannot be kept",
            path=label,
            expected="0 ns or more, below 2^62 ns",
            got=repr(tolerance),
            fix='write tolerance="5ms"',
        )
    return typing.cast(
        "Stream[Any]", _match(a, b, tolerance=span, size=size, full=full, types=(a.type, b.type), name=name)
    )
