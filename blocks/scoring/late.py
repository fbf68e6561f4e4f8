"""What becomes of late measurements of a flight: they are taken for fresh, which is said, or rewound.

A stream of a flight may say when its values were true (`Series.stamp`). Where that was before they came, the
case of any graph has a note of it; with the setting `rewind` the graph is built over a history instead, of as
many places as the stamps ask for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import DeclarationError, Graph, Series, Stream, clocks_of, merge
from flowgraph.blocks.filtering.rewind import rewind
from flowgraph.blocks.scoring.settings import Positive, Settings
from flowgraph.data.notes import note
from flowgraph.language.declare import GraphFunction

__all__ = ["Late", "built_for", "late_streams", "places", "rewound_graph"]


@dataclass(frozen=True)
class Late(Settings):
    """What becomes of what comes late.

    Args:
        rewind: s; what comes up to so late is applied at its own time, over a history of what was (`rewind`).
            Left out, it is taken for fresh.
    """

    rewind: Positive | None = None


def late_streams(inputs: Mapping[str, Series]) -> list[str]:
    """The names of streams that say when they were true, and were so before they came."""
    return [n for n, s in inputs.items() if s.is_late and (s.stamp < s.time).any()]


def places(inputs: Mapping[str, Series], lag: int) -> int:
    """How many places a history of `lag` ns needs: one for each different time in it, and some more."""
    times = np.unique(np.concatenate([s.stamp for s in inputs.values()]))
    ends = np.searchsorted(times, times + lag, side="right")
    return int((ends - np.arange(len(times))).max(initial=0)) + 4


def built_for(
    graph: GraphFunction,
    inputs: Mapping[str, Series],
    seconds: float | None,
    sizes: Mapping[str, int] | None,
    settings: Mapping[str, Any],
    *,
    smoothed: bool,
) -> tuple[Graph, list[str]]:
    """The graph for these streams, rewound by up to `seconds` where some are late; and notes on that.

    Raises:
        DeclarationError: for a run that is to be smoothed as well.
    """
    late = ", ".join(late_streams(inputs))
    if not late:
        return graph.build(**clocks_of(inputs), sizes=sizes, **settings), []
    latest = max(int((s.time - s.stamp).max(initial=0)) for s in inputs.values())
    most = math.ceil(latest / 1e6) / 1e3  # rounded up: a history of as many s holds all of it
    if seconds is None:
        said = f"late by up to {most:g} s and taken for fresh; rewind={most:g} applies it at its own time"
        built = graph.build(**clocks_of(inputs), sizes=sizes, **settings)
        return built, [note("warning", f"{late}: {said}")]
    if smoothed:
        raise DeclarationError(
            "a run that is rewound is not smoothed",
            path=f"{graph.name}.rewind",
            expected="one of them: rewind applies late measurements, a smoother looks back at the end",
            got=f"rewind={seconds:g}, with smooth or lag",
            fix="leave rewind out: for a smoother no measurement is late",
        )
    said = f"late by up to {most:g} s, and applied at its own time where that is {seconds:g} s ago or less"
    return rewound_graph(graph, inputs, seconds, sizes, settings), [note("info", f"{late}: {said}")]


def rewound_graph(
    graph: GraphFunction,
    inputs: Mapping[str, Series],
    seconds: float,
    sizes: Mapping[str, int] | None,
    settings: Mapping[str, Any],
) -> Graph:
    """A graph over a flight's streams, of which some are late, rewound by up to `seconds`.

    Its outputs are those of now. What a late measurement told when it was applied (innovations, likelihoods,
    NIS) is at the tick at which it came.
    """
    late = late_streams(inputs)
    lag = round(seconds * 1e9)

    def over(**streams: Stream[Any]) -> dict[str, Stream[Any]]:
        given = {n: s for n, s in streams.items() if s is not None}
        found = rewind(graph, given, late=late, max_lag=lag, size=places(inputs, lag), **settings)
        return {
            n: merge(s, found.then[n], tie="right") if n.endswith(("innovation", "log_likelihood")) else s
            for n, s in found.now.items()
        }

    over.__name__ = graph.name
    over.__doc__ = graph.__doc__
    made = GraphFunction(over)
    made.__dict__["parameters"] = (graph.parameters[0], {})  # its settings are told already
    return made.build(sizes=sizes, **clocks_of(inputs))
