"""Joins: how streams of different clocks meet. None of them guesses.

Each says when its result is present, what it remembers, and what is refused when the graph is built.
`latest` and `delay` are registers. The others are blocks like any other, written in the array API, so that
they are simulated, drawn and lowered by the same rules. Those that give pairs stand in `pairs`.
"""

from __future__ import annotations

import typing
from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from flowgraph.errors import ClockError, DeclarationError
from flowgraph.language import clock as clocks
from flowgraph.language.block import REQUIRED, Block, block, when
from flowgraph.language.builder import builder
from flowgraph.language.checks import need_streams
from flowgraph.language.clock import Clock, clock_of, within
from flowgraph.language.stream import Stream
from flowgraph.types import Type, annotation_type

T = TypeVar("T")


def latest(
    stream: Stream[T] | None = None,
    *,
    init: Any = REQUIRED,
    at: object = None,
    name: str | None = None,
    type: Any = None,
) -> Any:
    """The last value of a stream, held; with `at`, sampled at that clock.

    Reads after this tick's write: where the stream is present, its fresh value. One register.
    Without a stream, feed it later with `.feed(stream)`; such a cycle still needs a delay.

    Args:
        stream: what to hold.
        init: the value before the first; may be left out where `at` proves that the stream came first.
        at: a stream or clock; the result is then a stream that is present at its ticks.
        name: its name in paths and in `run.state`.

    Raises:
        ClockError: with neither `init` nor a proof.
    """
    if stream is not None and not isinstance(stream, Stream):
        raise DeclarationError(
            "latest needs a stream",
            path=name or "latest",
            expected="a Stream",
            got=repr(stream),
            fix="a held value is already held",
        )
    if init is REQUIRED:
        if stream is not None and at is not None and within(clock_of(at), stream.clock):
            return _sample(stream, at=at, name=name)
        raise ClockError(
            "no initial value, and no proof that a value came first",
            path=stream.label if stream is not None else name or "latest",
            expected="init=..., or at= a clock at which the stream is always present",
            got="latest without init" + ("" if at is None else f", at {clock_of(at)}"),
            fix="write latest(stream, init=...)",
        )
    build = builder("latest")
    declared = stream.type if stream is not None else annotation_type(type) if type is not None else None
    held = build.register("latest", name or "latest", init, declared, given=name is not None)
    if stream is not None:
        held.feed(stream)
    return held if at is None else held.at(at)


_sample: Block[Any] = Block(lambda value: value, name="sample")


def _count_clock(firing: Clock, _: list[Clock], settings: dict[str, Any]) -> Clock:
    return clocks.every(settings["n"], firing, phase=settings["phase"])


@block(name="every", clock=_count_clock)
def _every(state, x, *, n, phase):  # type: ignore[no-untyped-def]
    """Present at each n-th value of `x`; state: values seen, modulo n."""
    return (state + 1) % n, when(state == phase, x)


@_every.init
def _(x: Type, *, n: int, phase: int) -> Any:
    return np.int32(0)


@block(name="every", clock=_count_clock)
def _every_tick(state, *, n, phase):  # type: ignore[no-untyped-def]
    """Present at each n-th tick of a clock; state: ticks seen, modulo n."""
    return (state + 1) % n, when(state == phase, state == phase)


@_every_tick.init
def _(*, n: int, phase: int) -> Any:
    return np.int32(0)


def every(n: int, stream: Stream[T] | Clock, *, phase: int = 0, name: str | None = None) -> Stream[T]:
    """Each n-th value of a stream (or tick of a clock), starting with number `phase`."""
    whole = all(isinstance(k, int) and not isinstance(k, bool) for k in (n, phase))
    if not whole or not 1 <= n < 2**31 or not 0 <= phase < n:
        raise DeclarationError(
            "every needs a positive whole number and a phase below it",
            path=name or "every",
            expected="whole numbers, 1 <= n < 2^31, 0 <= phase < n",
            got=f"n={n!r}, phase={phase!r}",
            fix="write every(5, imu)",
        )
    if isinstance(stream, Clock):
        return typing.cast("Stream[T]", _every_tick(at=stream, n=n, phase=phase, name=name))
    return stream if n == 1 else typing.cast("Stream[T]", _every(stream, n=n, phase=phase, name=name))


@block(name="merge")
def _merge(a=None, b=None, *, tie):  # type: ignore[no-untyped-def]
    """The one that is present; `tie(a, b)` where both are."""
    if a is None:
        return b
    return a if b is None else tie(a, b)


_TIES: dict[str, Callable[[Any, Any], Any]] = {"left": lambda a, b: a, "right": lambda a, b: b}


def merge(a: Stream[T], b: Stream[T], *, tie: Any = None, name: str | None = None) -> Stream[T]:
    """Either stream; present when one is. No memory.

    Args:
        tie: what to take where both are present: "left", "right", or a function of both values.

    Raises:
        ClockError: where the clocks can coincide and no `tie` is named.
    """
    need_streams(name or "merge", a=a, b=b)
    if tie is None and not clocks.disjoint(a.clock, b.clock):
        raise ClockError(
            f"{a.label} and {b.label} can be present together",
            path=name or "merge",
            expected="a rule for ties",
            got=f"{a.clock} and {b.clock}, no tie",
            fix='write merge(a, b, tie="left"), "right" or a function of both',
        )
    if isinstance(tie, str) and tie not in _TIES:
        raise DeclarationError(
            "this tie rule does not exist",
            path=name or "merge",
            expected='"left", "right" or a function',
            got=repr(tie),
            fix='write tie="left"',
        )
    rule = _TIES[tie] if isinstance(tie, str) else tie or _TIES["left"]
    return typing.cast("Stream[T]", _merge(a, b, tie=rule, name=name))


def collect(stream: Stream[Any], name: str) -> None:
    """Keep all values of a stream in the result of a run, under `name`."""
    builder("collect").collect(name, stream)


def sink(stream: Stream[Any], function: Callable[..., Any], *, name: str | None = None) -> None:
    """Call `function(value)` on the host for each value: a print, a file, a display."""

    def consume(value: Any) -> None:
        function(value)

    Block(consume, name=name or getattr(function, "__name__", "sink").strip("<>"), host=True)(stream)
