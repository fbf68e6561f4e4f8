"""The shifts of each instruction, worked out once from the formats around it; the interpreter and C share
them.

Arguments of sums and comparisons are brought to one fraction first, and what is rounded is rounded once, at
the end. Sums keep eight bits more than their result until then.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from flowgraph.engines.fixed import integers as z
from flowgraph.pipeline.formats import FREE
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Spec
from flowgraph.recorder.trace import Instruction

_GUARD = 8
"""Bits that a sum keeps below those of its result."""


class Site:
    """One instruction with the fractions around it.

    Args:
        i: the instruction.
        fractions: of each argument, an integer array of the argument's shape, or None for one that is not
            real.
        out: the fraction of the result, of its shape; None where it is not real.
        specs: of all values.
        width: bits of a word.
        drop: of each argument the low bits that are not read; `fractions` are without them.
    """

    def __init__(
        self,
        i: Instruction,
        fractions: Sequence[np.ndarray | None],
        out: np.ndarray | None,
        specs: Mapping[int, Spec],
        width: int,
        drop: Sequence[int] = (),
    ) -> None:
        self.i, self.specs, self.width = i, specs, width
        self.drop = tuple(drop) or (0,) * len(i.args)
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


def shifts_of_sum(s: Site) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of both arguments before they are added, and of the sum."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    f, g = np.where(f == FREE, g, f), np.where(g == FREE, f, g)
    at = np.minimum(np.maximum(f, g), np.minimum(f, g) + (62 - s.width))
    at = np.where(at == FREE, s.out, at)
    return between(f, at), between(g, at), at - s.out


def shift_of_product(s: Site) -> np.ndarray:
    """Of the product of two words."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    return np.where((f == FREE) | (g == FREE), 0, f + g - s.out)


def shift_of_quotient(s: Site) -> np.ndarray:
    """By how much a quotient goes to the left."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    return np.where((f == FREE) | (g == FREE), 0, s.out - f + g)


def bound_fraction(f: np.ndarray) -> np.ndarray:
    """Fractions as functions take them: a free zero has none."""
    return np.where(f == FREE, 0, f)


def aligned(s: Site) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The shifts that bring two arguments to one fraction, and that fraction."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    at = common([f, g])
    return between(f, at), between(g, at), at


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


def terms_of_vecdot(s: Site) -> tuple[np.ndarray, np.ndarray, int, tuple[int, ...]]:
    """The same of a product of vectors."""
    f, g = np.broadcast_arrays(s.real(0), s.real(1))
    fractions = np.where((f == FREE) | (g == FREE), FREE, f + g)
    return fractions, np.broadcast_to(s.out, s.i.spec.shape)[..., None], f.shape[-1], (f.ndim - 1,)


def shifts_of_running_sum(s: Site) -> tuple[np.ndarray, int, np.ndarray]:
    """Of each term, the size at which it is cut, and of each sum."""
    f = s.real(0)
    axis = s.i.attrs["axis"] % f.ndim
    out = np.broadcast_to(s.out, f.shape)
    at = np.minimum(common_along(f, (axis,)), out.min(axis=axis, keepdims=True) + _GUARD)
    most = z.LIMIT // (1 << math.ceil(math.log2(max(f.shape[axis], 1))))
    return between(f, np.broadcast_to(at, f.shape)), most, at - out


def shifts_of_search(s: Site) -> tuple[np.ndarray, np.ndarray]:
    """Of what is searched in, and of what is searched for: all to one fraction."""
    f, g = s.real(0), s.real(1)
    at = max(int(common_along(x, tuple(range(x.ndim))).max(initial=-FREE)) for x in (f, g))
    return between(f, np.full(f.shape, at)), between(g, np.full(g.shape, at))


MOVES = frozenset(
    [
        "getitem",
        "reshape",
        "broadcast_to",
        "permute_dims",
        "matrix_transpose",
        "concat",
        "stack",
        "flip",
        "roll",
        "tril",
        "triu",
        "materialise",
        "positive",
        "negative",
        "abs",
        "take",
    ]
)
"""Operations that keep the formats of what they move."""

READ_WHOLE = MOVES | {
    "add", "subtract", "sum", "cumulative_sum", "where", "maximum", "minimum", "max", "min", "argmax",
    "argmin", "sort", "argsort", "searchsorted", "copysign", "sign", "equal", "not_equal", "less",
    "less_equal", "greater", "greater_equal", "isnan", "isfinite",
}  # fmt: skip
"""Operations that read all bits of a word; the others multiply, and read its upper 32."""


def moved(i: Instruction, fractions: Sequence[np.ndarray | None]) -> np.ndarray:
    """The fraction of a result of one of `MOVES`."""
    first = fractions[0]
    assert first is not None
    if i.op in ("positive", "negative", "abs", "materialise"):
        return first
    if i.op == "take":
        axis = i.attrs["axis"] % first.ndim
        least = first.min(axis=axis, keepdims=True)
        index = np.zeros(
            [n for n in i.spec.shape[axis : axis + len(i.spec.shape) - first.ndim + 1]], np.int64
        )
        return np.take(least, index, axis=axis)
    if i.op in ("tril", "triu"):
        kept = OPS[i.op].run(NUMPY, np.ones(first.shape, bool), **i.attrs)
        return np.where(kept, first, FREE)
    return np.asarray(OPS[i.op].run(NUMPY, *fractions, **i.attrs))


def moved_from(i: Instruction, shape: tuple[int, ...]) -> np.ndarray:
    """For each element of the result of a move of one argument, the place that it comes from, row by row."""
    places = np.arange(math.prod(shape), dtype=np.int64).reshape(shape)
    return np.asarray(OPS[i.op].run(NUMPY, places, **i.attrs)).reshape(i.spec.shape)
