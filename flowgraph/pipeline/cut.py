"""The cut: which blocks of a graph stay on the host, and which are lowered.

A host block (OpenCV, a file, a plot) runs in Python only. Where its values come to blocks that are lowered it
belongs before the cut, with all that nothing but such host blocks reads; where only host blocks and outputs
follow, it belongs after. What is left is accelerated. Each of the three parts is a graph of its own, in which
the streams of the others are sources, so engines, lowering and checks need to know nothing of the cut. The
parts run one after the other over a whole recording; a host block with accelerated blocks on both sides would
need them to take turns, and is refused.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from typing import NoReturn

from flowgraph.errors import LoweringError
from flowgraph.language.block import line_of
from flowgraph.language.clock import AllOf, AnyOf, Clock, Condition, Counted, Not, Source, atoms
from flowgraph.language.graph import (
    Argument,
    CallNode,
    Collected,
    Graph,
    Node,
    RegisterNode,
    SourceNode,
    Wire,
)
from flowgraph.pipeline.pipeline import HostStage


@dataclass(frozen=True)
class Cut:
    """A graph in parts: `before` and `after` run on the host, and are None where there is nothing to do."""

    before: Graph | None
    accelerated: Graph
    after: Graph | None
    host: tuple[HostStage, ...]


def cut(graph: Graph) -> Cut | None:
    """The parts of a graph with host blocks, or None for one without; kept with the graph.

    Raises:
        LoweringError: for a host block between accelerated blocks or in a cycle with one, and where the graph
            has host blocks alone; names the block and its line.
    """
    if "cut" not in graph.plans:
        hosts = [i for i, call in graph.calls if call.block.host]
        graph.plans["cut"] = _Knife(graph, hosts).cut() if hosts else None
    found: Cut | None = graph.plans["cut"]
    return found


class _Knife:
    def __init__(self, graph: Graph, hosts: list[int]) -> None:
        self.graph, self.hosts = graph, hosts
        self.conditions = graph.conditions()
        self.needs = {i: self._needs(call) for i, call in graph.calls}
        self.feeds: dict[int, set[int]] = {i: set() for i in self.needs}
        for reader, needed in self.needs.items():
            for i in needed:
                self.feeds[i].add(reader)

    def _needs(self, call: CallNode) -> set[int]:
        """The calls that a call reads, in this tick or an earlier one, or that decide when it fires."""
        wires = self._deciding(call.firing)
        for argument in call.arguments:
            if argument.wire is not None:
                wires.add(argument.wire)
            elif argument.register is not None and (feed := _register(self.graph, argument.register).feed):
                wires.add(feed)
        return {w.node for w in wires if isinstance(self.graph.nodes[w.node], CallNode)}

    def _deciding(self, clock: Clock) -> set[Wire]:
        """The outputs whose presence is a clock's; what they follow from themselves is their blocks' need."""
        if clock in self.conditions:
            return {self.conditions[clock]}
        if isinstance(clock, AnyOf | AllOf):
            return set().union(*map(self._deciding, clock.terms))
        return self._deciding(clock.term) if isinstance(clock, Not) else set()

    def cut(self) -> Cut:
        hosts = set(self.hosts)
        first = {h for h in hosts if _reached(h, self.feeds) - hosts}
        before = first | set().union(*(_reached(h, self.needs) - hosts for h in first))
        while wrong := {i for i in before - hosts if self.feeds[i] - hosts - before}:
            before -= wrong  # read by accelerated blocks too
        after = hosts - first
        inside = set(self.needs) - before - after
        for h in self.hosts:
            if h in first and (met := _reached(h, self.needs) & inside):
                self.refuse(h, met, inside)
        if not inside:
            self.alone()
        return self.parts(before, inside, after)

    def refuse(self, host: int, met: set[int], inside: set[int]) -> NoReturn:
        read = next(i for i in self.graph.order if i in met)
        fed = next(i for i in self.graph.order if i in _reached(host, self.feeds) & inside)
        cyclic = next((i for i in self.graph.order if i in met & _reached(host, self.feeds)), None)
        call = self.call(host)
        if cyclic is not None:
            message = "a host block is in a cycle with accelerated blocks"
            got = f"{self.call(cyclic).path}, which it reads and feeds"
        else:
            message = "a host block has accelerated blocks on both sides"
            got = f"{self.call(read).path} before it and {self.call(fed).path} after it"
        raise LoweringError(
            message,
            path=call.path,
            expected="accelerated blocks only before a host block, or only after it",
            got=f"{got}; @block(host=True) {call.block.name}, {line_of(call.block)}",
            fix='write it in array-API operations without host=True, or run the graph with engine="python"',
        )

    def alone(self) -> NoReturn:
        for variant in self.call(self.hosts[0]).variants.values():
            if isinstance(variant, LoweringError):
                raise variant
        raise AssertionError("a host block with a recorded step")

    def call(self, index: int) -> CallNode:
        node = self.graph.nodes[index]
        assert isinstance(node, CallNode)
        return node

    # -- parts ---------------------------------------------------------------------------------------

    def parts(self, before: set[int], inside: set[int], after: set[int]) -> Cut:
        graph = self.graph
        own: dict[int, list[Collected]] = {0: [], 1: [], 2: []}
        for c in graph.collected:
            own[0 if c.wire.node in before else 2 if c.wire.node in after else 1].append(c)
        last = _Part(graph, self.conditions, after, own[2]) if after else None
        middle = _Part(graph, self.conditions, inside, self.kept(own[1], last, inside))
        given = [*middle.given, *(last.given if last else ())]
        first = None
        if before:
            first = _Part(graph, self.conditions, before, _with(graph, own[0], given, before))
        stages = []
        for side, part, calls in (("before", first, before), ("after", last, after)):
            for i in graph.order:
                if part is not None and i in calls:
                    call = self.call(i)
                    feeds = [graph.label(w) for w in middle.given if w.node == i] if side == "before" else []
                    reads = [] if side == "before" else [graph.label(w) for w in self.read(call)]
                    stages.append(
                        HostStage(
                            call.path, call.block.name, side, line_of(call.block), tuple(reads), tuple(feeds)
                        )
                    )
        return Cut(
            None if first is None else first.graph(),
            middle.graph(),
            None if last is None else last.graph(),
            tuple(stages),
        )

    def read(self, call: CallNode) -> list[Wire]:
        found: dict[Wire, None] = {}
        for a in call.arguments:
            wire = a.wire
            if wire is None and a.register is not None:
                wire = _register(self.graph, a.register).feed
            if wire is not None:
                found.setdefault(wire)
        return list(found)

    def kept(self, own: list[Collected], last: _Part | None, inside: set[int]) -> list[Collected]:
        """What the accelerated part gives: the graph's own outputs, and what is read after it."""
        return _with(self.graph, own, last.given if last else (), inside)


