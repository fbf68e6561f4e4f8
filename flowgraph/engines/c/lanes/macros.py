"""Products, factorizations and sums with loops of their own, on the lanes of several runs.

Rows are exchanged, and what is singular becomes NaN, in each lane for itself, by masks.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from flowgraph.engines.c.elimination import SUBSTITUTED, eliminated
from flowgraph.engines.c.lanes.expressions import no_lanes
from flowgraph.engines.c.lines import Lines
from flowgraph.engines.c.macros import Loops, call, choice_call, element, index
from flowgraph.engines.c.nodes import Macro, View

if TYPE_CHECKING:
    from flowgraph.engines.c.lanes.writer import LaneWriter


def write_lane_macro(w: LaneWriter, m: Macro) -> None:
    """Write a macro's loops.

    Raises:
        NoLanesError: for one that has no form in lanes.
    """
    made = _MACROS.get(m.kind)
    if made is None or (m.output.buffer.dtype != "real" and m.kind != "reduce"):
        raise no_lanes(m.kind, m.origin)
    made(w, m)


def _types(w: Lines, m: Macro) -> list[str]:
    return [w.write.kind(v.buffer) for v in (*m.inputs, m.output)]


def _matmul(w: Lines, m: Macro) -> None:
    kinds = _types(w, m)
    if "fg_real" not in kinds[:2]:
        raise no_lanes("a product of constants", m.origin)

    def text(name: str, a: View, b: View, out: View) -> str:
        rows, columns, inner = out.shape[-2], out.shape[-1], a.shape[-1]
        left, right = index(a.strides[-2:], ("i", "k")), index(b.strides[-2:], ("k", "j"))
        return f"""/* ({rows} x {inner}) ({inner} x {columns}) */
static FG_APART void {name}(const {kinds[0]} *restrict a, const {kinds[1]} *restrict b,
                            fg_real *restrict out)
{{
    for (int32_t i = 0; i < {rows}; i++) {{
        fg_real row[{columns}];
        for (int32_t j = 0; j < {columns}; j++) row[j] = fg_real_of(0.0);
        for (int32_t k = 0; k < {inner}; k++) {{
            const {kinds[0]} left = a[{left}];
            for (int32_t j = 0; j < {columns}; j++) row[j] += left * b[{right}];
        }}
        for (int32_t j = 0; j < {columns}; j++) out[{index(out.strides[-2:], ("i", "j"))}] = row[j];
    }}
}}
"""

    call(w, "matmul", m, text, *kinds)


def _entry(kind: str, place: str) -> str:
    return place if kind == "fg_real" else f"fg_real_of({place})"


def _cholesky(w: Lines, m: Macro) -> None:
    kinds = _types(w, m)
    if m.output.shape[-1] <= _WRITTEN_OUT:
        call(w, "cholesky", m, lambda name, a, out: _written_out(name, kinds[0], a, out), *kinds)
        return
    factorize = w.write.function(("factorize",), "cholesky", lambda name: CHOLESKY.replace("NAME", name))

    def text(name: str, a: View, out: View) -> str:
        n, at = out.shape[-1], index(a.strides[-2:], ("i", "j"))
        return f"""/* lower factor of ({n} x {n}) */
