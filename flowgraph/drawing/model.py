"""A graph as a page draws it: names, ports, wires and what is to be known of each, in lists and texts.

A page lays itself out, since what is unfolded in it changes. So it is given no places but the graph: which
nodes stand in which nested graph, what flows between them and when, and for each node what a reader asks of
it: the type of a port with unit and frame, a clock and its rate, what is remembered and from which value on,
the settings, the docstring with its equations and their source, and the line in which the block is written.
Everything is text or a number; nothing in it is HTML.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.arrival import lateness_words
from flowgraph.data.flight import Flight
from flowgraph.drawing.text import (
    block_words,
    clock_words,
    firing_words,
    initial_words,
    links,
    name_in,
    queue_words,
    scope_of,
    shorten,
    triggers,
    type_words,
)
from flowgraph.language.block import Block
from flowgraph.language.clock import AnyOf, Clock, Source, atoms
from flowgraph.language.graph import CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.types import Signal, Type, flatten, leaves_of, type_of

LONGEST = 400
"""Characters of a setting or an initial value that are shown."""


def describe(
    graph: Graph,
    costs: Mapping[str, Mapping[str, Any]] | None = None,
    inputs: Flight | Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """The graph in plain lists and texts, as `front/src/model.ts` declares them.

    Args:
        costs: of the lowered graph, by path of a block or register, what is to be shown there; under "" that
            of the whole.
        inputs: what the sources are fed, which may arrive late.
    """
    return _Description(graph, costs or {}, lateness_words(inputs)).whole()


class _Description:
    def __init__(
        self, graph: Graph, costs: Mapping[str, Mapping[str, Any]], lateness: Mapping[str, str]
    ) -> None:
        self.graph, self.costs, self.lateness = graph, costs, lateness
        self.types: dict[str, int] = {}
        self.type_list: list[dict[str, Any]] = []
        self.clocks: dict[Clock | frozenset[Clock], int] = {}
        self.clock_list: list[dict[str, Any]] = []

    def whole(self) -> dict[str, Any]:
        graph = self.graph
        nodes = [self.node(index) for index in range(len(graph.nodes))]
        edges = [
            {
                "from": link.tail, "out": link.output, "to": link.head, "port": link.port,
                "optional": link.optional, "feedback": link.feedback, "fires": False,
            }
            for link in links(graph)
        ]  # fmt: skip
        for collected in graph.collected:
            nodes.append({
                "kind": "output", "path": f"output: {collected.name}", "name": collected.name, "scope": "",
                "ins": [{"name": "", **self.port(collected.wire)}], "outs": [],
            })  # fmt: skip
            edges.append({
                "from": collected.wire.node, "out": collected.wire.output, "to": len(nodes) - 1, "port": "",
                "optional": False, "feedback": False, "fires": False,
            })  # fmt: skip
        edges += [
            {
                "from": tail, "out": 0, "to": head, "port": "", "optional": False, "feedback": False,
                "fires": True,
            }
            for tail, head in triggers(graph)
        ]  # fmt: skip
        return {
            "name": graph.name,
            "doc": inspect.cleandoc(graph.doc or ""),
            "settings": setting_words(graph.settings),
            "scopes": [
                {"path": s, "name": name_in(scope_of(graph, s), s), "parent": scope_of(graph, s)}
                for s in sorted(graph.scopes)
            ],
            "types": self.type_list,
            "clocks": self.clock_list,
            "nodes": nodes,
            "edges": edges,
            "costs": dict(self.costs.get("", {})),
        }

    def node(self, index: int) -> dict[str, Any] | None:
        node = self.graph.nodes[index]
        scope = scope_of(self.graph, node.path)
        made: dict[str, Any] = {"path": node.path, "name": name_in(scope, node.path), "scope": scope}
        if isinstance(node, SourceNode):
            out = {"name": "", **self.port(Wire(index, 0))}
            rate = clock_words(self.graph, Wire(index, 0))
            rate = ", ".join(filter(None, [rate, self.lateness.get(node.path)]))
            return {**made, "kind": "source", "rate": rate, "ins": [], "outs": [out]}
        if isinstance(node, RegisterNode):
            if node.role not in ("latest", "delay"):
                return None
            held = {"name": "", "type": self.type(node.type), "clock": None}
            return {**made, "kind": "register", "role": node.role, "initial": initial_words(node),
                    "initially": value_words(node.initial, node.type), "ins": [held], "outs": [held],
                    **self.cost(node.path)}  # fmt: skip
        return {**made, **self.call(index, node), **self.cost(node.path)}

    def call(self, index: int, call: CallNode) -> dict[str, Any]:
        block = call.block
        made: dict[str, Any] = {
            "kind": "host" if block.host else "block",
            "block": block_words(call, name_in(scope_of(self.graph, call.path), call.path)),
            "doc": inspect.cleandoc(block.__doc__ or ""),
            "source": source_words(block),
            "settings": setting_words(call.settings),
            "fires": str(call.firing),
            "at": firing_words(self.graph, call),
            "queue": queue_words(call),
            "ins": [],
            "outs": [{"name": port.name, **self.port(Wire(index, k))} for k, port in enumerate(call.outputs)],
        }
        if call.state is not None:
            state = self.graph.nodes[call.state]
            assert isinstance(state, RegisterNode)
            made["state"] = {
                "type": self.type(state.type), "initial": initial_words(state),
                "initially": value_words(state.initial, state.type),
            }  # fmt: skip
            made["state"] |= self.cost(state.path)
        for port, argument in zip(block.ports, call.arguments, strict=True):
            if argument.wire is not None:
                end = self.port(argument.wire)
            elif argument.register is not None:
                register = self.graph.nodes[argument.register]
                assert isinstance(register, RegisterNode)
                end = {"type": self.type(register.type), "clock": None, "held": register.role}
            else:
                continue
            made["ins"].append({"name": port.name, "optional": argument.optional, **end})
        return made

    def cost(self, path: str) -> dict[str, Any]:
        return {"costs": dict(self.costs[path])} if path in self.costs else {}

    def port(self, wire: Wire) -> dict[str, Any]:
        port = self.graph.port(wire)
        return {"type": self.type(port.type), "clock": self.clock(port.clock),
                "when": clock_words(self.graph, wire)}  # fmt: skip

    def type(self, type_: Type) -> int:
        leaves = [
            {"name": name, "shape": list(leaf.shape), "dtype": leaf.dtype, "unit": leaf.unit or "",
             "frame": leaf.frame or ""}
            for name, leaf in leaves_of(type_)
        ]  # fmt: skip
        key = f"{type_words(type_)} {leaves}"
        if key not in self.types:
            self.types[key] = len(self.type_list)
            self.type_list.append({"words": type_words(type_), "leaves": leaves})
        return self.types[key]

    def clock(self, clock: Clock) -> int:
        key = frozenset(clock.terms) if isinstance(clock, AnyOf) else clock
        if key not in self.clocks:
            self.clocks[key] = len(self.clock_list)
            self.clock_list.append({"words": str(clock), "rate": rate_words(clock)})
        return self.clocks[key]


def rate_words(clock: Clock) -> str:
    """How often a clock can tick at most, from the sources that it is made of; nothing where one is free."""
    if isinstance(clock, Source):
        timing = clock.timing
        free = timing.period is None and not timing.max_rate
        return "" if free else f"≤ {timing.max_rate:g} Hz" if timing.period is None else str(timing)
    rates = [_most(a) for a in _sources(clock)]
    known = [r for r in rates if r is not None]
    return f"≤ {sum(known):.4g} Hz" if rates and len(known) == len(rates) else ""


def _sources(clock: Clock) -> list[Source]:
    found: dict[Source, None] = {}
    rest = list(atoms(clock))
    while rest:
        one = rest.pop()
        if isinstance(one, Source):
            found.setdefault(one)
        elif (parent := getattr(one, "parent", None)) is not None:
            rest += atoms(parent)
    return list(found)


def _most(source: Source) -> float | None:
    timing = source.timing
    return 1e9 / timing.period if timing.period else timing.max_rate


def value_words(value: Any, type_: Type) -> list[list[str]]:
    """A value leaf by leaf, each as (name, text); what is long is cut."""
    return [
        [name, array_words(leaf)]
        for (name, _), leaf in zip(leaves_of(type_), flatten(value, type_), strict=True)
    ]


def array_words(leaf: Any) -> str:
    """An array in few characters: its numbers, else its size and what all of them are or lie between."""
    array = np.asarray(leaf)
    if array.size <= 9:
        return _numbers(array)
    size = " × ".join(map(str, array.shape))
    if array.ndim == 2 and array.shape[0] == array.shape[1] <= 30:
        if (array == array[0, 0] * np.eye(len(array))).all():
            return f"{size}, {array[0, 0]:.5g} on the diagonal"
        return shorten(f"{size}, diagonal {_numbers(np.diag(array))}", LONGEST)
    numbers = array.astype(float)
    if np.isnan(numbers).all():
        return f"{size}, none a number"
    if (numbers == numbers.flat[0]).all():
        return f"{size}, all {numbers.flat[0]:.5g}"
    return f"{size}, from {np.nanmin(numbers):.5g} to {np.nanmax(numbers):.5g}"


def _numbers(array: np.ndarray) -> str:
    form = {"float_kind": "{:.5g}".format}
    return np.array2string(array, separator=", ", max_line_width=10_000, formatter=form)  # type: ignore[arg-type]


def setting_words(settings: Mapping[str, Any]) -> list[list[str]]:
    """Settings as (name, text)."""
    return [[str(key), _setting(value)] for key, value in settings.items()]


def _setting(value: Any) -> str:
    if isinstance(value, Signal):
        type_ = type_of(value)
        return shorten("; ".join(f"{name} {words}" for name, words in value_words(value, type_)), LONGEST)
    if isinstance(value, np.ndarray) or (hasattr(value, "shape") and hasattr(value, "dtype")):
        return array_words(value)
    if callable(value) and hasattr(value, "__name__"):
        return str(value.__name__)
    words = re.sub(r" at 0x[0-9a-f]+", "", repr(value))
    return shorten(re.sub(r"\d+\.\d{6,}(e-?\d+)?", lambda m: f"{float(m[0]):.5g}", words), LONGEST)


def source_words(block: Block[Any]) -> str:
    """The file and line in which a block is written, the file as it is imported; nothing where unknown."""
    code = getattr(inspect.unwrap(block.step), "__code__", None)
    if code is None:
        return ""
    module = getattr(block.step, "__module__", None) or ""
    top = getattr(sys.modules.get(module.partition(".")[0]), "__file__", None)
    file = Path(code.co_filename)
    if top is not None and file.is_relative_to(Path(top).parent):
        file = file.relative_to(Path(top).parent.parent)
    else:
        written = getattr(sys.modules.get(module), "__file__", None)
        file = Path(*module.split(".")).with_suffix(".py") if written and "." in module else Path(file.name)
    return f"{file.as_posix()}:{code.co_firstlineno}"


__all__ = ["describe"]
