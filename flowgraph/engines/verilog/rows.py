"""Rows: what is the same for each element of a long axis is said once, and made in a loop of the program.

An array of words keeps for each element a number. A word has the number of its node; an element of a row has
the row's number and, above 32 bits, its place in the row and one. So arrays are moved as before, and where
the elements along an axis are one row in order, or one word, an operation is written once for the row.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np

from flowgraph.engines.verilog.nodes import Constant, Held, Joined, Nodes, Sum, Table, Term, View

ELEMENT = 1 << 32


def root_of(number: int) -> int:
    """The node of a number in an array."""
    return number & (ELEMENT - 1)


def element_of(number: int) -> int:
    """Which element of its row a number in an array is; 0 for a word."""
    return max((number >> 32) - 1, 0)


class Rows(Nodes, abc.ABC):
    """Nodes that know rows.

    Attributes:
        shortest: an axis of so many is a row, and of more; 0 where none is.
    """

    shortest: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        self._parts: set[int] = set()

    def elements(self, n: int, size: int) -> np.ndarray:
        """The numbers of a row's elements, or of one word so many times."""
        if not self.row(n):
            return np.full(size, n, dtype=np.int64)
        return np.arange(1, size + 1, dtype=np.int64) * ELEMENT + n

    def view(self, n: int, offset: int, row: int = 0) -> int:
        """Elements of a row, or one of them."""
        node = self.nodes[n]
        if row and offset == 0 and self.row(n) == row:
            return n
        if isinstance(node, View):
            return self.view(node.of, node.offset + offset, row)
        if isinstance(node, Held):
            found = self.add(Held(node.value, node.place + offset, node.high, node.width, row))
        elif isinstance(node, Table):
            if not row:
                return self.constant(node.words[offset])
            found = self.add(Table(node.words[offset : offset + row]))
        else:
            found = self.add(View(n, offset, row))
        if n in self.doubtful:
            self.doubtful.add(found)
        return found

    def word(self, number: int) -> int:
        """The node of an element of an array."""
        return number if number < ELEMENT else self.view(root_of(number), element_of(number))

    def row_of(self, numbers: Sequence[int]) -> int | None:
        """The word that all these are, or the row whose elements they are in order, or None."""
        first, size = numbers[0], len(numbers)
        if all(n == first for n in numbers):
            return self.word(first)
        if first >= ELEMENT:
            if all(n == first + k * ELEMENT for k, n in enumerate(numbers)):
                return self.view(root_of(first), element_of(first), size)
            return self._joined(numbers) if self.shortest else None
        if size >= self.shortest and all(n < ELEMENT for n in numbers):
            known = [self.known(n) for n in numbers]
            if None not in known:
                return self.add(Table(tuple(w for w in known if w is not None)))
        return None

    def _joined(self, numbers: Sequence[int]) -> int | None:
        """Rows one behind the other as one, if these are some whole ones and perhaps the begin of another."""
        starts = [k for k, n in enumerate(numbers) if k == 0 or n != numbers[k - 1] + ELEMENT]
        parts = [root_of(numbers[k]) for k in starts]
        if any(numbers[k] < ELEMENT or element_of(numbers[k]) for k in starts):
            return None
        sizes = [b - a for a, b in pairwise([*starts, len(numbers)])]
        whole = [self.row(n) for n in parts]
        sums = all(isinstance(self.nodes[n], Sum) for n in parts)
        if sizes[:-1] != whole[:-1] or not sums or len(set(parts)) < len(parts):
            return None
        node = Joined(tuple(parts), sum(whole))
        if node not in self._known and self._parts.intersection(parts):
            return None
        self._parts.update(parts)
        found = self.add(node)
        if self.doubtful.intersection(parts):
            self.doubtful.add(found)
        return self.view(found, 0, len(numbers))

    def each_line(
        self,
        shape: tuple[int, ...],
        make: Callable[..., tuple[int, ...]],
        args: Sequence[np.ndarray],
        shifts: Sequence[Any] = (),
        *,
        elements: bool = False,
    ) -> np.ndarray:
        """`make` of the elements of arrays that broadcast to a shape, once for each row of them.

        Args:
            shape: of the result.
            make: from numbers of nodes and shifts to the words of an element.
            args: arrays of numbers.
            shifts: arrays of shifts.
            elements: whether `make` is given numbers as arrays have them.

        Returns:
            Numbers, with the words of an element as a last axis.
        """
        words = [np.broadcast_to(a, shape) for a in args]
        by = [np.broadcast_to(a, shape) for a in shifts]
        axis = self._axis(shape, words)
        size = shape[axis] if axis is not None else 1
        if axis is None:
            words, by = [a[..., None] for a in words], [a[..., None] for a in by]
        else:
            words, by = [np.moveaxis(a, axis, -1) for a in words], [np.moveaxis(a, axis, -1) for a in by]
        ahead = words[0].shape[:-1] if words else shape
        flat = [a.reshape(-1, size).tolist() for a in words]
        flat_by = [a.reshape(-1, size).tolist() for a in by]
        made: list[list[tuple[int, ...]]] = []
        for k in range(len(flat[0]) if flat else 0):
            numbers, moved = [f[k] for f in flat], [f[k] for f in flat_by]
            whole = self._rolled(make, numbers, moved) if axis is not None else None
            if whole is None:
                given = numbers if elements else [[self.word(n) for n in row] for row in numbers]
                whole = [make(*row) for row in zip(*given, *moved, strict=True)]
            made.append(whole)
        most = max((len(x) for row in made for x in row), default=1)
        found = np.empty((len(made), size, most), dtype=np.int64)
        for k, row in enumerate(made):
            if len(row) < size:  # a row, or one word for all
                found[k] = np.stack([self.elements(n, size) for n in self._of_length(row[0], most)], axis=-1)
            else:
                found[k] = [self._of_length(x, most) for x in row]
        out = found.reshape(*ahead, size, most)
        return out.reshape(*shape, most) if axis is None else np.moveaxis(out, -2, axis)

    def _of_length(self, x: tuple[int, ...], most: int) -> tuple[int, ...]:
        return x if len(x) == most else self.long(x)

    def _axis(self, shape: tuple[int, ...], words: Sequence[np.ndarray]) -> int | None:
        """The axis that rows run along: one on which they do already, or else the last long one."""
        long = [a for a in reversed(range(len(shape))) if self.shortest and shape[a] >= self.shortest]
        for axis in long:
            for a in words:
                first, second = a.take(0, axis=axis), a.take(1, axis=axis)
                if ((second - first == ELEMENT) & (first >= ELEMENT)).any():
                    return axis
        return long[0] if long else None

    def _rolled(
        self, make: Callable[..., tuple[int, ...]], numbers: list[list[int]], shifts: list[list[int]]
    ) -> list[tuple[int, ...]] | None:
        if any(row.count(row[0]) < len(row) for row in shifts):
            return None
        lines: list[int] = []
        for row in numbers:
            found = self.row_of(row)
            if found is None:
                return None
            lines.append(found)
        rows = [n for n in lines if self.row(n)]
        if (
            all(isinstance(self.nodes[n], Table) for n in rows)
            and all(self.known(n) is not None or self.row(n) for n in lines)
            and rows
        ):
            return None  # all is known
        return [make(*lines, *(row[0] for row in shifts))]

    def along(self, kind: str, rows: Iterable[tuple[int, int, int]], minus: bool = False) -> list[Term]:
        """Terms of two numbers, as arrays have them, and a shift each; those along a row are one."""
        left = list(rows)
        found: list[Term] = []
        k = 0
        while k < len(left):
            a, b, by = left[k]
            size = self._run(left, k) if self.shortest and max(a, b) >= ELEMENT else 1
            if size >= self.shortest > 0:
                x, y = (
                    self.view(root_of(n), element_of(n), size) if n >= ELEMENT and moves else self.word(n)
                    for n, moves in ((a, left[k + 1][0] != a), (b, left[k + 1][1] != b))
                )
                found.append(Term(kind, x, y, by, minus, size))
                k += size
            else:
                found.append(Term(kind, self.word(a), self.word(b), by, minus))
                k += 1
        return found

    @staticmethod
    def _run(rows: list[tuple[int, int, int]], start: int) -> int:
        """How many from there on go along one or two rows."""
        if start + 1 >= len(rows):
            return 1
        a, b, by = rows[start]
        steps = tuple(x - y for x, y in zip(rows[start + 1][:2], (a, b), strict=True))
        if steps not in ((ELEMENT, 0), (0, ELEMENT), (ELEMENT, ELEMENT)):
            return 1
        if any(n < ELEMENT for n, step in zip((a, b), steps, strict=True) if step):
            return 1
        k = start + 1
        while k < len(rows) and rows[k] == (a + (k - start) * steps[0], b + (k - start) * steps[1], by):
            k += 1
        return k - start

    def index(self, n: int) -> int:
        """A word as a place in a row; what is less than 0 is 0."""
        return self.sum([Term("MUL", n, self.one)], mode="INDEX")

    def at_index(self, row: int, index: int, offset: int = 0) -> Term:
        """The element of a row at an index, from an offset on."""
        size = self.row(row) - offset
        return Term("GET", row if offset == 0 else self.view(row, offset, size), index)

    @abc.abstractmethod
    def long(self, a: tuple[int, ...]) -> tuple[int, ...]:
        """A whole number as two words."""


__all__ = ["ELEMENT", "Constant", "Rows", "Sum", "element_of", "root_of"]
