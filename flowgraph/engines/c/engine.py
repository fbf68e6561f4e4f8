"""The C engine behind the contract of engines: the pipeline as C99, compiled and called in this process."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs
from flowgraph.data.tape import Tape
from flowgraph.engines.c.batch import threaded
from flowgraph.engines.c.compile import compiler
from flowgraph.engines.c.fixed import CompiledIntegers
from flowgraph.engines.c.fixed_replay import write_fixed
from flowgraph.engines.c.harness import write_c, write_events
from flowgraph.engines.c.library import Compiled, State, compiled
from flowgraph.engines.c.step import SingleTicks
from flowgraph.engines.contract import (
    CellStepper,
    ManyOutcome,
    ManyRuns,
    Outcome,
    PipelineEngine,
    Player,
    real_leaves,
)
from flowgraph.engines.fixed.engine import need_formats
from flowgraph.engines.options import KINDS, Meter, RunOptions
from flowgraph.engines.stretches import gathered
from flowgraph.pipeline.optimise import COMPILED
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words


class _Loaded(Player):
    def __init__(self, library: Compiled) -> None:
        self._library = library

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        library = self._library
        rows = library.rows([real_leaves(s, library.real) for s in tape.series])
        done = 0
        start = perf_counter()
        outputs = gathered(library.pipeline, tape)
        state = State(library, cells, seed)
        for part in library.play(state, tape.time, tape.key, rows):
            times = tape.time[done : done + part.ticks]
            for output, (mask, leaves) in zip(outputs, part.outputs, strict=True):
                output.add(part.ticks, times if mask.all() else times[mask], leaves)
            done += part.ticks
            if progress is not None:
                progress.update(done, int(times[-1]))
        collected = [output.rows() for output in outputs]
        return Outcome(state.after(), collected, perf_counter() - start)


class CEngine(PipelineEngine):
    """Generated C99, compiled by the system's C compiler; many runs go as many threads."""

    name = "c"
    dtypes = KINDS
    passes = COMPILED
    takes_many = True
    writes = True

    def need(self) -> None:
        compiler()

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        if dtype == "fixed":
            return CompiledIntegers(need_formats(pipeline), patterns)
        return _Loaded(compiled(pipeline, np.dtype(dtype), patterns, passes))

    def stepper(
        self, pipeline: Pipeline, cells: list[Any], seed: int, dtype: str, passes: tuple[str, ...]
    ) -> CellStepper | None:
        if dtype == "fixed":
            return None
        every = range(1, 2 ** min(len(pipeline.inputs), 8))  # beyond some patterns, presence is data
        return SingleTicks(compiled(pipeline, np.dtype(dtype), every, passes), cells, seed_words(seed))

    def play_many(self, runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
        return threaded(runs, passes, options)

    def write(
        self, pipeline: Pipeline, folder: Path, dtype: str, passes: Collection[str]
    ) -> Mapping[str, Path]:
        if dtype == "fixed":
            return write_fixed(pipeline, folder)
        return write_c(pipeline, folder, dtype, passes=passes)

    def write_events(self, pipeline: Pipeline, inputs: Inputs | Mapping[str, Any], file: Path) -> int:
        return write_events(pipeline, inputs, file)


ENGINE = CEngine()
