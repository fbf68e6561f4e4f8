"""Exponentials, logarithms and angles without branches and library calls, for loops: vector instructions.

A compiler makes one instruction for several turns of a loop only of what has no branch and calls nothing, and
of nothing that changes between double and float. So each function is here for both, in its own precision:
a reduction of the argument, and as much of a Taylor series as the precision asks for. They are good to about
two units in the last place. Sine and cosine are for arguments up to 1.6e6 in double and 1e5 in float, where
neighbouring numbers are 0.008 apart, and NaN beyond. In straight code the functions are those of math.h.

The lanes of several runs have the same functions on vectors of doubles. There a sine and a cosine of one
angle stand in straight code, where a compiler sees that they share all but the last choice.
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


def vector_texts(kind: str) -> dict[str, tuple[tuple[str, ...], str]]:
    """Helper -> (what it needs, text), for "double" or "float", or for "fg_real", a vector of doubles."""
    lanes = kind == "fg_real"
    real = "double" if lanes else kind  # of one number
    form = _FORMATS[real]
    f = "" if real == "double" else "f"
    word, one = "fg_ulong" if lanes else f"uint{form.bits}_t", 1 << form.mantissa
    truth = "fg_mask" if lanes else "bool"
    rounds = 3.0 * 2.0 ** (form.mantissa - 1)  # added, it leaves the whole number in the last bits

    def n(value: float | Fraction) -> str:
        return number(float(value), "real", real)

    def u(value: int) -> str:
        return f"UINT{form.bits}_C(0x{value:X})"

    def full(text: str) -> str:
        """A number as it stands for itself: in all lanes."""
        return f"fg_real_of({text})" if lanes else text

    def pick(condition: str, yes: str, no: str) -> str:
        return f"fg_real_pick({condition}, {yes}, {no})" if lanes else f"({condition} ? {yes} : {no})"

    def holds(text: str) -> str:
        """A comparison as a truth."""
        return f"(fg_mask)({text})" if lanes else f"({text})"

    def size(text: str) -> str:
        return f"fg_real_size({text})" if lanes else f"fabs{f}({text})"

    def signed(text: str, like: str) -> str:
        """A number that is not negative, with the sign of another."""
        if not lanes:
            return f"copysign{f}({text}, {like})"
        return f"{called('from_bits')}({called('bits')}({text}) | ({called('bits')}({like}) & {u(1 << 63)}))"

    def called(name: str) -> str:
        return f"fg_lanes_{name}" if lanes else f"fg_{name}"

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
    bits, from_bits, zero, infinite = called("bits"), called("from_bits"), full(n(0.0)), full("INFINITY")
    start = f"""/* {{what}} */
