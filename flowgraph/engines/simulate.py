"""Run a graph over recorded events, in the engine of your choice: the answer is the same in each."""

from __future__ import annotations

import typing
from collections.abc import Collection, Mapping, Sequence
from typing import Any

from flowgraph.data.inputs import Inputs, need_inputs
from flowgraph.data.result import Result
from flowgraph.engines.many import Batch, simulate_many
from flowgraph.engines.python.run import Meter, Run
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.graph import Graph

ENGINES = ("python", "reference", "xla", "c")


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
) -> Result | Batch:
    """Run a graph over its inputs to their end.

    Args:
        graph: a built graph.
        inputs: a `Flight`, or for each source a `Series`, `(times, values)`, or an iterable of
            `(time, value)`.
        engine: "python" (NumPy, event by event), "reference" (the lowered pipeline's instructions in NumPy),
            "xla" (the same instructions in one compiled scan; needs JAX) or "c" (generated, compiled by the
            system's C compiler and called in this process).
        dtype: what `real` is, "float64" or "float32"; the Python engine has float64 only.
        init: other initial values, by register path.
        state: a `run.state` or `result.state` to go on from.
        seed: of the random numbers, 0 .. 2^64 - 1; a `state` brings its own.
        seeds: run once for each of them, and return a `Batch`; `simulate_many` has more to choose.
        progress: an object that is told how far the run is.
        passes: of the optimiser, from `flowgraph.pipeline.optimise.PASSES`; None: those that suit the
        engine. The
            Python engine has no list to optimise.

    Raises:
        UnknownNameError, DataError, ClockError, TypeMismatchError: naming the source.
        FifoOverflowError: where a queue of a join overflows.
        MissingDependencyError: for "xla" without JAX, for "c" without a C compiler.
    """
    if engine not in ENGINES:
        raise UnknownNameError("engine", engine, ENGINES)
    if dtype not in ("float64", "float32"):
        raise UnknownNameError("dtype", dtype, ("float64", "float32"))
    if seeds is not None:
        if state is not None:
            raise DeclarationError(
                "many runs start anew",
                path="simulate",
                expected="seeds, or a state to go on from",
                got="both",
                fix="leave one of them out",
            )
        return simulate_many(
            graph, inputs, seeds, engine=engine, dtype=dtype, init=init, progress=progress, passes=passes
        )
    need_inputs(graph, inputs)
    if engine == "python":
        if dtype != "float64":
            raise DeclarationError(
                "the Python engine computes in float64",
                path='engine="python"',
                expected="float64",
                got=dtype,
                fix='use engine="reference" or "xla" for float32',
            )
        if passes is not None:
            raise DeclarationError(
                "the Python engine runs the blocks themselves",
                path="passes",
                expected="no passes, or an engine that plays the instructions",
                got='engine="python"',
                fix='use engine="reference" or "xla"',
            )
        return Run(graph, inputs, init=init, state=state, seed=seed).to_end(progress).result()
    from flowgraph.engines.playback import play

    return play(
        graph,
        inputs,
        engine=engine,
        dtype=dtype,
        init=init,
        state=state,
        seed=seed,
        progress=progress,
        passes=passes,
    )
