"""Elementwise operations, selections, joins and reductions, taken apart.

Chains of elementwise operations become operations on elements; selections, transpositions and joins of
arrays only rename elements where they can, and move the view where they cannot.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.engines.c.nodes import Node, Tape, View, value_of
from flowgraph.engines.c.values import Value, Values, lanes, row_major, space_of, unrolled
from flowgraph.pipeline.pipeline import kind_of
from flowgraph.recorder.namespaces import LEAST_ANGLE
from flowgraph.recorder.ops import SINC, Spec


class Shapes:
    """Rules for what works element by element, and for what selects, moves and joins.

    Args:
        tape: where the operations go.
        values: the arrays known so far, by value number; grows.
    """

    def __init__(self, tape: Tape, values: dict[int, Value]) -> None:
        self.tape, self.known, self.form = tape, values, Values(tape)
        self.halves: dict[Node, tuple[Node, Node]] = {}

    # -- element by element --------------------------------------------------------------------------

    def elementwise(self, op: str, spec: Spec, args: list[Value]) -> Value:
        parts = [self.form.aligned(a, spec.shape) for a in args]
        if op == "square":
            op, parts = "multiply", [parts[0], parts[0]]
        if op == SINC:
            made: Any = np.empty(unrolled(spec.shape), object)
            for index in np.ndindex(made.shape):
                made[index] = self.sinc(parts[0][index])
            return Value(spec, made)
        return Value(spec, self.combine(op, spec, *parts))

    def sinc(self, x: Node) -> Node:
        """sin(x) / x, and 1 at 0; where that of x / 2 is there, its product with cos(x / 2).

        Sine and cosine of one angle share most of their work, and the product saves a division.
        """
        tape, dtype = self.tape, x.dtype
        if x in self.halves:
            size, half = self.halves[x]
            return tape.op("multiply", dtype, half, tape.op("cos", dtype, size))
        size = tape.op("maximum", dtype, tape.op("abs", dtype, x), tape.const(LEAST_ANGLE, dtype))
        made = tape.op("divide", dtype, tape.op("sin", dtype, size), size)
        if x.op == "multiply":
            for k in (0, 1):
                if value_of(x.args[k]) == 0.5:
                    self.halves[x.args[1 - k]] = size, made
        return made

    def combine(self, op: str, spec: Spec, *parts: Any) -> Any:
        """An operation on element arrays that broadcast to the elements of a shape."""
        made = np.empty(unrolled(spec.shape), object)
        wide: list[Any] = [np.broadcast_to(p, made.shape) for p in parts]
        for index in np.ndindex(made.shape):
            made[index] = self.tape.op(op, spec.dtype, *(p[index] for p in wide))
        return made

    def from_view(self, spec: Spec, view: View) -> Value:
        return Value(spec, view=View(view.buffer, spec.shape, view.offset, view.strides))

    def fresh(self, spec: Spec) -> View:
        """Fresh memory in C's order."""
        return View(self.tape.work(spec.dtype, math.prod(spec.shape)), spec.shape, 0, row_major(spec.shape))

    # -- views ---------------------------------------------------------------------------------------

    def getitem(self, spec: Spec, x: Value, *, index: list[Any]) -> Value:
        entries = [e if isinstance(e, int) else slice(*e) for e in index]
        flags = lanes(x.shape)
        whole = [
            isinstance(e, slice) and e.indices(n) == (0, n, 1) for e, n in zip(entries, x.shape, strict=True)
        ]
        left = tuple(f for f, e in zip(flags, entries, strict=True) if isinstance(e, slice))
        inside = all(w or not f for w, f in zip(whole, flags, strict=True))
        if inside and left == lanes(spec.shape) and x.elements is not None:
            at = tuple(slice(None) if f else e for e, f in zip(entries, flags, strict=True))
            picked = np.empty(unrolled(spec.shape), object)
            picked[...] = x.elements[at]
            return Value(spec, picked)
        view = self.form.stored(x)
        offset, strides = view.offset, []
        for e, n, s in zip(entries, x.shape, view.strides, strict=True):
            if isinstance(e, int):
                offset += (e % n) * s
            else:
                start, _, step = e.indices(n)
                offset += start * s if n else 0
                strides.append(s * step)
        return Value(spec, view=View(view.buffer, spec.shape, offset, tuple(strides)))

    def permute(self, spec: Spec, x: Value, *, axes: list[int]) -> Value:
        flags = lanes(x.shape)
        moved = [a for a in axes if flags[a]]
        if moved == sorted(moved) and x.elements is not None:
            return Value(spec, x.elements.transpose(axes))
        view = self.form.stored(x)
        return Value(
            spec, view=View(view.buffer, spec.shape, view.offset, tuple(view.strides[a] for a in axes))
        )

    def transpose(self, spec: Spec, x: Value) -> Value:
        n = len(x.shape)
        return self.permute(spec, x, axes=[*range(n - 2), n - 1, n - 2])

    def reshape(self, spec: Spec, x: Value, *, shape: Any = None) -> Value:
        old, new = x.shape, spec.shape
        if old == new:
            return x
        if _same_lanes(old, new):
            return Value(spec, self.form.elements(x).reshape(unrolled(new)))
        return self.from_view(spec, self.form.packed(x)._replace(shape=new, strides=row_major(new)))

    def broadcast(self, spec: Spec, x: Value, *, shape: Any = None) -> Value:
        elements = self.form.aligned(x, spec.shape)
        return Value(spec, np.broadcast_to(elements, unrolled(spec.shape)))

    def concat(self, spec: Spec, *xs: Value, axis: int) -> Value:
        along = axis % len(spec.shape)
        same = all(lanes(x.shape) == lanes(spec.shape) for x in xs)
        if same and not lanes(spec.shape)[along]:
            return Value(spec, np.concatenate([self.form.elements(x) for x in xs], axis=along))
        view = self.fresh(spec)
        start = 0
        for x in xs:
            if x.shape[along]:
                piece = View(view.buffer, x.shape, view.offset + start * view.strides[along], view.strides)
                self.form.write(piece, self.form.elements(x))
            start += x.shape[along]
        return self.from_view(spec, view)

    def stack(self, spec: Spec, *xs: Value, axis: int) -> Value:
        along = axis % len(spec.shape)
        shape = (*xs[0].shape[:along], 1, *xs[0].shape[along:])
        return self.concat(spec, *(self.reshape(Spec(shape, x.spec.dtype), x) for x in xs), axis=along)

    def flip(self, spec: Spec, x: Value, *, axis: Any = None) -> Value:
        axes = _axes(axis, len(x.shape))
        index = [[None, None, -1] if k in axes else [None, None, None] for k in range(len(x.shape))]
        return self.getitem(spec, x, index=index)

    def roll(self, spec: Spec, x: Value, *, shift: Any, axis: Any = None) -> Value:
        if axis is None:
            size = math.prod(x.shape)
            flat = self.reshape(Spec((size,), spec.dtype), x)
            return self.reshape(spec, self.roll(flat.spec, flat, shift=shift, axis=0))
        axes = [axis] if isinstance(axis, int) else list(axis)
        shifts = [shift] * len(axes) if isinstance(shift, int) else list(shift)
        for a, by in zip(axes, shifts, strict=True):
            a %= len(x.shape)
            n = x.shape[a]
            if not n or not by % n:
                continue
            cut = n - by % n
            whole: list[Any] = [[None, None, None]] * len(x.shape)
            tail = self.like("getitem", x, index=[*whole[:a], [cut, None, None], *whole[a + 1 :]])
            head = self.like("getitem", x, index=[*whole[:a], [None, cut, None], *whole[a + 1 :]])
            x = self.like("concat", tail, head, axis=a)
        return x

    def triangle(self, spec: Spec, x: Value, *, k: int = 0, lower: bool = True) -> Value:
        rows, columns = spec.shape[-2:]
        keep = np.tri(rows, columns, k if lower else k - 1, dtype=bool)
        mask = self.constant(keep if lower else ~keep)
        return self.elementwise("where", spec, [mask, x, self.constant(np.zeros((), host_kind(spec.dtype)))])

    def constant(self, array: Any) -> Value:
        """An array known now."""
        found = np.asarray(array)
        view = self.form.constant(found, kind_of(found))
        return Value(Spec(found.shape, kind_of(found)), view=view)

    def same(self, spec: Spec, x: Value) -> Value:
        return x

    # -- reductions ----------------------------------------------------------------------------------

    def reduction(self, kind: str) -> Callable[..., Value]:
        def rule(spec: Spec, x: Value, *, axis: Any = None, keepdims: bool = False) -> Value:
            return self.reduce(kind, spec, x, axis)

        return rule

    def reduce(self, kind: str, spec: Spec, x: Value, axis: Any) -> Value:
        axes = _axes(axis, len(x.shape))
        if x.spec.dtype != spec.dtype:
            x = self.like("astype", x, dtype=spec.dtype)
        flags, space = lanes(x.shape), space_of(x.shape)
        gone = [a for a in axes if flags[a]]
        if gone and len(gone) < len(space):
            view = self.form.stored(x)
            out = self.fresh(Spec(tuple(n for k, n in enumerate(x.shape) if k not in axes), spec.dtype))
            self.tape.macro("reduce", [view], out, joins=kind, axes=tuple(axes))
            return self.reshape(spec, Value(Spec(out.shape, spec.dtype), view=out))
        elements = self.form.elements(x)
        if not all(x.shape[a] for a in axes):
            empty = {"sum": 0, "prod": 1, "any": False, "all": True}[kind]
            made = np.full(unrolled(spec.shape), None, object)
            made[...] = self.tape.const(empty, spec.dtype)
            return Value(spec, made)
        op = JOINS[kind]
        moved = np.moveaxis(elements, axes, range(len(axes)))
        moved = moved.reshape((-1, *moved.shape[len(axes) :]))
        rest = np.empty(moved.shape[1:], object)
        for index in np.ndindex(rest.shape):
            found = self.balanced(op, spec.dtype, list(moved[(slice(None), *index)]))
            rest[index] = self.tape.reduce(kind, found, space) if gone else found
        plain = Spec(tuple(n for k, n in enumerate(x.shape) if k not in axes), spec.dtype)
        left = tuple(f for k, f in enumerate(flags) if k not in axes)
        whole = Value(plain, rest) if left == lanes(plain.shape) else self.relaned(plain, rest, left)
        return self.reshape(spec, whole)

    def relaned(self, spec: Spec, elements: Any, flags: tuple[bool, ...]) -> Value:
        """Elements made in other lanes than their shape asks for, taken through memory."""
        view = self.fresh(spec)
        space = tuple(n for n, f in zip(spec.shape, flags, strict=True) if f)
        along = tuple(s for s, f in zip(view.strides, flags, strict=True) if f)
        for index in np.ndindex(elements.shape):
            offset = sum(i * s for i, s in zip(index, view.strides, strict=True))
            self.tape.store(view.buffer, offset, along, elements[index], space)
        return self.from_view(spec, view)

    def balanced(self, op: str, dtype: str, terms: list[Node]) -> Node:
        """Terms joined in a chain."""
        found = terms[0]
        for term in terms[1:]:
            found = self.tape.op(op, dtype, found, term)
        return found

    def mean(self, spec: Spec, x: Value, *, axis: Any = None, keepdims: bool = False) -> Value:
        count = math.prod(x.shape[a] for a in _axes(axis, len(x.shape)))
        total = self.reduce("sum", spec, x, axis)
        return self.elementwise("divide", spec, [total, self.constant(np.float64(count))])

    def place(self, kind: str) -> Callable[..., Value]:
        def rule(spec: Spec, x: Value, *, axis: int | None = None) -> Value:
            if axis is None:
                flat = Spec((math.prod(x.shape),), x.spec.dtype)
                x, axis = self.reshape(flat, x), 0
            return self.scan(kind, spec, x, axis)

        return rule

    def scan(self, kind: str, spec: Spec, x: Value, axis: int, **extra: Any) -> Value:
        """A macro along one axis, for all others: sort, argsort, cumulative_sum, argmax, argmin."""
        out = self.fresh(spec)
        view = self.form.stored(x)
        self.tape.macro(kind, [view], out, axis=axis % len(x.shape), **extra)
        return self.from_view(spec, out)

    def like(self, op: str, *args: Value, **attrs: Any) -> Value:
        """An operation of the pipeline's own list, with the shape that its rule gives."""
        raise NotImplementedError


