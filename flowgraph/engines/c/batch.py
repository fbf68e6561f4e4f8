"""Many runs in C: as many at once as there are processors, for a call into C lets other threads go on.

Where a pipeline has a form in lanes, each thread plays several runs side by side in vectors: those that have
their events at the times of the first. What a run gives is the same to the bit whichever runs lie beside it,
and within rounding what it gives alone.

What is the same for all runs is made once: the compiled library, the order of the ticks, and the inputs where
they are shared. An output whose presence follows from its inputs' is written by C straight to its place in an
array of all runs; of one that depends on data, or where runs have other ticks, the runs are put together
afterwards. Only what is kept of the outputs leaves the filter.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.batch import Runs, joined, leaf_type
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape
from flowgraph.engines.c.lanes.library import Lanes, lanes_of
from flowgraph.engines.c.lanes.source import WIDTH
from flowgraph.engines.c.library import Compiled, Outputs, Room, State, Structs, compiled, shrunk
from flowgraph.engines.contract import ManyOutcome, ManyRuns, real_leaves
from flowgraph.engines.options import RunOptions
from flowgraph.recorder.random import seed_words
from flowgraph.types import StructType


def threaded(runs: ManyRuns, passes: tuple[str, ...], options: RunOptions) -> ManyOutcome:
    """Play the runs, as many at once as there are processors, and lanes in each."""
    lanes = lanes_of(runs.pipeline, options.dtype, runs.first.patterns, passes)
    play = _Singly(runs, passes, options) if lanes is None else _Abreast(runs, passes, options, lanes)
    blocks = [range(n, min(n + play.width, len(runs.seeds))) for n in range(0, len(runs.seeds), play.width)]
    ticks = len(runs.first.time)
    start = perf_counter()
    with ThreadPoolExecutor(min(len(blocks), os.cpu_count() or 1)) as pool:
        for block, played in zip(blocks, pool.map(play, blocks), strict=True):
            ticks = played
            if options.progress is not None:
                options.progress.update(block[-1] + 1, 0)
    wall = perf_counter() - start
    return ManyOutcome({o.name: o.runs() for o in play.outputs if o.kept}, ticks, wall)


class _Singly:
    """Plays one run after the other."""

    width = 1

    def __init__(
        self, runs: ManyRuns, passes: tuple[str, ...], options: RunOptions, lanes: Any = None
    ) -> None:
        self.many, self.passes, self.real = runs, passes, np.dtype(options.dtype)
        self.outputs = [
            _Output(lanes or self._library(runs.first), k, runs.first, runs.keep.get(p.name), len(runs.seeds))
            for k, p in enumerate(runs.pipeline.outputs)
        ]
        self._rows: Structs | None = None

    def _library(self, events: Tape) -> Compiled:
        return compiled(self.many.pipeline, self.real, events.patterns, self.passes)

    def __call__(self, block: Sequence[int]) -> int:
        return [self.one(n, self.many.tape(n)) for n in block][-1]

    def one(self, n: int, events: Tape) -> int:
        """Play a run; returns its number of ticks."""
        library = self._library(events)
        if self.many.shared:
            given = self._rows = self._rows or _rows(library, events)
        else:
            given = _rows(library, events)
        state = State(library, self.many.cells(n), seed_words(self.many.seeds[n]))
        rooms = [output.room(n, library, events) for output in self.outputs]
        counts, made = library.advance(state, events.time, events.key, given, rooms)
        self.many.finish(n, state.now())
        for output, room, count in zip(self.outputs, rooms, counts, strict=False):
            output.came(n, events, room, count, made)
        return len(events.time)


class _Abreast(_Singly):
    """Plays runs side by side that have the ticks of the first, and others one after the other."""

    width = WIDTH

    def __init__(self, runs: ManyRuns, passes: tuple[str, ...], options: RunOptions, lanes: Lanes) -> None:
        super().__init__(runs, passes, options, lanes)
        self.lanes = lanes
        self._shared = lanes.rows([self._leaves(runs.first)]) if runs.shared else None
        self._begun = lanes.state([runs.started], [seed_words(0)]) if runs.started is not None else None

    def _leaves(self, events: Tape) -> list[list[np.ndarray]]:
        return [real_leaves(s, self.real) for s in events.series]

    def __call__(self, block: Sequence[int]) -> int:
        tapes = {n: self.many.tape(n) for n in block}
        abreast = [n for n, events in tapes.items() if events.time is self.many.first.time]
        apart = [self.one(n, tapes[n]) for n in block if n not in abreast]
        if abreast:
            self._together(abreast, tapes)
        return apart[-1] if block[-1] not in abreast else len(self.many.first.time)

    def _together(self, block: Sequence[int], tapes: Mapping[int, Tape]) -> None:
        lanes, first = self.lanes, self.many.first
        seeds = [seed_words(self.many.seeds[n]) for n in block]
        if self._begun is not None:
            memory = lanes.begun(self._begun, seeds)
        else:
            memory = lanes.state([self.many.cells(n) for n in block], seeds)
        given = self._shared or lanes.rows([self._leaves(tapes[n]) for n in block])
        rooms = [[output.room(n, lanes, first) for output in self.outputs] for n in block]
        played = lanes.advance(memory, first.time, first.key, given, rooms)
        quiet = not self.many.pipeline.faults and lanes.finite(memory)  # then the cells hold no trouble
        for lane, (n, room, (counts, made)) in enumerate(zip(block, rooms, played, strict=True)):
            if not quiet:
                self.many.finish(n, lanes.after(memory, lane))
            for output, arrays, count in zip(self.outputs, room, counts, strict=False):
                output.came(n, first, arrays, count, made)


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

    def __init__(self, library: Outputs, port: int, first: Tape, leaves: list[str] | None, runs: int) -> None:
        self.port, self.first, self.count = port, first, runs
        self.leaves, self.kept = leaves or [], leaves is not None
        self.name = library.pipeline.outputs[port].name
        self.names = [leaf.name for leaf in library.pipeline.outputs[port].leaves]
        count, certain = library.most(first.key)[port]
        self.time = first.time[library.present(first.key, port)] if certain else None
        self.whole = library.room(port, runs, count, kept=self.leaves) if certain and self.kept else None
        self.kinds = library.room(port, 0)
        self.apart: dict[int, Series] = {}

    def room(self, n: int, library: Outputs, events: Tape) -> Room:
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
