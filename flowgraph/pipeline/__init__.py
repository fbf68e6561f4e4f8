"""The pipeline: a graph without its Python, as a fixed list of instructions that anything can run.

A filter that works in simulation is to run on a small computer or a chip, where there are no objects, no
names and no memory to ask for. Lowering takes the recorded steps of the blocks in firing order, puts them
one after the other, and makes plain what the graph left to clocks: a truth value says whether each stage
fires, and a register keeps its old value where it does not (`lowering`, which writes into a `stage_list`).
Blocks that must stay on the host are cut off before and after (`cut`). What comes out is data: numbered
values assigned once, of fixed shape (`pipeline`). It is written to a file and checked line by line when it
is read (`description`, with its schema), printed for a person (`listing`), and known again by its digest
(`digests`). What an instruction computes
is defined in one place (`evaluate`).

A pipeline copes with every tick. For the ticks that come, say of the IMU alone, it is specialised
(`program`), and a program is made cheaper by passes that every backend shares (`optimise`). What it takes
in operations, memory, time and energy is counted on the same list (`costs`).

No engine is known here: engines play what this room makes.
"""

from __future__ import annotations

from flowgraph.pipeline.pipeline import (
    Cell,
    Fault,
    HostStage,
    Leaf,
    Pipeline,
    Port,
    RandomSite,
    Register,
    Stage,
    schema,
)

__all__ = [
    "Cell",
    "Fault",
    "HostStage",
    "Leaf",
    "Pipeline",
    "Port",
    "RandomSite",
    "Register",
    "Stage",
    "schema",
]
