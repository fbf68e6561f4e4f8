"""Functions that generated C calls, each written out only where it is needed.

Those that a loop calls in place of math.h are in `vector_math`.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from flowgraph.engines.c.elimination import SUBSTITUTED, eliminated
from flowgraph.engines.c.syntax import number
from flowgraph.engines.c.vector_math import vector_texts
from flowgraph.recorder.random import ROUNDS, segments


def _array(values: Any) -> str:
    numbers = [str(int(v)) for v in values]
    rows = [", ".join(numbers[k : k + 12]) for k in range(0, len(numbers), 12)]
    return "{\n    " + ",\n    ".join(rows) + "}"


def _texts(real: str) -> dict[str, tuple[tuple[str, ...], str]]:
    """Helper -> (what it needs, text)."""
    start, slope = segments()
    f = "" if real == "double" else "f"
    unit, step, half = (number(x, "real", real) for x in (2.0**-22, 2.0**-24, 0.5))
    even = number(1e-20 if real == "double" else 1e-8, "real", real)
    found: dict[str, tuple[tuple[str, ...], str]] = {
        **vector_texts(real),
        **vector_texts("fg_real"),  # for lanes
        "fg_clip": (
            (),
            """static inline int32_t fg_clip(int64_t at, int32_t size) {
    return (int32_t)(at < 0 ? 0 : (at >= size ? size - 1 : at));
}
""",
        ),
        "fg_clip_32": (
            (),
            """static inline int32_t fg_clip_32(int32_t at, int32_t size) {
    return at < 0 ? 0 : (at >= size ? size - 1 : at);
}
""",
        ),
        "fg_float_bits": (
            (),
            """static inline int32_t fg_float_bits(int32_t x) {
    union { float number; int32_t bits; } both;
    both.number = (float)x;
    return both.bits;
}
""",
        ),
        "fg_floor_divide": (
            (),
            f"""/* the quotient rounded down */
static inline {real} fg_floor_divide({real} a, {real} b) {{
    const {real} r = fmod{f}(a, b);
    const {real} q = (a - r) / b - (r != 0 && (r < 0) != (b < 0));
    const {real} down = floor{f}(q);
    if (b == 0) return a / b;
    return q != 0 ? (q - down > {half} ? down + 1 : down) : copysign{f}(0, a / b);
}}
""",
        ),
        "fg_remainder": (
            (),
            f"""/* the remainder that has the divisor's sign */
static inline {real} fg_remainder({real} a, {real} b) {{
    const {real} r = fmod{f}(a, b);
    return r != 0 ? ((r < 0) != (b < 0) ? r + b : r) : copysign{f}(0, b);
}}
""",
        ),
        "fg_floor_divide_i": (
            (),
            """static inline int64_t fg_floor_divide_i(int64_t a, int64_t b) {
    if (b == 0) return 0;
    if (b == -1) return (int64_t)(0u - (uint64_t)a);
    return a / b - ((a % b != 0) && ((a < 0) != (b < 0)));
}
""",
        ),
        "fg_remainder_i": (
            (),
            """static inline int64_t fg_remainder_i(int64_t a, int64_t b) {
    if (b == 0 || b == -1) return 0;
    const int64_t r = a % b;
    return r != 0 && ((r < 0) != (b < 0)) ? r + b : r;
}
""",
        ),
        "fg_floor_divide_u": (
            (),
            "static inline uint64_t fg_floor_divide_u(uint64_t a, uint64_t b) { return b ? a / b : 0; }\n",
        ),
        "fg_remainder_u": (
            (),
            "static inline uint64_t fg_remainder_u(uint64_t a, uint64_t b) { return b ? a % b : 0; }\n",
        ),
        "fg_cholesky": (
            (),
            f"""/* lower factor in place, of the lower triangle; NaN where that is not positive definite */
static FG_INLINE void fg_cholesky({real} *a, int32_t n) {{
    for (int32_t j = 0; j < n; j++) {{
        {real} d = a[n * j + j];
        for (int32_t k = 0; k < j; k++) d -= a[n * j + k] * a[n * j + k];
        if (!(d > 0)) {{
            for (int32_t k = 0; k < n * n; k++) a[k] = NAN;
            return;
        }}
        const {real} root = sqrt{f}(d);
        a[n * j + j] = root;
        for (int32_t i = j + 1; i < n; i++) {{
            {real} s = a[n * i + j];
            for (int32_t k = 0; k < j; k++) s -= a[n * i + k] * a[n * j + k];
            a[n * i + j] = s / root;
            a[n * j + i] = 0;
        }}
    }}
}}
""",
        ),
        "fg_solve_plain": (
            (),
            f"""/* a x = b in place of b (n x m), without exchange of rows; whether the matrix is one that
   needs none: symmetric and positive */
