"""The outcome of many runs of one graph: each collected stream with a leading axis of runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph.data.by_name import ByName
from flowgraph.data.series import Series
from flowgraph.types import ArrayType, StructType, dtype_name
from flowgraph.verbs import verb


@dataclass(frozen=True)
class Runs(ByName[np.ndarray]):
    """One collected stream of many runs.

    Args:
        name: of the stream.
        time: (n,) int64 ns, the same in all runs.
        present: (runs, n): whether the stream was present; all true unless its clock depends on data.
        leaves: by dotted name, (runs, n, ...), in XLA and C of the `dtype` that was asked for; zero where
            absent. Also attributes and items.
    """

    name: str
    time: np.ndarray
    present: np.ndarray
    leaves: Mapping[str, np.ndarray]

    def _parts(self) -> tuple[str, Mapping[str, np.ndarray], str]:
        return "field", self.leaves, self.name

    def __repr__(self) -> str:
        runs, count = self.present.shape
        return f"<Runs {self.name}: {runs} runs of {count} ticks, {', '.join(self.leaves)}>"

    def run(self, index: int) -> Series:
        """One run's stream, as a single run gives it (of the fields that were kept)."""
        at = self.present[index]
        fields = {n: a[index][at] for n, a in self.leaves.items()}
        if list(fields) == ["value"]:
            return Series(self.time[at], fields["value"], name=self.name)
        type_ = StructType(self.name, tuple((n, leaf_type(a)) for n, a in fields.items()), dict)
        return Series(self.time[at], fields, type=type_, name=self.name)


@dataclass(frozen=True)
class Batch(ByName[Runs]):
    """The outcome of many runs: `batch.pose.position`, or `batch["pose"]["position"]`, is (runs, n, 3).

    Args:
        graph, engine: names.
        seeds: of the runs, in the order asked for.
        series: the collected streams by name.
        ticks: of one run.
        wall_s: seconds spent in the engine's loop, without set-up.
        diverged: the places of runs in which numbers are not finite any more, and which; looked at are what
            is kept, and the registers at the end.
    """

    graph: str
    engine: str
    seeds: tuple[int, ...]
    series: Mapping[str, Runs]
    ticks: int
    wall_s: float
    diverged: Mapping[int, str] = field(default_factory=dict)

    def _parts(self) -> tuple[str, Mapping[str, Runs], str]:
        return "output", self.series, self.graph

    def _repr_html_(self) -> str:
        return str(verb("Batch._repr_html_")(self))

    def __repr__(self) -> str:
        return (
            f"<Batch of {self.graph} ({self.engine}): {len(self.seeds)} runs of {self.ticks} ticks, "
            f"{', '.join(self.series)}>"
        )


def joined(name: str, parts: list[Series], leaves: list[str]) -> Runs:
    """Series of several runs on the union of their times."""
    time = parts[0].time
    same = all(np.array_equal(p.time, time) for p in parts)
    if same:
        present = np.ones((len(parts), len(time)), bool)
    else:
        time = np.unique(np.concatenate([p.time for p in parts]))
        present = np.stack([np.isin(time, p.time) for p in parts])
    made = {}
    for leaf in leaves:
        arrays = [p.leaves[leaf] for p in parts]
        shape, kind = (len(parts), len(time), *arrays[0].shape[1:]), arrays[0].dtype
        full = np.empty(shape, kind) if same else np.zeros(shape, kind)
        for row, at, array in zip(full, present, arrays, strict=True):
            row[... if same else at] = array
        made[leaf] = full
    return Runs(name, time, present, made)


def leaf_type(array: np.ndarray) -> Any:
    return ArrayType(array.shape[1:], dtype_name(array))
