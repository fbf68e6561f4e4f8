"""What the parts of a pipeline are called in C: each an identifier of its own in its scope."""

from __future__ import annotations

from dataclasses import dataclass

from flowgraph.engines.c.syntax import identifier, unique
from flowgraph.pipeline.pipeline import Pipeline

_RESERVED = (
    "s",
    "time",
    "present",
    "made",
    "seed",
    "work",
    "registers",
    "order",
    "item",
    "hole",
    "top",
    "end",
)


@dataclass(frozen=True)
class Names:
    """What the parts of a pipeline are called in C."""

    module: str
    inputs: tuple[str, ...]
    input_leaves: tuple[tuple[str, ...], ...]
    outputs: tuple[str, ...]
    output_leaves: tuple[tuple[str, ...], ...]
    registers: tuple[tuple[str, ...], ...]


def names_of(pipeline: Pipeline) -> Names:
    """Identifiers for everything in a pipeline, each once in its scope."""
    ports = unique([p.name for p in (*pipeline.inputs, *pipeline.outputs)], _RESERVED)
    split = len(pipeline.inputs)
    cells = unique(_cell_name(r.path, c.name) for r in pipeline.registers for c in r.cells)
    places = iter(cells)
    return Names(
        identifier(pipeline.name),
        tuple(ports[:split]),
        tuple(tuple(unique(leaf.name for leaf in p.leaves)) for p in pipeline.inputs),
        tuple(ports[split:]),
        tuple(tuple(unique(leaf.name for leaf in p.leaves)) for p in pipeline.outputs),
        tuple(tuple(next(places) for _ in r.cells) for r in pipeline.registers),
    )


def _cell_name(path: str, cell: str) -> str:
    return path if cell == "value" else f"{path}_{cell}"
