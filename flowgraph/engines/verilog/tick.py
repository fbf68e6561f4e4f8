"""A tick as words: the instructions of one pattern of present inputs, element by element."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flowgraph.engines.fixed import absent, shifts
from flowgraph.engines.fixed.counts import names_of
from flowgraph.engines.fixed.engine import Bound, Integers, site_of
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.verilog.lookup import Lookup
from flowgraph.engines.verilog.nodes import Held, Term
from flowgraph.engines.verilog.real import COMPARE, WORD, no_form
from flowgraph.engines.verilog.rows import root_of
from flowgraph.engines.verilog.whole import stacked
from flowgraph.errors import LoweringError
from flowgraph.pipeline.formats import NOT_A_NUMBER, WIDEST
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Spec

_PARTICLES = 8
"""Fewer are written out."""

_SHORT = 6
"""And shorter axes always."""

_MAY_BE_NONE = frozenset(
    ["add", "subtract", "multiply", "where", "negative", "abs", "positive", "materialise"]
) | frozenset(("isnan", "isfinite", *COMPARE)) | (shifts.MOVES - {"take"})  # fmt: skip


class Tick(Lookup):
    """The words of one pattern of present inputs.

    Args:
        player: the interpreter, which knows the formats.
        key: the pattern: bit k is input k.

    Attributes:
        bound: the program with its shifts.
        values: for each value, the numbers of its words: of its shape for reals, with an axis of one or two
            words behind it for others.
        writes: for each word of a register that changes, the number of the word that it becomes.
        outputs: for each output that may be there, whether it is (a word), and the words of its leaves.
    """

    def __init__(self, player: Integers, key: int) -> None:
        super().__init__(player.formats.width, player.formats.widest)
        self.pipeline, self.key = player.pipeline, key
        self.formats = player.formats
        by_width = self.formats.by_width()
        if self.wide > WIDEST:
            raise LoweringError(
                "held words are wider than those of the machine",
                path=names_of(self.pipeline)[by_width[self.wide][0]],
                expected=f"{WIDEST} bits or fewer",
                got=str(self.wide),
                fix="find formats with a smaller --held-width, or lower the graph to C",
            )
        if len(set(by_width) - {self.width}) > 1:
            raise LoweringError(
                "the machine has words of two widths",
                path=names_of(self.pipeline)[by_width[min(by_width)][0]],
                expected=f"{self.width} or {self.wide} bits",
                got=str(min(by_width)),
                fix="find formats with --widen and --held-width alike, or lower the graph to C",
            )
        self.bound: Bound = player.bind(key)
        self.shortest = shortest_row(self.pipeline)
        self.values: dict[int, np.ndarray] = {}
        self._begin()
        program = self.bound.program
        doubtful = absent.may_be_nan(program.instructions, self.formats.absent)
        for i in program.instructions:
            self.here = f"v{i.out} {i.op}, {i.line}"
            if any(a in doubtful for a in i.args) and i.op not in _MAY_BE_NONE:
                raise LoweringError(
                    "this may meet a reading that is not there",
                    path=i.line,
                    expected="numbers",
                    got=f"{i.op} of what may be NaN",
                    fix="choose a number in its place first: xp.where(xp.isnan(z), 0.0, z)",
                )
            widths = self.bound.widths
            site = site_of(i, self.bound.fractions, widths, program.specs, self.width)
            self.now = widths.get(i.out, self.width)
            self.values[i.out] = made = self._made(site)
            if i.out not in doubtful:
                self.doubtful.difference_update(map(root_of, made.ravel().tolist()))
        self.here = "registers"
        self.writes = self._writes()
        self.outputs: list[tuple[int | None, list[np.ndarray]]] = []
        for flag, leaves in program.outputs:
            if flag is None:
                self.outputs.append((None, []))
            else:
                there = self.word(int(self.values[flag].ravel()[0]))
                self.outputs.append((there, [self.values[n] for n in leaves]))

    def _begin(self) -> None:
        """Words that are there before: registers, inputs, constants."""
        for value, spec in held_values(self.pipeline).items():
            self.values[value] = self._held(value, spec)
        for value, array in self.bound.known.items():
            if value in self.values:  # an input that is not there
                spec = self.pipeline.specs[value]
                array = np.zeros(spec.shape, np.int64)
            if self.bound.program.specs[value].dtype == "real":
                flat = [self.constant(w) for w in np.asarray(array).ravel().tolist()]
                self.values[value] = np.array(flat, dtype=np.int64).reshape(np.shape(array))
            else:
                spec = self.bound.program.specs[value]
                made = [self._split(int(w), spec.dtype) for w in np.asarray(array).ravel().tolist()]
                self.values[value] = stacked(made, np.shape(array), self)

    def _split(self, word: int, dtype: str) -> tuple[int, ...]:
        if -(2**32) < word < 2**32:
            return (self.constant(word),)
        high = word >> 32
        return self.constant(word & 0xFFFFFFFF), self.constant(
            high if dtype == "int64" else high & 0xFFFFFFFF
        )

    def _held(self, value: int, spec: Spec) -> np.ndarray:
        size, real = math.prod(spec.shape), spec.dtype == "real"
        width = self.bound.widths.get(value, self.width) if real else 0
        halves = 2 if spec.dtype in ("int64", "uint64") else 1
        long = spec.shape[-1] if spec.shape and self.shortest else 0
        if halves == 1 and long and long >= self.shortest:
            rows = [self.add(Held(value, k, False, width, long)) for k in range(0, size, long)]
            low = np.array([self.elements(n, long) for n in rows]).ravel().tolist()
        else:
            rows = low = [self.add(Held(value, k, False, width)) for k in range(size)]
        if spec.dtype == "bool":
            self.sizes.update(dict.fromkeys(rows, 1))
        if real:
            if value in self.formats.absent:
                self.doubtful.update(rows)
            return np.array(low, dtype=np.int64).reshape(spec.shape)
        parts = [low]
        if halves == 2:
            parts.append([self.add(Held(value, k, True)) for k in range(size)])
        return np.array(parts, dtype=np.int64).T.reshape(*spec.shape, halves)

    def _made(self, s: Site) -> np.ndarray:
        i = s.i
        args = [self.values[a] for a in i.args]
        kinds = [s.specs[a].dtype for a in i.args]
        real = i.spec.dtype == "real"
        if i.op in ("isnan", "isfinite"):
            return self._asked(s, args[0], kinds[0])
        if i.op == "astype" and kinds[0] != i.spec.dtype:
            if real:
                return self.to_real(s, args[0])
            if kinds[0] == "real":
                return self.from_real(s, args[0])
        if i.op in ("negative", "abs") and real:
            make = self.negated if i.op == "negative" else self.size
            return self._each(i.spec.shape, make, (args[0],))
        if i.op in ("materialise", "positive", "astype") and kinds[0] == i.spec.dtype:
            return args[0]
        if i.op in shifts.MOVES and i.op not in ("negative", "abs"):
            return self._moved(s, args, real)
        if i.op in ("sort", "argsort"):
            return self._sorted(s, args[0], kinds[0] == "real")
        if i.op == "cumulative_sum":
            return self._running(s, args[0], real)
        if i.op == "searchsorted":
            return self._search(s, args, kinds[0] == "real")
        if i.op in ("any", "all", "sum", "max", "min", "argmax", "argmin") and not (i.op == "sum" and real):
            return self._along(s, args[0], kinds[0] == "real")
        if i.op == "where" and real:
            return self._where(s, np.broadcast_to(args[0][..., 0], i.spec.shape), *args[1:])
        if i.op in ("sum", "matmul", "vecdot"):
            return self.total(s, args)
        if i.op in COMPARE and kinds[0] == "real":
            return self.comparison(s, *args)[..., None]
        if real and all(k == "real" for k in kinds):
            return self.real(s, args)
        if "real" not in kinds and not real:
            return self.whole_numbers(s, args)
        raise no_form(i)

    def _asked(self, s: Site, x: np.ndarray, kind: str) -> np.ndarray:
        nan = s.i.op == "isnan"
        if kind != "real":
            return np.full((*s.i.spec.shape, 1), self.constant(int(not nan)))

        def one(a: int) -> int:
            return self.sum([Term("ISNAN", a, self.one)], mode="NE" if nan else "EQ")

        return self._each(s.i.spec.shape, one, (x,))[..., None]

    def _moved(self, s: Site, args: list[np.ndarray], real: bool) -> np.ndarray:
        i = s.i
        if i.op == "take":
            return self._take(s, args, real)
        if i.op in ("tril", "triu"):
            kept = OPS[i.op].run(NUMPY, np.ones(i.spec.shape, bool), **i.attrs)
            return np.where(kept, args[0], self.zero)
        if real:
            return np.asarray(OPS[i.op].run(NUMPY, *args, **i.attrs))
        most = max(a.shape[-1] for a in args)
        alike = [a if a.shape[-1] == most else self._longer(a) for a in args]
        halves = [
            np.asarray(OPS[i.op].run(NUMPY, *[a[..., k] for a in alike], **i.attrs)) for k in range(most)
        ]
        return np.stack(halves, axis=-1)

    def _longer(self, a: np.ndarray) -> np.ndarray:
        return self.each_line(a.shape[:-1], lambda x: self.long((x,)), [a[..., 0]])

    def _along(self, s: Site, x: np.ndarray, real: bool) -> np.ndarray:
        """Truth of some or all, sums of whole numbers, extremes and their places, along axes."""
        i = s.i
        words = x[..., None] if real else x
        rank = words.ndim - 1
        axes = shifts.axes_of(i)(rank)
        inner = [a for a in range(rank) if a not in axes]
        rows = np.transpose(words, [*inner, *axes, rank])
        count = math.prod(words.shape[a] for a in axes)
        over = tuple(words.shape[a] for a in inner)
        depth = words.shape[-1]
        rows = rows.reshape(*over, count, depth)
        moved: list[np.ndarray] = []
        if real:
            at = shifts.common_along(s.real(0), axes)
            by = np.transpose(shifts.between(s.real(0), np.broadcast_to(at, x.shape)), [*inner, *axes])
            ends = np.transpose(at, [*inner, *axes]).reshape(over) - np.broadcast_to(
                s.out, i.spec.shape
            ).reshape(over)
            moved = [*np.moveaxis(by.reshape(*over, count), -1, 0), ends]

        def one(*x: int) -> tuple[int, ...]:
            if real:
                return (self._extreme(i.op, x[:count], x[count:-1], x[-1]),)
            return self._whole_along(s, [x[k : k + depth] for k in range(0, count * depth, depth)])

        args = [rows[..., k, w] for k in range(count) for w in range(depth)]
        made = self.each_line(over, one, args, moved, elements=True)
        made = made.reshape(*i.spec.shape, made.shape[-1])
        return made[..., 0] if i.spec.dtype == "real" else made

    def _extreme(self, op: str, numbers: Sequence[int], by: Sequence[int], end: int) -> int:
        """The largest or smallest of words at one fraction, to which `by` shifts each, or its place.

        What is best so far is kept as it lies, a word for each shift, of which all but one are zero: at the
        finest fraction of all it might fit no word.
        """
        if op in ("max", "min") and -min(by) <= WORD - self.now:
            ones = [self.one] * len(numbers)
            terms = self.along("MUL", zip(numbers, ones, by, strict=True), op == "min")
            if any(t.times for t in terms):
                peak = self.sum(terms, mode="RAW", gather="peak")
                return self.sum([self.plain(peak, 0, op == "min")], end=end)
        row = [self.word(n) for n in numbers]
        mode, turned = COMPARE["greater" if op in ("max", "argmax") else "less"]
        best, place = {by[0]: row[0]}, self.zero
        for k in range(1, len(row)):
            held = [self.plain(word, shift, not turned) for shift, word in best.items()]
            other = self.sum([self.plain(row[k], by[k], turned), *held], mode=mode)
            if op.startswith("arg"):
                place = self.chosen(other, self.constant(k), place, mode="RAW")
            best = {
                shift: self.chosen(
                    other, row[k] if shift == by[k] else self.zero, best.get(shift, self.zero), mode="RAW"
                )
                for shift in dict.fromkeys([*best, by[k]])
            }
        if op.startswith("arg"):
            return place
        return self.sum([self.plain(word, shift) for shift, word in best.items()], end=end)

    def _whole_along(self, s: Site, row: list[tuple[int, ...]]) -> tuple[int, ...]:
        op = s.i.op
        if op == "sum":
            parts = [[(x[k], self.one, -32 * k) for x in row] for k in range(len(row[0]))]
            return self.wrapped([t for part in parts for t in self.along("MUL", part)], s.i.spec.dtype)
        if op in ("any", "all") and all(len(x) == 1 for x in row):
            kind, mode = ("SEL", "NE") if op == "any" else ("SELN", "EQ")
            return (self.sum(self.along(kind, [(self.one, x[0], 0) for x in row]), mode=mode),)
        raise no_form(s.i)

    def _writes(self) -> dict[Held, int]:
        cells = [c for r in self.pipeline.registers for c in r.cells]
        found: dict[Held, int] = {}
        for c, n in zip(cells, self.bound.program.writes, strict=True):
            if n == c.read:
                continue
            new, old = self.values[n], self.values[c.read]
            if c.dtype == "real":
                by = shifts.between(self.bound.fractions[n], self.bound.fractions[c.read])
                by = np.broadcast_to(by, c.shape)
                self.now = self.bound.widths[c.read]
                new = self._each(
                    c.shape, lambda x, b: self.sum([self.plain(x, b)]), (np.broadcast_to(new, c.shape),), by
                )
            elif new.shape[-1] < old.shape[-1]:
                new = self._longer(new)
            new = np.broadcast_to(new, old.shape)
            flat, wanted = old.ravel().tolist(), new.ravel().tolist()
            k = 0
            while k < len(flat):
                size = max(self.row(root_of(flat[k])), 1)
                source = self.row_of(wanted[k : k + size])
                for to, n in (
                    [(root_of(flat[k]), source)]
                    if source is not None
                    else [
                        (self.word(to), self.word(n))
                        for to, n in zip(flat[k : k + size], wanted[k : k + size], strict=True)
                    ]
                ):
                    held = self.nodes[to]
                    assert isinstance(held, Held)
                    if to != n:
                        found[held] = n
                k += size
        return found


def held_values(pipeline: Pipeline) -> dict[int, Spec]:
    """The values that the memory holds before a tick, with their kinds: registers, inputs, time, seed."""
    found = {c.read: Spec(c.shape, c.dtype) for r in pipeline.registers for c in r.cells}
    found |= {leaf.value: Spec(leaf.shape, leaf.dtype) for port in pipeline.inputs for leaf in port.leaves}
    return found | {pipeline.time: Spec((), "int64"), pipeline.seed: Spec((2,), "uint32")}


def shortest_row(pipeline: Pipeline) -> int:
    """From which length on an axis is made in loops: a quarter of the particles, or 0 without such.

    Particles are an axis that has a name, the last of registers of several shapes. Their random words come
    four at a time.
    """
    ends: dict[int, set[tuple[int, ...]]] = {}
    for r in pipeline.registers:
        for c in r.cells:
            named = len(c.axes) == len(c.shape) > 0 and c.axes[-1]
            if named and c.shape[-1] >= _PARTICLES and c.shape[-1] not in c.shape[:-1]:
                ends.setdefault(c.shape[-1], set()).add(c.shape[:-1])
    sizes = [n for n, shapes in ends.items() if len(shapes) > 1]
    return max(-(-min(sizes) // 4), _SHORT) if sizes else 0


__all__ = ["NOT_A_NUMBER", "Tick", "held_values"]
