"""Many runs in C: as many at once as there are processors, for a call into C lets other threads go on.

What is the same for all runs, the compiled library and, where they share them, the inputs' structs, is made
once; of the outputs only what is kept leaves the structs.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.c.engine import compiled
from flowgraph.graph import Graph
from flowgraph.inputs import Tape, prepare, tape
from flowgraph.lowering import lower
from flowgraph.many import Batch, cells_of, is_shared, joined, leaf_type, of_run
from flowgraph.optimise import RELYING, for_engine, without
from flowgraph.pipeline import Port
from flowgraph.playback import check_faults, real_leaves
from flowgraph.random import seed_words
from flowgraph.run import Meter
from flowgraph.series import Series
from flowgraph.types import DTYPES, StructType


def threaded(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], dtype: str, init: Any,
    kept: dict[str, list[str]], progress: Meter | None, passes: Collection[str] | None,
) -> Batch:  # fmt: skip
    """Runs in C, as many at once as there are processors: a call into C lets other threads go on."""
    pipeline, real = lower(graph, dtype=dtype), np.dtype(dtype)
    chosen = for_engine("c", passes)
    if init is not None:
        chosen = without(*RELYING, passes=chosen)  # they rely on the values at reset
    shared = tape(prepare(graph, inputs), graph) if is_shared(inputs) else None
    library = None if shared is None else compiled(pipeline, real, shared.patterns, chosen)
    shared_rows = None if library is None or shared is None else library.rows(_reals(shared, real))

    def run(n: int) -> tuple[dict[str, Series], int]:
        events = shared or tape(prepare(graph, of_run(inputs, n, seeds[n])), graph)
        c = library if library is not None else compiled(pipeline, real, events.patterns, chosen)
        rows = shared_rows if shared_rows is not None else c.rows(_reals(events, real))
        cells = [cell[0] for cell in cells_of(graph, init, seeds, (n,))]
        found: dict[str, list[tuple[np.ndarray, list[np.ndarray]]]] = {name: [] for name in kept}
        done = 0
        for part, after in c.play(cells, seed_words(seeds[n]), events.time, events.key, rows, kept):
            cells = after
            times = events.time[done : done + part.ticks]
            for port, (mask, leaves) in zip(pipeline.outputs, part.outputs, strict=True):
                if port.name in kept:
                    found[port.name].append((times[mask], leaves))
            done += part.ticks
        check_faults(pipeline, cells)
        ports = [p for p in pipeline.outputs if p.name in kept]
        return {p.name: _series(p, kept[p.name], found[p.name]) for p in ports}, done

    if shared is None:  # made here, so that threads do not compile the same thing at once
        first = tape(prepare(graph, of_run(inputs, 0, seeds[0])), graph)
        compiled(pipeline, real, first.patterns, chosen)
    parts: dict[str, list[Series]] = {name: [] for name in kept}
    ticks = 0
    start = perf_counter()
    with ThreadPoolExecutor(min(len(seeds), os.cpu_count() or 1)) as pool:
        for n, (series, done) in enumerate(pool.map(run, range(len(seeds)))):
            ticks = done
            for name in kept:
                parts[name].append(series[name])
            if progress is not None:
                progress.update(n + 1, 0)
    wall = perf_counter() - start
    return Batch(graph.name, "c", seeds, {n: joined(n, p, kept[n]) for n, p in parts.items()}, ticks, wall)


def _reals(events: Tape, real: Any) -> list[list[np.ndarray]]:
    return [real_leaves(s, real) for s in events.series]


def _series(port: Port, names: list[str], parts: list[tuple[np.ndarray, list[np.ndarray]]]) -> Series:
    """Stretches of one output in one, with the leaves of these names."""
    leaves = [leaf for leaf in port.leaves if leaf.name in names]
    time = _whole([t for t, _ in parts]) if parts else np.zeros(0, np.int64)
    fields = {
        leaf.name: _whole([x[k] for _, x in parts])
        if parts
        else np.zeros((0, *leaf.shape), DTYPES[leaf.dtype])
        for k, leaf in enumerate(leaves)
    }
    if list(fields) == ["value"]:
        return Series(time, fields["value"], name=port.name)
    type_ = StructType(port.name, tuple((n, leaf_type(a)) for n, a in fields.items()), dict)
    return Series(time, fields, type=type_, name=port.name)


def _whole(parts: list[np.ndarray]) -> np.ndarray:
    return parts[0] if len(parts) == 1 else np.concatenate(parts)
