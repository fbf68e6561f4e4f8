"""What each instruction is in integers, given the formats of its arguments and of its result.

`bind` works out all shifts once; what it returns takes words and gives the result at the fraction asked for,
not yet fitted to a word. Arguments of sums and comparisons are brought to one fraction first, and what is
rounded is rounded once, at the end. Sums keep eight bits more than their result until then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.engines.fixed import integers as z
from flowgraph.errors import LoweringError
from flowgraph.pipeline.formats import FREE, NOT_A_NUMBER
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Spec, bound_attrs
from flowgraph.recorder.trace import Instruction

Run = Callable[..., Any]
_GUARD = 8
"""Bits that a sum keeps below those of its result."""


class Site:
    """One instruction with the fractions around it.

    Args:
        i: the instruction.
        fractions: of each argument, an integer array of the argument's shape, or None for one that is not real.
        out: the fraction of the result, of its shape; None where it is not real.
        specs: of all values.
        width: bits of a word.
    """

    def __init__(
        self,
        i: Instruction,
        fractions: Sequence[np.ndarray | None],
        out: np.ndarray | None,
        specs: Mapping[int, Spec],
        width: int,
    ) -> None:
        self.i, self.specs, self.width = i, specs, width
        self.f = [None if f is None else np.asarray(f) for f in fractions]
        self.out = np.zeros((), np.int64) if out is None else np.asarray(out)

    def real(self, k: int) -> np.ndarray:
        found = self.f[k]
        assert found is not None, f"{self.i.op}: argument {k} is not real"
        return found


def slim(f: np.ndarray) -> np.ndarray:
    """The same numbers with every axis along which they are equal shortened to one."""
    for axis in range(f.ndim):
        first = f.take([0], axis=axis) if f.shape[axis] else f
        if f.shape[axis] > 1 and (f == first).all():
            f = first
    return f


def _shifting(by: np.ndarray) -> Run:
    by = slim(np.asarray(by, dtype=np.int64))
    if not by.any():
        return lambda x: x
    return lambda x: z.shift(x, by)


def common(fractions: Sequence[np.ndarray]) -> np.ndarray:
    """The finest of fractions, element by element, zeros aside."""
    bound = [np.where(f == FREE, -FREE, f) for f in fractions]
    most = bound[0]
    for f in bound[1:]:
        most = np.maximum(most, f)
    return np.where(most == -FREE, 0, most)


def between(fraction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The shift that brings words of a fraction to another; zeros that are free stay."""
    return np.where(fraction == FREE, 0, fraction - target)


def to(fraction: np.ndarray, target: np.ndarray) -> Run:
    """Words of a fraction brought to another."""
    return _shifting(between(fraction, target))


def keeping_nan(run: Run) -> Run:
    return lambda x: np.where(x == NOT_A_NUMBER, NOT_A_NUMBER, run(x))


# -- element by element ------------------------------------------------------------------------------


def shifts_of_sum(s: Site) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of both arguments before they are added, and of the sum."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    f, g = np.where(f == FREE, g, f), np.where(g == FREE, f, g)
    at = np.minimum(np.maximum(f, g), np.minimum(f, g) + (62 - s.width))
    at = np.where(at == FREE, s.out, at)
    return between(f, at), between(g, at), at - s.out


def _sum_of_two(sign: int) -> Callable[[Site], Run]:
    def bind(s: Site) -> Run:
        left, right, end = map(_shifting, shifts_of_sum(s))
        if sign < 0:
            return lambda a, b: end(left(a) - right(b))
        return lambda a, b: end(left(a) + right(b))

    return bind


def shift_of_product(s: Site) -> np.ndarray:
    """Of the product of two words."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    return np.where((f == FREE) | (g == FREE), 0, f + g - s.out)


def shift_of_quotient(s: Site) -> np.ndarray:
    """By how much a quotient goes to the left."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    return np.where((f == FREE) | (g == FREE), 0, s.out - f + g)


def _multiply(s: Site) -> Run:
    by = slim(shift_of_product(s))
    return lambda a, b: z.product(a, b, by)


def _divide(s: Site) -> Run:
    up = slim(shift_of_quotient(s))
    return lambda a, b: z.quotient(a, b, up)


def bound_fraction(f: np.ndarray) -> np.ndarray:
    """Fractions as functions take them: a free zero has none."""
    return np.where(f == FREE, 0, f)


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


def aligned(s: Site) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The shifts that bring two arguments to one fraction, and that fraction."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    at = common([f, g])
    return between(f, at), between(g, at), at


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
        return lambda x: end(np.clip(np.asarray(x), 0 if kind == "uint64" else -z.LIMIT, z.LIMIT).astype(np.int64))
    f = np.where(s.real(0) == FREE, 0, s.real(0))
    up, behind = slim(np.clip(-f, 0, 62)), slim(np.clip(f, 0, 62))
    cast = OPS["astype"].run
    attrs = bound_attrs("astype", s.i.attrs, np.dtype(np.float64))
    if to == "bool":
        return lambda x: x != 0
    return lambda x: cast(NUMPY, _trunc(z.shift(x, -up), behind), **attrs)


