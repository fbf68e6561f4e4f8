"""The block diagram: what a graph looks like to the person who must believe in it.

Sources stand on the left, outputs on the right, and blocks between them in boxes that nest as the graphs do.
Wires say what they carry and when. Memory has a colour of its own, and a wire into a delay is dashed, since what
it carries is read one tick later: without the dashed wires a diagram has no cycle. The diagram is written as
DOT; the layout is done by the `dot` program where there is one, else by the Graphviz inside pygraphviz.
"""

from __future__ import annotations

import html
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from flowgraph.draw_text import (
    block_words,
    clock_words,
    doc_words,
    firing_words,
    initial_words,
    name_in,
    queue_words,
    scope_of,
    shorten,
    type_words,
)
from flowgraph.errors import DeclarationError, MissingDependencyError, UnknownNameError
from flowgraph.graph import CallNode, Graph, RegisterNode, SourceNode, Wire

if TYPE_CHECKING:
    import networkx

ENDINGS = (".svg", ".png", ".pdf", ".dot", ".gv")
DIRECTIONS = ("LR", "TB", "RL", "BT")
FONT = "Helvetica,Arial,sans-serif"

INK, GREY, RULE = "#22303c", "#6b7785", "#8a97a5"
# (fill, line) of each kind of node
COLOURS = {
    "source": ("#e3f1e5", "#4f8a5b"),
    "call": ("#eef3fa", "#5b7fae"),
    "host": ("#f3f1ee", "#8b8378"),
    "register": ("#fdf1d8", "#b98a2f"),
    "folded": ("#e6e9f5", "#5f6ca8"),
    "output": ("#f7e6ea", "#a85a6d"),
}
CLUSTERS = ("#f8fafc", "#f0f3f7", "#e8edf2")


class Link(NamedTuple):
    """One arrow: from an output (or a register, where `output` is None) to a port of a node."""

    tail: int
    output: int | None
    head: int
    port: str
    optional: bool
    feedback: bool


def links(graph: Graph) -> Iterator[Link]:
    """All arrows between sources, blocks and the registers that a reader sees; a state belongs to its block."""
    for index, node in enumerate(graph.nodes):
        if isinstance(node, CallNode):
            for port, argument in zip(node.block.ports, node.arguments, strict=True):
                if argument.wire is not None:
                    yield Link(*argument.wire, index, port.name, argument.optional, False)
                elif argument.register is not None:
                    yield Link(argument.register, None, index, port.name, argument.optional, False)
        elif isinstance(node, RegisterNode) and node.feed is not None:
            yield Link(*node.feed, index, "", False, node.role == "delay")


def draw(
    graph: Graph,
    file: str | Path | None = None,
    *,
    rankdir: str = "LR",
    fold: int | None = None,
    legend: bool = True,
) -> str | Path:
    """Draw the block diagram.

    Args:
        file: where to write it; its ending (.svg, .png, .pdf, .dot or .gv) says what. None: return SVG text.
        rankdir: which way values flow: "LR" left to right, "TB" top to bottom, "RL" or "BT".
        fold: graphs nested deeper than this are drawn as one box: 0 folds all of them, None none.
        legend: whether to say below the title what the kinds of arrow mean.

    Raises:
        UnknownNameError: for another ending or direction.
        MissingDependencyError: where nothing can lay out the diagram.
    """
    path = None if file is None else Path(file)
    ending = ".svg" if path is None else path.suffix.lower()
    if ending not in ENDINGS:
        raise UnknownNameError("file ending", ending, ENDINGS, path=str(file))
    source = dot_source(graph, rankdir=rankdir, fold=fold, legend=legend)
    if path is None:
        text = _render(source, "svg").decode()
        return text[text.index("<svg") :]  # without the XML prolog, so that it can stand in a page
    made = source.encode() if ending in (".dot", ".gv") else _render(source, ending[1:])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(made)
    return path


def _render(source: str, kind: str) -> bytes:
    """The laid-out diagram as bytes of an SVG, PNG or PDF."""
    if kind == "png":
        source = source.replace("{", "{ dpi=144;", 1)
    if shutil.which("dot"):
        import graphviz

        return bytes(graphviz.Source(source).pipe(format=kind, encoding=None, quiet=True))
    try:
        import pygraphviz
    except ImportError:
        raise MissingDependencyError(
            "nothing here can lay out a diagram",
            expected="a `dot` program on PATH, or the Python package pygraphviz",
            got="neither",
            fix="pip install pygraphviz, or install Graphviz; graph.text() needs neither",
        ) from None
    return bytes(pygraphviz.AGraph(string=source).draw(format=kind, prog="dot"))


