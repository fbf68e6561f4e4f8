"""Fixed point as C99: each instruction a nest of loops over words, with its shifts as numbers or small tables.

All values live in one array of 64-bit integers, `w`. A pattern of present inputs is a function of its own; the
shifts are those of `rules`, so the words are equal to the interpreter's to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from flowgraph.engines.fixed import rules
from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.engines.fixed.kernels import kernels
from flowgraph.engines.fixed.rules import Site, slim
from flowgraph.errors import LoweringError
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction

_WRAP = {"uint32": "(int64_t)(uint32_t)({})", "int32": "(int64_t)(int32_t)({})", "bool": "(({}) != 0)"}
_COMPARE = {"equal": "==", "not_equal": "!=", "less": "<", "less_equal": "<=", "greater": ">", "greater_equal": ">="}
_JOIN = {"logical_and": "&&", "logical_or": "||"}
_BITS = {"bitwise_and": "&", "bitwise_or": "|", "bitwise_xor": "^"}
_WHOLE = {"floor": 0, "ceil": 1, "trunc": 2, "round": 3}
_ONE = {"sqrt": "fx_square_root", "exp": "fx_exponential", "log": "fx_logarithm"}
_TWO = {"atan2": "fx_angle", "hypot": "fx_length"}


class _Writer:
    """C text of the ticks of a pipeline in its formats."""

    def __init__(self, player: Integers) -> None:
        self.player, self.pipeline = player, player.pipeline
        self.place: dict[int, int] = {}
        self.size = 0
        self.tables: dict[bytes, str] = {}
        self.lines: list[str] = []
        self.indent = 1
        self.counter: dict[int, int] = {}
        self.bound: Bound

    # -- text ----------------------------------------------------------------------------------------

    def put(self, line: str) -> None:
        self.lines.append("  " * self.indent + line)

    def at(self, value: int, shape: Sequence[int]) -> int:
        """Where a value lies in `w`."""
        if value not in self.place:
            self.place[value] = self.size
            self.size += max(math.prod(shape), 1)
        return self.place[value]

    def table(self, numbers: np.ndarray, name: str = "s", kind: str = "int16_t") -> str:
        flat = np.ascontiguousarray(numbers, dtype=np.int64).ravel()
        key = kind.encode() + flat.tobytes()
        if key not in self.tables:
            self.tables[key] = f"static const {kind} {name}{len(self.tables)}[] = {{{', '.join(map(str, flat))}}};"
        return self.tables[key].split()[3].split("[")[0]

    def shift(self, by: np.ndarray, index: Sequence[str]) -> str:
        """A shift at an index of the loops around: a number, or an element of a table."""
        by = slim(np.asarray(by))
        if by.size == 1:
            return str(int(by.ravel()[0]))
        return f"{self.table(by)}[{_flat(by.shape, index)}]"

    @contextmanager
    def loops(self, shape: Sequence[int]) -> Iterator[list[str]]:
        """Nested loops over a shape; gives the names of their indices."""
        names = [f"i{self.indent}_{n}" for n in range(len(shape))]
        opened = 0
        for name, size in zip(names, shape, strict=True):
            if size != 1:
                self.put(f"for (int {name} = 0; {name} < {size}; ++{name}) {{")
                self.indent += 1
                opened += 1
        yield [n if size != 1 else "0" for n, size in zip(names, shape, strict=True)]
        for _ in range(opened):
            self.indent -= 1
            self.put("}")

    def word(self, value: int, index: Sequence[str]) -> str:
        """The element of a value at an index of a shape that it broadcasts to."""
        shape = self.shape(value)
        return f"w[{_plus(self.at(value, shape), _flat(shape, index[len(index) - len(shape) :]))}]"

    def shape(self, value: int) -> tuple[int, ...]:
        return self.bound.program.specs[value].shape

    def fitted(self, value: int, text: str) -> str:
        count = self.counter.setdefault(value, len(self.counter))
        return f"fx_fit({text}, MOST, &counts[{count}])"

    # -- a tick --------------------------------------------------------------------------------------

    def tick(self, key: int) -> None:
        self.bound = self.player.bind(key)
        self.put(f"/* present: {', '.join(p.name for k, p in enumerate(self.pipeline.inputs) if key >> k & 1)} */")
        doubtful = rules.may_be_nan(self.bound.program.instructions, self.player.formats.absent)
        for i in self.bound.program.instructions:
            given = [self.bound.fractions.get(a) for a in i.args]
            out = self.bound.fractions.get(i.out) if i.spec.dtype == "real" else None
            site = Site(i, given, out, self.bound.program.specs, self.player.formats.width)
            lost = [a for a in i.args if a in doubtful]
            self.put(f"/* {i.op} {list(i.spec.shape)}  {i.line} */")
            self.instruction(site, lost)
        self.writes()

    def instruction(self, s: Site, lost: list[int]) -> None:
        i = s.i
        if i.op in rules.MOVES and i.op not in ("negative", "abs", "positive", "materialise"):
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
        else:
            with self.loops(i.spec.shape) as index:
                args = [self.word(a, index) for a in i.args]
                text = self.element(s, args, index)
                if lost and i.op not in ("where", "isnan", "isfinite", "negative", "abs", "positive", "materialise"):
                    none = " || ".join(f"{self.word(a, index)} == FX_NAN" for a in lost)
                    other = "FX_NAN" if i.spec.dtype == "real" else str(int(i.op == "not_equal"))
                    text = f"{none} ? {other} : {text}"
                if i.spec.dtype == "real" and i.op not in rules.MOVES:
                    text = self.fitted(i.out, text)
                self.put(f"{self.word(i.out, index)} = {text};")

    def refuse_lost(self, i: Instruction, lost: list[int]) -> None:
        if lost:
            raise LoweringError(
                "this may meet a reading that is not there",
                path=i.line,
                expected="numbers",
                got=f"{i.op} of what may be NaN",
                fix="choose a number in its place first: xp.where(xp.isnan(z), 0.0, z)",
            )

    # -- element by element --------------------------------------------------------------------------

    def element(self, s: Site, x: list[str], index: Sequence[str]) -> str:
        i, op = s.i, s.i.op
        kinds = [s.specs[a].dtype for a in i.args]
        if op in ("isnan", "isfinite"):
            return f"{x[0]} {'==' if op == 'isnan' else '!='} FX_NAN" if kinds[0] == "real" else str(int(op != "isnan"))
        if op == "materialise" or op == "positive":
            return x[0]
        if op == "negative":
            text = f"-{x[0]}" if kinds[0] == "real" else self.wrapped(f"-(uint64_t){x[0]}", i.spec)
            return f"{x[0]} == FX_NAN ? FX_NAN : {text}" if kinds[0] == "real" else text
        if op == "abs":
            return f"{x[0]} == FX_NAN ? FX_NAN : fx_abs({x[0]})" if kinds[0] == "real" else f"fx_abs({x[0]})"
        if op == "astype":
            return self.cast(s, x[0], kinds[0], index)
        if "real" in kinds:
            return self.real(s, x, index)
        return self.whole(s, x, kinds)

    def real(self, s: Site, x: list[str], index: Sequence[str]) -> str:
        i, op = s.i, s.i.op
        out = s.out
        if op in ("add", "subtract"):
            a, b, end = (self.shift(by, index) for by in rules.shifts_of_sum(s))
            return f"fx_shift(fx_shift({x[0]}, {a}) {'+' if op == 'add' else '-'} fx_shift({x[1]}, {b}), {end})"
        if op == "multiply":
            return f"fx_shift({x[0]} * {x[1]}, {self.shift(rules.shift_of_product(s), index)})"
        if op == "divide":
            return f"fx_quotient({x[0]}, {x[1]}, {self.shift(rules.shift_of_quotient(s), index)})"
        fractions = [None if f is None else self.shift(_wide(rules.bound_fraction(f), i.spec), index) for f in s.f]
        to = self.shift(_wide(out, i.spec), index)
        if op in _ONE:
            return f"{_ONE[op]}({x[0]}, {fractions[0]}, {to})"
        if op in ("sin", "cos"):
            return f"fx_sine({x[0]}, {fractions[0]}, {to}, {int(op == 'cos')})"
        if op in _TWO:
            return f"{_TWO[op]}({x[0]}, {x[1]}, {fractions[0]}, {fractions[1]}, {to})"
        if op in _WHOLE:
            return f"fx_shift(fx_whole({x[0]}, {fractions[0]}, {_WHOLE[op]}), -({to}))"
        if op == "sign":
            return f"fx_shift(({x[0]} > 0) - ({x[0]} < 0), -({to}))"
        ends = [
            None if f is None else self.shift(_wide(rules.between(np.broadcast_to(f, _common(f, out)), out), i.spec), index)
            for f in s.f
        ]
        if op == "where":
            kept = [f"({a} == FX_NAN ? FX_NAN : fx_shift({a}, {e}))" for a, e in zip(x[1:], ends[1:], strict=True)]
            return f"{x[0]} ? {kept[0]} : {kept[1]}"
        if op == "copysign":
            return f"({x[1]} < 0 ? -fx_shift(fx_abs({x[0]}), {ends[0]}) : fx_shift(fx_abs({x[0]}), {ends[0]}))"
        p, q, at = rules.aligned(s)
        a, b = f"fx_shift({x[0]}, {self.shift(p, index)})", f"fx_shift({x[1]}, {self.shift(q, index)})"
        if op in _COMPARE:
            return f"{a} {_COMPARE[op]} {b}"
        if op in ("maximum", "minimum"):
            order = ">=" if op == "maximum" else "<="
            return f"{a} {order} {b} ? fx_shift({x[0]}, {ends[0]}) : fx_shift({x[1]}, {ends[1]})"
        if op == "remainder":
            return f"fx_shift(fx_remainder({a}, {b}), {self.shift(at - out, index)})"
        if op == "floor_divide":
            return f"fx_shift(fx_floor_divide({a}, {b}), -({to}))"
        rules.bind(s)  # says so
        raise AssertionError(op)

    def whole(self, s: Site, x: list[str], kinds: list[str]) -> str:
        i, op = s.i, s.i.op
        big = "uint64" in kinds
        u = [f"(uint64_t){a}" for a in x]
        if op in ("add", "subtract", "multiply"):
            sign = {"add": "+", "subtract": "-", "multiply": "*"}[op]
            return self.wrapped(f"{u[0]} {sign} {u[1]}", i.spec)
        if op in _COMPARE:
            a, b = u if big else x
            return f"{a} {_COMPARE[op]} {b}"
        if op in _JOIN:
            return f"{x[0]} {_JOIN[op]} {x[1]}"
        if op == "logical_xor":
            return f"!{x[0]} != !{x[1]}"
        if op == "logical_not":
            return f"!{x[0]}"
        if op == "bitwise_invert":
            return f"!{x[0]}" if i.spec.dtype == "bool" else self.wrapped(f"~{u[0]}", i.spec)
        if op in _BITS:
            return self.wrapped(f"{u[0]} {_BITS[op]} {u[1]}", i.spec)
        if op in ("bitwise_left_shift", "bitwise_right_shift"):
            bits = 64 if i.spec.dtype.endswith("64") else 32
            if op == "bitwise_left_shift":
                return self.wrapped(f"({x[1]} >= {bits} || {x[1]} < 0 ? 0 : {u[0]} << {x[1]})", i.spec)
            if i.spec.dtype.startswith("u"):
                return self.wrapped(f"({x[1]} >= {bits} || {x[1]} < 0 ? 0 : {u[0]} >> {x[1]})", i.spec)
            return f"fx_down({x[0]}, {x[1]} >= {bits} || {x[1]} < 0 ? 63 : (int){x[1]})"
        if op == "where":
            return f"{x[0]} ? {x[1]} : {x[2]}"
        if op in ("maximum", "minimum"):
            a, b = u if big else x
            return f"{a} {'>=' if op == 'maximum' else '<='} {b} ? {x[0]} : {x[1]}"
        if op in ("floor_divide", "remainder") and not big:
            return f"fx_{op}({x[0]}, {x[1]})"
        if op == "sign":
            return f"({x[0]} > 0) - ({x[0]} < 0)"
        if op in ("floor", "ceil", "round", "trunc"):
            return x[0]
        if op == "float32_bits":
            return f"fx_float32_bits({x[0]})"
        raise LoweringError(
            f"{op} of {i.spec.dtype} has no form in fixed-point C", path=i.line, expected="an operation of the table",
            got=op, fix='use engine="fixed", which has it',
        )  # fmt: skip

    def wrapped(self, text: str, spec: Spec) -> str:
        return _WRAP.get(spec.dtype, "(int64_t)({})").format(text)

    def cast(self, s: Site, x: str, kind: str, index: Sequence[str]) -> str:
        to = s.i.attrs["dtype"]
        if kind == to:
            return x
        if to == "real":
            most = f"(uint64_t){x} > FX_LIMIT ? FX_LIMIT : {x}" if kind == "uint64" else f"fx_cut({x}, FX_LIMIT)"
            return f"fx_shift({most}, {self.shift(_wide(-s.out, s.i.spec), index)})"
        if kind == "real":
            if to == "bool":
                return f"{x} != 0"
            f = self.shift(_wide(rules.bound_fraction(s.real(0)), s.i.spec), index)
            return self.wrapped(f"fx_whole({x}, {f}, 2)", Spec((), to))
        return self.wrapped(x, Spec((), to))

    # -- sums and what compares along axes -----------------------------------------------------------

    def total(self, s: Site) -> None:
        i = s.i
        terms = {"sum": rules.terms_of_sum, "matmul": rules.terms_of_matmul, "vecdot": rules.terms_of_vecdot}[i.op]
        fractions, out, count, axes = terms(s)
        by, most, last = rules.adding(fractions, out, count, axes)
        outer = [1 if n in axes else size for n, size in enumerate(fractions.shape)]
        inner = [size if n in axes else 1 for n, size in enumerate(fractions.shape)]
        with self.loops(outer) as index:
            self.put("{ int64_t sum = 0;")
            self.indent += 1
            with self.loops(inner) as along:
                term = [a if n in axes else b for n, (a, b) in enumerate(zip(along, index, strict=True))]
                self.put(f"sum += fx_cut(fx_shift({self.term(s, term)}, {self.shift(by, term)}), INT64_C({most}));")
            place = self.result(s, index, axes)
            self.put(f"{place} = {self.fitted(i.out, f'fx_shift(sum, {self.shift(last, index)})')}; }}")
            self.indent -= 1

    def term(self, s: Site, index: list[str]) -> str:
        i = s.i
        if i.op == "sum":
            return self.word(i.args[0], index)
        if i.op == "vecdot":
            return f"{self.word(i.args[0], index)} * {self.word(i.args[1], index)}"
        *batch, row, k, column = index
        a, b = (self.shape(n) for n in i.args)
        left = [k] if len(a) == 1 else [*batch, row, k]
        right = [k] if len(b) == 1 else [*batch, k, column]
        return f"{self.word(i.args[0], left)} * {self.word(i.args[1], right)}"

    def result(self, s: Site, index: list[str], axes: tuple[int, ...]) -> str:
        i = s.i
        if i.op == "matmul":
            *batch, row, _, column = index
            a, b = (self.shape(n) for n in i.args)
            return self.word(i.out, [*batch, *([row] if len(a) > 1 else []), *([column] if len(b) > 1 else [])])
        if i.attrs.get("keepdims", False):
            return self.word(i.out, index)
        return self.word(i.out, [x for n, x in enumerate(index) if n not in axes])

    def along(self, s: Site) -> None:
        """Reductions that keep or compare: any, all, whole sums, extremes and where they are."""
        i = s.i
        shape = self.shape(i.args[0])
        axes = rules.axes_of(i)(len(shape))
        real = s.specs[i.args[0]].dtype == "real"
        at = rules.common_along(s.real(0), axes) if real else np.zeros((1,) * len(shape), np.int64)
        by = rules.between(s.real(0), np.broadcast_to(at, shape)) if real else np.zeros((), np.int64)
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
                    self.put(f"{{ int64_t x = {x}; if (k == 0 || x {order} best) {{ best = x; place = k; }} ++k; }}")
            keep = bool(i.attrs.get("keepdims", False))
            out = [x for n, x in enumerate(index) if keep or n not in axes]
            value = "place" if i.op.startswith("arg") else "best"
            if real and i.op in ("max", "min"):
                end = self.shift(at - (s.out if keep else np.expand_dims(np.broadcast_to(s.out, i.spec.shape), axes)), index)
                value = self.fitted(i.out, f"fx_shift(best, {end})")
            self.put(f"(void)place; (void)k; {self.word(i.out, out)} = {value}; }}")
            self.indent -= 1

    def running(self, s: Site) -> None:
        i = s.i
        shape = i.spec.shape
        axis = i.attrs["axis"] % len(shape)
        real = i.spec.dtype == "real"
        by, most, last = rules.shifts_of_running_sum(s) if real else (np.zeros((), np.int64), 0, np.zeros((), np.int64))
        with self.loops([1 if n == axis else size for n, size in enumerate(shape)]) as index:
            self.put("{ int64_t sum = 0;")
            self.indent += 1
            with self.loops([size if n == axis else 1 for n, size in enumerate(shape)]) as inside:
                here = [a if n == axis else b for n, (a, b) in enumerate(zip(inside, index, strict=True))]
                x = self.word(i.args[0], here)
                if real:
                    self.put(f"sum += fx_cut(fx_shift({x}, {self.shift(by, here)}), INT64_C({most}));")
                    self.put(f"{self.word(i.out, here)} = {self.fitted(i.out, f'fx_shift(sum, {self.shift(last, here)})')};")
                else:
                    self.put(f"sum = {self.wrapped(f'(uint64_t)sum + (uint64_t){x}', i.spec)};")
                    self.put(f"{self.word(i.out, here)} = sum;")
            self.indent -= 1
            self.put("}")

    def search(self, s: Site) -> None:
        i = s.i
        n = self.shape(i.args[0])[0]
        p = q = "0"
        if s.specs[i.args[0]].dtype == "real":
            left, right = rules.shifts_of_search(s)
            with self.loops(i.spec.shape) as index:
                q = self.shift(right, index)
            p = f"{self.table(np.broadcast_to(left, (n,)))}[middle]"
        order = "<=" if i.attrs.get("side", "left") == "right" else "<"
        base = self.at(i.args[0], (n,))
        with self.loops(i.spec.shape) as index:
            self.put(f"{{ int64_t low = 0, high = {n}, x = fx_shift({self.word(i.args[1], index)}, {q});")
            self.put("  while (low < high) { int64_t middle = (low + high) / 2;")
            self.put(f"    if (fx_shift(w[{base} + middle], {p}) {order} x) low = middle + 1; else high = middle; }}")
            self.put(f"  {self.word(i.out, index)} = low; }}")

    # -- moves ---------------------------------------------------------------------------------------

    def move(self, s: Site) -> None:
        i = s.i
        if i.op == "take":
            self.take(s)
            return
        if i.op in ("tril", "triu"):
            kept = "<=" if i.op == "tril" else ">="
            with self.loops(i.spec.shape) as index:
                inside = f"{index[-1]} - {index[-2]} {kept} {i.attrs.get('k', 0)}"
                self.put(f"{self.word(i.out, index)} = {inside} ? {self.word(i.args[0], index)} : 0;")
            return
        if i.op in ("concat", "stack"):
            axis = i.attrs["axis"] % len(i.spec.shape)
            start = 0
            for a in i.args:
                shape = self.shape(a)
                block = shape if i.op == "concat" else (*shape[:axis], 1, *shape[axis:])
                with self.loops(block) as index:
                    to = [_plus(start, x) if n == axis else x for n, x in enumerate(index)]
                    source = index if i.op == "concat" else [x for n, x in enumerate(index) if n != axis]
                    self.put(f"{self.word(i.out, to)} = {self.word(a, source)};")
                start += block[axis]
            return
        shape = self.shape(i.args[0])
        where = rules.moved_from(i, shape)
        source = self.at(i.args[0], shape)
        affine = _affine(where)
        with self.loops(i.spec.shape) as index:
            if affine is None:
                found = f"{self.table(where, 'at', 'int32_t')}[{_flat(i.spec.shape, index)}]"
            else:
                base, strides = affine
                parts = [f"{k} * {x}" if k != 1 else x for k, x in zip(strides, index, strict=True) if k and x != "0"]
                found = " + ".join([*([str(base)] if base or not parts else []), *parts])
            self.put(f"{self.word(i.out, index)} = w[{_plus(source, found)}];")

    def take(self, s: Site) -> None:
        i = s.i
        shape, indices = self.shape(i.args[0]), self.shape(i.args[1])
        axis = i.attrs["axis"] % len(shape)
        real = i.spec.dtype == "real"
        by = np.zeros((), np.int64)
        if real:
            f = s.real(0)
            by = rules.between(f, np.broadcast_to(f.min(axis=axis, keepdims=True), f.shape))
        by = slim(np.broadcast_to(by, shape)) if real else by
        with self.loops(i.spec.shape) as index:
            chosen = self.word(i.args[1], index[axis : axis + len(indices)])
            at = [*index[:axis], "n", *index[axis + len(indices) :]]
            self.put(f"{{ int64_t n = {chosen}; n = n < 0 ? 0 : n > {shape[axis] - 1} ? {shape[axis] - 1} : n;")
            x = self.word(i.args[0], at)
            text = f"fx_shift({x}, {self.shift(by, at)})" if real else x
            self.put(f"  {self.word(i.out, index)} = {text}; }}")

    def writes(self) -> None:
        """Registers at the end of a tick; all are read before the first is written."""
        cells = [c for r in self.pipeline.registers for c in r.cells]
        later: list[Callable[[], None]] = []
        for c, n in zip(cells, self.bound.program.writes, strict=True):
            if n == c.read:
                continue
            real = c.dtype == "real"
            by = np.zeros((), np.int64)
            if real:
                by = rules.between(self.bound.fractions[n], self.bound.fractions[c.read])
            kept = self.at(-1 - c.read, c.shape)
            with self.loops(c.shape) as index:
                x = self.word(n, index)
                text = f"({x} == FX_NAN ? FX_NAN : fx_shift({x}, {self.shift(by, index)}))" if real else x
                flat = _plus(kept, _flat(c.shape, index))
                self.put(f"w[{flat}] = {self.fitted(c.read, text) if real else text};")
            size = max(math.prod(c.shape), 1)
            place = self.at(c.read, c.shape)
            later.append(lambda p=place, k=kept, n=size: self.put(f"for (int k = 0; k < {n}; ++k) w[{p} + k] = w[{k} + k];"))
        for write in later:
            write()


def _plus(base: int, rest: str) -> str:
    return str(base) if rest == "0" else rest if base == 0 else f"{base} + {rest}"


def _flat(shape: Sequence[int], index: Sequence[str]) -> str:
    """The place of an element in an array laid out row by row; axes of one stay at 0."""
    parts = []
    stride = 1
    for size, x in zip(reversed(shape), reversed(index), strict=True):
        if size != 1 and x != "0":
            parts.append(x if stride == 1 else f"{stride} * ({x})" if "+" in x else f"{stride} * {x}")
        stride *= size
    return " + ".join(reversed(parts)) or "0"


def _wide(numbers: np.ndarray, spec: Spec) -> np.ndarray:
    return np.broadcast_to(numbers, spec.shape)


def _common(f: np.ndarray, out: np.ndarray) -> tuple[int, ...]:
    return np.broadcast_shapes(f.shape, out.shape)


def _affine(where: np.ndarray) -> tuple[int, list[int]] | None:
    """Base and strides of places that are a sum of multiples of the indices, or None."""
    if where.size == 0:
        return 0, [0] * where.ndim
    base = int(where.ravel()[0])
    strides = [int(where.take(1, axis=a).ravel()[0]) - base if n > 1 else 0 for a, n in enumerate(where.shape)]
    made = np.full(where.shape, base)
    for a, (n, k) in enumerate(zip(where.shape, strides, strict=True)):
        made = made + (k * np.arange(n)).reshape([-1 if b == a else 1 for b in range(where.ndim)])
    return (base, strides) if (made == where).all() else None


class Source:
    """A pipeline in fixed point as C99 text, with the places of its values.

    Args:
        pipeline: with formats.
        keys: the patterns of present inputs that come.

    Attributes:
        text: of the file; `play` in it runs ticks.
        place: where each value lies in the array of words; a register's new words lie elsewhere until the end.
        counts: the number of each value's counter of saturations.
        size: of the array of words.
        first: what the array holds before a run: the constants.
    """

    def __init__(self, pipeline: Pipeline, keys: Sequence[int]) -> None:
        player = Integers(pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32))
        writer = _Writer(player)
        known: dict[int, Any] = {}
        bodies = []
        cells = [c for r in pipeline.registers for c in r.cells]
        for c in cells:
            writer.at(c.read, c.shape)
        for port in pipeline.inputs:
            for leaf in port.leaves:
                writer.at(leaf.value, leaf.shape)
        writer.at(pipeline.time, ())
        writer.at(pipeline.seed, (2,))
        for key in keys:
            writer.lines, writer.indent = [], 1
            writer.tick(key)
            known |= writer.bound.known
            bodies.append((key, "\n".join(writer.lines), writer.bound))
        self.outputs = [
            [(-1, []) if flag is None else (flag, list(leaves)) for flag, leaves in bound.program.outputs]
            for _, _, bound in bodies
        ]
        self.keys = list(keys)
        self.fractions = [bound.fractions for _, _, bound in bodies]
        absent = {leaf.value for port in pipeline.inputs for leaf in port.leaves}
        self.known = {n: a for n, a in known.items() if n in writer.place and n not in absent}
        for n, a in known.items():  # constants that only an output or a register takes
            if n not in writer.place and n not in absent:
                writer.at(n, np.shape(a))
                self.known[n] = a
        self.place, self.counts, self.size = writer.place, writer.counter, writer.size
        self.text = self._text(writer, bodies, player)
        self.first = np.zeros(self.size, np.int64)
        for n, a in self.known.items():
            flat = np.asarray(a).astype(np.int64).ravel()
            self.first[self.place[n] : self.place[n] + flat.size] = flat

    def _text(self, writer: _Writer, bodies: list[tuple[int, str, Bound]], player: Integers) -> str:
        ticks = "\n".join(
            f"static void tick_{key}(int64_t *w, int64_t *counts) {{\n  (void)counts;\n{body}\n}}\n"
            for key, body, _ in bodies
        )
        cases = "\n".join(f"    case {key}: tick_{key}(w, counts); break;" for key, _, _ in bodies)
        return "\n".join(
            [
                f"/* {self._name(player)}, generated by flowgraph: fixed point of {player.formats.width} bits, no heap. */",
                kernels(),
                f"#define MOST INT64_C({int(player.most)})",
                *writer.tables.values(),
                ticks,
                "int fx_tick(int64_t *w, int64_t *counts, int key) {",
                "  switch (key) {",
                cases,
                "    default: return 1;",
                "  }",
                "  return 0;",
                "}",
                "",
                self._play(writer),
            ]
        )

    def _play(self, writer: _Writer) -> str:
        """A recording played in one call: inputs row by row, outputs appended where they are there."""
        pipeline = writer.pipeline
        lines = [
            "int64_t fx_play(int64_t *w, int64_t *counts, int64_t ticks, const int64_t *time, const int64_t *key,",
            "                const int64_t *const *rows, int64_t *const *outs, int64_t *const *when, int64_t *made) {",
            f"  int64_t used[{max(len(pipeline.inputs), 1)}] = {{0}};",
            "  for (int64_t t = 0; t < ticks; ++t) {",
            f"    w[{self.place[pipeline.time]}] = time[t];",
        ]
        row = 0
        for k, port in enumerate(pipeline.inputs):
            lines.append(f"    if (key[t] >> {k} & 1) {{")
            for leaf in port.leaves:
                n, place = math.prod(leaf.shape), self.place[leaf.value]
                lines.append(f"      for (int k = 0; k < {n}; ++k) w[{place} + k] = rows[{row}][used[{k}] * {n} + k];")
                row += 1
            lines += [f"      ++used[{k}];", "    }"]
        lines += ["    if (fx_tick(w, counts, (int)key[t])) return t;", "    switch (key[t]) {"]
        for key, ports in zip(self.keys, self.outputs, strict=True):
            lines.append(f"      case {key}:")
            column = 0
            for p, (flag, leaves) in enumerate(ports):
                sizes = [math.prod(leaf.shape) for leaf in pipeline.outputs[p].leaves]
                if flag >= 0:
                    lines.append(f"        if (w[{self.place[flag]}]) {{")
                    for n, value in enumerate(leaves):
                        copy = f"outs[{column + n}][made[{p}] * {sizes[n]} + k] = w[{self.place[value]} + k]"
                        lines.append(f"          for (int k = 0; k < {sizes[n]}; ++k) {copy};")
                    lines += [f"          when[{p}][made[{p}]++] = t;", "        }"]
                column += len(sizes)
            lines.append("        break;")
        return "\n".join([*lines, "    }", "  }", "  return ticks;", "}", ""])

    @staticmethod
    def _name(player: Integers) -> str:
        return player.pipeline.name.replace("*/", "* /")