static FG_INLINE {kind} {{name}}"""
    if lanes:
        casts = {
            bits: "static FG_INLINE fg_ulong NAME(fg_real x) { return (fg_ulong)x; }\n",
            from_bits: "static FG_INLINE fg_real NAME(fg_ulong x) { return (fg_real)x; }\n",
        }
    else:
        casts = {
            bits: f"""static inline {word} NAME({real} x) {{
    union {{ {real} number; {word} bits; }} both;
    both.number = x;
    return both.bits;
}}
""",
            from_bits: f"""static inline {real} NAME({word} x) {{
    union {{ {word} bits; {real} number; }} both;
    both.bits = x;
    return both.number;
}}
""",
        }
    return {
        **{name: ((), text.replace("NAME", name)) for name, text in casts.items()},
        called("exp"): (
            (bits, from_bits),
            start.format(what="exp(x): x = k log 2 + r, and the series of exp(r)", name=called("exp"))
            + f"""({kind} x) {{
    const {truth} low = {holds(f"x < {n(form.low)}")}, high = {holds(f"x > {n(form.high)}")};
    const {kind} c = {pick("low", full(n(form.low)), pick("high", full(n(form.high)), "x"))};
    const {kind} t = c * {n(1 / math.log(2))} + {n(rounds)};
    const {kind} k = t - {n(rounds)};
    const {kind} r = (c - k * {ln2[0]}) - k * {ln2[1]};
    const {kind} p = {series(factorial[: form.exp], "r")};
    const {kind} y = p * {from_bits}(({bits}(t) + {u(form.bias - 1)}) << {form.mantissa}) * {n(2.0)};
    return {pick("low", zero, "y")};
}}
""",
        ),
        called("log"): (
            (bits, from_bits),
            start.format(
                what="log(x): x = 2^k m with m near 1, and log(m) = 2 artanh((m - 1) / (m + 1))",
                name=called("log"),
            )
            + f"""({kind} x) {{
    const {truth} small = {holds(f"x < {n(tiny)}")};
    const {word} u = {bits}({pick("small", f"x * {n(2.0**lift)}", "x")});
    const {word} m = (u & {u(one - 1)}) | {u(form.bias * one)};
    const {kind} e = {from_bits}((u >> {form.mantissa}) | {u(whole)}) - {n(one)};
    const {kind} a = {from_bits}(m);
    const {truth} high = {holds(f"a > {n(math.sqrt(2.0))}")};
    const {kind} b = {pick("high", f"{n(0.5)} * a", "a")};
    const {kind} l = {pick("small", full(n(form.bias + lift)), full(n(form.bias)))};
    const {kind} k = e - l + {pick("high", full(n(1.0)), zero)};
    const {kind} s = (b - {n(1.0)}) / (b + {n(1.0)});
    const {kind} z = s * s;
    const {kind} y = k * {ln2[0]} + ({n(2.0)} * s + ({n(2.0)} * s * z * ({artanh}) + k * {ln2[1]}));
    return {
                pick(
                    holds(f"x > {n(0.0)}"),
                    pick(holds("x < INFINITY"), "y", "x"),
                    pick(holds(f"x == {n(0.0)}"), f"-{infinite}", full("NAN")),
                )
            };
}}
""",
        ),
        called("sincos"): (
            (bits, from_bits),
            start.format(
                what="sine and cosine on the quarter turn nearest to x; NaN where it cannot be told exactly",
                name=called("sine"),
            )
            + f"""({kind} r) {{
    const {kind} z = r * r;
    return r * ({sine});
}}
static FG_INLINE {kind} {called("cosine")}({kind} r) {{
    const {kind} z = r * r;
    return {cosine};
}}
static FG_INLINE {kind} {called("quarter")}({kind} x, uint{form.bits}_t more) {{
    const {kind} t = x * {n(2 / math.pi)} + {n(rounds)};
    const {kind} k = t - {n(rounds)};
    const {kind} r = {rest};
    const {word} q = {bits}(t) + more, odd = 0u - (q & 1u);
    const {word} y = ({bits}({called("cosine")}(r)) & odd) | ({bits}({
                called("sine")
            }(r)) & ~odd); /* by no branch */
    return {
                pick(
                    holds(f"{size('x')} <= {n(form.most)}"),
                    f"{from_bits}(y ^ ((q & 2u) << {form.bits - 2}))",
                    full("NAN"),
                )
            };
}}
""",
        ),
        called("sin"): (
            (called("sincos"),),
            f"static FG_INLINE {kind} {called('sin')}({kind} x) {{ return {called('quarter')}(x, 0u); }}\n",
        ),
        called("cos"): (
            (called("sincos"),),
            f"static FG_INLINE {kind} {called('cos')}({kind} x) {{ return {called('quarter')}(x, 1u); }}\n",
        ),
        called("atan2"): (
            (bits, from_bits),
            start.format(
                what="atan2: the ratio in [0, 1], about 0 or about 45 degrees, and the series of arctan",
                name=called("atan2"),
            )
            + f"""({kind} y, {kind} x) {{
    const {kind} p = {size("x")}, q = {size("y")};
    const {truth} steep = {holds("p < q")};
    const {kind} low = {pick("steep", "p", "q")}, high = {pick("steep", "q", "p")};
    const {truth} endless = {holds("high == INFINITY")}, alike = {holds("low == high")};
    const {kind} l = {pick("endless", pick("alike", full(n(1.0)), zero), "low")};
    const {kind} h = {pick("endless", full(n(1.0)), pick(holds(f"high > {n(0.0)}"), "high", full(n(1.0))))};
    const {truth} upper = {holds(f"l > {n(math.tan(math.pi / 8))} * h")};
    const {kind} b = {pick("upper", "l - h", "l")} / {pick("upper", "l + h", "h")};
    const {kind} z = b * b;
    const {kind} c = b * ({arctan}) + {pick("upper", full(n(math.pi / 4)), zero)};
    const {kind} d = {pick("steep", f"{n(math.pi / 2)} - c", "c")};
    const {kind} e = {pick(holds(f"{signed(full(n(1.0)), 'x')} < {n(0.0)}"), f"{n(math.pi)} - d", "d")};
    return {pick(holds("x != x") + " | " + holds("y != y"), full("NAN"), signed("e", "y"))};
}}
""",
        ),
    }
