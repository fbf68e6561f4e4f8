"""Many runs of one graph: together where the engine takes many at once, else one by one."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.data.batch import Batch, joined
from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.notes import note
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.contract import ManyRuns, PipelineEngine
from flowgraph.engines.options import RUNS_AT_ONCE, Meter, PerSeed, RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.engines.playback import chosen_passes
from flowgraph.engines.registry import find_engine
from flowgraph.engines.subject import LoweredGraph
from flowgraph.engines.trouble import ManyTroubles
from flowgraph.errors import DeclarationError, RunError, UnknownNameError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.optimise import RELYING, without
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words
from flowgraph.types import leaves_of

DIVERGED = note("diverged", "")

ManyInputs = Inputs | PerSeed | Sequence[Inputs]


def simulate_many(
    graph: Graph,
    inputs: ManyInputs,
    seeds: Sequence[int],
    *,
    engine: str = "xla",
    dtype: str = "float64",
    init: Mapping[str, Any] | PerSeed | Sequence[Mapping[str, Any]] | None = None,
    keep: Sequence[str] | None = None,
    runs_at_once: int = RUNS_AT_ONCE,
    progress: Meter | None = None,
    passes: Collection[str] | None = None,
    diverged: str = "raise",
    shard: Mapping[str, int] | None = None,
) -> Batch:
    """Run a graph once for each seed.

    Args:
        graph: a built graph.
        inputs: as for `simulate`, shared by all runs; or a function of the seed that gives them; or a list,
            one a run.
        seeds: one a run.
        engine, dtype: as for `simulate`.
        init: other initial values, shared or a function of the seed, or a list, one a run.
        keep: what to keep of the outputs, `"pose"` or `"pose.position"`; everything if left out. What
            nothing else needs is not computed, and not found to have diverged.
        runs_at_once: size of a chunk of runs in XLA. It is fixed, and the last chunk is filled up, so memory
            is bounded and the result of a run does not depend on how many others are asked for.
        progress: told the number of finished runs.
        passes: of the optimiser, as for `simulate`.
        diverged: as for `simulate`; "count" lists the runs in `Batch.diverged`.
        shard: as for `simulate`. Of `{"runs": n}`, n devices take as many of the runs that go together each,
            and `runs_at_once` is rounded up to what n divides.

    Raises:
        DeclarationError: without a seed, or where one is none; for a list that is not one a run.
        FifoOverflowError, DivergedError: of the first such run in the order of seeds; a note names the seed.
        DataError: where, in XLA, two runs have events at different times.
    """
    options = RunOptions(
        engine=engine, dtype=dtype, init=init, keep=keep, runs_at_once=runs_at_once, progress=progress,
        passes=passes, diverged=diverged, shard=shard,
    )  # fmt: skip
    return run_many(graph, inputs, seeds, options)


def run_many(graph: Graph, inputs: ManyInputs, seeds: Sequence[int], options: RunOptions) -> Batch:
    """Run a graph once for each seed, as the options ask; see `simulate_many`."""
    keep = _kept(graph, options.keep)
    seeds = _checked_seeds(graph, inputs, seeds, options)
    engine = find_engine(options.engine)
    engine.check(options)
    alone = not engine.takes_many or options.dtype == "fixed"
    if alone:
        graph = _collecting(graph, keep)
    if alone or lower(graph, dtype=options.dtype).host:  # the host has its part in every run
        return _one_by_one(graph, inputs, seeds, keep, options)
    assert isinstance(engine, PipelineEngine)
    engine.need()
    runs, troubles = _together(graph, inputs, seeds, keep, options)
    passes = chosen_passes(engine, options)
    if options.init is not None:
        passes = without(*RELYING, passes=passes)  # they rely on the values at reset
    if not len(runs.first.time):  # nothing to make ready for
        return _one_by_one(graph, inputs, seeds, keep, options.but(shard=None))
    found = engine.play_many(runs, passes, options)
    series = {name: found.series[name] for name in keep}
    astray = troubles.astray(series)
    worst = min([*troubles.full, *(astray if options.diverged == "raise" else ())], default=None)
    if worst is not None:
        _alone(graph, runs, worst, options)
        raise troubles.error(worst)
    return Batch(graph.name, options.engine, seeds, series, found.ticks, found.wall_s, astray)


def _collecting(graph: Graph, names: Collection[str]) -> Graph:
    """The graph that collects these outputs and no others, kept with the whole one."""
    collected = tuple(c for c in graph.collected if c.name in names)
    if len(collected) == len(graph.collected):
        return graph
    which = ("collecting", *(c.name for c in collected))
    if which not in graph.plans:
        plans: dict[Any, Any] = {}
        made: Pipeline | None = graph.plans.get("pipeline")
        if made is not None and not made.host:  # it may have been lifted since
            outputs = tuple(port for port in made.outputs if port.name in names)
            plans["pipeline"] = replace(made, outputs=outputs)
        graph.plans[which] = replace(graph, collected=collected, plans=plans)
    found: Graph = graph.plans[which]
    return found


def _alone(graph: Graph, runs: ManyRuns, n: int, options: RunOptions) -> None:
    """Run one of many by itself, for the error that it ends in."""
    given = dict(zip(graph.sources, runs.tape(n).series, strict=True))
    seed = runs.seeds[n]
    single = options.but(seed=seed, init=_of_run(options.init, n, seed), progress=None, keep=None)
    with _naming_seed(seed):
        run_graph(graph, given, single)


@contextmanager
def _naming_seed(seed: int) -> Iterator[None]:
    try:
        yield
    except RunError as error:
        error.add_note(f"in the run of seed {seed}")
        raise


def _checked_seeds(graph: Graph, inputs: Any, seeds: Any, options: RunOptions) -> tuple[int, ...]:
    try:
        seeds = tuple(seeds)
    except TypeError:
        seeds = ()
    if not seeds:
        raise DeclarationError(
            "many runs need a seed each",
            path=f"{graph.name}, seeds",
            expected="one whole number or more",
            got="none",
            fix="write seeds=range(100)",
        )
    for seed in seeds:
        seed_words(seed)
    for name, given in (("inputs", inputs), ("init", options.init)):
        if isinstance(given, list | tuple) and len(given) != len(seeds):
            raise DeclarationError(
                f"the list of {name} is not one a run",
                path=f"{graph.name}, {name}",
                expected=f"{len(seeds)}, as many as seeds",
                got=str(len(given)),
                fix="give one for each seed, or one for all, not in a list",
            )
    size = options.runs_at_once
    if isinstance(size, bool) or not isinstance(size, int) or size < 1:
        raise DeclarationError(
            "runs go in chunks of a positive size",
            path=f"{graph.name}, runs_at_once",
            expected="a whole number from 1",
            got=repr(size),
            fix=f"leave it out for {RUNS_AT_ONCE}",
        )
    return tuple(seeds)


def _kept(graph: Graph, keep: Sequence[str] | None) -> dict[str, list[str]]:
    """The leaf names to keep of each output."""
    every = {c.name: [n for n, _ in leaves_of(graph.port(c.wire).type)] for c in graph.collected}
    if keep is None:
        return every
    found: dict[str, list[str]] = {}
    for name in keep:
        output, _, leaf = name.partition(".")
        if output not in every or (leaf and leaf not in every[output]):
            raise UnknownNameError(
                "output", name, [*every, *(f"{o}.{x}" for o, leaves in every.items() for x in leaves)]
            )
        found.setdefault(output, []).extend([leaf] if leaf else every[output])
    return found


def _of_run(given: Any, run: int, seed: int) -> Any:
    """Inputs or initial values of the run of that place and seed."""
    if isinstance(given, list | tuple):
        return given[run]
    return given(seed) if callable(given) else given


def _is_shared(given: Any) -> bool:
    return not (callable(given) or isinstance(given, list | tuple))


def _one_by_one(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], keep: dict[str, list[str]], options: RunOptions
) -> Batch:
    if _is_shared(inputs):  # an iterable can be read only once
        inputs = dict(zip(graph.sources, tape(prepare(graph, inputs), graph).series, strict=True))
    parts: dict[str, list[Series]] = {name: [] for name in keep}
    wall, ticks = 0.0, 0
    astray: dict[int, str] = {}
    for n, seed in enumerate(seeds):
        single = options.but(seed=seed, init=_of_run(options.init, n, seed), progress=None)
        with _naming_seed(seed):
            result = run_graph(graph, _of_run(inputs, n, seed), single)
        said = [text.removeprefix(DIVERGED) for text in result.notes if text.startswith(DIVERGED)]
        if said:
            astray[n] = "; ".join(said)
        wall, ticks = wall + result.wall_s, result.ticks
        for name in keep:
            parts[name].append(result[name])
        if options.progress is not None:
            options.progress.update(n + 1, 0)
    series = {name: joined(name, part, keep[name]) for name, part in parts.items()}
    return Batch(graph.name, options.engine, seeds, series, ticks, wall, astray)


def _together(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], keep: dict[str, list[str]], options: RunOptions
) -> tuple[ManyRuns, ManyTroubles]:
    subject = LoweredGraph(graph, dtype=options.dtype)
    first = subject.tape(_of_run(inputs, 0, seeds[0]))
    shared = _is_shared(inputs)

    def tape_of(n: int) -> Tape:
        return first if shared or not n else subject.tape(_of_run(inputs, n, seeds[n]), like=first)

    def cells_of(n: int) -> list[np.ndarray]:
        single = options.but(init=_of_run(options.init, n, seeds[n]))
        return [np.asarray(cell) for cell in subject.start(single).cells]

    started = cells_of(0) if _is_shared(options.init) else None

    def cells_at(n: int) -> list[np.ndarray]:
        return started if started is not None else cells_of(n)

    troubles = ManyTroubles(subject.pipeline, cells_at, tape_of)
    runs = ManyRuns(
        graph.name, subject.pipeline, seeds, keep, first, shared, started, tape_of, cells_at,
        troubles.finish,
    )  # fmt: skip
    return runs, troubles
