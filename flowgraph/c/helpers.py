"""Functions that generated C calls, each written out only where it is needed.

`exp`, `log`, `sin`, `cos` and `atan2` are here a second time, without branches and library calls, for
loops: a compiler turns them into vector instructions. They are Taylor series after a reduction of the
argument, good to about two units in the last place. Sine and cosine are for arguments up to 1.6e6, and NaN
beyond: in straight code they are those of math.h.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction
from typing import Any

from flowgraph.random import ROUNDS, segments

_PI = Fraction(31415926535897932384626433832795028841971693993751, 10**49)
_LN2 = Fraction(69314718055994530941723212145817656807550013436025, 10**50)


def _parts(value: Fraction, bits: tuple[int, ...]) -> list[str]:
    """A number as a sum of doubles with few bits each, so that products with small integers are exact."""
    found = []
    for b in bits:
        exponent = math.floor(math.log2(abs(float(value)))) if value else 0
        scale = Fraction(2) ** (b - 1 - exponent)
        part = Fraction(round(value * scale)) / scale
        found.append(repr(float(part)))
        value -= part
    return found


def _series(terms: list[Fraction], variable: str) -> str:
    """A polynomial in Horner's form."""
    text = repr(float(terms[-1]))
    for term in reversed(terms[:-1]):
        text = f"({text}) * {variable} + {float(term)!r}"
    return text.replace("+ -", "- ")


def _array(values: Any) -> str:
    numbers = [str(int(v)) for v in values]
    rows = [", ".join(numbers[k : k + 12]) for k in range(0, len(numbers), 12)]
    return "{\n    " + ",\n    ".join(rows) + "}"


