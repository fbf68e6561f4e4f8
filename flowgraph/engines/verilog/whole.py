"""Whole numbers and truth values as sums of the machine.

A truth value is 0 or 1, a number of 32 bits is a word. Numbers of 64 bits, times above all, are two words,
the lower one without a sign; sums of them are made whole and cut in two again. What counts places in an array
is a word, whatever its declared kind.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from flowgraph.engines.fixed import shifts
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.verilog.bounds import MOST, most_of_sum, proved
from flowgraph.engines.verilog.nodes import NO_LIMIT, Term
from flowgraph.engines.verilog.real import COMPARE, Real, no_form

Pair = tuple[int, ...]
"""One word, or the lower and the upper one."""

_BIG = ("int64", "uint64")


class Whole(Real):
    """Nodes that know whole numbers; an array of them has the words (lower and upper) as a last axis."""

    def whole_numbers(self, s: Site, args: list[np.ndarray]) -> np.ndarray:
        """The words of a result that is no real number, from arguments that are none: (..., 1 or 2)."""
        i = s.i
        make = getattr(self, f"int_{i.op}", None)
        if make is None:
            raise no_form(i)
        ends = np.cumsum([0, *(a.shape[-1] for a in args)]).tolist()

        def one(*x: int) -> Pair:
            return tuple(make(s, *(x[k:n] for k, n in pairwise(ends))))

        return self.each_line(i.spec.shape, one, [a[..., k] for a in args for k in range(a.shape[-1])])

    def terms(self, x: Pair, minus: bool = False) -> list[Term]:
        """A number as terms of a sum."""
        return [self.plain(w, -32 * k, minus) for k, w in enumerate(x)]

    def wrapped(self, terms: list[Term], dtype: str) -> Pair:
        """A sum as a number of a kind; what does not fit falls off."""
        if dtype in _BIG:
            plain = all(t.shift == 0 and t.kind == "MUL" and t.b == self.one for t in terms)
            if plain and most_of_sum(self, terms) <= MOST:
                return (self.sum(terms, mode="RAW", limit=NO_LIMIT),)
            return self.halves(terms, dtype)
        return (self.sum(terms, mode="U32" if dtype == "uint32" else "S32", limit=NO_LIMIT),)

    def halves(self, terms: list[Term], dtype: str, down: int = 0) -> Pair:
        """A sum of 64 bits in two words, shifted down."""
        high = "S32" if dtype == "int64" else "U32"
        return (
            self.sum(terms, mode="U32", end=down, limit=NO_LIMIT, floor=True),
            self.sum(terms, mode=high, end=down + 32, limit=NO_LIMIT, floor=True),
        )

    def int_add(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self.wrapped([*self.terms(a), *self.terms(b)], s.i.spec.dtype)

    def int_subtract(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self.wrapped([*self.terms(a), *self.terms(b, True)], s.i.spec.dtype)

    def int_negative(self, s: Site, a: Pair) -> Pair:
        return self.wrapped(self.terms(a, True), s.i.spec.dtype)

    def int_multiply(self, s: Site, a: Pair, b: Pair) -> Pair:
        terms = [
            Term("MUL", x, y, -32 * (j + k)) for j, x in enumerate(a) for k, y in enumerate(b) if j + k < 2
        ]
        return self.wrapped(terms, s.i.spec.dtype)

    def int_compare(self, s: Site, a: Pair, b: Pair) -> Pair:
        mode, turned = COMPARE[s.i.op]
        terms = [*self.terms(a, turned), *self.terms(b, not turned)]
        return (self.sum(terms, mode=mode, limit=NO_LIMIT),)

    int_less = int_less_equal = int_greater = int_greater_equal = int_equal = int_not_equal = int_compare

    def int_where(self, s: Site, c: Pair, a: Pair, b: Pair) -> Pair:
        a, b = self.alike(a, b)
        return tuple(self.chosen(c[0], x, y, mode="RAW") for x, y in zip(a, b, strict=True))

    def alike(self, a: Pair, b: Pair) -> tuple[Pair, Pair]:
        """Both with the same number of words."""
        return (a, b) if len(a) == len(b) else (self.long(a), self.long(b))

    def long(self, a: Pair) -> Pair:
        return a if len(a) == 2 else self.halves(self.terms(a), "int64")

    def int_minimum(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self.int_where(s, (self._not_above(a, b),), a, b)

    def int_maximum(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self.int_where(s, (self._not_above(b, a),), a, b)

    def _not_above(self, a: Pair, b: Pair) -> int:
        """Whether a <= b."""
        return self.sum([*self.terms(a), *self.terms(b, True)], mode="LE", limit=NO_LIMIT)

    def int_abs(self, s: Site, a: Pair) -> Pair:
        below = self.sum(self.terms(a), mode="LT", limit=NO_LIMIT)
        return self.int_where(s, (below,), self.int_negative(s, a), a)

    def _bits(self, s: Site, a: Pair, b: Pair, kind: str) -> Pair:
        a, b = self.alike(a, b)
        mode = {"uint32": "U32", "int32": "S32"}.get(s.i.spec.dtype, "RAW")
        return tuple(self.sum([Term(kind, x, y)], mode=mode) for x, y in zip(a, b, strict=True))

    def int_bitwise_and(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self._bits(s, a, b, "AND")

    def int_bitwise_or(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self._bits(s, a, b, "OR")

    def int_bitwise_xor(self, s: Site, a: Pair, b: Pair) -> Pair:
        return self._bits(s, a, b, "XOR")

    int_logical_and, int_logical_or, int_logical_xor = int_bitwise_and, int_bitwise_or, int_bitwise_xor

    def int_logical_not(self, s: Site, a: Pair) -> Pair:
        return (self.sum([Term("MUL", a[0], self.one)], mode="EQ"),)

    def int_bitwise_invert(self, s: Site, a: Pair) -> Pair:
        if s.i.spec.dtype == "bool":
            return self.int_logical_not(s, a)
        return self.wrapped([*self.terms(a, True), self.plain(self.constant(-1))], s.i.spec.dtype)

    def int_bitwise_right_shift(self, s: Site, a: Pair, b: Pair) -> Pair:
        by = self.known(b[0])
        if by is None or len(b) > 1 or by < 0:
            raise no_form(s.i)
        if len(a) == 2:
            if by == 32:
                return (
                    (a[1], self.zero)
                    if s.i.spec.dtype == "uint64"
                    else self.halves(self.terms(a), "int64", 32)
                )
            return self.halves(self.terms(a), s.i.spec.dtype, by)
        return (self.sum([self.plain(a[0])], mode="RAW", end=by, floor=True),)

    def int_bitwise_left_shift(self, s: Site, a: Pair, b: Pair) -> Pair:
        by = self.known(b[0])
        if by is None or len(b) > 1 or not 0 <= by <= 31:
            raise no_form(s.i)
        terms = [Term(t.kind, t.a, t.b, t.shift - by) for t in self.terms(a)]
        return self.wrapped(terms, s.i.spec.dtype)

    @proved
    def int_floor_divide(self, s: Site, a: Pair, b: Pair) -> Pair:
        """Rounded down, by a number that is known: digit after digit, each by a product with 2^k / b."""
        by = self.known(b[0]) if len(b) == 1 else None
        if by is None or not 0 < by < 1 << 16 or s.i.spec.dtype == "uint64":
            raise no_form(s.i)
        digit = 31 - by.bit_length()
        shift = 31 + by.bit_length()
        factor = self.constant(-(-(1 << shift) // by))
        top = -(-64 // digit) - 1
        ahead = 1 << (63 - digit * top)  # the highest digit has the sign: it is made positive, by so often b
        rest = [Term("MUL", self.constant(ahead), b[0])]
        found = [Term("MUL", self.constant(ahead), self.one, -digit * top, True)]
        for k in range(top, -1, -1):
            part = self.sum(
                self.terms(a), mode="RAW" if k == top else "U32", end=digit * k, limit=NO_LIMIT, floor=True
            )
            low = self.plain(part) if k == top else Term("AND", part, self.constant((1 << digit) - 1))
            number = self.sum([*rest, low], mode="RAW", limit=NO_LIMIT)
            divided = self.sum(
                [Term("MUL", number, factor)], end=shift, mode="RAW", limit=NO_LIMIT, floor=True
            )
            rest = [self.plain(number, -digit), Term("MUL", divided, b[0], -digit, True)]
            found.append(self.plain(divided, -digit * k))
        return self.wrapped(found, s.i.spec.dtype)

    @proved
    def int_float32_bits(self, s: Site, a: Pair) -> Pair:
        """The bits of the float32 nearest to a number of 32 bits, halves to even."""
        length = self.sum([Term("BITS", a[0], self.one)], mode="RAW")
        size = self.sum([Term("NORM", a[0], self.one, -31)], mode="RAW")
        mantissa = self.whole_to_even(size, 7)
        some, below = (self.sum([self.plain(a[0])], mode=m) for m in ("NE", "LT"))
        made = self.sum(
            [
                Term("MUL", length, self.constant(1 << 23)),
                self.plain(self.constant(125 << 23)),
                self.plain(mantissa),
            ],
            mode="RAW",
        )
        return (self.sum([Term("SEL", made, some), Term("MUL", below, self.one, -31, True)], mode="S32"),)

    def int_sign(self, s: Site, a: Pair) -> Pair:
        above = self.sum(self.terms(a, True), mode="LT", limit=NO_LIMIT)
        below = self.sum(self.terms(a), mode="LT", limit=NO_LIMIT)
        return (self.sum([self.plain(above), self.plain(below, 0, True)], mode="RAW"),)

    def int_materialise(self, s: Site, a: Pair) -> Pair:
        return a

    int_positive = int_floor = int_ceil = int_trunc = int_round = int_materialise

    def int_astype(self, s: Site, a: Pair) -> Pair:
        kind, to = s.specs[s.i.args[0]].dtype, s.i.attrs["dtype"]
        if kind == to or (kind == "bool" and to != "real"):
            return a
        if to == "bool":
            return (self.sum(self.terms(a), mode="NE", limit=NO_LIMIT),)
        if to in _BIG:
            if len(a) == 2:  # the same bits
                return self.halves(self.terms(a), to)
            return a if kind in ("uint32", "int32") and (to == "int64" or kind == "uint32") else self.long(a)
        return (self.sum([self.plain(a[0])], mode="U32" if to == "uint32" else "S32"),)

    # -- between whole numbers and reals ---------------------------------------------------------------------

    def to_real(self, s: Site, a: np.ndarray) -> np.ndarray:
        def one(*x: int) -> int:
            return self.sum(self.terms(x[:-1]), end=-x[-1], limit=NO_LIMIT)

        out = np.broadcast_to(s.out, s.i.spec.shape)
        if self.uneven(out) and a.shape[-1] == 1:
            return self._each(
                s.i.spec.shape,
                lambda x, down: self.sum([Term("DYN", x, down)]),
                (a[..., 0], self.constants(-out)),
            )
        return self._each(s.i.spec.shape, one, [a[..., k] for k in range(a.shape[-1])], out)

    def from_real(self, s: Site, a: np.ndarray) -> np.ndarray:
        to = s.i.attrs["dtype"]

        def one(x: int, fraction: int) -> Pair:
            if to == "bool":
                return (self.sum([self.plain(x)], mode="NE"),)
            if fraction < 0 and to in _BIG:
                return self.halves([self.plain(x, fraction)], to)
            whole = self.whole_raw(x, fraction)
            return (whole,) if to in _BIG else self.wrapped([self.plain(whole)], to)

        return self.each_line(s.i.spec.shape, one, [a], [shifts.bound_fraction(s.real(0))])

    def whole_raw(self, x: int, f: int) -> int:
        """The whole part of a word, towards zero, as a whole number."""
        if f <= 0:
            return self.sum([self.plain(x, f)], mode="RAW")
        down = self.sum([self.plain(x)], end=f, mode="RAW", floor=True)
        up = self.sum([self.plain(x, 0, True)], end=f, mode="RAW", floor=True)
        below = self.sum([self.plain(x)], mode="LT")
        return self.sum([Term("SEL", up, below, 0, True), Term("SELN", down, below)], mode="RAW")


def stacked(made: list[Pair], shape: tuple[int, ...], nodes: Whole) -> np.ndarray:
    """Numbers as an array with their words as the last axis, all with as many as the longest."""
    most = max(map(len, made), default=1)
    if most == 2:
        made = [nodes.long(x) for x in made]
    return np.array(made, dtype=np.int64).reshape(*shape, most)
