"""The block diagram: what a graph looks like to the person who must believe in it.

Sources stand on the left, outputs on the right, and blocks between them in boxes that nest as the graphs
do. Wires say what they carry and when. Memory has a colour of its own, and a wire into a delay is dashed,
since what it carries is read one tick later: without the dashed wires a diagram has no cycle. The diagram is
written as DOT; the `dot` program lays it out where there is one, else the Graphviz inside pygraphviz.
"""

from __future__ import annotations

import html
import re
import shutil
import struct
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from flowgraph.data.arrival import lateness_words
from flowgraph.data.files import put
from flowgraph.data.flight import Flight
from flowgraph.drawing.fonts import without_font_warnings
from flowgraph.drawing.page import diagram_page
from flowgraph.drawing.text import (
    Link,
    block_words,
    clock_words,
    doc_words,
    firing_words,
    folded_scopes,
    initial_words,
    links,
    name_in,
    queue_words,
    scope_depth,
    shorten,
    to_networkx,
    triggers,
    type_words,
)
from flowgraph.errors import DeclarationError, MissingDependencyError, UnknownNameError, writes
from flowgraph.language.block import Port
from flowgraph.language.graph import Argument, CallNode, Graph, RegisterNode, SourceNode, Wire

_LONGEST = 32_767
ENDINGS = (".svg", ".png", ".pdf", ".html", ".dot", ".gv")
# for each direction, the sides of a box at which values enter and leave
COMPASS = {"LR": ("w", "e"), "TB": ("n", "s"), "RL": ("e", "w"), "BT": ("s", "n")}
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


