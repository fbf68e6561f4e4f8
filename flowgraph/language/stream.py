"""Streams and held values: what a graph function handles while a graph is declared.

A `Stream` stands for values that will flow, present at the ticks of its clock; a `Held` for a register read,
which is always there and fires nothing. Neither carries a value itself.
"""

from __future__ import annotations

import operator
import typing
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from flowgraph.errors import DeclarationError
from flowgraph.language.block import Block, block, when
from flowgraph.language.clock import Clock, clock_of
from flowgraph.language.graph import OutputPort, Wire
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.types import Type, annotation_type
from flowgraph.verbs import verb

if TYPE_CHECKING:
    from flowgraph.language.builder import Builder

T = TypeVar("T", covariant=True)


class Stream(Generic[T]):
    """Values that flow: present, with one value, at the ticks of `clock`."""

    __hash__ = object.__hash__
    __array_ufunc__ = None  # NumPy arrays on the left defer to this class

    def __init__(self, builder: Builder, wire: Wire, port: OutputPort, label: str) -> None:
        self.builder, self.wire, self.type, self.clock, self.label = (
            builder,
            wire,
            port.type,
            port.clock,
            label,
        )

    def map(self, function: Callable[..., Any], *, name: str | None = None, out: Any = None) -> Stream[Any]:
        """Apply a function to each value; `out` is the type of the result where it cannot be traced."""
        return apply(function, self, name=name, out=out)

    def filter(self, predicate: Callable[..., Any], *, name: str | None = None) -> Stream[T]:
        """The values for which the predicate is true; the result has a clock of its own."""
        return typing.cast("Stream[T]", _filter(self, predicate=predicate, name=name))

    def every(self, n: int, *, phase: int = 0) -> Stream[T]:
        """Each n-th value, starting with value number `phase`."""
        return typing.cast("Stream[T]", verb("Stream.every")(n, self, phase=phase))

    def drop(self, n: int, *, name: str | None = None) -> Stream[T]:
        """All values but the first `n`."""
        return typing.cast("Stream[T]", verb("Stream.drop")(n, self, name=name))

    def take_while(self, predicate: Callable[..., Any], *, name: str | None = None) -> Stream[T]:
        """The values before the first for which the predicate is false."""
        return typing.cast("Stream[T]", verb("Stream.take_while")(self, predicate, name=name))

    def tap(self, function: Callable[[Any], object], *, name: str | None = None) -> Stream[T]:
        """This stream, with `function(value)` called on the host for each value."""
        return typing.cast("Stream[T]", verb("Stream.tap")(self, function, name=name))

    def delay(self, init: Any, *, name: str | None = None) -> Held[T]:
        """The value of an earlier tick, held: what was last written before this tick."""
        register = verb("Stream.delay")(init, name=name, type=self.type)
        register.feed(self)
        return typing.cast("Held[T]", register)

    def __or__(self, other: object) -> Clock:
        return self.clock | clock_of(other)

    def __and__(self, other: object) -> Clock:
        return self.clock & clock_of(other)

    def __add__(self, other: Any) -> Stream[Any]:
        return _operate(operator.add, self, other)

    def __sub__(self, other: Any) -> Stream[Any]:
        return _operate(operator.sub, self, other)

    def __mul__(self, other: Any) -> Stream[Any]:
        return _operate(operator.mul, self, other)

    def __truediv__(self, other: Any) -> Stream[Any]:
        return _operate(operator.truediv, self, other)

    def __matmul__(self, other: Any) -> Stream[Any]:
        return _operate(operator.matmul, self, other)

    def __radd__(self, other: Any) -> Stream[Any]:
        return _operate(operator.add, self, other, swap=True)

    def __rsub__(self, other: Any) -> Stream[Any]:
        return _operate(operator.sub, self, other, swap=True)

    def __rmul__(self, other: Any) -> Stream[Any]:
        return _operate(operator.mul, self, other, swap=True)

    def __rtruediv__(self, other: Any) -> Stream[Any]:
        return _operate(operator.truediv, self, other, swap=True)

    def __rmatmul__(self, other: Any) -> Stream[Any]:
        return _operate(operator.matmul, self, other, swap=True)

    def __neg__(self) -> Stream[Any]:
        return apply(operator.neg, self)

    def __lt__(self, other: Any) -> Stream[Any]:
        return _operate(operator.lt, self, other)

    def __le__(self, other: Any) -> Stream[Any]:
        return _operate(operator.le, self, other)

    def __gt__(self, other: Any) -> Stream[Any]:
        return _operate(operator.gt, self, other)

    def __ge__(self, other: Any) -> Stream[Any]:
        return _operate(operator.ge, self, other)

    def __bool__(self) -> bool:
        raise DeclarationError(
            "a stream has no truth value when the graph is declared",
            path=self.label,
            expected="a test on the values, at run time",
            got="if, and, or, not on a stream",
            fix="use .filter(predicate), or `is not None` for an optional source",
        )

    def __iter__(self) -> typing.NoReturn:
        raise DeclarationError(
            "a stream cannot be unpacked",
            path=self.label,
            expected="one stream",
            got="unpacking",
            fix="take the parts with .map(lambda v: v[0])",
        )

    def __array__(self, *_: Any, **__: Any) -> typing.NoReturn:
        _refuse_as_value(self)

    def __repr__(self) -> str:
        return f"<Stream {self.label}: {self.type} at {self.clock}>"


