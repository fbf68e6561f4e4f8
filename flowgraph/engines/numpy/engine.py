"""The NumPy engine behind the contract of engines."""

from __future__ import annotations

import math
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.contract import Outcome, PipelineEngine, Player, real_leaves
from flowgraph.engines.numpy.guards import present_in
from flowgraph.engines.numpy.plan import Plan, planned
from flowgraph.engines.numpy.steps import Stretch
from flowgraph.engines.options import Meter
from flowgraph.engines.stretches import gathered
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import DTYPES

TICKS, NUMBERS = 8192, 1 << 21
"""How many ticks are done at once at most, and how many numbers the largest value may have in them: what a
small value takes then stays within a processor's cache, and a cloud takes no more memory in a longer run."""


class _Prepared(Player):
    def __init__(
        self, pipeline: Pipeline, patterns: tuple[int, ...], real: Any, passes: Sequence[str]
    ) -> None:
        self.pipeline, self.patterns, self.real = pipeline, patterns, real
        self.plan = planned(pipeline, patterns, real, passes)
        largest = max((math.prod(spec.shape) for spec in self.plan.program.specs.values()), default=1)
        self.most = max(NUMBERS // max(largest, 1), 1)

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        program = self.plan.program
        held = {n: self._number(c) for n, c in zip(program.reads, cells, strict=True)}
        outputs = gathered(self.pipeline, tape)
        start = perf_counter()
        with np.errstate(all="ignore"):
            fixed = self._fixed(held, seed)
            which = np.searchsorted(self.patterns, tape.key)
            inputs = [[np.moveaxis(x, 0, -1) for x in real_leaves(s, self.real)] for s in tape.series]
            rows = [0] * len(inputs)
            size = min(self.most, TICKS)
            for first in range(0, len(tape.time), size):
                span = slice(first, first + size)
                ticks = Stretch(tape.time[span], which[span], self.plan.every, held, fixed, seed)
                self._give(ticks, inputs, rows)
                for step, done in zip(self.plan.steps, self.plan.done, strict=True):
                    step.play(ticks)
                    for n in done:
                        ticks.values.pop(n, None)
                for output, found in zip(outputs, self._outputs(ticks), strict=True):
                    output.add(len(ticks.times), *found)
                every = self.plan.every
                held = {
                    r: np.array(ticks.at(w, every)[..., -1])
                    for r, w in zip(program.reads, program.writes, strict=True)
                }
                if progress is not None:
                    progress.update(first + len(ticks.times), int(ticks.times[-1]))
        collected = [output.rows() for output in outputs]
        return Outcome([held[n] for n in program.reads], collected, perf_counter() - start)

    def _number(self, value: Any) -> Any:
        found = np.asarray(value)
        return found.astype(self.real) if found.dtype.kind == "f" else found

    def _fixed(self, held: dict[int, Any], seed: np.ndarray) -> dict[int, Any]:
        """The values that are the same in all ticks, with a last axis of 1."""
        plan: Plan = self.plan
        known = {n: self._number(a)[..., None] for n, a in plan.program.constants.items()}
        known[self.pipeline.seed] = seed[..., None]
        known.update({n: held[n][..., None] for n in plan.stays})
        one = Stretch(np.zeros(1, np.int64), np.zeros(1, np.intp), 1, {}, known, seed)
        for step in plan.once:
            step.play(one)
            known.update({n: one.values[n][1] for n in step.makes})
        return known

    def _give(self, ticks: Stretch, inputs: list[list[np.ndarray]], rows: list[int]) -> None:
        """Put time, presence and the events of these ticks into the stretch."""
        every = self.plan.every
        ticks.values[self.pipeline.time] = every, ticks.times
        for k, port in enumerate(self.pipeline.inputs):
            where = present_in(k, self.patterns)
            ticks.values[port.present] = every, ticks.mask(where)
            begin, rows[k] = rows[k], rows[k] + len(ticks.rows(where))
            for leaf, column in zip(port.leaves, inputs[k], strict=True):
                ticks.values[leaf.value] = where, column[..., begin : rows[k]]

    def _outputs(self, ticks: Stretch) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        """The times of each output, and its leaves with the ticks first."""
        found = []
        every = self.plan.every
        for port, (flag, leaves) in zip(self.pipeline.outputs, self.plan.program.outputs, strict=True):
            where = 0 if flag is None else self.plan.bounds.get(flag, (0, every))[1]
            if flag is None or not where:
                none: list[np.ndarray] = [
                    np.zeros((0, *leaf.shape), DTYPES[leaf.dtype]) for leaf in port.leaves
                ]
                found.append((np.zeros(0, np.int64), none))
                continue
            present = ticks.full(flag, where)
            whole = present.all()
            times = ticks.times[ticks.rows(where)]
            columns: list[np.ndarray] = []
            for n, leaf in zip(leaves, port.leaves, strict=True):
                column = ticks.full(n, where)
                column = np.moveaxis(column if whole else column[..., present], -1, 0)
                columns.append(np.ascontiguousarray(column, DTYPES[leaf.dtype]))
            found.append((times if whole else times[present], columns))
        return found


class NumpyEngine(PipelineEngine):
    """The instructions in NumPy, each over all ticks at once; what loops, tick by tick."""

    name = "numpy"
    passes = ("fold", "share", "drop")

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        which = (tuple(patterns), dtype, passes)
        kept: dict[Any, Player] = pipeline.__dict__.setdefault("_whole", {})  # as long as the pipeline lives
        if which not in kept:
            kept[which] = _Prepared(pipeline, tuple(patterns), np.dtype(dtype), passes)
        return kept[which]


ENGINE = NumpyEngine()
