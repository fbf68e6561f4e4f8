"""How large numbers get: the sizes of all values of a pipeline, over recorded flights in floating point."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.reference import Interpreter
from flowgraph.pipeline.formats import Formats, fraction_for
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import needed


class Sizes:
    """The largest size of each element of each real value, so far.

    Args:
        pipeline: in plain instructions; it is played in float64.

    Attributes:
        largest: by value number, an array that broadcasts to the value's shape.
        absent: the inputs and registers that were NaN at some time.
        ticks: how many were played.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.largest: dict[int, np.ndarray] = {}
        self.absent: set[int] = set()
        self.ticks = 0
        self._real = {n for n, s in pipeline.specs.items() if s.dtype == "real"} - set(pipeline.constants)
        self._shared = {
            n for part in _parts(pipeline) for n, axis in zip(part.shape, part.axes, strict=False) if axis
        }

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray) -> None:
        """Play one flight, and widen the sizes by what occurs in it."""
        player = Interpreter(self.pipeline, cells, np.dtype(np.float64), seed)
        rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
        for cell, value in zip((c for r in self.pipeline.registers for c in r.cells), cells, strict=True):
            if cell.dtype == "real":
                self._see(cell.read, np.asarray(value))
        with np.errstate(all="ignore"):
            for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
                values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
                program, env = player.values(time, key, values)
                player.cells = [env[n] for n in program.writes]
                made = {i.out for i in program.instructions}
                given = {
                    leaf.value
                    for k, port in enumerate(self.pipeline.inputs)
                    if key >> k & 1
                    for leaf in port.leaves
                }
                taken = needed(program, env)
                for n in (made | given) & self._real:
                    self._see(n, np.where(taken.get(n, False), env[n], 0.0))
                self.absent |= {n for n in given & self._real if np.isnan(env[n]).any()}
                for cell, n in zip(
                    (c for r in self.pipeline.registers for c in r.cells), program.writes, strict=True
                ):
                    if cell.dtype == "real":
                        self._see(cell.read, env[n])
                        if np.isnan(env[n]).any():
                            self.absent.add(cell.read)
                self.ticks += 1

    def _see(self, value: int, x: Any) -> None:
        size = np.abs(np.asarray(x, dtype=np.float64))
        axes = tuple(a for a, n in enumerate(size.shape) if n in self._shared)
        size = np.where(np.isfinite(size), size, 0.0).max(axis=axes, keepdims=True, initial=0.0)
        before = self.largest.get(value)
        self.largest[value] = size if before is None else np.maximum(before, size)

    def formats(self, width: int, margin: float = 2.0) -> Formats:
        """Formats in which numbers fit that are `margin` times as large as any that was seen."""
        fractions = {n: fraction_for(margin * size, width) for n, size in self.largest.items()}
        return Formats(width, fractions, margin, frozenset(self.absent))


def _parts(pipeline: Pipeline) -> Iterable[Any]:
    yield from (c for r in pipeline.registers for c in r.cells)
    yield from (x for port in (*pipeline.inputs, *pipeline.outputs) for x in port.leaves)
