"""Playing a lowered pipeline over recorded events, in the reference interpreter, in XLA or in C.

Works from the description alone: a pipeline read from disk needs no graph and no block to be importable.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np

from flowgraph.clock import Source, Timing
from flowgraph.errors import ClockError, DataError, FifoOverflowError, UnknownNameError
from flowgraph.graph import NEVER, Graph, SourceNode
from flowgraph.inputs import Inputs, Tape, prepare, tape
from flowgraph.lowering import lower
from flowgraph.optimise import for_engine, usable
from flowgraph.pipeline import Cell, Leaf, Pipeline, Port, type_of_leaves
from flowgraph.random import seed_words
from flowgraph.reference import Player
from flowgraph.result import Result
from flowgraph.run import Meter
from flowgraph.series import Flight, Series
from flowgraph.state import check_settable, check_start, initial_registers, load_registers, read_tree
from flowgraph.types import (
    DTYPES,
    ArrayType,
    Type,
    as_value,
    dtype_name,
    flatten,
    leaves_of,
    type_of,
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
        from flowgraph.cut_run import play_parts

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
    sources = _sources(pipeline)
    names = [p.name for p in pipeline.inputs]
    if state is None:
        cells, last = _initial_cells(pipeline, init), dict.fromkeys(names, NEVER)
    else:
        held = {r.path: type_of_leaves(r.path, r.cells) for r in pipeline.registers}
        found, last, seed = read_tree(state, held, names, name=pipeline.name, of="pipeline")
        cells = [leaf for r in pipeline.registers for leaf in found[r.path]]
    events = tape(prepare(sources, _inputs(pipeline, inputs), last), sources)
    check_together(pipeline, events)
    types = [type_of_leaves(p.type, p.leaves) for p in pipeline.outputs]
    return _result(pipeline, events, cells, last, types, engine, dtype, seed, progress, passes)


def check_together(pipeline: Pipeline, events: Tape) -> None:
    """Refuse recordings of inputs of one clock, such as two outputs of a host block, that come apart.

    The pipeline was made for inputs that are present together: which of them enables a stage is not said.

    Raises:
        ClockError: naming both inputs and the first time at which one comes without the other.
    """
    first: dict[str, int] = {}
    for k, port in enumerate(pipeline.inputs):
        other = first.setdefault(port.clock, k)
        if not np.array_equal(events.series[other].time, events.series[k].time):
            alone = np.setxor1d(events.series[other].time, events.series[k].time)
            there = port.name if np.isin(alone[0], events.series[k].time) else pipeline.inputs[other].name
            raise ClockError(
                f"{pipeline.inputs[other].name!r} and {port.name!r} have one clock and come apart",
                path=f"{pipeline.name}, input {port.name}",
                expected=f"equal stamps of both: their clock is {port.clock}",
                got=f"only {there!r} at t = {int(alone[0])} ns, the first of {len(alone)} such times",
                fix="give both the stamps of the events that they are made of",
            )


def sources_of(pipeline: Pipeline, inputs: Any) -> tuple[Graph, dict[str, Any]]:
    """A graph of a pipeline's inputs alone, and recorded events as it takes them."""
    return _sources(pipeline), _inputs(pipeline, inputs)


def _sources(pipeline: Pipeline) -> Graph:
    """A graph of the inputs alone, with their types and timing, so that events are checked as for a graph."""
    nodes = tuple(
        SourceNode(p.name, type_of_leaves(p.type, p.leaves), Source(p.name, p.timing or Timing()))
        for p in pipeline.inputs
    )
    return Graph(pipeline.name, "", nodes, tuple(range(len(nodes))), (), ())


def _inputs(pipeline: Pipeline, inputs: Any) -> dict[str, Any]:
    """Events of each input, with values as the pipeline knows them: arrays by the names of their leaves."""
    if not isinstance(inputs, Flight | Mapping):
        raise DataError(
            "these inputs have no names",
            path=pipeline.name,
            expected="a Flight, or a mapping from input to events",
            got=type(inputs).__name__,
            fix=f"pass {{{', '.join(repr(p.name) + ': ...' for p in pipeline.inputs)}}}",
        )
    given = inputs.streams if isinstance(inputs, Flight) else inputs
    names = [p.name for p in pipeline.inputs]
    for name in given if inputs is given else ():
        if name not in names:
            raise UnknownNameError("input", name, names, path=pipeline.name)
    found: dict[str, Any] = {}
    for port in pipeline.inputs:
        if port.name not in given:
            maker = next((h for h in pipeline.host if port.name in h.feeds), None)
            made = "" if maker is None else f", made on the host by {maker.path} ({maker.line})"
            whole = "" if maker is None else ", or simulate the graph, which runs its host blocks too"
            raise DataError(
                f"input {port.name!r} has no data",
                path=pipeline.name,
                expected=f"events of {port.type}{made}",
                got=", ".join(given) or "no inputs",
                fix=f"pass {{{port.name!r}: Series(time, values)}}{whole}",
            )
        value = given[port.name]
        if isinstance(value, Series) or (isinstance(value, tuple) and len(value) == 2):
            found[port.name] = _recorded(pipeline, port, value)
        else:
            found[port.name] = _events(pipeline, port, value) if isinstance(value, Iterable) else value
    return found