def dot_source(graph: Graph, *, rankdir: str = "LR", fold: int | None = None, legend: bool = True) -> str:
    """The diagram in the DOT language; the arguments are those of `draw`."""
    if rankdir not in DIRECTIONS:
        raise UnknownNameError("rankdir", rankdir, DIRECTIONS, path=graph.name)
    if fold is not None and (not isinstance(fold, int) or fold < 0):
        raise DeclarationError(
            "fold is a depth of nesting", path=graph.name, expected="None, or a whole number from 0",
            got=repr(fold), fix="write fold=0 for the outermost boxes only",
        )  # fmt: skip
    return _Diagram(graph, rankdir, fold).source(legend)


def to_networkx(graph: Graph) -> networkx.MultiDiGraph:
    """The graph for analysis by networkx.

    Nodes, by path: `kind` ("source", "block", "latest", "delay" or "state"), `type` (a block's: of its
    first output), `clock` (a block's: at which it fires) and `outputs` (names under which it is collected).
    Edges: `type`, `clock` (None: held), `output` and `port` (names of the two ends), `optional`, and
    `feedback`: whether it writes what is read a tick later. Without the feedback edges there is no cycle.
    """
    import networkx

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


def _quoted(text: str) -> str:
    """A DOT string; backslashes and entities in it are taken as they are written."""
    clean = re.sub(r"[\x00-\x1f]", " ", text)
    return '"' + clean.replace("&", "&amp;").replace("\\", "\\\\").replace('"', '\\"') + '"'


def _escaped(text: str) -> str:
    return html.escape(re.sub(r"[\x00-\x1f]", " ", text))


def _font(text: str, *, size: int = 9, colour: str = GREY, tag: str = "") -> str:
    inside = f"<{tag}>{_escaped(text)}</{tag}>" if tag else _escaped(text)
    return f'<font point-size="{size}" color="{colour}">{inside}</font>'


def _attributes(**attributes: object) -> str:
    return "[" + ", ".join(f"{k}={v}" for k, v in attributes.items()) + "]"


