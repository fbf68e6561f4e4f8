"""What each block and register of a graph takes as lowered, by its path, for a diagram to show there."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import work
from flowgraph.types import DTYPES


def costs_by_path(graph: Graph, dtype: str = "float64") -> dict[str, dict[str, Any]]:
    """Instructions and scalar operations of each block, bytes and kinds of number of each register.

    Nothing is optimised here, and only counted: it is quick. Under "" stands what the whole takes, or why it
    cannot be lowered.

    Args:
        dtype: what a real is in the lowered graph.
    """
    try:
        pipeline = lower(graph, dtype=dtype)
    except LoweringError as error:
        return {"": {"cannot be lowered": f"{error.path}: {error.message}"}}
    found: dict[str, dict[str, Any]] = {"": {"real is": dtype, **_words(pipeline.totals())}}
    for stage in pipeline.stages:
        entry = found.setdefault(stage.path, {"instructions": 0, "operations": 0})
        entry["instructions"] += len(stage.instructions)
        entry["operations"] += sum(work(i, pipeline.specs) for i in stage.instructions)
        if stage.axis:
            entry["parallel along"] = stage.axis
    for register in pipeline.registers:
        kinds = dict.fromkeys(dtype if c.dtype == "real" else c.dtype for c in register.cells)
        size = sum(math.prod(c.shape) * _bytes(c.dtype, dtype) for c in register.cells)
        found.setdefault(register.path, {}).update({"format": ", ".join(kinds), "bytes": size})
    return found


def _bytes(kind: str, real: str) -> int:
    return np.dtype(real if kind == "real" else DTYPES[kind]).itemsize


def _words(totals: dict[str, int]) -> dict[str, int]:
    return {name.replace("_", " "): value for name, value in totals.items()}
