"""Many runs of one graph at once: a leading batch of runs, in chunks of fixed size.

In XLA a chunk of runs goes through one compiled scan under `vmap`, in C each run on one of several threads;
the other engines run them one by one.
The size of a chunk is fixed and the last one is filled up, so memory is bounded and the result of a run does
not depend on how many others are asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from flowgraph.graph import Graph
from flowgraph.inputs import Inputs, Tape, prepare, tape
from flowgraph.lowering import lower
from flowgraph.optimise import for_engine, without
from flowgraph.pipeline import Pipeline, Port
from flowgraph.playback import check_faults, dense, real_leaves
from flowgraph.random import seed_words
from flowgraph.run import Meter
from flowgraph.series import Series
from flowgraph.state import initial_registers
from flowgraph.types import ArrayType, StructType, dtype_name, flatten, leaves_of

if TYPE_CHECKING:
    from flowgraph.xla import Chunk

_TICKS_AT_ONCE = 512
_CHUNK_BYTES = 64 * 2**20
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
        return _one_by_one(graph, inputs, tuple(seeds), engine, dtype, init, kept, progress, passes)
    if engine == "xla":
        return _vectorised(graph, inputs, tuple(seeds), dtype, init, kept, runs_at_once, progress, passes)
    if engine == "c":
        from flowgraph.c.batch import threaded

        return threaded(graph, inputs, tuple(seeds), dtype, init, kept, progress, passes)
    return _one_by_one(graph, inputs, tuple(seeds), engine, dtype, init, kept, progress, passes)


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


def _one_by_one(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], engine: str, dtype: str, init: Any,
    kept: dict[str, list[str]], progress: Meter | None, passes: Collection[str] | None,
) -> Batch:  # fmt: skip
    from flowgraph.simulate import simulate

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


def _vectorised(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], dtype: str, init: Any,
    kept: dict[str, list[str]], runs_at_once: int, progress: Meter | None, passes: Collection[str] | None,
) -> Batch:  # fmt: skip
    from flowgraph.xla import Scan, bytes_per_tick, import_jax

    import_jax()
    real = np.dtype(dtype)
    whole = lower(graph, dtype=dtype)
    pipeline = _pruned(whole, kept)
    shared = is_shared(inputs)
    first = tape(prepare(graph, of_run(inputs, 0, seeds[0])), graph)
    if not len(first.time):  # nothing to compile for
        nothing = _one_by_one(graph, inputs, seeds, "reference", dtype, init, kept, progress, None)
        return replace(nothing, engine="xla")
    keys = tuple(int(k) for k in np.unique(first.key))
    per_tick = runs_at_once * bytes_per_tick(pipeline)
    ticks = max(1, min(_TICKS_AT_ONCE, len(first.time), _CHUNK_BYTES // max(per_tick, 1)))
    chosen = for_engine("xla", passes)
    if init is not None:
        chosen = without("symmetry", passes=chosen)  # it relies on the values at reset
    which = (keys, real.name, ticks, runs_at_once, shared, repr(kept), tuple(chosen))
    compiled: dict[Any, Scan] = whole.__dict__.setdefault("_batched", {})  # they live as long as it does
    if which not in compiled:
        compiled[which] = Scan(pipeline, keys, real, ticks, runs=runs_at_once, shared=shared, passes=chosen)
    scan = compiled[which]
    dense_first = _columns([first], True, real)
    chunks: list[list[Chunk]] = []
    wall = 0.0
    for n, members in enumerate(_chunks(len(seeds), runs_at_once)):
        columns = (
            dense_first if shared else _columns(_tapes(graph, inputs, seeds, members, first), False, real)
        )
        last = cells = _cells_of(graph, init, seeds, members)
        words = np.stack([seed_words(seeds[k]) for k in members])
        scan.compile(cells, words, columns)
        start = perf_counter()
        parts = []
        for part, after in scan(cells, words, first.time, first.key, columns):
            parts.append(_without_absent(part))
            last = after
        wall += perf_counter() - start
        chunks.append(parts)
        done = min((n + 1) * runs_at_once, len(seeds))
        for row in range(done - n * runs_at_once):
            check_faults(pipeline, [cell[row] for cell in last])
        if progress is not None:
            progress.update(done, 0)
    series = {
        port.name: _collected(port, k, first.time, chunks, len(seeds))
        for k, port in enumerate(pipeline.outputs)
    }
    return Batch(graph.name, "xla", seeds, series, len(first.time), wall)


def _pruned(pipeline: Pipeline, kept: dict[str, list[str]]) -> Pipeline:
    ports = tuple(
        replace(port, leaves=tuple(leaf for leaf in port.leaves if leaf.name in kept[port.name]))
        for port in pipeline.outputs
        if port.name in kept
    )
    return replace(pipeline, outputs=ports)


def _chunks(count: int, size: int) -> Iterator[tuple[int, ...]]:
    """Places of runs in chunks of one size; the last is filled up with its last run."""
    for start in range(0, count, size):
        part = tuple(range(start, min(start + size, count)))
        yield part + (part[-1],) * (size - len(part))


def _tapes(
    graph: Graph, inputs: Any, seeds: tuple[int, ...], members: tuple[int, ...], first: Tape
) -> list[Tape]:
    made: dict[int, Tape] = {}
    for run in members:
        if run not in made:
            made[run] = tape(prepare(graph, of_run(inputs, run, seeds[run])), graph)
            _same_ticks(graph, first, made[run], seeds[run])
    return [made[run] for run in members]


def _same_ticks(graph: Graph, first: Tape, other: Tape, seed: int) -> None:
    if np.array_equal(first.time, other.time) and np.array_equal(first.key, other.key):
        return
    raise DataError(
        "runs in one batch must have their events at the same times",
        path=f"{graph.name}, seed {seed}",
        expected=f"the {len(first.time)} ticks of the first run",
        got=f"{len(other.time)} ticks, or others",
        fix='run them one by one: engine="python", or a simulate(...) each',
    )


def initial_cells(graph: Graph, init: Any) -> list[np.ndarray]:
    """The register cells that a run starts from."""
    slots = initial_registers(graph, init)
    return [np.asarray(leaf) for index, node in graph.registers for leaf in flatten(slots[index], node.type)]


def _cells_of(graph: Graph, init: Any, seeds: tuple[int, ...], members: tuple[int, ...]) -> list[np.ndarray]:
    """Register cells with a leading axis of runs."""
    made = {run: initial_cells(graph, of_run(init, run, seeds[run])) for run in set(members)}
    return [np.stack(column) for column in zip(*(made[run] for run in members), strict=True)]


def _columns(tapes: list[Tape], shared: bool, real: Any) -> list[list[np.ndarray]]:
    """Dense leaves of each input; with a leading axis of runs where inputs differ."""
    made = [
        [
            [dense(leaf, (t.key >> k & 1).astype(bool)) for leaf in real_leaves(s, real)]
            for k, s in enumerate(t.series)
        ]
        for t in tapes
    ]
    if shared:
        return made[0]
    return [[np.stack(leaves) for leaves in zip(*ports, strict=True)] for ports in zip(*made, strict=True)]


def _without_absent(part: Chunk) -> Chunk:
    """The chunk without the ticks at which an output is known to be absent in all runs."""
    outputs = [
        (mask, leaves if mask.ndim > 1 or mask.all() else [leaf[:, mask] for leaf in leaves])
        for mask, leaves in part.outputs
    ]
    return replace(part, outputs=outputs)


def _collected(port: Port, k: int, time: np.ndarray, chunks: list[list[Chunk]], runs: int) -> Runs:
    """One output of all runs, at the ticks in which it is present in any."""

    def joined(pick: Callable[[Chunk], np.ndarray]) -> np.ndarray:
        rows = [np.concatenate([pick(part) for part in parts], axis=1) for parts in chunks]
        return (rows[0] if len(rows) == 1 else np.concatenate(rows))[:runs]

    masks = [part.outputs[k][0] for part in chunks[0]]
    if all(mask.ndim == 1 for mask in masks):  # the same in all runs, and already left out where absent
        some: np.ndarray = np.concatenate(masks)
        present = np.ones((runs, int(some.sum())), dtype=bool)
        leaves = {leaf.name: joined(lambda p, n=n: p.outputs[k][1][n]) for n, leaf in enumerate(port.leaves)}  # type: ignore[misc]
        return Runs(port.name, time[some], present, leaves)
    present = joined(lambda part: part.outputs[k][0])
    some = np.asarray(present.any(axis=0))
    leaves = {
        leaf.name: joined(lambda p, n=n: p.outputs[k][1][n])[:, some]  # type: ignore[misc]
        for n, leaf in enumerate(port.leaves)
    }
    return Runs(port.name, time[some], present[:, some], leaves)


def leaf_type(array: np.ndarray) -> Any:
    return ArrayType(array.shape[1:], dtype_name(array))
