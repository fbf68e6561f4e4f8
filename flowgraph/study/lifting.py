"""Lifting: the real constants of a lowered graph become registers that never change.

Settings are constants of a pipeline, so each value of a noise would be another program to compile. As
registers they are initial values, which each run of a batch has of its own: one compilation then serves all
seeds and all parameters that leave the instructions alone. What remains in the program are shapes, integers
and truth values. All real constants are lifted, whichever may vary, so that the program, and with it each
run's last bit, does not depend on what else a study asks for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.graph import Graph, RegisterNode
from flowgraph.lowering import lower
from flowgraph.pipeline import Cell, Register
from flowgraph.state import join_states
from flowgraph.types import ArrayType

_PREFIX = "constants/"


def lifted(graph: Graph) -> Graph:
    """The same graph, whose pipeline takes its real constants as initial values of registers.

    It is for lowered engines: the Python engine runs blocks as they are and would not see the registers.

    Raises:
        LoweringError: where the graph cannot be lowered.
    """
    pipeline = lower(graph)
    registers, nodes = [], []
    for number, array in _real(pipeline.constants).items():
        path, unnamed = f"{_PREFIX}{number}", (None,) * array.ndim
        cell = Cell("value", number, number, array.shape, "real", array, axes=unnamed)
        registers.append(Register(path, "delay", (cell,)))
        nodes.append(RegisterNode(path, "delay", ArrayType(array.shape, "real"), array))
    rest = {n: a for n, a in pipeline.constants.items() if a.dtype.kind != "f"}
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
    found.update({f"{_PREFIX}{n}": a for n, a in _real(lower(graph).constants).items()})
    return found


def _real(constants: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
    return {n: a for n, a in constants.items() if a.dtype.kind == "f"}
