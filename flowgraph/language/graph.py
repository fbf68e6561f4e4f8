"""The frozen graph: nodes in firing order, the wires between them, and what may be asked of it.

Three kinds of node: `SourceNode` (events from outside), `CallNode` (a block) and `RegisterNode` (memory
between ticks, fed at the end of a tick). A `Wire` is one output of a source or call. Nothing in a graph
changes after it is built; all state lives in runs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from flowgraph.errors import CycleError, LoweringError, UnknownNameError
from flowgraph.language.block import Block
from flowgraph.language.clock import Clock, Source, atoms
from flowgraph.language.recording import StepTrace
from flowgraph.types import Type
from flowgraph.verbs import verb

if TYPE_CHECKING:
    import networkx

NEVER = -(2**63)
"""The time stamp, in ns, of what has not happened yet."""


class Wire(NamedTuple):
    """Output number `output` of node number `node`."""

    node: int
    output: int


class Argument(NamedTuple):
    """What a port is connected to: a wire, a register (held), or nothing."""

    wire: Wire | None = None
    register: int | None = None
    optional: bool = False


@dataclass(frozen=True)
class SourceNode:
    """Events that come from outside, of one type at one clock."""

    path: str
    type: Type
    clock: Source


@dataclass(frozen=True)
class OutputPort:
    """A stream: name at its node, type, and the clock at which it is present."""

    name: str
    type: Type
    clock: Clock


@dataclass(frozen=True)
class CallNode:
    """A block wired into the graph.

    Args:
        path: unique, with the names of the graphs it is nested in.
        firing: clock at which the step runs.
        dynamic: for each output, whether its presence is known only when the step has run.
        variants: by presence of the optional inputs: the recorded step, or why it cannot be recorded.
        state: index of its state register, and `stamp` of the register of its last firing, or None.
        draws: the first part of the names of its random streams.
    """

    path: str
    block: Block[Any]
    arguments: tuple[Argument, ...]
    settings: Mapping[str, Any]
    firing: Clock
    outputs: tuple[OutputPort, ...]
    dynamic: tuple[bool, ...]
    variants: Mapping[tuple[bool, ...], StepTrace | LoweringError]
    state: int | None = None
    stamp: int | None = None
    draws: str = ""


@dataclass(frozen=True)
class RegisterNode:
    """Memory: `role` is "latest", "delay", "state" or "stamp"; a delay is read before this tick's write."""

    path: str
    role: str
    type: Type
    initial: Any
    feed: Wire | None = None


@dataclass(frozen=True)
class Collected:
    """A stream whose values a run keeps, under `name`."""

    name: str
    wire: Wire


Node = SourceNode | CallNode | RegisterNode


@dataclass(frozen=True, eq=False)
class Graph:
    """A frozen graph; made by `some_graph.build(...)`.

    Args:
        name: of the `@graph` function.
        doc: its docstring.
        nodes: all nodes; wires and arguments refer to them by index.
        order: indices of the sources and calls in firing order.
        collected: the streams that a run returns.
        scopes: paths of the nested graphs.
    """

    name: str
    doc: str
    nodes: tuple[Node, ...]
    order: tuple[int, ...]
    collected: tuple[Collected, ...]
    scopes: tuple[str, ...]
    settings: Mapping[str, Any] = field(default_factory=dict)
    plans: dict[Any, Any] = field(default_factory=dict, repr=False)

    @property
    def sources(self) -> dict[str, SourceNode]:
        """The sources by name, in declaration order."""
        return {n.path: n for n in self.nodes if isinstance(n, SourceNode)}

    @property
    def calls(self) -> list[tuple[int, CallNode]]:
        """The calls with their indices, in firing order."""
        return [(i, n) for i in self.order if isinstance(n := self.nodes[i], CallNode)]

    @property
    def registers(self) -> list[tuple[int, RegisterNode]]:
        """The registers with their indices."""
        return [(i, n) for i, n in enumerate(self.nodes) if isinstance(n, RegisterNode)]

    def port(self, wire: Wire) -> OutputPort:
        """The stream at a wire."""
        node = self.nodes[wire.node]
        if isinstance(node, SourceNode):
            return OutputPort("", node.type, node.clock)
        assert isinstance(node, CallNode)
        return node.outputs[wire.output]

    def label(self, wire: Wire) -> str:
        """A name for a wire in messages: the path, with the port where there are several."""
        node = self.nodes[wire.node]
        several = isinstance(node, CallNode) and len(node.outputs) > 1
        return f"{node.path}.{self.port(wire).name}" if several else node.path

    def conditions(self) -> dict[Clock, Wire]:
        """For each clock atom known only at run time, the output whose presence it is."""
        found: dict[Clock, Wire] = {}
        for index, call in self.calls:
            for k, (port, dynamic) in enumerate(zip(call.outputs, call.dynamic, strict=True)):
                if dynamic:
                    found.setdefault(port.clock, Wire(index, k))
        return found

    def depends_on(self, clock: Clock) -> list[Wire]:
        """The outputs whose presence at run time a clock depends on."""
        conditions = self.conditions()
        return [conditions[a] for a in atoms(clock) if a in conditions]

    def draw(self, file: str | None = None, **options: Any) -> Any:
        """Draw the block diagram: to a file (.svg, .png, .pdf, .dot), or as SVG text without one."""
        return verb("Graph.draw")(self, file, **options)

    def text(self, *, fold: int | None = None, width: int | None = None, inputs: Any = None) -> str:
        """The diagram as plain text; what is nested deeper than `fold` is one line, lines of more than
        `width` columns go on in the next, and the inputs tell which sources are late."""
        return str(verb("Graph.text")(self, fold=fold, width=width, inputs=inputs))

    def to_networkx(self) -> networkx.MultiDiGraph:
        """The graph as a `networkx.MultiDiGraph`: nodes by path, edges with type, clock and `feedback`."""
        return verb("Graph.to_networkx")(self)

    def _repr_mimebundle_(self, include: Any = None, exclude: Any = None) -> dict[str, str]:
        bundle: dict[str, str] = verb("Graph._repr_mimebundle_")(self)
        return bundle

    def __repr__(self) -> str:
        return f"<graph {self.name}: {len(self.sources)} sources, {len(self.calls)} blocks>"


