"""Operations on one stream that scala-flow's `Source` had: ends, running folds, groups, parts, taps.

Each says when its result is present, what it remembers, what it does with the first value, and what is
refused when the graph is built. All of them are blocks of array operations, simulated, drawn and lowered by
the same rules as any other, except `tap`, which is for the host. Those in which the time between events
counts are in `flowgraph.language.timed`, those that collect several values into one in
`flowgraph.language.windows`.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable, Hashable, Sequence
from typing import Any, TypeVar

import numpy as np

from flowgraph.errors import DeclarationError, TypeMismatchError
from flowgraph.language.block import REQUIRED, Block, block, when
from flowgraph.language.checks import (
    folded,
    need_count,
    need_init,
    need_stream,
    result_type,
    same_type,
    with_xp,
)
from flowgraph.language.clock import Clock, Condition
from flowgraph.language.stream import Stream
from flowgraph.types import ArrayType, StructType, Type

T = TypeVar("T")


# -- beginnings and ends -----------------------------------------------------------------------------


@block(name="take_while", output=lambda types, _: types[0])
def _take_while(state, x, *, predicate, xp) -> tuple[Any, Any | None]:  # type: ignore[no-untyped-def]
    """Present until `predicate` is first false. State: whether it has held so far."""
    still = state & predicate(x, xp=xp)
    return still, when(still, x)


@_take_while.init
def _(x: Type, *, predicate: Any) -> Any:
    return np.True_


def take_while(stream: Stream[T], predicate: Callable[..., Any], *, name: str | None = None) -> Stream[T]:
    """The values before the first for which `predicate` is false; after it, none. A clock of its own.

    Remembers one truth value. The first value is tested like any other. Other readers of `stream` go on.
    Refused: a predicate that does not give a truth value.
    """
    operation = name or "take_while"
    need_stream(operation, stream)
    given = result_type(predicate, [stream.type], operation)
    if given is not None and given != ArrayType((), "bool"):
        raise TypeMismatchError(
            "the predicate does not give a truth value",
            path=operation,
            expected="bool",
            got=str(given),
            fix="compare: lambda v: v < limit; over an array, xp.all(...)",
        )
    return typing.cast("Stream[T]", _take_while(stream, predicate=with_xp(predicate), name=name))


@block(name="until")
def _until(state, x=None, stop=None, *, inclusive) -> tuple[Any, Any | None]:  # type: ignore[no-untyped-def]
    """Present with `x` until `stop` first is. State: whether it has not been yet."""
    after = state if stop is None else np.False_
    return after, None if x is None else when(state if inclusive else after, x)


@_until.init
def _(x: Type, stop: Type, *, inclusive: bool) -> Any:
    return np.True_


def until(
    stream: Stream[T], stop: Stream[Any], *, inclusive: bool = False, name: str | None = None
) -> Stream[T]:
    """The values before the first event of `stop`; from it on, none. A clock of its own.

    Remembers one truth value. A value at the very tick of that event passes only if `inclusive`. A condition
    on another stream is `until(x, y.filter(condition))`.
    """
    need_stream(name or "until", stream)
    need_stream(name or "until", stop)
    return typing.cast("Stream[T]", _until(stream, stop, inclusive=bool(inclusive), name=name))


def _drop_clock(firing: Clock, _: list[Clock], settings: dict[str, Any]) -> Clock:
    return Condition(f"drop({settings['n']}, {firing})", firing)  # equal for streams of one clock


@block(name="drop", clock=_drop_clock)
def _drop(state, x, *, n, xp):  # type: ignore[no-untyped-def]
    """Present after the first `n` values. State: values seen, up to n."""
    return xp.minimum(state + 1, n), when(state >= n, x)


@_drop.init
def _(x: Type, *, n: int) -> Any:
    return np.int32(0)


def drop(n: int, stream: Stream[T], *, name: str | None = None) -> Stream[T]:
    """All values but the first `n`. Remembers a count up to n.

    The clock is that of `stream` from its value number n on (the first has number 0); two streams of one
    clock, both less n values, are again of one clock. Refused: a negative n.
    """
    need_count(name or "drop", "n", n, least=0)
    need_stream(name or "drop", stream)
    return stream if n == 0 else typing.cast("Stream[T]", _drop(stream, n=n, name=name))


# -- folds, groups, parts ----------------------------------------------------------------------------


@block(name="scan", output=same_type)
def _scan(state, x, *, function, kind, init, xp):  # type: ignore[no-untyped-def]
    """state = function(state, x), which is the output too."""
    new = function(state, x, xp=xp)
    return new, new


@_scan.init
def _(x: Type, *, function: Any, kind: Type, init: Any) -> Any:
    return init


def scan(
    stream: Stream[Any], function: Callable[..., Any], *, init: Any = REQUIRED, name: str | None = None
) -> Stream[Any]:
    """The running fold: y_k = function(y_{k-1}, x_k). Present with `stream`; remembers y.

    y_{-1} = init, which is not put out: the first output is function(init, x_0). `function` may take `xp`,
    the array namespace, by keyword. Refused: no init, a function that changes the type of what it folds.
    """
    need_stream(name or "scan", stream)
    need_init(name or "scan", init)
    kind, start = folded(name or "scan", function, init, stream.type)
    return typing.cast(
        "Stream[Any]", _scan(stream, function=with_xp(function), kind=kind, init=start, name=name)
    )


def _pick(x, key, *, value):  # type: ignore[no-untyped-def]
    """Present, with the value of `x`, where the key is `value`."""
    return when(key == value, x)


def _others(x, key, *, keys, xp):  # type: ignore[no-untyped-def]
    """Present, with the value of `x`, where the key is none of `keys`."""
    return when(~functools.reduce(xp.logical_or, [key == k for k in keys]), x)


def group_by(
    stream: Stream[T], key: Callable[..., Any], keys: Sequence[Hashable], *, name: str | None = None
) -> dict[Any, Stream[T]]:
    """Split a stream by a key: `{k: the values whose key is k}` for each of `keys`. No memory.

    Each part has a clock of its own within that of `stream`. A run cannot open new streams, so the keys are
    declared: integers, truth values or members of an `IntEnum`. The values whose key is none of them are in
    the part under None, so that leaving them out is the graph's own doing. Refused: no keys, equal keys, a
    key function that gives anything but one integer or truth value.
    """
    operation = name or "group_by"
    need_stream(operation, stream)
    if not keys or len(set(keys)) < len(keys) or not all(isinstance(k, int | np.integer) for k in keys):
        raise DeclarationError(
            "group_by needs its keys declared",
            path=operation,
            expected="one or more whole numbers, all different",
            got=repr(keys),
            fix="write group_by(stream, key, keys=(0, 1, 2))",
        )
    found = Block(key.step if isinstance(key, Block) else key, name="group_by.key")(
        stream, name=name and f"{name}.key"
    )
    if not isinstance(found.type, ArrayType) or found.type.shape or found.type.dtype == "real":
        raise TypeMismatchError(
            "the key is no whole number",
            path=operation,
            expected="one integer or truth value for each value of the stream",
            got=str(found.type),
            fix="convert it in the key function: xp.astype(..., xp.int32)",
        )
    parts: dict[Any, Stream[T]] = {}
    for k in keys:
        label = f"group_by[{k}]"
        part: Block[Any] = Block(_pick, name=label)
        parts[k] = part(stream, found, value=k, name=name and f"{name}[{k}]")
    rest: Block[Any] = Block(_others, name="group_by[others]")
    parts[None] = rest(stream, found, keys=tuple(keys), name=name and f"{name}[others]")
    return parts


def _part(x, *, index):  # type: ignore[no-untyped-def]
    """One part of a tuple."""
    return x[index]


def unzip(stream: Stream[Any], *, name: str | None = None) -> tuple[Stream[Any], ...]:
    """The streams of the parts of a stream of tuples, all at its clock. No memory. Refused: no tuple."""
    need_stream(name or "unzip", stream)
    if not isinstance(stream.type, StructType) or stream.type.cls is not tuple:
        raise TypeMismatchError(
            "unzip needs a stream of tuples",
            path=name or "unzip",
            expected="a tuple, as zip, match and apply give",
            got=f"{stream.type} from {stream.label}",
            fix="take a field out with .map(lambda v: v.field)",
        )
    made: list[Stream[Any]] = []
    for index in range(len(stream.type.fields)):
        part: Block[Any] = Block(_part, name=f"unzip[{index}]")
        made.append(part(stream, index=index, name=name and f"{name}[{index}]"))
    return tuple(made)


# -- the host ----------------------------------------------------------------------------------------


def tap(stream: Stream[T], function: Callable[[Any], object], *, name: str | None = None) -> Stream[T]:
    """Call `function(value)` on the host for each value, and return the very same stream.

    For a print, a log, a probe: it stands beside the wire and cannot change what flows. No memory. What it
    returns is not used. A lowered graph runs it on the host, after the pipeline (`flowgraph.pipeline.cut`);
    what a run is seen to do is the same in all engines, so no engine leaves it out in silence.
    """
    need_stream(name or "tap", stream)

    def consume(value: Any) -> None:
        function(value)

    called = getattr(function, "__name__", type(function).__name__).strip("<>")
    watcher: Block[Any] = Block(consume, name=f"tap({called})", host=True)
    watcher(stream, name=name)
    return stream
