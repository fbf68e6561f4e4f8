"""Operations that collect several values into one: windows, folds by a clock, batches, flat maps.

A wire has one fixed shape, so a value of varying length is *padded*: an array with room for a declared
maximum, a mask that says which places hold a value, and their count. `padded(type, size)` is that type. A
stream has at most one value a tick, so what scala-flow broadcasts as several packets is one padded value
here; it is taken apart with array operations, not with more ticks.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, TypeMismatchError
from flowgraph.language import clock as clocks
from flowgraph.language.block import REQUIRED, Block, block, when
from flowgraph.language.checks import folded, need_count, need_init, need_stream, same_type, with_xp
from flowgraph.language.clock import Clock, clock_of
from flowgraph.language.graph import NEVER
from flowgraph.language.queues import empty_queue, push
from flowgraph.language.recording import record
from flowgraph.language.stream import Stream
from flowgraph.types import (
    ArrayType,
    Signal,
    StructType,
    Type,
    annotation_type,
    flatten,
    leaves_of,
    struct_type,
    tuple_type,
    unflatten,
)


def stacked(kind: Any, n: int) -> Type:
    """The type of `n` values of one type as one: a leading axis on every leaf, units and frames kept.

    A signal becomes a signal of the same fields under a name of its own ("Imu[8]").
    """
    found = annotation_type(kind)
    if found is None:
        raise DeclarationError(
            "this is no signal type",
            path="stacked",
            expected="a Signal class, real(...), or a tuple of them",
            got=repr(kind),
            fix="write stacked(real(3), 8)",
        )
    return _stacked(found, n)


@functools.lru_cache(maxsize=1024)
def _stacked(kind: Type, n: int) -> Type:
    if isinstance(kind, ArrayType):
        axes = (None, *kind.axes) if kind.axes else ()
        return ArrayType((n, *kind.shape), kind.dtype, kind.unit, kind.frame, axes)
    parts = {name: _stacked(part, n) for name, part in kind.fields}
    if kind.cls is tuple:
        return tuple_type(list(parts.values()))
    if kind.cls is dict:
        return StructType(kind.name, tuple(parts.items()), dict)
    return _signal(f"{kind.name}[{n}]", f"{n} values of {kind.name}, along the first axis.", parts)


def padded(kind: Any, size: int) -> type[Signal]:
    """The signal type of up to `size` values of one type.

    Fields: `values` (the type of one value with a leading axis of `size`; zeros where there is none), `mask`
    (bool, which of them are there) and `count` (int32, how many).
    """
    need_count("padded", "size", size, least=1)
    return _padded(stacked(kind, size), size)


@functools.lru_cache(maxsize=1024)
def _padded(values: Type, size: int) -> type[Signal]:
    fields = {"values": values, "mask": ArrayType((size,), "bool"), "count": ArrayType((), "int32")}
    return _signal_class(f"Padded[{values}]", f"Up to {size} values: values, mask, count.", fields)


def _signal_class(name: str, doc: str, fields: dict[str, Type]) -> type[Signal]:
    made = type(name, (Signal,), {"__annotations__": fields, "__module__": __name__, "__doc__": doc})
    return typing.cast("type[Signal]", made)


def _signal(name: str, doc: str, fields: dict[str, Type]) -> Type:
    return struct_type(_signal_class(name, doc, fields))


def _padded_type(_: list[Type], settings: dict[str, Any]) -> Type:
    return struct_type(settings["out"])


_tick: Block[Any] = Block(lambda *, xp: xp.asarray(True), name="tick")


def _events(operation: str, at: object) -> Stream[Any]:
    """A stream present at the ticks of `at`, which is a stream or a clock."""
    if at is REQUIRED:
        raise DeclarationError(
            f"{operation} needs the clock at which it closes",
            path=operation,
            expected="at=, a stream or a clock",
            got="none",
            fix=f"write {operation}(..., at=every(10, imu)), or scan(...) for a running fold",
        )
    return at if isinstance(at, Stream) else typing.cast("Stream[Any]", _tick(at=clock_of(at)))


@block(name="window", output=_padded_type, fault=("overflow", "the window is full"))
def _window(state, x=None, tick=None, *, size, kind, out, t, xp):  # type: ignore[no-untyped-def]
    """Present with `tick`: the values since the last tick. State: a queue of values."""
    queue = {"items": state["items"], "count": state["count"]}
    if x is not None:
        queue = push(queue, flatten(x, kind), True, xp)
    late = (queue["count"] > size) & (state["overflow"] == NEVER)
    overflow = xp.where(late, t, state["overflow"])
    if tick is None:
        return {**queue, "overflow": overflow}, None
    mask = xp.arange(size, dtype=xp.int32) < queue["count"]
    closed = out(unflatten(_stacked(kind, size), iter(queue["items"])), mask, queue["count"])
    return {**empty_queue(kind, size), "overflow": overflow}, closed


@_window.init
def _(x: Type, tick: Type, *, size: int, kind: Type, out: Any) -> Any:
    return {**empty_queue(kind, size), "overflow": np.int64(NEVER)}


def window(
    stream: Stream[Any], *, at: Any = REQUIRED, size: int | None = None, name: str | None = None
) -> Stream[Any]:
    """The values since the last tick of `at`, as one padded value; present at each tick of it, empty or not.

    Remembers up to `size` values. One that comes at the very tick of `at` belongs to the window that closes
    there (as `latest` reads after the write). The first window begins with the run. More than `size` values
    are an error at run time that names the window and the time.

    Args:
        at: a stream or clock.
        size: the most values that a window may hold.

    Raises:
        DeclarationError: without a size or a clock.
    """
    operation = name or "window"
    need_stream(operation, stream)
    room = need_count(operation, "size", size, least=1)
    tick = _events(operation, at)
    return typing.cast(
        "Stream[Any]",
        _window(stream, tick, size=room, kind=stream.type, out=padded(stream.type, room), name=name),
    )


@block(name="reduce", output=same_type)
def _reduce(state, x=None, tick=None, *, function, kind, init, xp) -> tuple[Any, Any | None]:  # type: ignore[no-untyped-def]
    """Present with `tick`: the fold of the values since the last tick. State: the fold so far."""
    now = state if x is None else function(state, x, xp=xp)
    return (now, None) if tick is None else (init, now)


@_reduce.init
def _(x: Type, tick: Type, *, function: Any, kind: Type, init: Any) -> Any:
    return init


def reduce(
    stream: Stream[Any],
    function: Callable[..., Any],
    *,
    init: Any = REQUIRED,
    at: Any = REQUIRED,
    name: str | None = None,
) -> Stream[Any]:
    """The fold of the values since the last tick of `at`: function(...function(init, x_i)..., x_k).

    Present at the ticks of `at`, where it starts again from `init`; with no value in between it is `init`.
    Remembers the fold so far. A value at the very tick of `at` is folded before it closes. It is `window` and
    a fold over what is in it, without keeping the values. For the fold at every value, see `scan`.

    Refused: no init, no clock, a function that changes the type of what it folds.
    """
    operation = name or "reduce"
    need_stream(operation, stream)
    need_init(operation, init)
    tick = _events(operation, at)
    kind, start = folded(operation, function, init, stream.type)
    return typing.cast(
        "Stream[Any]",
        _reduce(stream, tick, function=with_xp(function), kind=kind, init=start, name=name),
    )


def _batch_clock(firing: Clock, _: list[Clock], settings: dict[str, Any]) -> Clock:
    return clocks.every(settings["n"], firing, phase=settings["n"] - 1)


@block(name="batch", clock=_batch_clock, output=lambda _, settings: settings["out"])
def _batch(state, x, *, n, kind, out, xp) -> tuple[Any, Any | None]:  # type: ignore[no-untyped-def]
    """Present at each n-th value: the last `n` of them. State: a queue of values."""
    queue = push(state, flatten(x, kind), True, xp)
    full = queue["count"] == n
    count = xp.where(full, np.int32(0), queue["count"])
    return {"items": queue["items"], "count": count}, when(full, unflatten(out, iter(queue["items"])))


@_batch.init
def _(x: Type, *, n: int, kind: Type, out: Type) -> Any:
    return empty_queue(kind, n)


def _alone(x, *, kind, out, xp):  # type: ignore[no-untyped-def]
    """A value as a batch of one."""
    return unflatten(out, iter([xp.expand_dims(leaf, axis=0) for leaf in flatten(x, kind)]))


def batch(n: int, stream: Stream[Any], *, name: str | None = None) -> Stream[Any]:
    """`n` consecutive values as one, along a new first axis; none is in two batches.

    Present with the last of each n, at the clock `every(n, stream, phase=n - 1)`, which the build knows.
    Remembers up to n values; those that do not fill a batch when a run ends stay in `run.state`.
    Refused: an n below 1.
    """
    need_count(name or "batch", "n", n, least=1)
    need_stream(name or "batch", stream)
    out = stacked(stream.type, n)
    if n == 1:
        one: Block[Any] = Block(_alone, name="batch", output=lambda _, settings: settings["out"])
        return typing.cast("Stream[Any]", one(stream, kind=stream.type, out=out, name=name))
    return typing.cast("Stream[Any]", _batch(stream, n=n, kind=stream.type, out=out, name=name))


@block(name="flat_map", output=_padded_type)
def _flat_map(x, *, function, values, out, xp):  # type: ignore[no-untyped-def]
    """The values that `function` gives, zero where its mask is False, with the mask and their count."""
    found, mask = function(x, xp=xp)

    def kept(leaf: Any) -> Any:
        shape = (leaf.shape[0],) + (1,) * (leaf.ndim - 1)
        return xp.where(xp.reshape(mask, shape), leaf, xp.zeros_like(leaf))

    count = xp.astype(xp.sum(xp.astype(mask, xp.int32)), xp.int32)
    return out(unflatten(values, iter([kept(leaf) for leaf in flatten(found, values)])), mask, count)


def flat_map(
    stream: Stream[Any], function: Callable[..., Any], *, size: int | None = None, name: str | None = None
) -> Stream[Any]:
    """Several values for one: `function(x)` gives (values, mask), up to `size` values along the first axis.

    Present with `stream`, one padded value each, also where the mask is False throughout: a stream has one
    value a tick, and the values that scala-flow broadcasts one by one have all the same time. They stay in
    the places where the function put them. No memory. `function` may take `xp`, the array namespace, by
    keyword.

    For a function that needs the host, let `Tags = padded(real(2), 8)` and write a `@block(host=True)` that
    is annotated `-> Tags`.

    Args:
        function: gives (values, mask): an array or tuple of arrays of first axis `size`, and bool[size].
        size: the declared maximum.
    """
    operation = name or "flat_map"
    need_stream(operation, stream)
    room = need_count(operation, "size", size, least=1)
    plain = function.step if isinstance(function, Block) else function
    given = record(Block(plain), [stream.type], {}, None, operation).outputs[0].type
    parts = [t for _, t in given.fields] if isinstance(given, StructType) and given.cls is tuple else []
    mask = parts[1] if len(parts) == 2 else None
    leaves = [t.shape for _, t in leaves_of(parts[0])] if parts else []
    if mask != ArrayType((room,), "bool") or any(shape[:1] != (room,) for shape in leaves):
        raise TypeMismatchError(
            "the function does not give padded values",
            path=operation,
            expected=f"(values, mask): arrays of first axis {room}, and bool[{room}]",
            got=str(given),
            fix=f"return values, mask with room for size={room} values",
        )
    element = _element(parts[0])
    return typing.cast(
        "Stream[Any]",
        _flat_map(stream, function=with_xp(function), values=parts[0], out=padded(element, room), name=name),
    )


def _element(values: Type) -> Type:
    if isinstance(values, ArrayType):
        return ArrayType(values.shape[1:], values.dtype, values.unit, values.frame, values.axes[1:])
    return tuple_type([_element(part) for _, part in values.fields])
