"""What a worker does: runs of a study, one by one or many in one vectorised call, each to a row.

Nothing that a run raises ends the others: it becomes the row's `error`. In an engine that takes many runs at
once, those of one program and one set of ticks go together, filled up to the chunk's fixed size; where such a
call raises, each of its runs is tried alone, in the same program, to find the one that is to blame.
"""

from __future__ import annotations

import inspect
import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.batch import Batch
from flowgraph.data.experiment import Experiment
from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.data.registry import Case, find_graph, flight_settings, load_flight
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.data.settings import of_any_stream, parsed_settings, text
from flowgraph.engines.many import run_many
from flowgraph.engines.options import RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.engines.registry import find_engine
from flowgraph.errors import DataError, FlowgraphError
from flowgraph.language.graph import Graph
from flowgraph.language.recording import remembering
from flowgraph.pipeline.digests import structure
from flowgraph.study.lifting import Lowered, lifted, start_of
from flowgraph.study.spec import Value
from flowgraph.study.store import pack_trajectory
from flowgraph.study.whole import whole_case
from flowgraph.types import unflatten

_FLIGHTS_KEPT = 2
_PROGRAMS_KEPT = 4


@dataclass(frozen=True)
class RunSpec:
    """One run: what is run, and the key of its result. `seeded` is false where the flight is the same for
    all seeds; `whole` is true where it need not be written down to be filtered, if the filter lets it (see
    `whole`)."""

    graph: str
    data: str
    seed: int
    parameters: Mapping[str, Value]
    key: str
    seeded: bool = True
    whole: bool = False


@dataclass(frozen=True)
class Task:
    """Runs that one worker does together, and how.

    Args:
        name: of the task.
        runs: in order; more than one only where the engine takes many.
        options: of each run, but for its seed.
        metrics, keep: of the study.
    """

    name: str
    runs: tuple[RunSpec, ...]
    options: RunOptions
    metrics: tuple[str, ...] | None
    keep: bool


@dataclass(frozen=True)
class Done:
    """The outcome of one run: its row, and its trajectory where it is to be kept."""

    key: str
    row: dict[str, Any]
    trajectory: bytes | None = None


@dataclass
class _Lane:
    """A run made ready."""

    run: RunSpec
    case: Case
    times: dict[str, float] = field(default_factory=dict)


def prepared(
    graph: str, data: str, seed: int, parameters: Mapping[str, Any], flight: Flight | None = None
) -> tuple[Case, Flight]:
    """A graph made ready for a flight with these settings, as `flowgraph run --set` does.

    Raises:
        FlowgraphError: as the loader and the graph do.
    """
    function = find_graph(graph)
    if function.prepare is None:
        return function.case(Flight(data, {})), Flight(data, {})  # raises, saying what is missing
    given = {name: text(value) for name, value in parameters.items()}
    mine, rest = parsed_settings(function.prepare, given, also=flight_settings(data), path=graph)
    if flight is None:
        flight = load_flight(data, seed=seed, settings=rest)
    if "seed" in inspect.signature(function.prepare).parameters:
        mine.setdefault("seed", seed)
    return function.case(flight, **mine), flight


def loaded(data: str, seed: int, parameters: Mapping[str, Any]) -> Flight:
    """A flight with those of these settings that are its own."""
    own = {n: text(v) for n, v in flight_part(data, parameters).items()}
    return load_flight(data, seed=seed, settings=own)


