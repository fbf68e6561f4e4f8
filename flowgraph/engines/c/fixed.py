"""The fixed-point C of a pipeline, compiled and called in this process."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Mapping, Sequence
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.c.compile import load
from flowgraph.engines.contract import Outcome, Player
from flowgraph.engines.fixed.counts import Counts
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.fixed.source import Source
from flowgraph.engines.options import Meter
from flowgraph.pipeline.formats import real_numbers
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import needed_of
from flowgraph.recorder.ops import Spec
from flowgraph.types import DTYPES

FLAGS = ("-std=c99", "-O1")
_STRETCH = 4096
"""Ticks in one call, after which the meter is told."""


class CompiledIntegers(Player):
    """Plays a pipeline in its formats, in C.

    The C stops at a tick in which a word was marked, for here it is known what takes the word, and goes on.

    Args:
        pipeline: with formats.
        patterns: of present inputs that come.
        tabled: whether it is compiled once for all formats of a structure, and slower then.

    Attributes:
        counts: of the last run.
    """

    def __init__(self, pipeline: Pipeline, patterns: Sequence[int], *, tabled: bool = False) -> None:
        self.pipeline = pipeline
        self.source = Source(pipeline, patterns, tabled=tabled)
        self.counts = Counts()
        by_place = sorted((p, n) for n, p in self.source.place.items())
        self._places, self._values = np.array([p for p, _ in by_place]), [n for _, n in by_place]
        self._library = load({"fixed.c": f"{self.source.text}\n{self.source.play}"}, FLAGS)
        self._play = self._library.fx_play
        self._play.restype = ctypes.c_int64

    def play(self, tape: Tape, cells: list[Any], seed: np.ndarray, progress: Meter | None) -> Outcome:
        source, pipeline = self.source, self.pipeline
        if source.tabled:
            for name, row in (("fx_s", source.shifts), ("fx_m", source.mosts)):
                ctypes.c_void_p.in_dll(self._library, name).value = row.ctypes.data
        player = Integers(pipeline, cells, seed)
        held = [c for r in pipeline.registers for c in r.cells]
        w, off = source.first.copy(), np.zeros(source.size + 1, np.uint8)
        lost = np.zeros(len(source.lost) + 1, np.int64)
        for c, v in zip(held, player.cells, strict=True):
            self._set(w, c.read, v)
        self._set(w, pipeline.seed, seed)
        rows = [
            np.ascontiguousarray(
                player.words(leaf.value, x, leaf.shape) if leaf.dtype == "real" else x, np.int64
            )
            if len(x)
            else np.zeros(0, np.int64)
            for port, series in zip(pipeline.inputs, tape.series, strict=True)
            for leaf, x in zip(port.leaves, series.leaves.values(), strict=True)
        ]
        ticks = len(tape.time)
        outs = [
            np.zeros((ticks, max(math.prod(leaf.shape), 1)), np.int64)
            for port in pipeline.outputs
            for leaf in port.leaves
        ]
        when = [np.zeros(ticks, np.int64) for _ in pipeline.outputs]
        used = np.zeros(len(pipeline.inputs) + 1, np.int64)
        made = np.zeros(len(pipeline.outputs) + 1, np.int64)
        time = np.ascontiguousarray(tape.time, np.int64)
        key = np.ascontiguousarray(tape.key, np.int64)
        start = perf_counter()
        done, after = 0, 0
        while done < ticks:
            last = min(ticks, done + _STRETCH)
            numbers = (ctypes.c_int64(done), ctypes.c_int64(last), ctypes.c_int(after))
            arrays = (_at(time), _at(key), _all(rows), _all(outs), _all(when), _at(used), _at(made))
            done = self._play(_at(w), _at(off), _at(lost), *numbers, *arrays)
            after = int(off[-1])
            if after and done < last:
                self._look(int(key[done]), w, off, player.counts)
            elif after:
                after = 0
            if progress is not None and not after:
                progress.update(done, int(time[done - 1]))
        self._ended(off, player.counts)
        wall = perf_counter() - start
        for n, k in source.lost.items():
            player.counts.add("lost_bits", n, lost[k])
        self.counts = player.counts
        player.cells = [self._get(w, c.read, c.shape, c.dtype) for c in held]
        stats, notes = self.counts.stats(pipeline), self.counts.notes(pipeline)
        return Outcome(player.reals(), self._outputs(tape, outs, when, made), wall, stats, notes)

    def _look(self, key: int, w: np.ndarray, off: np.ndarray, counts: Counts) -> None:
        """Count the marked words that something takes, and clear the marks."""
        program = self.source.bound[self.source.keys.index(key)].program
        self._ended(off, counts)
        marked = {
            self._values[k] for k in np.searchsorted(self._places, np.flatnonzero(off[:-1]), "right") - 1
        }
        words = _Words(w, self.source.place, self.pipeline.specs)
        taken = needed_of(program, words, marked) if marked else {}
        for n in marked:
            p, shape = self.source.place[n], self.pipeline.specs[n].shape
            marks = off[p : p + math.prod(shape)].reshape(shape)
            mask = taken.get(n, False)
            counts.add("saturations", n, (marks & 1 > 0) & mask)
            counts.add("divisions_by_zero", n, (marks & 2 > 0) & mask)
        off[:] = 0

    def _ended(self, off: np.ndarray, counts: Counts) -> None:
        """Count the marked words of registers, which are all taken, and clear the marks."""
        for register in self.pipeline.registers:
            for c in register.cells:
                place = self.source.place.get(-1 - c.read)
                if place is not None:
                    marks = off[place : place + math.prod(c.shape)]
                    counts.add("saturations", c.read, (marks > 0).reshape(c.shape))
                    marks[:] = 0

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
                real = leaf.dtype == "real"
                leaves.append(self._reals(words, keys, p, n) if real else words.astype(DTYPES[leaf.dtype]))
            found.append((tape.time[ticks], leaves))
        return found

    def _reals(self, words: np.ndarray, keys: np.ndarray, port: int, leaf: int) -> np.ndarray:
        """A leaf's words as reals: their format depends on the pattern of present inputs."""
        real = np.zeros(words.shape)
        for key, bound in zip(self.source.keys, self.source.bound, strict=True):
            here = keys == key
            if here.any():
                value = bound.program.outputs[port][1][leaf]
                real[here] = real_numbers(words[here], bound.fractions[value])
        return real


class _Words(dict[int, np.ndarray]):
    """The words of each value, looked up when they are asked for."""

    def __init__(self, w: np.ndarray, place: Mapping[int, int], specs: Mapping[int, Spec]) -> None:
        super().__init__()
        self._w, self._place, self._specs = w, place, specs

    def __missing__(self, n: int) -> np.ndarray:
        p, shape = self._place[n], self._specs[n].shape
        self[n] = found = self._w[p : p + math.prod(shape)].reshape(shape)
        return found

    def get(self, n: int, other: Any = None) -> Any:
        return self[n] if n in self._place else other


def _at(x: np.ndarray) -> Any:
    return ctypes.c_void_p(x.ctypes.data)


def _all(arrays: Sequence[np.ndarray]) -> Any:
    return (ctypes.c_void_p * max(len(arrays), 1))(*[x.ctypes.data for x in arrays])
