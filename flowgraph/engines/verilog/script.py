"""What the bench is told: words to put into their places, ticks, and words to read or to compare.

A line is `put PLACE WORD`, `go KEY`, `get PLACE` or `is PLACE WORD`, as `machine/bench.cpp` reads them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.verilog.image import Image
from flowgraph.engines.verilog.nodes import NONE_WORD
from flowgraph.pipeline.formats import NOT_A_NUMBER


class Script:
    """The script of a recording.

    Args:
        image: the machine.
        tape: ticks, and the events of each input.
        cells: register cells before the first.
        seed: (2,) uint32.
        check: whether the interpreter plays beside; then all registers are read after each tick, otherwise
            after the last alone.

    Attributes:
        lines: with `get` for each word that is read: of the outputs of each tick first.
        wanted: for each of these, the interpreter's word, or None where it has none.
        player: the interpreter, with the registers after the last tick if it played.
    """

    def __init__(self, image: Image, tape: Tape, cells: list[Any], seed: np.ndarray, check: bool) -> None:
        self.image, self.check = image, check
        self.player = Integers(image.pipeline, cells, seed)
        self.lines: list[str] = []
        self.wanted: list[int | None] = []
        self._held = [c for r in image.pipeline.registers for c in r.cells]
        for c, v in zip(self._held, self.player.cells, strict=True):
            self._write(c.read, v)
        self._write(image.pipeline.seed, seed)
        rows = [zip(*s.leaves.values(), strict=True) for s in tape.series]
        for time, key in zip(tape.time.tolist(), tape.key.tolist(), strict=True):
            self._tick(time, key, [next(row) for k, row in enumerate(rows) if key >> k & 1])
        if not check:
            for c in self._held:
                self._read(image.places[c.read])

    def checked(self) -> list[str]:
        """The lines, comparing where there is something to compare with."""
        wanted = iter(self.wanted)
        found = []
        for line in self.lines:
            word = next(wanted) if line.startswith("get") else None
            found.append(line if word is None else f"is{line[3:]} {word}")
        return found

    def _tick(self, time: int, key: int, values: list[tuple[Any, ...]]) -> None:
        image, player, pipeline = self.image, self.player, self.image.pipeline
        self._write(pipeline.time, np.int64(time))
        present = iter(values)
        for k, port in enumerate(pipeline.inputs):
            if key >> k & 1:
                for leaf, x in zip(port.leaves, next(present), strict=True):
                    self._write(
                        leaf.value, player.words(leaf.value, x, leaf.shape) if leaf.dtype == "real" else x
                    )
        self.lines.append(f"go {key}")
        env: dict[int, Any] = {}
        if self.check:
            _, env = player.values(time, key, values)
            player.tick(time, key, values)
        entry = next(e for e in image.entries if e.key == key)
        for found, (flag, leaves) in zip(entry.outputs, player.bind(key).program.outputs, strict=True):
            if found is None or flag is None:
                continue
            self._read(np.array([found[0]]), np.array([env.get(flag, 1)]) if self.check else None)
            there = self.check and bool(env.get(flag, True))
            for places, n in zip(found[1], leaves, strict=True):
                self._read(places, env[n] if there else None)
        if self.check:
            for c, v in zip(self._held, player.cells, strict=True):
                self._read(image.places[c.read], v)

    def _write(self, value: int, x: Any) -> None:
        for place, word in self.image.words_of(value, np.asarray(x)):
            self.lines.append(f"put {place} {word - (1 << 36) if word >> 35 else word}")

    def _read(self, places: np.ndarray, expected: Any = None) -> None:
        flat = places.ravel().tolist()
        self.lines.extend(f"get {p}" for p in flat)
        self.wanted.extend([None] * len(flat) if expected is None else _parts(expected, places))


def _parts(expected: Any, places: np.ndarray) -> list[int]:
    """The words that an array of the interpreter has in the memory."""
    row = np.ravel(expected).tolist()
    count = places.size // max(len(row), 1)
    found: list[int] = []
    for x in map(int, row):
        if count == 1:
            found.append(NONE_WORD if x == NOT_A_NUMBER else x)
        else:
            found += [x & 0xFFFFFFFF, x >> 32]
    return found
