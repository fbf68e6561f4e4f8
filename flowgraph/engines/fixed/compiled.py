"""The fixed-point C of a pipeline, compiled and called in this process."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.c.compile import load
from flowgraph.engines.contract import Outcome, Player
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.fixed.source import Source
from flowgraph.engines.options import Meter
from flowgraph.pipeline.formats import real_numbers
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import DTYPES

_FLAGS = ("-std=c99", "-O1")
_CHUNK = 4096


class CompiledIntegers(Player):
    """Plays a pipeline in its formats, in C.

    Attributes:
        saturations: of the last run, by value number; words that no selection takes are counted too.
    """

    def __init__(self, pipeline: Pipeline, patterns: Sequence[int]) -> None:
        self.pipeline = pipeline
        self.source = Source(pipeline, patterns)
        self.saturations: dict[int, int] = {}
        library = load({"fixed.c": self.source.text}, _FLAGS)
        self._play = library.fx_play
        self._play.restype = ctypes.c_int64

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        source, pipeline = self.source, self.pipeline
        player = Integers(pipeline, cells, seed)
        held = [c for r in pipeline.registers for c in r.cells]
        w = source.first.copy()
        counts = np.zeros(len(source.counts) + 1, np.int64)
        for c, v in zip(held, player.cells, strict=True):
            self._set(w, c.read, v)
        self._set(w, pipeline.seed, seed)
        rows = [
            np.ascontiguousarray(player.words(leaf.value, x, leaf.shape) if leaf.dtype == "real" else x, np.int64)
            if len(x)
            else np.zeros(0, np.int64)
            for port, series in zip(pipeline.inputs, tape.series, strict=True)
            for leaf, x in zip(port.leaves, series.leaves.values(), strict=True)
        ]
        ticks = len(tape.time)
        outs = [
            np.zeros((ticks, max(math.prod(leaf.shape), 1)), np.int64) for port in pipeline.outputs for leaf in port.leaves
        ]
        when = [np.zeros(ticks, np.int64) for _ in pipeline.outputs]
        made = np.zeros(len(pipeline.outputs) + 1, np.int64)
        time, key = np.ascontiguousarray(tape.time, np.int64), np.ascontiguousarray(tape.key, np.int64)
        start = perf_counter()
        self._play(_at(w), _at(counts), ctypes.c_int64(ticks), _at(time), _at(key), _all(rows), _all(outs), _all(when), _at(made))
        wall = perf_counter() - start
        if progress is not None and ticks:
            progress.update(ticks, int(time[-1]))
        self.saturations = {n: int(counts[k]) for n, k in source.counts.items() if counts[k]}
        for n, k in player.saturations.items():
            self.saturations[n] = self.saturations.get(n, 0) + k
        player.cells = [self._get(w, c.read, c.shape, c.dtype) for c in held]
        return Outcome(player.reals(), self._outputs(tape, outs, when, made), wall)

    def _set(self, w: np.ndarray, value: int, x: Any) -> None:
        flat = np.asarray(x).astype(np.int64).ravel()
        w[self.source.place[value] : self.source.place[value] + flat.size] = flat

    def _get(self, w: np.ndarray, value: int, shape: tuple[int, ...], dtype: str) -> np.ndarray:
        place = self.source.place[value]
        found = w[place : place + math.prod(shape)].reshape(shape)
        return found.copy() if dtype == "real" else found.astype(DTYPES[dtype])

    def _outputs(
        self, tape: Tape, outs: list[np.ndarray], when: list[np.ndarray], made: np.ndarray
    ) -> list[tuple[np.ndarray, list[np.ndarray]]]:
        found = []
        column = 0
        for p, port in enumerate(self.pipeline.outputs):
            ticks = when[p][: made[p]]
            keys = tape.key[ticks]
            leaves = []
            for n, leaf in enumerate(port.leaves):
                words = outs[column][: made[p], : math.prod(leaf.shape)].reshape(len(ticks), *leaf.shape)
                column += 1
                if leaf.dtype != "real":
                    leaves.append(words.astype(DTYPES[leaf.dtype]))
                    continue
                real = np.zeros(words.shape)
                for key, ports, fractions in zip(
                    self.source.keys, self.source.outputs, self.source.fractions, strict=True
                ):
                    here = keys == key
                    if here.any():
                        real[here] = real_numbers(words[here], fractions[ports[p][1][n]])
                leaves.append(real)
            found.append((tape.time[ticks], leaves))
        return found


def _at(x: np.ndarray) -> Any:
    return ctypes.c_void_p(x.ctypes.data)


def _all(arrays: Sequence[np.ndarray]) -> Any:
    return (ctypes.c_void_p * max(len(arrays), 1))(*[x.ctypes.data for x in arrays])