# -- along axes --------------------------------------------------------------------------------------


def axes_of(i: Instruction) -> Callable[[int], tuple[int, ...]]:
    """The axes that an instruction works along, for an argument of so many."""
    axis = i.attrs.get("axis", -1 if i.op in ("sort", "argsort") else None)

    def found(rank: int) -> tuple[int, ...]:
        axes = range(rank) if axis is None else axis if isinstance(axis, list | tuple) else [axis]
        return tuple(a % rank for a in axes)

    return found


def adding(
    f: np.ndarray, out: np.ndarray, count: int, axes: tuple[int, ...]
) -> tuple[np.ndarray, int, np.ndarray]:
    """How `count` terms of fractions `f` are summed: the shift of each, the size at which it is cut, and the
    shift of the sum; `out` is the result's fraction with those axes of one, as is the last shift."""
    at = np.minimum(common_along(f, axes), out + _GUARD)
    most = z.LIMIT // (1 << math.ceil(math.log2(max(count, 1))))
    return between(f, np.broadcast_to(at, f.shape)), most, at - out


def _adding(f: np.ndarray, out: np.ndarray, count: int, axes: tuple[int, ...], add: Run) -> Run:
    by, most, last = adding(f, out, count, axes)
    shifted, end = _shifting(by), _shifting(np.squeeze(last, axis=axes) if axes else last)
    return lambda terms: end(add(np.clip(shifted(terms), -most, most)))


def common_along(f: np.ndarray, axes: tuple[int, ...]) -> np.ndarray:
    """The finest fraction along axes, which stay with length one."""
    bound = np.where(f == FREE, -FREE, f).max(axis=axes, keepdims=True, initial=-FREE)
    return np.where(bound == -FREE, 0, bound)


def terms_of_sum(s: Site) -> tuple[np.ndarray, np.ndarray, int, tuple[int, ...]]:
    """Fractions of the terms and of the result with its axes, their count, and the axes."""
    f = s.real(0)
    axes = axes_of(s.i)(f.ndim)
    out = np.broadcast_to(s.out, s.i.spec.shape)
    out = out if s.i.attrs.get("keepdims", False) else np.expand_dims(out, axes)
    return f, out, math.prod(f.shape[a] for a in axes), axes


def _sum(s: Site) -> Run:
    f, out, count, axes = terms_of_sum(s)
    run = _adding(f, out, count, axes, lambda x: x.sum(axis=axes))
    return (lambda x: np.expand_dims(run(x), axes)) if s.i.attrs.get("keepdims", False) else run


def terms_of_matmul(s: Site) -> tuple[np.ndarray, np.ndarray, int, tuple[int, ...]]:
    """The same of a matrix product, its terms (..., m, k, n); vectors are taken as matrices."""
    f, g = s.real(0), s.real(1)
    vector_a, vector_b = f.ndim == 1, g.ndim == 1
    f = f[None] if vector_a else f
    g = g[:, None] if vector_b else g
    out = np.broadcast_to(s.out, s.i.spec.shape)
    out = out[..., None] if vector_b else out
    out = out[..., None, :] if vector_a else out
    p, q = f[..., :, :, None], g[..., None, :, :]
    fractions = np.where((p == FREE) | (q == FREE), FREE, p + q)
    return fractions, out[..., :, None, :], f.shape[-1], (fractions.ndim - 2,)


def _matmul(s: Site) -> Run:
    vector_a, vector_b = s.real(0).ndim == 1, s.real(1).ndim == 1
    run = _adding(*terms_of_matmul(s), lambda x: x.sum(axis=-2))

    def product(a: Any, b: Any) -> Any:
        a, b = a[None] if vector_a else a, b[:, None] if vector_b else b
        c = run(a[..., :, :, None] * b[..., None, :, :])
        c = c[..., 0, :] if vector_a else c
        return (c[..., 0] if vector_b else c) if not (vector_a and vector_b) else c[..., 0]

    return product


