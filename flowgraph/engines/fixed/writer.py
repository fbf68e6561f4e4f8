"""A tick as C99: each instruction a nest of loops over words, with its shifts as numbers or small tables."""

from __future__ import annotations

import math

import numpy as np

from flowgraph.engines.fixed import absent, shifts
from flowgraph.engines.fixed.elements import Elements
from flowgraph.engines.fixed.engine import site_of
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.fixed.text import flat, narrow, plus, unless_none, wide
from flowgraph.errors import LoweringError
from flowgraph.recorder.trace import Instruction

_TOGETHER = 24
"""Instructions in one function: a compiler's time grows faster than the length of one."""

_LOSE = {"multiply": "{0} != 0 && {1} != 0", "divide": "{0} != 0 && {1} != 0", "sqrt": "{0} > 0", "exp": "1"}
_PASS = frozenset(["where", "isnan", "isfinite", "negative", "abs", "positive", "materialise"])


class Writer(Elements):
    """C text of the ticks of a pipeline in its formats."""

    def tick(self, key: int) -> tuple[list[str], str]:
        """The bodies of the functions that compute a tick, in order, and of the one that ends it."""
        self.bound = self.player.bind(key)
        self.places.begin(key, self.bound)
        program, width, widths = self.bound.program, self.player.formats.width, self.bound.widths
        doubtful = absent.may_be_nan(program.instructions, self.player.formats.absent)
        bodies = []
        for first in range(0, len(program.instructions), _TOGETHER):
            for i in program.instructions[first : first + _TOGETHER]:
                self.said(i)
                self.most = self.bound.most(i.out) if i.out in widths else None
                site = site_of(i, self.bound.fractions, widths, program.specs, width)
                self.drop = {a: n for a, n in zip(i.args, site.drop, strict=True) if n}
                self.instruction(site, [a for a in i.args if a in doubtful])
                self.drop = {}
            bodies.append(self.taken())
        self.writes()
        return bodies, self.taken()

    def taken(self) -> str:
        """What was written so far, which is then forgotten."""
        text = "\n".join(self.lines)
        self.lines = []
        return text

    def instruction(self, s: Site, lost: list[int]) -> None:
        i = s.i
        if i.op in shifts.MOVES and i.op not in ("negative", "abs", "positive", "materialise"):
            self.move(s)
        elif i.op in ("sum", "matmul", "vecdot") and i.spec.dtype == "real":
            self.refuse_lost(i, lost)
            self.total(s)
        elif i.op in ("any", "all", "sum", "max", "min", "argmax", "argmin"):
            self.refuse_lost(i, lost)
            self.along(s)
        elif i.op == "cumulative_sum":
            self.refuse_lost(i, lost)
            self.running(s)
        elif i.op == "searchsorted":
            self.search(s)
        elif i.op in ("sort", "argsort"):
            self.refuse_lost(i, lost)
            self.order(s)
        else:
            self.each(s, lost)

    def each(self, s: Site, lost: list[int]) -> None:
        """An operation that works element by element."""
        i = s.i
        real = i.spec.dtype == "real"
        with self.loops(i.spec.shape) as index:
            place, args = self.to(i.out, index), [self.word(a, index) for a in i.args]
            text = self.expression(s, args, index)
            if real and i.op in _LOSE:
                text = f"fx_lost({text}, {_LOSE[i.op].format(*args)}, &{self.counter(i.out)})"
            if lost and i.op not in _PASS:
                none = " || ".join(f"{self.word(a, index)} == FX_NAN" for a in lost)
                text = f"{none} ? {'FX_NAN' if real else int(i.op == 'not_equal')} : {text}"
            if real and i.op == "divide":
                self.put(f"if ({args[1]} == 0) {self.by_zero(place)}")
            fits = not real or i.op in shifts.MOVES
            if fits:
                self.put_to(place, text)
            else:
                self.put(self.fitted(place, text))

    def refuse_lost(self, i: Instruction, lost: list[int]) -> None:
        if lost:
            raise LoweringError(
                "this may meet a reading that is not there",
                path=i.line,
                expected="numbers",
                got=f"{i.op} of what may be NaN",
                fix="choose a number in its place first: xp.where(xp.isnan(z), 0.0, z)",
            )

    def total(self, s: Site) -> None:
        i = s.i
        terms = {
            "sum": shifts.terms_of_sum,
            "matmul": shifts.terms_of_matmul,
            "vecdot": shifts.terms_of_vecdot,
        }[i.op]
        fractions, out, count, axes = terms(s)
        by, most, last = shifts.adding(fractions, out, count, axes)
        outer = [1 if n in axes else size for n, size in enumerate(fractions.shape)]
        inner = [size if n in axes else 1 for n, size in enumerate(fractions.shape)]
        with self.loops(outer) as index:
            self.put("{ int64_t sum = 0;")
            self.indent += 1
            with self.loops(inner) as along:
                term = [a if n in axes else b for n, (a, b) in enumerate(zip(along, index, strict=True))]
                self.put(
                    f"sum += fx_cut(fx_shift({self.term(s, term)}, {self.shift(by, term)}), INT64_C({most}));"
                )
            place = self.result(s, index, axes)
            self.put(f"{self.fitted(place, f'fx_shift(sum, {self.shift(last, index)})')} }}")
            self.indent -= 1

    def term(self, s: Site, index: list[str]) -> str:
        i = s.i
        if i.op == "sum":
            return self.word(i.args[0], index)
        if i.op == "vecdot":
            return self.product(self.word(i.args[0], index), self.word(i.args[1], index))
        *batch, row, k, column = index
        a, b = (self.shape(n) for n in i.args)
        left = [k] if len(a) == 1 else [*batch, row, k]
        right = [k] if len(b) == 1 else [*batch, k, column]
        return self.product(self.word(i.args[0], left), self.word(i.args[1], right))

    def result(self, s: Site, index: list[str], axes: tuple[int, ...]) -> str:
        i = s.i
        if i.op == "matmul":
            *batch, row, _, column = index
            a, b = (self.shape(n) for n in i.args)
            return self.to(i.out, [*batch, *([row] if len(a) > 1 else []), *([column] if len(b) > 1 else [])])
        if i.attrs.get("keepdims", False):
            return self.to(i.out, index)
        return self.to(i.out, [x for n, x in enumerate(index) if n not in axes])

    def along(self, s: Site) -> None:
        """Reductions that keep or compare: any, all, whole sums, extremes and where they are."""
        i = s.i
        shape = self.shape(i.args[0])
        axes = shifts.axes_of(i)(len(shape))
        real = s.specs[i.args[0]].dtype == "real"
        at = shifts.common_along(s.real(0), axes) if real else np.zeros((1,) * len(shape), np.int64)
        by = shifts.between(s.real(0), np.broadcast_to(at, shape)) if real else np.zeros((), np.int64)
        outer = [1 if n in axes else size for n, size in enumerate(shape)]
        inner = [size if n in axes else 1 for n, size in enumerate(shape)]
        with self.loops(outer) as index:
            self.put(f"{{ int64_t best = {int(i.op == 'all')}, place = 0, k = 0;")
            self.indent += 1
            with self.loops(inner) as inside:
                here = [a if n in axes else b for n, (a, b) in enumerate(zip(inside, index, strict=True))]
                x = f"fx_shift({self.word(i.args[0], here)}, {self.shift(by, here)})"
                if i.op in ("any", "all"):
                    self.put(f"best = best {'||' if i.op == 'any' else '&&'} {x};")
                elif i.op == "sum":
                    self.put(f"best = (int64_t)((uint64_t)best + (uint64_t){x});")
                else:
                    order = ">" if i.op in ("max", "argmax") else "<"
                    first = f"k == 0 || x {order} best"
                    self.put(f"{{ int64_t x = {x}; if ({first}) {{ best = x; place = k; }} ++k; }}")
            keep = bool(i.attrs.get("keepdims", False))
            out = [x for n, x in enumerate(index) if keep or n not in axes]
            value = "place" if i.op.startswith("arg") else "best"
            if real and i.op in ("max", "min"):
                end = self.shift(
                    at - (s.out if keep else np.expand_dims(np.broadcast_to(s.out, i.spec.shape), axes)),
                    index,
                )
                statement = self.fitted(self.to(i.out, out), f"fx_shift(best, {end})")
            else:
                to = self.to(i.out, out)
                statement = f"{to} = {narrow(to, value)};"
            self.put(f"(void)place; (void)k; {statement} }}")
            self.indent -= 1

    def running(self, s: Site) -> None:
        i = s.i
        shape = i.spec.shape
        axis = i.attrs["axis"] % len(shape)
        real = i.spec.dtype == "real"
        by, most, last = (
            shifts.shifts_of_running_sum(s) if real else (np.zeros((), np.int64), 0, np.zeros((), np.int64))
        )
        with self.loops([1 if n == axis else size for n, size in enumerate(shape)]) as index:
            self.put("{ int64_t sum = 0;")
            self.indent += 1
            with self.loops([size if n == axis else 1 for n, size in enumerate(shape)]) as inside:
                here = [a if n == axis else b for n, (a, b) in enumerate(zip(inside, index, strict=True))]
                x = self.word(i.args[0], here)
                if real:
                    self.put(f"sum += fx_cut(fx_shift({x}, {self.shift(by, here)}), INT64_C({most}));")
                    text = f"fx_shift(sum, {self.shift(last, here)})"
                    self.put(self.fitted(self.to(i.out, here), text))
                else:
                    self.put(f"sum = {self.wrapped(f'(uint64_t)sum + (uint64_t){x}', i.spec)};")
                    self.put_to(self.to(i.out, here), "sum")
            self.indent -= 1
            self.put("}")

    def search(self, s: Site) -> None:
        i = s.i
        n = self.shape(i.args[0])[0]
        p = q = "0"
        if s.specs[i.args[0]].dtype == "real":
            left, right = shifts.shifts_of_search(s)
            with self.loops(i.spec.shape) as index:
                q = self.shift(right, index)
            p = self.row(np.broadcast_to(left, (n,)), "middle")
        order = "<=" if i.attrs.get("side", "left") == "right" else "<"
        middle = wide(self.element(i.args[0], (n,), "middle"))
        with self.loops(i.spec.shape) as index:
            self.put(f"{{ int64_t low = 0, high = {n}, x = fx_shift({self.word(i.args[1], index)}, {q});")
            self.put("  while (low < high) { int64_t middle = (low + high) / 2;")
            before = f"fx_shift({middle}, {p}) {order} x"
            self.put(f"    if ({before}) low = middle + 1; else high = middle; }}")
            self.put_to(self.to(i.out, index), "low")
            self.put("}")

    def order(self, s: Site) -> None:
        """Sorting by insertion, which keeps the order of what is equal."""
        i = s.i
        shape = self.shape(i.args[0])
        (axis,) = shifts.axes_of(i)(len(shape))
        by = at = np.zeros((), np.int64)
        if s.specs[i.args[0]].dtype == "real":
            at = shifts.common_along(s.real(0), (axis,))
            by = shifts.between(s.real(0), np.broadcast_to(at, shape))
        with self.loops([1 if n == axis else size for n, size in enumerate(shape)]) as index:

            def along(name: str) -> list[str]:
                return [name if n == axis else x for n, x in enumerate(index)]

            def key(name: str) -> str:
                return f"fx_shift({self.word(i.args[0], along(name))}, {self.shift(by, along(name))})"

            k, m, n = (self.to(i.out, along(name)) for name in "kmn")
            self.put(f"for (int n = 0; n < {shape[axis]}; ++n) {{ int64_t x = {key('n')}; int k = n;")
            held = "m" if i.op == "sort" else f"(int){m}"
            self.put(f"  for (; k > 0; --k) {{ int m = k - 1; {k} = {m}; m = {held};")
            self.put(f"    if ({wide(m) if i.op == 'sort' else key('m')} <= x) break; }}")
            self.put(f"  {k} = {narrow(k, 'x' if i.op == 'sort' else 'n')}; }}")
            if i.op == "sort" and i.spec.dtype == "real":
                end = self.shift(at - np.broadcast_to(s.out, shape), along("n"))
                fitted = self.fitted(n, f"fx_shift({wide(n)}, {end})")
                self.put(f"for (int n = 0; n < {shape[axis]}; ++n) {fitted}")

    def move(self, s: Site) -> None:
        i = s.i
        if i.op == "take":
            self.take(s)
            return
        if i.op in ("tril", "triu"):
            kept = "<=" if i.op == "tril" else ">="
            with self.loops(i.spec.shape) as index:
                inside = f"{index[-1]} - {index[-2]} {kept} {i.attrs.get('k', 0)}"
                self.put_to(self.to(i.out, index), f"{inside} ? {self.word(i.args[0], index)} : 0")
            return
        if i.op in ("concat", "stack"):
            axis = i.attrs["axis"] % len(i.spec.shape)
            start = 0
            for a in i.args:
                shape = self.shape(a)
                block = shape if i.op == "concat" else (*shape[:axis], 1, *shape[axis:])
                begin = start * math.prod(shape[axis:]) if i.op == "stack" and axis == 0 else -1
                if not self.places.lies(a, i.out, begin):
                    with self.loops(block) as index:
                        to = [plus(start, x) if n == axis else x for n, x in enumerate(index)]
                        source = index if i.op == "concat" else [x for n, x in enumerate(index) if n != axis]
                        self.put_to(self.to(i.out, to), self.word(a, source))
                start += block[axis]
            return
        if self.places.lies(i.out, i.args[0]):
            return
        shape = self.shape(i.args[0])
        where = shifts.moved_from(i, shape)
        affine = _affine(where)
        with self.loops(i.spec.shape) as index:
            if affine is None:
                found = f"{self.table(where, 'at', 'int32_t')}[{flat(i.spec.shape, index)}]"
            else:
                base, strides = affine
                parts = [
                    f"{k} * {x}" if k != 1 else x
                    for k, x in zip(strides, index, strict=True)
                    if k and x != "0"
                ]
                found = " + ".join([*([str(base)] if base or not parts else []), *parts])
            self.put_to(self.to(i.out, index), wide(self.element(i.args[0], shape, found)))

    def take(self, s: Site) -> None:
        i = s.i
        shape, indices = self.shape(i.args[0]), self.shape(i.args[1])
        axis = i.attrs["axis"] % len(shape)
        real = i.spec.dtype == "real"
        by = np.zeros((), np.int64)
        if real:
            f = s.real(0)
            by = shifts.between(f, np.broadcast_to(f.min(axis=axis, keepdims=True), f.shape))
        by = np.broadcast_to(by, shape) if real else by
        with self.loops(i.spec.shape) as index:
            chosen = self.word(i.args[1], index[axis : axis + len(indices)])
            at = [*index[:axis], "n", *index[axis + len(indices) :]]
            self.put(
                f"{{ int64_t n = {chosen}; n = n < 0 ? 0 : n > {shape[axis] - 1} ? {shape[axis] - 1} : n;"
            )
            x = self.word(i.args[0], at)
            text = f"fx_shift({x}, {self.shift(by, at)})" if real else x
            self.put_to(self.to(i.out, index), text)
            self.put("}")

    def writes(self) -> None:
        """Registers at the end of a tick; all are read before the first is written."""
        cells = [c for r in self.pipeline.registers for c in r.cells]
        later: list[str] = []
        for c, n in zip(cells, self.bound.program.writes, strict=True):
            if n == c.read:
                continue
            real = c.dtype == "real"
            by = np.zeros((), np.int64)
            if real:
                by = shifts.between(self.bound.fractions[n], self.bound.fractions[c.read])
            with self.loops(c.shape) as index:
                x = self.word(n, index)
                text = unless_none(x, f"fx_shift({x}, {self.shift(by, index)})") if real else x
                to = self.element(-1 - c.read, c.shape, flat(c.shape, index))
                self.most = self.bound.most(c.read) if real else None
                self.put(self.fitted(to, text) if real else f"{to} = {narrow(to, text)};")
            size = max(math.prod(c.shape), 1)
            new, old = (self.element(n, c.shape, "k") for n in (-1 - c.read, c.read))
            later.append(f"for (int k = 0; k < {size}; ++k) {old} = {new};")
        for copy in later:
            self.put(copy)


def _affine(where: np.ndarray) -> tuple[int, list[int]] | None:
    """Base and strides of places that are a sum of multiples of the indices, or None."""
    if where.size == 0:
        return 0, [0] * where.ndim
    base = int(where.ravel()[0])
    strides = [
        int(where.take(1, axis=a).ravel()[0]) - base if n > 1 else 0 for a, n in enumerate(where.shape)
    ]
    made = np.full(where.shape, base)
    for a, (n, k) in enumerate(zip(where.shape, strides, strict=True)):
        made = made + (k * np.arange(n)).reshape([-1 if b == a else 1 for b in range(where.ndim)])
    return (base, strides) if (made == where).all() else None
