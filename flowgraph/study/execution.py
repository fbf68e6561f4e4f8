"""Running a study: what is there already stays, what is missing is run, and each result is kept as it comes.

The plan lists the runs in a fixed order, each with its key. In an engine that takes many runs at once, those
of one graph, one flight and one program make chunks of a fixed size by their place in that order, whatever
has been done before: of a chunk only the missing runs are kept, but they ran as they would have in any case.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Any

from flowgraph.data.flight import Flight
from flowgraph.data.registry import find_graph, load_flight
from flowgraph.data.settings import text
from flowgraph.engines.options import RunOptions
from flowgraph.engines.registry import find_engine
from flowgraph.errors import DeclarationError
from flowgraph.pipeline import digests
from flowgraph.pipeline.lowering import lower
from flowgraph.study import keys
from flowgraph.study.executors import Executor, Finished, InProcess, OnDask, ProcessPool
from flowgraph.study.spec import Study, Value
from flowgraph.study.store import Row, Store, import_pyarrow
from flowgraph.study.tasks import Done, RunSpec, Task, flight_part, lost, prepared, run_task, said


@dataclass(frozen=True)
class Outcome:
    """What a study came to.

    Args:
        folder: where its results are.
        rows: a row a run, in the order of the plan.
        done: how many were run now; `kept` were there before.
        seconds: that it took now.
        interrupted: whether it was stopped; then `rows` are those that there are. by: what was raised then.
    """

    folder: Path
    rows: tuple[Row, ...]
    done: int
    kept: int
    seconds: float
    interrupted: bool = False
    by: type[KeyboardInterrupt] | None = None

    @property
    def failed(self) -> list[Row]:
        """The rows with an error."""
        return [row for row in self.rows if row.get("error") is not None]


class Watcher:
    """Is told how a study goes; does nothing with it. `progress` has ones that speak."""

    def planning(self, described: int, total: int) -> None:
        """So many of the distinct settings have been looked at."""

    def start(self, total: int, kept: Sequence[Row]) -> None:
        """There are so many runs, and these rows are there already."""

    def row(self, row: Row) -> None:
        """A run has ended."""

    def end(self, outcome: Outcome) -> None:
        """No more runs."""


@dataclass(frozen=True)
class Plan:
    """All runs in order, and which of them share a program, by the place of each."""

    runs: tuple[RunSpec, ...]
    programs: tuple[str, ...]


def plan(study: Study, watcher: Watcher | None = None) -> Plan:
    """The runs of a study with their keys.

    Each distinct setting of a graph and a flight is prepared once, with seed 0, to describe it.
    """
    watcher = watcher or Watcher()
    flights = _Flights(many=len(study.each_seed) > 1)
    total = len(study.data) * sum(1 for g in study.graphs for _ in study.combinations(g))
    together = find_engine(study.engine).takes_many
    shared = [study.shard] if study.shard else []  # results are those of one device to rounding
    runs: list[RunSpec] = []
    programs: list[str] = []
    for graph in study.graphs:
        prepare = find_graph(graph).prepare
        code = digests.code_digest(prepare) if prepare is not None else ""
        for data in study.data:
            for parameters in study.combinations(graph):
                identity, seeded, described, program = flights.described(graph, data, parameters)
                whole = together and not study.keep and flights.made(data, parameters)
                watcher.planning(len(runs) // len(study.each_seed), total)
                common = {
                    "graph": [graph, described, code],
                    "data": identity,
                    "parameters": {n: [type(v).__name__, text(v)] for n, v in parameters.items()},
                    "engine": [study.engine, study.dtype, study.chunk if together else 1, *shared],
                    "metrics": study.metrics,
                }
                for seed in study.each_seed:
                    key = keys.run_key({**common, "seed": seed})
                    runs.append(RunSpec(graph, data, seed, parameters, key, seeded, whole))
                    programs.append(program)
    return Plan(tuple(runs), tuple(programs))


class _Flights:
    """Descriptions of flights and of graphs on them."""

    def __init__(self, *, many: bool) -> None:
        self._many = many
        self._known: dict[Any, tuple[Flight | Exception, str, bool]] = {}

    def described(self, graph: str, data: str, parameters: Mapping[str, Value]) -> tuple[str, bool, str, str]:
        """Identity of the data, whether it depends on the seed, digest of the graph, and of its program."""
        flight, identity, seeded = self._flight(data, parameters)
        if isinstance(flight, Exception):
            return identity, seeded, "", ""
        try:
            case, _ = prepared(graph, data, 0, parameters, flight)
        except Exception as error:  # the run will raise it again, and say so in its row
            return identity, seeded, keys.failure_digest(error), ""
        try:
            pipeline = lower(case.graph)
            described, program = digests.graph_digest(pipeline), digests.structure_digest(pipeline)
        except Exception as error:  # the Python engine may run it all the same
            described, program = keys.failure_digest(error), ""
        beside = digests.python_digest(case.graph, every=not program)
        return identity, seeded, digests.digest((described, beside)) if beside else described, program

    def made(self, data: str, parameters: Mapping[str, Value]) -> bool:
        """Whether its flights, one a seed, are runs of a graph."""
        flight = self._flight(data, parameters)[0]
        return self._many and isinstance(flight, Flight) and flight.experiment is not None

    def _flight(self, data: str, parameters: Mapping[str, Value]) -> tuple[Flight | Exception, str, bool]:
        settings = {n: text(v) for n, v in flight_part(data, parameters).items()}
        which = (data, tuple(sorted(settings.items())))
        if which not in self._known:
            self._known.clear()  # the flights come one after the other
            try:
                flight = load_flight(data, settings=settings)
                identity = digests.digest((data, settings, flight))
                seeded = not self._many or digests.digest(flight) != digests.digest(
                    load_flight(data, seed=1, settings=settings)
                )
                self._known[which] = flight, identity, seeded
            except Exception as error:
                self._known[which] = error, digests.digest((data, settings, keys.failure_digest(error))), True
        return self._known[which]


def tasks_of(study: Study, planned: Plan, wanted: Iterable[str]) -> list[Task]:
    """Tasks for the wanted keys, in the order of the plan; chunks keep the places that they have in it."""
    missing = set(wanted)
    metrics = None if study.metrics is None else tuple(study.metrics)
    together = find_engine(study.engine).takes_many
    options = RunOptions(
        engine=study.engine, dtype=study.dtype, runs_at_once=study.chunk, shard=study.shard
    )  # fmt: skip
    chunks: dict[Any, list[RunSpec]] = {}
    counts: dict[Any, int] = {}
    for place, (run, program) in enumerate(zip(planned.runs, planned.programs, strict=True)):
        if together:
            group = (run.graph, run.data, program)
            counts[group] = counts.get(group, -1) + 1
            chunk: Any = (group, counts[group] // study.chunk)
        else:
            chunk = place
        if run.key in missing:
            chunks.setdefault(chunk, []).append(run)
    return [Task(f"{k}", tuple(runs), options, metrics, study.keep) for k, runs in enumerate(chunks.values())]


def run_study(
    study: Study,
    out: str | Path | None = None,
    *,
    workers: int = 1,
    executor: Executor | None = None,
    force: bool = False,
    retry: bool = False,
    watcher: Watcher | None = None,
) -> Outcome:
    """Run what is missing of a study, and write the table of all of it.

    Args:
        study: what to run.
        out: the folder; the study's own if left out.
        workers: processes; with 1 everything runs in this one. Not used with an `executor`.
        executor: where to run; it stays open.
        force: run everything anew.
        retry: run those anew that ended in an error.
        watcher: is told how it goes.

    Returns:
        An `Outcome`. After a KeyboardInterrupt that of what there is by then, with `interrupted`.

    Raises:
        DeclarationError: without a folder; for a `shard` of more devices than there are.
        OutputError: where the folder cannot be written, or another study is running into it.
        MissingDependencyError: without pyarrow.
    """
    import_pyarrow()
    folder = out if out is not None else study.out
    if folder is None:
        raise DeclarationError(
            "a study needs a folder for its results",
            path="out",
            expected="a folder",
            got="none",
            fix="write --out DIR, or out = ... in the study",
        )
    if study.shard and not isinstance(executor, OnDask):  # whose workers have devices of their own
        find_engine(study.engine).need_devices(study.shard)
    start = perf_counter()
    watcher = watcher or Watcher()
    store = Store(folder)
    with store.locked():
        return _run(study, store, start, watcher, workers, executor, force=force, retry=retry)


def _run(
    study: Study, store: Store, start: float, watcher: Watcher, workers: int, executor: Executor | None, *,
    force: bool, retry: bool,
) -> Outcome:  # fmt: skip
    store.write_study(study.resolved())
    rows: dict[str, Row] = {}
    done = kept = 0
    interrupted, by = False, None
    planned = Plan((), ())
    own = executor is None
    runner: Executor = executor or (InProcess() if workers == 1 else ProcessPool(workers))
    try:
        planned = plan(study, watcher)
        if not force:
            rows = _there(study, store, planned, retry)
        kept = len(rows)
        watcher.start(len(planned.runs), list(rows.values()))
        missing = [r.key for r in planned.runs if r.key not in rows]
        work = {t.name: t for t in tasks_of(study, planned, missing)}
        for task in work.values():
            runner.submit(task.name, run_task, task)
        for finished in runner.as_completed():
            task = work.pop(finished.task)
            ended = _ended(finished, task, work, runner)
            store.write((one.key, one.row, one.trajectory) for one, safe in ended if safe)
            for one, _ in ended:
                rows[one.key] = one.row
                done += 1
                watcher.row(one.row)
    except KeyboardInterrupt as error:
        interrupted, by = True, type(error)
        rows = {**_there(study, store, planned, retry=False), **rows}  # one may have been written just now
    finally:
        if own:
            runner.close()
    ordered = tuple(rows[r.key] for r in planned.runs if r.key in rows)
    store.write_table(ordered, first=("graph", "data", "seed", *study.names()))
    outcome = Outcome(store.folder, ordered, done, kept, perf_counter() - start, interrupted, by)
    watcher.end(outcome)
    return outcome


def _there(study: Study, store: Store, planned: Plan, retry: bool) -> dict[str, Row]:
    found = {}
    kept = store.read(run.key for run in planned.runs)
    for run in planned.runs:
        one = kept.get(run.key)
        if one is None or (retry and one.row.get("error") is not None):
            continue
        if study.keep and one.row.get("error") is None and not store.has_trajectory(one):
            continue
        found[run.key] = one.row
    return found


def _ended(
    finished: Finished, task: Task, work: dict[str, Task], runner: Executor
) -> list[tuple[Done, bool]]:
    """The runs of a task that has ended, and whether each is a result to keep.

    A task of many that kills its workers is taken apart, to lose only the run that is to blame. What is lost
    is no result: it is tried again when the study is run again.
    """
    if finished.value is not None:
        found: list[Done] = finished.value
        return [(done, True) for done in found]
    why = finished.lost or said(finished.error or RuntimeError("nothing came back"))
    if len(task.runs) > 1:
        for k, run in enumerate(task.runs):
            part = replace(task, name=f"{task.name}.{k}", runs=(run,))
            work[part.name] = part
            runner.submit(part.name, run_task, part)
        return []
    return [(Done(run.key, lost(run, why)), False) for run in task.runs]
