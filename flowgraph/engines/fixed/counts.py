"""What went wrong in a fixed-point run, counted by value: words cut, quotients by zero, words lost.

A saturation is a word that did not fit and was cut to the largest, a division by zero a quotient that has no
value, both counted only where a selection or an output takes them. A lost word is a product, quotient, root
or power that is not zero and became zero in its format, wherever it is.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph.data.notes import note
from flowgraph.pipeline.pipeline import Pipeline

KINDS = {
    "saturations": "was cut to the largest word",
    "divisions_by_zero": "was divided by zero",
    "lost_bits": "was not zero and became zero",
}
"""The counts, by their names in a result, and what each says of a value."""

_SAID = 5
"""Values that are named in the notes of each kind, the most frequent first."""


@dataclass
class Counts:
    """Counts by value number; `cut` marks the elements that saturated."""

    saturations: dict[int, int] = field(default_factory=dict)
    divisions_by_zero: dict[int, int] = field(default_factory=dict)
    lost_bits: dict[int, int] = field(default_factory=dict)
    cut: dict[int, np.ndarray] = field(default_factory=dict)

    def add(self, kind: str, value: int, many: Any) -> None:
        """Count once for each true element of `many`, or so many times."""
        marks = np.asarray(many)
        n = int(np.count_nonzero(marks)) if marks.dtype == bool else int(many)
        if n and kind == "saturations" and marks.dtype == bool:
            self.mark(value, marks)
        if n:
            counted: dict[int, int] = getattr(self, kind)
            counted[value] = counted.get(value, 0) + n

    def total(self, kind: str) -> int:
        """Of all values."""
        return sum(getattr(self, kind).values())

    def mark(self, value: int, elements: np.ndarray) -> None:
        """Elements that saturated."""
        self.cut[value] = np.asarray(self.cut.get(value, np.False_) | elements)

    def join(self, other: Counts) -> None:
        """Add those of another run of the same pipeline."""
        for kind in KINDS:
            mine: dict[int, int] = getattr(self, kind)
            for value, n in getattr(other, kind).items():
                mine[value] = mine.get(value, 0) + n
        for value, marks in other.cut.items():
            self.mark(value, marks)

    def first(self, pipeline: Pipeline, kind: str) -> str:
        """The value that has most of a kind."""
        return next((name for k, name, _ in self._named(pipeline) if k == kind), pipeline.name)

    def stats(self, pipeline: Pipeline) -> dict[str, int]:
        """The totals, always there, then what is not zero by value: "saturations.v7 divide, module:12"."""
        found = {kind: self.total(kind) for kind in KINDS}
        return found | {f"{kind}.{name}": n for kind, name, n in self._named(pipeline)}

    def notes(self, pipeline: Pipeline) -> tuple[str, ...]:
        """A sentence for each of the values that were cut or divided by zero most often."""
        said: dict[str, int] = {}
        notes = []
        for kind, name, n in self._named(pipeline):
            said[kind] = said.get(kind, 0) + 1
            if kind != "lost_bits" and said[kind] <= _SAID:
                notes.append(note("counted", f"{kind} {n}: {name} {KINDS[kind]}"))
        return tuple(notes)

    def _named(self, pipeline: Pipeline) -> Iterator[tuple[str, str, int]]:
        names = names_of(pipeline)
        for kind in KINDS:
            for value, n in sorted(getattr(self, kind).items(), key=lambda one: (-one[1], one[0])):
                yield kind, names[value], n


def names_of(pipeline: Pipeline) -> dict[int, str]:
    """What a person calls each value: its number, its operation and line, or its input or register."""
    found = {
        leaf.value: f"v{leaf.value} input {port.name}.{leaf.name}"
        for port in pipeline.inputs
        for leaf in port.leaves
    }
    found |= {c.read: f"v{c.read} register {r.path}.{c.name}" for r in pipeline.registers for c in r.cells}
    return found | {i.out: f"v{i.out} {i.op}, {i.line}" for i in pipeline.instructions}
