"""The C engine: a pipeline compiled by the system's compiler and called in this process.

Events and outputs are arrays of the structs that the generated header declares, so nothing is converted a
tick. A call plays a stretch of ticks and lets other threads run meanwhile: many runs go on as many threads.
"""

from __future__ import annotations

import ctypes
import math
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.c.compile import FLAGS, build
from flowgraph.c.source import MOST_PATTERNS, Source, generate
from flowgraph.optimise import optimise
from flowgraph.pipeline import Cell, Leaf, Pipeline
from flowgraph.program import specialise

_CHUNK_BYTES = 16 * 2**20
_MOST_TICKS = 65536
Structs = list[np.ndarray]


def loop_text(pipeline: Pipeline, source: Source) -> str:
    """C that plays a stretch of ticks; a part of the engine, not of the filter."""
    names = source.names
    m = names.module
    inputs = [f"present >> {k} & 1u ? in{k}++ : NULL" for k in range(len(names.inputs))]
    lines = [
        f'#include "{m}.h"',
        "#include <stddef.h>",
        f"size_t flowgraph_size(void) {{ return sizeof({m}_state); }}",
        "void flowgraph_play(void *state, int64_t ticks, const int64_t *time, const int64_t *key,",
        "                    const void *const *inputs, void *const *outputs, uint64_t *made)",
        "{",
        f"    {m}_state *const s = state;",
    ]
    for k, n in enumerate(names.inputs):
        lines.append(f"    const {m}_{n} *in{k} = inputs[{k}];")
    for k, n in enumerate(names.outputs):
        lines.append(f"    {m}_{n} *out{k} = outputs[{k}];")
    if not names.inputs:
        lines.append("    (void)inputs;")
    if not names.outputs:
        lines.append("    (void)outputs;")
    call = ", ".join(["s", "time[t]", "present", *inputs, *(f"out{k}" for k in range(len(names.outputs)))])
    lines += [
        "    for (int64_t t = 0; t < ticks; t++) {",
        "        const uint64_t present = (uint64_t)key[t];",
        f"        const uint64_t there = {m}_react({call});",
    ]
    lines += [f"        out{k} += there >> {k} & 1u;" for k in range(len(names.outputs))]
    lines += ["        made[t] = there;", "    }", "}", ""]
    return "\n".join(lines)


@dataclass(frozen=True)
class Piece:
    """Outputs of a stretch of ticks: for each port which of them it is present in, and its leaves there."""

    ticks: int
    outputs: list[tuple[np.ndarray, list[np.ndarray]]]


