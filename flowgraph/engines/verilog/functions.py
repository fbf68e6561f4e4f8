"""Functions as sums: the sequences of `flowgraph.engines.fixed.integers`, step by step.

Polynomials are sums one after the other. Quotients, roots, the digits of logarithms and the turns of CORDIC
are made by units beside, which are given numbers brought to full length.
"""

from __future__ import annotations

import abc

import numpy as np

from flowgraph.engines.fixed import integers as z
from flowgraph.engines.verilog.bounds import proved
from flowgraph.engines.verilog.nodes import Term
from flowgraph.engines.verilog.rows import Rows
from flowgraph.errors import LoweringError


class Functions(Rows, abc.ABC):
    """Nodes that know functions of one element."""

    @property
    def zero(self) -> int:
        return self.constant(0)

    def plain(self, a: int, by: int = 0, minus: bool = False) -> Term:
        """A word itself, shifted."""
        return Term("MUL", a, self.one, by, minus)

    def quotient(self, a: int, b: int, up: int) -> int:
        """(a / b) 2^up."""
        begun = self.begin("divide", [Term("NORM", a, self.one, -62), Term("NORM", b, self.one, -31)])
        return self.take(begun, shift=31 - up)

    def rest(self, a: int, b: int, p: int, q: int, end: int) -> int:
        """The remainder of a 2^-p by b 2^-q, for shifts to the left, with the sign of b; 0 for b = 0."""
        _, rest, turned = self._divided(a, b, p, q)
        return self.sum([Term("SEL", self.sum([self.plain(rest), Term("SEL", b, turned, q)], end=end), b)])

    def floor_quotient(self, a: int, b: int, p: int, q: int, end: int) -> int:
        """a 2^-p by b 2^-q rounded down, for shifts to the left, then shifted; 0 for b = 0."""
        quotient, _, turned = self._divided(a, b, p, q)
        made = self.sum([self.plain(quotient), self.plain(turned, 0, True)], end=end)
        return self.sum([Term("SEL", made, b)])

    @proved
    def _divided(self, a: int, b: int, p: int, q: int) -> tuple[int, int, int]:
        """The quotient rounded towards zero, what it leaves, and whether that has not the sign of b.

        The quotient fits a word: arguments of `remainder` are not 2^30 times the divisor.
        """
        begun = self.begin("divide", [Term("NORM", a, self.one, -62), Term("NORM", b, self.one, -31)])
        quotient = self.take(begun, shift=31 + p - q, mode="RAW", floor=True)
        rest = self.sum([self.plain(a, p), Term("MUL", quotient, b, q, True)], mode="RAW")
        below, b_below = (self.sum([self.plain(x)], mode="LT") for x in (rest, b))
        other = self.sum([Term("XOR", below, b_below)], mode="RAW")
        some = self.sum([self.plain(rest)], mode="NE")
        return quotient, rest, self.sum([Term("SEL", other, some)], mode="RAW")

    def square_root(self, x: int, fraction: int, out: int) -> int:
        known = self.known(x)
        if known is not None:
            return self._folded(z.square_root(np.int64(known), np.int64(fraction), np.int64(out)))
        begun = self.begin("root", [Term("NORM_EVEN", x, self.one, -62)], odd=bool(fraction & 1))
        return self.take(begun, shift=((fraction + 62) >> 1) - out)

    def _folded(self, made: np.ndarray) -> int:
        most = (1 << (self.now - 1)) - 1
        return self.constant(max(min(int(made), most), -most))

    def _polynomial(self, coefficients: list[int], u: int) -> int:
        total = self.constant(coefficients[-1])
        for c in reversed(coefficients[:-1]):
            total = self.sum([Term("MUL", total, u, 30), self.plain(self.constant(c))], mode="RAW")
        return total

    @proved
    def sine(self, x: int, fraction: int, out: int, ahead: int, mode: str = "FIT") -> int:
        known = self.known(x)
        if known is not None:
            f, o = np.int64(fraction), np.int64(out)
            return self._folded(z.sine(np.int64(known), f, o, ahead=ahead))
        self._whole_turns("sin" if not ahead else "cos", fraction)
        turns = Term("MUL", x, self.constant(z.QUARTER_TURNS), fraction + 1)
        n = self.sum([turns], end=30, mode="RAW")
        r = self.sum([turns, self.plain(n, -30, True)], mode="RAW")
        u = self.sum([Term("MUL", r, r, 30)], mode="RAW")
        sinc, cosine = self._polynomial(z.SINC, u), self._polynomial(z.COSINE, u)
        turned = self.sum([Term("MUL", r, self.constant(z.QUARTER), 30)], mode="RAW")
        sin = self.sum([Term("MUL", turned, sinc, 60 - out)], mode=mode)
        cos = self.sum([self.plain(cosine, 30 - out)], mode=mode)
        if ahead:
            n = self.sum([self.plain(n), self.plain(self.one)], mode="RAW")
        else:
            small = self.sum([Term("MUL", x, sinc, fraction + 30 - out)], mode=mode)
            sin = self.sum([Term("SEL", sin, n), Term("SELN", small, n)], mode=mode)
        odd = self.sum([Term("AND", n, self.one)], mode="RAW")
        value = self.sum([Term("SEL", cos, odd), Term("SELN", sin, odd)], mode=mode)
        back = self.sum([Term("AND", n, self.constant(2))], mode="RAW")
        return self.sum([Term("SEL", value, back, 0, True), Term("SELN", value, back)], mode=mode)

    @proved
    def sinc(self, x: int, fraction: int, out: int) -> int:
        """sin(x) / x: as a polynomial near 0, as a quotient elsewhere."""
        known = self.known(x)
        if known is not None:
            return self._folded(z.sinc(np.int64(known), np.int64(fraction), np.int64(out)))
        self._whole_turns("unnormalized_sinc", fraction)
        turns = Term("MUL", x, self.constant(z.QUARTER_TURNS), fraction + 1)
        n = self.sum([turns], end=30, mode="RAW")
        r = self.sum([turns, self.plain(n, -30, True)], mode="RAW")
        u = self.sum([Term("MUL", r, r, 30)], mode="RAW")
        near = self.sum([self.plain(self._polynomial(z.SINC, u), 30 - out)])
        far = self.quotient(self.sine(x, fraction, 30, 0, "RAW"), x, out + fraction - 30)
        return self.sum([Term("SEL", far, n), Term("SELN", near, n)])

    def _whole_turns(self, name: str, fraction: int) -> None:
        if fraction < 0:
            raise LoweringError(
                f"the argument of {name} is so large that its whole turns fit no word",
                path=self.here,
                expected="a fraction of 0 or more",
                got=str(fraction),
                fix="keep the angle within some turns",
            )

    @proved
    def exponential(self, x: int, fraction: int, out: int) -> int:
        known = self.known(x)
        if known is not None:
            return self._folded(z.exponential(np.int64(known), np.int64(fraction), np.int64(out)))
        self._whole_turns("exp", fraction)
        y = Term("MUL", x, self.constant(z.LOG2_E), fraction)
        n = self.sum([y], end=30, mode="RAW")
        u = self.sum([y, self.plain(n, -30, True)], mode="RAW")
        m = self._polynomial(z.POWER, u)
        down = self.sum([self.plain(n, 0, True)], mode="RAW")
        return self.sum([Term("DYN", m, down, 30 - out)])

    @proved
    def logarithm(self, x: int, fraction: int, out: int) -> int:
        known = self.known(x)
        if known is not None:
            return self._folded(z.logarithm(np.int64(known), np.int64(fraction), np.int64(out)))
        above = self.compared("greater", x, self.zero, 0, 0)
        size = self.sum([Term("SEL", x, above), Term("SELN", self.one, above)], mode="RAW")  # it may be wide
        length = self.sum([Term("BITS", size, self.one)], mode="RAW")
        begun = self.begin("logarithm", [Term("DYN", size, length, -31)])
        digits = self.take(begun, mode="RAW")
        ln_2 = self.constant(z.LN_2)
        terms = [
            Term("MUL", length, ln_2),
            Term("MUL", self.constant(-1 - fraction), ln_2),
            Term("MUL", digits, ln_2, 30),
        ]
        value = self.sum(terms, end=30 - out)
        least = self.constant(1 - 2 ** (self.now - 1))
        return self.sum([Term("SEL", value, above), Term("SELN", least, above)])

    def _top(self, a: int, b: int, fraction_a: int, fraction_b: int) -> int:
        """The place of the highest bit of the larger of two numbers."""
        lengths = (self.sum([Term("BITS", x, self.one)], mode="RAW") for x in (a, b))
        top_a, top_b = (
            self.sum([self.plain(n), self.plain(self.constant(-f))], mode="RAW")
            for n, f in zip(lengths, (fraction_a, fraction_b), strict=True)
        )
        higher = self.compared("greater", top_a, top_b, 0, 0)
        return self.chosen(higher, top_a, top_b, mode="RAW")

    @proved
    def length(self, a: int, b: int, fraction_a: int, fraction_b: int, out: int) -> int:
        """sqrt(a^2 + b^2): squares of 30 bits, whose sum goes to the root as it is."""
        top = self._top(a, b, fraction_a, fraction_b)
        p = self.sum([Term("DYN", a, top, fraction_a - 30)], mode="RAW")
        q = self.sum([Term("DYN", b, top, fraction_b - 30)], mode="RAW")
        root = self.take(self.begin("root", [Term("MUL", p, p), Term("MUL", q, q)]), mode="RAW")
        down = self.sum([self.plain(top, 0, True)], mode="RAW")
        return self.sum([Term("DYN", root, down, 30 - out)])

    @proved
    def angle(self, y: int, x: int, fraction_y: int, fraction_x: int, out: int) -> int:
        top = self._top(y, x, fraction_y, fraction_x)
        along, up = Term("DYN", x, top, fraction_x - 59), Term("DYN", y, top, fraction_y - 59)
        value = self.take(self.begin("angle", [along, up]), shift=60 - out)
        flat = self.sum([self.plain(y)], mode="EQ")
        behind = self.sum([self.plain(x)], mode="LT")
        half = self._folded(z.shift(z.HALF_TURN, np.int64(60 - out)))
        on_axis = self.sum([Term("SEL", half, behind)])
        return self.sum([Term("SEL", on_axis, flat), Term("SELN", value, flat)])

    @abc.abstractmethod
    def compared(self, op: str, a: int, b: int, p: int, q: int) -> int:
        """Whether a `op` b, where their fractions differ by p and q."""

    @abc.abstractmethod
    def chosen(self, c: int, a: int, b: int, p: int = 0, q: int = 0, mode: str = "FIT") -> int:
        """a where c is true, else b, shifted by p and q."""
