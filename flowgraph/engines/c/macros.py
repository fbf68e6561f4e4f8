"""Operations with loops of their own: larger products and factorizations, sorts, random numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from flowgraph.engines.c.lines import Lines
from flowgraph.engines.c.nodes import Macro, View
from flowgraph.engines.c.syntax import ctype

if TYPE_CHECKING:
    from flowgraph.engines.c.statements import Writer


def write_macro(w: Writer, m: Macro) -> None:
    """Write a macro's loops."""
    _MACROS[m.kind](w, m)


def element(w: Lines, view: View, index: Sequence[str]) -> str:
    """An element of a view; an axis of size one, and leading axes that are not there, are left out."""
    index = index[len(index) - len(view.shape) :]
    terms = [
        (i if s == 1 else f"{s} * {i}")
        for i, s, n in zip(index, view.strides, view.shape, strict=True)
        if s and n > 1
    ]
    if view.offset or not terms:
        terms.insert(0, str(view.offset))
    return w.at(view.buffer, " + ".join(terms))


class Loops:
    """Opens loops over axes and closes them again."""

    def __init__(self, w: Lines, sizes: Sequence[int], letter: str = "b") -> None:
        self.w, self.sizes, self.letter = w, sizes, letter

    def __enter__(self) -> list[str]:
        names = []
        for k, n in enumerate(self.sizes):
            name = f"{self.letter}{k}"
            self.w.line(f"for (int32_t {name} = 0; {name} < {n}; {name}++) {{")
            self.w.depth += 1
            names.append(name)
        return names

    def __exit__(self, *_: object) -> None:
        for _n in self.sizes:
            self.w.depth -= 1
            self.w.line("}")


def _pointer(w: Lines, view: View, batch: Sequence[str]) -> str:
    """The address of a view's first element in a batch."""
    view = View(view.buffer, view.shape[:-2], view.offset, view.strides[:-2])
    return "&" + element(w, view, list(batch))


def index(strides: Sequence[int], names: Sequence[str]) -> str:
    """An index into a matrix."""
    terms = [n if s == 1 else f"{s} * {n}" for s, n in zip(strides, names, strict=True) if s]
    return " + ".join(terms) or "0"


def call(
    w: Lines, kind: str, m: Macro, make: Callable[..., str], *more: object, given: Sequence[str] = ()
) -> None:
    """Call the function for these sizes and strides, which a file has once, for each of the batch.

    `more` tells functions of the same sizes apart, `given` are arguments after the addresses.
    """
    views = [*m.inputs, m.output]
    key = (kind, *more, *((v.shape[-2:], v.strides[-2:]) for v in views))
    name = w.write.function(key, kind, make, *views)
    with Loops(w, m.output.shape[:-2]) as batch:
        w.line(f"{name}({', '.join([*(_pointer(w, v, batch) for v in views), *given])});")


_ACCUMULATORS = 12
"""Vectors of sums that are under way together: what is one after the other waits for each sum."""

_PACKED = 16_384
"""Elements of a matrix that are laid out for vectors at a time: they lie on the stack."""


def write_product_of_block(w: Lines, m: Macro) -> None:
    """Write a product of real matrices over the places of a block, added to that of the blocks before."""
    _matmul(w, m, ("block", "end - block"))


