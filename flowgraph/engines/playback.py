"""Playing a lowered pipeline over recorded events, in the reference interpreter, in XLA or in C.

Works from the description alone: a pipeline read from disk needs no graph and no block to be importable.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.pipeline_inputs import cells_at_start, events_of
from flowgraph.engines.python.run import Meter
from flowgraph.engines.reference import Player
from flowgraph.engines.state import check_start, initial_registers, load_registers, read_tree
from flowgraph.errors import FifoOverflowError, UnknownNameError
from flowgraph.language.graph import NEVER, Graph
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.optimise import for_engine, usable
from flowgraph.pipeline.pipeline import Pipeline, type_of_leaves
from flowgraph.recorder.random import seed_words
from flowgraph.types import (
    DTYPES,
    Type,
    flatten,
    unflatten,
)

_METER_TICKS = 2048


@dataclass(frozen=True)
class _Outcome:
    cells: list[Any]
    outputs: list[tuple[np.ndarray, list[np.ndarray]]]
    wall_s: float


def play(
    graph: Graph,
    inputs: Inputs,
    *,
    engine: str,
    dtype: str,
    init: Any,
    state: Any,
    seed: int,
    progress: Meter | None,
    passes: Collection[str] | None = None,
) -> Result:
    """Lower a graph and play it; the result has the graph's own signal types."""
    check_start(init, state, path=graph.name)
    pipeline = lower(graph)
    if pipeline.host:
        from flowgraph.engines.cut_run import play_parts

        return play_parts(
            graph, inputs, engine=engine, dtype=dtype, init=init, state=state, seed=seed, progress=progress,
            passes=passes,
        )  # fmt: skip
    if state is None:
        slots, last = initial_registers(graph, init), dict.fromkeys(graph.sources, NEVER)
    else:
        slots, last, seed = load_registers(graph, state)
    cells = [leaf for index, node in graph.registers for leaf in flatten(slots[index], node.type)]
    events = tape(prepare(graph, inputs, last), graph)
    types = [graph.port(c.wire).type for c in graph.collected]
    return _result(pipeline, events, cells, last, types, engine, dtype, seed, progress, passes)


def run_pipeline(
    pipeline: Pipeline,
    inputs: Inputs,
    *,
    engine: str = "reference",
    dtype: str = "float64",
    init: Mapping[str, Any] | None = None,
    state: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Meter | None = None,
    passes: Collection[str] | None = None,
) -> Result:
    """Play a pipeline without its graph; see `Pipeline.run`."""
    if engine not in _ENGINES:
        raise UnknownNameError("engine of a pipeline", engine, _ENGINES)
    if dtype not in ("float64", "float32"):
        raise UnknownNameError("dtype", dtype, ("float64", "float32"))
    check_start(init, state, path=pipeline.name)
    names = [p.name for p in pipeline.inputs]
    if state is None:
        cells, last = cells_at_start(pipeline, init), dict.fromkeys(names, NEVER)
    else:
        held = {r.path: type_of_leaves(r.path, r.cells) for r in pipeline.registers}
        found, last, seed = read_tree(state, held, names, name=pipeline.name, of="pipeline")
        cells = [leaf for r in pipeline.registers for leaf in found[r.path]]
    events = events_of(pipeline, inputs, last)
    types = [type_of_leaves(p.type, p.leaves) for p in pipeline.outputs]
    return _result(pipeline, events, cells, last, types, engine, dtype, seed, progress, passes)


