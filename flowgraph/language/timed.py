"""Operations in which the time between events counts: first-order filters, time differences, integrals.

All of them fire with their stream and are written in the array API on `dt`, the seconds since its last
event, which is 0 at the first. What each does with the first value is said in its docstring.
"""

from __future__ import annotations

import typing
from typing import Annotated, Any, TypeVar

import numpy as np

from flowgraph.errors import DeclarationError, TypeMismatchError
from flowgraph.language.block import Block, block
from flowgraph.language.checks import need_reals, need_stream, same_type
from flowgraph.language.clock import nanoseconds
from flowgraph.language.stream import Stream
from flowgraph.types import ArrayType, StructType, Type, as_value, flatten, map_leaves, unflatten, zeros

T = TypeVar("T")


@block(name="low_pass", output=same_type)
def _low_pass(state, x, *, kind, alpha, tau, dt, xp):  # type: ignore[no-untyped-def]
    """y += share (x - y), share = alpha or 1 - exp(-dt / tau). State: y, and whether there was a value."""
    share = alpha if tau is None else -xp.expm1(-dt / tau)
    new = _smoothed(state, x, share, kind, xp)
    return new, new["level"]


@block(name="high_pass", output=same_type)
def _high_pass(state, x, *, kind, alpha, tau, dt, xp):  # type: ignore[no-untyped-def]
    """x minus its low pass, whose share is 1 - alpha or 1 - exp(-dt / tau). State: that low pass."""
    share = 1.0 - alpha if tau is None else -xp.expm1(-dt / tau)
    new = _smoothed(state, x, share, kind, xp)
    rest = [a - b for a, b in zip(flatten(x, kind), flatten(new["level"], kind), strict=True)]
    return new, unflatten(kind, iter(rest))


def _smoothed(state: dict[str, Any], x: Any, share: Any, kind: Type, xp: Any) -> dict[str, Any]:
    pairs = zip(flatten(x, kind), flatten(state["level"], kind), strict=True)
    moved = [xp.where(state["started"], (1.0 - share) * old + share * new, new) for new, old in pairs]
    return {"level": unflatten(kind, iter(moved)), "started": np.True_}


def _smoothing(wanted: Block[Any], stream: Any, alpha: Any, tau: Any, init: Any, name: str | None) -> Any:
    operation = name or wanted.name
    need_stream(operation, stream)
    if (alpha is None) == (tau is None):
        raise DeclarationError(
            f"{wanted.name} needs either alpha or tau",
            path=operation,
            expected="one of alpha=, tau=",
            got="both" if tau is not None else "neither",
            fix=f'write {wanted.name}(stream, alpha=0.98), or {wanted.name}(stream, tau="0.5s")',
        )
    if alpha is not None and not (isinstance(alpha, int | float) and 0.0 < alpha <= 1.0):
        raise DeclarationError(
            "alpha is outside (0, 1]",
            path=operation,
            expected="0 < alpha <= 1",
            got=f"alpha={alpha!r}",
            fix="write alpha=0.98, or name a time constant with tau=",
        )
    seconds = None if tau is None else nanoseconds(tau, what="tau") * 1e-9
    if seconds is not None and not seconds > 0.0:
        raise DeclarationError(
            "tau must be positive", path=operation, expected="a time above 0", got=tau, fix='write tau="0.5s"'
        )
    need_reals(operation, stream)
    level = zeros(stream.type) if init is None else as_value(init, stream.type, path=f"{operation}.init")
    made: Block[Any] = Block(wanted.step, name=wanted.name, output=same_type)
    made.init(lambda x, **_: {"level": level, "started": np.bool_(init is not None)})
    return made(stream, kind=stream.type, alpha=alpha, tau=seconds, name=name)


def low_pass(
    stream: Stream[T],
    *,
    alpha: float | None = None,
    tau: Any = None,
    init: Any = None,
    name: str | None = None,
) -> Stream[T]:
    """First-order low pass of each component. Present with `stream`, of its type; remembers its last output.

        y_k = y_{k-1} + a (x_k - y_{k-1}),    a = alpha, or a = 1 - exp(-dt / tau)

    The second form is the exact answer of tau y' = x - y to an input that has held its new value since the
    last event, so it does not depend on how events are spaced. `alpha` is the share of the new value, as in
    the complementary filters of Fiszel (2017); 1 passes everything.

    First value: the output is the value itself. With `init`, y_{-1} = init: then alpha moves it at once,
    while tau does not (dt = 0).

    It works component by component: a quaternion comes out without unit length.

    Args:
        stream: a stream of real arrays, or of a signal or tuple of them.
        alpha: in (0, 1], the same at each event whatever their spacing.
        tau: the time constant, such as "0.5s".
        init: the output before the first value.
    """
    return typing.cast("Stream[T]", _smoothing(_low_pass, stream, alpha, tau, init, name))


