"""Several runs in one call: their states, events and outputs laid out as lanes, and taken apart again."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.engines.c.compile import LANES, CompileError, load
from flowgraph.engines.c.lanes.expressions import NoLanesError
from flowgraph.engines.c.lanes.source import WIDTH, generate_lanes
from flowgraph.engines.c.library import Outputs, Room, Structs, pointers
from flowgraph.engines.c.names import names_of
from flowgraph.engines.c.source import every_pattern
from flowgraph.engines.c.texts import kept_text, presence_of_rows, presence_rows
from flowgraph.pipeline.optimise import optimise
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline

_SEED = Cell("fg_seed", -1, -1, (2,), "uint32", np.zeros(2, np.uint32))


class Lanes(Outputs):
    """A pipeline compiled for several runs at once, in double precision.

    Args:
        pipeline: what to play.
        keys: the patterns of present inputs that come.
        passes: of the optimiser.

    Raises:
        NoLanesError: where an operation of the pipeline has no form in lanes.
        MissingDependencyError, CompileError: without a compiler, or without one that knows vector types.
    """

    def __init__(self, pipeline: Pipeline, keys: Sequence[int], passes: tuple[str, ...]) -> None:
        names, file = names_of(pipeline), f"{names_of(pipeline).module}_lanes.c"

        def write() -> dict[str, Any]:
            source = generate_lanes(pipeline, keys, lambda program: optimise(program, passes))
            return {"files": {file: source.text}, "presence": presence_rows(source.presence)}

        patterns = None if every_pattern(pipeline) is not None else sorted(keys)
        text = kept_text(pipeline, names.module, ("lanes", patterns, passes), write)
        super().__init__(pipeline, np.float64, presence_of_rows(text["presence"]))
        self._library = load(text["files"], LANES)
        self._library.fg_play.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 6]
        self._library.fg_play.restype = None
        self._library.fg_size.restype = ctypes.c_size_t
        self.size = int(self._library.fg_size())
        self._inputs = [
            self._lanes(p.leaves, n) for p, n in zip(pipeline.inputs, names.input_leaves, strict=True)
        ]
        self._held = [c for r in pipeline.registers for c in r.cells]
        cells = [n for r in names.registers for n in r]
        self._cells = self._lanes([*self._held, _SEED], [*cells, "fg_seed"])
        self._reals = self._words_of_reals()

    def _lanes(self, leaves: Sequence[Leaf | Cell], names: Sequence[str]) -> np.dtype[Any]:
        """The struct that C lays out, as NumPy sees it: each number a lane for each run."""
        kinds = {"real": np.float64, "bool": np.int64}
        fields = [
            (n, kinds.get(leaf.dtype, leaf.dtype), (max(math.prod(leaf.shape), 1), WIDTH))
            for n, leaf in zip(names, leaves, strict=True)
        ]
        offsets, end, most = [], 0, WIDTH
        for _, kind, shape in fields:
            step = np.dtype(kind).itemsize * WIDTH  # of a vector, and its alignment
            offsets.append(-(-end // step) * step)
            end, most = offsets[-1] + step * shape[0], max(most, step)
        return np.dtype(
            {
                "names": [n for n, _, _ in fields],
                "formats": [(kind, shape) for _, kind, shape in fields],
                "offsets": offsets,
                "itemsize": -(-end // most) * most if fields else 8 * WIDTH,
            }
        )

    def _words_of_reals(self) -> np.ndarray:
        """Where among the words of 8 bytes of the register cells the reals are."""
        words = np.zeros(self._cells.itemsize // 8, bool)
        fields: Mapping[str, Any] = self._cells.fields or {}
        for name, cell in zip(self._cells.names or (), self._held, strict=False):
            kind, offset = fields[name][:2]
            if cell.dtype == "real" and 0 not in cell.shape:
                words[offset // 8 : (offset + kind.itemsize) // 8] = True
        return np.flatnonzero(words)

    def rows(self, runs: Sequence[Sequence[Sequence[np.ndarray]]]) -> Structs:
        """For each input port its events as structs of lanes; `runs` has the leaves (n, ...) of each port.

        One run alone is the same in all lanes; lanes without a run have the last one's.
        """
        made = []
        for k, (port, struct) in enumerate(zip(self.pipeline.inputs, self._inputs, strict=True)):
            count = len(runs[0][k][0]) if runs[0][k] else 0
            rows = _aligned(count, struct)
            for j, (name, leaf) in enumerate(zip(struct.names or (), port.leaves, strict=False)):
                if math.prod(leaf.shape):
                    for lane, run in enumerate(runs):
                        rows[name][..., lane] = _signed(run[k][j]).reshape(count, -1)
                    rows[name][..., len(runs) :] = rows[name][..., len(runs) - 1 : len(runs)]
            made.append(rows)
        return made

    def state(self, cells: Sequence[Sequence[Any]], seeds: Sequence[np.ndarray]) -> np.ndarray:
        """What the runs remember, with the cells and (2,) uint32 seed of each; lanes without a run have the
        last one's, and one run's cells alone are the same in all lanes."""
        memory = _aligned(1, np.dtype((np.void, self.size)))
        seen = self._seen(memory)
        for lane, run in enumerate(cells):
            for name, cell, value in zip(self._cells.names or (), self._held, run, strict=False):
                if math.prod(cell.shape):
                    seen[name][0, :, lane:] = _signed(np.asarray(value)).reshape(-1, 1)
        return self._seeded(memory, seeds)

    def begun(self, memory: np.ndarray, seeds: Sequence[np.ndarray]) -> np.ndarray:
        """A copy of what runs remember that begins with other seeds."""
        copy = _aligned(1, memory.dtype)
        copy[:] = memory
        return self._seeded(copy, seeds)

    def _seeded(self, memory: np.ndarray, seeds: Sequence[np.ndarray]) -> np.ndarray:
        lanes = np.array([seeds[min(lane, len(seeds) - 1)] for lane in range(WIDTH)], np.uint32)
        self._seen(memory)["fg_seed"][0] = lanes.T
        return memory

    def _seen(self, memory: np.ndarray) -> np.ndarray:
        return memory.view(np.uint8)[: self._cells.itemsize].view(self._cells)

    def finite(self, memory: np.ndarray) -> bool:
        """Whether all reals among the register cells of all lanes are."""
        words = memory.view(np.uint8)[: self._cells.itemsize].view(np.float64)
        return bool(np.isfinite(words[self._reals]).all())

    def after(self, memory: np.ndarray, lane: int) -> list[np.ndarray]:
        """Copies of the register cells of one run as they are now."""
        seen = self._seen(memory)
        return [
            np.array(seen[name][0, : math.prod(cell.shape), lane], self.kind(cell.dtype)).reshape(cell.shape)
            for name, cell in zip(self._cells.names or (), self._held, strict=False)
        ]

    def advance(
        self,
        memory: np.ndarray,
        time: np.ndarray,
        key: np.ndarray,
        rows: Structs,
        rooms: Sequence[Sequence[Room]],
    ) -> list[tuple[list[int], np.ndarray]]:
        """Play ticks of all lanes in one call; the outputs of each run are written to its `rooms`.

        Returns:
            For each run how many rows each output has now, and (T,) uint64 with bit k set where output k was
            present.
        """
        time, key = np.ascontiguousarray(time), np.ascontiguousarray(key, np.int64)
        outputs = len(self.pipeline.outputs)
        made = np.empty((WIDTH, len(time)), np.uint64)
        counts = np.zeros((WIDTH, max(outputs, 1)), np.int64)
        leaves: list[int | None] = []
        for port in range(outputs):
            for leaf in range(len(self.pipeline.outputs[port].leaves)):
                for lane in range(WIDTH):
                    array = rooms[lane][port][leaf] if lane < len(rooms) else None
                    leaves.append(None if array is None else array.ctypes.data)
        self._library.fg_play(
            memory.ctypes.data,
            len(time),
            time.ctypes.data,
            key.ctypes.data,
            pointers([r.ctypes.data for r in rows]),
            pointers(leaves),
            made.ctypes.data,
            counts.ctypes.data,
        )
        return [(counts[lane].tolist(), made[lane]) for lane in range(len(rooms))]


def _signed(array: np.ndarray) -> np.ndarray:
    """Truths as masks: all bits of a true one are set."""
    return -array.astype(np.int64) if array.dtype == bool else array


def _aligned(count: int, struct: np.dtype[Any]) -> np.ndarray:
    """Zeros at an address that vectors can be read from."""
    memory = np.zeros(count * struct.itemsize + 64, np.uint8)
    start = -memory.ctypes.data % 64
    return memory[start : start + count * struct.itemsize].view(struct)


def lanes_of(
    pipeline: Pipeline, real: Any, keys: Sequence[int], passes: tuple[str, ...] = ()
) -> Lanes | None:
    """The pipeline for several runs at once; None where it, or the compiler, has no lanes."""
    if np.dtype(real) != np.float64:
        return None
    which = (None if every_pattern(pipeline) is not None else tuple(keys), passes)
    kept: dict[Any, Lanes | None] = pipeline.__dict__.setdefault("_lanes", {})
    if which not in kept:
        try:
            kept[which] = Lanes(pipeline, keys, passes)
        except (NoLanesError, CompileError):  # vector types are an extension of GCC and Clang
            kept[which] = None
    return kept[which]