def _with(
    graph: Graph, own: list[Collected], wires: Iterable[Wire], calls: Collection[int]
) -> list[Collected]:
    """The graph's own outputs of a part, and the wires of it that another part reads, each once."""
    there = {c.wire for c in own}
    names = {c.name for c in graph.collected}
    found = list(own)
    for wire in wires:
        if wire.node in calls and wire not in there:
            there.add(wire)
            name = graph.label(wire)
            while name in names:
                name += "_"
            names.add(name)
            found.append(Collected(name, wire))
    return found


class _Part:
    """Some calls of a graph, their registers, and as sources whatever else they read.

    A stream from another part whose clock is a source's keeps it. Any other gets a source of its own name,
    which stands for its clock throughout the part.
    """

    def __init__(
        self, graph: Graph, conditions: dict[Clock, Wire], calls: set[int], collected: list[Collected]
    ) -> None:
        self.whole, self.calls, self.collected = graph, calls, collected
        self.registers = self._registers()
        self.given: dict[Wire, None] = {}  # streams of other parts
        self.sources: set[int] = set()
        self.stands: dict[Clock, Clock] = {}
        of_clock = {n.clock: i for i, n in enumerate(graph.nodes) if isinstance(n, SourceNode)}
        for wire in self._wires():
            self._take(wire)
        known: tuple[int, int] | None = None
        while known != (len(self.given), len(self.sources)):  # clocks may ask for the presence of more
            known = len(self.given), len(self.sources)
            for atom in atoms(*map(self.clock, self._clocks())):
                if isinstance(atom, Source):
                    if atom in of_clock and all(graph.port(w).clock != atom for w in self.given):
                        self.sources.add(of_clock[atom])
                elif atom in conditions:
                    self._take(conditions[atom])

    def _take(self, wire: Wire) -> None:
        if wire.node in self.calls:
            return
        if isinstance(self.whole.nodes[wire.node], SourceNode):
            self.sources.add(wire.node)
            return
        self.given.setdefault(wire)
        clock = self.whole.port(wire).clock
        if not isinstance(clock, Source):
            self.stands.setdefault(clock, Source(self.whole.label(wire)))

    def _registers(self) -> list[int]:
        calls = [n for i, n in self.whole.calls if i in self.calls]
        used = {a.register for c in calls for a in c.arguments} | {
            r for c in calls for r in (c.state, c.stamp)
        }
        return [i for i, _ in self.whole.registers if i in used]

    def _wires(self) -> list[Wire]:
        found = [a.wire for i, c in self.whole.calls if i in self.calls for a in c.arguments if a.wire]
        found += [f for i in self.registers if (f := _register(self.whole, i).feed) is not None]
        return found + [c.wire for c in self.collected]

    def _clocks(self) -> list[Clock]:
        calls = [n for i, n in self.whole.calls if i in self.calls]
        found = [c for n in calls for c in (n.firing, *(p.clock for p in n.outputs))]
        return found + [self.whole.port(w).clock for w in self._wires() if w.node in self.calls]

    def clock(self, clock: Clock) -> Clock:
        """A clock of the graph as this part knows it."""
        if clock in self.stands:
            return self.stands[clock]
        if isinstance(clock, AnyOf | AllOf):
            return type(clock)(tuple(map(self.clock, clock.terms)))
        if isinstance(clock, Not):
            return Not(self.clock(clock.term))
        if isinstance(clock, Counted | Condition):
            return replace(clock, parent=self.clock(clock.parent))
        return clock

    def graph(self) -> Graph:
        """The part, with nodes numbered anew and paths as they were."""
        whole = self.whole
        kept = [i for i, _ in enumerate(whole.nodes) if i in self.sources]
        nodes: list[Node] = [whole.nodes[i] for i in kept]
        place = {i: k for k, i in enumerate(kept)}
        wires = {Wire(i, 0): Wire(k, 0) for i, k in place.items()}
        for wire in self.given:
            port = whole.port(wire)
            clock = self.clock(port.clock)
            assert isinstance(clock, Source)
            wires[wire] = Wire(len(nodes), 0)
            nodes.append(SourceNode(whole.label(wire), port.type, clock))
        heads = len(nodes)
        calls = [i for i, _ in whole.calls if i in self.calls]
        place.update({i: heads + k for k, i in enumerate([*calls, *self.registers])})

        def moved(wire: Wire | None) -> Wire | None:
            if wire is None:
                return None
            return wires[wire] if wire in wires else Wire(place[wire.node], wire.output)

        def index(old: int | None) -> int | None:
            return None if old is None else place[old]

        for i in calls:
            call = whole.nodes[i]
            assert isinstance(call, CallNode)
            nodes.append(
                replace(
                    call,
                    arguments=tuple(
                        Argument(moved(a.wire), index(a.register), a.optional) for a in call.arguments
                    ),
                    firing=self.clock(call.firing),
                    outputs=tuple(replace(p, clock=self.clock(p.clock)) for p in call.outputs),
                    state=index(call.state),
                    stamp=index(call.stamp),
                )
            )
        for i in self.registers:
            register = _register(whole, i)
            nodes.append(replace(register, feed=moved(register.feed)))
        collected = tuple(Collected(c.name, moved(c.wire) or c.wire) for c in self.collected)
        order = (*range(heads), *(place[i] for i in calls))
        return Graph(whole.name, whole.doc, tuple(nodes), order, collected, whole.scopes, whole.settings)


def _register(graph: Graph, index: int) -> RegisterNode:
    node = graph.nodes[index]
    assert isinstance(node, RegisterNode)
    return node


def _reached(start: int, edges: dict[int, set[int]]) -> set[int]:
    """All that can be reached from a call, itself only through a cycle."""
    found: set[int] = set()
    waiting = list(edges[start])
    while waiting:
        if (i := waiting.pop()) not in found:
            found.add(i)
            waiting.extend(edges[i])
    return found
