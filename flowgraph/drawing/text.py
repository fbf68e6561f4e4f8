"""The drawing in plain text, for a terminal, a log or a review; and what all drawings share: words, arrows.

What a reader wants to know of a graph is: what comes in and how often, in which order the blocks run, what
each of them sees when it runs (a fresh value, a held one, perhaps none), and what is remembered until the
next tick. So the text has four parts: sources, blocks in firing order, registers, outputs. A dashed
arrow marks feedback: a value that is read no earlier than the tick after the one that wrote it.
"""

from __future__ import annotations

import inspect
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from flowgraph.data.arrival import lateness_words
from flowgraph.data.flight import Flight
from flowgraph.errors import DeclarationError
from flowgraph.language.clock import Condition, Counted, atoms, either
from flowgraph.language.graph import Argument, CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.types import StructType, Type, flatten

if TYPE_CHECKING:
    import networkx  # slow to import, and only needed here

WIDTH = 100


def shorten(text: str, most: int) -> str:
    """At most `most` characters, with an ellipsis where something was left out."""
    return text if len(text) <= most else text[: most - 1].rstrip(" ,|") + "…"


def type_words(type_: Type) -> str:
    """A type as a reader writes it: `Imu`, `real[3], m/s, world`, `(Imu, real)`, `{x, y}`."""
    if isinstance(type_, StructType) and type_.cls is tuple:
        return "(" + ", ".join(type_words(t) for _, t in type_.fields) + ")"
    if isinstance(type_, StructType) and type_.cls is dict:
        return "{" + ", ".join(name for name, _ in type_.fields) + "}"
    return str(type_)


def clock_words(graph: Graph, wire: Wire) -> str:
    """When a stream is present: the rate at a source, `some of imu` after a filter, else its clock."""
    clock = graph.port(wire).clock
    node = graph.nodes[wire.node]
    if isinstance(node, SourceNode):
        timing = node.clock.timing
        if node.path != node.clock.name:
            return f"with {node.clock.name}: when it was true"
        return f"≤ {timing.max_rate:g} Hz" if timing.period is None and timing.max_rate else str(timing)
    if isinstance(clock, Condition) and isinstance(node, CallNode) and node.dynamic[wire.output]:
        return f"some of {clock.parent}"
    return str(clock) if isinstance(clock, Counted) else f"at {clock}"


def firing_words(graph: Graph, call: CallNode) -> str:
    """The firing clock where the inputs do not show it, else nothing."""
    wires = [(a.optional, graph.port(a.wire).clock) for a in call.arguments if a.wire is not None]
    main = [clock for optional, clock in wires if not optional]
    if call.firing in main or (wires and not main and call.firing == either(*(c for _, c in wires))):
        return ""
    return f"at {call.firing}"


def queue_words(call: CallNode) -> str:
    """The bound of a join's queues and the tolerance of a match, else nothing."""
    if call.block.fault is None or "size" not in call.settings:
        return ""
    tolerance = call.settings.get("tolerance")
    near = f", within {duration_words(tolerance)}" if isinstance(tolerance, int) else ""
    return f"queues ≤ {call.settings['size']}{near}"


def duration_words(nanoseconds: int) -> str:
    """A duration with the unit that suits it: `5 ms`."""
    for unit, size in (("s", 1_000_000_000), ("ms", 1_000_000), ("us", 1_000)):
        if nanoseconds >= size:
            return f"{nanoseconds / size:g} {unit}"
    return f"{nanoseconds} ns"


def initial_words(register: RegisterNode) -> str:
    """The initial value of a register: a number, `zeros`, `identity`, or else `given`."""
    leaves = [np.asarray(leaf) for leaf in flatten(register.initial, register.type)]
    if len(leaves) == 1 and leaves[0].ndim == 0:
        return f"{leaves[0].item():.4g}" if leaves[0].dtype.kind == "f" else str(leaves[0].item())
    if all(not leaf.any() for leaf in leaves):
        return "zeros"
    only = leaves[0]
    square = len(leaves) == 1 and only.ndim == 2 and only.shape[0] == only.shape[1]
    return "identity" if square and np.array_equal(only, np.eye(len(only))) else "given"


