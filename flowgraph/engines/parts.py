"""One run of a graph: in an engine that runs its blocks, or lowered; then whole, or in parts where it is cut.

The host's parts of a graph run block by block, event by event, in float64; the accelerated one in the engine
that was asked for. Every stream that crosses goes over whole, with its times. Random numbers depend on the
seed, the name and the time alone, so each part draws what the whole graph would have drawn.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.result import Result, statistics
from flowgraph.data.series import Series
from flowgraph.data.tape import tape
from flowgraph.engines.contract import BlockEngine
from flowgraph.engines.options import RunOptions
from flowgraph.engines.playback import play
from flowgraph.engines.python.run import Run
from flowgraph.engines.registry import find_engine
from flowgraph.engines.state import check_start, initial_registers, load_registers, state_tree
from flowgraph.engines.subject import LoweredGraph
from flowgraph.errors import DeclarationError
from flowgraph.language.graph import NEVER, Graph
from flowgraph.pipeline.cut import cut
from flowgraph.pipeline.lowering import lower


def run_graph(graph: Graph, inputs: Inputs, options: RunOptions) -> Result:
    """Run a graph over its inputs to their end."""
    engine = find_engine(options.engine)
    engine.check(options)
    if isinstance(engine, BlockEngine):
        engine.need()
        return engine.run(graph, inputs, options)
    check_start(options.init, options.state, path=graph.name)
    if lower(graph).host:
        if options.checkpoint is not None:
            raise DeclarationError(
                "a run that is cut at the blocks of the host has no checkpoints",
                path=graph.name,
                expected='engine="python", which runs all blocks itself',
                got=f"engine={options.engine!r}",
                fix='use engine="python", or leave the checkpoint out',
            )
        return _play_parts(graph, inputs, options)
    return play(LoweredGraph(graph), inputs, options)


def _play_parts(graph: Graph, inputs: Inputs, options: RunOptions) -> Result:
    """Run a graph with host blocks; the result is that of the whole graph."""
    parts = cut(graph)
    assert parts is not None
    if options.state is None:
        slots = initial_registers(graph, options.init)  # type: ignore[arg-type]
        last, seed = dict.fromkeys(graph.sources, NEVER), options.seed
    else:
        slots, last, seed = load_registers(graph, options.state)
    tree = state_tree(graph, slots, last, seed)
    events = tape(prepare(graph, inputs, last), graph)
    known = dict(zip(graph.sources, events.series, strict=True))
    ends = {n: int(s.time[-1]) if len(s) else last[n] for n, s in known.items()}
    collected: dict[str, Series] = {}
    wall, notes = 0.0, tuple[str, ...]()
    counts: dict[str, Any] = {}
    for part in (parts.before, parts.accelerated, parts.after):
        if part is None:
            continue
        given = {name: known[name] for name in part.sources}
        begin = _state_of(part, tree)
        if part is parts.accelerated:
            found = play(LoweredGraph(part), given, options.but(init=None, state=begin))
        else:
            found = Run(part, given, state=begin).to_end().result()
        wall, notes = wall + found.wall_s, (*notes, *found.notes)
        counts.update(found.stats)
        tree["registers"].update(found.state["registers"])
        for c in part.collected:
            collected[c.name] = series = found.series[c.name]
            # what a block made may be NaN; it is not checked again on its way to the next part
            known[part.label(c.wire)] = Series(
                series.time, series.values, type=series.type, name=part.label(c.wire), gaps=True
            )
    tree["sources"] = {n: np.asarray(t, dtype=np.int64) for n, t in ends.items()}
    outputs = {c.name: collected[c.name] for c in graph.collected}
    counts.update(statistics(graph, tree))
    return Result(graph.name, options.engine, outputs, tree, counts, len(events.time), wall, notes)


def _state_of(part: Graph, tree: Mapping[str, Any]) -> dict[str, Any]:
    """What a part starts from: its registers and sources; a stream of another part has no last time."""
    return {
        "registers": {node.path: tree["registers"][node.path] for _, node in part.registers},
        "sources": {n: tree["sources"].get(n, NEVER) for n in part.sources},
        "seed": tree["seed"],
    }