static FG_INLINE bool fg_solve_plain({real} *a, {real} *b, int32_t n, int32_t m) {{
    bool sound = true;
    for (int32_t j = 0; j < n; j++) {{
        for (int32_t i = j + 1; i < n; i++) {{
            const {real} apart = a[n * i + j] - a[n * j + i];
            sound = sound && apart * apart <= {even} * (a[n * i + i] * a[n * j + j]);
        }}
    }}
    if (!sound) return false;
    for (int32_t j = 0; j < n; j++) {{
        sound = sound && a[n * j + j] > 0;
{eliminated(real, "1")}    }}
{SUBSTITUTED}    return sound;
}}
""",
        ),
        "fg_solve": (
            (),
            f"""/* a x = b in place of b (n x m), by elimination with row exchange; NaN where a is singular */
static FG_APART void fg_solve({real} *a, {real} *b, int32_t n, int32_t m) {{
    for (int32_t j = 0; j < n; j++) {{
        int32_t best = j;
        for (int32_t i = j + 1; i < n; i++) {{
            if (fabs{f}(a[n * i + j]) > fabs{f}(a[n * best + j])) best = i;
        }}
        if (best != j) {{
            for (int32_t k = 0; k < n; k++) {{
                const {real} t = a[n * j + k];
                a[n * j + k] = a[n * best + k];
                a[n * best + k] = t;
            }}
            for (int32_t k = 0; k < m; k++) {{
                const {real} t = b[m * j + k];
                b[m * j + k] = b[m * best + k];
                b[m * best + k] = t;
            }}
        }}
        if (a[n * j + j] == 0) {{
            for (int32_t k = 0; k < n * m; k++) b[k] = NAN;
            return;
        }}
{eliminated(real, "1")}    }}
{SUBSTITUTED}}}
""",
        ),
        "fg_philox": (
            (),
            """/* Philox4x32: even holds counter words 0 and 2, odd 1 and 3 */
static FG_INLINE void fg_philox(uint32_t even[2], uint32_t odd[2], uint32_t key0, uint32_t key1) {
    for (int32_t r = 0; r < ROUNDS; r++) {
        const uint64_t p = (uint64_t)even[0] * UINT32_C(0xD2511F53);
        const uint64_t q = (uint64_t)even[1] * UINT32_C(0xCD9E8D57);
        even[0] = (uint32_t)(q >> 32) ^ odd[0] ^ (key0 + UINT32_C(0x9E3779B9) * (uint32_t)r);
        even[1] = (uint32_t)(p >> 32) ^ odd[1] ^ (key1 + UINT32_C(0xBB67AE85) * (uint32_t)r);
        odd[0] = (uint32_t)q;
        odd[1] = (uint32_t)p;
    }
}
""".replace("ROUNDS", str(ROUNDS)),
        ),
        "fg_normal_tables": (
            (),
            "/* start and fall of each segment of the normal quantile, in units of 2^-22 */\n"
            f"static const int32_t fg_normal_start[{len(start)}] = {_array(start)};\n"
            f"static const int32_t fg_normal_fall[{len(slope)}] = {_array(slope)};\n",
        ),
        "fg_one_normal": (
            ("fg_normal_tables", "fg_float_bits"),
            f"""static FG_INLINE {real} fg_one_normal(uint32_t bits) {{
    const int32_t form = fg_float_bits((int32_t)((bits >> 1) | 1u));
    const int32_t segment = (form >> 17) - 8128;
    const int32_t place = (form & 0x1FFFF) >> 3;
    const int32_t fall = (fg_normal_fall[segment] * place + 8192) >> 14;
    const int32_t size = fg_normal_start[segment] - fall;
    return ({real})((bits & 1u) ? -size : size) * {unit};
}}
""",
        ),
        "fg_one_uniform": (
            (),
            f"""static FG_INLINE {real} fg_one_uniform(uint32_t bits) {{
    return ({real})(int32_t)(bits >> 8) * {step};
}}
""",
        ),
    }
    for kind in ("int32", "int64", "uint32", "uint64"):
        limits = np.iinfo(kind)
        low, over = (number(float(x), "real", real) for x in (limits.min, limits.max + 1))
        name = f"UINT{limits.bits}" if kind.startswith("u") else f"INT{limits.bits}"
        least = "0" if kind.startswith("u") else f"{name}_MIN"
        found[f"fg_whole_{kind}"] = (
            (),
            f"""/* a whole number from a real one: the nearest there is, and 0 for NaN */
