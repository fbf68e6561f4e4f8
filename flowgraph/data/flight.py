"""A recording of one flight: its streams, its truth, and what its source says of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from flowgraph.data.experiment import Experiment
from flowgraph.data.notes import said
from flowgraph.data.series import Series
from flowgraph.errors import DataError
from flowgraph.verbs import verb


@dataclass(frozen=True)
class Flight:
    """A recording: named streams, the truth where it is known, and what else its source says.

    Args:
        name: what to call it.
        streams: a `Series` for each sensor.
        truth: a `Series` with at least `position` and `attitude`, or None.
        info: calibration and noise, by name.
        notes: what was dropped, shifted or assumed when it was read, a sentence each, which begins with a
            word of `flowgraph.data.notes`.
        experiment: the graph of which a run is this flight; None of a recording.

    Raises:
        DeclarationError: for a note that does not.
        DataError: for a stream or a truth that is no `Series`.
    """

    name: str
    streams: Mapping[str, Series]
    truth: Series | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    experiment: Experiment | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "notes", said(self.notes))
        if not isinstance(self.streams, Mapping):
            raise _no_series(f"{self.name}: streams", "each stream by its name", self.streams)
        known = [] if self.truth is None else [("truth", self.truth)]
        for name, stream in (*self.streams.items(), *known):
            if not isinstance(stream, Series):
                raise _no_series(f"{self.name}: {name}", "a Series", stream)

    def _repr_html_(self) -> str:
        return str(verb("Flight._repr_html_")(self))

    def need(self, graph: str, *names: str, fix: str = "choose another flight") -> dict[str, Series]:
        """The streams of these names, for a graph that cannot run without them.

        Args:
            graph: who asks.
            names: of the streams.
            fix: what to do where one is missing.

        Raises:
            DataError: where one is missing, or holds no event.
        """
        missing = [name for name in names if name not in self.streams]
        if missing:
            raise DataError(
                f"this flight lacks what {graph} needs",
                path=self.name,
                expected=f"streams {', '.join(names)}",
                got=", ".join(self.streams) or "no stream",
                fix=f"{fix}, or a graph that fits: flowgraph inspect names them",
            )
        for name in names:
            if not len(self.streams[name]):
                raise DataError(
                    f"this flight's stream {name!r} is empty, and {graph} needs it",
                    path=f"{self.name}: {name}",
                    expected="at least one event",
                    got="none",
                    fix="choose a longer flight, or an earlier first measurement",
                )
        return {name: self.streams[name] for name in names}


def _no_series(path: str, expected: str, got: Any) -> DataError:
    return DataError(
        "a flight is made of series",
        path=path,
        expected=expected,
        got=f"{type(got).__name__} {repr(got)[:60]}",
        fix='write Flight("name", {"imu": Series(time, values)})',
    )
