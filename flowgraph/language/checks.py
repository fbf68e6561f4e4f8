"""What stream operations ask of their arguments, and how they call and type a user's function."""

from __future__ import annotations

import functools
import inspect
import math
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from flowgraph.errors import DeclarationError, LoweringError, TypeMismatchError
from flowgraph.language.block import REQUIRED, Block
from flowgraph.language.recording import record
from flowgraph.language.stream import Stream
from flowgraph.types import StructType, Type, as_value, leaves_of, type_of


def need_stream(operation: str, stream: object) -> None:
    """Refuse what is not a stream."""
    if not isinstance(stream, Stream):
        raise DeclarationError(
            f"{operation} needs a stream",
            path=operation,
            expected="a Stream",
            got=repr(stream),
            fix="a held value is always there and has no times: sample it with .at(clock)",
        )


def need_streams(join: str, **given: Any) -> None:
    """Refuse what is not a stream, by the name of its port."""
    for port, value in given.items():
        if not isinstance(value, Stream):
            raise DeclarationError(
                f"{join} needs a stream as {port!r}",
                path=join,
                expected="a Stream",
                got=repr(value),
                fix="a held value has no times: read it with map or apply, or sample it with .at(clock)",
            )


def need_count(operation: str, name: str, n: object, *, least: int, most: int = 2**31 - 1) -> int:
    """`n` as a whole number from `least` to `most`."""
    if not isinstance(n, int) or isinstance(n, bool) or not least <= n <= most:
        raise DeclarationError(
            f"{operation} needs a whole number as {name!r}",
            path=operation,
            expected=f"{name} from {least} to {most}",
            got=f"{name}={n!r}",
            fix=f"write {name}={max(least, 5)}",
        )
    return n


def need_callable(where: str, **given: object) -> None:
    """Refuse what is to be called, by its name, and cannot be; None, which is left out, passes."""
    for name, function in given.items():
        if function is not None and not callable(function):
            raise DeclarationError(
                f"{name!r} is no function",
                path=f"{where}.{name}",
                expected="a function",
                got=repr(function)[:80],
                fix=f"write {name}=function, without calling it",
            )


MOST = 1e9
"""No setting of a filter is as large, in SI units; its square is still a number."""


def need_numbers(
    where: str,
    *,
    positive: Mapping[str, object] | None = None,
    not_negative: Mapping[str, object] | None = None,
) -> None:
    """Refuse settings, by name, that are no numbers below `MOST`; None, which is left out, passes."""
    for least, given in ((math.ulp(0.0), positive or {}), (0.0, not_negative or {})):
        for name, value in given.items():
            number = isinstance(value, int | float) and not isinstance(value, bool)
            if value is not None and not (number and least <= typing.cast(float, value) < MOST):
                raise DeclarationError(
                    f"setting {name!r} is out of range",
                    path=f"{where}.{name}",
                    expected=f"a {'positive ' if least else ''}number"
                    + ("" if least else " that is not negative")
                    + f", below {MOST:g}",
                    got=repr(value),
                    fix=f"leave {name} out, or write {name}=1.0",
                )


def need_reals(operation: str, stream: Stream[Any]) -> None:
    """Refuse a stream with leaves that are no real numbers."""
    for leaf, type_ in leaves_of(stream.type):
        if type_.dtype != "real":
            raise TypeMismatchError(
                f"{operation} needs real numbers",
                path=f"{stream.label}.{leaf}" if isinstance(stream.type, StructType) else stream.label,
                expected="real",
                got=str(type_),
                fix="take the real fields out, or convert, with .map(...)",
            )


def need_init(operation: str, init: object) -> None:
    """Refuse a fold without an initial value."""
    if init is REQUIRED:
        raise DeclarationError(
            f"{operation} needs an initial value",
            path=operation,
            expected="init=, of the type that the function returns",
            got="none",
            fix=f"write {operation}(stream, function, init=0.0)",
        )


def with_xp(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function as one that also takes the array namespace, as `xp=`, whether it asks for it or not."""
    plain = function.step if isinstance(function, Block) else function
    try:
        if "xp" in inspect.signature(plain).parameters:
            return plain
    except (TypeError, ValueError):  # a builtin
        pass

    @functools.wraps(plain, updated=())
    def called(*args: Any, xp: Any) -> Any:
        return plain(*args)

    return called


def result_type(function: Callable[..., Any], types: Sequence[Type], where: str) -> Type | None:
    """The type of `function(values of types...)`; None where it cannot be traced, and so not be lowered."""
    plain = function.step if isinstance(function, Block) else function
    try:
        return record(Block(plain), list(types), {}, None, where).outputs[0].type
    except LoweringError:
        return None


def same_type(_: list[Type], settings: dict[str, Any]) -> Type:
    """Output rule: the type in the setting `kind`."""
    return typing.cast(Type, settings["kind"])


def folded(operation: str, function: Callable[..., Any], init: Any, element: Type) -> tuple[Type, Any]:
    """The type of a fold, and its initial value as one of that type."""
    start = type_of(init)
    kind = result_type(function, [start, element], operation) or start
    return kind, as_value(init, kind, path=f"{operation}.init")
