"""What each instruction is in integers, given the formats of its arguments and of its result.

What `bind` returns takes words and gives the result at the fraction asked for, not yet fitted to a word.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.engines.fixed import integers as z
from flowgraph.engines.fixed.absent import Run, keeping_nan
from flowgraph.engines.fixed.shifts import (
    MOVES,
    Site,
    adding,
    aligned,
    axes_of,
    between,
    bound_fraction,
    common_along,
    shift_of_product,
    shift_of_quotient,
    shifts_of_running_sum,
    shifts_of_search,
    shifts_of_sum,
    slim,
    terms_of_matmul,
    terms_of_sum,
    terms_of_vecdot,
)
from flowgraph.errors import LoweringError
from flowgraph.pipeline.formats import FREE, NOT_A_NUMBER
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, SINC, bound_attrs


def _shifting(by: np.ndarray) -> Run:
    by = slim(np.asarray(by, dtype=np.int64))
    if not by.any():
        return lambda x: x
    return lambda x: z.shift(x, by)


def to(fraction: np.ndarray, target: np.ndarray) -> Run:
    """Words of a fraction brought to another."""
    return _shifting(between(fraction, target))


# -- element by element ------------------------------------------------------------------------------


def _sum_of_two(sign: int) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        left, right, end = map(_shifting, shifts_of_sum(s))
        if sign < 0:
            return lambda a, b: end(left(a) - right(b))
        return lambda a, b: end(left(a) + right(b))

    return bind


def _multiply(s: Site) -> Run:
    by = slim(shift_of_product(s))
    return lambda a, b: z.product(a, b, by)


def _divide(s: Site) -> Run:
    up = slim(shift_of_quotient(s))
    return lambda a, b: z.quotient(a, b, up)


def _of_one(function: Callable[..., Any], **options: Any) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        f, out = slim(bound_fraction(s.real(0))), slim(s.out)
        return lambda x: function(x, f, out, **options)

    return bind


def _of_two(function: Callable[..., Any]) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        f, g = (slim(bound_fraction(x)) for x in (s.real(0), s.real(1)))
        out = slim(s.out)
        return lambda a, b: function(a, b, f, g, out)

    return bind


def _same_sign(run: Callable[[Any], Any]) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        end = to(s.real(0), s.out)
        return lambda x: end(run(x))

    return bind


def _copysign(s: Site) -> Run:
    end = to(s.real(0), s.out)
    return lambda a, b: np.where(b < 0, -end(np.abs(a)), end(np.abs(a)))


def _sign(s: Site) -> Run:
    end = _shifting(-s.out)
    return lambda x: end(np.sign(x))


def _comparing(compare: Callable[[Any, Any], Any]) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        left, right = map(_shifting, aligned(s)[:2])
        return lambda a, b: compare(left(a), right(b))

    return bind


def _choosing(first: Callable[[Any, Any], Any]) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        left, right = map(_shifting, aligned(s)[:2])
        a_out, b_out = to(s.real(0), s.out), to(s.real(1), s.out)
        return lambda a, b: np.where(first(left(a), right(b)), a_out(a), b_out(b))

    return bind


def _where(s: Site) -> Run:
    left, right = keeping_nan(to(s.real(1), s.out)), keeping_nan(to(s.real(2), s.out))
    return lambda c, a, b: np.where(c, left(a), right(b))


def _whole(how: Callable[[Any, Any], Any]) -> Callable[[Site], Run]:
    """Whole numbers from words: `how(x, f)` with f from 0 to 62 gives them as integers."""

    def bind(s: Site) -> Run:
        f = np.where(s.real(0) == FREE, 0, s.real(0))
        up, behind, end = slim(np.clip(-f, 0, 62)), slim(np.clip(f, 0, 62)), _shifting(-s.out)
        return lambda x: end(how(z.shift(x, -up), behind))

    return bind


def _floor(x: Any, f: Any) -> Any:
    return x >> f


def _ceil(x: Any, f: Any) -> Any:
    return -((-x) >> f)


def _trunc(x: Any, f: Any) -> Any:
    return np.where(x < 0, -((-x) >> f), x >> f)


def _round(x: Any, f: Any) -> Any:
    """To the nearest, halves to the even one."""
    low = x >> f
    rest = (x - (low << f)) * 2
    one = np.int64(1) << f
    return low + ((rest > one) | ((rest == one) & (low & 1 == 1)))


def _remainder(s: Site) -> Run:
    *shifts, at = aligned(s)
    left, right = map(_shifting, shifts)
    end = _shifting(at - s.out)

    def run(a: Any, b: Any) -> Any:
        divisor = right(b)
        return end(np.where(divisor == 0, 0, np.remainder(left(a), np.where(divisor == 0, 1, divisor))))

    return run


def _floor_divide(s: Site) -> Run:
    left, right = map(_shifting, aligned(s)[:2])
    end = _shifting(-s.out)

    def run(a: Any, b: Any) -> Any:
        divisor = right(b)
        return end(np.where(divisor == 0, 0, np.floor_divide(left(a), np.where(divisor == 0, 1, divisor))))

    return run


def _astype(s: Site) -> Run:
    kind = s.specs[s.i.args[0]].dtype
    to = s.i.attrs["dtype"]
    if kind == to:
        return lambda x: x
    if to == "real":
        end = _shifting(-s.out)
        return lambda x: end(
            np.clip(np.asarray(x), 0 if kind == "uint64" else -z.LIMIT, z.LIMIT).astype(np.int64)
        )
    f = np.where(s.real(0) == FREE, 0, s.real(0))
    up, behind = slim(np.clip(-f, 0, 62)), slim(np.clip(f, 0, 62))
    cast = OPS["astype"].run
    attrs = bound_attrs("astype", s.i.attrs, np.dtype(np.float64))
    if to == "bool":
        return lambda x: x != 0
    return lambda x: cast(NUMPY, _trunc(z.shift(x, -up), behind), **attrs)


# -- along axes --------------------------------------------------------------------------------------


def _adding(f: np.ndarray, out: np.ndarray, count: int, axes: tuple[int, ...], add: Run) -> Run:
    by, most, last = adding(f, out, count, axes)
    shifted, end = _shifting(by), _shifting(np.squeeze(last, axis=axes) if axes else last)
    return lambda terms: end(add(np.clip(shifted(terms), -most, most)))


def _sum(s: Site) -> Run:
    f, out, count, axes = terms_of_sum(s)
    run = _adding(f, out, count, axes, lambda x: x.sum(axis=axes))
    return (lambda x: np.expand_dims(run(x), axes)) if s.i.attrs.get("keepdims", False) else run


def _matmul(s: Site) -> Run:
    vector_a, vector_b = s.real(0).ndim == 1, s.real(1).ndim == 1
    run = _adding(*terms_of_matmul(s), lambda x: x.sum(axis=-2))

    def product(a: Any, b: Any) -> Any:
        a, b = a[None] if vector_a else a, b[:, None] if vector_b else b
        c = run(a[..., :, :, None] * b[..., None, :, :])
        c = c[..., 0, :] if vector_a else c
        return (c[..., 0] if vector_b else c) if not (vector_a and vector_b) else c[..., 0]

    return product


def _vecdot(s: Site) -> Run:
    run = _adding(*terms_of_vecdot(s), lambda x: x.sum(axis=-1))
    return lambda a, b: run(a * b)


def _cumulative_sum(s: Site) -> Run:
    axis = s.i.attrs["axis"] % s.real(0).ndim
    by, most, last = shifts_of_running_sum(s)
    start, end = _shifting(by), _shifting(last)
    return lambda x: end(np.cumsum(np.clip(start(x), -most, most), axis=axis))


def _along(run: Callable[..., Any], *, real: bool) -> Callable[[Site], Run]:
    """What compares along axes: all brought to one fraction there."""

    def bind(s: Site) -> Run:
        f = s.real(0)
        axes = axes_of(s.i)(f.ndim)
        at = common_along(f, axes)
        start = to(f, np.broadcast_to(at, f.shape))
        if not real:
            return lambda x: run(start(x), **s.i.attrs)
        keep = s.i.op == "sort" or bool(s.i.attrs.get("keepdims", False))
        end = _shifting((at if keep else np.squeeze(at, axis=axes)) - s.out)
        attrs = dict(s.i.attrs)
        if isinstance(attrs.get("axis"), list):
            attrs["axis"] = tuple(attrs["axis"])
        return lambda x: end(run(start(x), **attrs))

    return bind


def _searchsorted(s: Site) -> Run:
    left, right = map(_shifting, shifts_of_search(s))
    side = s.i.attrs.get("side", "left")
    return lambda a, v: np.searchsorted(left(a), right(v), side=side).astype(np.int64)


# -- moves -------------------------------------------------------------------------------------------


def _move(s: Site) -> Run:
    op, attrs = OPS[s.i.op].run, s.i.attrs
    if s.i.op == "take":
        axis = attrs["axis"] % s.real(0).ndim
        first = s.real(0)
        start = to(first, np.broadcast_to(first.min(axis=axis, keepdims=True), first.shape))
        return lambda x, index: op(NUMPY, start(x), index, **attrs)
    return lambda *xs: op(NUMPY, *xs, **attrs)


_REAL: dict[str, Callable[[Site], Run]] = {
    "add": _sum_of_two(1),
    "subtract": _sum_of_two(-1),
    "multiply": _multiply,
    "divide": _divide,
    "sqrt": _of_one(z.square_root),
    "sin": _of_one(z.sine),
    "cos": _of_one(z.sine, ahead=1),
    SINC: _of_one(z.sinc),
    "exp": _of_one(z.exponential),
    "log": _of_one(z.logarithm),
    "atan2": _of_two(z.angle),
    "hypot": _of_two(z.length),
    "copysign": _copysign,
    "sign": _sign,
    "maximum": _choosing(lambda a, b: a >= b),
    "minimum": _choosing(lambda a, b: a <= b),
    "where": _where,
    "floor": _whole(_floor),
    "ceil": _whole(_ceil),
    "trunc": _whole(_trunc),
    "round": _whole(_round),
    "remainder": _remainder,
    "floor_divide": _floor_divide,
    "astype": _astype,
    "sum": _sum,
    "matmul": _matmul,
    "vecdot": _vecdot,
    "cumulative_sum": _cumulative_sum,
    "max": _along(np.max, real=True),
    "min": _along(np.min, real=True),
    "sort": _along(np.sort, real=True),
    "argmax": _along(np.argmax, real=False),
    "argmin": _along(np.argmin, real=False),
    "argsort": _along(lambda x, axis=-1: np.argsort(x, axis=axis, kind="stable"), real=False),
    "searchsorted": _searchsorted,
    "equal": _comparing(np.equal),
    "not_equal": _comparing(np.not_equal),
    "less": _comparing(np.less),
    "less_equal": _comparing(np.less_equal),
    "greater": _comparing(np.greater),
    "greater_equal": _comparing(np.greater_equal),
    "isnan": lambda s: lambda x: x == NOT_A_NUMBER,
    "isfinite": lambda s: lambda x: x != NOT_A_NUMBER,
    **dict.fromkeys(MOVES, _move),
}


def bind(s: Site) -> Run:
    """What computes an instruction in integers.

    Raises:
        LoweringError: for an operation that has no form in fixed point, naming the line.
    """
    i = s.i
    if i.spec.dtype != "real" and all(s.specs[a].dtype != "real" for a in i.args):
        op, attrs = OPS[i.op].run, bound_attrs(i.op, i.attrs, np.dtype(np.float64))
        return lambda *xs: op(NUMPY, *xs, **attrs)
    rule = _REAL.get(i.op)
    if rule is None:
        raise LoweringError(
            f"{i.op} has no form in fixed point",
            path=i.line,
            expected=f"one of {', '.join(sorted(_REAL))}",
            got=i.op,
            fix="write it with these, or lower the graph to floating point",
        )
    return rule(s)
