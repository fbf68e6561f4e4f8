"""What a run gives back: the collected streams as arrays with times, the last state, and counts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowgraph.data.by_name import ByName
from flowgraph.data.export.mcap_file import write_mcap
from flowgraph.data.export.rerun_file import write_rerun
from flowgraph.data.export.tables import write_parquet
from flowgraph.data.export.text import write_table
from flowgraph.data.export.trees import to_xarray
from flowgraph.data.flight import Flight
from flowgraph.data.series import Series
from flowgraph.errors import DeclarationError
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
class Result(ByName[Series]):
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

    def _parts(self) -> tuple[str, Mapping[str, Series], str]:
        return "output", self.series, self.graph

    def plot(self, file: str | Path | None = None, *, outputs: list[str] | None = None) -> Any:
        """A matplotlib figure with a panel a field; written to `file` if given."""
        return verb("Result.plot")(self, file, outputs=outputs)

    def to_xarray(self) -> Any:
        """An `xarray.DataTree` with a dataset a stream; see `flowgraph.data.export`. Needs xarray."""
        return to_xarray(self)

    def to_pandas(self) -> dict[str, Any]:
        """A pandas `DataFrame` a stream, by name, each with a `time` of its own (int64 ns). Needs pandas."""
        return {name: series.to_pandas() for name, series in self.series.items()}

    def to_csv(self, file: str | Path, *, also: Mapping[str, Series] | None = None) -> None:
        """One csv table of all streams, which `table:FILE` reads; see `flowgraph.write_table`."""
        write_table(Flight(self.graph, self._with(also)), file)

    def to_parquet(self, folder: str | Path, *, also: Mapping[str, Series] | None = None) -> dict[str, Path]:
        """A Parquet file a stream, a row a time; see `flowgraph.data.export.tables`. Needs pyarrow.

        Args:
            folder: for NAME.parquet.
            also: series beside the outputs, by a name that no output has.

        Returns:
            The files by stream.
        """
        return write_parquet(self._with(also), folder, about=self.about)

    def to_mcap(self, file: str | Path, *, also: Mapping[str, Series] | None = None) -> tuple[str, ...]:
        """An MCAP file, which Foxglove opens; see `flowgraph.data.export.mcap_file`. Needs mcap.

        Args:
            file: to be written.
            also: series beside the outputs, such as `{"truth": flight.truth}`.

        Returns:
            Notes on what could not be placed.
        """
        return write_mcap(self._with(also), file, about=self.about)

    def to_rerun(self, file: str | Path, *, also: Mapping[str, Series] | None = None) -> tuple[str, ...]:
        """A recording of Rerun; see `flowgraph.data.export.rerun_file`. Needs rerun-sdk. As `to_mcap`."""
        return write_rerun(self._with(also), file, name=self.graph, about=self.about)

    @property
    def about(self) -> dict[str, object]:
        """What is said of a run in the files that it goes out in: graph, engine, ticks, counts and notes."""
        notes = {f"note {k}": words for k, words in enumerate(self.notes, 1)}
        return {"graph": self.graph, "engine": self.engine, "ticks": self.ticks, **self.stats, **notes}

    def _with(self, also: Mapping[str, Series] | None) -> dict[str, Series]:
        """The streams, and others beside them.

        Raises:
            DeclarationError: where two are called the same.
        """
        both = sorted({*self.series} & {*(also or {})})
        if both:
            raise DeclarationError(
                "two series are called the same",
                path=f"{self.graph}: {both[0]}",
                expected="a name that no output has",
                got=f"an output {both[0]!r} already",
                fix="give what is written beside the outputs another name",
            )
        return {**self.series, **(also or {})}

    def _repr_html_(self) -> str:
        return str(verb("Result._repr_html_")(self))

    def __repr__(self) -> str:
        return f"<Result of {self.graph} ({self.engine}): {self.ticks} ticks, {', '.join(self.series)}>"
