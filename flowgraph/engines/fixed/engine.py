"""The engine `fixed`: plays a pipeline in integers, in the formats that it carries."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.contract import Outcome, PipelineEngine, Player
from flowgraph.engines.fixed.absent import Run, keeping_nan, may_be_nan, passing_nan
from flowgraph.engines.fixed.counts import Counts
from flowgraph.engines.fixed.rules import bind, to
from flowgraph.engines.fixed.shifts import MOVES, READ_WHOLE, Site, moved
from flowgraph.engines.options import Meter
from flowgraph.errors import DataError, DeclarationError, LoweringError
from flowgraph.pipeline.formats import (
    FREE,
    NOT_A_NUMBER,
    WIDEST,
    fraction_of_constant,
    real_numbers,
    whole_numbers,
)
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, needed_of, specialise
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

LOSE: dict[str, Callable[..., Any]] = {
    "multiply": lambda a, b: (a != 0) & (b != 0),
    "divide": lambda a, b: (a != 0) & (b != 0),
    "sqrt": lambda x: x > 0,
    "exp": lambda x: np.ones(np.shape(x), bool),
}
"""For operations whose words may be lost, where of its arguments the result is not zero."""


@dataclass(frozen=True)
class _Step:
    run: Run
    args: tuple[int, ...]
    out: int
    real: bool
    op: str
    drop: tuple[int, ...]


@dataclass(frozen=True)
class Bound:
    """A program with its shifts worked out."""

    program: Program
    steps: tuple[_Step, ...]
    known: dict[int, Any]
    fractions: dict[int, np.ndarray]
    writes: tuple[Run | None, ...]
    widths: dict[int, int]

    def most(self, value: int) -> int:
        """The largest word of a value."""
        return int(2 ** (self.widths[value] - 1) - 1)


class Integers:
    """Plays ticks of one pipeline in its formats, keeping its registers as words.

    Args:
        pipeline: what to play, with formats.
        cells: the value of each register cell, in order, as reals where they are real.
        seed: (2,) uint32.

    Attributes:
        counts: what did not fit, so far.
    """

    def __init__(self, pipeline: Pipeline, cells: Sequence[Any], seed: np.ndarray) -> None:
        self.pipeline, self.seed = pipeline, seed
        formats = need_formats(pipeline).formats
        assert formats is not None
        self.formats = formats
        self.most = np.int64(2 ** (self.formats.width - 1) - 1)
        self.counts = Counts()
        self._cells = [c for r in pipeline.registers for c in r.cells]
        self._bound: dict[int, Bound] = {}
        self.cells = [
            self.words(c.read, v, c.shape) if c.dtype == "real" else np.asarray(v)
            for c, v in zip(self._cells, cells, strict=True)
        ]

    def words(self, value: int, x: Any, shape: tuple[int, ...]) -> np.ndarray:
        """Reals as words of an input's or register's format; `x` may have axes before `shape`."""
        real = np.asarray(x, dtype=np.float64)
        fraction = self.fraction(value, shape)
        width = self.formats.width_of(value)
        words = whole_numbers(real, fraction, width)
        with np.errstate(invalid="ignore", over="ignore"):
            off = (
                np.abs(np.ldexp(real, np.where(fraction == FREE, 0, fraction).astype(int)))
                > float(2 ** (width - 1) - 1) + 0.5
            )
        if off.any():
            self.counts.add("saturations", value, np.count_nonzero(off))
            self.counts.mark(value, off.reshape(-1, *shape).any(axis=0))
        if np.isnan(real).any() and value not in self.formats.absent:
            raise DataError(
                "a reading is NaN that never was one when the number formats were found",
                path=self.pipeline.name,
                expected="numbers",
                got="NaN",
                fix="find the formats again on flights in which readings are absent, or drop the row",
            )
        return words

    def fraction(self, value: int, shape: tuple[int, ...]) -> np.ndarray:
        """Of a value that is no move and no constant.

        Raises:
            LoweringError: where the formats do not know it.
        """
        found = self.formats.fractions.get(value)
        if found is None:
            line = next((i.line for i in self.pipeline.instructions if i.out == value), f"value {value}")
            raise LoweringError(
                "a value has no number format",
                path=line,
                expected="a value that was seen when the formats were found",
                got="a tick of a kind that was not seen",
                fix="find them again on flights in which the same sources meet: flowgraph quantise",
            )
        return np.broadcast_to(found, shape)

    def reals(self) -> list[Any]:
        """The register cells as they are read, real numbers as float64."""
        return [
            real_numbers(v, self.fraction(c.read, c.shape)) if c.dtype == "real" else v
            for c, v in zip(self._cells, self.cells, strict=True)
        ]

    def tick(self, time: int, key: int, values: list[tuple[Any, ...]]) -> list[tuple[Any, ...] | None]:
        """One tick: `values` are the leaves of the present inputs; returns those of each output, or None."""
        bound, env = self.values(time, key, values)
        program = bound.program
        cut: dict[int, Any] = {}
        self.cells = [
            np.asarray(env[n]) if end is None else self._fitted(c.read, end(env[n]), cut, bound)
            for c, n, end in zip(self._cells, program.writes, bound.writes, strict=True)
        ]
        for value, off in cut.items():
            self.counts.add("saturations", value, off)
        made: list[tuple[Any, ...] | None] = []
        for flag, leaves in program.outputs:
            if flag is None or not env.get(flag, True):
                made.append(None)
            else:
                made.append(
                    tuple(
                        real_numbers(env[n], bound.fractions[n]) if n in bound.fractions else env[n]
                        for n in leaves
                    )
                )
        return made

    def values(self, time: int, key: int, values: list[tuple[Any, ...]]) -> tuple[Bound, dict[int, Any]]:
        """The bound program of a tick, and every value in it by number: words, integers and truth values."""
        bound = self.bind(key)
        env = dict(bound.known)
        env[self.pipeline.time] = np.int64(time)
        env[self.pipeline.seed] = self.seed
        env.update(zip((c.read for c in self._cells), self.cells, strict=True))
        present = iter(values)
        for k, port in enumerate(self.pipeline.inputs):
            if key >> k & 1:
                for leaf, x in zip(port.leaves, next(present), strict=True):
                    env[leaf.value] = self.words(leaf.value, x, leaf.shape) if leaf.dtype == "real" else x
        cut: dict[int, Any] = {}
        by_zero: dict[int, Any] = {}
        for step in bound.steps:
            given = [env[a] for a in step.args]
            if any(step.drop):
                given = [_upper(x, n) if n else x for x, n in zip(given, step.drop, strict=True)]
            made = step.run(*given)
            if not step.real:
                env[step.out] = made
                continue
            env[step.out] = made = self._fitted(step.out, made, cut, bound)
            lose = LOSE.get(step.op)
            if lose is None:
                continue
            gone = made == 0
            if np.any(gone):
                self.counts.add("lost_bits", step.out, gone & lose(*given))
            if step.op == "divide" and not np.all(given[1]):
                by_zero[step.out] = np.broadcast_to(given[1] == 0, np.shape(made))
        if cut or by_zero:
            taken = needed_of(bound.program, env, [*cut, *by_zero])
            for kind, found in (("saturations", cut), ("divisions_by_zero", by_zero)):
                for value, off in found.items():
                    self.counts.add(kind, value, off & taken.get(value, False))
        return bound, env

    def _fitted(self, value: int, words: Any, cut: dict[int, Any], bound: Bound) -> Any:
        most = bound.most(value)
        off = (np.abs(words) > most) & (words != NOT_A_NUMBER)
        if not off.any():
            return words
        cut[value] = off
        return np.where(off, np.clip(words, -most, most), words)

    def bind(self, key: int) -> Bound:
        """The program of a pattern of present inputs, with its shifts worked out."""
        if key not in self._bound:
            self._bound[key] = self._made(key)
        return self._bound[key]

    def _made(self, key: int) -> Bound:
        program = specialise(self.pipeline, key)
        specs, width = program.specs, self.formats.width
        fractions: dict[int, np.ndarray] = {}
        known: dict[int, Any] = {}
        widths: dict[int, int] = {}
        for n, array in program.constants.items():
            if array.dtype.kind == "f":
                widths[n] = width
                fractions[n] = fraction_of_constant(array, width)
                known[n] = whole_numbers(array, fractions[n], width)
            else:
                known[n] = array
        for k, port in enumerate(self.pipeline.inputs):
            for leaf in port.leaves:
                if not key >> k & 1:  # a selection may name it without taking it
                    known[leaf.value] = np.zeros(
                        leaf.shape, np.int64 if leaf.dtype == "real" else DTYPES[leaf.dtype]
                    )
                if leaf.dtype == "real":
                    widths[leaf.value] = self.formats.width_of(leaf.value)
                    absent = np.full(leaf.shape, FREE)
                    fractions[leaf.value] = self.fraction(leaf.value, leaf.shape) if key >> k & 1 else absent
        for c in self._cells:
            if c.dtype == "real":
                widths[c.read] = self.formats.width_of(c.read)
                fractions[c.read] = self.fraction(c.read, c.shape)
        steps = []
        doubtful = may_be_nan(program.instructions, self.formats.absent)
        for i in program.instructions:
            given = [fractions.get(a) for a in i.args]
            real = i.spec.dtype == "real"
            out = None
            if real:
                out = moved(i, given) if i.op in MOVES else self.fraction(i.out, i.spec.shape)
                fractions[i.out] = np.broadcast_to(out, i.spec.shape)
            if real:
                taken = [widths[a] for a in i.args if a in widths]
                widths[i.out] = max(taken) if i.op in MOVES else self.formats.width_of(i.out)
            site = site_of(i, fractions, widths, specs, width)
            run = bind(site)
            if any(a in doubtful for a in i.args):
                run = passing_nan(i, run)
            steps.append(_Step(run, i.args, i.out, real, i.op, site.drop))
        writes = tuple(
            _moving(fractions[n], fractions[c.read], specs[n]) if c.dtype == "real" else None
            for c, n in zip(self._cells, program.writes, strict=True)
        )
        return Bound(program, tuple(steps), known, fractions, writes, widths)


def site_of(
    i: Instruction,
    fractions: Mapping[int, np.ndarray],
    widths: Mapping[int, int],
    specs: Mapping[int, Spec],
    width: int,
) -> Site:
    """An instruction with its formats: what multiplies reads the upper bits of words that are wider.

    Args:
        i: the instruction.
        fractions, widths: of the real values so far, its result among them.
        specs: of all values.
        width: bits of a word that is not held.
    """
    taken = [widths[a] for a in i.args if a in widths]
    whole = i.op in READ_WHOLE
    drop = [0 if whole else max(widths.get(a, 0) - WIDEST, 0) for a in i.args]
    given = [
        f if f is None or not n else np.where(f == FREE, FREE, f - n)
        for f, n in zip((fractions.get(a) for a in i.args), drop, strict=True)
    ]
    most = max(taken, default=width)
    out = fractions[i.out] if i.spec.dtype == "real" else None
    return Site(i, given, out, specs, most if whole else min(most, WIDEST), drop)


def _upper(x: Any, n: int) -> Any:
    """Words without their lowest n bits: rounded half upwards, but for what would not fit then."""
    upper = np.minimum((x + (1 << (n - 1))) >> n, 2 ** (WIDEST - 1) - 1)
    return np.where(x == NOT_A_NUMBER, NOT_A_NUMBER, upper)


def _moving(have: np.ndarray, want: np.ndarray, spec: Spec) -> Run:
    return keeping_nan(to(np.broadcast_to(have, spec.shape), np.broadcast_to(want, spec.shape)))


def need_formats(pipeline: Pipeline) -> Pipeline:
    """The pipeline, if it carries number formats.

    Raises:
        DeclarationError: where it carries none.
    """
    if pipeline.formats is None:
        raise DeclarationError(
            "this pipeline has no number formats",
            path=pipeline.name,
            expected="formats found by `flowgraph quantise`",
            got="none",
            fix="flowgraph quantise GRAPH --data SPEC -o DIR, then formats=DIR",
        )
    return pipeline


class _Prepared(Player):
    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        ports = self._pipeline.outputs
        player = Integers(self._pipeline, cells, seed)
        rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
        outputs: list[tuple[list[int], list[tuple[Any, ...]]]] = [([], []) for _ in ports]
        start = perf_counter()
        for n, (time, key) in enumerate(zip(tape.time.tolist(), tape.key.tolist(), strict=True)):
            values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
            for (times, kept), leaves in zip(outputs, player.tick(time, key, values), strict=True):
                if leaves is not None:
                    times.append(time)
                    kept.append(leaves)
            if progress is not None and ((n + 1) % 256 == 0 or n + 1 == len(tape.time)):
                progress.update(n + 1, time)
        wall = perf_counter() - start
        stacked = []
        for port, (times, kept) in zip(ports, outputs, strict=True):
            columns: Any = zip(*kept, strict=True) if kept else [[] for _ in port.leaves]
            arrays: list[np.ndarray] = [
                np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
                for column, leaf in zip(columns, port.leaves, strict=True)
            ]
            stacked.append((np.asarray(times, dtype=np.int64), arrays))
        counts = player.counts
        return Outcome(
            player.reals(), stacked, wall, counts.stats(self._pipeline), counts.notes(self._pipeline)
        )


class FixedEngine(PipelineEngine):
    """Integers of a pipeline's formats, in NumPy: the definition of fixed point. Its results are float64."""

    name = "fixed"
    dtypes = ("fixed", "float64")  # the second is what a user gets who leaves dtype out

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        pipeline.need_numbers("fixed")
        return _Prepared(need_formats(pipeline))


ENGINE = FixedEngine()