def _texts(real: str) -> dict[str, tuple[tuple[str, ...], str]]:
    """Helper -> (what it needs, text)."""
    half_pi = _parts(_PI / 2, (33, 33, 53))
    ln2 = _parts(_LN2, (32, 53))
    factorial = [Fraction(1, math.factorial(k)) for k in range(20)]
    exp = _series(factorial[:14], "r")
    sine = _series([(-1) ** k * factorial[2 * k + 1] for k in range(9)], "z")
    cosine = _series([(-1) ** k * factorial[2 * k] for k in range(9)], "z")
    artanh = _series([Fraction(1, 2 * k + 3) for k in range(11)], "z")
    arctan = _series([Fraction((-1) ** k, 2 * k + 1) for k in range(21)], "z")
    start, slope = segments()
    f = "" if real == "double" else "f"
    found: dict[str, tuple[tuple[str, ...], str]] = {
        "fg_bits": (
            (),
            """static inline uint64_t fg_bits(double x) {
    union { double number; uint64_t bits; } both;
    both.number = x;
    return both.bits;
}
static inline double fg_from_bits(uint64_t x) {
    union { uint64_t bits; double number; } both;
    both.bits = x;
    return both.number;
}
""",
        ),
        "fg_exp": (
            ("fg_bits",),
            f"""/* exp(x): x = k log 2 + r, and the series of exp(r) */
static FG_INLINE double fg_exp(double x) {{
    const double c = x < -708.0 ? -708.0 : (x > 709.79 ? 709.79 : x);
    const double t = c * {1 / math.log(2)!r} + 6755399441055744.0;
    const double k = t - 6755399441055744.0;
    const double r = (c - k * {ln2[0]}) - k * {ln2[1]};
    const double p = {exp};
    const double y = p * fg_from_bits((fg_bits(t) + UINT64_C(1022)) << 52) * 2.0;
    return x < -708.0 ? 0.0 : y;
}}
""",
        ),
        "fg_log": (
            ("fg_bits",),
            f"""/* log(x): x = 2^k m with m near 1, and log(m) = 2 artanh((m - 1) / (m + 1)) */
static FG_INLINE double fg_log(double x) {{
    const bool small = x < 2.2250738585072014e-308;
    const uint64_t u = fg_bits(small ? x * 18014398509481984.0 : x);
    const uint64_t m = (u & UINT64_C(0xFFFFFFFFFFFFF)) | UINT64_C(0x3FF0000000000000);
    const double e = fg_from_bits((u >> 52) | UINT64_C(0x4330000000000000)) - 4503599627370496.0;
    const double a = fg_from_bits(m);
    const bool high = a > 1.4142135623730951;
    const double b = high ? 0.5 * a : a;
    const double k = e - 1023.0 + (high ? 1.0 : 0.0) - (small ? 54.0 : 0.0);
    const double s = (b - 1.0) / (b + 1.0);
    const double z = s * s;
    const double y = k * {ln2[0]} + (2.0 * s + (2.0 * s * z * ({artanh}) + k * {ln2[1]}));
    return x > 0.0 ? (x < INFINITY ? y : x) : (x == 0.0 ? -INFINITY : NAN);
}}
""",
        ),
        "fg_sincos": (
            ("fg_bits",),
            f"""/* sine and cosine on the quarter turn nearest to x; NaN where that cannot be told exactly */
static FG_INLINE double fg_sine(double r) {{
    const double z = r * r;
    return r * ({sine});
}}
static FG_INLINE double fg_cosine(double r) {{
    const double z = r * r;
    return {cosine};
}}
static FG_INLINE double fg_quarter(double x, uint64_t more) {{
    const double t = x * {2 / math.pi!r} + 6755399441055744.0;
    const double k = t - 6755399441055744.0;
    const double r = ((x - k * {half_pi[0]}) - k * {half_pi[1]}) - k * {half_pi[2]};
    const uint64_t q = fg_bits(t) + more;
    const double y = (q & 1u) ? fg_cosine(r) : fg_sine(r);
    return fabs(x) <= 1.6e6 ? ((q & 2u) ? -y : y) : NAN;
}}
""",
        ),
        "fg_sin": (
            ("fg_sincos",),
            "static FG_INLINE double fg_sin(double x) { return fg_quarter(x, 0u); }\n",
        ),
        "fg_cos": (
            ("fg_sincos",),
            "static FG_INLINE double fg_cos(double x) { return fg_quarter(x, 1u); }\n",
        ),
        "fg_atan2": (
            (),
            f"""/* atan2: the ratio in [0, 1], about 0 or about 45 degrees, and the series of arctan */
static FG_INLINE double fg_atan2(double y, double x) {{
    const double p = fabs(x), q = fabs(y);
    const double low = p < q ? p : q, high = p < q ? q : p;
    const bool both = !(high < INFINITY) && low == high;
    const double a = both ? 1.0 : low / (high > 0.0 ? high : 1.0);
    const bool upper = a > {math.tan(math.pi / 8)!r};
    const double b = upper ? (a - 1.0) / (a + 1.0) : a;
    const double z = b * b;
    const double c = b * ({arctan}) + (upper ? {math.pi / 4!r} : 0.0);
    const double d = p < q ? {math.pi / 2!r} - c : c;
    const double e = copysign(1.0, x) < 0.0 ? {math.pi!r} - d : d;
    return x != x || y != y ? NAN : copysign(e, y);
}}
""",
        ),
        "fg_whole": (
            (),
            """/* a whole number from a real one, without undefined behaviour outside the range */
static inline int64_t fg_whole(double x) {
    return (x >= -9223372036854775808.0 && x < 9223372036854775808.0) ? (int64_t)x : INT64_MIN;
}
""",
        ),
        "fg_clip": (
            (),
            """static inline int32_t fg_clip(int64_t at, int32_t size) {
    return (int32_t)(at < 0 ? 0 : (at >= size ? size - 1 : at));
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
            ("fg_remainder",),
            f"""static inline {real} fg_floor_divide({real} a, {real} b) {{
    return b == 0 ? a / b : rint{f}((a - fg_remainder(a, b)) / b);
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
        "fg_solve": (
            (),
            f"""/* a x = b in place of b (n x m), by elimination with row exchange; NaN where a is singular */
static FG_INLINE void fg_solve({real} *a, {real} *b, int32_t n, int32_t m) {{
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
        const {real} inverse = 1 / a[n * j + j];
        for (int32_t i = j + 1; i < n; i++) {{
            const {real} f = a[n * i + j] * inverse;
            for (int32_t k = j + 1; k < n; k++) a[n * i + k] -= f * a[n * j + k];
            for (int32_t k = 0; k < m; k++) b[m * i + k] -= f * b[m * j + k];
        }}
    }}
    for (int32_t j = n - 1; j >= 0; j--) {{
        for (int32_t i = j + 1; i < n; i++) {{
            for (int32_t k = 0; k < m; k++) b[m * j + k] -= a[n * j + i] * b[m * i + k];
        }}
        const {real} inverse = 1 / a[n * j + j];
        for (int32_t k = 0; k < m; k++) b[m * j + k] *= inverse;
    }}
}}
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
    return ({real})((bits & 1u) ? -size : size) * ({real})2.384185791015625e-07;
}}
""",
        ),
        "fg_one_uniform": (
            (),
            f"""static FG_INLINE {real} fg_one_uniform(uint32_t bits) {{
    return ({real})(int32_t)(bits >> 8) * ({real})5.9604644775390625e-08;
}}
""",
        ),
    }
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
        nan = " || (x != x && a[place + step - 1] == a[place + step - 1])" if kind == "r" else ""
        found[f"fg_search_{kind}"] = (
            (),
            f"""/* how many of n numbers in order come before x (or, on the right, do not come after it) */
static inline int64_t fg_search_{kind}(const {type_} *a, int32_t n, {type_} x, int right) {{
    int32_t place = 0, step = 1;
    while (step <= n / 2) step *= 2;
    for (; step > 0; step /= 2) {{
        if (place + step <= n && (a[place + step - 1] < x || (right && a[place + step - 1] == x){nan}))
            place += step;
    }}
    return place;
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


def helper_text(names: Iterable[str], real: str) -> str:
    """The helpers with what they need, each once and in order."""
    texts = _texts(real)
    made: list[str] = []
    seen: set[str] = set()

    def add(name: str) -> None:
        if name in seen:
            return
        seen.add(name)
        needs, text = texts[name]
        for n in needs:
            add(n)
        made.append(text)

    for name in sorted(names):
        add(name)
    return "\n".join(made)