static FG_APART void {name}(const {kinds[0]} *restrict a, fg_real *restrict out)
{{
    fg_real factor[{n * n}];
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {n}; j++)
            factor[{n} * i + j] = j <= i ? {_entry(kinds[0], f"a[{at}]")} : fg_real_of(0.0);
    {factorize}(factor, {n});
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {n}; j++)
            out[{index(out.strides[-2:], ("i", "j"))}] = factor[{n} * i + j];
}}
"""

    call(w, "cholesky", m, text, *kinds)


_WRITTEN_OUT = 16
"""Rows of a matrix whose factorization has no loop."""


def _written_out(name: str, kind: str, a: View, out: View) -> str:
    """L D L^T, of which only the pivots' inverses wait for one another; the roots of D come at the end."""
    n, at, to = out.shape[-1], a.strides[-2:], out.strides[-2:]
    below = [(i, j) for i in range(n) for j in range(i + 1)]
    lines = [f"fg_real a{i}_{j} = {_entry(kind, f'a[{at[0] * i + at[1] * j}]')};" for i, j in below]
    for j in range(n):
        lines.append(f"const fg_real inverse{j} = 1.0 / a{j}_{j};")
        for i in range(j + 1, n):
            lines.append(f"const fg_real f{i}_{j} = a{i}_{j} * inverse{j};")
            lines += [f"a{i}_{k} -= f{i}_{j} * a{k}_{j};" for k in range(j + 1, i + 1)]
    good = " & ".join(f"(fg_mask)(a{j}_{j} > 0.0)" for j in range(n))
    lines.append(f"const fg_mask good = {good};")
    lines += [
        f"const fg_real root{j} = fg_real_pick(good, fg_real_root(a{j}_{j}), fg_real_of(NAN));"
        for j in range(n)
    ]
    lines.append("const fg_real none = fg_real_pick(good, fg_real_of(0.0), fg_real_of(NAN));")
    for i in range(n):
        for j in range(n):
            value = f"f{i}_{j} * root{j}" if j < i else f"root{j}" if j == i else "none"
            lines.append(f"out[{to[0] * i + to[1] * j}] = {value};")
    return "\n".join(
        [
            f"/* lower factor of ({n} x {n}); NaN in lanes where that is not positive definite */",
            f"static FG_APART void {name}(const {kind} *restrict a, fg_real *restrict out)",
            "{",
            *(f"    {line}" for line in lines),
            "}",
            "",
        ]
    )


def _solve(w: Lines, m: Macro) -> None:
    kinds = _types(w, m)
    exchanging = w.write.function(("eliminate",), "solve", lambda name: SOLVE.replace("NAME", name))
    plain = w.write.function(("plain",), "solve_plain", lambda name: PLAIN.replace("NAME", name))

    def text(name: str, a: View, b: View, out: View) -> str:
        n, columns = out.shape[-2:]
        left, right = index(a.strides[-2:], ("i", "j")), index(b.strides[-2:], ("i", "j"))
        given = f"""    for (int32_t i = 0; i < {n}; i++) {{
        for (int32_t j = 0; j < {n}; j++) matrix[{n} * i + j] = {_entry(kinds[0], f"a[{left}]")};
        for (int32_t j = 0; j < {columns}; j++) right[{columns} * i + j] = {_entry(kinds[1], f"b[{right}]")};
    }}
"""
        return f"""/* ({n} x {n}) x = ({n} x {columns}) */
static FG_APART void {name}(const {kinds[0]} *restrict a, const {kinds[1]} *restrict b,
                            fg_real *restrict out)
{{
    fg_real matrix[{n * n}], right[{n * columns}];
{given}    const fg_mask sound = {plain}(matrix, right, {n}, {columns});
    if (fg_mask_any(~sound)) {{
        fg_real found[{n * columns}];
        for (int32_t k = 0; k < {n * columns}; k++) found[k] = right[k];
{given}        {exchanging}(matrix, right, {n}, {columns});
        for (int32_t k = 0; k < {n * columns}; k++) right[k] = fg_real_pick(sound, found[k], right[k]);
    }}
    for (int32_t i = 0; i < {n}; i++)
        for (int32_t j = 0; j < {columns}; j++)
            out[{index(out.strides[-2:], ("i", "j"))}] = right[{columns} * i + j];
}}
"""

    call(w, "solve", m, text, *kinds)