def high_pass(
    stream: Stream[T],
    *,
    alpha: float | None = None,
    tau: Any = None,
    init: Any = None,
    name: str | None = None,
) -> Stream[T]:
    """First-order high pass of each component. Present with `stream`, of its type; remembers its low pass.

        y_k = a (y_{k-1} + x_k - x_{k-1}),    a = alpha, or a = exp(-dt / tau)

    It is computed as what a low pass leaves: `high_pass(s, alpha=a)` plus `low_pass(s, alpha=1 - a)` is `s`,
    and so it is for one `tau`. `alpha` is the share that is kept; 1 keeps every change for ever.

    First value: 0, as nothing has changed yet. With `init`, the input is taken to have rested there: then
    y_0 = a (x_0 - init), and dt = 0.

    Args:
        stream: a stream of real arrays, or of a signal or tuple of them.
        alpha: in (0, 1], the same at each event whatever their spacing.
        tau: the time constant, such as "0.5s".
        init: where the input rested before the first value.
    """
    return typing.cast("Stream[T]", _smoothing(_high_pass, stream, alpha, tau, init, name))


@block(name="delta_time")
def _delta_time(x, *, dt, xp) -> Annotated[Any, ArrayType((), "real", "s")]:  # type: ignore[no-untyped-def]
    """Seconds since the last event."""
    return xp.asarray(dt)


def delta_time(stream: Stream[Any], *, name: str | None = None) -> Stream[Any]:
    """Seconds since the last event of `stream`, 0 at the first. Present with it; remembers its last time."""
    need_stream(name or "delta_time", stream)
    return typing.cast("Stream[Any]", _delta_time(stream, name=name))


@block(name="integrate", output=lambda _, settings: settings["out"])
def _integrate(state, x, *, kind, out, init, rule, dt):  # type: ignore[no-untyped-def]
    """sum += x dt, or (x + the x before) / 2 dt. State: the sum and the last x."""
    leaves = [flatten(v, kind) for v in (state["sum"], state["last"], x)]
    back = 0.5 if rule == "trapezoid" else 0.0
    total = [s + (back * old + (1.0 - back) * new) * dt for s, old, new in zip(*leaves, strict=True)]
    value = unflatten(kind, iter(total))
    return {"sum": value, "last": x}, value


@_integrate.init
def _(x: Type, *, kind: Type, out: Type, init: Any, rule: str) -> Any:
    return {"sum": init, "last": zeros(kind)}


def integrate(
    stream: Stream[Any], *, rule: str = "rectangle", init: Any = None, name: str | None = None
) -> Stream[Any]:
    """The sum of value times seconds since the last event. Present with `stream`; remembers sum and value.

    "rectangle" takes the new value for the whole interval, "trapezoid" the mean of both its ends. The first
    output is init (0 where left out), as dt is 0 there. The unit is that of the value times s: m/s gives m.

    Refused: a signal, since its integral is another quantity: take a field out, or pack the result, with map.
    """
    operation = name or "integrate"
    need_stream(operation, stream)
    if rule not in ("rectangle", "trapezoid"):
        raise DeclarationError(
            "this integration rule does not exist",
            path=operation,
            expected='"rectangle" or "trapezoid"',
            got=repr(rule),
            fix='write rule="trapezoid"',
        )
    kind = stream.type
    if isinstance(kind, StructType) and kind.cls is not tuple:
        raise TypeMismatchError(
            "the integral of a signal is another quantity",
            path=operation,
            expected="an array or a tuple of arrays",
            got=f"{kind} from {stream.label}",
            fix=f"take a field out: integrate(stream.map(lambda v: v.{kind.fields[0][0]}))",
        )
    need_reals(operation, stream)
    start = zeros(kind) if init is None else as_value(init, kind, path=f"{operation}.init")
    out = map_leaves(
        kind, lambda leaf: ArrayType(leaf.shape, "real", _times_s(leaf.unit), leaf.frame, leaf.axes)
    )
    return typing.cast(
        "Stream[Any]", _integrate(stream, kind=kind, out=out, init=start, rule=rule, name=name)
    )


def _times_s(unit: str | None) -> str | None:
    if unit is None or unit == "1":
        return unit and "s"
    if unit.endswith("/s^2"):
        return unit.removesuffix("^2")
    return unit.removesuffix("/s") if unit.endswith("/s") else f"{unit}*s"
