"""What one more run of a study costs, beside its filter's own time in C.

Ours are runs of a chunk of a study, from seed to row: the flight is made, filtered and scored in one graph.
The peer is the same filter in C on flights that were recorded before, which makes, scores and writes nothing:
one run after the other, as `simulate` plays it, and, in the details, all of them at once, four side by side.
Both are processor time, of all threads, once everything is compiled and loaded.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from statistics import median
from time import process_time
from typing import Any

from flowgraph.engines.many import run_many
from flowgraph.engines.options import RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.study import tasks
from flowgraph.study.lifting import lifted, start_of
from tests.bench.rows import Row

SETTINGS: Mapping[str, tuple[float, Mapping[str, Any]]] = {
    "ekf": (20.0, {}),
    "ins_eskf": (20.0, {}),
    "rbpf_indoor": (4.0, {"particles": 100}),
}
"""Of each filter, s of a flight and settings."""


def rows(*, runs: int = 32, repeats: int = 5, factor: float = 1.0) -> list[Row]:
    """A row a filter; `factor` shortens the flights."""
    return [
        further(graph, factor * duration, more, runs, repeats) for graph, (duration, more) in SETTINGS.items()
    ]


def further(graph: str, duration: float, more: Mapping[str, Any], runs: int, repeats: int) -> Row:
    """ms of processor time a run: of a study, and of the filter alone."""
    parameters = {"duration": duration, **more}
    options = RunOptions(engine="c", runs_at_once=runs)

    def specs(whole: bool) -> tuple[tasks.RunSpec, ...]:
        return tuple(
            tasks.RunSpec(graph, "sim", seed, parameters, f"{seed}", whole=whole) for seed in range(runs)
        )

    task = tasks.Task("study", specs(True), options, None, False)
    cases = [
        tasks.prepared(s.graph, s.data, s.seed, s.parameters, tasks.loaded(s.data, s.seed, s.parameters))[0]
        for s in specs(False)
    ]
    filter_ = lifted(cases[0].graph)
    fed: Any = [dict(case.recorded) for case in cases]
    starts = [start_of(case.graph) for case in cases]

    def study() -> None:
        done = tasks.run_task(task)
        assert all(one.row["error"] is None and one.row["load_s"] == 0.0 for one in done)

    def alone() -> None:
        for seed, case in enumerate(cases):
            run_graph(case.graph, case.inputs, options.but(seed=seed))

    def together() -> None:
        run_many(filter_, fed, range(runs), options.but(init=starts, keep=()))

    works = (study, alone, together)
    for work in works:
        work()
    turns = [[1e3 * _cpu(work) / runs for work in works] for _ in range(repeats)]
    ours, peer, beside = (median(column) for column in zip(*turns, strict=True))
    ratio = median(a / b for a, b, _ in turns)
    details = {"all_at_once_ms": beside, "ratio_to_all_at_once": median(a / c for a, _, c in turns)}
    name = f"one more run of {graph}, {duration:g} s{_said(more)}, c"
    against = "its filter alone on a recorded flight, c"
    return Row(name, ours, peer, "CPU ms", against, ratio, "ratio <= 1.5", ratio <= 1.5, details=details)


def _said(more: Mapping[str, Any]) -> str:
    return "".join(f", {name} = {value}" for name, value in more.items())


def _cpu(work: Callable[[], None]) -> float:
    begun = process_time()
    work()
    return process_time() - begun
