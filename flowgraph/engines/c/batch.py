"""Many runs in C: as many at once as there are processors, for a call into C lets other threads go on.

What is the same for all runs is made once: the compiled library, the order of the ticks, and the inputs where
they are shared. An output whose presence follows from its inputs' is written by C straight to its place in an
array of all runs; of one that depends on data, or where runs have other ticks, the runs are put together
afterwards. Only what is kept of the outputs leaves the filter.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter

import numpy as np

from flowgraph.data.batch import Runs, joined, leaf_type
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape
from flowgraph.engines.c.library import Compiled, Room, State, Structs, compiled, shrunk
from flowgraph.engines.contract import ManyOutcome, ManyRuns, real_leaves
from flowgraph.engines.options import RunOptions
from flowgraph.recorder.random import seed_words
from flowgraph.types import StructType


def threaded(runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
    """Play the runs, as many at once as there are processors: a call into C lets other threads go on."""
    pipeline, real, seeds = runs.pipeline, np.dtype(options.dtype), runs.seeds
    first = runs.first
    library = compiled(pipeline, real, first.patterns, passes)
    rows = _rows(library, first) if runs.shared else None
    outputs = [
        _Output(library, k, first, runs.keep.get(p.name), len(seeds)) for k, p in enumerate(pipeline.outputs)
    ]

    def run(n: int) -> int:
        events, c = runs.tape(n), library
        if events.time is not first.time:
            c = compiled(pipeline, real, events.patterns, passes)
        state = State(c, runs.cells(n), seed_words(seeds[n]))
        given = rows if rows is not None else _rows(c, events)
        rooms = [output.room(n, c, events) for output in outputs]
        counts, made = c.advance(state, events.time, events.key, given, rooms)
        runs.finish(n, state.after())
        for output, room, count in zip(outputs, rooms, counts, strict=False):
            output.came(n, events, room, count, made)
        return len(events.time)

    ticks = len(first.time)
    start = perf_counter()
    with ThreadPoolExecutor(min(len(seeds), os.cpu_count() or 1)) as pool:
        for n, played in enumerate(pool.map(run, range(len(seeds)))):
            ticks = played
            if options.progress is not None:
                options.progress.update(n + 1, 0)
    wall = perf_counter() - start
    return ManyOutcome({o.name: o.runs() for o in outputs if o.kept}, ticks, wall)


def _rows(library: Compiled, events: Tape) -> Structs:
    return library.rows([real_leaves(s, library.real) for s in events.series])


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