def flight_part(data: str, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Those parameters that are settings of the flight."""
    names = flight_settings(data)
    return {n: v for n, v in parameters.items() if n in names or of_any_stream(n, names)}


_flights: OrderedDict[Any, Flight] = OrderedDict()
_steps: OrderedDict[Any, Any] = OrderedDict()
_lowered = Lowered()
_wholes: OrderedDict[Any, tuple[Case, Experiment] | None] = OrderedDict()


def _flight(run: RunSpec) -> Flight:
    """The flight of a run; the last few of those that serve many runs are kept."""
    settings = {n: text(v) for n, v in flight_part(run.data, run.parameters).items()}
    if run.seeded:
        return load_flight(run.data, seed=run.seed, settings=settings)
    which = (run.data, tuple(sorted(settings.items())))
    if which not in _flights:
        _flights[which] = load_flight(run.data, settings=settings)
        while len(_flights) > _FLIGHTS_KEPT:
            _flights.popitem(last=False)
    _flights.move_to_end(which)
    return _flights[which]


def run_task(task: Task) -> list[Done]:
    """Do the runs of a task; the rows come in their order."""
    found: dict[str, Done] = {}
    lanes: list[_Lane] = []
    for run in task.runs:
        try:
            lane = _ready(run)
            # lowered here, where its error is that of one run; the host has its part in every run
            if find_engine(task.options.engine).takes_many and not _lowered.lower(lane.case.graph).host:
                lanes.append(lane)
            else:
                found[run.key] = _alone(task, lane)
        except Exception as error:
            found[run.key] = _failed(run, error)
    for program, places in grouped([lane.case for lane in lanes]):
        reading: dict[Any, list[_Lane]] = {}
        for k in places:
            reading.setdefault(None if task.keep else _read(lanes[k].case), []).append(lanes[k])
        for keep, together in reading.items():
            found.update({d.key: d for d in _together(task, program, together, keep)})
    return [found[run.key] for run in task.runs]


def _ready(run: RunSpec) -> _Lane:
    start = perf_counter()
    if run.whole and (whole := _whole(run)) is not None:
        return _Lane(run, whole, {"load_s": 0.0, "setup_s": perf_counter() - start})
    flight = _flight(run)
    loaded = perf_counter()
    with remembering(_steps):
        case, _ = prepared(run.graph, run.data, run.seed, run.parameters, flight)
    return _Lane(run, case, {"load_s": loaded - start, "setup_s": perf_counter() - loaded})


def _alone(task: Task, lane: _Lane) -> Done:
    start = perf_counter()
    result = run_graph(lane.case.graph, lane.case.inputs, task.options.but(seed=lane.run.seed))
    lane.times["run_s"] = perf_counter() - start
    return _scored(task, lane, result)


def _whole(run: RunSpec) -> Case | None:
    """The experiment of a run's filter as one case, where there is one; found once for all seeds."""
    which = (run.graph, run.data, tuple(sorted(run.parameters.items())))
    if which not in _wholes:
        found = []
        for seed in (0, 1):
            flight = loaded(run.data, seed, run.parameters)
            with remembering(_steps):
                found.append((prepared(run.graph, run.data, seed, run.parameters, flight)[0], flight))
        made_by = found[0][1].experiment
        case = None if made_by is None else whole_case(made_by, *found)
        _wholes[which] = None if made_by is None or case is None else (case, made_by)
        while len(_wholes) > _PROGRAMS_KEPT:
            _wholes.popitem(last=False)
    _wholes.move_to_end(which)
    kept = _wholes[which]
    if kept is None:
        return None
    case, own = kept[0], kept[1].given(run.seed)
    assert not isinstance(case.inputs, Flight)
    return replace(case, inputs={**case.inputs, **own}) if own else case


_programs: OrderedDict[str, list[tuple[Any, Graph]]] = OrderedDict()


def _program(name: str, program: Any, graph: Graph) -> Graph:
    """The lifted graph of this structure that this process has compiled before; else this one's."""
    kept = _programs.setdefault(name, [])
    _programs.move_to_end(name)
    for other, made in kept:
        if other == program:
            return made
    kept.append((program, lifted(graph)))
    del kept[:-_PROGRAMS_KEPT]
    while len(_programs) > _PROGRAMS_KEPT:
        _programs.popitem(last=False)
    return kept[-1][1]


def _together(task: Task, program: Any, lanes: list[_Lane], keep: tuple[str, ...] | None) -> list[Done]:
    try:
        start = perf_counter()
        cases, seeds = [lane.case for lane in lanes], [lane.run.seed for lane in lanes]
        options = task.options.but(keep=keep, diverged="count")  # one that diverges leaves the others be
        batch = _played(cases, seeds, program, options)
        share = (perf_counter() - start) / len(lanes)
    except Exception as error:
        if len(lanes) == 1:
            return [_failed(lanes[0].run, error)]
        return [done for lane in lanes for done in _together(task, program, [lane], keep)]
    found = []
    brief = getattr(cases[0].score, "of", None)  # of the last values alone
    for k, lane in enumerate(lanes):
        lane.times["run_s"] = share
        if k in batch.diverged and task.options.diverged == "raise":
            why = note("diverged", batch.diverged[k])
            found.append(Done(lane.run.key, {**_named(lane.run), "error": why}))
            continue
        try:
            if brief is None or task.keep:
                found.append(_scored(task, lane, _result(lane.case.graph, batch, k)))
            else:
                start = perf_counter()
                last = {n: {x: a[k, -1] for x, a in s.leaves.items()} for n, s in batch.series.items()}
                found.append(_row(task, lane, brief(last), batch.ticks, start))
        except Exception as error:
            found.append(_failed(lane.run, error))
    return found


def simulate_together(
    cases: Sequence[Case], seeds: Sequence[int], program: Any, options: RunOptions
) -> list[Result]:
    """Cases of one program and one set of ticks (see `grouped`) in one call.

    Only the streams of `options.keep` come back.
    """
    batch = _played(cases, seeds, program, options)
    return [_result(case.graph, batch, k) for k, case in enumerate(cases)]


def _played(cases: Sequence[Case], seeds: Sequence[int], program: Any, options: RunOptions) -> Batch:
    graph = _program(cases[0].graph.name, program, cases[0].graph)
    streams: Any = [_streams(case, graph) for case in cases]
    start: Any = None
    whole = any(one is not None and cases[0] is one[0] for one in _wholes.values())
    if whole and all(case is cases[0] for case in cases):  # but for the seeds they are one run
        streams, start = streams[0], start_of(cases[0].graph)
    starts = start or [start_of(case.graph) for case in cases]
    return run_many(graph, streams, seeds, options.but(init=starts))


def _read(case: Case) -> tuple[str, ...] | None:
    """The streams that a score looks at; None where it does not say, for then it may be any."""
    reads = getattr(case.score, "reads", None)
    return None if reads is None else tuple(reads(case.graph))


def grouped(cases: Sequence[Case]) -> list[tuple[Any, list[int]]]:
    """The places of cases that can go together, with the program that they share."""
    groups: list[tuple[Any, list[np.ndarray], list[int]]] = []
    places: list[int] = []
    for k, case in enumerate(cases):
        if k and case is cases[k - 1]:  # of a whole experiment
            places.append(k)
            continue
        pipeline = _lowered.lower(case.graph)
        program = pipeline.__dict__.setdefault("_structure", None) or structure(pipeline)
        pipeline.__dict__["_structure"] = program
        ticks = _ticks(case)
        found = [where for other, when, where in groups if other == program and _same(when, ticks)]
        places = found[0] if found else []
        places.append(k)
        if not found:
            groups.append((program, ticks, places))
    return [(program, places) for program, _, places in groups]


def _streams(case: Case, graph: Graph) -> dict[str, Any]:
    given = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
    return {name: given[name] for name in graph.sources}


def _ticks(case: Case) -> list[np.ndarray]:
    """The times of each source, which runs must share to go together."""
    given = case.inputs.streams if isinstance(case.inputs, Flight) else case.inputs
    return [given[n].time for n in case.graph.sources if isinstance(given[n], Series)]


def _same(a: Sequence[np.ndarray], b: Sequence[np.ndarray]) -> bool:
    return len(a) == len(b) and all(np.array_equal(x, y) for x, y in zip(a, b, strict=True))


def _result(graph: Graph, batch: Batch, k: int) -> Result:
    """One run of a batch, with the graph's own signal types; without a last state, which a batch has not."""
    series = {}
    for collected in graph.collected:
        if collected.name not in batch.series:
            continue
        runs = batch[collected.name]
        here, type_ = runs.present[k], graph.port(collected.wire).type
        whole = bool(here.all())
        leaves = iter([leaf[k] if whole else leaf[k][here] for leaf in runs.leaves.values()])
        time = runs.time if whole else runs.time[here]
        series[collected.name] = Series(time, unflatten(type_, leaves), type=type_, name=collected.name)
    notes = (note("diverged", batch.diverged[k]),) if k in batch.diverged else ()
    return Result(batch.graph, batch.engine, series, {}, {}, batch.ticks, 0.0, notes)


def _scored(task: Task, lane: _Lane, result: Result) -> Done:
    start = perf_counter()
    score = lane.case.score(result)
    kept = pack_trajectory(result.series) if task.keep else None
    return _row(task, lane, {**score, **result.stats}, result.ticks, start, kept)


def _row(
    task: Task, lane: _Lane, score: Mapping[str, Any], ticks: int, start: float, kept: bytes | None = None
) -> Done:
    run, values = lane.run, {n: _plain(v) for n, v in score.items()}
    lane.times["score_s"] = perf_counter() - start
    row = {**_named(run), **_chosen(values, task.metrics, run), "ticks": ticks, "error": None}
    astray = [n for n, v in values.items() if isinstance(v, float) and not math.isfinite(v)]
    if astray:
        row["error"] = f"the estimate went astray: {astray[0]} is {values[astray[0]]}"
    row.update(lane.times, wall_s=sum(lane.times.values()))
    return Done(run.key, row, kept)


def _chosen(values: dict[str, Any], metrics: tuple[str, ...] | None, run: RunSpec) -> dict[str, Any]:
    if metrics is None:
        return values
    missing = [n for n in metrics if n not in values]
    if missing:
        raise DataError(
            "this run has no such measure",
            path=f"{run.graph} on {run.data}, metrics",
            expected="some of " + (", ".join(values) or "none: the flight has no truth"),
            got=missing[0],
            fix="name others in the study's metrics, or leave them out",
        )
    return {n: values[n] for n in metrics}


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value


def _named(run: RunSpec) -> dict[str, Any]:
    return {"key": run.key, "graph": run.graph, "data": run.data, "seed": run.seed, **run.parameters}


def _failed(run: RunSpec, error: Exception) -> Done:
    return Done(run.key, {**_named(run), "error": said(error)})


def lost(run: RunSpec, why: str) -> dict[str, Any]:
    """The row of a run that could not be done because workers died of it."""
    return {**_named(run), "error": f"lost: {why}"}


def said(error: BaseException) -> str:
    """An error in one line."""
    parts = [p.strip() for p in str(error).splitlines() if p.strip()] or [repr(error)]
    kind = type(error).__name__
    return f"{kind}: {'; '.join(parts)}" if isinstance(error, FlowgraphError) else f"{kind}: {parts[0]}"


Runner = Callable[[Task], list[Done]]
