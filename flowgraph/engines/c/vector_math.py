"""Exponentials, logarithms and angles without branches and library calls, for loops: vector instructions.

A compiler makes one instruction for several turns of a loop only of what has no branch and calls nothing, and
of nothing that changes between double and float. So each function is here for both, in its own precision:
a reduction of the argument, and as much of a Taylor series as the precision asks for. They are good to about
two units in the last place. Sine and cosine are for arguments up to 1.6e6 in double and 1e5 in float, where
neighbouring numbers are 0.008 apart, and NaN beyond. In straight code the functions are those of math.h.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

from flowgraph.engines.c.syntax import number

_PI = Fraction(31415926535897932384626433832795028841971693993751, 10**49)
_LN2 = Fraction(69314718055994530941723212145817656807550013436025, 10**50)


@dataclass(frozen=True)
class _Format:
    """A floating-point format, and how far its series go.

    Args:
        bits, mantissa, bias: its width, the bits after the point, and the exponent's offset.
        half_pi, ln2: significant bits of the parts in which the constant is subtracted.
        exp, sine, artanh, arctan: terms of each series; `sine` is that of the cosine, too.
        low, high: arguments between which exp is written out: below it is 0, above infinite.
        most: largest argument of sine and cosine.
    """

    bits: int
    mantissa: int
    bias: int
    half_pi: tuple[int, ...]
    ln2: tuple[int, int]
    exp: int
    sine: int
    artanh: int
    arctan: int
    low: float
    high: float
    most: float


_FORMATS = {
    "double": _Format(64, 52, 1023, (33, 33, 53), (32, 53), 14, 9, 11, 21, -708.0, 709.79, 1.6e6),
    "float": _Format(32, 23, 127, (8, 8, 8, 24), (15, 24), 8, 6, 5, 10, -86.98, 88.73, 1e5),
}


def _parts(value: Fraction, bits: tuple[int, ...]) -> list[float]:
    """A number as a sum of numbers with few bits each, so that products with small integers are exact."""
    found = []
    for b in bits:
        exponent = math.floor(math.log2(abs(float(value)))) if value else 0
        scale = Fraction(2) ** (b - 1 - exponent)
        part = Fraction(round(value * scale)) / scale
        found.append(float(part))
        value -= part
    return found


def vector_texts(real: str) -> dict[str, tuple[tuple[str, ...], str]]:
    """Helper -> (what it needs, text), for "double" or "float"."""
    form = _FORMATS[real]
    f = "" if real == "double" else "f"
    word, one = f"uint{form.bits}_t", 1 << form.mantissa
    rounds = 3.0 * 2.0 ** (form.mantissa - 1)  # added, it leaves the whole number in the last bits

    def n(value: float | Fraction) -> str:
        return number(float(value), "real", real)

    def u(value: int) -> str:
        return f"UINT{form.bits}_C(0x{value:X})"

    def series(terms: Sequence[Fraction], variable: str) -> str:
        """A polynomial in Horner's form."""
        text = n(terms[-1])
        for term in reversed(terms[:-1]):
            text = f"({text}) * {variable} + {n(term)}"
        return text.replace("+ -", "- ").replace("+ (-", "+ (-")

    factorial = [Fraction(1, math.factorial(k)) for k in range(20)]
    sine = series([(-1) ** k * factorial[2 * k + 1] for k in range(form.sine)], "z")
    cosine = series([(-1) ** k * factorial[2 * k] for k in range(form.sine)], "z")
    artanh = series([Fraction(1, 2 * k + 3) for k in range(form.artanh)], "z")
    arctan = series([Fraction((-1) ** k, 2 * k + 1) for k in range(form.arctan)], "z")
    ln2 = [n(p) for p in _parts(_LN2, form.ln2)]
    rest = "x"
    for p in _parts(_PI / 2, form.half_pi):
        rest = f"({rest} - k * {n(p)})"
    whole = (form.bias + form.mantissa) * one  # the bits of a number whose last bit is worth one
    tiny, lift = 2.0 ** (2 - form.bias - 1), form.mantissa + 2
    start = f"""/* {{what}} */
static FG_INLINE {real} {{name}}"""
    return {
        "fg_bits": (
            (),
            f"""static inline {word} fg_bits({real} x) {{
    union {{ {real} number; {word} bits; }} both;
    both.number = x;
    return both.bits;
}}
""",
        ),
        "fg_from_bits": (
            (),
            f"""static inline {real} fg_from_bits({word} x) {{
    union {{ {word} bits; {real} number; }} both;
    both.bits = x;
    return both.number;
}}
""",
        ),
        "fg_exp": (
            ("fg_bits", "fg_from_bits"),
            start.format(what="exp(x): x = k log 2 + r, and the series of exp(r)", name="fg_exp")
            + f"""({real} x) {{
    const {real} c = x < {n(form.low)} ? {n(form.low)} : (x > {n(form.high)} ? {n(form.high)} : x);
    const {real} t = c * {n(1 / math.log(2))} + {n(rounds)};
    const {real} k = t - {n(rounds)};
    const {real} r = (c - k * {ln2[0]}) - k * {ln2[1]};
    const {real} p = {series(factorial[: form.exp], "r")};
    const {real} y = p * fg_from_bits((fg_bits(t) + {u(form.bias - 1)}) << {form.mantissa}) * {n(2.0)};
    return x < {n(form.low)} ? {n(0.0)} : y;
}}
""",
        ),
        "fg_log": (
            ("fg_bits", "fg_from_bits"),
            start.format(
                what="log(x): x = 2^k m with m near 1, and log(m) = 2 artanh((m - 1) / (m + 1))",
                name="fg_log",
            )
            + f"""({real} x) {{
    const bool small = x < {n(tiny)};
    const {word} u = fg_bits(small ? x * {n(2.0**lift)} : x);
    const {word} m = (u & {u(one - 1)}) | {u(form.bias * one)};
    const {real} e = fg_from_bits((u >> {form.mantissa}) | {u(whole)}) - {n(one)};
    const {real} a = fg_from_bits(m);
    const bool high = a > {n(math.sqrt(2.0))};
    const {real} b = high ? {n(0.5)} * a : a;
    const {real} l = small ? {n(form.bias + lift)} : {n(form.bias)};
    const {real} k = e - l + (high ? {n(1.0)} : {n(0.0)});
    const {real} s = (b - {n(1.0)}) / (b + {n(1.0)});
    const {real} z = s * s;
    const {real} y = k * {ln2[0]} + ({n(2.0)} * s + ({n(2.0)} * s * z * ({artanh}) + k * {ln2[1]}));
    return x > {n(0.0)} ? (x < INFINITY ? y : x) : (x == {n(0.0)} ? -INFINITY : NAN);
}}
""",
        ),
        "fg_sincos": (
            ("fg_bits", "fg_from_bits"),
            start.format(
                what="sine and cosine on the quarter turn nearest to x; NaN where it cannot be told exactly",
                name="fg_sine",
            )
            + f"""({real} r) {{
    const {real} z = r * r;
    return r * ({sine});
}}
static FG_INLINE {real} fg_cosine({real} r) {{
    const {real} z = r * r;
    return {cosine};
}}
static FG_INLINE {real} fg_quarter({real} x, {word} more) {{
    const {real} t = x * {n(2 / math.pi)} + {n(rounds)};
    const {real} k = t - {n(rounds)};
    const {real} r = {rest};
    const {word} q = fg_bits(t) + more, odd = 0u - (q & 1u);
    const {word} y = (fg_bits(fg_cosine(r)) & odd) | (fg_bits(fg_sine(r)) & ~odd); /* by no branch */
    return fabs{f}(x) <= {n(form.most)} ? fg_from_bits(y ^ ((q & 2u) << {form.bits - 2})) : NAN;
}}
""",
        ),
        "fg_sin": (
            ("fg_sincos",),
            f"static FG_INLINE {real} fg_sin({real} x) {{ return fg_quarter(x, 0u); }}\n",
        ),
        "fg_cos": (
            ("fg_sincos",),
            f"static FG_INLINE {real} fg_cos({real} x) {{ return fg_quarter(x, 1u); }}\n",
        ),
        "fg_atan2": (
            (),
            start.format(
                what="atan2: the ratio in [0, 1], about 0 or about 45 degrees, and the series of arctan",
                name="fg_atan2",
            )
            + f"""({real} y, {real} x) {{
    const {real} p = fabs{f}(x), q = fabs{f}(y);
    const {real} low = p < q ? p : q, high = p < q ? q : p;
    const bool both = !(high < INFINITY) && low == high;
    const {real} a = both ? {n(1.0)} : low / (high > {n(0.0)} ? high : {n(1.0)});
    const bool upper = a > {n(math.tan(math.pi / 8))};
    const {real} b = upper ? (a - {n(1.0)}) / (a + {n(1.0)}) : a;
    const {real} z = b * b;
    const {real} c = b * ({arctan}) + (upper ? {n(math.pi / 4)} : {n(0.0)});
    const {real} d = p < q ? {n(math.pi / 2)} - c : c;
    const {real} e = copysign{f}({n(1.0)}, x) < {n(0.0)} ? {n(math.pi)} - d : d;
    return x != x || y != y ? NAN : copysign{f}(e, y);
}}
""",
        ),
    }
