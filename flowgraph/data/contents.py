"""What a recording holds: its streams, their fields and units, how often they come and where they pause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.registry import installed
from flowgraph.data.series import Series
from flowgraph.errors import FlowgraphError
from flowgraph.types import leaves_of

__all__ = ["contents", "graphs_for"]

_GAP = 4.0
"""So many median steps without a reading are a gap."""

_TRIED = 3.0
"""s of a recording on which graphs are tried."""


def contents(flight: Flight) -> list[dict[str, Any]]:
    """A row a stream, the truth last.

    Returns:
        By row: `name`; `kind`, the type of its readings; `fields`, each with `name` and `unit` (None where
        it has none); `count`; `rate_hz`, by the median step, None of a single reading; `first_ns` and
        `last_ns`; `gaps`, how many steps are longer than four usual ones, and `longest_gap_s`, the longest
        of all steps.
    """
    truth = {} if flight.truth is None else {"truth": flight.truth}
    return [_row(name, series) for name, series in (*flight.streams.items(), *truth.items())]


def _row(name: str, series: Series) -> dict[str, Any]:
    steps = np.diff(series.time)
    usual = float(np.median(steps)) if len(steps) else None
    return {
        "name": name,
        "kind": getattr(series.type, "name", str(series.type)),
        "fields": [
            {"name": field, "unit": getattr(leaf, "unit", None)} for field, leaf in leaves_of(series.type)
        ],
        "count": len(series),
        "rate_hz": 1e9 / usual if usual else None,
        "first_ns": int(series.time[0]) if len(series) else None,
        "last_ns": int(series.time[-1]) if len(series) else None,
        "gaps": int(np.sum(steps > _GAP * usual)) if usual else 0,
        "longest_gap_s": float(steps.max()) * 1e-9 if len(steps) else None,
    }


def graphs_for(flight: Flight) -> list[str]:
    """The installed graphs that are made ready for the first seconds of a flight as it is, without a
    setting."""
    short = _beginning(flight)
    graphs, _ = installed("flowgraph.graphs")
    return [name for name, graph in graphs.items() if _fits(graph, short)]


def _fits(graph: Any, flight: Flight) -> bool:
    try:
        graph.case(flight)
    except FlowgraphError:
        return False
    return True


def _beginning(flight: Flight) -> Flight:
    """What comes before the last of the streams has come for a while."""
    starts = [int(s.time[0]) for s in flight.streams.values() if len(s)]
    end = max(starts, default=0) + round(_TRIED * 1e9)
    cut: Iterator[tuple[str, Series]] = ((n, s[s.time <= end]) for n, s in flight.streams.items())
    truth = flight.truth
    return replace(
        flight, streams=dict(cut), truth=None if truth is None else truth[truth.time <= end + 10**9]
    )
