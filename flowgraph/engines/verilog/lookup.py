"""Arrays that are read at computed places, and sums as they go: `take`, `searchsorted`, `cumulative_sum`."""

from __future__ import annotations

import math

import numpy as np

from flowgraph.engines.fixed import shifts
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.verilog.bounds import proved
from flowgraph.engines.verilog.nodes import NO_LIMIT, Term
from flowgraph.engines.verilog.real import no_form
from flowgraph.engines.verilog.whole import Pair, Whole


class Lookup(Whole):
    """Nodes that know rows by places in them."""

    def _take(self, s: Site, args: list[np.ndarray], real: bool) -> np.ndarray:
        i = s.i
        x, chosen = args
        rank = len(s.specs[i.args[0]].shape)
        axis = i.attrs["axis"] % rank
        index = s.specs[i.args[1]].shape
        if chosen.shape[-1] > 1:
            raise no_form(i)
        chosen = chosen[..., 0]
        words = x[..., None] if real else x
        size, depth = words.shape[axis], words.shape[-1]
        by = np.zeros((), np.int64)
        if real:
            f = s.real(0)
            by = shifts.between(f, np.broadcast_to(f.min(axis=axis, keepdims=True), f.shape))
            if by.any():
                words = self._each(x.shape, lambda a, b: self.sum([self.plain(a, b)]), (x,), by)[..., None]
        lines = np.moveaxis(words, axis, -2).reshape(-1, size, depth)
        made = [
            self.each_line(index, lambda n, line=line: self._chosen(line, n, size), [chosen])
            for line in lines
        ]
        shape = s.specs[i.args[0]].shape
        found = np.stack(made).reshape(*shape[:axis], *shape[axis + 1 :], *index, -1)
        # the axes of the index go where the axis was
        behind = list(range(rank - 1, rank - 1 + len(index)))
        found = np.moveaxis(found, behind, range(axis, axis + len(index)))
        return found[..., 0] if real else found

    @proved
    def _chosen(self, line: np.ndarray, n: int, size: int) -> Pair:
        """The words of the element of a line at n, or of the first or last one."""
        known = self.known(n)
        if known is not None:
            return tuple(self.word(x) for x in line[max(0, min(known, size - 1))].tolist())
        rows = [self.row_of(column) for column in line.T.tolist()]
        if self.long_row(size) and all(r is not None and self.row(r) for r in rows):
            last = self.constant(size - 1)
            high = self.compared("greater", n, last, 0, 0)
            index = self.index(self.chosen(high, last, n, mode="RAW"))
            return tuple(self.sum([self.at_index(r, index)], mode="RAW") for r in rows if r is not None)
        at = [self.compared("equal", n, self.constant(k), 0, 0) for k in range(size)]
        at[0] = self.compared("less_equal", n, self.zero, 0, 0)
        at[-1] = self.compared("greater_equal", n, self.constant(size - 1), 0, 0) if size > 1 else self.one
        return tuple(
            self.sum([Term("SEL", self.word(x), c) for x, c in zip(column, at, strict=True)], mode="RAW")
            for column in line.T.tolist()
        )

    def long_row(self, size: int) -> bool:
        """Whether an axis of that length is a row: without particles, a table is."""
        return size >= (self.shortest or _TABLE)

    def _search(self, s: Site, args: list[np.ndarray], real: bool) -> np.ndarray:
        """How many elements are below, or not above: by halves in a row, one by one in what is short."""
        i = s.i
        size = s.specs[i.args[0]].shape[0]
        mode = "LE" if i.attrs.get("side", "left") == "right" else "LT"
        p = q = np.zeros((), np.int64)
        if real:
            p, q = shifts.shifts_of_search(s)
            args = [a[..., None] for a in args]
        ahead = np.broadcast_to(p, (size,)).tolist()
        line, wanted = args
        rows = [self.row_of(column) for column in line.T.tolist()]
        halving = all(r is not None and self.row(r) for r in rows) and len(set(ahead)) == 1

        def minus(x: Pair, by: int) -> list[Term]:
            return [self.plain(w, by - 32 * k, True) for k, w in enumerate(x)]

        def one(*x: int) -> Pair:
            value, by = x[:-1], x[-1]
            if not halving:
                below = [
                    self.sum(
                        [
                            *(self.plain(self.word(w), at - 32 * k) for k, w in enumerate(row)),
                            *minus(value, by),
                        ],
                        mode=mode,
                        limit=NO_LIMIT,
                    )
                    for row, at in zip(line.tolist(), ahead, strict=True)
                ]
                return (self.sum([self.plain(b) for b in below], mode="RAW"),)
            found: list[Term] = []
            left = size
            while left:
                half = max(left // 2, 1)
                terms = minus(value, by)
                for k, r in enumerate(rows):
                    assert r is not None
                    if found:
                        index = self.index_of(found)
                        get = self.at_index(r, index, half - 1)
                    else:
                        get = self.plain(self.view(r, half - 1))
                    terms.append(Term(get.kind, get.a, get.b, ahead[0] - 32 * k))
                below_half = self.sum(terms, mode=mode, limit=NO_LIMIT)
                found.append(Term("MUL", below_half, self.constant(half)))
                left = left - half if left > 1 else 0
            return (self.sum(found, mode="RAW"),)

        columns = [wanted[..., k] for k in range(wanted.shape[-1])]
        return self.each_line(i.spec.shape, one, columns, [np.broadcast_to(q, i.spec.shape)])

    def _running(self, s: Site, x: np.ndarray, real: bool) -> np.ndarray:
        i = s.i
        shape = i.spec.shape
        axis = i.attrs["axis"] % len(shape)
        size = shape[axis]
        words = x[..., None] if real else x
        depth = words.shape[-1]
        lines = np.moveaxis(words, axis, -2).reshape(-1, size, depth)
        by = ends = np.zeros((), np.int64)
        limit = NO_LIMIT
        if real:
            by, _, ends = shifts.shifts_of_running_sum(s)
            limit = math.ceil(math.log2(max(size, 1)))
        moved, last = (
            np.moveaxis(np.broadcast_to(a, shape), axis, -1).reshape(-1, size).tolist() for a in (by, ends)
        )
        made = [
            self._real_sums(line[:, 0].tolist(), b, e, limit)
            if real
            else self._whole_sums(line, i.spec.dtype)
            for line, b, e in zip(lines, moved, last, strict=True)
        ]
        most = max(m.shape[-1] for m in made)
        found = np.stack(made).reshape(*shape[:axis], *shape[axis + 1 :], size, most)
        found = np.moveaxis(found, -2, axis)
        return found[..., 0] if real else found

    def _real_sums(self, numbers: list[int], by: list[int], ends: list[int], limit: int) -> np.ndarray:
        terms = self.along("MUL", zip(numbers, [self.one] * len(by), by, strict=True))
        if len(terms) == 1 and terms[0].times and len(set(ends)) == 1:
            return self.elements(self._sums(terms[0], "FIT", ends[0], limit), len(numbers))[:, None]
        each = [self.plain(self.word(n), b) for n, b in zip(numbers, by, strict=True)]
        made = [self.sum(each[: k + 1], end=end, limit=limit) for k, end in enumerate(ends)]
        return np.array(made)[:, None]

    def _sums(self, term: Term, mode: str, end: int = 0, limit: int = NO_LIMIT) -> int:
        return self.sum(
            [term], mode=mode, end=end, limit=limit, floor=limit == NO_LIMIT, row=term.times, gather="running"
        )

    def _whole_sums(self, line: np.ndarray, dtype: str) -> np.ndarray:
        """Of numbers of 64 bits: the sums of their lower words give a carry to those of the upper."""
        size, depth = line.shape
        columns = [self.along("MUL", [(n, self.one, 0) for n in column]) for column in line.T.tolist()]
        if any(len(c) != 1 or not c[0].times for c in columns):
            each = [self.terms(tuple(map(self.word, row))) for row in line.tolist()]
            made = [self.wrapped([t for x in each[: k + 1] for t in x], dtype) for k in range(size)]
            most = max(map(len, made))
            return np.array([x if len(x) == most else self.long(x) for x in made])
        if depth == 1:
            mode = {"uint32": "U32", "int32": "S32"}.get(dtype, "RAW")
            return self.elements(self._sums(columns[0][0], mode), size)[:, None]
        low = self._sums(columns[0][0], "U32")
        carry, above = self._sums(columns[0][0], "RAW", 32), self._sums(columns[1][0], "S32")
        mode = "U32" if dtype == "uint64" else "S32"
        high = self.sum([self.plain(carry), self.plain(above)], mode=mode, limit=NO_LIMIT)
        return np.stack([self.elements(low, size), self.elements(high, size)], axis=-1)

    def index_of(self, terms: list[Term]) -> int:
        """A sum as a place in a row."""
        return self.sum(terms, mode="INDEX")

    def _sorted(self, s: Site, x: np.ndarray, real: bool) -> np.ndarray:
        """`sort` and `argsort` of a short axis: an element's rank is how many come before it."""
        i = s.i
        axes = shifts.axes_of(i)(x.ndim if real else x.ndim - 1)
        count = s.specs[i.args[0]].shape[axes[0]]
        if not real or count > _RANKED or any(n >= self.shortest > 0 for n in i.spec.shape):
            raise no_form(i)
        f = s.real(0)
        at = shifts.common_along(f, axes)
        by = np.moveaxis(shifts.between(f, np.broadcast_to(at, f.shape)), axes[0], -1)
        words = np.moveaxis(x, axes[0], -1)
        places = i.op == "argsort"
        ends = np.zeros_like(by) if places else np.moveaxis(np.broadcast_to(at - s.out, f.shape), axes[0], -1)
        made = np.empty_like(words)
        for here in np.ndindex(*words.shape[:-1]):
            row = [self.word(n) for n in words[here].tolist()]
            ranks = self._ranks(row, by[here].tolist())
            for k in range(count):
                at_k = [self.compared("equal", r, self.constant(k), 0, 0) for r in ranks]
                if places:
                    terms = [Term("MUL", c, self.constant(n)) for n, c in enumerate(at_k)]
                else:
                    terms = [
                        Term("SEL", a, c, up) for a, c, up in zip(row, at_k, by[here].tolist(), strict=True)
                    ]
                mode = "RAW" if places else "FIT"
                made[(*here, k)] = self.sum(terms, mode=mode, end=int(ends[(*here, k)]))
        found = np.moveaxis(made, -1, axes[0])
        return found[..., None] if places else found

    def _ranks(self, row: list[int], by: list[int]) -> list[int]:
        """How many of a row lie before each; of equal ones the first is first."""
        before: list[list[int]] = [[] for _ in row]
        for k in range(len(row)):
            for n in range(k):
                above = self.sum([self.plain(row[k], by[k]), self.plain(row[n], by[n], True)], mode="LT")
                before[n].append(above)  # k lies before n
                before[k].append(self.sum([self.plain(above)], mode="EQ"))
        return [self.sum([self.plain(x) for x in xs], mode="RAW") for xs in before]


_TABLE = 64
"""What is read at a computed place is a row of the memory from this length on, where nothing else is."""

_RANKED = 16
"""Elements that are sorted, at most: each is compared with each."""