def _reduce(w: LaneWriter, m: Macro) -> None:
    (x,), out, axes = m.inputs, m.output, m.extra["axes"]
    kind, dtype = m.extra["joins"], out.buffer.dtype
    kept = [k for k in range(len(x.shape)) if k not in axes]
    type_ = w.write.ctype(dtype)

    def entry(at: list[str]) -> str:
        text = element(w, x, at)
        return w.write.splat(dtype, text) if x.buffer.kind == "const" else text

    with Loops(w, [x.shape[k] for k in kept], "r") as outer:
        w.line("{")
        w.depth += 1
        first = [dict(zip(kept, outer, strict=True)).get(k, "0") for k in range(len(x.shape))]
        start = {"sum": "0", "prod": "1", "any": "0", "all": "1"}.get(kind)
        w.line(f"{type_} total = {entry(first) if start is None else w.write.splat(dtype, start)};")
        with Loops(w, [x.shape[k] for k in axes], "k") as inner:
            at = dict(zip(kept, outer, strict=True)) | dict(zip(axes, inner, strict=True))
            w.line(f"const {type_} term = {entry([at[k] for k in range(len(x.shape))])};")
            if kind in ("max", "min"):
                nan = " | (term != term)" if dtype == "real" else ""
                wins = w.write.compared(dtype, f"(term {'>' if kind == 'max' else '<'} total){nan}")
                w.line(f"total = {w.write.pick(dtype, wins, 'term', 'total')};")
            elif dtype == "bool":
                w.line(f"total {'|' if kind == 'any' else '&'}= term;")
            elif dtype in ("int32", "int64"):
                wide, sign = w.write.ctype(f"u{dtype}"), "+" if kind == "sum" else "*"
                w.line(f"total = ({type_})(({wide})total {sign} ({wide})term);")
            else:
                w.line(f"total {'+' if kind == 'sum' else '*'}= term;")
        w.line(f"{element(w, out, outer)} = total;")
        w.depth -= 1
        w.line("}")


def _choose(w: LaneWriter, m: Macro) -> None:
    """What is rarely taken is computed where a lane takes it."""
    other, out = m.inputs[0], m.output
    where = w.promoted(m.args[0])
    w.line("{")
    w.depth += 1
    w.line(f"const fg_mask taken = {where if m.extra['truth'] else f'~({where})'};")
    w.line("const bool any = fg_mask_any(taken);")
    w.line(f"if (any) {choice_call(w, m)}")
    with Loops(w, out.shape) as at:
        there, made = element(w, other, at), element(w, out, at)
        there = w.write.splat("real", there) if other.buffer.kind == "const" else there
        w.line(f"{made} = any ? fg_real_pick(taken, {made}, {there}) : {there};")
    w.depth -= 1
    w.line("}")


def _random(w: LaneWriter, m: Macro) -> None:
    draws, blocks = m.extra["draws"], m.output.buffer.size // 4
    for needed in ("fg_philox", f"fg_one_{draws}"):
        w.write.helper(needed)
    name = w.write.function(
        ("random", draws), draws, lambda name: RANDOM.replace("NAME", name).replace("KIND", draws)
    )
    seed = w.names(m.inputs[0].buffer)
    w.line(f"{name}({w.names(m.output.buffer)}, {blocks}, UINT32_C({m.extra['hash']}), time, {seed});")


_MACROS = {
    "matmul": _matmul,
    "cholesky": _cholesky,
    "solve": _solve,
    "reduce": _reduce,
    "random": _random,
    "choose": _choose,
}

RANDOM = """\
/* 4 n random numbers of a name (its hash) at a time, in each lane those of its own seed */
static inline void NAME(fg_real *restrict out, int32_t n, uint32_t hash, int64_t time, const fg_uint *seed) {
    const uint32_t low = (uint32_t)(uint64_t)time, high = (uint32_t)((uint64_t)time >> 32);
    for (int32_t i = 0; i < n; i++) {
        union { fg_real all; double one[FG_LANES]; } a, b, c, d;
        FG_SIMD(omp simd)
        for (int32_t l = 0; l < FG_LANES; l++) {
            uint32_t even[2] = {(uint32_t)i, low}, odd[2] = {hash, high};
            fg_philox(even, odd, seed[0][l], seed[1][l]);
            a.one[l] = fg_one_KIND(even[0]);
            b.one[l] = fg_one_KIND(even[1]);
            c.one[l] = fg_one_KIND(odd[0]);
            d.one[l] = fg_one_KIND(odd[1]);
        }
        out[i] = a.all;
        out[n + i] = b.all;
        out[2 * n + i] = c.all;
        out[3 * n + i] = d.all;
    }
}
"""