def doc_words(thing: object) -> str:
    """The first line of a docstring, or nothing."""
    written = thing if isinstance(thing, str) else getattr(thing, "__doc__", None)
    return (inspect.cleandoc(written).splitlines() or [""])[0] if written else ""


def block_words(call: CallNode, name: str) -> str:
    """The name of a call's block where it is not the call's own name, else nothing."""
    own = re.fullmatch(re.escape(call.block.name) + r"(_\d+)?", name)
    return "" if own else call.block.name


class Link(NamedTuple):
    """One arrow: from an output (or a register, where `output` is None) to a port of a node."""

    tail: int
    output: int | None
    head: int
    port: str
    optional: bool
    feedback: bool


def links(graph: Graph) -> Iterator[Link]:
    """All arrows between sources, blocks and the registers that are seen; a state belongs to its block."""
    for index, node in enumerate(graph.nodes):
        if isinstance(node, CallNode):
            for port, argument in zip(node.block.ports, node.arguments, strict=True):
                if argument.wire is not None:
                    yield Link(*argument.wire, index, port.name, argument.optional, False)
                elif argument.register is not None:
                    yield Link(argument.register, None, index, port.name, argument.optional, False)
        elif isinstance(node, RegisterNode) and node.feed is not None:
            yield Link(*node.feed, index, "", False, node.role == "delay")


def triggers(graph: Graph) -> list[tuple[int, int]]:
    """(source or block, block) where the first is wired to nothing and only makes the second fire."""
    wired = {link.tail for link in links(graph)} | {c.wire.node for c in graph.collected}
    found = []
    for index, node in enumerate(graph.nodes):
        if index not in wired and not isinstance(node, RegisterNode):
            own = {node.clock} if isinstance(node, SourceNode) else {p.clock for p in node.outputs}
            for fired, call in graph.calls:
                if own & set(atoms(call.firing)) and firing_words(graph, call):
                    found.append((index, fired))
    return found


def to_networkx(graph: Graph) -> networkx.MultiDiGraph:
    """The graph for analysis by networkx.

    Nodes, by path: `kind` ("source", "block", "latest", "delay" or "state"), `type` (a block's: of its
    first output), `clock` (a block's: at which it fires) and `outputs` (names under which it is collected).
    Edges: `type`, `clock` (None: held), `output` and `port` (names of the two ends), `optional`, and
    `feedback`: whether it writes what is read a tick later. Without the feedback edges there is no cycle.
    """
    import networkx  # slow to import, and only needed here

    made = networkx.MultiDiGraph(name=graph.name)
    for index, node in enumerate(graph.nodes):
        names = tuple(c.name for c in graph.collected if c.wire.node == index)
        if isinstance(node, CallNode):
            first = str(node.outputs[0].type) if node.outputs else None
            made.add_node(node.path, kind="block", type=first, clock=str(node.firing), outputs=names)
        elif isinstance(node, SourceNode):
            made.add_node(node.path, kind="source", type=str(node.type), clock=str(node.clock), outputs=names)
        elif node.role != "stamp":
            made.add_node(node.path, kind=node.role, type=str(node.type), clock=None, outputs=())
    for link in links(graph):
        tail, head = graph.nodes[link.tail], graph.nodes[link.head]
        end = graph.port(Wire(link.tail, link.output)) if link.output is not None else None
        type_ = end.type if end is not None else tail.type if isinstance(tail, RegisterNode) else None
        made.add_edge(
            tail.path, head.path, type=str(type_), clock=None if end is None else str(end.clock),
            output=end.name if end is not None else "", port=link.port, optional=link.optional,
            feedback=link.feedback,
        )  # fmt: skip
    for _, call in graph.calls:
        if call.state is not None:
            state = graph.nodes[call.state]
            assert isinstance(state, RegisterNode)
            common = {"type": str(state.type), "output": "", "port": "state", "optional": False}
            made.add_edge(state.path, call.path, clock=None, feedback=False, **common)
            made.add_edge(call.path, state.path, clock=str(call.firing), feedback=True, **common)
    return made


def scope_of(graph: Graph, path: str) -> str:
    """The innermost nested graph that a path is in; empty at the top."""
    return max((s for s in graph.scopes if path.startswith(s + "/")), key=len, default="")