def firing_order(nodes: list[Node], lines: Mapping[int, str | None] | None = None) -> tuple[int, ...]:
    """Sources and calls such that each comes after what it reads in the same tick.

    A delay adds no edge: it is read before it is written. A latest does: it is written before it is read. A
    block that fires at a clock known only at run time comes after the block that decides it.

    Args:
        nodes: of the graph.
        lines: where registers were declared, by node.

    Raises:
        CycleError: with the whole chain of ports.
    """
    done: dict[int, None] = {}
    trail: list[tuple[int, str]] = []

    decides: dict[Clock, int] = {}  # for each clock known only at run time, the call that decides it
    for index, node in enumerate(nodes):
        if isinstance(node, CallNode):
            for output, dynamic in zip(node.outputs, node.dynamic, strict=True):
                if dynamic:
                    decides.setdefault(output.clock, index)

    def needs(index: int) -> list[tuple[str, int]]:
        node = nodes[index]
        if isinstance(node, RegisterNode):
            return [("", node.feed.node)] if node.role == "latest" and node.feed else []
        if not isinstance(node, CallNode):
            return []
        edges = []
        for port, arg in zip(node.block.ports, node.arguments, strict=True):
            if arg.wire is not None:
                edges.append((port.name, arg.wire.node))
            if arg.register is not None:
                edges.append((port.name, arg.register))
        edges.extend(("at", decides[atom]) for atom in atoms(node.firing) if atom in decides)
        return edges

    def visit(index: int) -> None:
        if index in done:
            return
        if any(index == i for i, _ in trail):
            start = next(k for k, (i, _) in enumerate(trail) if i == index)
            loop = [*trail[start:], (index, "")]
            # the trail runs from reader to read; print it the way values flow
            chain = " -> ".join(
                f"{nodes[i].path}.{port}" if port else nodes[i].path for i, port in reversed(loop)
            )
            error = CycleError(
                "a cycle passes through no delay",
                path=nodes[index].path,
                expected="at least one delay in each cycle",
                got=chain,
                fix="read the value of the tick before: delay(init), not latest(init=...); or use moore(...)",
            )
            error.line = next((lines[i] for i, _ in loop if lines and i in lines), None)
            raise error
        for port, needed in needs(index):
            trail.append((index, port))
            visit(needed)
            trail.pop()
        done.setdefault(index)

    for index in range(len(nodes)):
        if not isinstance(nodes[index], RegisterNode):
            visit(index)
    for index, node in enumerate(nodes):  # a cycle of registers alone has no call in it
        if isinstance(node, RegisterNode):
            visit(index)
    return tuple(i for i in done if not isinstance(nodes[i], RegisterNode))


def join_states(graph: Graph) -> set[int]:
    """The registers that hold the state of a join: what its clock is was proven from where they start."""
    return {
        call.state
        for _, call in graph.calls
        if call.state is not None and (call.block.clock_rule or call.block.fault)
    }


def find_output(graph: Graph, name: str) -> Collected:
    """The collected stream of that name.

    Raises:
        UnknownNameError: listing the names that exist.
    """
    for collected in graph.collected:
        if collected.name == name:
            return collected
    raise UnknownNameError("output", name, [c.name for c in graph.collected], path=graph.name)