JOINS = {
    "sum": "add",
    "prod": "multiply",
    "max": "maximum",
    "min": "minimum",
    "any": "logical_or",
    "all": "logical_and",
}


def host_kind(dtype: str) -> Any:
    return {"real": np.float64, "bool": np.bool_}.get(dtype) or np.dtype(dtype)


def _axes(axis: Any, rank: int) -> list[int]:
    if axis is None:
        return list(range(rank))
    return sorted(a % rank for a in ([axis] if isinstance(axis, int) else axis))


def within(array: Any, index: tuple[int, ...], rank: int) -> tuple[int, ...]:
    """An index into an array that is broadcast: leading axes dropped, those of size one at zero."""
    short = index[rank - array.ndim :]
    return tuple(0 if n == 1 else i for i, n in zip(short, array.shape, strict=True))


def without_zeros(terms: list[Node]) -> list[Node]:
    kept = [t for t in terms if not (t.op == "const" and t.extra[0] == 0)]
    return kept or terms[:1]


def _same_lanes(old: tuple[int, ...], new: tuple[int, ...]) -> bool:
    """Whether a reshape keeps every lane whole and in its order."""

    def places(shape: tuple[int, ...]) -> list[tuple[int, int]]:
        return [
            (math.prod(shape[:k]), n) for k, (n, f) in enumerate(zip(shape, lanes(shape), strict=True)) if f
        ]

    return places(old) == places(new)
