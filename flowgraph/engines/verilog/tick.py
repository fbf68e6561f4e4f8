"""A tick as words: the instructions of one pattern of present inputs, element by element."""

from __future__ import annotations

import math

import numpy as np

from flowgraph.engines.fixed import absent, shifts
from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.engines.fixed.shifts import Site
from flowgraph.engines.verilog.nodes import Held, Term
from flowgraph.engines.verilog.real import COMPARE, no_form
from flowgraph.engines.verilog.whole import Whole, stacked
from flowgraph.errors import LoweringError
from flowgraph.pipeline.formats import NOT_A_NUMBER
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, Spec

_MAY_BE_NONE = frozenset(
    ["add", "subtract", "multiply", "where", "negative", "abs", "positive", "materialise"]
) | frozenset(("isnan", "isfinite", *COMPARE)) | (shifts.MOVES - {"take"})  # fmt: skip


class Tick(Whole):
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
        super().__init__(player.formats.width, max(player.formats.width, player.formats.held_width))
        self.pipeline, self.key = player.pipeline, key
        self.formats = player.formats
        self.bound: Bound = player.bind(key)
        self.values: dict[int, np.ndarray] = {}
        self._begin()
        program = self.bound.program
        doubtful = absent.may_be_nan(program.instructions, self.formats.absent)
        for i in program.instructions:
            self.here = f"v{i.out} {i.op}, {i.line}"
            given = [self.bound.fractions.get(a) for a in i.args]
            out = self.bound.fractions.get(i.out) if i.spec.dtype == "real" else None
            if any(a in doubtful for a in i.args) and i.op not in _MAY_BE_NONE:
                raise LoweringError(
                    "this may meet a reading that is not there",
                    path=i.line,
                    expected="numbers",
                    got=f"{i.op} of what may be NaN",
                    fix="choose a number in its place first: xp.where(xp.isnan(z), 0.0, z)",
                )
            widths = self.bound.widths
            taken = [widths[a] for a in i.args if a in widths]
            site = Site(i, given, out, program.specs, max(taken, default=self.width))
            self.now = widths.get(i.out, self.width)
            self.values[i.out] = made = self._made(site)
            if i.out not in doubtful:
                self.doubtful.difference_update(made.ravel().tolist())
        self.here = "registers"
        self.writes = self._writes()
        self.outputs: list[tuple[int | None, list[np.ndarray]]] = []
        for flag, leaves in program.outputs:
            if flag is None:
                self.outputs.append((None, []))
            else:
                self.outputs.append((int(self.values[flag].ravel()[0]), [self.values[n] for n in leaves]))

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
        low = [self.add(Held(value, k, False, width)) for k in range(size)]
        if real:
            if value in self.formats.absent:
                self.doubtful.update(low)
            return np.array(low, dtype=np.int64).reshape(spec.shape)
        halves = [low]
        if spec.dtype in ("int64", "uint64"):
            halves.append([self.add(Held(value, k, True)) for k in range(size)])
        return np.array(halves, dtype=np.int64).T.reshape(*spec.shape, len(halves))

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
            return self._each(i.spec.shape, make, args[0])
        if i.op in ("materialise", "positive", "astype") and kinds[0] == i.spec.dtype:
            return args[0]
        if i.op in shifts.MOVES and i.op not in ("negative", "abs"):
            return self._moved(s, args, real)
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

        return self._each(s.i.spec.shape, one, x)[..., None]

    def _moved(self, s: Site, args: list[np.ndarray], real: bool) -> np.ndarray:
        i = s.i
        if i.op == "take":
            raise no_form(i)
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
        rows = [self.long(tuple(x)) for x in a.reshape(-1, 1).tolist()]
        return np.array(rows, dtype=np.int64).reshape(*a.shape[:-1], 2)

    def _along(self, s: Site, x: np.ndarray, real: bool) -> np.ndarray:
        """Truth of some or all, sums of whole numbers, extremes and their places, along axes."""
        i = s.i
        words = x[..., None] if real else x
        rank = words.ndim - 1
        axes = shifts.axes_of(i)(rank)
        inner = [a for a in range(rank) if a not in axes]
        rows = np.transpose(words, [*inner, *axes, rank])
        count = math.prod(words.shape[a] for a in axes)
        rows = rows.reshape(-1, count, words.shape[-1])
        if real:
            at = shifts.common_along(s.real(0), axes)
            by = np.transpose(shifts.between(s.real(0), np.broadcast_to(at, x.shape)), [*inner, *axes])
            ends = (
                np.transpose(at, [*inner, *axes]).ravel() - np.broadcast_to(s.out, i.spec.shape).ravel()
            ).tolist()
            made: list[tuple[int, ...]] = [
                (self._extreme(i.op, row[:, 0].tolist(), b.tolist(), end),)
                for row, b, end in zip(rows, by.reshape(-1, count), ends, strict=True)
            ]
        else:
            made = [self._whole_along(s, [tuple(w) for w in row.tolist()]) for row in rows]
        out = stacked(made, i.spec.shape, self)
        return out[..., 0] if i.spec.dtype == "real" else out

    def _extreme(self, op: str, row: list[int], by: list[int], end: int) -> int:
        order = "greater" if op in ("max", "argmax") else "less"
        best, best_by, place = row[0], by[0], self.zero
        for k in range(1, len(row)):
            other = self.compared(order, row[k], best, by[k], best_by)
            if op.startswith("arg"):
                place = self.chosen(other, self.constant(k), place, mode="RAW")
            best, best_by = self.chosen(other, row[k], best, by[k], best_by, mode="RAW"), 0
        if op.startswith("arg"):
            return place
        return self.sum([self.plain(best, best_by)], end=end)

    def _whole_along(self, s: Site, row: list[tuple[int, ...]]) -> tuple[int, ...]:
        op = s.i.op
        if op == "sum":
            return self.wrapped([t for x in row for t in self.terms(x)], s.i.spec.dtype)
        if op in ("any", "all") and all(len(x) == 1 for x in row):
            kind, mode = ("SEL", "NE") if op == "any" else ("SELN", "EQ")
            return (self.sum([Term(kind, self.one, x[0]) for x in row], mode=mode),)
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
                    c.shape, lambda x, b: self.sum([self.plain(x, b)]), np.broadcast_to(new, c.shape), by
                )
            elif new.shape[-1] < old.shape[-1]:
                new = self._longer(new)
            new = np.broadcast_to(new, old.shape)
            for to, source in zip(old.ravel().tolist(), new.ravel().tolist(), strict=True):
                held = self.nodes[to]
                assert isinstance(held, Held)
                if to != source:
                    found[held] = source
        return found


def held_values(pipeline: Pipeline) -> dict[int, Spec]:
    """The values that the memory holds before a tick, with their kinds: registers, inputs, time, seed."""
    found = {c.read: Spec(c.shape, c.dtype) for r in pipeline.registers for c in r.cells}
    found |= {leaf.value: Spec(leaf.shape, leaf.dtype) for port in pipeline.inputs for leaf in port.leaves}
    return found | {pipeline.time: Spec((), "int64"), pipeline.seed: Spec((2,), "uint32")}


__all__ = ["NOT_A_NUMBER", "Tick", "held_values"]
