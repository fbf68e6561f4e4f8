"""Algebra: what arithmetic does not change, and data that is moved to where it was.

x + 0, 1 x and x / 1 are x; 0 x is 0, also where x is NaN or infinite: a structural zero has no opinion
of what it is multiplied with. Of two moves that undo each other nothing is left, and a piece of
something that was put together is the piece.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.pipeline.optimise.draft import LARGEST_CONSTANT, Draft
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction


def simplify(program: Program) -> Program:
    """Leave out operations that have no effect, and replace some by cheaper ones."""
    draft = Draft(program)
    for i in program.instructions:
        args = draft.args(i)
        rule = _RULES.get(i.op)
        new = None if rule is None else rule(draft, i, args)
        if new is None:
            draft.keep(i)
        else:
            draft.replace(i.out, new)
    return draft.done()


def _value(draft: Draft, number: int) -> float | None:
    """The number that all elements of a constant are, or None."""
    array = draft.constants.get(number)
    if array is None or not array.size:
        return None
    first = array.flat[0]
    return float(first) if array.size == 1 or bool((array == first).all()) else None


def _zeros(draft: Draft, spec: Spec) -> int | None:
    if math.prod(spec.shape) > LARGEST_CONSTANT:
        return None
    return draft.constant(np.zeros(spec.shape), spec.dtype)


def _fits(draft: Draft, number: int, i: Instruction) -> int | None:
    """A value in the place of an instruction's result, where shape and kind are the same."""
    return number if draft.specs[number] == i.spec else None


def _multiply(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    for one, other in (args, args[::-1]):
        factor = _value(draft, one)
        if factor == 1.0:
            found = _fits(draft, other, i)
            if found is not None:
                return found
        elif factor == 0.0:
            return _zeros(draft, i.spec)
        elif factor == -1.0 and draft.specs[other] == i.spec and i.spec.dtype == "real":
            return draft.emit("negative", other, by=i)
    return None


def _add(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    for one, other in (args, args[::-1]):
        if _value(draft, one) == 0.0:
            found = _fits(draft, other, i)
            if found is not None:
                return found
    return None


def _subtract(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    if _value(draft, args[1]) == 0.0:
        return _fits(draft, args[0], i)
    if _value(draft, args[0]) == 0.0 and draft.specs[args[1]] == i.spec:
        return draft.emit("negative", args[1], by=i)
    return None


def _divide(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    if _value(draft, args[1]) == 1.0:
        return _fits(draft, args[0], i)
    return None


def _power(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    exponent = _value(draft, args[1])
    if exponent == 1.0:
        return _fits(draft, args[0], i)
    if exponent not in (2.0, 3.0, 4.0) or draft.specs[args[0]] != i.spec:
        return None
    square = draft.emit("multiply", args[0], args[0], by=i)
    if exponent == 2.0:
        return square
    return draft.emit("multiply", square, square if exponent == 4.0 else args[0], by=i)


def _square(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    return draft.emit("multiply", args[0], args[0], by=i)


def _negative(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    before = draft.made.get(args[0])
    return before.args[0] if before is not None and before.op == "negative" else None


def _where(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    condition = _value(draft, args[0])
    if args[1] == args[2]:
        return _fits(draft, args[1], i)
    return None if condition is None else _fits(draft, args[1 if condition else 2], i)


def _logical(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    ends = i.op == "logical_or"
    for one, other in (args, args[::-1]):
        known = _value(draft, one)
        if known is not None:
            if bool(known) == ends:
                return draft.constant(np.full(i.spec.shape, ends), "bool") if i.spec.shape == () else None
            return _fits(draft, other, i)
    return None


def _same(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    """An operation that gives its argument where shape and kind stay."""
    return _fits(draft, args[0], i)


def _reshape(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    found = _fits(draft, args[0], i)
    before = draft.made.get(args[0])
    if found is None and before is not None and before.op == "reshape":
        inner = _fits(draft, before.args[0], i)
        return inner if inner is not None else draft.emit("reshape", before.args[0], by=i, **i.attrs)
    return found


def _transpose(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    before = draft.made.get(args[0])
    if before is not None and before.op == "matrix_transpose":
        return before.args[0]
    if i.spec.shape[-2:] == (1, 1):
        return args[0]
    if 1 in i.spec.shape[-2:]:  # a row as a column
        return draft.emit("reshape", args[0], by=i, shape=list(i.spec.shape))
    return None


def _getitem(draft: Draft, i: Instruction, args: tuple[int, ...]) -> int | None:
    index = i.attrs["index"]
    shape = draft.specs[args[0]].shape
    spans = [None if isinstance(e, int) else range(n)[slice(*e)] for e, n in zip(index, shape, strict=True)]
    if all(s is not None and s == range(n) for s, n in zip(spans, shape, strict=True)):
        return args[0]
    before = draft.made.get(args[0])
    if before is None:
        return None
    if before.op == "stack" and before.attrs["axis"] == 0 and isinstance(index[0], int):
        part = before.args[index[0]]
        return draft.emit("getitem", part, by=i, index=index[1:]) if len(index) > 1 else part
    if before.op == "concat":
        return _of_concat(draft, i, before, index)
    return None


def _of_concat(draft: Draft, i: Instruction, before: Instruction, index: list[Any]) -> int | None:
    """An index into something put together, where it falls into one part."""
    axis = before.attrs["axis"] % len(before.spec.shape)
    entry = index[axis]
    size = before.spec.shape[axis]
    if isinstance(entry, int):
        low, high = entry % size, entry % size + 1
    else:
        span = range(size)[slice(*entry)]
        if span.step != 1 or not len(span):
            return None
        low, high = span.start, span.stop
    start = 0
    for part in before.args:
        width = draft.specs[part].shape[axis]
        if start <= low and high <= start + width:
            moved = low - start if isinstance(entry, int) else [low - start, high - start, None]
            new = [moved if k == axis else e for k, e in enumerate(index)]
            if draft.specs[part] == i.spec and all(not isinstance(e, int) for e in new):
                return part
            return draft.emit("getitem", part, by=i, index=new)
        start += width
    return None


_RULES: dict[str, Callable[[Draft, Instruction, tuple[int, ...]], int | None]] = {
    "multiply": _multiply,
    "add": _add,
    "subtract": _subtract,
    "divide": _divide,
    "pow": _power,
    "square": _square,
    "negative": _negative,
    "positive": _same,
    "where": _where,
    "logical_and": _logical,
    "logical_or": _logical,
    "astype": _same,
    "broadcast_to": _same,
    "reshape": _reshape,
    "matrix_transpose": _transpose,
    "getitem": _getitem,
}