static inline {kind}_t fg_whole_{kind}({real} x) {{
    return x >= {low} ? (x < {over} ? ({kind}_t)x : {name}_MAX) : (x < {low} ? {least} : 0);
}}
""",
        )
    for kind in ("normal", "uniform"):
        found[f"fg_{kind}"] = (
            ("fg_philox", f"fg_one_{kind}"),
            f"""/* 4 n random numbers of a name (its hash) at a time */
static inline void fg_{kind}({real} *restrict out, int32_t n, uint32_t hash, int64_t time, uint32_t seed0,
                             uint32_t seed1) {{
    const uint32_t low = (uint32_t)(uint64_t)time, high = (uint32_t)((uint64_t)time >> 32);
    FG_SIMD(omp simd)
    for (int32_t i = 0; i < n; i++) {{
        uint32_t even[2] = {{(uint32_t)i, low}}, odd[2] = {{hash, high}};
        fg_philox(even, odd, seed0, seed1);
        out[i] = fg_one_{kind}(even[0]);
        out[n + i] = fg_one_{kind}(even[1]);
        out[2 * n + i] = fg_one_{kind}(odd[0]);
        out[3 * n + i] = fg_one_{kind}(odd[1]);
    }}
}}
""",
        )
    for kind, type_ in {
        "r": real,
        "b": "bool",
        **{k: f"{k}_t" for k in ("int32", "int64", "uint32", "uint64")},
    }.items():
        nan = " || (x != x && y == y)" if kind == "r" else ""
        found[f"fg_before_{kind}"] = (
            (),
            f"""static inline bool fg_before_{kind}({type_} y, {type_} x, int right) {{
    return y < x || (right && y == x){nan};
}}
""",
        )
        found[f"fg_search_{kind}"] = (
            (f"fg_before_{kind}",),
            f"""/* how many of n numbers in order come before x (or, on the right, do not come after it) */
static inline int64_t fg_search_{kind}(const {type_} *a, int32_t n, {type_} x, int right) {{
    int32_t place = 0, step = 1;
    while (step <= n / 2) step *= 2;
    for (; step > 0; step /= 2) {{
        if (place + step <= n && fg_before_{kind}(a[place + step - 1], x, right)) place += step;
    }}
    return place;
}}
""",
        )
        found[f"fg_search_near_{kind}"] = (
            (f"fg_before_{kind}", f"fg_search_{kind}"),
            f"""/* the same, first a few steps on from the last place: enough where x comes in order */
static inline int64_t fg_search_near_{kind}(
    const {type_} *a, int32_t n, {type_} x, int right, int32_t *near)
{{
    int32_t place = *near;
    const int32_t end = n - place > 8 ? place + 8 : n;
    if (place == 0 || fg_before_{kind}(a[place - 1], x, right)) {{
        for (; place < end && fg_before_{kind}(a[place], x, right); place++) {{}}
        if (place < end || place == n) return *near = place;
    }}
    return *near = (int32_t)fg_search_{kind}(a, n, x, right);
}}
""",
        )
    for sign, type_ in (("i", "int64_t"), ("u", "uint64_t")):
        found[f"fg_pow_{sign}"] = (
            (),
            f"""static inline {type_} fg_pow_{sign}({type_} a, {type_} b) {{
    uint64_t base = (uint64_t)a, made = 1;
    for (uint64_t n = (uint64_t)b; n != 0; n >>= 1) {{
        if (n & 1u) made *= base;
        base *= base;
    }}
    return ({type_})made;
}}
""",
        )
    return found


def helper_text(names: Iterable[str], real: str, there: Iterable[str] = ()) -> str:
    """The helpers with what they need, each once and in order; not those that are `there` already."""
    texts = _texts(real)
    made: dict[str, str] = {}

    def add(name: str, into: dict[str, str]) -> None:
        if name in made or name in into:
            return
        needs, text = texts[name]
        for n in needs:
            add(n, into)
        into[name] = text

    for name in sorted(there):
        add(name, made)
    wanted: dict[str, str] = {}
    for name in sorted(names):
        add(name, wanted)
    return "\n".join(wanted.values())


def own_text(called: Iterable[str], there: Iterable[str], real: str) -> str | None:
    """What puts our own functions in the place of those of math.h, for who defines FLOWGRAPH_OWN_MATH.

    Libraries differ in the last bit of a sine; this text does not.
    """
    names = sorted(called)
    if not names:
        return None
    f = "" if real == "double" else "f"
    text = helper_text([f"fg_{n}" for n in names], real, there)
    lines = [f"#define {n}{f} fg_{n}" for n in names]
    return "\n".join(
        ["#ifdef FLOWGRAPH_OWN_MATH /* the same numbers with every library */", text, *lines, "#endif", ""]
    )
