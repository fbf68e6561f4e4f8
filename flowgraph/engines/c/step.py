"""Single ticks of a compiled pipeline, for events that come one by one.

Room for one event of each input and one value of each output is made once, with all pointers to it; a tick
writes into it, calls, and copies out.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import numpy as np

from flowgraph.engines.c.library import Compiled, State, pointers
from flowgraph.engines.contract import CellStepper
from flowgraph.language.graph import NEVER


class SingleTicks(CellStepper):
    """One run of a compiled pipeline.

    Args:
        library: the pipeline in C, for all patterns that may come.
        cells: register cells before the first tick.
        seed: (2,) uint32.
    """

    def __init__(self, library: Compiled, cells: Sequence[Any], seed: np.ndarray) -> None:
        self._state = State(library, cells, seed)
        pipeline = library.pipeline
        self._rows = library.single_rows()
        self._into = [
            [
                rows[name][0, ...] if leaf.shape and 0 not in leaf.shape else rows[name]
                for name, leaf in zip(rows.dtype.names or (), port.leaves, strict=False)
            ]
            for rows, port in zip(self._rows, pipeline.inputs, strict=True)
        ]
        self._shapes = [[leaf.shape for leaf in port.leaves] for port in pipeline.inputs]
        self._rooms = [library.room(k, 1) for k in range(len(pipeline.outputs))]
        self._out = [[leaf[0, ...] for leaf in room if leaf is not None] for room in self._rooms]
        self._tick = np.zeros(2, np.int64)  # its time and key
        self._made, self._counts = np.zeros(1, np.uint64), np.zeros(max(len(self._rooms), 1), np.int64)
        self._scratch = library.scratch()
        given = [r.ctypes.data for r in self._rows]
        leaves = [leaf.ctypes.data for room in self._rooms for leaf in room if leaf is not None]
        self._call = (
            ctypes.c_void_p(self._state.address),
            ctypes.c_int64(1),
            ctypes.c_void_p(self._tick.ctypes.data),
            ctypes.c_void_p(self._tick.ctypes.data + 8),
            pointers(given),
            pointers([s.ctypes.data for s in self._scratch]),
            pointers(leaves),
            ctypes.c_void_p(self._made.ctypes.data),
            ctypes.c_void_p(self._counts.ctypes.data),
        )
        self._play = library.play_ticks
        self._faults = self._state.seen_cells([(f.register, f.cell) for f in pipeline.faults])

    def react(
        self, time: int, key: int, leaves: Sequence[tuple[int, Sequence[Any]]]
    ) -> list[tuple[Any, ...] | None]:
        self._tick[0], self._tick[1] = time, key
        for k, values in leaves:
            for into, value, shape in zip(self._into[k], values, self._shapes[k], strict=False):
                if 0 not in shape:
                    into[...] = value.reshape(into.shape) if len(shape) > 1 else value
        self._play(*self._call)
        made = int(self._made[0])
        return [
            tuple([np.array(leaf) for leaf in leaves]) if made >> k & 1 else None
            for k, leaves in enumerate(self._out)
        ]

    def cells(self) -> list[Any]:
        return list(self._state.after())

    def full(self) -> Sequence[int]:
        return [k for k, cell in enumerate(self._faults) if int(cell[0]) != NEVER]
