"""Reference pages written from the code: each room, each block with its ports, each signal, each graph.

The pages hold a comment where the text goes; the hook puts it there when the site is built. So the
reference cannot fall behind the blocks.
"""

from __future__ import annotations

import importlib
import inspect
import pkgutil
import tomllib
from collections.abc import Collection, Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import gallery

import flowgraph.blocks
from flowgraph import Block, Signal, find_graph
from flowgraph.data.registry import graph_names
from flowgraph.language.block import REQUIRED
from flowgraph.types import StructType, Type, leaves_of, struct_type

PROJECT = Path(__file__).resolve().parents[1] / "pyproject.toml"


def modules() -> list[ModuleType]:
    """The modules of the block library, room by room from the bottom up."""
    rooms = [importlib.import_module(f"flowgraph.blocks.{room}") for room in flowgraph.blocks.__all__]
    names = [info.name for room in rooms for info in pkgutil.iter_modules(room.__path__, f"{room.__name__}.")]
    return [importlib.import_module(name) for name in names]


def public(kind: type) -> Iterator[tuple[ModuleType, str, Any]]:
    """(module, name, object) of each instance or subclass of `kind` that a module defines for others."""
    for module in modules():
        for name, thing in vars(module).items():
            chosen = issubclass(thing, kind) if isinstance(thing, type) else isinstance(thing, kind)
            if chosen and not name.startswith("_") and thing.__module__ == module.__name__:
                yield module, name, thing


def blocks() -> str:
    """A section a room that has blocks, and one a module, with each of its blocks."""
    text: list[str] = []
    last = None
    for module, name, block in public(Block):
        if module is not last:
            room = importlib.import_module(module.__name__.rpartition(".")[0])
            title = f"### {room.__name__}"
            text += [] if title in text else [title, *paragraphs(room)]
            text += [f"### {module.__name__}", *paragraphs(module)]
            last = module
        text += [f"#### {name}", *block_lines(block), fenced(block.step)]
    return "\n\n".join(text)


def block_list() -> str:
    """A line a block, by room: what goes in, what comes out, and what it does."""
    text = [
        "# The blocks, a line each",
        "Written from the code by `python docs/library.py`, and held against it by a test. "
        "With ports, settings and equations: [Blocks](blocks.md#the-library).",
    ]
    rooms: dict[str, list[str]] = {}
    for module, name, block in public(Block):
        room = module.__name__.split(".")[2]
        inputs = ", ".join(p.name + ("?" if p.optional else "") for p in block.ports)
        outputs = ", ".join(str(p.type or "any") for p in block.outputs or ()) or "any"
        what = (inspect.getdoc(block.step) or "").partition("\n\n")[0].replace("\n", " ").replace("|", "\\|")
        cells = (f"`{name}`", inputs, outputs.replace("|", "\\|"), what)
        rooms.setdefault(room, []).append(f"| {' | '.join(cells)} |")
    for room, rows in rooms.items():
        first = paragraphs(importlib.import_module(f"flowgraph.blocks.{room}"))[0].replace("\n", " ")
        text += [f"## {room}", first, "\n".join(["| block | in | out | |", "|---|---|---|---|", *rows])]
    return "\n\n".join(text) + "\n"


def block_lines(block: Block[Any]) -> Iterator[str]:
    """Ports, settings and when it fires."""
    rows = [("in", p.name + (" (optional)" if p.optional else ""), p.type) for p in block.ports]
    outputs = block.outputs or ()
    rows += [("out", p.name + (" (may be absent)" if p.optional else ""), p.type) for p in outputs]
    lines = ["| | port | type |", "|---|---|---|"]
    yield "\n".join([*lines, *(f"| {way} | {name} | {words(type_)} |" for way, name, type_ in rows)])
    main = [f"`{p.name}`" for p in block.ports if not p.optional]
    fires = f"Fires when {' and '.join(main)} {'is' if len(main) == 1 else 'are'} present, or at `at=`."
    settings = [f"`{k}`" if v is REQUIRED else f"`{k}={v!r}`" for k, v in block.settings.items()]
    state = " Has a state." if block.stateful else ""
    host = " Stays in Python: cannot be lowered." if block.host else ""
    yield (
        (fires if main else "Fires when any of its inputs is present.")
        + state
        + host
        + (f" Settings: {', '.join(settings)}." if settings else "")
    )


def rooms() -> str:
    """A section a room, from the ground up: what it says about itself."""
    (contract,) = tomllib.loads(PROJECT.read_text(encoding="utf-8"))["tool"]["importlinter"]["contracts"]
    text: list[str] = []
    for name in reversed(contract["layers"]):
        text += [f"### `{name}`", *paragraphs(importlib.import_module(f"flowgraph.{name}"))]
    return "\n\n".join(text)


def signals() -> str:
    """A table of the signal types."""
    rows = ["| signal | field | type |", "|---|---|---|"]
    for _, name, signal in public(Signal):
        for k, (field, leaf) in enumerate(leaves_of(struct_type(signal))):
            rows.append(f"| {f'`{name}`' if k == 0 else ''} | `{field}` | {leaf} |")
    return "\n".join(rows)


def graphs(page: str, drawn: Collection[str]) -> str:
    """A section for each installed graph that the page has none for, with its diagram if it is drawn."""
    text: list[str] = []
    for name in graph_names():
        if f"## {name}\n" in page:
            continue
        graph = find_graph(name)
        sources, settings = graph.parameters
        rows = ["| source | type | |", "|---|---|---|"]
        rows += [f"| `{n}` | {words(t)} | {'optional' if o else ''} |" for n, (t, o) in sources.items()]
        text += [f"## {name}", *paragraphs(inspect.getmodule(graph.function)), "\n".join(rows)]
        text += [f"Settings: {', '.join(f'`{s}`' for s in settings)}."] if settings else []
        text += [fenced(graph.function)]
        if name in drawn:
            text += [f"[![The diagram of {name}](generated/{name}.svg)](generated/{name}.svg)"]
    return "\n\n".join(text)


def words(type_: Type | None) -> str:
    """A type in a table."""
    if type_ is None:
        return "any"
    return f"`{type_}`" if isinstance(type_, StructType) else str(type_)


def paragraphs(module: ModuleType | None) -> list[str]:
    """What a module says about itself; indented text stays as it is."""
    parts = (inspect.getdoc(module) or "").split("\n\n")
    return [f"```text\n{p}\n```" if p.startswith(" ") else p for p in parts if p]


def fenced(function: Any) -> str:
    """A docstring as it stands, for its equations."""
    doc = inspect.getdoc(function)
    return f"```text\n{doc}\n```" if doc else ""


MARKS = {"<!-- blocks -->": blocks, "<!-- rooms -->": rooms, "<!-- signals -->": signals}


def filled(markdown: str, drawn: Collection[str] = ()) -> str:
    """A page with its marks replaced; `drawn` names the graphs of which there is a diagram."""
    for mark, text in MARKS.items():
        if mark in markdown:
            markdown = markdown.replace(mark, text())
    if "<!-- gallery -->" in markdown:
        markdown = markdown.replace("<!-- gallery -->", gallery.gallery(drawn))
    if "<!-- graphs -->" in markdown:
        markdown = markdown.replace("<!-- graphs -->", graphs(markdown, drawn))
    return markdown


if __name__ == "__main__":
    Path(__file__).with_name("block_list.md").write_text(block_list(), encoding="utf-8")
