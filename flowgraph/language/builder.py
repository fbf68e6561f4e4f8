"""The graph under construction: nodes as they are added, unique paths, and the checks made at the end."""

from __future__ import annotations

import itertools
import typing
from collections.abc import Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.errors import DeclarationError, asking_line
from flowgraph.language import clock as clocks
from flowgraph.language.clock import Clock
from flowgraph.language.graph import (
    NEVER,
    CallNode,
    Collected,
    Graph,
    Node,
    OutputPort,
    RegisterNode,
    SourceNode,
    Wire,
    firing_order,
)
from flowgraph.language.stream import Held, Stream
from flowgraph.types import ArrayType, Type, as_value, bind, check_fits, type_of

_MOST_SOURCES = 62
"""Source patterns are bits of an int64."""


class Builder:
    """The graph under construction."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.nodes: list[Node] = []
        self.collected: dict[str, Collected] = {}
        self.scopes: list[str] = []
        self._scope: tuple[str, ...] = ()
        self._taken: set[str] = set()
        self._stamps: dict[Clock, int] = {}
        self._draws: dict[str, str] = {}
        self._sites: dict[int, str] = {}
        self._lines: dict[int, str | None] = {}

    def path(self, name: str, *, given: bool = False) -> str:
        """A unique path in the current scope; a name that the user gave must be free."""
        if given and (not _is_text(name) or "/" in name):
            raise DeclarationError(
                "a node cannot be called this",
                path="/".join(self._scope) or self.name,
                expected="a text of characters, without /, which joins names to paths",
                got=repr(name),
                fix='give another name, such as name="gate_2"',
            )
        return self.claim("/".join((*self._scope, name)), given=given)

    def claim(self, base: str, *, given: bool = False) -> str:
        """`base`, whatever the scope, or where it is taken and was not given, with a number behind it."""
        path = base
        if path in self._taken and given:
            raise DeclarationError(
                f"the name {base.rsplit('/', 1)[-1]!r} is taken",
                path=path,
                expected="one node a name",
                got="a second one",
                fix="give it another name=",
            )
        for n in itertools.count(2):
            if path not in self._taken:
                break
            path = f"{base}_{n}"
        self._taken.add(path)
        return path

    @contextmanager
    def scope(self, name: str, *, given: bool) -> typing.Iterator[None]:
        """Nodes added inside get `name/` in front."""
        path = self.path(name, given=given)
        self.scopes.append(path)
        outer, self._scope = self._scope, tuple(path.split("/"))
        try:
            yield
        finally:
            self._scope = outer

    def add(self, node: Node) -> int:
        self.nodes.append(node)
        if isinstance(node, RegisterNode) and node.role in ("delay", "latest"):
            self._lines[len(self.nodes) - 1] = asking_line()
        return len(self.nodes) - 1

    def stream(self, wire: Wire) -> Stream[Any]:
        node = self.nodes[wire.node]
        if isinstance(node, SourceNode):
            return Stream(self, wire, OutputPort("", node.type, node.clock), node.path)
        assert isinstance(node, CallNode)
        label = node.path if len(node.outputs) == 1 else f"{node.path}.{node.outputs[wire.output].name}"
        return Stream(self, wire, node.outputs[wire.output], label)

    def register(
        self,
        role: str,
        name: str,
        initial: Any,
        type_: Type | None,
        *,
        given: bool = False,
        feed: Wire | None = None,
    ) -> Held[Any]:
        path = self.path(name, given=given)
        value = as_value(initial, type_ or type_of(initial), path=path)
        found = type_of(value)
        kept = type_ if type_ is not None else found
        index = self.add(RegisterNode(path, role, bind(kept, _sizes_of(kept, found, path)), value, feed))
        node = typing.cast(RegisterNode, self.nodes[index])
        return Held(self, index, node.type, path)

    def stamp(self, firing: Clock) -> int:
        """The register that keeps when a clock last ticked; nodes of one clock share it."""
        if firing not in self._stamps:
            node = RegisterNode(
                self.claim(f"last({firing})"), "stamp", ArrayType((), "int64", "ns"), np.int64(NEVER)
            )
            self._stamps[firing] = self.add(node)
        return self._stamps[firing]

    def stamp_of(self, firing: Clock) -> int | None:
        """The register that keeps when a clock last ticked, where there is one."""
        return self._stamps.get(firing)

    def random_streams(self, prefix: str, path: str) -> str:
        """Claim the names that begin with `prefix` for one node: no two nodes draw the same numbers."""
        if prefix in self._draws:
            raise DeclarationError(
                f"the random streams {prefix!r} are taken by {self._draws[prefix]}",
                path=path,
                expected="one node a name, since equal names draw equal numbers",
                got=prefix,
                fix=f'name them: draws="{prefix}_2"',
            )
        self._draws[prefix] = path
        return prefix

    def random_site(self, name: str, number: int, path: str) -> None:
        """Refuse a second name that the same 32-bit number stands for: both would draw the same."""
        known = self._sites.setdefault(number, name)
        if known != name:
            raise DeclarationError(
                f"the random stream {name!r} would draw the numbers of {known!r}",
                path=path,
                expected="names that differ in their hash",
                got=f"{number:#010x} for both",
                fix="give one of them another name",
            )

    def feed(self, held: Held[Any], stream: Stream[Any]) -> None:
        node = self.nodes[held.register]
        assert isinstance(node, RegisterNode)
        if not isinstance(stream, Stream):
            raise DeclarationError(
                "only a stream can be fed",
                path=node.path,
                expected="a stream",
                got=repr(stream),
                fix="sample a held value with .at(clock) first",
            )
        if node.feed is not None:
            raise DeclarationError(
                "this register is fed twice",
                path=node.path,
                expected="one feed",
                got=f"{self.stream(node.feed).label} and {stream.label}",
                fix="merge the two streams first",
            )
        check_fits(stream.type, node.type, given_at=stream.label, wanted_at=node.path, sizes={})
        self.nodes[held.register] = replace(node, feed=stream.wire)

    def collect(self, name: str, stream: Stream[Any]) -> None:
        if not isinstance(stream, Stream):
            raise DeclarationError(
                "only streams can be collected",
                path=f"{self.name}.{name}",
                expected="a stream",
                got=repr(stream),
                fix="sample a held value with .at(clock)",
            )
        if not _is_text(name):
            raise DeclarationError(
                "an output cannot be called this",
                path=self.name,
                expected="a text of characters",
                got=repr(name),
                fix='give it a name: {"belief": stream}, or collect(stream, "belief")',
            )
        full = "/".join((*self._scope, name))
        if full in self.collected:
            raise DeclarationError(
                f"the name {full!r} is taken",
                path=self.name,
                expected="one output a name",
                got="a second one",
                fix="give it another name",
            )
        self.collected[full] = Collected(full, stream.wire)

    def freeze(self, doc: str, settings: Mapping[str, Any]) -> Graph:
        for index, node in enumerate(self.nodes):
            if isinstance(node, RegisterNode) and node.role in ("delay", "latest") and node.feed is None:
                error = DeclarationError(
                    f"this {node.role} is never fed",
                    path=node.path,
                    expected="one call of .feed(stream)",
                    got="none",
                    fix="call .feed(...) on it before the graph function returns",
                )
                error.line = self._lines[index]
                raise error
        if not self.collected and not any(isinstance(n, CallNode) and n.block.host for n in self.nodes):
            raise DeclarationError(
                "this graph gives nothing",
                path=self.name,
                expected="a stream, a tuple of streams or a dict of them; or a sink",
                got="None",
                fix='return the stream, or several: return {"belief": belief}',
            )
        sources = [n.path for n in self.nodes if isinstance(n, SourceNode)]
        if len(sources) > _MOST_SOURCES:
            raise DeclarationError(
                "too many sources",
                path=self.name,
                expected=f"at most {_MOST_SOURCES}",
                got=str(len(sources)),
                fix="pack several sensors of one clock into one signal",
            )
        order = firing_order(self.nodes, self._lines)
        used = {w.node for w in self._wires()} | self._clocked()
        for index, source in enumerate(self.nodes):
            if isinstance(source, SourceNode) and index not in used:
                raise DeclarationError(
                    "this source is connected to nothing",
                    path=f"{self.name}.{source.path}",
                    expected="every source used",
                    got="no port reads it",
                    fix="wire it, or leave the parameter out",
                )
        return Graph(
            self.name,
            doc,
            tuple(self.nodes),
            order,
            tuple(self.collected.values()),
            tuple(self.scopes),
            settings,
        )

    def _wires(self) -> typing.Iterator[Wire]:
        yield from (c.wire for c in self.collected.values())
        for node in self.nodes:
            if isinstance(node, RegisterNode) and node.feed is not None:
                yield node.feed
            if isinstance(node, CallNode):
                yield from (a.wire for a in node.arguments if a.wire is not None)

    def _clocked(self) -> set[int]:
        firing = [n.firing for n in self.nodes if isinstance(n, CallNode)]
        named = set(clocks.atoms(*firing))
        return {i for i, n in enumerate(self.nodes) if isinstance(n, SourceNode) and n.clock in named}


def _sizes_of(type_: Type, found: Type, path: str) -> dict[str, int]:
    sizes: dict[str, int] = {}
    check_fits(found, type_, given_at=f"the initial value of {path}", wanted_at=path, sizes=sizes)
    return sizes


def _is_text(name: Any) -> bool:
    """Whether a name is one that files can hold: Unicode has numbers that are no characters."""
    return (
        isinstance(name, str)
        and name != ""
        and not any(
            "\ud800" <= c <= "\udfff" or "\ufdd0" <= c <= "\ufdef" or ord(c) & 0xFFFE == 0xFFFE for c in name
        )
    )


_current: ContextVar[Builder | None] = ContextVar("flowgraph_builder", default=None)


def builder(what: str) -> Builder:
    """The graph under construction.

    Raises:
        DeclarationError: outside a `@graph` function.
    """
    found = _current.get()
    if found is None:
        raise DeclarationError(
            f"{what} can only be wired while a graph is declared",
            path=what,
            expected="a call inside a @graph function",
            got="a call outside",
            fix=f"to run the function itself on arrays, call {what}.step(...)",
        )
    return found


@contextmanager
def building(build: Builder) -> typing.Iterator[None]:
    """Make `build` the graph under construction."""
    token = _current.set(build)
    try:
        yield
    finally:
        _current.reset(token)
