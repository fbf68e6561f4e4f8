"""Array instructions taken apart: one rule for each instruction of a pipeline.

What works element by element stands in `shapes`; here are products, factorizations and look-ups, and the
table of all rules. What needs loops of its own becomes a macro.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph.engines.c.nodes import Buffer, Node, View
from flowgraph.engines.c.shapes import JOINS, Shapes, host_kind, within, without_zeros
from flowgraph.engines.c.values import Value, lanes, row_major, space_of, unrolled
from flowgraph.errors import LoweringError
from flowgraph.pipeline.optimise.aside import Choice
from flowgraph.recorder.ops import ELEMENTWISE, OPS, Spec, broadcast
from flowgraph.recorder.replay import body_of
from flowgraph.recorder.trace import Instruction

MOST_PRODUCTS = 600
"""A product of matrices with more scalar products than this is a loop."""


class Expander(Shapes):
    """Takes instructions apart onto a tape."""

    def play(self, i: Instruction) -> None:
        """Take one instruction apart.

        Raises:
            LoweringError: where C has no rule for it.
        """
        self.tape.origin = i.line
        args = [self.known[a] for a in i.args]
        if i.op == "replay":
            self.known[i.out] = self.replayed(i)
            return
        rule = _RULES.get(i.op)
        if rule is None and i.op in ELEMENTWISE:
            self.known[i.out] = self.elementwise(i.op, i.spec, args)
            return
        if rule is None:
            raise LoweringError(
                f"the C backend has no operation {i.op}",
                path=i.line,
                expected="one of " + ", ".join(sorted([*ELEMENTWISE, *_RULES])),
                got=i.op,
                fix='write the step with these, or use engine="xla"',
            )
        self.known[i.out] = rule(self, i.spec, *args, **i.attrs)

    def tell(self, elements: Mapping[int, np.ndarray], i: Instruction) -> None:
        """Say of an instruction's arguments what is known of their elements."""
        for a in i.args:
            if a in elements:
                self.known[a].told = elements[a]

    def like(self, op: str, *args: Value, **attrs: Any) -> Value:
        """An operation of the pipeline's own list, with the shape that its rule gives."""
        spec = OPS[op].rule(*(a.spec for a in args), **attrs)
        if op in ELEMENTWISE:
            return self.elementwise(op, spec, list(args))
        return _RULES[op](self, spec, *args, **attrs)

    def replayed(self, i: Instruction, into: Buffer | None = None) -> Value:
        """A replay, into memory of its own, or where its history lies, which nobody else reads."""
        history, rows, first, count = (self.known[a] for a in i.args)
        views = [self.form.packed(rows), self.form.stored(first), self.form.stored(count)]
        if into is None:
            out = self.fresh(i.spec)
            views.append(self.form.packed(history))
        else:
            out = View(into, i.spec.shape, 0, row_major(i.spec.shape))
        self.tape.origin = i.line
        self.tape.macro("replay", views, out, body=body_of(i.attrs["body"]))
        return self.from_view(i.spec, out)

    def chosen(self, i: Instruction, choice: Choice) -> Value:
        """One array, or where a truth says so what a function of others makes."""
        truth, other, *inputs = (self.known[a] for a in i.args)
        self.tape.origin = i.line
        views = [self.form.stored(other), *(self.form.own(x) for x in inputs)]
        out = self.fresh(i.spec)
        when = self.form.elements(truth).item()
        self.tape.macro("choose", views, out, [when], choice=choice, truth=i.attrs["truth"])
        return self.from_view(i.spec, out)

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
            zeros = np.zeros(spec.shape, host_kind(spec.dtype))
            return self.constant(zeros)
        work = math.prod(unrolled(spec.shape)) * inner
        if not fa[-1] and not fb[-2] and work <= MOST_PRODUCTS and self._lanes_fit(spec.shape, a, b):
            x, y = self.form.elements(a), self.form.elements(b)
            made = np.empty(unrolled(spec.shape), object)
            rank = len(made.shape)
            for index in np.ndindex(made.shape):
                terms = []
                for k in range(inner):
                    p = x[within(x, (*index[:-1], k), rank)]
                    q = y[within(y, (*index[:-2], k, index[-1]), rank)]
                    terms.append(self.tape.op("multiply", spec.dtype, p, q))
                made[index] = self.balanced("add", spec.dtype, without_zeros(terms))
            return Value(spec, made)
        only_inner = fa[-1] and fb[-2] and not any(fa[:-1]) and not any(fb[:-2]) and not fb[-1]
        if only_inner and not any(fo) and math.prod(spec.shape) <= UNROLLED_SUMS:
            x, y = self.form.elements(a), self.form.elements(b)
            made = np.empty(spec.shape, object)
            rank, even = len(spec.shape), _weighted(x, y)
            for index in np.ndindex(spec.shape):
                if even and index[0] > index[1]:
                    made[index] = made[index[::-1]]
                    continue
                p = x[within(x, (*index[:-1], 0), rank)]
                q = y[within(y, (*index[:-2], 0, index[-1]), rank)]
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

        A product with few others is unrolled. Else along the other side's free axis there is one loop, in
        which all that is left of the product is done.
        """
        known, free, right = self._mostly_zero(a), b, False
        if known is None:
            known, free, right = self._mostly_zero(b), a, True
        if known is None:
            return None
        if right:
            known = known.T
        terms = [[(k, node) for k, node in enumerate(row) if not _is_zero(node)] for row in known]
        columns = free.shape[0 if right else 1]
        few = sum(len(row) for row in terms) * columns <= MOST_PRODUCTS
        if few and not any(lanes(spec.shape)) and not any(lanes(free.shape)):
            elements = self.form.elements(free)
            made = np.empty(spec.shape, object)
            for i, row in enumerate(terms):
                for j in range(columns):
                    loaded = [(n, elements[(j, k) if right else (k, j)]) for k, n in row]
                    made[(j, i) if right else (i, j)] = self._total(spec.dtype, loaded)
            return Value(spec, made)
        out, view = self.fresh(spec), self.form.stored(free)
        if right:
            view = View(view.buffer, view.shape[::-1], view.offset, view.strides[::-1])
        step, along = (out.strides[1], out.strides[0]) if right else out.strides
        space = (view.shape[1],)
        for i, row in enumerate(terms):
            loaded = [
                (n, self.form.load(view.buffer, view.offset + k * view.strides[0], (view.strides[1],), space))
                for k, n in row
            ]
            self.tape.store(out.buffer, i * step, (along,), self._total(spec.dtype, loaded), space)
        return self.from_view(spec, out)

    def _total(self, dtype: str, pairs: list[tuple[Node, Node]]) -> Node:
        """The sum of products of these pairs."""
        terms = [self.tape.op("multiply", dtype, p, q) for p, q in pairs]
        return self.balanced("add", dtype, terms or [self.tape.const(0, dtype)])

    def _mostly_zero(self, x: Value) -> Any:
        """The elements of a matrix, if all are known and half or more of them are zero."""
        if x.told is not None:
            made = np.empty(x.shape, object)
            for place in np.ndindex(x.shape):
                made[place] = self._told(x, place)
            return made
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
        if 2 * sum(_is_zero(n) for n in found) < len(found):
            return None
        made = np.empty(x.shape, object)
        made.ravel()[:] = found
        return made

    def _told(self, x: Value, place: tuple[int, ...]) -> Node:
        """An element as the optimiser names it: a number, a scalar that is there, or what lies in memory."""
        name = x.told[place]
        if isinstance(name, float):
            return self.tape.const(name, x.spec.dtype)
        if name is not None:
            node: Node = self.form.elements(self.known[name]).item()
            return node
        view = self.form.stored(x)
        offset = view.offset + sum(k * s for k, s in zip(place, view.strides, strict=True))
        return self.tape.load(view.buffer, offset, (), ())

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

    def solve(self, spec: Spec, a: Value, b: Value, *, assume_a: str = "gen") -> Value:
        """Whatever is assumed: C looks whether the matrix is one that needs no exchange of rows."""
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


def _weighted(x: Any, y: Any) -> bool:
    """Whether x (m, 1) holds the elements of y (1, m), each times the same: sums of x y are symmetric."""
    if x.ndim != 2 or y.ndim != 2 or len(x) != y.shape[1]:
        return False
    times: list[Node | None] = []
    for p, q in zip(x[:, 0], y[0], strict=True):
        if p is q:
            times.append(None)
        elif p.op == "multiply" and q in p.args:
            times.append(p.args[1 if p.args[0] is q else 0])
        else:
            return False
    return all(t is times[0] for t in times)


def _is_zero(node: Node) -> bool:
    return node.op == "const" and node.extra[0] == 0


def _method(name: str) -> Callable[..., Value]:
    return lambda self, spec, *args, **attrs: getattr(self, name)(spec, *args, **attrs)


def _made(maker: str, kind: str) -> Callable[..., Value]:
    return lambda self, spec, *args, **attrs: getattr(self, maker)(kind)(spec, *args, **attrs)


_RULES: dict[str, Callable[..., Value]] = {
    **{k: _made("reduction", k) for k in JOINS},
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
