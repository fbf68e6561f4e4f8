"""The C engine: a pipeline compiled by the system's compiler and called in this process.

Events are arrays of the structs that the generated header declares, and of the outputs the leaves that are
asked for are written to arrays that the caller provides, so nothing is converted a tick. A call plays a
stretch of ticks and lets other threads run meanwhile: many runs go on as many threads.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.data.tape import patterns_of
from flowgraph.engines.c.compile import FLAGS, LOOPS, load
from flowgraph.engines.c.loop import loop_text
from flowgraph.engines.c.names import names_of
from flowgraph.engines.c.source import every_pattern, generate
from flowgraph.engines.c.texts import kept_text, presence_of_rows, presence_rows
from flowgraph.engines.c.units import units
from flowgraph.pipeline.optimise import optimise
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline

_CHUNK_BYTES = 16 * 2**20
_MOST_TICKS = 65536
_LONG = 512
"""Turns of a loop: more than the entries of a covariance, so particles."""
Structs = list[np.ndarray]
Room = list[np.ndarray | None]


@dataclass(frozen=True)
class Piece:
    """Outputs of a stretch of ticks: for each port which of them it is present in, and its leaves there."""

    ticks: int
    outputs: list[tuple[np.ndarray, list[np.ndarray]]]


class State:
    """What one run remembers between ticks, as C lays it out.

    Args:
        library: of the run.
        cells: register cells before the first tick.
        seed: (2,) uint32.
    """

    def __init__(self, library: Compiled, cells: Sequence[Any], seed: np.ndarray) -> None:
        self._memory = np.zeros(library.size + 64, np.uint8)
        start = -self._memory.ctypes.data % 64
        self.address = self._memory.ctypes.data + start
        self._struct = library.cells
        self._registers = library.pipeline.registers
        self._held = [c for r in self._registers for c in r.cells]
        self._seen = self._memory[start : start + self._struct.itemsize].view(self._struct)
        for name, cell, value in zip(self._struct.names or (), self._held, cells, strict=False):
            if math.prod(cell.shape):
                self._seen[name] = np.asarray(value).reshape(self._seen[name].shape)
        self._seen["fg_seed"] = seed

    def now(self) -> list[np.ndarray]:
        """The register cells as they are now: views, which the next tick changes."""
        return [
            self._seen[name].reshape(cell.shape)
            if math.prod(cell.shape)
            else np.zeros(cell.shape, self._seen.dtype[name].base)
            for name, cell in zip(self._struct.names or (), self._held, strict=False)
        ]

    def after(self) -> list[np.ndarray]:
        """Copies of the register cells as they are now."""
        return [np.array(cell) for cell in self.now()]

    def seen_cells(self, places: Sequence[tuple[str, str]]) -> list[np.ndarray]:
        """Views of register cells as they are, by path and name."""
        named = {
            (r.path, c.name): n
            for (r, c), n in zip(
                ((r, c) for r in self._registers for c in r.cells), self._struct.names or (), strict=False
            )
        }
        return [self._seen[named[place]] for place in places]


class Outputs:
    """The outputs of a pipeline that was compiled: when they are present, and arrays to hold them.

    Args:
        pipeline: that is played.
        real: float64 or float32.
        presence: by pattern of inputs, or None for all, the outputs that are present for certain and those
            that can be, a bit each.
    """

    def __init__(self, pipeline: Pipeline, real: Any, presence: Mapping[int | None, tuple[int, int]]) -> None:
        self.pipeline, self.real, self._presence = pipeline, np.dtype(real), presence

    def presence_of(self, key: int) -> tuple[int, int]:
        """The outputs that are present for certain in a tick of this pattern, and those that can be."""
        return self._presence.get(None if None in self._presence else key, (0, 0))

    def kind(self, dtype: str) -> np.dtype[Any]:
        """What a leaf's numbers are kept as."""
        return self.real if dtype == "real" else np.dtype(dtype)

    def most(self, key: np.ndarray) -> list[tuple[int, bool]]:
        """For each output in how many ticks of these patterns it can be present, and whether it then is."""
        counts = {k: int(np.count_nonzero(key == k)) for k in patterns_of(key)}
        found = []
        for port in range(len(self.pipeline.outputs)):
            bits = [(n, *(p >> port & 1 for p in self.presence_of(k))) for k, n in counts.items()]
            found.append((sum(n for n, _, may in bits if may), all(m == must for _, must, m in bits)))
        return found

    def present(self, key: np.ndarray, port: int) -> np.ndarray:
        """(T,) bool: where an output is whose presence follows from the patterns alone."""
        there = {k: bool(self.presence_of(k)[0] >> port & 1) for k in patterns_of(key)}
        if len(set(there.values())) == 1:
            return np.full(len(key), next(iter(there.values())))
        return np.isin(key, [k for k, holds in there.items() if holds])

    def room(self, port: int, *size: int, kept: Collection[str] | None = None) -> Room:
        """Arrays (*size, ...) for the leaves of an output; None for one that is not among `kept`."""
        return [
            np.empty((*size, *leaf.shape), self.kind(leaf.dtype))
            if kept is None or leaf.name in kept
            else None
            for leaf in self.pipeline.outputs[port].leaves
        ]


