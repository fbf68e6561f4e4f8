"""Playing a lowered pipeline over recorded events, in the reference interpreter or in XLA.

Works from the description alone: a pipeline read from disk needs no graph and no block to be importable.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.clock import Timing
from flowgraph.errors import DataError, FifoOverflowError, UnknownNameError
from flowgraph.graph import NEVER, Graph
from flowgraph.inputs import Inputs, Tape, check_finite, check_times, prepare, tape
from flowgraph.lowering import lower
from flowgraph.pipeline import Pipeline, type_of_leaves
from flowgraph.random import seed_words
from flowgraph.reference import Player
from flowgraph.result import Result
from flowgraph.run import Meter
from flowgraph.series import Series
from flowgraph.state import initial_registers, load_registers
from flowgraph.types import DTYPES, Type, as_value, flatten, unflatten

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
) -> Result:
    """Lower a graph and play it; the result has the graph's own signal types."""
    pipeline = lower(graph)
    if state is None:
        slots, last = initial_registers(graph, init), dict.fromkeys(graph.sources, NEVER)
    else:
        slots, last, seed = load_registers(graph, state)
    cells = [leaf for index, node in graph.registers for leaf in flatten(slots[index], node.type)]
    events = tape(prepare(graph, inputs, last), graph)
    types = [graph.port(c.wire).type for c in graph.collected]
    return _result(pipeline, events, cells, last, types, engine, dtype, seed, progress)


def run_pipeline(
    pipeline: Pipeline,
    inputs: Mapping[str, Any],
    *,
    engine: str = "reference",
    dtype: str = "float64",
    init: Mapping[str, Any] | None = None,
    state: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Meter | None = None,
) -> Result:
    """Play a pipeline without its graph; see `Pipeline.run`."""
    if engine not in ("reference", "xla"):
        raise UnknownNameError("engine of a pipeline", engine, ("reference", "xla"))
    if dtype not in ("float64", "float32"):
        raise UnknownNameError("dtype", dtype, ("float64", "float32"))
    names = [p.name for p in pipeline.inputs]
    for name in inputs:
        if name not in names:
            raise UnknownNameError("input", name, names, path=pipeline.name)
    series = tuple(_input(pipeline, port, inputs) for port in pipeline.inputs)
    cells = _initial_cells(pipeline, init, state)
    seed = seed if state is None else int(state["seed"])
    last = dict.fromkeys(names, NEVER) if state is None else {n: int(state["sources"][n]) for n in names}
    types = [type_of_leaves(p.type, p.leaves) for p in pipeline.outputs]
    return _result(pipeline, Tape.of(series), cells, last, types, engine, dtype, seed, progress)


def _input(pipeline: Pipeline, port: Any, inputs: Mapping[str, Any]) -> Series:
    if port.name not in inputs:
        raise DataError(
            f"input {port.name!r} has no data",
            path=pipeline.name,
            expected=f"events of {port.type}",
            got=", ".join(inputs) or "no inputs",
            fix=f"pass {{{port.name!r}: Series(time, values)}}",
        )
    value = inputs[port.name]
    type_ = type_of_leaves(port.type, port.leaves)
    if isinstance(value, Series):
        arrays: Mapping[str, Any] = value.leaves
        time = value.time
    else:
        time, values = value
        arrays = values if isinstance(values, Mapping) else {"value": values}
    if list(arrays) != [leaf.name for leaf in port.leaves]:
        raise DataError(
            f"input {port.name!r} has other fields",
            path=pipeline.name,
            expected=", ".join(leaf.name for leaf in port.leaves),
            got=", ".join(arrays),
            fix="give these fields, in this order",
        )
    series = Series(
        time, unflatten(type_, iter([np.asarray(a) for a in arrays.values()])), type=type_, name=port.name
    )
    check_finite(port.name, series)
    check_times(port.name, series.time, Timing())
    return series


def _initial_cells(
    pipeline: Pipeline, init: Mapping[str, Any] | None, state: Mapping[str, Any] | None
) -> list[Any]:
    paths = {r.path: r for r in pipeline.registers}
    given: dict[str, Any] = dict(init or {}) if state is None else dict(state["registers"])
    for path in given:
        if path not in paths:
            raise UnknownNameError("register", path, paths, path=pipeline.name)
    absent = sorted(set(paths) - set(given)) if state is not None else []
    if absent:
        raise DataError(
            "this state is of another pipeline",
            path=pipeline.name,
            expected=f"registers {sorted(paths)}",
            got=f"none called {absent[0]!r}",
            fix="resume a run with the pipeline that it was saved from",
        )
    cells: list[Any] = []
    for register in pipeline.registers:
        type_ = type_of_leaves(register.path, register.cells)
        if register.path in given:
            value = given[register.path]
            if not isinstance(value, Mapping):
                value = dict(zip((c.name for c in register.cells), [value], strict=True))
            missing = [c.name for c in register.cells if c.name not in value]
            if missing:
                raise UnknownNameError("field", missing[0], value, path=register.path)
            leaves = [value[c.name] for c in register.cells]
            cells.extend(flatten(as_value(unflatten(type_, iter(leaves)), type_, path=register.path), type_))
        else:
            cells.extend(c.reset for c in register.cells)
    return cells


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
) -> Result:
    real = np.dtype(dtype)
    outcome = (_reference if engine == "reference" else _xla)(
        pipeline, events, cells, real, seed_words(seed), progress
    )
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
    pipeline: Pipeline, events: Tape, cells: list[Any], real: Any, seed: np.ndarray, progress: Meter | None
) -> _Outcome:
    player = Player(
        pipeline, [c.astype(real) if np.asarray(c).dtype.kind == "f" else c for c in cells], real, seed
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
    pipeline: Pipeline, events: Tape, cells: list[Any], real: Any, seed: np.ndarray, progress: Meter | None
) -> _Outcome:
    from flowgraph.xla import Scan, chunk_size, import_jax

    import_jax()
    keys = events.patterns
    chunk = chunk_size(pipeline, len(events.time))
    which = (keys, real.name, chunk)
    compiled: dict[Any, Scan] = _compiled(pipeline)
    if which not in compiled:
        compiled[which] = Scan(pipeline, keys, real, chunk)
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
    outputs = []
    for port, kept in zip(pipeline.outputs, parts, strict=True):
        count = sum(len(t) for t, _ in kept)
        times = events.time if count == len(events.time) else np.concatenate([t for t, _ in kept])
        arrays = [
            np.concatenate([leaves[k] for _, leaves in kept])
            if kept
            else np.zeros((0, *leaf.shape), DTYPES[leaf.dtype])
            for k, leaf in enumerate(port.leaves)
        ]
        outputs.append((times, arrays))
    return _Outcome(cells, outputs, wall)


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
