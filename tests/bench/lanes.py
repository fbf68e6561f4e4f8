"""Runs side by side in vectors, against single runs of the same C: ticks a second of one core.

Nothing of the outputs is kept, so that what is timed is the filter.
"""

from __future__ import annotations

from time import perf_counter
from typing import Any

import numpy as np

from flowgraph import load_flight
from flowgraph.engines.c.lanes.library import lanes_of
from flowgraph.engines.c.lanes.source import WIDTH
from flowgraph.engines.c.library import State, compiled
from flowgraph.engines.contract import real_leaves
from flowgraph.engines.options import RunOptions
from flowgraph.engines.subject import LoweredGraph
from flowgraph.graphs import ekf, ins_eskf, kalman
from flowgraph.pipeline.optimise import COMPILED
from flowgraph.recorder.random import seed_words
from tests.bench.rows import Row, interleaved

BOUNDS = {kalman: 0.6, ekf: 0.45, ins_eskf: 0.45}
"""The share of the vector width that must be reached."""


def rows(*, duration: float = 4.0, repeats: int = 51) -> list[Row]:
    """Ticks a second of one core: lanes, and one run."""
    return [_row(graph, share, duration, repeats) for graph, share in BOUNDS.items()]


def _row(graph: Any, share: float, duration: float, repeats: int) -> Row:
    case = graph.case(load_flight("sim", seed=0, settings={"duration": f"{duration:g}"}))
    subject = LoweredGraph(case.graph, dtype="float64")
    events = subject.tape(case.inputs)
    cells = [np.asarray(c) for c in subject.start(RunOptions(engine="c", seed=0)).cells]
    single = compiled(subject.pipeline, np.float64, events.patterns, COMPILED)
    lanes = lanes_of(subject.pipeline, np.float64, events.patterns, COMPILED)
    assert lanes is not None
    leaves = [real_leaves(s, np.float64) for s in events.series]
    alone, abreast = single.rows(leaves), lanes.rows([leaves])
    none = [single.room(k, 0, kept=()) for k in range(len(subject.pipeline.outputs))]

    def one() -> float:
        state = State(single, cells, seed_words(0))
        start = perf_counter()
        single.advance(state, events.time, events.key, alone, none)
        return len(events.time) / (perf_counter() - start)

    def several() -> float:
        memory = lanes.state([cells], [seed_words(0)])
        start = perf_counter()
        lanes.advance(memory, events.time, events.key, abreast, [none] * WIDTH)
        return WIDTH * len(events.time) / (perf_counter() - start)

    ours, peer, ratio = interleaved(several, one, repeats)
    name, bound = f"{case.graph.name}: {WIDTH} runs in lanes", f"at least {share:g} of {WIDTH} lanes"
    return Row(
        name, ours, peer, "ticks/s", "a single run of the same C", ratio, bound,
        ratio >= share * WIDTH, details={"width": WIDTH, "share": ratio / WIDTH},
    )  # fmt: skip
