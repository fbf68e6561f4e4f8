"""Array instructions taken apart: one rule for each instruction of a pipeline.

Elementwise chains become operations on elements; selections, transpositions and joins of arrays only rename
elements where they can, and move the view where they cannot. What needs loops of its own becomes a macro.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.c.nodes import Node, Tape, View
from flowgraph.c.values import Value, Values, lanes, row_major, space_of, unrolled
from flowgraph.errors import LoweringError
from flowgraph.ops import OPS, Spec, broadcast
from flowgraph.symbolic import Instruction

MOST_PRODUCTS = 600
"""A product of matrices with more scalar products than this is a loop."""

_ELEMENTWISE = [
    "add",
    "subtract",
    "multiply",
    "divide",
    "maximum",
    "minimum",
    "abs",
    "remainder",
    "floor_divide",
    "pow",
    "negative",
    "sign",
    "positive",
    "atan2",
    "hypot",
    "copysign",
    "sqrt",
    "exp",
    "expm1",
    "log",
    "log1p",
    "log2",
    "sin",
    "cos",
    "tan",
    "asin",
    "acos",
    "atan",
    "sinh",
    "cosh",
    "tanh",
    "floor",
    "ceil",
    "round",
    "trunc",
    "equal",
    "not_equal",
    "less",
    "less_equal",
    "greater",
    "greater_equal",
    "logical_and",
    "logical_or",
    "logical_xor",
    "logical_not",
    "isfinite",
    "isnan",
    "bitwise_and",
    "bitwise_or",
    "bitwise_xor",
    "bitwise_invert",
    "bitwise_left_shift",
    "bitwise_right_shift",
    "where",
    "float32_bits",
    "astype",
    "square",
]


class Expander:
    """Takes instructions apart onto a tape.

    Args:
        tape: where the operations go.
        values: the arrays known so far, by value number; grows.
    """

    def __init__(self, tape: Tape, values: dict[int, Value]) -> None:
        self.tape, self.known, self.form = tape, values, Values(tape)

    def play(self, i: Instruction) -> None:
        """Take one instruction apart.

        Raises:
            LoweringError: where C has no rule for it.
        """
        self.tape.origin = i.line
        args = [self.known[a] for a in i.args]
        if i.op in _ELEMENTWISE:
            self.known[i.out] = self.elementwise(i.op, i.spec, args)
            return
        rule = _RULES.get(i.op)
        if rule is None:
            raise LoweringError(
                f"the C backend has no operation {i.op}",
                path=i.line,
                expected="one of " + ", ".join(sorted([*_ELEMENTWISE, *_RULES])),
                got=i.op,
                fix='write the step with these, or use engine="xla"',
            )
        self.known[i.out] = rule(self, i.spec, *args, **i.attrs)

    # -- element by element --------------------------------------------------------------------------

    def elementwise(self, op: str, spec: Spec, args: list[Value]) -> Value:
        parts = [self.form.aligned(a, spec.shape) for a in args]
        if op == "square":
            op, parts = "multiply", [parts[0], parts[0]]
        return Value(spec, self.combine(op, spec, *parts))

    def combine(self, op: str, spec: Spec, *parts: Any) -> Any:
        """An operation on element arrays that broadcast to the elements of a shape."""
        made = np.empty(unrolled(spec.shape), object)
        wide: list[Any] = [np.broadcast_to(p, made.shape) for p in parts]
        for index in np.ndindex(made.shape):
            made[index] = self.tape.op(op, spec.dtype, *(p[index] for p in wide))
        return made

    def like(self, op: str, *args: Value, **attrs: Any) -> Value:
        """An operation of the pipeline's own list, with the shape that its rule gives."""
        spec = OPS[op].rule(*(a.spec for a in args), **attrs)
        if op in _ELEMENTWISE:
            return self.elementwise(op, spec, list(args))
        return _RULES[op](self, spec, *args, **attrs)

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
        return self.elementwise("where", spec, [mask, x, self.constant(np.zeros((), _host(spec.dtype)))])

    def constant(self, array: Any) -> Value:
        """An array known now."""
        from flowgraph.pipeline import kind_of

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
        op = _JOINS[kind]
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

    # -- products ------------------------------------------------------------------------------------

    def matmul(self, spec: Spec, a: Value, b: Value) -> Value:
        left = a.shape if len(a.shape) > 1 else (1, *a.shape)
        right = b.shape if len(b.shape) > 1 else (*b.shape, 1)
        shape = (*broadcast(left[:-2], right[:-2]), left[-2], right[-1])
        a = self.reshape(Spec(left, a.spec.dtype), a)
        b = self.reshape(Spec(right, b.spec.dtype), b)
        full = Spec(shape, spec.dtype)
        made = self.product(full, a, b)
        return self.reshape(spec, made)

    def product(self, spec: Spec, a: Value, b: Value) -> Value:
        """A product of matrices with two axes or more."""
        inner = a.shape[-1]
        fa, fb, fo = lanes(a.shape), lanes(b.shape), lanes(spec.shape)
        if not inner:
            zeros = np.zeros(spec.shape, _host(spec.dtype))
            return self.constant(zeros)
        work = math.prod(unrolled(spec.shape)) * inner
        if not fa[-1] and not fb[-2] and work <= MOST_PRODUCTS and self._lanes_fit(spec.shape, a, b):
            x, y = self.form.elements(a), self.form.elements(b)
            made = np.empty(unrolled(spec.shape), object)
            rank = len(made.shape)
            for index in np.ndindex(made.shape):
                terms = []
                for k in range(inner):
                    p = x[_within(x, (*index[:-1], k), rank)]
                    q = y[_within(y, (*index[:-2], k, index[-1]), rank)]
                    terms.append(self.tape.op("multiply", spec.dtype, p, q))
                made[index] = self.balanced("add", spec.dtype, _without_zeros(terms))
            return Value(spec, made)
        only_inner = fa[-1] and fb[-2] and not any(fa[:-1]) and not any(fb[:-2]) and not fb[-1]
        if only_inner and not any(fo) and math.prod(spec.shape) <= UNROLLED_SUMS:
            x, y = self.form.elements(a), self.form.elements(b)
            made = np.empty(spec.shape, object)
            rank = len(spec.shape)
            for index in np.ndindex(spec.shape):
                p = x[_within(x, (*index[:-1], 0), rank)]
                q = y[_within(y, (*index[:-2], 0, index[-1]), rank)]
                term = self.tape.op("multiply", spec.dtype, p, q)
                made[index] = self.tape.reduce("sum", term, (inner,))
            return Value(spec, made)
        if len(a.shape) == len(b.shape) == 2:
            sparse = self._sparse(spec, a, b)
            if sparse is not None:
                return sparse
        out = self.fresh(spec)
        self.tape.macro("matmul", [self.form.stored(a), self.form.stored(b)], out)
        return self.from_view(spec, out)

    def _sparse(self, spec: Spec, a: Value, b: Value) -> Value | None:
        """A product with a matrix whose places are known and mostly zero: only the others are multiplied.

        Along the other side's free axis there is one loop, in which all that is left of the product is done.
        """
        known, free, right = self._mostly_zero(a), b, False
        if known is None:
            known, free, right = self._mostly_zero(b), a, True
        if known is None:
            return None
        out, view = self.fresh(spec), self.form.stored(free)
        if right:
            known = known.T
            view = View(view.buffer, view.shape[::-1], view.offset, view.strides[::-1])
        step, along = (out.strides[1], out.strides[0]) if right else out.strides
        space = (view.shape[1],)
        for i, row in enumerate(known):
            terms = [
                self.tape.op(
                    "multiply",
                    spec.dtype,
                    node,
                    self.form.load(view.buffer, view.offset + k * view.strides[0], (view.strides[1],), space),
                )
                for k, node in enumerate(row)
                if not (node.op == "const" and node.extra[0] == 0)
            ]
            total = self.balanced("add", spec.dtype, terms or [self.tape.const(0, spec.dtype)])
            self.tape.store(out.buffer, i * step, (along,), total, space)
        return self.from_view(spec, out)

    def _mostly_zero(self, x: Value) -> Any:
        """The elements of a matrix in memory, if all are known and three in five or more are zero."""
        view = self.form.stored(x)
        places = [
            view.offset + i * view.strides[0] + j * view.strides[1]
            for i in range(x.shape[0])
            for j in range(x.shape[1])
        ]
        if view.buffer.kind == "work":
            if any(p not in view.buffer.known for p in places):
                return None
        elif view.buffer.kind != "const":
            return None
        found = [self.tape.load(view.buffer, p, (), ()) for p in places]
        zeros = sum(n.op == "const" and n.extra[0] == 0 for n in found)
        if 5 * zeros < 3 * len(found):
            return None
        made = np.empty(x.shape, object)
        made.ravel()[:] = found
        return made

    def _lanes_fit(self, shape: tuple[int, ...], a: Value, b: Value) -> bool:
        """Whether the lanes of both sides are those of the product, at the same axes."""
        rank, wanted = len(shape), lanes(shape)
        for x, inner in ((a, rank - 1), (b, rank - 2)):
            short = rank - len(x.shape)
            sizes, flags = (1,) * short + x.shape, (False,) * short + lanes(x.shape)
            for k in range(rank):
                if k != inner and (flags[k] != wanted[k] or sizes[k] != shape[k]) and sizes[k] != 1:
                    return False
            if any(flags) and space_of(x.shape) != space_of(shape):
                return False
        return True

    def vecdot(self, spec: Spec, a: Value, b: Value) -> Value:
        return self.like("sum", self.like("multiply", a, b), axis=-1)

    def outer(self, spec: Spec, a: Value, b: Value) -> Value:
        column = self.reshape(Spec((*a.shape, 1), a.spec.dtype), a)
        row = self.reshape(Spec((1, *b.shape), b.spec.dtype), b)
        return self.elementwise("multiply", spec, [column, row])

    def cross(self, spec: Spec, a: Value, b: Value) -> Value:
        def part(x: Value, k: int) -> Value:
            whole: list[Any] = [[None, None, None]] * (len(x.shape) - 1)
            return self.like("getitem", x, index=[*whole, k])

        parts = []
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            first = self.like("multiply", part(a, j), part(b, k))
            second = self.like("multiply", part(a, k), part(b, j))
            parts.append(self.like("subtract", first, second))
        return self.like("stack", *parts, axis=len(spec.shape) - 1)

    # -- matrices ------------------------------------------------------------------------------------

    def cholesky(self, spec: Spec, x: Value) -> Value:
        out = self.fresh(spec)
        self.tape.macro("cholesky", [self.form.stored(x)], out)
        return self.from_view(spec, out)

    def solve(self, spec: Spec, a: Value, b: Value) -> Value:
        vector = len(b.shape) == 1
        if vector:
            b = self.reshape(Spec((*b.shape, 1), "real"), b)
        shape = (*broadcast(a.shape[:-2], b.shape[:-2]), *b.shape[-2:])
        out = self.fresh(Spec(shape, "real"))
        self.tape.macro("solve", [self.form.stored(a), self.form.stored(b)], out)
        return self.reshape(spec, self.from_view(Spec(shape, "real"), out))

    # -- places --------------------------------------------------------------------------------------

    def take(self, spec: Spec, x: Value, at: Value, *, axis: int) -> Value:
        axis %= len(x.shape)
        view = self.form.stored(x)
        rank = len(at.shape)
        before, after = x.shape[:axis], x.shape[axis + 1 :]
        where = self.reshape(Spec((*at.shape, *(1,) * len(after)), at.spec.dtype), at)
        index: Any = self.form.aligned(where, spec.shape)
        index = index.reshape((1,) * (len(spec.shape) - index.ndim) + index.shape)
        index = np.broadcast_to(index, unrolled(spec.shape))
        flags, space = lanes(spec.shape), space_of(spec.shape)
        strides = (*view.strides[:axis], *(0,) * rank, *view.strides[axis + 1 :])
        along = tuple(s for s, f in zip(strides, flags, strict=True) if f)
        made = np.empty(unrolled(spec.shape), object)
        for place in np.ndindex(made.shape):
            offset = view.offset + sum(i * s for i, s in zip(place, strides, strict=True))
            made[place] = self.tape.gather(view, offset, along, space, axis, index[place])
        assert len(before) + rank + len(after) == len(spec.shape)
        return Value(spec, made)

    def searchsorted(self, spec: Spec, x: Value, v: Value, *, side: str = "left") -> Value:
        view = self.form.packed(x)
        elements = self.form.elements(v)
        made = np.empty(elements.shape, object)
        for index in np.ndindex(elements.shape):
            extra = (view.buffer, view.offset, x.shape[0], side)
            made[index] = self.tape.node("search", (elements[index],), "int64", (), extra)
        return Value(spec, made)


