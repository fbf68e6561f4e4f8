"""One run of a pipeline over recorded events, in any engine that plays pipelines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.engines.contract import PipelineEngine
from flowgraph.engines.options import RunOptions
from flowgraph.engines.registry import find_pipeline_engine
from flowgraph.engines.subject import LoadedPipeline, Subject
from flowgraph.errors import FifoOverflowError
from flowgraph.language.graph import NEVER
from flowgraph.pipeline.optimise import check_passes, usable
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words
from flowgraph.types import DTYPES, unflatten


def run_pipeline(pipeline: Pipeline, inputs: Inputs, *, engine: str = "reference", **options: Any) -> Result:
    """Play a pipeline without its graph; see `Pipeline.run`."""
    return play(LoadedPipeline(pipeline), inputs, RunOptions(engine=engine, **options))


def play(subject: Subject, inputs: Any, options: RunOptions) -> Result:
    """Play what was lowered over its inputs to their end."""
    engine = find_pipeline_engine(options.engine)
    engine.check(options)
    pipeline = subject.pipeline
    start = subject.start(options)
    events = subject.tape(inputs, start.last)
    pipeline.need_numbers(options.dtype)
    engine.need()
    passes = usable(pipeline, chosen_passes(engine, options), start.cells)
    player = engine.prepare(pipeline, events.patterns, len(events.time), options.dtype, passes)
    outcome = player.play(events, start.cells, seed_words(start.seed), options.progress)
    check_faults(pipeline, outcome.cells)
    series = {
        port.name: Series(times, unflatten(type_, iter(leaves)), type=type_, name=port.name)
        for port, type_, (times, leaves) in zip(pipeline.outputs, subject.types, outcome.outputs, strict=True)
    }
    last = {
        name: int(s.time[-1]) if len(s) else before
        for (name, before), s in zip(start.last.items(), events.series, strict=True)
    }
    state = _state(pipeline, outcome.cells, last, start.seed)
    stats = {
        f"{f.path}.{name}": int(count)
        for f in pipeline.faults
        for name, count in state["registers"][f.register].items()
        if name.startswith("expired")
    }
    return Result(pipeline.name, options.engine, series, state, stats, len(events.time), outcome.wall_s)


def chosen_passes(engine: PipelineEngine, options: RunOptions) -> tuple[str, ...]:
    """The passes that were asked for, or those that suit the engine, in order."""
    return check_passes(engine.passes if options.passes is None else options.passes)


def check_faults(pipeline: Pipeline, cells: list[Any]) -> None:
    """Refuse register cells that hold the time at which a queue overflowed.

    Raises:
        FifoOverflowError: naming the join, its bound and the time.
    """
    values = iter(cells)
    found = {(r.path, c.name): next(values) for r in pipeline.registers for c in r.cells}
    for fault in pipeline.faults:
        time = int(found[fault.register, fault.cell])
        if time != NEVER:
            raise FifoOverflowError(
                fault.message,
                path=fault.path,
                expected=f"at most {fault.bound} waiting values of one stream",
                got=f"one more at t = {time} ns",
                fix="raise size=, or look why the other stream is silent",
            )


def _state(pipeline: Pipeline, cells: list[Any], last: Mapping[str, int], seed: int) -> dict[str, Any]:
    values = iter(cells)
    registers: dict[str, Any] = {}
    for register in pipeline.registers:
        parts: dict[str, np.ndarray] = {
            c.name: np.asarray(next(values)).astype(DTYPES[c.dtype]) for c in register.cells
        }
        registers[register.path] = parts["value"] if list(parts) == ["value"] else parts
    return {
        "registers": registers,
        "sources": {n: np.asarray(t, dtype=np.int64) for n, t in last.items()},
        "seed": np.asarray(seed, dtype=np.uint64),
    }
