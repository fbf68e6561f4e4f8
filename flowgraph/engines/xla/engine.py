"""The XLA engine behind the contract of engines; JAX is imported when it is first used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.contract import (
    ManyOutcome,
    ManyRuns,
    Outcome,
    PipelineEngine,
    Player,
)
from flowgraph.engines.forks import refuse_lost_threads
from flowgraph.engines.options import Meter, RunOptions
from flowgraph.engines.stretches import gathered
from flowgraph.engines.xla.batch import vectorised
from flowgraph.engines.xla.devices import RUNS, Devices, chosen_device, enough_devices, import_jax
from flowgraph.engines.xla.scan import Scan, chunk_size
from flowgraph.errors import DeclarationError
from flowgraph.pipeline.optimise import ARRAYS
from flowgraph.pipeline.pipeline import Pipeline


class _Compiled(Player):
    def __init__(self, scan: Scan) -> None:
        self._scan = scan

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        columns = [list(series.leaves.values()) for series in tape.series]
        self._scan.compile(cells, seed, columns)
        done = 0
        start = perf_counter()
        outputs = gathered(self._scan.pipeline, tape)
        for part, after in self._scan(cells, seed, tape.time, tape.key, columns, tape.rows):
            cells = after
            times = tape.time[done : done + part.ticks]
            for output, (mask, leaves) in zip(outputs, part.outputs, strict=True):
                if mask is None or mask.all():
                    output.add(part.ticks, times, leaves)
                else:
                    output.add(part.ticks, times[mask], [leaf[mask] for leaf in leaves])
            done += part.ticks
            if progress is not None:
                progress.update(done, int(times[-1]))
        rows = [output.rows() for output in outputs]
        return Outcome(cells, rows, perf_counter() - start)


class XlaEngine(PipelineEngine):
    """The instructions in one compiled scan over the ticks, and under `vmap` over runs; needs JAX."""

    name = "xla"
    passes = ARRAYS
    takes_many = True
    shards = True

    def __init__(self, shard: Mapping[str, int] | None = None) -> None:
        self._shard = shard or {}

    def with_shard(self, shard: Mapping[str, int] | None) -> XlaEngine:
        if RUNS in (shard or {}):
            raise DeclarationError(
                "a run by itself is no runs to share out",
                path="shard",
                expected="axes that the types of the graph name, such as particles",
                got=str(shard),
                fix="ask for many runs, or leave runs out; with host blocks a graph runs one by one",
            )
        return XlaEngine(shard)

    def need(self) -> None:
        refuse_lost_threads()
        import_jax()

    def need_devices(self, shard: Mapping[str, int]) -> None:
        enough_devices(shard)

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        chunk = chunk_size(pipeline, ticks)
        which = (tuple(patterns), dtype, chunk, passes, chosen_device(), tuple(self._shard.items()))
        kept: dict[Any, Scan] = pipeline.__dict__.setdefault("_scans", {})  # as long as the pipeline lives
        if which not in kept:
            devices = Devices(pipeline, self._shard) if self._shard else None
            kept[which] = Scan(
                pipeline, tuple(patterns), np.dtype(dtype), chunk, passes=passes, devices=devices
            )
        return _Compiled(kept[which])

    def play_many(self, runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
        return vectorised(runs, passes, options)


ENGINE = XlaEngine()
