"""Run a graph over recorded events, in the engine of your choice: the answer is the same in each."""

from __future__ import annotations

import typing
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

from flowgraph.data.batch import Batch
from flowgraph.data.inputs import Inputs, need_inputs
from flowgraph.data.result import Result
from flowgraph.engines.many import run_many
from flowgraph.engines.options import Checkpoint, Meter, RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.errors import DeclarationError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.formats import Formats


@typing.overload
def simulate(
    graph: Graph,
    inputs: Inputs,
    *,
    engine: str = ...,
    dtype: str = ...,
    init: Mapping[str, Any] | None = ...,
    state: Mapping[str, Any] | None = ...,
    seed: int = ...,
    seeds: None = ...,
    progress: Meter | None = ...,
    passes: Collection[str] | None = ...,
    diverged: str = ...,
    checkpoint: Checkpoint | None = ...,
    formats: Formats | str | Path | None = ...,
    shard: Mapping[str, int] | None = ...,
) -> Result: ...
@typing.overload
def simulate(
    graph: Graph,
    inputs: Inputs,
    *,
    engine: str = ...,
    dtype: str = ...,
    init: Mapping[str, Any] | None = ...,
    state: Mapping[str, Any] | None = ...,
    seed: int = ...,
    seeds: Sequence[int],
    progress: Meter | None = ...,
    passes: Collection[str] | None = ...,
    diverged: str = ...,
    checkpoint: Checkpoint | None = ...,
    formats: Formats | str | Path | None = ...,
    shard: Mapping[str, int] | None = ...,
) -> Batch: ...
def simulate(
    graph: Graph,
    inputs: Inputs,
    *,
    engine: str = "python",
    dtype: str = "float64",
    init: Mapping[str, Any] | None = None,
    state: Mapping[str, Any] | None = None,
    seed: int = 0,
    seeds: Sequence[int] | None = None,
    progress: Meter | None = None,
    passes: Collection[str] | None = None,
    diverged: str = "raise",
    checkpoint: Checkpoint | None = None,
    formats: Formats | str | Path | None = None,
    shard: Mapping[str, int] | None = None,
) -> Result | Batch:
    """Run a graph over its inputs to their end.

    Args:
        graph: a built graph.
        inputs: a `Flight`, or for each source a `Series`, `(times, values)`, or an iterable of
            `(time, value)`.
        engine: "python" (NumPy, event by event), "reference" (the lowered pipeline's instructions in NumPy),
            "numpy" (each of them over all ticks at once), "xla" (the same instructions in one compiled scan;
            needs JAX), "c" (generated, compiled by the system's C compiler and called in this process) or
            "fixed" (in integers, in number formats).
        dtype: what `real` is, "float64" or "float32", for "c" also "fixed"; the Python engine has float64
            only.
        init: other initial values, by register path.
        state: a `run.state` or `result.state` to go on from.
        seed: of the random numbers, 0 .. 2^64 - 1; a `state` brings its own.
        seeds: run once for each of them, and return a `Batch`; `simulate_many` has more to choose.
        progress: an object that is told how far the run is.
        passes: of the optimiser, from `flowgraph.pipeline.optimise.PASSES`; None: those
            that suit the engine. The Python engine has no list to optimise.
        diverged: where an operation makes an output or a register that is not finite, "raise", or "count"
            it in the result's `stats` and `notes` and go on.
        checkpoint: `Checkpoint(file, every=10.0)` keeps the run in a file now and then;
            `Checkpoint(resume=file)` goes on from one, to the same bits. Of one run alone.
        formats: for fixed point, the number formats, or the folder that `flowgraph quantise` wrote.
        shard: for "xla", among how many devices the work along an axis is shared out, such as
            `{"particles": 4}`, and with seeds also `{"runs": 4}`.

    Raises:
        UnknownNameError, DataError, ClockError, TypeMismatchError: naming the source.
        FifoOverflowError: where a queue of a join overflows.
        DivergedError: where a number is not finite any more.
        MissingDependencyError: for "xla" without JAX, for "c" without a C compiler.
        DeclarationError: for a shard of more devices than there are, or of what cannot be cut so.
    """
    options = RunOptions(
        engine=engine, dtype=dtype, init=init, state=state, seed=seed, progress=progress, passes=passes,
        diverged=diverged, checkpoint=checkpoint, formats=formats, shard=shard,
    )  # fmt: skip
    if seeds is None:
        need_inputs(graph, inputs)
        return run_graph(graph, inputs, options)
    if state is not None or checkpoint is not None:
        raise DeclarationError(
            "many runs start anew",
            path="simulate",
            expected="seeds, or a state or checkpoint to go on from",
            got="both",
            fix="leave one of them out",
        )
    return run_many(graph, inputs, seeds, options)
