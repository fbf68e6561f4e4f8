"""Whole experiments: world, sensors, filter and score in one graph, of which a run gives its figures alone.

A flight that was made by a graph (`Flight.experiment`) need not be written down to be filtered. Where the
case of a filter does not hang on the seed, the filter takes the place of the recording: its built graph is
wired to the sensors of the world, its score to the filter, and seeds are all that differs between runs. What
comes back of each are the figures. They are those of the recorded way, but for rounding.

A start that follows from the flight is made in the graph as well, by blocks at the first tick (`Case.begin`):
a graph of world and start alone is run for two seeds, and must give what their cases start from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import numpy as np

from flowgraph.data.experiment import Experiment
from flowgraph.data.flight import Flight
from flowgraph.data.inputs import timing_of
from flowgraph.data.registry import Case
from flowgraph.data.series import Series
from flowgraph.engines.options import RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.language.block import Block
from flowgraph.language.builder import Builder, building
from flowgraph.language.clock import Source
from flowgraph.language.graph import SourceNode, Wire
from flowgraph.language.inlining import inlined
from flowgraph.language.joins import latest
from flowgraph.language.stream import Stream
from flowgraph.pipeline.digests import structure
from flowgraph.pipeline.lowering import lower
from flowgraph.study.lifting import start_of
from flowgraph.types import StructType, Type, flatten, leaves_of, type_of, unflatten

BEGIN, END = "begin", "end"
"""The sources that tick once: at the first tick of the flight, and at the last."""


def whole_case(experiment: Experiment, one: tuple[Case, Flight], other: tuple[Case, Flight]) -> Case | None:
    """The experiment of a filter as one case for all seeds; None where there is none.

    Args:
        experiment: what made the flights. What it is given for a seed is in the case that of seed 0.
        one, other: the filter's cases of two seeds, and the flights as they were made.
    """
    case, _ = one
    parts = _parts(*one)
    programs = [structure(lower(each.graph)) for each in (case, other[0])]
    if parts is None or parts != _parts(*other) or programs[0] != programs[1]:
        return None
    starts = [start_of(each.graph) for each in (case, other[0])]
    moving = {n for n, value in starts[0].items() if not _alike(value, starts[1][n], 1e-12)}
    if moving:
        made = _begun(experiment, case)
        if made is None or not moving <= made[0].keys():
            return None
        if not all(_alike(made[k][n], start[n], 1e-9) for k, start in enumerate(starts) for n in made[k]):
            return None
    same = {n for n in parts if np.array_equal(_given(case)[n].time, _given(other[0])[n].time)}
    return _composed(experiment, case, parts, same, begin=bool(moving))


def _parts(case: Case, flight: Flight) -> dict[str, str] | None:
    """Of which stream of the flight each source of the filter is, or is some fields; None where one is of
    none, or where the score is not against the flight's truth."""
    given = _given(case)
    if getattr(case.score, "truth", None) is not flight.truth:
        return None
    found = {}
    for source in case.graph.sources:
        own = flight.streams.get(source)
        names = list(flight.streams)
        if own is not None:
            names = [source] if list(given[source].leaves) == list(own.leaves) else []
        name = next((n for n in names if _within(given[source], flight.streams[n])), None)
        if name is None:
            return None
        found[source] = name
    return found


def _given(case: Case) -> Any:
    return case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs


def _within(a: Any, b: Series) -> bool:
    """Whether a series has the times of another, and of its fields."""
    if a is b:
        return True
    same = isinstance(a, Series) and np.array_equal(a.time, b.time) and set(a.leaves) <= set(b.leaves)
    return same and all(np.array_equal(x, b.leaves[n]) for n, x in a.leaves.items())


def _alike(a: Any, b: Any, by: float) -> bool:
    pairs = ((np.asarray(x), np.asarray(y)) for x, y in _leaves(a, b))
    return all(
        np.allclose(x, y, rtol=by, atol=by) if x.dtype.kind == "f" else np.array_equal(x, y) for x, y in pairs
    )