def folded_scopes(graph: Graph, fold: int | None) -> list[str]:
    """The nested graphs that are one box, or one line, when what is deeper than `fold` is not shown.

    Raises:
        DeclarationError: for a depth that is not a whole number from 0.
    """
    if fold is None:
        return []
    if not isinstance(fold, int) or fold < 0:
        raise DeclarationError(
            "fold is a depth of nesting", path=graph.name, expected="None, or a whole number from 0",
            got=repr(fold), fix="write fold=0 for the outermost boxes only",
        )  # fmt: skip
    return [s for s in graph.scopes if scope_depth(graph, s) == fold]


def scope_depth(graph: Graph, scope: str) -> int:
    """How many nested graphs are around one."""
    return sum(scope.startswith(other + "/") for other in graph.scopes)


def name_in(scope: str, path: str) -> str:
    """A path as it reads inside a scope."""
    return path.removeprefix(scope + "/") if scope else path


def draw_text(
    graph: Graph,
    *,
    fold: int | None = None,
    width: int | None = None,
    inputs: Flight | Mapping[str, Any] | None = None,
) -> str:
    """The graph as plain text of about 100 columns: sources, blocks in firing order, registers, outputs.

    Args:
        fold: graphs nested deeper than this are one line: 0 folds all of them, None none.
        width: the columns of a narrower page, on which long lines go on in the next; names are not cut.
        inputs: what the sources are fed; of one whose values arrive late the text says so.
    """
    doc = doc_words(graph.doc)
    text = textwrap.wrap(f"{graph.name}: {doc}" if doc else graph.name, WIDTH, subsequent_indent="  ")
    parts = [
        ("sources", _sources(graph, lateness_words(inputs))),
        ("blocks, in firing order", _blocks(graph, fold)),
    ]
    parts += [("registers", _registers(graph)), ("outputs", _outputs(graph))]
    parts = [(heading, lines) for heading, lines in parts if lines]
    for k, (heading, lines) in enumerate(parts):
        last = k == len(parts) - 1
        text += ["│", ("└─ " if last else "├─ ") + heading]
        text += [(("   " if last else "│  ") + line).rstrip() for line in lines]
    if width is not None:
        text = [part for line in text for part in _narrow(line, width)]
    return "\n".join(text) + "\n"


def _narrow(line: str, width: int) -> list[str]:
    """A line as several of at most `width` columns, if no word is longer; bars go on at their left."""
    bars = re.match(r"[│ ]*", line)[0]  # type: ignore[index]
    words = line[len(bars) :].split()
    lines, now = [], bars
    for word in words:
        if len(now) > len(bars) and len(now) + 1 + len(word) > width:
            lines.append(now)
            now = f"{bars}    {word}"
        else:
            now = f"{now} {word}" if len(now) > len(bars) else bars + word
    return [line] if len(line) <= width else [*lines, now]


