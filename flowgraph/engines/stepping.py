"""Runs that take one tick after the other, in the engines that can: Python's, and C's without its set-up."""

from __future__ import annotations

from typing import Any

from flowgraph.engines.contract import BlockEngine, CellStepper, Stepper
from flowgraph.engines.entrance import Admitted
from flowgraph.engines.options import RunOptions
from flowgraph.engines.playback import chosen_passes, state_of
from flowgraph.engines.registry import find_engine
from flowgraph.engines.subject import LoweredGraph, Start
from flowgraph.engines.trouble import overflow_error
from flowgraph.errors import DeclarationError, FifoOverflowError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.optimise import usable
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import flatten


def stepper(graph: Graph, options: RunOptions) -> Stepper:
    """A run of the graph that takes one tick after the other.

    Raises:
        DeclarationError: for an engine that takes whole recordings only, or a graph with blocks for the host
            in one that plays pipelines.
        UnknownNameError, DataError: for initial values or a state of something else.
    """
    engine = find_engine(options.engine)
    engine.check(options)
    engine.need()
    made: Stepper | None
    if isinstance(engine, BlockEngine):
        made = engine.stepper(graph, options)
    elif lower(graph).host:
        raise DeclarationError(
            "blocks of the host run in the Python engine, event by event",
            path=graph.name,
            expected='engine="python"',
            got=f"engine={options.engine!r}, and host blocks",
            fix='use engine="python", or take the host blocks out of the graph',
        )
    else:
        subject = LoweredGraph(graph)
        start = subject.start(options)
        pipeline = subject.pipeline
        passes = usable(pipeline, chosen_passes(engine, options), start.cells)  # type: ignore[arg-type]
        cells = engine.stepper(pipeline, start.cells, start.seed, options.dtype, passes)  # type: ignore[attr-defined]
        made = None if cells is None else _Lowered(graph, pipeline, cells, start)
    if made is None:
        raise DeclarationError(
            f"the {options.engine} engine makes no single ticks",
            path=f"engine={options.engine!r}",
            expected='"python" or "c"',
            got=repr(options.engine),
            fix="use one of these for what comes live",
        )
    return made


class _Lowered(Stepper):
    """A pipeline whose ticks come one by one."""

    def __init__(self, graph: Graph, pipeline: Pipeline, cells: CellStepper, start: Start) -> None:
        self.ticks, self.time = 0, max(start.last.values())
        self._pipeline, self._cells = pipeline, cells
        self._last, self._seed = dict(start.last), start.seed
        self._names, self._types = list(graph.sources), [n.type for n in graph.sources.values()]
        self._told = set(cells.full())

    def step(self, admitted: Admitted) -> list[tuple[Any, ...] | None]:
        leaves = [(k, flatten(value, self._types[k])) for k, value in admitted.values]
        made = self._cells.react(admitted.time, admitted.key, leaves)
        self.ticks += 1
        self.time = admitted.time
        for k, _ in admitted.values:
            self._last[self._names[k]] = admitted.time
        return made

    def overflows(self) -> list[FifoOverflowError]:
        new = [k for k in self._cells.full() if k not in self._told] if self._pipeline.faults else []
        self._told.update(new)
        faults = [self._pipeline.faults[k] for k in new]
        return [overflow_error(f.message, f.path, f.bound, self.time) for f in faults]

    @property
    def state(self) -> dict[str, Any]:
        return state_of(self._pipeline, self._cells.cells(), self._last, self._seed)
