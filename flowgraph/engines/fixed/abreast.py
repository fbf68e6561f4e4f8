"""Several flights of one pipeline at once, in float64: every value of a tick, for whoever looks at all.

An interpreter spends its time between small arrays, so the last axis of each value here is the flights: tens
of them take about what one takes. Each flight makes its own n-th tick at the n-th step. Those with the same
inputs present there go together.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.numpy.rules import bound
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise
from flowgraph.types import DTYPES

_REAL: np.dtype[Any] = np.dtype(np.float64)


@dataclass(frozen=True)
class Recorded:
    """A flight: the pipeline with its constants, its ticks, and what it starts from.

    Args:
        pipeline: all flights have one structure, and constants of their own.
        tape: the ticks.
        cells: register cells before the first.
        seed: (2,) uint32.
    """

    pipeline: Pipeline
    tape: Tape
    cells: Sequence[Any]
    seed: np.ndarray


@dataclass(frozen=True)
class Step:
    """One tick of some flights: the last axis of each value is these, or 1 where it is the same in all.

    Args:
        program: of the inputs that are present.
        key: of these.
        values: by number.
        flights: which, by their places.
    """

    program: Program
    key: int
    values: dict[int, Any]
    flights: tuple[int, ...]


def abreast(flights: Sequence[Recorded]) -> Iterator[Step]:
    """All ticks of the flights, in their order."""
    together = _Together(flights)
    keys = [f.tape.key.tolist() for f in flights]
    for n in range(max(map(len, keys), default=0)):
        groups: dict[int, list[int]] = {}
        for k, mine in enumerate(keys):
            if n < len(mine):
                groups.setdefault(mine[n], []).append(k)
        for key, lanes in groups.items():
            yield together.tick(n, key, lanes)


class _Together:
    def __init__(self, flights: Sequence[Recorded]) -> None:
        self.flights, self.pipeline = flights, flights[0].pipeline
        self.reads = [c.read for r in self.pipeline.registers for c in r.cells]
        self.cells = [_stacked(cell) for cell in zip(*(f.cells for f in flights), strict=True)]
        self.seeds = _stacked([f.seed for f in flights])
        self.varying = varying([f.pipeline for f in flights])
        self.constants = {n: _stacked([f.pipeline.constants[n] for f in flights]) for n in self.varying}
        self.rows = [[0] * len(self.pipeline.inputs) for _ in flights]
        self.leaves = [[list(s.leaves.values()) for s in f.tape.series] for f in flights]
        self.programs: dict[int, tuple[Program, list[_Bound], dict[int, Any]]] = {}

    def tick(self, n: int, key: int, lanes: list[int]) -> Step:
        """The n-th tick of some flights."""
        program, steps, known = self._program(key)
        every = len(lanes) == len(self.flights)

        def of(x: Any) -> Any:
            return x if every else x[..., lanes]

        values = dict(known)
        values[self.pipeline.time] = np.array([self.flights[k].tape.time[n] for k in lanes], np.int64)
        values[self.pipeline.seed] = of(self.seeds)
        values.update((c, of(x)) for c, x in self.constants.items() if c in program.constants)
        values.update(zip(self.reads, map(of, self.cells), strict=True))
        for k, port in enumerate(self.pipeline.inputs):
            if key >> k & 1:
                for place, leaf in enumerate(port.leaves):
                    given = [self.leaves[f][k][place][self.rows[f][k]] for f in lanes]
                    values[leaf.value] = _stacked(given)
                for f in lanes:
                    self.rows[f][k] += 1
        for run, args, out in steps:
            values[out] = run(*[values[a] for a in args])
        for place, w in enumerate(program.writes):
            now = np.broadcast_to(values[w], (*np.shape(values[w])[:-1], len(lanes)))
            if every:
                self.cells[place] = now
            else:
                self.cells[place] = self.cells[place].copy()
                self.cells[place][..., lanes] = now
        return Step(program, key, values, tuple(lanes))

    def _program(self, key: int) -> tuple[Program, list[_Bound], dict[int, Any]]:
        if key not in self.programs:
            program = specialise(self.pipeline, key)
            steps = [(bound(i, _REAL), i.args, i.out) for i in program.instructions]
            known = {n: a[..., None] for n, a in program.constants.items() if n not in self.varying}
            for k, port in enumerate(self.pipeline.inputs):  # a selection may name what it does not take
                if not key >> k & 1:
                    known |= {x.value: np.zeros((*x.shape, 1), DTYPES[x.dtype]) for x in port.leaves}
            self.programs[key] = program, steps, known
        return self.programs[key]


_Bound = tuple[Callable[..., Any], tuple[int, ...], int]


def varying(pipelines: Sequence[Pipeline]) -> set[int]:
    """The constants that are not the same in all of these pipelines of one structure."""
    first, *others = pipelines
    return {
        n
        for n, a in first.constants.items()
        if any(not np.array_equal(a, p.constants[n], equal_nan=a.dtype.kind == "f") for p in others)
    }


def _stacked(rows: Sequence[Any]) -> np.ndarray:
    return np.stack([np.asarray(row) for row in rows], axis=-1)