def _begun(experiment: Experiment, case: Case) -> list[dict[str, Any]] | None:
    """What the registers of a filter start from by a run of the world's first tick, for seeds 0 and 1."""
    if case.begin is None:
        return None
    first = min(int(series.time[0]) for series in experiment.ticks.values())
    build = Builder(f"{case.graph.name}_start")
    with building(build):
        ticks = {**experiment.ticks, BEGIN: _once(BEGIN, first)}
        sources = {
            name: _source(build, name, series) for name, series in {**ticks, **experiment.given(0)}.items()
        }
        made = _world(experiment, sources)
        starts = case.begin(_firsts(build, made), sources[BEGIN])
        for name, stream in starts.items():
            build.collect(name, stream)
        graph = build.freeze("", {})
    now = {name: series[series.time <= first] for name, series in ticks.items()}
    runs = [
        run_graph(graph, {**now, **experiment.given(seed)}, RunOptions(engine="python", seed=seed))
        for seed in (0, 1)
    ]
    return [{name: run[name][0] for name in starts} for run in runs]


def _leaves(a: Any, b: Any) -> Iterator[tuple[Any, Any]]:
    kind = type_of(a)
    yield from zip(flatten(a, kind), flatten(b, kind), strict=True)


def _composed(
    experiment: Experiment, case: Case, parts: dict[str, str], same: set[str], *, begin: bool
) -> Case | None:
    """The whole case; `same` are the sources whose times are those of all seeds."""
    in_graph = getattr(case.score, "in_graph", None)
    if in_graph is None:
        return None
    given, clocks = _given(case), {n.path: n.clock for n in case.graph.nodes if isinstance(n, SourceNode)}
    inputs = {**experiment.ticks, **experiment.given(0)}
    inputs[END] = _once(END, max(int(series.time[-1]) for series in experiment.ticks.values()))
    if begin:
        inputs[BEGIN] = _once(BEGIN, min(int(series.time[0]) for series in experiment.ticks.values()))
    build = Builder(case.graph.name)
    with building(build):
        sources = {name: _source(build, name, series) for name, series in inputs.items()}
        made = _world(experiment, sources)
        wires = {name: made[whose] for name, whose in parts.items()}
        for name, stream in wires.items():
            if name == parts[name] and stream.clock == clocks[name]:
                continue
            if name in inputs or name not in same or not isinstance(given[name].type, StructType):
                return None  # of a clock that no source of this name can tell
            inputs[name] = Series(given[name].time, np.ones(len(given[name]), dtype=bool), name=name)
            wires[name] = _picked(build, stream, given[name], _source(build, name, inputs[name]))
        starts = case.begin(_firsts(build, made), sources[BEGIN]) if begin and case.begin is not None else {}
        streams = inlined(build, case.graph, wires, starts)
        wired = in_graph(streams, made["truth"], sources[END])
        if wired is None:
            return None
        figures, read = wired
        for name, stream in figures.items():
            build.collect(name, stream)
        graph = build.freeze(case.graph.doc, case.graph.settings)
    return Case(graph, inputs, read, case.estimate, case.notes)


def _world(experiment: Experiment, sources: Mapping[str, Stream[Any]]) -> Any:
    told: dict[str, Any] = {name: sources[name] for name in (*experiment.ticks, *experiment.given(0))}
    return experiment.world(**told, **experiment.settings)


def _once(name: str, time: int) -> Series:
    return Series(np.array([time]), np.ones(1, dtype=bool), name=name)


def _picked(build: Builder, stream: Stream[Any], of: Series, at: Stream[Any]) -> Stream[Any]:
    """Some fields of a stream as a stream of its own type and clock, which ticks when the stream does."""
    kind = of.type
    assert isinstance(kind, StructType)
    names = [name for name, _ in kind.fields]
    some: Block[Any] = Block(lambda x: kind.cls(**{n: getattr(x, n) for n in names}), name=f"{of.name}_of")
    with build.scope("flight", given=False):  # apart from all names that a filter may have
        return latest(some(stream), init=_none(kind), at=at)  # type: ignore[no-any-return]


def _firsts(build: Builder, made: Mapping[str, Stream[Any]]) -> Callable[[str], Any]:
    """The streams of a world, each held from its first value on: no clock tells that all are there then."""

    def first(name: str) -> Any:
        with build.scope("flight", given=False):
            return latest(made[name], init=_none(made[name].type))

    return first


def _none(kind: Type) -> Any:
    return unflatten(kind, iter([np.zeros([int(n) for n in of.shape]) for _, of in leaves_of(kind)]))


def _source(build: Builder, name: str, series: Series) -> Stream[Any]:
    path = build.path(name, given=True)
    return build.stream(Wire(build.add(SourceNode(path, series.type, Source(path, timing_of(series)))), 0))
