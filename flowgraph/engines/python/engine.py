"""Python's engine behind the contract of engines: the blocks themselves, in plain NumPy, event by event."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.checkpoint import Keeper, identity, program_digest
from flowgraph.engines.contract import BlockEngine, Stepper
from flowgraph.engines.entrance import Admitted
from flowgraph.engines.options import Checkpoint, RunOptions
from flowgraph.engines.python.run import Run
from flowgraph.engines.state import load_registers
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.trouble import Playback, all_finite, gaps_of, settled
from flowgraph.errors import DeclarationError, FifoOverflowError, LoweringError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.types import flatten


class PythonEngine(BlockEngine):
    """Runs the blocks of a graph, so that a person can step through them with a debugger."""

    name = "python"
    dtypes = ("float64",)

    def check(self, options: RunOptions) -> None:
        if options.dtype != "float64":
            raise DeclarationError(
                "the Python engine computes in float64",
                path='engine="python"',
                expected="float64",
                got=options.dtype,
                fix='use engine="reference" or "xla" for float32',
            )
        if options.passes is not None:
            raise DeclarationError(
                "the Python engine runs the blocks themselves",
                path="passes",
                expected="no passes, or an engine that plays the instructions",
                got='engine="python"',
                fix='use engine="reference" or "xla"',
            )
        super().check(options)

    def run(self, graph: Graph, inputs: Inputs, options: RunOptions) -> Result:
        if options.checkpoint is not None:
            return self._kept(graph, inputs, options, options.checkpoint)
        return self.driven(graph, inputs, options, lambda run: run.to_end(options.progress))

    def _kept(self, graph: Graph, inputs: Inputs, options: RunOptions, asked: Checkpoint) -> Result:
        result, given, error = _in_stretches(graph, inputs, options, asked)
        if error is None and all_finite(result):
            return result
        return settled(result, _playback(graph, lambda: given, options), options.diverged, error)

    def driven(
        self, graph: Graph, inputs: Inputs, options: RunOptions, drive: Callable[[Run], object]
    ) -> Result:
        """A run that `drive` takes to its end in its own way, and what is to be said of it."""
        given, kept = _kept(inputs)
        run, error = _started(graph, given, options), None
        try:
            drive(run)
        except FifoOverflowError as full:
            error = full
        result = run.result()
        if error is None and all_finite(result):
            return result
        return settled(result, _playback(graph, kept, options), options.diverged, error)

    def stepper(self, graph: Graph, options: RunOptions) -> Stepper:
        return _SingleTicks(graph, options)


class _SingleTicks(Stepper):
    """A live run, tick by tick."""

    def __init__(self, graph: Graph, options: RunOptions) -> None:
        self._run = Run(graph, init=options.init, state=options.state, seed=options.seed)  # type: ignore[arg-type]
        self._types = [graph.port(c.wire).type for c in graph.collected]

    @property
    def ticks(self) -> int:  # type: ignore[override]
        return self._run.ticks

    @property
    def time(self) -> int:  # type: ignore[override]
        return self._run.time

    @property
    def state(self) -> dict[str, Any]:
        return self._run.state

    def overflows(self) -> list[FifoOverflowError]:
        return self._run.overflows()

    def step(self, admitted: Admitted) -> list[tuple[Any, ...] | None]:
        return [
            None if not values else tuple(map(np.array, flatten(values[0], type_)))
            for values, type_ in zip(self._run.react(admitted), self._types, strict=True)
        ]


def _started(graph: Graph, inputs: Inputs, options: RunOptions) -> Run:
    return Run(graph, inputs, init=options.init, state=options.state, seed=options.seed)  # type: ignore[arg-type]


def _in_stretches(
    graph: Graph, inputs: Inputs, options: RunOptions, asked: Checkpoint
) -> tuple[Result, Inputs, FifoOverflowError | None]:
    """The run, kept now and then; also its inputs, read to their end, and what ended it before them."""
    before = None if options.state is None else load_registers(graph, options.state)[1]
    events = tape(prepare(graph, inputs, before), graph)
    given = dict(zip(graph.sources, events.series, strict=True))
    run = _started(graph, given, options)
    which = identity(graph.name, program_digest(graph), events, run.state, run.seed, options)
    types = {c.name: graph.port(c.wire).type for c in graph.collected}
    keeper = Keeper(asked, which, events, types)
    if keeper.start is not None:
        rest = events.part(keeper.start.ticks, len(events.time)).series
        run = Run(graph, dict(zip(graph.sources, rest, strict=True)), state=keeper.start.state)

    def stretch(first: int, last: int) -> Result:
        run.to_end(keeper.meter(options.progress, anew=False), most=last - first)
        return run.drain()

    try:
        return keeper.play(stretch), given, None
    except FifoOverflowError as full:
        keeper.add(run.drain())
        return keeper.whole(), given, full


def _playback(graph: Graph, kept: Callable[[], Inputs], options: RunOptions) -> Playback:
    """The run again, with what is known of it from its lowered form, where it has one."""
    hosted = any(call.block.host for _, call in graph.calls)
    last = None if options.state is None else load_registers(graph, options.state)[1]

    def events() -> Tape:
        return tape(prepare(graph, kept(), last), graph)

    def again(ticks: int) -> Result:
        return _started(graph, kept(), options).to_end(most=ticks).result()

    try:
        pipeline = lower(graph)
    except LoweringError:
        return Playback(None, (), dict, events, None if hosted else again)
    if hosted:  # its blocks must not do what they do a second time
        return Playback(pipeline, [c.reset for r in pipeline.registers for c in r.cells], dict, events, None)
    gaps = lambda: gaps_of(events(), list(graph.sources))
    return Playback(pipeline, LoweredGraph(graph).start(options).cells, gaps, events, again)


def _kept(inputs: Inputs) -> tuple[Inputs, Callable[[], Inputs]]:
    """Inputs to be read now, and a function that gives as much of them again."""
    if not isinstance(inputs, Mapping):
        return inputs, lambda: inputs
    read: dict[str, list[Any]] = {
        n: [] for n, v in inputs.items() if isinstance(v, Iterable) and not isinstance(v, Series | tuple)
    }
    now = {n: _noted(v, read[n]) if n in read else v for n, v in inputs.items()}
    return now, lambda: {n: list(read[n]) if n in read else v for n, v in inputs.items()}


def _noted(events: Iterable[Any], into: list[Any]) -> Iterator[Any]:
    for event in events:
        into.append(event)
        yield event


ENGINE = PythonEngine()
