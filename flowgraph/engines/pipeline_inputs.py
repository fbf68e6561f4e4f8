"""What a pipeline is fed when its graph is not there: events and initial values, by the names it knows.

A description holds names, shapes and kinds of numbers, but no signal types. So events are taken from any
signal, tuple or mapping that has the right leaves, and are then checked as those of a graph are.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from flowgraph.data.arrival import with_stamps
from flowgraph.data.flight import Flight
from flowgraph.data.inputs import prepare
from flowgraph.data.series import Series
from flowgraph.data.tape import Tape, tape
from flowgraph.engines.state import check_settable
from flowgraph.errors import ClockError, DataError, UnknownNameError
from flowgraph.language.clock import Source, Timing
from flowgraph.language.graph import NEVER, Graph, SourceNode
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline, Port, type_of_leaves
from flowgraph.types import ArrayType, as_value, dtype_name, flatten, leaves_of, type_of, unflatten


def events_of(pipeline: Pipeline, inputs: Any, last: Mapping[str, int] | None = None) -> Tape:
    """Recorded events as the pipeline plays them, checked as for a graph.

    Args:
        inputs: as for `Pipeline.run`.
        last: time of the last event of each input, where a run goes on.

    Raises:
        ClockError, DataError, UnknownNameError: naming the input that does not suit.
    """
    graph = input_graph(pipeline)
    before = dict.fromkeys(graph.sources, NEVER) if last is None else last
    events = tape(prepare(graph, given_events(pipeline, inputs), before), graph)
    check_together(pipeline, events)
    return events


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


def input_graph(pipeline: Pipeline) -> Graph:
    """A graph of the inputs alone, with their types and timing, so that events are checked as for a graph."""
    nodes = tuple(
        SourceNode(p.name, type_of_leaves(p.type, p.leaves), Source(p.name, p.timing or Timing()))
        for p in pipeline.inputs
    )
    return Graph(pipeline.name, "", nodes, tuple(range(len(nodes))), (), ())


def given_events(pipeline: Pipeline, inputs: Any) -> dict[str, Any]:
    """Events of each input, with values as the pipeline knows them: arrays by the names of their leaves."""
    if not isinstance(inputs, Flight | Mapping):
        raise DataError(
            "these inputs have no names",
            path=pipeline.name,
            expected="a Flight, or a mapping from input to events",
            got=type(inputs).__name__,
            fix=f"pass {{{', '.join(repr(p.name) + ': ...' for p in pipeline.inputs)}}}",
        )
    given: Mapping[str, Any] = inputs.streams if isinstance(inputs, Flight) else inputs
    names = [p.name for p in pipeline.inputs]
    for name in given if inputs is given else ():
        if name not in names:
            raise UnknownNameError("input", name, names, path=pipeline.name)
    given = with_stamps(names, given)
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


def cells_at_start(pipeline: Pipeline, init: Mapping[str, Any] | None) -> list[Any]:
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
