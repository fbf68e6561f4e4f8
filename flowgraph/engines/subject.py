"""What an engine is to play: a graph that was lowered, or a pipeline that was read without its graph.

Both come to the same: a pipeline, register cells to start from, a tape of checked events, and the types of
the outputs. A graph knows its signal types; a description knows names, shapes and kinds of numbers.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowgraph.data.inputs import prepare
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.options import RunOptions
from flowgraph.engines.pipeline_inputs import cells_at_start, events_of
from flowgraph.engines.state import check_start, initial_registers, load_registers, read_tree
from flowgraph.language.graph import NEVER, Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import Pipeline, type_of_leaves
from flowgraph.types import Type, flatten


@dataclass
class Start:
    """Where a run starts: register cells in order, the last time of each input, and the seed."""

    cells: list[Any]
    last: dict[str, int]
    seed: int


class Subject(abc.ABC):
    """What is played.

    Attributes:
        name: for messages.
        pipeline: its instructions.
        types: of the outputs.
    """

    name: str
    pipeline: Pipeline
    types: Sequence[Type]

    def start(self, options: RunOptions) -> Start:
        """Where the run starts that these options ask for.

        Raises:
            DeclarationError, UnknownNameError, DataError: for initial values or a state of something else.
        """
        check_start(options.init, options.state, path=self.name)
        return self._begin(options) if options.state is None else self._resumed(options.state)

    @abc.abstractmethod
    def _begin(self, options: RunOptions) -> Start: ...

    @abc.abstractmethod
    def _resumed(self, state: Mapping[str, Any]) -> Start: ...

    @abc.abstractmethod
    def tape(self, inputs: Any, last: Mapping[str, int] | None = None, *, like: Tape | None = None) -> Tape:
        """The inputs, checked, as ticks; `last` holds the last time of each input in a run that goes on."""


class LoweredGraph(Subject):
    """A graph; its pipeline is made once and kept with it."""

    def __init__(self, graph: Graph, *, dtype: str | None = None) -> None:
        self.graph, self.name = graph, graph.name
        self.pipeline = lower(graph) if dtype is None else lower(graph, dtype=dtype)
        self.types = [graph.port(c.wire).type for c in graph.collected]

    def _begin(self, options: RunOptions) -> Start:
        slots = initial_registers(self.graph, options.init)  # type: ignore[arg-type]
        return Start(self._cells(slots), dict.fromkeys(self.graph.sources, NEVER), options.seed)

    def _resumed(self, state: Mapping[str, Any]) -> Start:
        slots, last, seed = load_registers(self.graph, state)
        return Start(self._cells(slots), last, seed)

    def _cells(self, slots: Sequence[Any]) -> list[Any]:
        return [leaf for index, node in self.graph.registers for leaf in flatten(slots[index], node.type)]

    def tape(self, inputs: Any, last: Mapping[str, int] | None = None, *, like: Tape | None = None) -> Tape:
        return tape(prepare(self.graph, inputs, last), self.graph, like=like)


class LoadedPipeline(Subject):
    """A pipeline alone: no graph and no block need be importable.

    Args:
        pipeline: that is played.
        cells: where its register cells start, in order, in place of their resets.
    """

    def __init__(self, pipeline: Pipeline, cells: Sequence[Any] | None = None) -> None:
        self.pipeline, self.name, self._first = pipeline, pipeline.name, cells
        self.types = [type_of_leaves(p.type, p.leaves) for p in pipeline.outputs]
        self._names = [p.name for p in pipeline.inputs]

    def _begin(self, options: RunOptions) -> Start:
        cells = cells_at_start(self.pipeline, options.init)  # type: ignore[arg-type]
        cells = cells if self._first is None else list(self._first)
        return Start(cells, dict.fromkeys(self._names, NEVER), options.seed)

    def _resumed(self, state: Mapping[str, Any]) -> Start:
        held = {r.path: type_of_leaves(r.path, r.cells) for r in self.pipeline.registers}
        found, last, seed = read_tree(state, held, self._names, name=self.name, of="pipeline")
        return Start([leaf for r in self.pipeline.registers for leaf in found[r.path]], last, seed)

    def tape(self, inputs: Any, last: Mapping[str, int] | None = None, *, like: Tape | None = None) -> Tape:
        return events_of(self.pipeline, inputs, last)
