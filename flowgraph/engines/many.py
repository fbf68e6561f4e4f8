"""Many runs of one graph at once: a leading batch of runs, in chunks of fixed size.

In XLA a chunk of runs goes through one compiled scan under `vmap`, in C each run on one of several threads;
the other engines run them one by one.
The size of a chunk is fixed and the last one is filled up, so memory is bounded and the result of a run does
not depend on how many others are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.series import Series
from flowgraph.data.tape import tape
from flowgraph.engines.python.run import Meter
from flowgraph.engines.state import initial_registers
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.recorder.random import seed_words
from flowgraph.types import ArrayType, StructType, dtype_name, flatten, leaves_of

RUNS_AT_ONCE = 64


@dataclass(frozen=True)
class Runs:
    """One collected stream of many runs.

    Args:
        name: of the stream.
        time: (n,) int64 ns, the same in all runs.
        present: (runs, n): whether the stream was present; all true unless its clock depends on data.
        leaves: by dotted name, (runs, n, ...), in XLA and C of the `dtype` that was asked for; zero where
            absent. Also attributes and items.
    """

    name: str
    time: np.ndarray
    present: np.ndarray
    leaves: Mapping[str, np.ndarray]

    def __getitem__(self, leaf: str) -> np.ndarray:
        if leaf not in self.leaves:
            raise UnknownNameError("field", leaf, self.leaves, path=self.name)
        return self.leaves[leaf]

    def __getattr__(self, leaf: str) -> np.ndarray:
        if leaf.startswith("_") or "leaves" not in self.__dict__:
            raise AttributeError(leaf)
        try:
            return self[leaf]
        except UnknownNameError as error:
            raise AttributeError(str(error)) from None

    def run(self, index: int) -> Series:
        """One run's stream, as a single run gives it (of the fields that were kept)."""
        at = self.present[index]
        fields = {n: a[index][at] for n, a in self.leaves.items()}
        if list(fields) == ["value"]:
            return Series(self.time[at], fields["value"], name=self.name)
        type_ = StructType(self.name, tuple((n, leaf_type(a)) for n, a in fields.items()), dict)
        return Series(self.time[at], fields, type=type_, name=self.name)


@dataclass(frozen=True)
class Batch:
    """The outcome of many runs: `batch["pose"].position` is (runs, n, 3).

    Args:
        graph, engine: names.
        seeds: of the runs, in the order asked for.
        series: the collected streams by name.
        ticks: of one run.
        wall_s: seconds spent in the engine's loop, without set-up.
    """

    graph: str
    engine: str
    seeds: tuple[int, ...]
    series: Mapping[str, Runs]
    ticks: int
    wall_s: float

    def __getitem__(self, name: str) -> Runs:
        if name not in self.series:
            raise UnknownNameError("output", name, self.series, path=self.graph)
        return self.series[name]


PerSeed = Callable[[int], Any]