def terms_of_vecdot(s: Site) -> tuple[np.ndarray, np.ndarray, int, tuple[int, ...]]:
    """The same of a product of vectors."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    fractions = np.where((f == FREE) | (g == FREE), FREE, f + g)
    return fractions, np.broadcast_to(s.out, s.i.spec.shape)[..., None], f.shape[-1], (f.ndim - 1,)


def _vecdot(s: Site) -> Run:
    run = _adding(*terms_of_vecdot(s), lambda x: x.sum(axis=-1))
    return lambda a, b: run(a * b)


def shifts_of_running_sum(s: Site) -> tuple[np.ndarray, int, np.ndarray]:
    """Of each term, the size at which it is cut, and of each sum."""
    f = s.real(0)
    axis = s.i.attrs["axis"] % f.ndim
    out = np.broadcast_to(s.out, f.shape)
    at = np.minimum(common_along(f, (axis,)), out.min(axis=axis, keepdims=True) + _GUARD)
    most = z.LIMIT // (1 << math.ceil(math.log2(max(f.shape[axis], 1))))
    return between(f, np.broadcast_to(at, f.shape)), most, at - out


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


def shifts_of_search(s: Site) -> tuple[np.ndarray, np.ndarray]:
    """Of what is searched in, and of what is searched for: all to one fraction."""
    f, g = s.real(0), s.real(1)
    at = max(int(common_along(x, tuple(range(x.ndim))).max(initial=-FREE)) for x in (f, g))
    return between(f, np.full(f.shape, at)), between(g, np.full(g.shape, at))


def _searchsorted(s: Site) -> Run:
    left, right = map(_shifting, shifts_of_search(s))
    side = s.i.attrs.get("side", "left")
    return lambda a, v: np.searchsorted(left(a), right(v), side=side).astype(np.int64)


# -- moves -------------------------------------------------------------------------------------------

MOVES = frozenset(
    """getitem reshape broadcast_to permute_dims matrix_transpose concat stack flip roll tril triu materialise
    positive negative abs take""".split()
)
"""Operations that keep the formats of what they move."""


def moved(i: Instruction, fractions: Sequence[np.ndarray | None]) -> np.ndarray:
    """The fraction of a result of one of `MOVES`."""
    first = fractions[0]
    assert first is not None
    if i.op in ("positive", "negative", "abs", "materialise"):
        return first
    if i.op == "take":
        axis = i.attrs["axis"] % first.ndim
        least = first.min(axis=axis, keepdims=True)
        index = np.zeros([n for n in i.spec.shape[axis : axis + len(i.spec.shape) - first.ndim + 1]], np.int64)
        return np.take(least, index, axis=axis)
    if i.op in ("tril", "triu"):
        kept = OPS[i.op].run(NUMPY, np.ones(first.shape, bool), **i.attrs)
        return np.where(kept, first, FREE)
    return np.asarray(OPS[i.op].run(NUMPY, *fractions, **i.attrs))


def moved_from(i: Instruction, shape: tuple[int, ...]) -> np.ndarray:
    """For each element of the result of a move of one argument, the place that it comes from, row by row."""
    places = np.arange(math.prod(shape), dtype=np.int64).reshape(shape)
    return np.asarray(OPS[i.op].run(NUMPY, places, **i.attrs)).reshape(i.spec.shape)


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


_COMPARE = frozenset("equal not_equal less less_equal greater greater_equal".split())
_ASK = frozenset(("isnan", "isfinite"))


def may_be_nan(instructions: Sequence[Instruction], given: Collection[int]) -> set[int]:
    """The values that may be no numbers when those in `given` may be.

    `where(isnan(x), c, x)` is a number again, and so is what compares.
    """
    found = set(given)
    asks: dict[int, tuple[int, bool]] = {}  # a truth value -> the value it asks about, and whether true is a number
    for i in instructions:
        if i.op in _ASK:
            asks[i.out] = (i.args[0], i.op == "isfinite")
        elif i.op in ("logical_not", "bitwise_invert") and i.args[0] in asks:
            value, number = asks[i.args[0]]
            asks[i.out] = (value, not number)
        elif i.op == "where":
            value, number = asks.get(i.args[0], (None, True))
            taken, other = (i.args[1], i.args[2]) if number else (i.args[2], i.args[1])
            if other in found or (taken in found and taken != value):
                found.add(i.out)
        elif i.spec.dtype == "real" and any(a in found for a in i.args):
            found.add(i.out)
    return found


def passing_nan(i: Instruction, run: Run) -> Run:
    """The same where arguments may be NaN: what depends on one is none, and compares as none does."""
    if i.op in _ASK or i.op == "where" or i.op in MOVES:
        return run
    op, attrs = OPS[i.op].run, bound_attrs(i.op, i.attrs, np.dtype(np.float64))

    def carried(*xs: Any) -> Any:
        lost = [np.asarray(x) == NOT_A_NUMBER for x in xs]
        if not any(n.any() for n in lost):
            return run(*xs)
        made = run(*[np.where(n, 0, x) for n, x in zip(lost, xs, strict=True)])
        if i.op in _COMPARE:
            return np.where(np.logical_or(*np.broadcast_arrays(*lost)), i.op == "not_equal", made)
        traces = op(NUMPY, *[np.where(n, np.nan, 0.0) for n in lost], **attrs)
        return np.where(np.isnan(traces), NOT_A_NUMBER, made)

    return carried


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
