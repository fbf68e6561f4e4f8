"""A built graph inside another: its nodes, wired to streams in place of its sources.

A `@graph` function nests by being called again. A graph that was built, as a case of a filter is, has
settings and a start of its own; this takes it as it stands. Its nodes keep their paths, so whoever names a
register or an output of it still finds it there, and steps are not recorded anew.
"""

from __future__ import annotations

import operator
from collections.abc import Mapping
from dataclasses import replace
from functools import reduce
from typing import Any

from flowgraph.errors import ClockError, UnknownNameError
from flowgraph.language.builder import Builder
from flowgraph.language.graph import Argument, CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.language.joins import merge
from flowgraph.language.stream import Held, Stream
from flowgraph.types import check_fits


def inlined(
    build: Builder,
    graph: Graph,
    streams: Mapping[str, Stream[Any]],
    starts: Mapping[str, Stream[Any]] | None = None,
) -> dict[str, Stream[Any]]:
    """Add the nodes of a built graph to one under construction.

    Args:
        build: the graph under construction.
        graph: what is added.
        streams: one for each of its sources, of the same type and at the same clock.
        starts: by register, a stream that is present at the first tick alone, or at the first few: what is
            read of the register there is this.

    Returns:
        The streams that it collects, by name. They are not collected in `build`.

    Raises:
        UnknownNameError: for a stream that is none of its sources, or a source without one.
        TypeMismatchError, ClockError: for a stream that is not what the source was built as.
    """
    for name in {**streams, **graph.sources}:
        if name not in streams or name not in graph.sources:
            raise UnknownNameError("source", name, list(graph.sources), path=f"{build.name}/{graph.name}")
    where = _places(build, graph)
    ends = {
        Wire(index, 0): _fitting(node, streams[node.path], graph.name)
        for index, node in enumerate(graph.nodes)
        if isinstance(node, SourceNode)
    }

    def wire(old: Wire) -> Wire:
        return ends[old] if old in ends else Wire(where[old.node], old.output)

    def argument(old: Argument) -> Argument:
        moved = None if old.wire is None else wire(old.wire)
        return Argument(moved, None if old.register is None else where[old.register], old.optional)

    for index, node in enumerate(graph.nodes):
        if index not in where or where[index] < len(build.nodes):
            continue  # a source, or a stamp that both have
        if isinstance(node, RegisterNode):
            feed = None if node.feed is None else wire(node.feed)
            build.add(replace(node, path=build.claim(node.path, given=True), feed=feed))
        elif isinstance(node, CallNode):
            if node.draws:
                build.random_streams(node.draws, node.path)
            build.add(
                replace(
                    node,
                    path=build.claim(node.path, given=True),
                    arguments=tuple(argument(a) for a in node.arguments),
                    state=None if node.state is None else where[node.state],
                    stamp=None if node.stamp is None else where[node.stamp],
                )
            )
    build.scopes.extend(graph.scopes)
    paths = {node.path: where[index] for index, node in graph.registers}
    for name, start in (starts or {}).items():
        if name not in paths:
            raise UnknownNameError("register", name, list(paths), path=f"{build.name}/{graph.name}")
        _begin(build, paths[name], start, sorted(where.values()))
    return {c.name: build.stream(wire(c.wire)) for c in graph.collected}


def _begin(build: Builder, register: int, start: Stream[Any], places: list[int]) -> None:
    """Have those that read a register read a start in its place, where there is one."""
    reading = {}
    for place in places:
        node = build.nodes[place]
        if isinstance(node, CallNode) and any(a.register == register for a in node.arguments):
            reading[place] = node
    if not reading:
        return
    node = build.nodes[register]
    assert isinstance(node, RegisterNode)
    clock = reduce(operator.or_, (reader.firing for reader in reading.values()))
    held: Held[Any] = Held(build, register, node.type, node.path)
    first = merge(start, held.at(clock), tie="left")
    check_fits(first.type, node.type, given_at=first.label, wanted_at=node.path, sizes={})
    for place, reader in reading.items():
        moved = tuple(
            Argument(first.wire, None, a.optional) if a.register == register else a for a in reader.arguments
        )
        build.nodes[place] = replace(reader, arguments=moved)


def _places(build: Builder, graph: Graph) -> dict[int, int]:
    """Where each node comes to stand; stamps of a clock that both have are one."""
    firing = {n.stamp: n.firing for n in graph.nodes if isinstance(n, CallNode) and n.stamp is not None}
    found: dict[int, int] = {}
    free = len(build.nodes)
    for index, node in enumerate(graph.nodes):
        if isinstance(node, SourceNode):
            continue
        shared = build.stamp_of(firing[index]) if index in firing else None
        found[index] = free if shared is None else shared
        free += shared is None
    return found


def _fitting(source: SourceNode, stream: Stream[Any], name: str) -> Wire:
    check_fits(stream.type, source.type, given_at=stream.label, wanted_at=f"{name}.{source.path}", sizes={})
    if stream.clock != source.clock:
        raise ClockError(
            f"source {source.path!r} was built for another clock",
            path=name,
            expected=f"{source.clock}, {source.clock.timing}",
            got=f"{stream.label} at {stream.clock}",
            fix="build the graph with the clock that the stream has",
        )
    return stream.wire