UNROLLED_SUMS = 64
_JOINS = {
    "sum": "add",
    "prod": "multiply",
    "max": "maximum",
    "min": "minimum",
    "any": "logical_or",
    "all": "logical_and",
}


def _host(dtype: str) -> Any:
    return {"real": np.float64, "bool": np.bool_}.get(dtype) or np.dtype(dtype)


def _axes(axis: Any, rank: int) -> list[int]:
    if axis is None:
        return list(range(rank))
    return sorted(a % rank for a in ([axis] if isinstance(axis, int) else axis))


def _within(array: Any, index: tuple[int, ...], rank: int) -> tuple[int, ...]:
    """An index into an array that is broadcast: leading axes dropped, those of size one at zero."""
    short = index[rank - array.ndim :]
    return tuple(0 if n == 1 else i for i, n in zip(short, array.shape, strict=True))


def _without_zeros(terms: list[Node]) -> list[Node]:
    kept = [t for t in terms if not (t.op == "const" and t.extra[0] == 0)]
    return kept or terms[:1]


def _same_lanes(old: tuple[int, ...], new: tuple[int, ...]) -> bool:
    """Whether a reshape keeps every lane whole and in its order."""

    def places(shape: tuple[int, ...]) -> list[tuple[int, int]]:
        return [
            (math.prod(shape[:k]), n) for k, (n, f) in enumerate(zip(shape, lanes(shape), strict=True)) if f
        ]

    return places(old) == places(new)