def draw(
    graph: Graph,
    file: str | Path | None = None,
    *,
    rankdir: str = "LR",
    fold: int | None = None,
    legend: bool = True,
    words: Mapping[str, str] | None = None,
    inputs: Flight | Mapping[str, Any] | None = None,
) -> str | Path:
    """Draw the block diagram.

    Args:
        file: where to write it; its ending (.svg, .png, .pdf, .html, .dot or .gv) says what. None: return SVG
            text. An .html is a page in which graphs unfold; see `flowgraph.drawing.page`.
        rankdir: which way values flow: "LR" left to right, "TB" top to bottom, "RL" or "BT".
        fold: graphs nested deeper than this are drawn as one box: 0 folds all of them, None none.
        legend: whether to say below the title what the kinds of arrow mean.
        words: a line more for the box of a path, such as its number formats; under "" for the title.
        inputs: what the sources are fed; of one whose values arrive late the diagram says so.

    Raises:
        UnknownNameError: for another ending or direction.
        MissingDependencyError: where nothing can lay out the diagram.
        DeclarationError: for a .png that would be longer than the format allows.
        OutputError: where the file cannot be written.
    """
    path = None if file is None else Path(file)
    ending = ".svg" if path is None else path.suffix.lower()
    if ending not in ENDINGS:
        raise UnknownNameError("file ending", ending, ENDINGS, path=str(file))
    source = dot_source(graph, rankdir=rankdir, fold=fold, legend=legend, words=words, inputs=inputs)
    if ending == ".html":
        costs = {at: {"words": line} for at, line in (words or {}).items()}
        return diagram_page(graph, file, fold=fold, rankdir=rankdir, costs=costs, inputs=inputs)
    if path is None:
        text = _render(source, "svg").decode()
        return text[text.index("<svg") :]  # without the XML prolog, so that it can stand in a page
    made = source.encode() if ending in (".dot", ".gv") else _render(source, ending[1:])
    if ending == ".png":
        made = _whole_png(made)
    with writes(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    return put(path, made)


def _render(source: str, kind: str) -> bytes:
    """The laid-out diagram as bytes of an SVG, PNG or PDF: by `dot`, else by the library in pygraphviz."""
    if kind == "png":
        source = source.replace("{", "{ dpi=144;", 1)
    failed = "no dot program on PATH"
    if shutil.which("dot"):
        import graphviz  # only where its program is

        try:
            return bytes(graphviz.Source(source).pipe(format=kind, encoding=None, quiet=True))
        except (graphviz.CalledProcessError, graphviz.ExecutableNotFound, OSError) as error:
            said = getattr(error, "stderr", None) or str(error)
            words = said.decode(errors="replace") if isinstance(said, bytes) else str(said)
            failed = f"a dot program that fails: {shorten(' '.join(words.split()), 200)}"
    try:
        import pygraphviz  # may be absent
    except ImportError:
        raise MissingDependencyError(
            "nothing here can lay out a diagram",
            expected="a `dot` program that works, or the Python package pygraphviz",
            got=f"{failed}, and no pygraphviz",
            fix="pip install pygraphviz, or install Graphviz; graph.text() needs neither",
        ) from None
    with without_font_warnings():
        return bytes(pygraphviz.AGraph(string=source).draw(format=kind, prog="dot"))


def _whole_png(made: bytes) -> bytes:
    """The picture itself; Graphviz shrinks one that is longer than a PNG can be until nobody can read it."""
    pixels = struct.unpack(">II", made[16:24])  # width and height, as the header has them
    if max(pixels) >= _LONGEST:
        raise DeclarationError(
            "the diagram is too large for a PNG", expected=f"less than {_LONGEST} pixels a side",
            got="more", fix="write an .svg or .pdf, which have no such bound, or fold nested graphs (fold=0)",
        )  # fmt: skip
    return made


def dot_source(
    graph: Graph,
    *,
    rankdir: str = "LR",
    fold: int | None = None,
    legend: bool = True,
    words: Mapping[str, str] | None = None,
    inputs: Flight | Mapping[str, Any] | None = None,
) -> str:
    """The diagram in the DOT language; the arguments are those of `draw`."""
    if rankdir not in COMPASS:
        raise UnknownNameError("rankdir", rankdir, COMPASS, path=graph.name)
    return _Diagram(graph, rankdir, fold, words or {}, lateness_words(inputs)).source(legend)


def _plain(text: str) -> str:
    return re.sub(r"[\x00-\x1f]", " ", text)


def _quoted(text: str) -> str:
    """A DOT string; backslashes and entities in it are taken as they are written."""
    return '"' + _plain(text).replace("&", "&amp;").replace("\\", "\\\\").replace('"', '\\"') + '"'


def _escaped(text: str) -> str:
    return html.escape(_plain(text))


def _font(text: str, *, size: int = 9, colour: str = GREY, tag: str = "") -> str:
    inside = f"<{tag}>{_escaped(text)}</{tag}>" if tag else _escaped(text)
    return f'<font point-size="{size}" color="{colour}">{inside}</font>'


def _table(rows: list[str], spacing: int = 0, padding: int = 2) -> str:
    return f'<table border="0" cellspacing="{spacing}" cellpadding="{padding}">{"".join(rows)}</table>'


def _attributes(label: str = "", **attributes: object) -> str:
    """A DOT attribute list; `label` is in Graphviz's HTML."""
    parts = [f"label=<{label}>"] if label else []
    return "[" + ", ".join([*parts, *(f"{k}={_quoted(str(v))}" for k, v in attributes.items())]) + "]"


class _Diagram:
    """One drawing of one graph: who is visible after folding, and the DOT statements for it."""

    def __init__(
        self,
        graph: Graph,
        rankdir: str,
        fold: int | None,
        words: Mapping[str, str],
        lateness: Mapping[str, str],
    ) -> None:
        self.graph, self.rankdir, self.words, self.lateness = graph, rankdir, words, lateness
        self.folded = folded_scopes(graph, fold)
        self.open = [s for s in graph.scopes if fold is None or scope_depth(graph, s) < fold]
        self.links = list(links(graph))
        self.along = rankdir in ("LR", "RL")
        self.enter, self.leave = COMPASS[rankdir]

    def visible(self, index: int) -> str:
        """The name of the box that stands for a node: its own path, or the folded graph around it."""
        path = self.graph.nodes[index].path
        return next((s for s in self.folded if path.startswith(s + "/")), path)

    def inside(self, path: str) -> str:
        """The innermost open scope around a path."""
        return max((s for s in self.open if path.startswith(s + "/")), key=len, default="")

    def source(self, legend: bool) -> str:
        lines = [
            "digraph {",
            f"rankdir={self.rankdir}; bgcolor=white; pad=0.2; nodesep=0.3; ranksep=0.55;",
            f'labelloc=t; labeljust=l; fontname="{FONT}"; fontcolor="{INK}";',
            f"label=<{self.title(legend)}>; tooltip={_quoted(self.graph.name)};",
            f'node [fontname="{FONT}", fontsize=11, fontcolor="{INK}", margin=0, width=0, height=0];',
            f'edge [fontname="{FONT}", fontsize=9, fontcolor="{GREY}", color="{RULE}", arrowsize=0.65];',
            *self.scope("", 0),
        ]
        for name in (c.name for c in self.graph.collected):
            label = f"<b>{_escaped(name)}</b>"
            lines.append(
                self.node(f"output: {name}", "output", label, "ellipse", "output", margin="0.1,0.04")
            )
        return "\n".join([*lines, *self.edges(), "}", ""])

    def title(self, legend: bool) -> str:
        rows = [_font(self.graph.name, size=15, colour=INK, tag="b")]
        if doc := doc_words(self.graph.doc):
            rows.append(_font(shorten(doc, 110), size=10))
        if "" in self.words:
            rows.append(_font(self.words[""], size=10))
        notes = ["dashed: read one tick later"] if any(link.feedback for link in self.links) else []
        notes += ["hollow arrow: may be absent"] if any(link.optional for link in self.links) else []
        notes += ["dotted: only fires"] if triggers(self.graph) else []
        if legend and notes:
            rows.append(_font(" · ".join(notes), tag="i"))
        return _table([f'<tr><td align="left">{row}</td></tr>' for row in rows])

    def scope(self, scope: str, depth: int) -> list[str]:
        """The statements for all that is directly in a scope, and for the open scopes in it."""
        lines = []
        for index, node in enumerate(self.graph.nodes):
            if self.visible(index) == node.path and self.inside(node.path) == scope:
                if isinstance(node, SourceNode):
                    lines.append(self.source_node(node))
                elif isinstance(node, CallNode):
                    lines.append(self.call_node(node, scope))
                elif node.role in ("latest", "delay"):
                    lines.append(self.register_node(node, scope))
        lines += [self.folded_node(path, scope) for path in self.folded if self.inside(path) == scope]
        for path in (p for p in self.open if self.inside(p) == scope):
            fill = CLUSTERS[min(depth, len(CLUSTERS) - 1)]
            label = _font(name_in(scope, path), size=11, tag="b")
            lines += [
                f"subgraph {_quoted('cluster ' + path)} {{ label=<{label}>; tooltip={_quoted(path)};",
                f'style="rounded,filled"; fillcolor="{fill}"; color="#c5ced8"; margin=12; labeljust=l;',
                *self.scope(path, depth + 1),
                "}",
            ]
        return lines

    def node(self, name: str, kind: str, label: str, shape: str, tooltip: str, **more: object) -> str:
        fill, line = COLOURS[kind]
        style = "rounded,filled" if shape == "box" else "filled"
        look = _attributes(
            label, shape=shape, style=style, fillcolor=fill, color=line, tooltip=tooltip, **more
        )
        return f"{_quoted(name)} {look};"

    def source_node(self, node: SourceNode) -> str:
        tip = f"source {node.path}: {node.type}, {node.clock.timing}"
        if node.path != node.clock.name:
            tip = f"when the values of {node.clock.name} were true: {node.type}, with each of them"
        shape = {"TB": "invhouse", "BT": "house"}.get(self.rankdir, "cds")
        label = f"<b>{_escaped(node.path)}</b>{self.below(node.path)}"
        if late := self.lateness.get(node.path):
            label += f"<br/>{_font(late)}"
            tip += f", {late}"
        margin = "0.14,0.12" if late else "0.14,0.08"
        return self.node(node.path, "source", label, shape, tip, margin=margin)

    def below(self, path: str) -> str:
        """A line under a name, where there is one more to say."""
        return f"<br/>{_font(self.words[path], size=8)}" if path in self.words else ""

    def register_node(self, node: RegisterNode, scope: str) -> str:
        name = name_in(scope, node.path)
        role = "" if re.fullmatch(rf"{node.role}(_\d+)?", name) else f"{node.role}, "
        start = _font(f"{role}init {initial_words(node)}", size=8)
        label = f"{_font(name, size=10, colour=INK, tag='b')}<br/>{start}{self.below(node.path)}"
        tip = f"{node.role} {node.path}: {node.type}"
        return self.node(node.path, "register", label, "cylinder", tip, margin="0.08,0.05")

    def folded_node(self, path: str, scope: str) -> str:
        blocks = sum(call.path.startswith(path + "/") for _, call in self.graph.calls)
        count = _font(f"{blocks} block" + "s" * (blocks != 1))
        label = f"<b>{_escaped(name_in(scope, path))}</b><br/>{count}"
        return self.node(path, "folded", label, "box", f"graph {path}", peripheries=2, margin="0.18,0.1")

    def call_node(self, call: CallNode, scope: str) -> str:
        """A box with the names of its inputs on one side, where there are several; outputs alike."""
        name, host = name_in(scope, call.path), call.block.host
        rows = [f"<tr><td><b>{_escaped(name)}</b></td></tr>"]
        notes = [block_words(call, name), shorten(firing_words(self.graph, call), 44), "on the host" * host]
        notes.append(self.words.get(call.path, ""))
        rows += [f"<tr><td>{_font(note, tag='i')}</td></tr>" for note in notes if note]
        chip = queue_words(call)
        if call.state is not None and not chip:
            state = self.graph.nodes[call.state]
            assert isinstance(state, RegisterNode)
            chip = shorten(f"state {type_words(state.type)}, init {initial_words(state)}", 34)
        if chip:
            fill, line = COLOURS["register"]
            look = f'border="1" style="rounded" color="{line}" bgcolor="{fill}"'
            rows.append(f"<tr><td {look}>{_font(chip, size=8)}</td></tr>")
        given = [(k, p.name + "?" * a.optional) for k, p, a in _connected(call)]
        sides = [
            self.side([(f"i{k}", port) for k, port in given], "left"),
            f"<td>{_table(rows, spacing=2, padding=1)}</td>",
            self.side([(f"o{k}", port.name) for k, port in enumerate(call.outputs)], "right"),
        ]
        if self.rankdir in ("RL", "BT"):
            sides.reverse()
        body = (
            [f"<tr>{''.join(sides)}</tr>"] if self.along else [f"<tr>{side}</tr>" for side in sides if side]
        )
        tip = f"{call.path}: {doc_words(call.block) or call.block.name}"
        return self.node(call.path, "host" if host else "call", _table(body, padding=3), "box", tip)

    def side(self, ends: list[tuple[str, str]], align: str) -> str:
        if len(ends) < 2:
            return ""
        cells = [f'<td port="{port}" align="{align}">{_font(name, size=8)}</td>' for port, name in ends]
        rows = [f"<tr>{cell}</tr>" for cell in cells] if self.along else ["<tr>", *cells, "</tr>"]
        return f'<td cellpadding="0">{_table(rows, padding=3)}</td>'

    def edges(self) -> list[str]:
        """One arrow for each link that shows; links into one folded box that carry the same are one."""
        groups: dict[tuple[object, ...], list[Link]] = {}
        for link in self.links:
            head = self.visible(link.head)
            if self.visible(link.tail) != head:
                groups.setdefault((link.tail, link.output, head, head in self.folded or link), []).append(
                    link
                )
        lines = []
        for (_, _, name, _), group in groups.items():
            optional, feedback = all(k.optional for k in group), all(k.feedback for k in group)
            lines.append(self.edge(group[0]._replace(optional=optional, feedback=feedback), str(name)))
        for collected in self.graph.collected:
            lines.append(self.edge(Link(*collected.wire, -1, "", False, False), f"output: {collected.name}"))
        for index, fired in triggers(self.graph):
            tail, head = self.tail(Link(index, 0, fired, "", False, False)), self.visible(fired)
            look = _attributes(style="dotted", arrowhead="odot", tooltip="fires")
            lines.append(f"{tail} -> {_quoted(head)} {look};")
        return lines

    def edge(self, link: Link, head: str) -> str:
        node = self.graph.nodes[link.tail]
        look: dict[str, object] = {}
        if link.output is None:
            assert isinstance(node, RegisterNode)
            words, when, origin = type_words(node.type), "", node.path
        else:
            wire = Wire(link.tail, link.output)
            words, when = type_words(self.graph.port(wire).type), clock_words(self.graph, wire)
            origin = self.graph.label(wire)
        short = [shorten(part, 36) for part in (words, when) if part]
        text = short if sum(map(len, short)) > 16 else [", ".join(short)]
        label = "<br/>".join(f" {_escaped(line)} " for line in text)
        port = f".{link.port}" if link.port and head not in self.folded else ""
        look["tooltip"] = look["labeltooltip"] = f"{origin} → {head}{port}: {words}, {when or 'held'}"
        if link.output is None or link.feedback:
            look["color"] = COLOURS["register"][1]
        if link.optional:
            look["arrowhead"] = "onormal"
        if link.feedback:
            look["style"] = "dashed"
            if self.returns(link):  # laid out as if it left the register, so that all else flows one way
                return f"{_quoted(head)} -> {self.tail(link)} {_attributes(label, dir='back', **look)};"
        return f"{self.tail(link)} -> {self.head(link, head)} {_attributes(label, **look)};"

    def returns(self, link: Link) -> bool:
        """Whether what is fed back came from the register that it goes to."""
        reached, rest = {link.head}, [link.head]
        while rest:
            now = rest.pop()
            new = {k.head for k in self.links if k.tail == now} - reached
            reached |= new
            rest += new
        return link.tail in reached

    def tail(self, link: Link) -> str:
        """Where an arrow starts: at the cell of the output, where the box has one."""
        node, name = self.graph.nodes[link.tail], self.visible(link.tail)
        if node.path != name or isinstance(node, RegisterNode):
            return _quoted(name)
        if isinstance(node, SourceNode):
            return f"{_quoted(name)}:{self.leave}" if self.rankdir == "LR" else _quoted(name)
        last = len(node.outputs) - 1
        cell = f":o{link.output}" if last else ""
        if link.feedback and link.output in (0, last):  # around the box, not through it
            return f"{_quoted(name)}{cell}:{('ns' if self.along else 'we')[bool(link.output)]}"
        return f"{_quoted(name)}{cell}:{self.leave}"

    def head(self, link: Link, name: str) -> str:
        """Where an arrow ends: at the cell of the port, where the box has one."""
        node = self.graph.nodes[link.head]
        if not isinstance(node, CallNode) or node.path != name:
            return _quoted(name)
        places = {port.name: k for k, port, _ in _connected(node)}
        cell = f":i{places[link.port]}" if len(places) > 1 else ""
        return f"{_quoted(name)}{cell}:{self.enter}"


def _connected(call: CallNode) -> list[tuple[int, Port, Argument]]:
    ends = enumerate(zip(call.block.ports, call.arguments, strict=True))
    return [(k, port, a) for k, (port, a) in ends if a.wire is not None or a.register is not None]


__all__ = ["dot_source", "draw", "to_networkx"]
