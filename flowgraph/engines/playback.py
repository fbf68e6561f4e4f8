"""One run of a pipeline over recorded events, in any engine that plays pipelines."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs
from flowgraph.data.result import COUNTED, Result
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape
from flowgraph.engines.checkpoint import Keeper, identity, pipeline_digest
from flowgraph.engines.contract import Outcome, PipelineEngine
from flowgraph.engines.options import Checkpoint, Meter, RunOptions
from flowgraph.engines.registry import find_pipeline_engine
from flowgraph.engines.subject import LoadedPipeline, Start, Subject
from flowgraph.engines.trouble import Playback, cells_of, gaps_of, overflow, settled
from flowgraph.errors import DeclarationError
from flowgraph.pipeline.format_files import load_formats, with_formats
from flowgraph.pipeline.formats import Formats
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
    engine = engine.with_shard(options.shard)
    pipeline = _formatted(subject.pipeline, engine, options)
    start = subject.start(options)
    events = subject.tape(inputs, start.last)
    pipeline.need_numbers(options.dtype)
    engine.need()
    passes = usable(pipeline, chosen_passes(engine, options), start.cells)
    player = engine.prepare(pipeline, events.patterns, len(events.time), options.dtype, passes)
    words = seed_words(start.seed)

    def played(tape: Tape, progress: Meter | None = None, start: Start = start) -> Result:
        outcome = player.play(tape, start.cells, words, progress)
        return _result(subject, pipeline, outcome, tape, start, options.engine)

    def kept(asked: Checkpoint) -> Result:
        begun = (start.cells, start.last)
        which = identity(
            pipeline.name, pipeline_digest(pipeline), events, begun, start.seed, options, passes=passes
        )
        types = dict(zip((p.name for p in pipeline.outputs), subject.types, strict=True))
        keeper, now = Keeper(asked, which, events, types), start
        if keeper.start is not None:
            now = subject.start(options.but(init=None, state=keeper.start.state))

        def stretch(first: int, last: int) -> Result:
            nonlocal now
            part = played(events.part(first, last), keeper.meter(options.progress), now)
            last_times = {n: int(t) for n, t in part.state["sources"].items()}
            now = Start(cells_of(pipeline, part.state), last_times, start.seed)
            return part

        return keeper.play(stretch)

    result = played(events, options.progress) if options.checkpoint is None else kept(options.checkpoint)
    run = Playback(
        pipeline,
        start.cells,
        lambda: gaps_of(events, [p.name for p in pipeline.inputs]),
        lambda: events,
        lambda ticks: played(events.first(ticks)),
    )
    error = overflow(pipeline, cells_of(pipeline, result.state))
    if error is not None:
        result = played(events.first(int(np.searchsorted(events.time, error.time or 0))))
    return settled(result, run, options.diverged, error)


def _result(
    subject: Subject, pipeline: Pipeline, outcome: Outcome, events: Tape, start: Start, engine: str
) -> Result:
    series = {
        port.name: Series(times, unflatten(type_, iter(leaves)), type=type_, name=port.name)
        for port, type_, (times, leaves) in zip(pipeline.outputs, subject.types, outcome.outputs, strict=True)
    }
    last = {
        name: int(s.time[-1]) if len(s) else before
        for (name, before), s in zip(start.last.items(), events.series, strict=True)
    }
    state = state_of(pipeline, outcome.cells, last, start.seed)
    calls = {f.register: f.path for f in pipeline.faults}
    stats = {
        f"{calls.get(r.path, r.path.removesuffix('.state'))}.{name}": int(count)
        for r in pipeline.registers
        if r.role in ("join", "state") and isinstance(state["registers"][r.path], Mapping)
        for name, count in state["registers"][r.path].items()
        if name.startswith(COUNTED)
    }
    stats |= outcome.stats
    ticks = len(events.time)
    return Result(pipeline.name, engine, series, state, stats, ticks, outcome.wall_s, outcome.notes)


def _formatted(pipeline: Pipeline, engine: PipelineEngine, options: RunOptions) -> Pipeline:
    """The pipeline with the number formats that the options have.

    Raises:
        DeclarationError: for formats where the run is not in fixed point, or of another pipeline.
    """
    formats = options.formats
    if formats is None:
        return pipeline
    if engine.dtypes[0] != "fixed" and options.dtype != "fixed":
        raise DeclarationError(
            "number formats are for a run in fixed point",
            path="formats",
            expected='engine="fixed", or one equal to it, or engine="c" with dtype="fixed"',
            got=f"engine={options.engine!r}, dtype={options.dtype!r}",
            fix="choose one of these, or leave formats out",
        )
    return with_formats(pipeline, formats if isinstance(formats, Formats) else load_formats(formats))


def chosen_passes(engine: PipelineEngine, options: RunOptions) -> tuple[str, ...]:
    """The passes that were asked for, or those that suit the engine, in order."""
    return check_passes(engine.passes if options.passes is None else options.passes)


def state_of(pipeline: Pipeline, cells: list[Any], last: Mapping[str, int], seed: int) -> dict[str, Any]:
    """The state tree of these register cells."""
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
