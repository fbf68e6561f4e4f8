"""What a run gives back: the collected streams as arrays with times, the last state, and counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowgraph.data.export import to_xarray
from flowgraph.data.series import Series
from flowgraph.errors import UnknownNameError
from flowgraph.language.graph import Graph
from flowgraph.verbs import verb

COUNTED = ("expired", "late_")
"""How the parts of a block's state begin that are counts for `run.stats`."""


def statistics(graph: Graph, state: Mapping[str, Any]) -> dict[str, int]:
    """Counters of what joins discarded by definition, and of late events: `{"match.expired_a": 3}`."""
    counts = {}
    for _, call in graph.calls:
        if call.state is not None:
            path = graph.nodes[call.state].path
            part = state["registers"][path]
            if isinstance(part, Mapping):
                counts.update({f"{call.path}.{n}": int(v) for n, v in part.items() if n.startswith(COUNTED)})
    return counts


@dataclass(frozen=True)
class Result:
    """The outcome of a run.

    Args:
        graph, engine: names.
        series: the collected streams by name; also attributes (`result.belief.position`).
        state: the state after the last tick, as `run.state`.
        stats: what joins discarded by definition.
        ticks: how many were run.
        wall_s: seconds spent in the engine's loop, without set-up.
        notes: what the run has to say, a sentence each; see `flowgraph.data.notes`.
    """

    graph: str
    engine: str
    series: Mapping[str, Series]
    state: Mapping[str, Any]
    stats: Mapping[str, int]
    ticks: int
    wall_s: float
    notes: tuple[str, ...] = ()

    def __getitem__(self, name: str) -> Series:
        if name not in self.series:
            raise UnknownNameError("output", name, self.series, path=self.graph)
        return self.series[name]

    def __getattr__(self, name: str) -> Series:
        if name.startswith("_") or "series" not in self.__dict__:
            raise AttributeError(name)
        try:
            return self[name]
        except UnknownNameError as error:
            raise AttributeError(str(error)) from None

    def plot(self, file: str | Path | None = None, *, outputs: list[str] | None = None) -> Any:
        """A matplotlib figure with a panel a field; written to `file` if given."""
        return verb("Result.plot")(self, file, outputs=outputs)

    def to_xarray(self) -> Any:
        """An `xarray.DataTree` with a dataset a stream; see `flowgraph.data.export`. Needs xarray."""
        return to_xarray(self)

    def to_pandas(self) -> dict[str, Any]:
        """A pandas `DataFrame` a stream, by name, each with a `time` of its own (int64 ns). Needs pandas."""
        return {name: series.to_pandas() for name, series in self.series.items()}

    def __repr__(self) -> str:
        return f"<Result of {self.graph} ({self.engine}): {self.ticks} ticks, {', '.join(self.series)}>"
