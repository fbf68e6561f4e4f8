"""Operations on real numbers as sums of the machine, element by element; the shifts are the interpreter's."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from flowgraph.engines.fixed import shifts
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.verilog.bounds import proved
from flowgraph.engines.verilog.functions import Functions
from flowgraph.engines.verilog.nodes import Term
from flowgraph.errors import LoweringError
from flowgraph.recorder.trace import Instruction

COMPARE = {
    "less": ("LT", False),
    "less_equal": ("LE", False),
    "greater": ("LT", True),
    "greater_equal": ("LE", True),
    "equal": ("EQ", False),
    "not_equal": ("NE", False),
}
"""For each comparison of a and b how a - b, or where it says so b - a, compares with 0."""


WORD = 34
"""Bits of a word that the machine multiplies."""


class Real(Functions):
    """What works element by element on real numbers.

    Every method takes the words of one element, and a function that gives a shift at this element.
    """

    def real(self, s: Site, args: list[np.ndarray]) -> np.ndarray:
        """The words of a result.

        Args:
            s: the instruction with its formats.
            args: numbers of the words of each argument, of its shape.
        """
        i, shape = s.i, s.i.spec.shape
        wide = [np.broadcast_to(a, shape) for a in args]
        make = getattr(self, f"_{i.op}", None)
        if make is None:
            raise no_form(i)
        return np.asarray(make(s, *wide), dtype=np.int64).reshape(shape)

    def _each(
        self, shape: tuple[int, ...], make: Callable[..., int], args: Sequence[np.ndarray], *shifts: Any
    ) -> np.ndarray:
        """`make` of the elements of arrays, and shifts, that broadcast to a shape."""
        return self.each_line(shape, lambda *x: (make(*x),), args, shifts)[..., 0]

    def _added(self, s: Site, a: np.ndarray, b: np.ndarray, minus: bool) -> np.ndarray:
        def one(x: int, y: int, p: int, q: int, end: int) -> int:
            return self.sum([self.plain(x, p), self.plain(y, q, minus)], end=end)

        return self._each(s.i.spec.shape, one, (a, b), *shifts.shifts_of_sum(s))

    def _add(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._added(s, a, b, False)

    def _subtract(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._added(s, a, b, True)

    def _multiply(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        def one(x: int, y: int, by: int) -> int:
            return self.sum([Term("MUL", x, y, by)])

        by = shifts.shift_of_product(s)
        if not self.uneven(by) or (by.max() - by.min()) > WORD - self.now:
            return self._each(s.i.spec.shape, one, (a, b), by)

        def lifted(x: int, y: int, down: int, most: int) -> int:
            return one(self.sum([Term("DYN", x, down)], mode="RAW"), y, most)

        return self._each(s.i.spec.shape, lifted, (a, b, self.constants(by - by.max())), by.max())

    def uneven(self, shift: np.ndarray) -> bool:
        """Whether shifts differ along an axis of rows."""
        return any(
            size >= self.shortest > 0 and bool((shift != shift.take([0], axis=a)).any())
            for a, size in enumerate(shift.shape)
        )

    def constants(self, numbers: np.ndarray) -> np.ndarray:
        """Known words."""
        made = [self.constant(n) for n in numbers.ravel().tolist()]
        return np.array(made, dtype=np.int64).reshape(numbers.shape)

    def _divide(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._each(s.i.spec.shape, self.quotient, (a, b), shifts.shift_of_quotient(s))

    def _of_one(self, function: Callable[[int, int, int], int], s: Site, a: np.ndarray) -> np.ndarray:
        f = shifts.bound_fraction(s.real(0))

        def one(x: int, fraction: int, out: int) -> int:
            self.here = s.i.line
            return function(x, fraction, out)

        return self._each(s.i.spec.shape, one, (a,), f, s.out)

    def _sqrt(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(self.square_root, s, a)

    def _sin(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(lambda x, f, out: self.sine(x, f, out, 0), s, a)

    def _cos(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(lambda x, f, out: self.sine(x, f, out, 1), s, a)

    def _unnormalized_sinc(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(self.sinc, s, a)

    def _exp(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(self.exponential, s, a)

    def _log(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._of_one(self.logarithm, s, a)

    def _of_two(self, function: Callable[..., int], s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        f, g = (shifts.bound_fraction(s.real(k)) for k in (0, 1))
        return self._each(s.i.spec.shape, function, (a, b), f, g, s.out)

    def _atan2(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._of_two(self.angle, s, a, b)

    def _hypot(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._of_two(self.length, s, a, b)

    def _where(self, s: Site, c: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._each(
            s.i.spec.shape,
            self.chosen,
            (c, a, b),
            shifts.between(s.real(1), s.out),
            shifts.between(s.real(2), s.out),
        )

    def chosen(self, c: int, a: int, b: int, p: int = 0, q: int = 0, mode: str = "FIT") -> int:
        """a where c is not 0, else b, each shifted."""
        if a == b and p == q:
            return self.sum([self.plain(a, p)], mode=mode)
        return self.sum([Term("SEL", a, c, p), Term("SELN", b, c, q)], mode=mode)

    def compared(self, op: str, a: int, b: int, p: int, q: int) -> int:
        mode, turned = COMPARE[op]
        return self.sum([self.plain(a, p, turned), self.plain(b, q, not turned)], mode=mode)

    def comparison(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Truth values of two arrays of reals."""
        p, q, _ = shifts.aligned(s)
        return self._each(s.i.spec.shape, lambda *x: self.compared(s.i.op, *x), (a, b), p, q)

    def _picked(self, s: Site, a: np.ndarray, b: np.ndarray, op: str) -> np.ndarray:
        p, q, _ = shifts.aligned(s)

        def one(x: int, y: int, p: int, q: int, px: int, qy: int) -> int:
            return self.chosen(self.compared(op, x, y, p, q), x, y, px, qy)

        return self._each(
            s.i.spec.shape,
            one,
            (a, b),
            p,
            q,
            shifts.between(s.real(0), s.out),
            shifts.between(s.real(1), s.out),
        )

    def _maximum(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._picked(s, a, b, "greater_equal")

    def _minimum(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return self._picked(s, a, b, "less_equal")

    def negated(self, a: int) -> int:
        return self.sum([self.plain(a, 0, True)])

    def size(self, a: int, by: int = 0) -> int:
        """|a|, shifted."""
        below = self.sum([self.plain(a)], mode="LT")
        return self.sum([Term("SEL", a, below, by, True), Term("SELN", a, below, by)])

    def _copysign(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        def one(x: int, y: int, by: int) -> int:
            below = self.sum([self.plain(y)], mode="LT")
            size = self.size(x, by)
            return self.sum([Term("SEL", size, below, 0, True), Term("SELN", size, below)])

        return self._each(s.i.spec.shape, one, (a, b), shifts.between(s.real(0), s.out))

    def _sign(self, s: Site, a: np.ndarray) -> np.ndarray:
        def one(x: int, out: int) -> int:
            above, below = (
                self.compared("less", self.zero, x, 0, 0),
                self.compared("less", x, self.zero, 0, 0),
            )
            return self.sum([self.plain(above), self.plain(below, 0, True)], end=-out)

        return self._each(s.i.spec.shape, one, (a,), s.out)

    def whole(self, how: str, x: int, f: int, end: int) -> int:
        """The whole part of a word of fraction f, shifted by `end`."""
        if f <= 0:
            return self.sum([self.plain(x, f)], end=end)
        down = self.sum([self.plain(x)], end=f, mode="RAW", floor=True)
        if how == "floor":
            return self.sum([self.plain(down)], end=end)
        up = self.sum([self.plain(x, 0, True)], end=f, mode="RAW", floor=True)
        if how == "ceil":
            return self.sum([self.plain(up, 0, True)], end=end)
        if how == "trunc":
            below = self.sum([self.plain(x)], mode="LT")
            return self.sum([Term("SEL", up, below, 0, True), Term("SELN", down, below)], end=end)
        return self.whole_to_even(x, f, end)

    @proved
    def whole_to_even(self, x: int, f: int, end: int | None = None) -> int:
        """The whole number nearest to x 2^-f, of two the even one, shifted by `end`; or as it is."""
        down = self.sum([self.plain(x)], end=f, mode="RAW", floor=True)
        # up where the rest is more than a half, or is one and the number below is odd
        rest = self.sum([self.plain(x, -1), self.plain(down, -f - 1, True)], mode="RAW")
        one = self.constant(1 << f)
        more, half = self.compared("greater", rest, one, 0, 0), self.compared("equal", rest, one, 0, 0)
        odd = self.sum([Term("AND", down, self.one), self.plain(half)], end=0, mode="RAW")
        both = self.compared("equal", odd, self.constant(2), 0, 0)
        mode = "RAW" if end is None else "FIT"
        return self.sum([self.plain(down), self.plain(more), self.plain(both)], end=end or 0, mode=mode)

    def _wholes(self, how: str, s: Site, a: np.ndarray) -> np.ndarray:
        f = shifts.bound_fraction(s.real(0))
        return self._each(s.i.spec.shape, lambda x, p, out: self.whole(how, x, p, -out), (a,), f, s.out)

    def _floor(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._wholes("floor", s, a)

    def _ceil(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._wholes("ceil", s, a)

    def _trunc(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._wholes("trunc", s, a)

    def _round(self, s: Site, a: np.ndarray) -> np.ndarray:
        return self._wholes("round", s, a)

    def _remainder(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        p, q, at = shifts.aligned(s)
        return self._each(s.i.spec.shape, self.rest, (a, b), p, q, at - s.out)

    def _floor_divide(self, s: Site, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        p, q, _ = shifts.aligned(s)
        return self._each(s.i.spec.shape, self.floor_quotient, (a, b), p, q, -s.out)

    # -- along axes ----------------------------------------------------------------------------------------

    def total(self, s: Site, args: list[np.ndarray]) -> np.ndarray:
        """`sum`, `matmul` and `vecdot`."""
        i = s.i
        found = {
            "sum": shifts.terms_of_sum,
            "matmul": shifts.terms_of_matmul,
            "vecdot": shifts.terms_of_vecdot,
        }[i.op]
        fractions, out, count, axes = found(s)
        by, _, last = shifts.adding(fractions, out, count, axes)
        if i.op == "sum":
            left, right = args[0], np.full((), self.one)
        elif i.op == "vecdot":
            left, right = args
        else:
            a, b = args
            a, b = a[None] if a.ndim == 1 else a, b[:, None] if b.ndim == 1 else b
            left, right = a[..., :, :, None], b[..., None, :, :]
        shape = fractions.shape
        left, right, by = (np.broadcast_to(x, shape) for x in (left, right, by))
        last = np.broadcast_to(last, [1 if n in axes else size for n, size in enumerate(shape)])
        limit = max(count - 1, 0).bit_length()
        inner = [a for a in range(len(shape)) if a not in axes]
        over = tuple(shape[a] for a in inner)
        left, right, by, last = (
            np.transpose(x, [*inner, *axes]).reshape(*over, -1) for x in (left, right, by, last)
        )

        def one(*x: int) -> tuple[int, ...]:
            a, b, n, end = x[:count], x[count : 2 * count], x[2 * count : -1], x[-1]
            return (self.sum(self.along("MUL", zip(a, b, n, strict=True)), end=end, limit=limit),)

        args = [x[..., k] for x in (left, right) for k in range(count)]
        moved = [*(by[..., k] for k in range(count)), last[..., 0]]
        made = self.each_line(over, one, args, moved, elements=True)
        return np.asarray(made[..., 0]).reshape(i.spec.shape)


def no_form(i: Instruction) -> LoweringError:
    """The error for an operation that the machine does not do."""
    return LoweringError(
        f"{i.op} of {i.spec.dtype} has no form in hardware yet",
        path=i.line,
        expected="an operation that is made of sums, quotients, roots, logarithms and angles",
        got=f"{i.op} {list(i.spec.shape)}",
        fix="write it with these, or lower the graph to C",
    )