def _matmul(w: Lines, m: Macro, part: tuple[str, ...] = ()) -> None:
    type_ = ctype(m.output.buffer.dtype, w.write.real)

    def text(name: str, a: View, b: View, out: View) -> str:
        rows, columns, inner = out.shape[-2], out.shape[-1], a.shape[-1]
        right = index(b.strides[-2:], ("k", "j"))

        def at(r: int) -> str:
            return index(a.strides[-2:], (f"(i + {r})" if r else "i", "k"))

        def to(r: int) -> str:
            return index(out.strides[-2:], (f"(i + {r})" if r else "i", "j"))

        packed = type_ == w.write.real and rows >= 4 and columns > 1
        w.write.packs |= packed
        kept, wide = ("fg_pack", f"FG_PACKS({columns})") if packed else (type_, columns)
        deep = min(inner, max(_PACKED // columns, 1))
        parted = packed and deep < inner
        assert not part or (packed and not parted)
        begin, end = ("first", "last") if parted else (0, "count" if part else inner)
        nth = "(k - first)" if parted else "k"

        def so_far(r: int) -> list[str]:
            """What the parts before have summed up."""
            sums = f"(({type_} *)made)[j]"
            return [
                f"        for (int32_t j = 0; first && j < {columns}; j++) {sums} = out[{to(r)}];",
                f"        for (int32_t j = 0; first && j < {wide}; j++) row{r}[j] = made[j];",
            ]

        def block(first: int, last: int, step: int) -> list[str]:
            """Rows from `first` on up to `last`, so many at a time."""
            each = range(step)
            factor = f"right[{wide} * {nth} + j]" if packed else f"b[{right}]"
            lines = [
                f"    for (int32_t i = {first}; i < {last}; i += {step}) {{",
                *(f"        {kept} row{r}[{wide}];" for r in each),
                f"        for (int32_t j = 0; j < {wide}; j++) {{",
                *(f"            row{r}[j] = {'none' if packed else '0'};" for r in each),
                "        }",
                *([line for r in each for line in so_far(r)] if parted or part else []),
                f"        for (int32_t k = {begin}; k < {end}; k++) {{",
                *(f"            const {type_} left{r} = a[{at(r)}];" for r in each),
                f"            for (int32_t j = 0; j < {wide}; j++) {{",
                *(f"                row{r}[j] += left{r} * {factor};" for r in each),
                "            }",
                "        }",
            ]
            for r in each:
                if packed:
                    lines.append(f"        for (int32_t j = 0; j < {wide}; j++) made[j] = row{r}[j];")
                found = f"((const {type_} *)made)[j]" if packed else f"row{r}[j]"
                lines.append(f"        for (int32_t j = 0; j < {columns}; j++) out[{to(r)}] = {found};")
            return [*lines, "    }"]

        together = max(1, min(_ACCUMULATORS // -(-columns // 4), 4)) if packed else 1
        full = rows - rows % together
        copy = [
            f"    fg_pack right[{deep} * {wide}], made[{wide}];",
            "    const fg_pack none = FG_ZERO;",
            *(
                [
                    f"    for (int32_t first = 0; first < {inner}; first += {deep}) {{",
                    f"    const int32_t last = first < {inner - deep} ? first + {deep} : {inner};",
                ]
                if parted
                else []
            ),
            f"    for (int32_t k = {begin}; k < {end}; k++) {{",
            f"        {type_} *const row = ({type_} *)(right + {wide} * {nth});",
            f"        for (int32_t j = 0; j < {columns}; j++) row[j] = b[{right}];",
            f"        for (int32_t j = {columns}; j < FG_PACK * {wide}; j++) row[j] = 0;",
            "    }",
        ]
        return "\n".join(
            [
                f"/* ({rows} x {inner}) ({inner} x {columns}) */",
                f"static FG_APART void {name}(const {type_} *restrict a, const {type_} *restrict b, "
                f"{type_} *restrict out{', int32_t first, int32_t count' if part else ''})",
                "{",
                *(copy if packed else []),
                *block(0, full, together),
                *(block(full, rows, rows - full) if full < rows else []),
                *(["    }"] if parted else []),
                "}",
                "",
            ]
        )

    call(w, "matmul", m, text, type_, bool(part), given=part)


def _cholesky(w: Lines, m: Macro) -> None:
    real, helper = w.write.real, w.write.helper("fg_cholesky")

    def text(name: str, a: View, out: View) -> str:
        n, at = out.shape[-1], index(a.strides[-2:], "ij")
        return f"""/* lower factor of ({n} x {n}) */
static FG_APART void {name}(const {real} *restrict a, {real} *restrict out)
{{
    {real} factor[{n * n}];
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {n}; j++) factor[{n} * i + j] = j <= i ? a[{at}] : 0;
    {helper}(factor, {n});
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {n}; j++) out[{index(out.strides[-2:], "ij")}] = factor[{n} * i + j];
}}
"""

    call(w, "cholesky", m, text)


_SMALL = 32
"""Numbers that stay in registers around a solution."""


def _solve(w: Lines, m: Macro) -> None:
    real, plain, exchanging = w.write.real, w.write.helper("fg_solve_plain"), w.write.helper("fg_solve")

    def text(name: str, a: View, b: View, out: View) -> str:
        n, columns = out.shape[-2:]
        made = index(out.strides[-2:], "ij")
        given = f"""    for (int32_t i = 0; i < {n}; i++) {{
        for (int32_t j = 0; j < {n}; j++) matrix[{n} * i + j] = a[{index(a.strides[-2:], "ij")}];
        for (int32_t j = 0; j < {columns}; j++) right[{columns} * i + j] = b[{index(b.strides[-2:], "ij")}];
    }}
"""
        where = "FG_INLINE" if n * (n + columns) <= _SMALL else "FG_APART"
        return f"""/* ({n} x {n}) x = ({n} x {columns}) */
static {where} void {name}(const {real} *restrict a, const {real} *restrict b, {real} *restrict out)
{{
    {real} matrix[{n * n}], right[{n * columns}];
{given}    if (!{plain}(matrix, right, {n}, {columns})) {{
{given.replace("    ", "        ", 1)}        {exchanging}(matrix, right, {n}, {columns});
    }}
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {columns}; j++) out[{made}] = right[{columns} * i + j];
}}
"""

    call(w, "solve", m, text)


def _reduce(w: Lines, m: Macro) -> None:
    (x,), out, axes = m.inputs, m.output, m.extra["axes"]
    kind, dtype = m.extra["joins"], out.buffer.dtype
    kept = [k for k in range(len(x.shape)) if k not in axes]
    with Loops(w, [x.shape[k] for k in kept], "r") as outer:
        w.line("{")
        w.depth += 1
        first = [dict(zip(kept, outer, strict=True)).get(k, "0") for k in range(len(x.shape))]
        c = ctype(dtype, w.write.real)
        start = {"sum": "0", "prod": "1", "any": "0", "all": "1"}.get(kind) or element(w, x, first)
        w.line(f"{c} total = {start};")
        with Loops(w, [x.shape[k] for k in axes], "k") as inner:
            at = dict(zip(kept, outer, strict=True)) | dict(zip(axes, inner, strict=True))
            w.line(f"const {c} term = {element(w, x, [at[k] for k in range(len(x.shape))])};")
            if kind in ("max", "min"):
                sign = ">" if kind == "max" else "<"
                nan = " || term != term" if dtype == "real" else ""
                w.line(f"total = (term {sign} total{nan}) ? term : total;")
            elif dtype == "bool":
                w.line(f"total = total {'||' if kind == 'any' else '&&'} term;")
            elif dtype in ("int32", "int64"):
                sign, wide = "+" if kind == "sum" else "*", f"uint{dtype[3:]}_t"
                w.line(f"total = ({c})(({wide})total {sign} ({wide})term);")
            else:
                w.line(f"total {'+' if kind == 'sum' else '*'}= term;")
        w.line(f"{element(w, out, outer)} = total;")
        w.depth -= 1
        w.line("}")


def _lines(w: Lines, m: Macro, axis: int) -> tuple[Loops, Callable[[View, list[str], str], str]]:
    """Loops over all axes but one, and how an element along that one is written."""
    shape = m.inputs[0].shape
    others = [n for k, n in enumerate(shape) if k != axis]

    def at(view: View, outer: list[str], inner: str) -> str:
        short = len(view.shape) < len(shape)
        return element(w, view, outer if short else [*outer[:axis], inner, *outer[axis:]])

    return Loops(w, others, "r"), at


def _cumulative(w: Lines, m: Macro) -> None:
    axis, dtype = m.extra["axis"], m.output.buffer.dtype
    loops, at = _lines(w, m, axis)
    c = ctype(dtype, w.write.real)
    with loops as outer:
        w.line("{")
        w.depth += 1
        w.line(f"{c} total = 0;")
        with Loops(w, (m.inputs[0].shape[axis],), "k") as (k,):
            term = at(m.inputs[0], outer, k)
            if dtype in ("int32", "int64"):
                wide = f"uint{dtype[3:]}_t"
                w.line(f"total = ({c})(({wide})total + ({wide}){term});")
            else:
                w.line(f"total += {term};")
            w.line(f"{at(m.output, outer, k)} = total;")
        w.depth -= 1
        w.line("}")


def _place(w: Lines, m: Macro) -> None:
    axis = m.extra["axis"]
    x = m.inputs[0]
    sign = ">" if m.kind == "argmax" else "<"
    loops, at = _lines(w, m, axis)
    c = ctype(x.buffer.dtype, w.write.real)
    with loops as outer:
        w.line("{")
        w.depth += 1
        w.line("int64_t place = 0;")
        w.line(f"{c} best = {at(x, outer, '0')};")
        with Loops(w, (x.shape[axis],), "k") as (k,):
            w.line(f"const {c} term = {at(x, outer, k)};")
            nan = " || (term != term && best == best)" if x.buffer.dtype == "real" else ""
            w.line(f"if (term {sign} best{nan}) {{ best = term; place = {k}; }}")
        w.line(f"{at(m.output, outer, '0')} = place;")
        w.depth -= 1
        w.line("}")


def _sort(w: Lines, m: Macro) -> None:
    """In order by insertion for short lines, by heap for long ones; ties by place, NaN last."""
    axis = m.extra["axis"]
    x = m.inputs[0]
    n = x.shape[axis]
    loops, at = _lines(w, m, axis)
    real = x.buffer.dtype == "real"

    def value(place: str) -> str:
        return at(x, outer, place)

    with loops as outer:
        w.line("{")
        w.depth += 1
        w.line(f"int32_t order[{max(n, 1)}];")
        w.line(f"for (int32_t k = 0; k < {n}; k++) order[k] = k;")
        w.line(f"for (int32_t top = {n} / 2, end = {n}; end > 1;) {{")
        w.depth += 1
        w.line("int32_t item;")
        w.line("if (top > 0) { item = order[--top]; }")
        w.line(
            "else { item = order[--end]; order[end] = order[0]; if (end == 1) { order[0] = item; break; } }"
        )
        w.line("int32_t hole = top;")
        w.line("for (int32_t child; (child = 2 * hole + 1) < end; hole = child) {")
        w.depth += 1

        def after(a: str, b: str) -> str:
            p, q = value(a), value(b)
            if real:
                return (
                    f"({p} > {q} || ({p} != {p} && {q} == {q}) || "
                    f"(({p} == {q} || ({p} != {p} && {q} != {q})) && {a} > {b}))"
                )
            return f"({p} > {q} || ({p} == {q} && {a} > {b}))"

        w.line(f"if (child + 1 < end && {after('order[child + 1]', 'order[child]')}) child++;")
        w.line(f"if (!{after('order[child]', 'item')}) break;")
        w.line("order[hole] = order[child];")
        w.depth -= 1
        w.line("}")
        w.line("order[hole] = item;")
        w.depth -= 1
        w.line("}")
        chosen = "order[k]" if m.kind == "argsort" else value("order[k]")
        w.line(f"for (int32_t k = 0; k < {n}; k++) {at(m.output, outer, 'k')} = {chosen};")
        w.depth -= 1
        w.line("}")


def _replay(w: Lines, m: Macro) -> None:
    """Turn after turn around the ring; a function for each case of the body."""
    rows, first, count, *given = m.inputs
    (places, size), wide = m.output.shape, rows.shape[1]
    history, at_row = w.names(m.output.buffer), w.names(rows.buffer)
    row = f"{at_row} + {rows.offset} + {wide} * at" if rows.offset else f"{at_row} + {wide} * at"
    names = [
        w.write.function((id(case), size, wide), "turn", w.write.turn, case, (size, wide))
        for case in m.extra["body"].cases
    ]
    for view in given:
        source = w.names(view.buffer) + (f"[{view.offset} + k]" if view.offset else "[k]")
        w.line(f"for (int32_t k = 0; k < {places * size}; k++) {history}[k] = {source};")
    w.line(f"for (int32_t k = 0; k < {element(w, count, [])} && k < {places}; k++) {{")
    w.depth += 1
    w.line(f"const int32_t at = ({element(w, first, [])} % {places} + {places} + k) % {places};")
    w.line(f"const {w.write.real} *before = {history} + {size} * ((at + {places - 1}) % {places});")
    calls = [f"{name}(s, before, {row}, {history} + {size} * at);" for name in names]
    for k, call in enumerate(calls[:-1]):
        w.line(f"{'else ' if k else ''}if ({at_row}[{rows.offset} + {wide} * at] < {k + 1}) {call}")
    w.line(("else " if len(calls) > 1 else "") + calls[-1])
    w.depth -= 1
    w.line("}")


def choice_call(w: Lines, m: Macro) -> str:
    """The call of the function that makes a choice, which a file has once."""
    choice = m.extra["choice"]
    name = w.write.function(("choice", choice.key), "choice", w.write.choice, choice)
    places = [f"&{w.at(v.buffer, str(v.offset))}" for v in (*m.inputs[1:], m.output)]
    return f"{name}(s, {', '.join(places)});"


def _choose(w: Writer, m: Macro) -> None:
    """What is rarely taken is computed only then."""
    called, when = choice_call(w, m), w.ref(m.args[0])
    w.line(f"if ({when}) {{" if m.extra["truth"] else f"if (!({when})) {{")
    w.line(f"    {called}")
    w.line("} else {")
    w.depth += 1
    with Loops(w, m.output.shape) as at:
        w.line(f"{element(w, m.output, at)} = {element(w, m.inputs[0], at)};")
    w.depth -= 1
    w.line("}")


def _random(w: Lines, m: Macro) -> None:
    name = w.write.helper(f"fg_{m.extra['draws']}")
    blocks = m.output.buffer.size // 4
    seed = w.at(m.inputs[0].buffer, "0")
    w.line(f"{name}({w.names(m.output.buffer)}, {blocks}, UINT32_C({m.extra['hash']}), time, {seed}, "
           f"{w.at(m.inputs[0].buffer, '1')});")  # fmt: skip


_MACROS: dict[str, Callable[[Any, Macro], None]] = {
    "matmul": _matmul,
    "cholesky": _cholesky,
    "solve": _solve,
    "reduce": _reduce,
    "cumulative_sum": _cumulative,
    "argmax": _place,
    "argmin": _place,
    "sort": _sort,
    "argsort": _sort,
    "random": _random,
    "choose": _choose,
    "replay": _replay,
}