def _method(name: str) -> Callable[..., Value]:
    return lambda self, spec, *args, **attrs: getattr(self, name)(spec, *args, **attrs)


def _made(maker: str, kind: str) -> Callable[..., Value]:
    return lambda self, spec, *args, **attrs: getattr(self, maker)(kind)(spec, *args, **attrs)


_RULES: dict[str, Callable[..., Value]] = {
    **{k: _made("reduction", k) for k in _JOINS},
    "mean": _method("mean"),
    "argmax": _made("place", "argmax"),
    "argmin": _made("place", "argmin"),
    "sort": lambda self, spec, x, *, axis=-1: self.scan("sort", spec, x, axis),
    "argsort": lambda self, spec, x, *, axis=-1: self.scan("argsort", spec, x, axis),
    "cumulative_sum": lambda self, spec, x, *, axis: self.scan("cumulative_sum", spec, x, axis),
    "flip": _method("flip"),
    "roll": _method("roll"),
    "concat": _method("concat"),
    "stack": _method("stack"),
    "matmul": _method("matmul"),
    "matrix_transpose": _method("transpose"),
    "cholesky": _method("cholesky"),
    "solve": _method("solve"),
    "cross": _method("cross"),
    "vecdot": _method("vecdot"),
    "outer": _method("outer"),
    "searchsorted": _method("searchsorted"),
    "tril": lambda self, spec, x, *, k=0: self.triangle(spec, x, k=k),
    "triu": lambda self, spec, x, *, k=0: self.triangle(spec, x, k=k, lower=False),
    "permute_dims": _method("permute"),
    "reshape": _method("reshape"),
    "broadcast_to": _method("broadcast"),
    "getitem": _method("getitem"),
    "take": _method("take"),
    "materialise": _method("same"),
}
