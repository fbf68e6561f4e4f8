"""The reference interpreter: plays a pipeline's instructions in NumPy, one after the other.

It is the definition that every backend is tested against. A singular factorization gives NaN, as in a
compiled backend, and never an exception.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.contract import Outcome, PipelineEngine, Player, real_leaves
from flowgraph.engines.options import Meter
from flowgraph.pipeline.optimise import optimise
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.types import DTYPES


class Interpreter:
    """Plays ticks of one pipeline, keeping its registers.

    Args:
        pipeline: what to play.
        cells: the value of each register cell, in order.
        dtype: what `real` is.
        seed: (2,) uint32.
        passes: of the optimiser; without them the list is played as it was lowered, which is the definition.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        cells: list[Any],
        dtype: Any,
        seed: np.ndarray,
        passes: Collection[str] = (),
    ) -> None:
        self.pipeline, self.cells, self.dtype, self.seed = pipeline, cells, dtype, seed
        self._passes = passes
        self._reads = [c.read for r in pipeline.registers for c in r.cells]
        self._leaves = [[leaf.value for leaf in port.leaves] for port in pipeline.inputs]
        self._programs: dict[int, tuple[Program, list[Any], dict[int, Any]]] = {}

    def tick(self, time: int, key: int, values: list[tuple[Any, ...]]) -> list[tuple[Any, ...] | None]:
        """One tick: `values` are the leaves of the present inputs; returns those of each output, or None."""
        program, env = self.values(time, key, values)
        self.cells = [env[n] for n in program.writes]
        return [
            None if flag is None or not env.get(flag, True) else tuple(env[n] for n in leaves)
            for flag, leaves in program.outputs
        ]

    def values(self, time: int, key: int, values: list[tuple[Any, ...]]) -> tuple[Program, dict[int, Any]]:
        """The program of a tick, and every value in it by number; the registers stay as they are."""
        if key not in self._programs:
            program = specialise(self.pipeline, key)
            if self._passes:
                program = optimise(program, self._passes)
            known = {n: _as(a, self.dtype) for n, a in program.constants.items()} | self._blanks(key)
            self._programs[key] = program, [_bind(i, self.dtype) for i in program.instructions], known
        program, steps, known = self._programs[key]
        env = dict(known)
        env[self.pipeline.time] = np.int64(time)
        env[self.pipeline.seed] = self.seed
        env.update(zip(self._reads, self.cells, strict=True))
        present = iter(values)
        for k, numbers in enumerate(self._leaves):
            if key >> k & 1:
                env.update(zip(numbers, next(present), strict=True))
        for run, args, out in steps:
            env[out] = run(*[env[a] for a in args])
        return program, env

    def _blanks(self, key: int) -> dict[int, Any]:
        """Zeros for the leaves of absent inputs, which a selection may name without taking."""
        absent = [p for k, p in enumerate(self.pipeline.inputs) if not key >> k & 1]
        return {
            leaf.value: _as(np.zeros(leaf.shape, DTYPES[leaf.dtype]), self.dtype)
            for port in absent
            for leaf in port.leaves
        }


def _bind(i: Any, real: Any) -> tuple[Callable[..., Any], tuple[int, ...], int]:
    return partial(OPS[i.op].run, NUMPY, **bound_attrs(i.op, i.attrs, real)), i.args, i.out


def _as(array: Any, real: Any) -> Any:
    found = np.asarray(array)
    return found.astype(real) if found.dtype.kind == "f" else found


_METER_TICKS = 2048


class _Prepared(Player):
    def __init__(self, pipeline: Pipeline, dtype: str, passes: tuple[str, ...]) -> None:
        self._pipeline, self._real, self._passes = pipeline, np.dtype(dtype), passes

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        ports, real = self._pipeline.outputs, self._real
        player = Interpreter(
            self._pipeline,
            [c.astype(real) if np.asarray(c).dtype.kind == "f" else c for c in cells],
            real,
            seed,
            self._passes,
        )
        rows = [_rows(real_leaves(s, real)) for s in tape.series]
        outputs: list[tuple[list[int], list[tuple[Any, ...]]]] = [([], []) for _ in ports]
        start = perf_counter()
        with np.errstate(all="ignore"):
            for n, (time, key) in enumerate(zip(tape.time.tolist(), tape.key.tolist(), strict=True)):
                values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
                for (times, kept), leaves in zip(outputs, player.tick(time, key, values), strict=True):
                    if leaves is not None:
                        times.append(time)
                        kept.append(leaves)
                if progress is not None and ((n + 1) % _METER_TICKS == 0 or n + 1 == len(tape.time)):
                    progress.update(n + 1, time)
        wall = perf_counter() - start
        stacked = []
        for port, (times, kept) in zip(ports, outputs, strict=True):
            columns: Iterable[Any] = zip(*kept, strict=True) if kept else [[] for _ in port.leaves]
            arrays: list[np.ndarray] = [
                np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
                for column, leaf in zip(columns, port.leaves, strict=True)
            ]
            stacked.append((np.asarray(times, dtype=np.int64), arrays))
        return Outcome(player.cells, stacked, wall)


def _rows(leaves: list[np.ndarray]) -> Iterator[tuple[Any, ...]]:
    return zip(*leaves, strict=True)


class ReferenceEngine(PipelineEngine):
    """The list as it was lowered, in NumPy; no pass suits it, for it is the definition."""

    name = "reference"

    def prepare(
        self, pipeline: Pipeline, patterns: Sequence[int], ticks: int, dtype: str, passes: tuple[str, ...]
    ) -> Player:
        return _Prepared(pipeline, dtype, passes)


ENGINE = ReferenceEngine()