def _result(
    pipeline: Pipeline,
    events: Tape,
    cells: list[Any],
    last: dict[str, int],
    types: list[Type],
    engine: str,
    dtype: str,
    seed: int,
    progress: Meter | None,
    passes: Collection[str] | None,
) -> Result:
    pipeline.need_numbers(dtype)
    real = np.dtype(dtype)
    chosen = usable(pipeline, for_engine(engine, passes), cells)
    outcome = _ENGINES[engine](pipeline, events, cells, real, seed_words(seed), progress, chosen)
    check_faults(pipeline, outcome.cells)
    series = {}
    for port, type_, (times, leaves) in zip(pipeline.outputs, types, outcome.outputs, strict=True):
        series[port.name] = Series(times, unflatten(type_, iter(leaves)), type=type_, name=port.name)
    for name, s in zip(last, events.series, strict=True):
        last[name] = int(s.time[-1]) if len(s) else last[name]
    state = _state(pipeline, outcome.cells, last, seed)
    stats = {
        f"{f.path}.{name}": int(count)
        for f in pipeline.faults
        for name, count in state["registers"][f.register].items()
        if name.startswith("expired")
    }
    return Result(pipeline.name, engine, series, state, stats, len(events.time), outcome.wall_s)


def _state(pipeline: Pipeline, cells: list[Any], last: Mapping[str, int], seed: int) -> dict[str, Any]:
    values = iter(cells)
    registers: dict[str, Any] = {}
    for register in pipeline.registers:
        parts: dict[str, np.ndarray] = {
            c.name: np.asarray(next(values)).astype(DTYPES[c.dtype]) for c in register.cells
        }
        registers[register.path] = parts["value"] if list(parts) == ["value"] else parts
    return {
        "registers": registers,
        "sources": {n: np.asarray(t, dtype=np.int64) for n, t in last.items()},
        "seed": np.asarray(seed, dtype=np.uint64),
    }


def check_faults(pipeline: Pipeline, cells: list[Any]) -> None:
    values = iter(cells)
    found = {(r.path, c.name): next(values) for r in pipeline.registers for c in r.cells}
    for fault in pipeline.faults:
        time = int(found[fault.register, fault.cell])
        if time != NEVER:
            raise FifoOverflowError(
                fault.message,
                path=fault.path,
                expected=f"at most {fault.bound} waiting values of one stream",
                got=f"one more at t = {time} ns",
                fix="raise size=, or look why the other stream is silent",
            )


def real_leaves(series: Series, real: Any) -> list[np.ndarray]:
    return [a.astype(real, copy=False) if a.dtype.kind == "f" else a for a in series.leaves.values()]


def _reference(
    pipeline: Pipeline, events: Tape, cells: list[Any], real: Any, seed: np.ndarray, progress: Meter | None,
    passes: tuple[str, ...],
) -> _Outcome:  # fmt: skip
    player = Player(
        pipeline,
        [c.astype(real) if np.asarray(c).dtype.kind == "f" else c for c in cells],
        real,
        seed,
        passes,
    )
    rows = [_rows(real_leaves(s, real)) for s in events.series]
    outputs: list[tuple[list[int], list[tuple[Any, ...]]]] = [([], []) for _ in pipeline.outputs]
    start = perf_counter()
    with np.errstate(all="ignore"):
        for n, (time, key) in enumerate(zip(events.time.tolist(), events.key.tolist(), strict=True)):
            values = [next(row) for k, row in enumerate(rows) if key >> k & 1]
            for (times, kept), leaves in zip(outputs, player.tick(time, key, values), strict=True):
                if leaves is not None:
                    times.append(time)
                    kept.append(leaves)
            if progress is not None and ((n + 1) % _METER_TICKS == 0 or n + 1 == len(events.time)):
                progress.update(n + 1, time)
    wall = perf_counter() - start
    stacked = []
    for port, (times, kept) in zip(pipeline.outputs, outputs, strict=True):
        columns: Iterable[Any] = zip(*kept, strict=True) if kept else [[] for _ in port.leaves]
        arrays: list[np.ndarray] = [
            np.asarray(column, dtype=DTYPES[leaf.dtype]).reshape(len(times), *leaf.shape)
            for column, leaf in zip(columns, port.leaves, strict=True)
        ]
        stacked.append((np.asarray(times, dtype=np.int64), arrays))
    return _Outcome(player.cells, stacked, wall)


def _rows(leaves: list[np.ndarray]) -> Iterator[tuple[Any, ...]]:
    return zip(*leaves, strict=True)


