"""Where the words of a tick lie: each value in a place of its own, or in one that is used again.

Whoever asks what was cut, and whether anything takes it, wants every value of a tick at its end. A program on
a small machine wants memory. There a value keeps its place until it was last read, what is only a part of
another value lies in it, words of up to 32 bits take four bytes, and constants lie with the code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from flowgraph.engines.fixed.absent import may_be_nan
from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.pipeline.formats import WIDEST
from flowgraph.pipeline.optimise.memory import plan
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.ops import Spec

Place = tuple[str, int]
"""An array by its name, and the first element in it."""

WORDS, SMALL, KNOWN, KNOWN_SMALL = "w", "v", "d", "c"
"""Arrays: words of 64 bits, words of at most 32, and the same of constants."""


class Places(Protocol):
    """Says where a value lies."""

    def begin(self, key: int, bound: Bound) -> None:
        """What comes is the tick of another pattern of present inputs."""

    def at(self, value: int, shape: Sequence[int]) -> Place:
        """Of a value; of the new words of a register, whose number is then -1 - value."""

    def lies(self, part: int, whole: int, begin: int | None = None) -> bool:
        """Whether a value lies in another's memory (from this element on), so that nothing is copied."""


class OwnPlaces:
    """Every value in a place of its own, in one array.

    Attributes:
        place: by value.
        size: of the array.
    """

    def __init__(self) -> None:
        self.place: dict[int, int] = {}
        self.size = 0

    def begin(self, key: int, bound: Bound) -> None: ...

    def at(self, value: int, shape: Sequence[int]) -> Place:
        if value not in self.place:
            self.place[value] = self.size
            self.size += max(math.prod(shape), 1)
        return WORDS, self.place[value]

    def lies(self, part: int, whole: int, begin: int | None = None) -> bool:
        return False


class SharedPlaces:
    """Places that are used again once their value was last read.

    Args:
        player: the interpreter, which knows the formats.
        keys: the patterns of present inputs that come.

    Attributes:
        sizes: of the arrays `v` and `w`.
        held: of those, what registers, inputs, the time and the seed take, which lie first.
        known: the words of `c` and `d`.
        copies: the constants that an output of this tick is, and where a caller finds them.
    """

    def __init__(self, player: Integers, keys: Sequence[int]) -> None:
        self._player = player
        self._specs: Mapping[int, Spec] = player.pipeline.specs
        pipeline = player.pipeline
        self.held = {SMALL: 0, WORDS: 0}
        self.known: dict[str, list[int]] = {KNOWN: [], KNOWN_SMALL: []}
        self._held: dict[int, Place] = {}
        self._constants: dict[tuple[str, bytes], int] = {}
        long = long_held(player, keys)
        for n, spec in held_values(pipeline):
            kept = n if n >= 0 else -1 - n
            self._held[n] = self._next(self.held, array_of(spec.dtype, kept in long), spec.shape)
        self.sizes = dict(self.held)
        self._at: dict[int, Place] = {}
        self.copies: dict[int, Place] = {}
        self._view: Mapping[int, tuple[int, int]] = {}

    def _next(self, sizes: dict[str, int], array: str, shape: Sequence[int]) -> Place:
        place = array, sizes[array]
        sizes[array] += max(math.prod(shape), 1)
        return place

    def begin(self, key: int, bound: Bound) -> None:
        program = bound.program
        found = plan(program, ("reuse",), scalars=True)
        self._view = found.view
        roots = {root_of(found.view, n)[0] for n in long_words(self._player, bound)}
        wide = {found.place[n] for n in roots if n in found.place}
        sizes = dict(self.held)
        buffers = [
            self._next(sizes, array_of(b.dtype, k in wide), (b.size,)) for k, b in enumerate(found.buffers)
        ]
        self._at = dict(self._held)
        for n, array in bound.known.items():
            if n not in self._held:
                self._at[n] = self._constant(np.asarray(array), program.specs[n].dtype)
        for i in program.instructions:
            root, begin = root_of(found.view, i.out)
            array, base = buffers[found.place[root]] if root in found.place else self._at[root]
            self._at[i.out] = array, base + begin
        self.copies = {}
        for n in {n for flag, leaves in program.outputs if flag is not None for n in leaves}:
            if n in bound.known and n not in self._held:
                spec = program.specs[n]
                self.copies[n] = self._next(sizes, array_of(spec.dtype, False), spec.shape)
        self.sizes = {array: max(n, self.sizes[array]) for array, n in sizes.items()}

    def _constant(self, words: np.ndarray, dtype: str) -> Place:
        array = KNOWN_SMALL if dtype in ("real", "bool") else KNOWN
        flat = words.astype(np.int64).ravel()
        key = array, flat.tobytes()
        if key not in self._constants:
            self._constants[key] = len(self.known[array])
            self.known[array] += flat.tolist() or [0]
        return array, self._constants[key]

    def at(self, value: int, shape: Sequence[int]) -> Place:
        return self._at[value] if value in self._at else self._held[value]

    def lies(self, part: int, whole: int, begin: int | None = None) -> bool:
        found = self._view.get(part)
        return found is not None and found[0] == whole and begin in (None, found[1])


def held_values(pipeline: Pipeline) -> list[tuple[int, Spec]]:
    """What is there before a tick or after it: registers, inputs, time, seed, new words of registers."""
    cells = [c for r in pipeline.registers for c in r.cells]
    leaves = [leaf for port in pipeline.inputs for leaf in port.leaves]
    return [
        *((c.read, Spec(c.shape, c.dtype)) for c in cells),
        *((x.value, Spec(x.shape, x.dtype)) for x in leaves),
        (pipeline.time, Spec((), "int64")),
        (pipeline.seed, Spec((2,), "uint32")),
        *((-1 - c.read, Spec(c.shape, c.dtype)) for c in cells),
    ]


def long_held(player: Integers, keys: Sequence[int]) -> set[int]:
    """The inputs and registers that take 64 bits: they may hold a reading that is not there, or are wide."""
    wide = {n for n, bits in player.formats.wider.items() if bits > WIDEST}
    cells = [c for r in player.pipeline.registers for c in r.cells]
    absent = set(player.formats.absent)
    for program in (player.bind(key).program for key in keys):
        doubtful = may_be_nan(program.instructions, absent)
        absent |= {c.read for c, n in zip(cells, program.writes, strict=True) if n in doubtful}
    return absent | wide


def long_words(player: Integers, bound: Bound) -> set[int]:
    """The values of a tick that take 64 bits, for one or the other."""
    doubtful = may_be_nan(bound.program.instructions, player.formats.absent)
    return doubtful | {n for n, bits in bound.widths.items() if bits > WIDEST}


def array_of(dtype: str, wide: bool) -> str:
    """The array of words of a kind."""
    return SMALL if dtype in ("real", "bool") and not wide else WORDS


def root_of(view: Mapping[int, tuple[int, int]], value: int) -> tuple[int, int]:
    """The value in whose memory another lies, and where in it."""
    begin = 0
    while value in view:
        value, more = view[value]
        begin += more
    return value, begin
