"""Lifting: the real constants of a lowered graph become registers that never change.

Settings are constants of a pipeline, so each value of a noise would be another program to compile. As
registers they are initial values, which each run of a batch has of its own: one compilation then serves all
seeds and all parameters that leave the instructions alone. What remains in the program are shapes, integers
and truth values. All real constants are lifted, whichever may vary, so that the program, and with it each
run's last bit, does not depend on what else a study asks for.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.language.graph import CallNode, Graph, RegisterNode, join_states
from flowgraph.pipeline.digests import settings_of
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import Cell, Pipeline, Register
from flowgraph.types import ArrayType, flatten

CONSTANTS = "constants/"
"""What stands before the number of a constant in the path of its register."""


def lifted(graph: Graph) -> Graph:
    """The same graph, whose pipeline takes its real constants as initial values of registers.

    It is for lowered engines: the Python engine runs blocks as they are and would not see the registers.

    Raises:
        LoweringError: where the graph cannot be lowered.
    """
    pipeline = lower(graph)
    registers, nodes = [], []
    moving = settings_of(pipeline)
    for number, array in moving.items():
        path, unnamed = f"{CONSTANTS}{number}", (None,) * array.ndim
        cell = Cell("value", number, number, array.shape, "real", array, axes=unnamed)
        registers.append(Register(path, "delay", (cell,)))
        nodes.append(RegisterNode(path, "delay", ArrayType(array.shape, "real"), array))
    rest = {n: a for n, a in pipeline.constants.items() if n not in moving}
    moved = replace(pipeline, registers=(*pipeline.registers, *registers), constants=rest)
    return replace(graph, nodes=(*graph.nodes, *nodes), plans={"pipeline": moved})


def start_of(graph: Graph) -> dict[str, Any]:
    """What a run of `graph` starts from, as `init` of any lifted graph of the same structure."""
    joins = join_states(graph)
    found = {
        node.path: node.initial
        for index, node in graph.registers
        if node.role != "stamp" and index not in joins
    }
    found.update({f"{CONSTANTS}{n}": a for n, a in settings_of(lower(graph)).items()})
    return found


class Lowered:
    """Pipelines of graphs that were lowered before, but for where their registers start.

    Graphs that are built alike for one flight after another, out of steps that are remembered (see
    `recording.remembering`), need lowering only once.
    """

    def __init__(self, most: int = 8) -> None:
        self._most = most
        self._known: list[tuple[Any, Graph]] = []

    def lower(self, graph: Graph) -> Pipeline:
        """The pipeline of a graph, kept with it; its registers may start as another graph's do."""
        if "pipeline" not in graph.plans:
            skeleton = _skeleton(graph)
            for other, known in self._known:
                if other == skeleton:
                    graph.plans["pipeline"] = known.plans["pipeline"]
                    break
            else:
                lower(graph)
                self._known = [*self._known[1 - self._most :], (skeleton, graph)]
        found: Pipeline = graph.plans["pipeline"]
        return found


def _skeleton(graph: Graph) -> list[Any]:
    """All that lowering sees of a graph but initial values; a recorded step counts as itself."""
    joins = join_states(graph)
    found: list[Any] = [graph.name, graph.order, graph.collected]
    for index, node in enumerate(graph.nodes):
        if isinstance(node, CallNode):
            steps = tuple((choice, id(step)) for choice, step in node.variants.items())
            wired = (node.arguments, node.firing, node.outputs, node.dynamic, node.state, node.stamp)
            found.append((node.path, id(node.block), steps, wired, node.draws))
        elif isinstance(node, RegisterNode):
            fixed = index in joins or node.role == "stamp"
            start = [np.asarray(x).tobytes() for x in flatten(node.initial, node.type)] if fixed else None
            found.append((node.path, node.role, node.type, node.feed, start))
        else:
            found.append((node.path, node.type, node.clock, node.clock.timing))
    return found