def _xla(
    pipeline: Pipeline, events: Tape, cells: list[Any], real: Any, seed: np.ndarray, progress: Meter | None,
    passes: tuple[str, ...],
) -> _Outcome:  # fmt: skip
    from flowgraph.engines.xla.scan import Scan, chunk_size, import_jax

    import_jax()
    keys = events.patterns
    chunk = chunk_size(pipeline, len(events.time))
    which = (keys, real.name, chunk, passes)
    compiled: dict[Any, Scan] = _compiled(pipeline)
    if which not in compiled:
        compiled[which] = Scan(pipeline, keys, real, chunk, passes=passes)
    columns = []
    for k, series in enumerate(events.series):
        leaves = real_leaves(series, real)
        everywhere = len(series) == len(events.time)
        columns.append(leaves if everywhere else [dense(x, events.key & (1 << k) != 0) for x in leaves])
    scan = compiled[which]
    scan.compile(cells, seed, columns)
    parts: list[list[tuple[np.ndarray, list[np.ndarray]]]] = [[] for _ in pipeline.outputs]
    done = 0
    start = perf_counter()
    for part, after in scan(cells, seed, events.time, events.key, columns):
        cells = after
        times = events.time[done : done + part.ticks]
        for kept, (mask, leaves) in zip(parts, part.outputs, strict=True):
            kept.append((times, leaves) if mask.all() else (times[mask], [leaf[mask] for leaf in leaves]))
        done += part.ticks
        if progress is not None:
            progress.update(done, int(times[-1]))
    wall = perf_counter() - start
    return _Outcome(cells, _joined(pipeline, parts, events), wall)


def _c(
    pipeline: Pipeline, events: Tape, cells: list[Any], real: Any, seed: np.ndarray, progress: Meter | None,
    passes: tuple[str, ...],
) -> _Outcome:  # fmt: skip
    from flowgraph.engines.c.engine import compiled

    library = compiled(pipeline, real, events.patterns, passes)
    rows = library.rows([real_leaves(s, real) for s in events.series])
    parts: list[list[tuple[np.ndarray, list[np.ndarray]]]] = [[] for _ in pipeline.outputs]
    done = 0
    start = perf_counter()
    for part, after in library.play(cells, seed, events.time, events.key, rows):
        cells = after
        times = events.time[done : done + part.ticks]
        for kept, (mask, leaves) in zip(parts, part.outputs, strict=True):
            kept.append((times[mask], leaves))
        done += part.ticks
        if progress is not None:
            progress.update(done, int(times[-1]))
    wall = perf_counter() - start
    return _Outcome(cells, _joined(pipeline, parts, events), wall)


def _joined(
    pipeline: Pipeline, parts: list[list[tuple[np.ndarray, list[np.ndarray]]]], events: Tape
) -> list[tuple[np.ndarray, list[np.ndarray]]]:
    """Stretches of each output in one."""
    outputs = []
    for port, kept in zip(pipeline.outputs, parts, strict=True):
        count = sum(len(t) for t, _ in kept)
        whole = count == len(events.time)
        times = events.time if whole else np.concatenate([t for t, _ in kept])
        arrays = [
            np.concatenate([leaves[k] for _, leaves in kept])
            if kept
            else np.zeros((0, *leaf.shape), DTYPES[leaf.dtype])
            for k, leaf in enumerate(port.leaves)
        ]
        outputs.append((times, arrays))
    return outputs


_ENGINES = {"reference": _reference, "xla": _xla, "c": _c}


def _compiled(pipeline: Pipeline) -> dict[Any, Any]:
    """Scans compiled for a pipeline; they live as long as it does."""
    kept: dict[Any, Any] = pipeline.__dict__.setdefault("_scans", {})
    return kept


def dense(leaf: np.ndarray, at: np.ndarray) -> np.ndarray:
    if len(leaf) == len(at):
        return leaf
    full = np.zeros((len(at), *leaf.shape[1:]), leaf.dtype)
    full[at] = leaf
    return full
