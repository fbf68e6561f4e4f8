"""Where the words of a tick lie in hardware: each value in an array of its own, named by the value.

A compiler of high-level synthesis makes registers of a small array and a memory of a large one, and sees by
itself how long a value lives. Of places that are used again, as a small machine has them, it would make one
memory with two ports. What is only a part of another value lies in that one's array here too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from flowgraph.engines.c.syntax import identifier
from flowgraph.engines.fixed.engine import Bound, Integers
from flowgraph.engines.fixed.places import (
    KNOWN,
    KNOWN_SMALL,
    SMALL,
    Place,
    array_of,
    held_values,
    long_held,
    long_words,
    root_of,
)
from flowgraph.pipeline.optimise.memory import plan
from flowgraph.recorder.ops import Spec


@dataclass(frozen=True)
class Array:
    """An array of the text: `kind name[size]`."""

    name: str
    kind: str
    size: int


class ValueArrays:
    """An array for each value that is no part of another.

    Args:
        player: the interpreter, which knows the formats.
        keys: the patterns of present inputs that come.

    Attributes:
        held: of registers, inputs, time and seed, and, under -1 - value, of the new words of a register.
        made: of what the present tick makes, by value.
        known: of constants: each with its words.
    """

    def __init__(self, player: Integers, keys: Sequence[int]) -> None:
        self._player = player
        pipeline = player.pipeline
        names = {pipeline.time: "time", pipeline.seed: "seed"}
        names |= {c.read: f"{r.path}.{c.name}" for r in pipeline.registers for c in r.cells}
        names |= {x.value: f"{port.name}.{x.name}" for port in pipeline.inputs for x in port.leaves}
        long = long_held(player, keys)
        self.held: dict[int, Array] = {}
        for n, spec in held_values(pipeline):
            kept = n if n >= 0 else -1 - n
            array = array_of(spec.dtype, kept in long)
            name = f"{array}{kept}_{identifier(names[kept])}{'_next' if n < 0 else ''}"
            self.held[n] = self._array(name, spec, array, player.formats.width_of(kept))
        self.made: dict[int, Array] = {}
        self._begun: set[int] = set()
        self.known: dict[str, tuple[Array, list[int]]] = {}
        self._same: dict[tuple[str, bytes], Array] = {}
        self._at: dict[int, Place] = {}
        self._view: Mapping[int, tuple[int, int]] = {}

    def _array(self, name: str, spec: Spec, array: str, width: int) -> Array:
        return Array(name, kind_of(array, spec.dtype, width), max(int(np.prod(spec.shape)), 1))

    def begin(self, key: int, bound: Bound) -> None:
        program = bound.program
        self._view = plan(program, ("reuse",), scalars=True).view
        wide = {root_of(self._view, n)[0] for n in long_words(self._player, bound)}
        widths: dict[int, int] = {}
        for n, width in bound.widths.items():
            root, _ = root_of(self._view, n)
            widths[root] = max(widths.get(root, 0), width)
        self._at = {n: (a.name, 0) for n, a in self.held.items()}
        for n, words in bound.known.items():
            if n not in self.held:
                known = self._constant(n, np.asarray(words), program.specs[n].dtype, widths.get(n, 0))
                self._at[n] = known.name, 0
        self.made, self._begun = {}, set()
        for i in program.instructions:
            root, begin = root_of(self._view, i.out)
            if root in self._at and root not in self.made:
                self._at[i.out] = self._at[root][0], begin
                continue
            if root not in self.made:
                spec = program.specs[root]
                array = array_of(spec.dtype, root in wide)
                self.made[root] = self._array(f"{array}{root}", spec, array, widths.get(root, 0))
            self._at[i.out] = self.made[root].name, begin

    def _constant(self, value: int, words: np.ndarray, dtype: str, width: int) -> Array:
        array = KNOWN_SMALL if dtype in ("real", "bool") else KNOWN
        flat = words.astype(np.int64).ravel()
        kind = kind_of(array, dtype, width)
        key = kind, flat.tobytes()
        if key not in self._same:
            made = Array(f"{array}{value}", kind, max(flat.size, 1))
            self._same[key] = made
            self.known[made.name] = made, flat.tolist() or [0]
        return self._same[key]

    def at(self, value: int, shape: Sequence[int]) -> Place:
        return self._at[value]

    def begun(self, value: int) -> list[Array]:
        """The array that is to be declared for a value: none where an earlier one lies in it already."""
        root, _ = root_of(self._view, value)
        if root in self._begun or root not in self.made:
            return []
        self._begun.add(root)
        return [self.made[root]]

    def lies(self, part: int, whole: int, begin: int | None = None) -> bool:
        found = self._view.get(part)
        return found is not None and found[0] == whole and begin in (None, found[1])


def kind_of(array: str, dtype: str, width: int) -> str:
    """The type of an element: as many bits as a word has, and 64 where it is long."""
    if array in (SMALL, KNOWN_SMALL):
        return "ap_uint<1>" if dtype == "bool" else f"ap_int<{width}>"
    return "int64_t"