def _recorded(pipeline: Pipeline, port: Port, value: Any) -> Series:
    """A series whose type is a plain struct of the port's leaves."""
    where = f"{pipeline.name}, input {port.name}"
    gaps = False
    if isinstance(value, tuple) and not isinstance(value[1], Mapping):
        value = Series(value[0], value[1], name=port.name)
    if isinstance(value, Series):
        time, arrays, gaps = value.time, value.leaves, value.gaps
        kinds = dict(leaves_of(value.type))
    else:
        time, arrays = value[0], {n: np.asarray(a) for n, a in _flat(value[1]).items()}
        kinds = {n: ArrayType(a.shape[1:], dtype_name(a)) for n, a in arrays.items()}
    _check_fields(arrays, [leaf.name for leaf in port.leaves], f"input {port.name!r}", where)
    leaves = []
    for leaf in port.leaves:
        given = kinds[leaf.name]
        kind = "real" if leaf.dtype == "real" and given.dtype != "bool" else given.dtype
        leaves.append(Leaf(leaf.name, 0, _sizes(given), kind, given.unit, given.frame))
    type_ = type_of_leaves(port.type, tuple(leaves))
    values = unflatten(type_, iter([arrays[leaf.name] for leaf in port.leaves]))
    return Series(time, values, type=type_, name=port.name, gaps=gaps)


def _sizes(type_: ArrayType) -> tuple[int, ...]:
    return tuple(n for n in type_.shape if isinstance(n, int))


def _events(pipeline: Pipeline, port: Port, events: Iterable[Any]) -> Iterator[Any]:
    """Events one by one; what is no pair is passed on, to be refused with all else that is wrong."""
    for event in events:
        if isinstance(event, tuple) and len(event) == 2:
            where = f"{pipeline.name}, input {port.name}"
            yield event[0], _value(event[1], port.type, port.leaves, f"input {port.name!r}", where)
        else:
            yield event


def _value(value: Any, name: str, leaves: tuple[Leaf, ...] | tuple[Cell, ...], what: str, where: str) -> Any:
    """One value, from a signal, a tuple, a mapping or an array with these leaves."""
    if isinstance(value, Mapping):
        parts = _flat(value)
    else:
        type_ = type_of(value)
        parts = dict(zip((n for n, _ in leaves_of(type_)), flatten(value, type_), strict=True))
    _check_fields(parts, [leaf.name for leaf in leaves], what, where)
    made = []
    for leaf in leaves:
        array = np.asarray(parts[leaf.name])
        made.append(array.astype(np.float64) if leaf.dtype == "real" and array.dtype.kind in "iu" else array)
    return unflatten(type_of_leaves(name, leaves), iter(made))


def _flat(value: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Leaves of nested mappings by dotted name."""
    found: dict[str, Any] = {}
    for name, part in value.items():
        found.update(
            _flat(part, f"{prefix}{name}.") if isinstance(part, Mapping) else {f"{prefix}{name}": part}
        )
    return found


def _check_fields(given: Mapping[str, Any], wanted: list[str], what: str, where: str) -> None:
    if set(given) != set(wanted):
        raise DataError(
            f"{what} has other fields",
            path=where,
            expected=", ".join(wanted),
            got=", ".join(map(str, given)),
            fix="give these fields",
        )


def _initial_cells(pipeline: Pipeline, init: Mapping[str, Any] | None) -> list[Any]:
    roles = {r.path: r.role for r in pipeline.registers}
    given = init or {}
    for path in given:
        check_settable(path, roles, graph=pipeline.name)
    cells: list[Any] = []
    for register in pipeline.registers:
        if register.path in given:
            path, type_ = register.path, type_of_leaves(register.path, register.cells)
            value = _value(
                given[path], path, register.cells, f"the value of {path!r}", f"{pipeline.name}, {path}"
            )
            cells.extend(flatten(as_value(value, type_, path=path), type_))
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
    from flowgraph.xla import Scan, chunk_size, import_jax

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
    from flowgraph.c.engine import compiled

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