class Held(Generic[T]):
    """A value that is always there: a register read. It fires nothing."""

    def __init__(self, builder: Builder, register: int, type_: Type, label: str) -> None:
        self.builder, self.register, self.type, self.label = builder, register, type_, label

    def at(self, clock: object, *, name: str | None = None) -> Stream[T]:
        """A stream that samples this value at a clock."""
        return typing.cast("Stream[T]", _SAMPLE(self, at=clock, name=name))

    def feed(self, stream: Stream[T]) -> None:
        """Write `stream` into this register at the end of each tick in which it is present."""
        self.builder.feed(self, stream)

    def __array__(self, *_: Any, **__: Any) -> typing.NoReturn:
        _refuse_as_value(self)

    def __repr__(self) -> str:
        return f"<Held {self.label}: {self.type}>"


_SAMPLE: Block[Any] = Block(lambda value: value, name="sample")


@block(name="filter")
def _filter(x, *, predicate):  # type: ignore[no-untyped-def]
    """Present, with the value of `x`, where `predicate(x)` is true."""
    return when(predicate(x), x)


def _refuse_as_value(thing: Stream[Any] | Held[Any]) -> typing.NoReturn:
    """Refuse a stream where a value is meant: mostly one that a lambda has captured."""
    kind = "stream" if isinstance(thing, Stream) else "held value"
    raise DeclarationError(
        f"{thing.label} is a {kind}, not a number: a step sees only what comes through its ports",
        path=thing.label,
        expected="values of the step's own parameters",
        got=repr(thing),
        fix="pass it as a port: apply(f, a, b), where f = lambda v, w: v + w",
    )


def _operate(
    function: Callable[..., Any], stream: Stream[Any], other: Any, *, swap: bool = False
) -> Stream[Any]:
    if isinstance(other, Stream | Held):
        return apply(function, stream, other)
    if isinstance(other, Symbolic):
        _refuse_as_value(stream)
    if swap:
        return apply(Block(lambda x: function(other, x), name=function.__name__), stream)
    return apply(Block(lambda x: function(x, other), name=function.__name__), stream)


def apply(
    function: Callable[..., Any],
    *streams: Any,
    name: str | None = None,
    out: Any = None,
    at: object = None,
    **settings: Any,
) -> Stream[Any]:
    """A stream of `function(values...)`, present when all streams are; their clocks must be equal."""
    named = getattr(function, "__name__", "map")
    declared = annotation_type(out)
    rule = None if declared is None else (lambda types, settings: declared)
    block: Block[Any] = (
        function
        if isinstance(function, Block)
        else Block(function, name="map" if named == "<lambda>" else named, output=rule)
    )
    return typing.cast("Stream[Any]", block(*streams, name=name, at=at, **settings))