class Compiled(Outputs):
    """A pipeline in C, for one kind of real.

    Args:
        pipeline: what to play.
        real: float64 or float32.
        keys: the patterns of present inputs that come.
        flags: of the compiler; those that suit the pipeline if left out.
        passes: of the optimiser.

    Raises:
        MissingDependencyError: without a compiler.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        real: Any,
        keys: Sequence[int],
        flags: tuple[str, ...] | None = None,
        passes: tuple[str, ...] = (),
    ) -> None:
        patterns = None if every_pattern(pipeline) is not None else sorted(keys)
        dtype = np.dtype(real).name

        def write() -> dict[str, Any]:
            source = generate(
                pipeline,
                dtype,
                patterns=patterns,
                tidy=lambda program: optimise(program, passes),
                alone=False,  # whoever plays sets registers, and looks for faults and what is not finite
            )
            m = source.names.module
            loop = loop_text(pipeline, source)
            files = {f"{m}.h": source.header, **units(source), "fg_loop.c": loop}
            presence = presence_rows(source.presence)
            return {"files": files, "longest": source.longest, "presence": presence}

        names = names_of(pipeline)
        text = kept_text(pipeline, names.module, ("whole", dtype, patterns, passes), write)
        super().__init__(pipeline, real, presence_of_rows(text["presence"]))
        self._library = load(text["files"], flags or (LOOPS if text["longest"] >= _LONG else FLAGS))
        self.play_ticks = self._library.fg_play
        self.play_ticks.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 7]
        self.play_ticks.restype = None
        self._library.fg_size.restype = ctypes.c_size_t
        self.size = int(self._library.fg_size())
        self._inputs = [
            self._struct(p.leaves, n) for p, n in zip(pipeline.inputs, names.input_leaves, strict=True)
        ]
        self._outputs = [
            self._struct(p.leaves, n) for p, n in zip(pipeline.outputs, names.output_leaves, strict=True)
        ]
        cells = [c for r in pipeline.registers for c in r.cells]
        flat = [n for r in names.registers for n in r]
        self.cells = self._struct(cells, [*flat, "seed"], seed=True)
        per_tick = sum(s.itemsize for s in self._outputs) + 8
        self.chunk = int(max(1, min(_MOST_TICKS, _CHUNK_BYTES // per_tick)))

    def _struct(
        self, leaves: Sequence[Leaf | Cell], names: Sequence[str], *, seed: bool = False
    ) -> np.dtype[Any]:
        """The struct that C lays out, as NumPy sees it."""
        fields: list[Any] = [
            (n, self.kind(leaf.dtype), max(math.prod(leaf.shape), 1))
            if leaf.shape
            else (n, self.kind(leaf.dtype))
            for n, leaf in zip(names, leaves, strict=False)
        ]
        if seed:
            fields.append(("fg_seed", np.uint32, 2))
        return np.dtype(fields or [("nothing", np.bool_)], align=True)

    def rows(self, inputs: Sequence[Sequence[np.ndarray]]) -> Structs:
        """For each input port its events, leaves (n, ...) each, as structs."""
        made = []
        for port, struct, leaves in zip(self.pipeline.inputs, self._inputs, inputs, strict=True):
            rows = np.zeros(len(leaves[0]) if leaves else 0, struct)
            for name, leaf, array in zip(struct.names or (), port.leaves, leaves, strict=False):
                rows[name] = array.reshape(rows[name].shape) if math.prod(leaf.shape) else 0
            made.append(rows)
        return made

    def single_rows(self) -> Structs:
        """Room for one event of each input port."""
        return [np.zeros(1, struct) for struct in self._inputs]

    def scratch(self) -> Structs:
        """Room for the struct of each output."""
        return [np.empty(1, s) for s in self._outputs]

    def advance(
        self, state: State, time: np.ndarray, key: np.ndarray, rows: Structs, rooms: Sequence[Room]
    ) -> tuple[list[int], np.ndarray]:
        """Play ticks in one call; the outputs are written to `rooms`, which must have the rows for them.

        Returns:
            How many rows each output has now, and (T,) uint64 with bit k set where output k was present.
        """
        time, key = np.ascontiguousarray(time), np.ascontiguousarray(key, np.int64)
        made, counts = np.empty(len(time), np.uint64), np.zeros(max(len(rooms), 1), np.int64)
        scratch = self.scratch()
        leaves = [None if leaf is None else leaf.ctypes.data for room in rooms for leaf in room]
        self.play_ticks(
            state.address,
            len(time),
            time.ctypes.data,
            key.ctypes.data,
            pointers([r.ctypes.data for r in rows]),
            pointers([s.ctypes.data for s in scratch]),
            pointers(leaves),
            made.ctypes.data,
            counts.ctypes.data,
        )
        return counts.tolist(), made

    def play(self, state: State, time: np.ndarray, key: np.ndarray, rows: Structs) -> Iterator[Piece]:
        """Play ticks, from what is remembered on; yields stretches of outputs.

        Args:
            state: of the run, which goes on with it.
            time: (T,) int64 ns.
            key: (T,), bit k set where input k is present.
            rows: events of each port, from `rows`.
        """
        rows = list(rows)
        for first in range(0, len(time), self.chunk):
            here = key[first : first + self.chunk]
            rooms = [self.room(k, n) for k, (n, _) in enumerate(self.most(here))]
            counts, made = self.advance(state, time[first : first + self.chunk], here, rows, rooms)
            rows = [r[int((here >> k & 1).sum()) :] for k, r in enumerate(rows)]
            outputs = []
            for k, (room, n) in enumerate(zip(rooms, counts, strict=False)):
                mask = (made >> np.uint64(k) & np.uint64(1)).astype(bool)
                outputs.append((mask, [shrunk(leaf, n) for leaf in room if leaf is not None]))
            yield Piece(len(here), outputs)


def shrunk(leaf: np.ndarray, n: int) -> np.ndarray:
    """The first n rows, without the memory of the others."""
    return leaf if len(leaf) == n else leaf[:n].copy()


def pointers(places: Sequence[int | None]) -> Any:
    """An array of pointers, as C takes it."""
    return (ctypes.c_void_p * max(len(places), 1))(*places)


def compiled(pipeline: Pipeline, real: Any, keys: Sequence[int], passes: tuple[str, ...] = ()) -> Compiled:
    """The pipeline in C, optimised by `passes`; it lives as long as the pipeline does."""
    every = every_pattern(pipeline) is not None
    which = (np.dtype(real).name, None if every else tuple(keys), passes)
    kept: dict[Any, Compiled] = pipeline.__dict__.setdefault("_libraries", {})
    if which not in kept:
        kept[which] = Compiled(pipeline, real, keys, passes=passes)
    return kept[which]
