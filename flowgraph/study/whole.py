"""Whole experiments: world, sensors, filter and score in one graph, of which a run gives its figures alone.

A flight that was made by a graph (`Flight.experiment`) need not be written down to be filtered. Where the
case of a filter does not hang on the seed, the filter takes the place of the recording: its built graph is
wired to the sensors of the world, its score to the filter, and seeds are all that differs between runs. What
comes back of each are the figures. They are those of the recorded way, but for rounding.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import timing_of
from flowgraph.data.registry import Case
from flowgraph.data.series import Flight, Series
from flowgraph.language.builder import Builder, building
from flowgraph.language.clock import Source
from flowgraph.language.graph import SourceNode, Wire
from flowgraph.language.inlining import inlined
from flowgraph.language.stream import Stream
from flowgraph.pipeline.digests import structure
from flowgraph.pipeline.lowering import lower
from flowgraph.study.lifting import start_of
from flowgraph.types import flatten, type_of

END = "end"
"""The source that ticks once, at the last tick of the flight."""


def whole_case(experiment: Experiment, one: tuple[Case, Flight], other: tuple[Case, Flight]) -> Case | None:
    """The experiment of a filter as one case for all seeds; None where there is none.

    Args:
        experiment: what made the flights.
        one, other: the filter's cases of two seeds, and the flights as they were made.
    """
    case, _ = one
    alike = _as_made(*one) and _as_made(*other) and _same_program(case, other[0])
    return _composed(experiment, case) if alike else None


def _as_made(case: Case, flight: Flight) -> bool:
    """Whether the filter reads the flight as it is, and is compared with its truth."""
    given = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
    return getattr(case.score, "truth", None) is flight.truth and all(
        name in flight.streams and _equal(given[name], flight.streams[name]) for name in case.graph.sources
    )


def _equal(a: Any, b: Series) -> bool:
    if a is b:
        return True
    same = isinstance(a, Series) and np.array_equal(a.time, b.time) and list(a.leaves) == list(b.leaves)
    return same and all(np.array_equal(x, b.leaves[n]) for n, x in a.leaves.items())


def _same_program(one: Case, other: Case) -> bool:
    """Whether two cases are one program, from one start, but for the rounding of their flights."""
    if structure(lower(one.graph)) != structure(lower(other.graph)):
        return False
    a, b = start_of(one.graph), start_of(other.graph)
    pairs = [(np.asarray(x), np.asarray(y)) for name in a for x, y in _leaves(a[name], b[name])]
    return all(
        np.allclose(x, y, rtol=1e-12, atol=1e-12) if x.dtype.kind == "f" else np.array_equal(x, y)
        for x, y in pairs
    )


def _leaves(a: Any, b: Any) -> Iterator[tuple[Any, Any]]:
    kind = type_of(a)
    yield from zip(flatten(a, kind), flatten(b, kind), strict=True)


def _composed(experiment: Experiment, case: Case) -> Case | None:
    in_graph = getattr(case.score, "in_graph", None)
    if in_graph is None:
        return None
    last = max(int(series.time[-1]) for series in experiment.ticks.values())
    end = Series(np.array([last]), np.ones(1, dtype=bool), name=END)
    inputs = {**experiment.ticks, END: end}
    build = Builder(case.graph.name)
    with building(build):
        sources = {name: _source(build, series) for name, series in inputs.items()}
        told: dict[str, Any] = {name: sources[name] for name in experiment.ticks}
        made = experiment.world(**told, **experiment.settings)
        streams = inlined(build, case.graph, {name: made[name] for name in case.graph.sources})
        wired = in_graph(streams, made["truth"], sources[END])
        if wired is None:
            return None
        figures, read = wired
        for name, stream in figures.items():
            build.collect(name, stream)
        graph = build.freeze(case.graph.doc, case.graph.settings)
    return Case(graph, inputs, read, case.estimate, case.notes)


def _source(build: Builder, series: Series) -> Stream[Any]:
    path = build.path(series.name, given=True)
    return build.stream(Wire(build.add(SourceNode(path, series.type, Source(path, timing_of(series)))), 0))