class _Diagram:
    """One drawing of one graph: who is visible after folding, and the DOT statements for it."""

    def __init__(self, graph: Graph, rankdir: str, fold: int | None) -> None:
        self.graph, self.rankdir = graph, rankdir
        depths = {s: sum(s.startswith(o + "/") for o in graph.scopes) for s in graph.scopes}
        self.open = [s for s in graph.scopes if fold is None or depths[s] < fold]
        self.folded = [s for s in graph.scopes if fold is not None and depths[s] == fold]
        self.links = list(links(graph))

    def visible(self, index: int) -> str:
        """The name of the box that stands for a node: its own path, or the folded graph around it."""
        path = self.graph.nodes[index].path
        return next((s for s in self.folded if path.startswith(s + "/")), path)

    def source(self, legend: bool) -> str:
        lines = [
            "digraph {",
            f'rankdir={self.rankdir}; fontname="{FONT}"; fontcolor="{INK}"; bgcolor=white; pad=0.2; nodesep=0.3; '
            "ranksep=0.55; labelloc=t; labeljust=l; newrank=false; compound=true;",
            f"label=<{self.title(legend)}>; tooltip={_quoted(self.graph.name)};",
            f'node [fontname="{FONT}", fontsize=11, fontcolor="{INK}", penwidth=1.1, margin=0, width=0, height=0];',
            f'edge [fontname="{FONT}", fontsize=9, fontcolor="{GREY}", color="{RULE}", arrowsize=0.65, penwidth=1.1];',
        ]
        lines += self.scope("", 0)
        for collected in self.graph.collected:
            label = f"<b>{_escaped(collected.name)}</b>"
            lines.append(
                self.node(
                    f"output: {collected.name}", "output", label, "ellipse", "output", margin='"0.1,0.04"'
                )
            )
        return "\n".join([*lines, *self.edges(), "}", ""])

    def title(self, legend: bool) -> str:
        rows = [_font(self.graph.name, size=15, colour=INK, tag="b")]
        if doc := doc_words(self.graph.doc):
            rows.append(_font(shorten(doc, 110), size=10))
        notes = []
        if any(link.feedback for link in self.links):
            notes.append("dashed: read one tick later")
        if any(link.optional for link in self.links):
            notes.append("hollow arrow: may be absent")
        if self.triggers():
            notes.append("dotted: only fires")
        if legend and notes:
            rows.append(_font(" · ".join(notes), size=9, tag="i"))
        return '<br align="left"/>'.join([*rows, ""])

    def scope(self, scope: str, depth: int) -> list[str]:
        """The statements for all that is directly in a scope, and for the open scopes in it."""
        graph, lines = self.graph, []
        for index, node in enumerate(graph.nodes):
            if self.visible(index) == node.path and self.inside(node.path) == scope:
                if isinstance(node, SourceNode):
                    lines.append(self.source_node(node))
                elif isinstance(node, CallNode):
                    lines.append(self.call_node(index, node, scope))
                elif node.role in ("latest", "delay"):
                    lines.append(self.register_node(node, scope))
        for path in self.folded:
            if self.inside(path) == scope:
                lines.append(self.folded_node(path, scope))
        for path in self.open:
            if self.inside(path) == scope:
                fill = CLUSTERS[min(depth, len(CLUSTERS) - 1)]
                label = f"label=<{_font(name_in(scope, path), size=11, tag='b')}>; tooltip={_quoted(path)};"
                look = f'style="rounded,filled"; fillcolor="{fill}"; color="#c5ced8"; margin=12; labeljust=l; labelloc=t;'
                lines += [
                    f"subgraph {_quoted('cluster ' + path)} {{",
                    label,
                    look,
                    *self.scope(path, depth + 1),
                    "}",
                ]
        return lines

    def inside(self, path: str) -> str:
        return max((s for s in self.open if path.startswith(s + "/")), key=len, default="")

    def node(self, name: str, kind: str, label: str, shape: str, tooltip: str, **more: object) -> str:
        fill, line = COLOURS[kind]
        look: dict[str, object] = {"shape": shape, "style": '"rounded,filled"' if shape == "box" else "filled"}
        look |= {"fillcolor": f'"{fill}"', "color": f'"{line}"', "tooltip": _quoted(tooltip), **more}
        return f"{_quoted(name)} {_attributes(label=f'<{label}>', **look)};"

    def source_node(self, node: SourceNode) -> str:
        tip = f"source {node.path}: {node.type}, {node.clock.timing}"
        return self.node(
            node.path, "source", f"<b>{_escaped(node.path)}</b>", "cds", tip, margin='"0.14,0.08"'
        )

    def register_node(self, node: RegisterNode, scope: str) -> str:
        name = name_in(scope, node.path)
        role = "" if re.fullmatch(rf"{node.role}(_\d+)?", name) else f"{node.role}, "
        label = f"{_font(name, size=10, colour=INK, tag='b')}<br/>{_font(f'{role}init {initial_words(node)}', size=8)}"
        tip = f"{node.role} {node.path}: {node.type}"
        return self.node(node.path, "register", label, "cylinder", tip, margin='"0.08,0.02"')

    def folded_node(self, path: str, scope: str) -> str:
        inner = [n for n in self.graph.nodes if n.path.startswith(path + "/")]
        blocks = sum(isinstance(n, CallNode) for n in inner)
        label = f"<b>{_escaped(name_in(scope, path))}</b><br/>{_font(f'{blocks} blocks')}"
        return self.node(path, "folded", label, "box", f"graph {path}", peripheries=2, margin='"0.18,0.1"')

    def call_node(self, index: int, call: CallNode, scope: str) -> str:
        """A box with port names on the side where values come in, where there are several, and likewise out."""
        name, host = name_in(scope, call.path), call.block.host
        rows = [f"<tr><td><b>{_escaped(name)}</b></td></tr>"]
        notes = [
            block_words(call, name),
            shorten(firing_words(self.graph, call), 40),
            "on the host" if host else "",
        ]
        rows += [f"<tr><td>{_font(note, tag='i')}</td></tr>" for note in notes if note]
        chips = [queue_words(call)]
        if call.state is not None:
            state = self.graph.nodes[call.state]
            assert isinstance(state, RegisterNode)
            chips.append(shorten(f"state {type_words(state.type)}, init {initial_words(state)}", 34))
        fill, line = COLOURS["register"]
        for chip in filter(None, chips):
            look = f'border="1" style="rounded" color="{line}" bgcolor="{fill}"'
            rows.append(f"<tr><td {look}>{_font(chip, size=8)}</td></tr>")
        middle = f'<td><table border="0" cellspacing="2" cellpadding="1">{"".join(rows)}</table></td>'
        ins = [
            (f"i{k}", f"{port.name}?" if a.optional else port.name)
            for k, (port, a) in enumerate(zip(call.block.ports, call.arguments, strict=True))
            if a.wire is not None or a.register is not None
        ]
        outs = [(f"o{k}", port.name) for k, port in enumerate(call.outputs)]
        first, last = self._side(ins, "left"), self._side(outs, "right")
        if self.rankdir in ("RL", "BT"):
            first, last = last, first
        if self.rankdir in ("LR", "RL"):
            body = f"<tr>{first}{middle}{last}</tr>"
        else:
            body = "".join(f"<tr>{part}</tr>" for part in (first, middle, last) if part)
        label = f'<table border="0" cellspacing="0" cellpadding="3">{body}</table>'
        tip = f"{call.path}: {doc_words(call.block) or call.block.name}"
        return self.node(call.path, "host" if host else "call", label, "box", tip)

    def _side(self, ends: list[tuple[str, str]], align: str) -> str:
        if len(ends) < 2:
            return ""
        cells = [f'<td port="{port}" align="{align}">{_font(name, size=8)}</td>' for port, name in ends]
        if self.rankdir in ("LR", "RL"):
            rows = "".join(f"<tr>{cell}</tr>" for cell in cells)
        else:
            rows = f"<tr>{''.join(cells)}</tr>"
        return f'<td cellpadding="0"><table border="0" cellspacing="0" cellpadding="3">{rows}</table></td>'

    def triggers(self) -> list[tuple[int, int]]:
        """(source or block, block) where the first is wired to nothing and only makes the second fire."""
        from flowgraph.clock import atoms

        wired = {link.tail for link in self.links} | {c.wire.node for c in self.graph.collected}
        found = []
        for index, node in enumerate(self.graph.nodes):
            if index in wired or isinstance(node, RegisterNode):
                continue
            own = [node.clock] if isinstance(node, SourceNode) else [p.clock for p in node.outputs]
            found += [(index, i) for i, call in self.graph.calls if set(own) & set(atoms(call.firing))]
        return found

    def edges(self) -> list[str]:
        lines = []
        for link in self.links:
            tail, head = self.visible(link.tail), self.visible(link.head)
            if tail != head:
                lines.append(self.edge(link, tail, head))
        for collected in self.graph.collected:
            name, wire = f"output: {collected.name}", collected.wire
            lines.append(self.edge(Link(*wire, -1, "", False, False), self.visible(wire.node), name))
        for index, fired in self.triggers():
            look = _attributes(style="dotted", arrowhead="odot", tooltip=_quoted("fires"))
            lines.append(f"{_quoted(self.visible(index))} -> {_quoted(self.visible(fired))} {look};")
        return list(dict.fromkeys(lines))

    def edge(self, link: Link, tail: str, head: str) -> str:
        graph = self.graph
        node = graph.nodes[link.tail]
        look: dict[str, object] = {}
        if link.output is None:
            assert isinstance(node, RegisterNode)
            words, when = type_words(node.type), ""
            look["color"] = f'"{COLOURS["register"][1]}"'
        else:
            wire = Wire(link.tail, link.output)
            words, when = type_words(graph.port(wire).type), clock_words(graph, wire)
        full = ", ".join(filter(None, (words, when or "held")))
        short = [shorten(words, 26), shorten(when, 26)]
        together = ", ".join(filter(None, short))
        text = [together] if len(together) <= 18 else list(filter(None, short))
        look["label"] = "<" + "<br/>".join(f" {_escaped(t)} " for t in text) + ">"
        ends = [self._end(link, tail, False), self._end(link, head, True)]
        where = f"{graph.label(wire) if link.output is not None else node.path} → {head}"
        tip = f"{where}{'.' + link.port if link.port else ''}: {full}"
        look |= {"tooltip": _quoted(tip), "labeltooltip": _quoted(tip)}
        if link.optional:
            look["arrowhead"] = "onormal"
        if link.feedback:
            look |= {"style": "dashed", "constraint": "false", "color": f'"{COLOURS["register"][1]}"'}
        return f"{ends[0]} -> {ends[1]} {_attributes(**look)};"

    def _end(self, link: Link, name: str, is_head: bool) -> str:
        """An end of an edge: at the named cell of the box where it has one."""
        index = link.head if is_head else link.tail
        node = self.graph.nodes[index] if index >= 0 else None
        if not isinstance(node, CallNode) or node.path != name:
            return _quoted(name)
        sides = dict(zip(("LR", "RL", "TB", "BT"), ("we", "ew", "ns", "sn"), strict=True))[self.rankdir]
        if is_head:
            given = [k for k, a in enumerate(node.arguments) if a.wire is not None or a.register is not None]
            place = next(k for k, port in enumerate(node.block.ports) if port.name == link.port)
            return f"{_quoted(name)}:i{place}:{sides[0]}" if len(given) > 1 else f"{_quoted(name)}:{sides[0]}"
        return f"{_quoted(name)}:o{link.output}:{sides[1]}" if len(node.outputs) > 1 else _quoted(name)