def _columns(rows: Sequence[tuple[str, ...]], most: int = 32) -> list[str]:
    """Rows whose cells stand under each other; a cell longer than `most` does not widen its column."""
    widths = [
        max((len(c) for c in column if len(c) <= most), default=0) for column in zip(*rows, strict=True)
    ]
    return ["  ".join(c.ljust(w) for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]


def _sources(graph: Graph, lateness: Mapping[str, str]) -> list[str]:
    rows = []
    for index, node in enumerate(graph.nodes):
        if isinstance(node, SourceNode):
            timing = clock_words(graph, Wire(index, 0))
            if node.clock.timing.jitter:
                timing += f", jitter {duration_words(node.clock.timing.jitter)}"
            if late := lateness.get(node.path):
                timing += f", {late}"
            rows.append((f"▷ {node.path}", type_words(node.type), timing))
    return _columns(rows)


def _blocks(graph: Graph, fold: int | None) -> list[str]:
    """A heading for each block and a row for each of its ends; all rows are aligned together."""
    readers = _readers(graph)
    shut = folded_scopes(graph, fold)
    seen: set[str] = set()
    lines: list[str] = []
    rows: list[tuple[str, ...]] = []
    places: list[int] = []
    opened: list[str] = []
    for number, (index, call) in enumerate(graph.calls, start=1):
        scope = scope_of(graph, call.path)
        closed = next((s for s in shut if call.path.startswith(s + "/")), None)
        if closed is not None:
            scope = scope_of(graph, closed)
        chain = sorted((s for s in graph.scopes if f"{scope}/".startswith(s + "/")), key=len)
        while opened != chain[: len(opened)]:
            opened.pop()
            lines.append("│  " * len(opened) + "╰─")
        for inner in chain[len(opened) :]:
            parent = opened[-1] if opened else ""
            lines.append("│  " * len(opened) + f"╭─ {name_in(parent, inner)}")
            opened.append(inner)
        bars = "│  " * len(opened)
        if closed is not None:
            if closed not in seen:
                seen.add(closed)
                count = sum(c.path.startswith(closed + "/") for _, c in graph.calls)
                words = f"{count} block" + "s" * (count != 1)
                lines.append(f"{bars}{number:>2} {name_in(scope, closed)}: {words}, folded")
            continue
        lines.append(bars + _heading(graph, call, scope, number))
        for port, argument in zip(call.block.ports, call.arguments, strict=True):
            if argument.wire is not None or argument.register is not None:
                places.append(len(lines))
                rows.append((f"{bars}     {port.name}", *_origin(graph, argument, scope)))
                lines.append("")
        for k, out in enumerate(call.outputs):
            to = ", ".join(name_in(scope, path) for path in readers.get(Wire(index, k), ["nothing"]))
            end = f"{bars}     {out.name}", f"─▷ {to}"
            places.append(len(lines))
            rows.append((*end, shorten(type_words(out.type), 32), clock_words(graph, Wire(index, k))))
            lines.append("")
    for place, row in zip(places, _columns(rows), strict=True):
        lines[place] = row
    return lines + ["│  " * depth + "╰─" for depth in reversed(range(len(opened)))]


def _heading(graph: Graph, call: CallNode, scope: str, number: int) -> str:
    name = name_in(scope, call.path)
    block = block_words(call, name)
    notes = [firing_words(graph, call), queue_words(call), "keeps a state" if call.state is not None else ""]
    notes.append("on the host" if call.block.host else "")
    return "   ".join([f"{number:>2} {name}" + (f" = {block}(…)" if block else ""), *filter(None, notes)])


def _origin(graph: Graph, argument: Argument, scope: str) -> tuple[str, str, str]:
    """Where an input comes from, its type, and how it is there."""
    if argument.register is not None:
        register = graph.nodes[argument.register]
        assert isinstance(register, RegisterNode)
        arrow, how = ("◁╌", "held from the tick before") if register.role == "delay" else ("◁─", "held")
        return f"{arrow} {name_in(scope, register.path)}", shorten(type_words(register.type), 32), how
    assert argument.wire is not None
    how = "fresh or absent" if argument.optional else "fresh"
    type_ = shorten(type_words(graph.port(argument.wire).type), 32)
    return f"◁─ {name_in(scope, graph.label(argument.wire))}", type_, how


def _readers(graph: Graph) -> dict[Wire, list[str]]:
    """Who reads each output: blocks, registers, and the outputs of the graph."""
    found: dict[Wire, dict[str, None]] = {}
    for _, call in graph.calls:
        for argument in call.arguments:
            if argument.wire is not None:
                found.setdefault(argument.wire, {})[call.path] = None
    for _, register in graph.registers:
        if register.feed is not None:
            found.setdefault(register.feed, {})[register.path] = None
    for collected in graph.collected:
        found.setdefault(collected.wire, {})[f"● {collected.name}"] = None
    return {wire: list(paths) for wire, paths in found.items()}


def _registers(graph: Graph) -> list[str]:
    owners = {call.state: call.path for _, call in graph.calls}
    rows = []
    for index, register in graph.registers:
        if register.role == "stamp":
            continue
        feed = graph.label(register.feed) if register.feed is not None else owners.get(index, "")
        arrow = "◁─" if register.role == "latest" else "◁╌"
        start = f"init {initial_words(register)}"
        type_ = shorten(type_words(register.type), 24)
        rows.append((f"▪ {register.path}", register.role, type_, start, f"{arrow} {feed}"))
    return _columns(rows)


def _outputs(graph: Graph) -> list[str]:
    rows = []
    for name, wire in ((c.name, c.wire) for c in graph.collected):
        type_ = shorten(type_words(graph.port(wire).type), 32)
        rows.append((f"● {name}", f"◁─ {graph.label(wire)}", type_, clock_words(graph, wire)))
    return _columns(rows)
