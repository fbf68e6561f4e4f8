"""Many runs in C: as many at once as there are processors, for a call into C lets other threads go on.

What is the same for all runs is made once: the compiled library, the order of the ticks, and the inputs where
they are shared. An output whose presence follows from its inputs' is written by C straight to its place in an
array of all runs; of one that depends on data, or where runs have other ticks, the runs are put together
afterwards. Only what is kept of the outputs leaves the filter.
"""

from __future__ import annotations

import os
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.inputs import prepare
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.c.engine import Compiled, Room, State, Structs, compiled, shrunk
from flowgraph.engines.many import Batch, Runs, initial_cells, is_shared, joined, leaf_type, of_run
from flowgraph.engines.playback import check_faults, real_leaves
from flowgraph.engines.python.run import Meter
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.optimise import RELYING, for_engine, without
from flowgraph.recorder.random import seed_words
from flowgraph.types import StructType


def threaded(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], dtype: str, init: Any,
    kept: dict[str, list[str]], progress: Meter | None, passes: Collection[str] | None,
) -> Batch:  # fmt: skip
    """Runs in C, as many at once as there are processors: a call into C lets other threads go on."""
    pipeline, real = lower(graph, dtype=dtype), np.dtype(dtype)
    chosen = for_engine("c", passes)
    if init is not None:
        chosen = without(*RELYING, passes=chosen)  # they rely on the values at reset
    shared = is_shared(inputs)
    first = tape(prepare(graph, of_run(inputs, 0, seeds[0])), graph)
    library = compiled(pipeline, real, first.patterns, chosen)
    rows = _rows(library, first, real) if shared else None
    cells = initial_cells(graph, init) if is_shared(init) else None
    ports = enumerate(pipeline.outputs)
    outputs = [_Output(library, k, first, kept.get(p.name), len(seeds)) for k, p in ports]

    def run(n: int) -> int:
        events, c = first, library
        if not shared and n:
            events = tape(prepare(graph, of_run(inputs, n, seeds[n])), graph, like=first)
            if events.time is not first.time:
                c = compiled(pipeline, real, events.patterns, chosen)
        start = cells if cells is not None else initial_cells(graph, of_run(init, n, seeds[n]))
        state = State(c, start, seed_words(seeds[n]))
        given = rows if rows is not None else _rows(c, events, real)
        rooms = [output.room(n, c, events) for output in outputs]
        counts, made = c.advance(state, events.time, events.key, given, rooms)
        if pipeline.faults:
            check_faults(pipeline, state.after())
        for output, room, count in zip(outputs, rooms, counts, strict=False):
            output.came(n, events, room, count, made)
        return len(events.time)

    ticks = len(first.time)
    start = perf_counter()
    with ThreadPoolExecutor(min(len(seeds), os.cpu_count() or 1)) as pool:
        for n, played in enumerate(pool.map(run, range(len(seeds)))):
            ticks = played
            if progress is not None:
                progress.update(n + 1, 0)
    wall = perf_counter() - start
    series = {o.name: o.runs() for o in outputs if o.kept}
    return Batch(graph.name, "c", seeds, {name: series[name] for name in kept}, ticks, wall)


def _rows(library: Compiled, events: Tape, real: Any) -> Structs:
    return library.rows([real_leaves(s, real) for s in events.series])


class _Output:
    """Where one output of all runs goes.

    Args:
        library: of the first run.
        port: its place.
        first: the ticks of the first run.
        leaves: the names that are kept; None where the output is not.
        runs: how many.
    """

    def __init__(
        self, library: Compiled, port: int, first: Tape, leaves: list[str] | None, runs: int
    ) -> None:
        self.port, self.first, self.count = port, first, runs
        self.leaves, self.kept = leaves or [], leaves is not None
        self.name = library.pipeline.outputs[port].name
        self.names = [leaf.name for leaf in library.pipeline.outputs[port].leaves]
        count, certain = library.most(first.key)[port]
        self.time = first.time[library.present(first.key, port)] if certain else None
        self.whole = library.room(port, runs, count, kept=self.leaves) if certain and self.kept else None
        self.kinds = library.room(port, 0)
        self.apart: dict[int, Series] = {}

    def room(self, n: int, library: Compiled, events: Tape) -> Room:
        """Arrays for a run."""
        if not self.kept:
            return [None] * len(self.names)
        if self.whole is not None and events.time is self.first.time:
            return [None if leaf is None else leaf[n] for leaf in self.whole]
        return library.room(self.port, library.most(events.key)[self.port][0], kept=self.leaves)

    def came(self, n: int, events: Tape, room: Room, count: int, made: np.ndarray) -> None:
        """A run has filled its arrays."""
        if self.kept and (self.whole is None or events.time is not self.first.time):
            there = (made >> np.uint64(self.port) & np.uint64(1)).astype(bool)
            leaves = [None if leaf is None else shrunk(leaf, count) for leaf in room]
            self.apart[n] = self._series(events.time[there], leaves)

    def runs(self) -> Runs:
        """All runs of the output."""
        if self.whole is not None and self.time is not None and not self.apart:
            present = np.ones((self.count, len(self.time)), bool)
            fields = {n: a for n, a in zip(self.names, self.whole, strict=True) if a is not None}
            return Runs(self.name, self.time, present, {n: fields[n] for n in self.leaves})
        parts = [self.apart[n] if n in self.apart else self._placed(n) for n in range(self.count)]
        found = joined(self.name, parts, self.leaves)
        kinds = {n: a.dtype for n, a in zip(self.names, self.kinds, strict=True) if a is not None}
        return replace(found, leaves={n: a.astype(kinds[n], copy=False) for n, a in found.leaves.items()})

    def _placed(self, n: int) -> Series:
        assert self.whole is not None
        assert self.time is not None
        return self._series(self.time, [None if leaf is None else leaf[n] for leaf in self.whole])

    def _series(self, time: np.ndarray, leaves: Room) -> Series:
        fields = {n: a for n, a in zip(self.names, leaves, strict=True) if a is not None}
        if list(fields) == ["value"]:
            return Series(time, fields["value"], name=self.name)
        type_ = StructType(self.name, tuple((n, leaf_type(a)) for n, a in fields.items()), dict)
        return Series(time, fields, type=type_, name=self.name)