class Compiled:
    """A pipeline in C, for one kind of real.

    Args:
        pipeline: what to play.
        real: float64 or float32.
        keys: the patterns of present inputs that come.
        flags: of the compiler.
        passes: of the optimiser.

    Raises:
        MissingDependencyError: without a compiler.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        real: Any,
        keys: Sequence[int],
        flags: tuple[str, ...] = FLAGS,
        passes: tuple[str, ...] = (),
    ) -> None:
        self.pipeline, self.real = pipeline, np.dtype(real)
        every = 2 ** len(pipeline.inputs) - 1 <= MOST_PATTERNS
        self.source = generate(
            pipeline,
            self.real.name,
            patterns=None if every else keys,
            program=lambda p, key: optimise(specialise(p, key), passes),
        )
        m = self.source.names.module
        files = {
            f"{m}.h": self.source.header,
            f"{m}.c": self.source.source,
            "loop.c": loop_text(pipeline, self.source),
        }
        self._library = ctypes.CDLL(str(build(files, flags)))
        self._play = self._library.flowgraph_play
        self._play.argtypes = [ctypes.c_void_p, ctypes.c_int64, *[ctypes.c_void_p] * 5]
        self._play.restype = None
        self._library.flowgraph_size.restype = ctypes.c_size_t
        self._size = int(self._library.flowgraph_size())
        names = self.source.names
        self._inputs = [
            self._struct(p.leaves, n) for p, n in zip(pipeline.inputs, names.input_leaves, strict=True)
        ]
        self._outputs = [
            self._struct(p.leaves, n) for p, n in zip(pipeline.outputs, names.output_leaves, strict=True)
        ]
        cells = [c for r in pipeline.registers for c in r.cells]
        flat = [n for r in names.registers for n in r]
        self._cells = self._struct(cells, [*flat, "seed"], seed=True)
        self._rooms = threading.local()
        per_tick = sum(s.itemsize for s in self._outputs) + 8
        self.chunk = int(max(1, min(_MOST_TICKS, _CHUNK_BYTES // per_tick)))

    def _struct(
        self, leaves: Sequence[Leaf | Cell], names: Sequence[str], *, seed: bool = False
    ) -> np.dtype[Any]:
        """The struct that C lays out, as NumPy sees it."""
        fields: list[Any] = [
            (n, self._kind(leaf.dtype), max(math.prod(leaf.shape), 1))
            if leaf.shape
            else (n, self._kind(leaf.dtype))
            for n, leaf in zip(names, leaves, strict=False)
        ]
        if seed:
            fields.append(("fg_seed", np.uint32, 2))
        return np.dtype(fields or [("nothing", np.bool_)], align=True)

    def _kind(self, dtype: str) -> np.dtype[Any]:
        return self.real if dtype == "real" else np.dtype(dtype)

    def rows(self, inputs: Sequence[Sequence[np.ndarray]]) -> Structs:
        """For each input port its events, leaves (n, ...) each, as structs."""
        made = []
        for port, struct, leaves in zip(self.pipeline.inputs, self._inputs, inputs, strict=True):
            rows = np.zeros(len(leaves[0]) if leaves else 0, struct)
            for name, leaf, array in zip(struct.names or (), port.leaves, leaves, strict=False):
                rows[name] = array.reshape(rows[name].shape) if math.prod(leaf.shape) else 0
            made.append(rows)
        return made

    def play(
        self,
        cells: Sequence[Any],
        seed: np.ndarray,
        time: np.ndarray,
        key: np.ndarray,
        rows: Structs,
        kept: Mapping[str, Collection[str]] | None = None,
    ) -> Iterator[tuple[Piece, list[np.ndarray]]]:
        """Play ticks; yields stretches of outputs, with the register cells after each.

        Args:
            cells: register cells before the first tick.
            seed: (2,) uint32.
            time, key: (T,) int64.
            rows: events of each port, from `rows`.
            kept: the leaves that are wanted of each output; all if left out.
        """
        memory = np.zeros(self._size + 64, np.uint8)
        start = -memory.ctypes.data % 64
        state = memory[start : start + self._cells.itemsize].view(self._cells)
        held = [c for r in self.pipeline.registers for c in r.cells]
        for name, cell, value in zip(self._cells.names or (), held, cells, strict=False):
            if math.prod(cell.shape):
                state[name] = np.asarray(value).reshape(state[name].shape)
        state["fg_seed"] = seed
        done = [0] * len(rows)
        most = min(self.chunk, len(time))
        outputs = self._room(most)
        made = np.zeros(most, np.uint64)
        out = (ctypes.c_void_p * max(len(outputs), 1))(*(o.ctypes.data for o in outputs))
        time, key = np.ascontiguousarray(time), np.ascontiguousarray(key)
        for first in range(0, len(time), self.chunk):
            count = min(self.chunk, len(time) - first)
            here = key[first : first + count]
            places = [r.ctypes.data + n * r.itemsize for r, n in zip(rows, done, strict=True)]
            given = (ctypes.c_void_p * max(len(rows), 1))(*places)
            self._play(
                memory.ctypes.data + start,
                count,
                time[first:].ctypes.data,
                here.ctypes.data,
                ctypes.addressof(given),
                ctypes.addressof(out),
                made.ctypes.data,
            )
            done = [n + int((here >> k & 1).sum()) for k, n in enumerate(done)]
            yield Piece(count, self._leaves(outputs, made[:count], kept)), self._after(state)

    def _room(self, ticks: int) -> Structs:
        """This thread's memory for the outputs of a stretch: new pages for each run cost time."""
        kept: Structs = getattr(self._rooms, "outputs", [])
        if not kept or len(kept[0]) <= ticks:
            kept = [np.empty(ticks + 1, s) for s in self._outputs]  # one more: written, though absent
            self._rooms.outputs = kept
        return kept

    def _leaves(
        self, outputs: Structs, made: np.ndarray, kept: Mapping[str, Collection[str]] | None
    ) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        """Of each output where it is present, and a copy of its leaves there."""
        found = []
        for k, (port, rows) in enumerate(zip(self.pipeline.outputs, outputs, strict=True)):
            mask = (made >> np.uint64(k) & np.uint64(1)).astype(bool)
            n = int(mask.sum())
            leaves = [
                rows[name][:n].copy().reshape(n, *leaf.shape)
                if math.prod(leaf.shape)
                else np.zeros((n, *leaf.shape), self._kind(leaf.dtype))
                for name, leaf in zip(rows.dtype.names or (), port.leaves, strict=False)
                if kept is None or leaf.name in kept.get(port.name, ())
            ]
            found.append((mask, leaves))
        return found

    def _after(self, state: np.ndarray) -> list[np.ndarray]:
        held = [c for r in self.pipeline.registers for c in r.cells]
        return [
            np.array(state[name][0]).reshape(cell.shape)
            if math.prod(cell.shape)
            else np.zeros(cell.shape, self._kind(cell.dtype))
            for name, cell in zip(self._cells.names or (), held, strict=False)
        ]


def compiled(pipeline: Pipeline, real: Any, keys: Sequence[int], passes: tuple[str, ...] = ()) -> Compiled:
    """The pipeline in C, optimised by `passes`; it lives as long as the pipeline does."""
    every = 2 ** len(pipeline.inputs) - 1 <= MOST_PATTERNS
    which = (np.dtype(real).name, None if every else tuple(keys), passes)
    kept: dict[Any, Compiled] = pipeline.__dict__.setdefault("_libraries", {})
    if which not in kept:
        kept[which] = Compiled(pipeline, real, keys, passes=passes)
    return kept[which]