CHOLESKY = """\
/* lower factor in place, of the lower triangle; NaN in lanes where that is not positive definite */
static FG_INLINE void NAME(fg_real *a, int32_t n) {
    fg_mask good = fg_mask_of(-1);
    for (int32_t j = 0; j < n; j++) {
        fg_real d = a[n * j + j];
        for (int32_t k = 0; k < j; k++) d -= a[n * j + k] * a[n * j + k];
        good &= (fg_mask)(d > fg_real_of(0.0));
        const fg_real root = fg_real_root(d);
        a[n * j + j] = root;
        for (int32_t i = j + 1; i < n; i++) {
            fg_real s = a[n * i + j];
            for (int32_t k = 0; k < j; k++) s -= a[n * i + k] * a[n * j + k];
            a[n * i + j] = s / root;
            a[n * j + i] = fg_real_of(0.0);
        }
    }
    for (int32_t k = 0; k < n * n; k++) a[k] = fg_real_pick(good, a[k], fg_real_of(NAN));
}
"""

PLAIN = (
    """\
/* a x = b in place of b (n x m) in lanes with a symmetric positive matrix, which needs no exchange of rows;
   which those are */
static FG_INLINE fg_mask NAME(fg_real *a, fg_real *b, int32_t n, int32_t m) {
    fg_mask sound = fg_mask_of(-1);
    for (int32_t j = 0; j < n; j++) {
        for (int32_t i = j + 1; i < n; i++) {
            const fg_real apart = a[n * i + j] - a[n * j + i];
            sound &= (fg_mask)(apart * apart <= 1e-20 * (a[n * i + i] * a[n * j + j]));
        }
    }
    for (int32_t j = 0; j < n; j++) {
        sound &= (fg_mask)(a[n * j + j] > fg_real_of(0.0));
"""
    + eliminated("fg_real", "1.0")
    + "    }\n"
    + SUBSTITUTED
    + """\
    return sound;
}
"""
)

SOLVE = (
    """\
/* a x = b in place of b (n x m), by elimination with row exchange; NaN in lanes where a is singular */
static FG_APART void NAME(fg_real *a, fg_real *b, int32_t n, int32_t m) {
    fg_mask good = fg_mask_of(-1);
    for (int32_t j = 0; j < n; j++) {
        fg_real most = fg_real_size(a[n * j + j]);
        fg_long best = fg_long_of(j);
        for (int32_t i = j + 1; i < n; i++) {
            const fg_real size = fg_real_size(a[n * i + j]);
            const fg_mask wins = (fg_mask)(size > most);
            most = fg_real_pick(wins, size, most);
            best = fg_long_pick(wins, fg_long_of(i), best);
        }
        for (int32_t i = j + 1; i < n; i++) {
            const fg_mask here = (fg_mask)(best == fg_long_of(i));
            for (int32_t k = 0; k < n; k++) {
                const fg_real t = a[n * j + k];
                a[n * j + k] = fg_real_pick(here, a[n * i + k], t);
                a[n * i + k] = fg_real_pick(here, t, a[n * i + k]);
            }
            for (int32_t k = 0; k < m; k++) {
                const fg_real t = b[m * j + k];
                b[m * j + k] = fg_real_pick(here, b[m * i + k], t);
                b[m * i + k] = fg_real_pick(here, t, b[m * i + k]);
            }
        }
        good &= (fg_mask)(a[n * j + j] != fg_real_of(0.0));
"""
    + eliminated("fg_real", "1.0")
    + "    }\n"
    + SUBSTITUTED
    + """\
    for (int32_t k = 0; k < n * m; k++) b[k] = fg_real_pick(good, b[k], fg_real_of(NAN));
}
"""
)