def simulate_many(
    graph: Graph,
    inputs: Inputs | PerSeed | Sequence[Inputs],
    seeds: Sequence[int],
    *,
    engine: str = "xla",
    dtype: str = "float64",
    init: Mapping[str, Any] | PerSeed | Sequence[Mapping[str, Any]] | None = None,
    keep: Sequence[str] | None = None,
    runs_at_once: int = RUNS_AT_ONCE,
    progress: Meter | None = None,
    passes: Collection[str] | None = None,
) -> Batch:
    """Run a graph once for each seed.

    Args:
        graph: a built graph.
        inputs: as for `simulate`, shared by all runs; or a function of the seed that gives them; or a list,
            one a run.
        seeds: one a run.
        engine, dtype: as for `simulate`.
        init: other initial values, shared or a function of the seed, or a list, one a run.
        keep: what to keep of the outputs, `"pose"` or `"pose.position"`; everything if left out.
        runs_at_once: size of a chunk of runs in XLA.
        progress: told the number of finished runs.
        passes: of the optimiser, as for `simulate`.

    Raises:
        DeclarationError: without a seed, or where one is none; for a list that is not one a run.
        DataError: where, in XLA, two runs have events at different times.
    """
    kept = _kept(graph, keep)
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
    for name, given in (("inputs", inputs), ("init", init)):
        if isinstance(given, list | tuple) and len(given) != len(seeds):
            raise DeclarationError(
                f"the list of {name} is not one a run",
                path=f"{graph.name}, {name}",
                expected=f"{len(seeds)}, as many as seeds",
                got=str(len(given)),
                fix="give one for each seed, or one for all, not in a list",
            )
    if isinstance(runs_at_once, bool) or not isinstance(runs_at_once, int) or runs_at_once < 1:
        raise DeclarationError(
            "runs go in chunks of a positive size",
            path=f"{graph.name}, runs_at_once",
            expected="a whole number from 1",
            got=repr(runs_at_once),
            fix=f"leave it out for {RUNS_AT_ONCE}",
        )
    if dtype not in ("float64", "float32"):
        raise UnknownNameError("dtype", dtype, ("float64", "float32"))
    if engine in ("xla", "c") and lower(graph, dtype=dtype).host:  # the host has its part in every run
        return one_by_one(graph, inputs, tuple(seeds), engine, dtype, init, kept, progress, passes)
    if engine == "xla":
        from flowgraph.engines.xla.batch import vectorised

        return vectorised(graph, inputs, tuple(seeds), dtype, init, kept, runs_at_once, progress, passes)
    if engine == "c":
        from flowgraph.engines.c.batch import threaded

        return threaded(graph, inputs, tuple(seeds), dtype, init, kept, progress, passes)
    return one_by_one(graph, inputs, tuple(seeds), engine, dtype, init, kept, progress, passes)


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


def of_run(given: Any, run: int, seed: int) -> Any:
    """Inputs or initial values of the run of that place and seed."""
    if isinstance(given, list | tuple):
        return given[run]
    return given(seed) if callable(given) else given


def is_shared(inputs: Any) -> bool:
    return not (callable(inputs) or isinstance(inputs, list | tuple))


def one_by_one(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], engine: str, dtype: str, init: Any,
    kept: dict[str, list[str]], progress: Meter | None, passes: Collection[str] | None,
) -> Batch:  # fmt: skip
    from flowgraph.engines.simulate import simulate

    if is_shared(inputs):  # an iterable can be read only once
        inputs = dict(zip(graph.sources, tape(prepare(graph, inputs), graph).series, strict=True))
    parts: dict[str, list[Series]] = {name: [] for name in kept}
    wall, ticks = 0.0, 0
    for n, seed in enumerate(seeds):
        result = simulate(
            graph, of_run(inputs, n, seed), engine=engine, dtype=dtype, init=of_run(init, n, seed),
            seed=seed, passes=passes,
        )  # fmt: skip
        wall, ticks = wall + result.wall_s, result.ticks
        for name in kept:
            parts[name].append(result[name])
        if progress is not None:
            progress.update(n + 1, 0)
    return Batch(graph.name, engine, seeds, {n: joined(n, p, kept[n]) for n, p in parts.items()}, ticks, wall)


def joined(name: str, parts: list[Series], leaves: list[str]) -> Runs:
    """Series of several runs on the union of their times."""
    time = parts[0].time
    same = all(np.array_equal(p.time, time) for p in parts)
    if same:
        present = np.ones((len(parts), len(time)), bool)
    else:
        time = np.unique(np.concatenate([p.time for p in parts]))
        present = np.stack([np.isin(time, p.time) for p in parts])
    made = {}
    for leaf in leaves:
        arrays = [p.leaves[leaf] for p in parts]
        shape, kind = (len(parts), len(time), *arrays[0].shape[1:]), arrays[0].dtype
        full = np.empty(shape, kind) if same else np.zeros(shape, kind)
        for row, at, array in zip(full, present, arrays, strict=True):
            row[... if same else at] = array
        made[leaf] = full
    return Runs(name, time, present, made)


def initial_cells(graph: Graph, init: Any) -> list[np.ndarray]:
    """The register cells that a run starts from."""
    slots = initial_registers(graph, init)
    return [np.asarray(leaf) for index, node in graph.registers for leaf in flatten(slots[index], node.type)]


def leaf_type(array: np.ndarray) -> Any:
    return ArrayType(array.shape[1:], dtype_name(array))
