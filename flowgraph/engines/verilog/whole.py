"""Whole numbers and truth values as sums of the machine.

A truth value is 0 or 1, a number of 32 bits is a word. Numbers of 64 bits, times above all, are two words,
the lower one without a sign; sums of them are made whole and cut in two again. What counts places in an array
is a word, whatever its declared kind.
"""

from __future__ import annotations

import numpy as np

from flowgraph.engines.fixed import shifts
from flowgraph.engines.fixed.shifts import Site
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
        shape = i.spec.shape
        rows = [np.broadcast_to(a, (*shape, a.shape[-1])).reshape(-1, a.shape[-1]).tolist() for a in args]
        made = [make(s, *map(tuple, row)) for row in zip(*rows, strict=True)]
        return stacked(made, shape, self)

    def terms(self, x: Pair, minus: bool = False) -> list[Term]:
        """A number as terms of a sum."""
        return [self.plain(w, -32 * k, minus) for k, w in enumerate(x)]

    def wrapped(self, terms: list[Term], dtype: str) -> Pair:
        """A sum as a number of a kind; what does not fit falls off."""
        if dtype in _BIG:
            if all(t.shift == 0 and t.kind == "MUL" and t.b == self.one for t in terms):
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
        shape = s.i.spec.shape
        out = np.broadcast_to(s.out, shape).ravel().tolist()
        rows = a.reshape(-1, a.shape[-1]).tolist()
        made = [
            self.sum(self.terms(tuple(x)), end=-f, limit=NO_LIMIT) for x, f in zip(rows, out, strict=True)
        ]
        return np.array(made, dtype=np.int64).reshape(shape)

    def from_real(self, s: Site, a: np.ndarray) -> np.ndarray:
        to = s.i.attrs["dtype"]
        f = np.broadcast_to(shifts.bound_fraction(s.real(0)), a.shape).ravel().tolist()
        made: list[Pair] = []
        for x, fraction in zip(a.ravel().tolist(), f, strict=True):
            if to == "bool":
                made.append((self.sum([self.plain(x)], mode="NE"),))
                continue
            if fraction < 0 and to in _BIG:
                raise no_form(s.i)
            whole = self.whole_raw(x, fraction)
            made.append((whole,) if to in _BIG else self.wrapped([self.plain(whole)], to))
        return stacked(made, s.i.spec.shape, self)

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
