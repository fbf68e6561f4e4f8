"""What the pages list is what there is: rooms, blocks, joins, instructions, passes, settings, files."""

from __future__ import annotations

import importlib
import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest

import flowgraph
from flowgraph import Block, FlowgraphError, Signal, errors, find_graph
from flowgraph.blocks.flights import figure
from flowgraph.data.registry import flight_names, flight_settings, graph_names
from flowgraph.language.graph import CallNode
from flowgraph.pipeline.optimise import PASSES
from flowgraph.recorder.ops import OPS
from tests.test_house import LAYERS

ROOT = Path(__file__).resolve().parents[2]


def page(name: str) -> str:
    return (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")


def code_words(text: str) -> set[str]:
    """All names inside `...` of a page, outside its code blocks."""
    prose = re.sub(r"^```.*?^```$", "", text, flags=re.MULTILINE | re.DOTALL)
    return {word for span in re.findall(r"`([^`]+)`", prose) for word in re.findall(r"[\w.]+", span)}


@pytest.fixture(scope="module")
def library() -> Any:
    """docs/library.py, which writes the reference from the code."""
    spec = importlib.util.spec_from_file_location("docs_library", ROOT / "docs" / "library.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "docs"))  # where its own neighbours are
        spec.loader.exec_module(module)
    return module


def test_every_block_is_written_down_with_ports_and_equations(library: Any) -> None:
    text = library.filled(page("blocks"))
    assert "<!--" not in text
    found = list(library.public(Block))
    assert {"predict", "aid_position"} <= {name for _, name, _ in found}
    for module, name, block in found:
        assert f"### {module.__name__}\n" in text
        assert f"#### {name}\n" in text
        for port in block.ports:
            assert f"| in | {port.name}" in text
        assert (block.step.__doc__ or "").strip().partition("\n")[0] in text


def test_the_list_of_blocks_is_that_of_the_code(library: Any) -> None:
    """It is kept in the tree, to be read without a build."""
    assert page("block_list") == library.block_list(), "python docs/library.py writes it anew"


def test_every_public_name_has_an_entry_in_the_reference(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    reference = importlib.import_module("reference")
    pages = dict(reference.pages())
    assert len(pages) == len(reference.packages()) + 1 > 25
    for name in set(flowgraph.__all__):
        entries = (f"::: flowgraph.{name}\n", f"## {name} {{ #flowgraph.{name} }}\n")
        assert any(entry in pages["api/flowgraph.md"] for entry in entries), name
        assert f"[`{name}`](flowgraph.md#flowgraph.{name})" in pages["api/index.md"]
    for package in reference.packages():
        for name in reference.names(package):
            if not str(getattr(getattr(package, name), "__module__", "")).startswith("flowgraph"):
                continue  # the name of a type, which has no docstring
            assert (getattr(package, name).__doc__ or "").strip(), (
                f"{package.__name__}.{name} has no docstring"
            )


def test_a_name_without_an_entry_in_the_site_is_found(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    reference = importlib.import_module("reference")
    monkeypatch.setattr(reference, "packages", lambda: [flowgraph])
    there = "".join(f'<h2 id="flowgraph.{name}">' for name in flowgraph.__all__ if name != "simulate")
    (tmp_path / "api" / "flowgraph").mkdir(parents=True)
    (tmp_path / "api" / "flowgraph" / "index.html").write_text(there)
    assert reference.missing(tmp_path) == ["flowgraph.simulate"]


def test_the_gallery_measures_and_says_how(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    gallery = importlib.import_module("gallery")
    monkeypatch.setattr(gallery, "graph_names", lambda: ["ins_eskf"])
    text = gallery.gallery(["ins_eskf"])
    assert "flowgraph run ins_eskf --data sim --set duration=6" in text
    (millimetres,) = re.findall(r"position ([\d.]+) mm", text)
    assert 5.0 < float(millimetres) < 30.0
    assert "generated/ins_eskf.svg" in text


def test_every_signal_is_written_down_with_units(library: Any) -> None:
    text = library.filled(page("blocks"))
    assert "| `Imu` | `gyro` | real[3], rad/s, body |" in text
    for _, name, _ in library.public(Signal):
        assert f"| `{name}` |" in text


def test_every_graph_has_a_section(library: Any) -> None:
    text = library.filled(page("graphs"), drawn=graph_names())
    for name in graph_names():
        assert text.count(f"## {name}\n") == 1
        assert f"generated/{name}.svg" in text


def test_the_section_of_ins_eskf_names_its_sources_and_settings() -> None:
    sources, settings = find_graph("ins_eskf").parameters
    assert {*sources, *settings} <= code_words(page("graphs"))


def test_every_join_is_listed() -> None:
    rooms = [f"flowgraph.language.{name}" for name in ("joins", "late", "pairs")]
    joins = {name for name in flowgraph.__all__ if getattr(flowgraph, name).__module__ in rooms}
    assert {"latest", "zip", "match", "merge", "every", "sink"} <= joins
    assert joins | {"apply", "delay"} <= code_words(page("blocks"))


def test_every_pass_is_listed() -> None:
    section = page("lowering").split("## Passes")[1].split("\n`sparse`")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(PASSES)


def test_every_room_has_a_section_and_stands_in_the_picture(
    library: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = library.filled(page("architecture"))
    places = [text.index(f"\n### `{room}`\n") for room in LAYERS]
    assert places == sorted(places)
    for room in LAYERS:
        assert library.paragraphs(importlib.import_module(f"flowgraph.{room}"))[0] in text
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    house = importlib.import_module("rooms").house()
    drawn = {node.path for node in house.nodes if isinstance(node, CallNode)}
    assert drawn == {*LAYERS} - {"errors", "types", "verbs", "moved", "cli"}
    assert all(f">{room}</text>" in house.draw(legend=False) for room in drawn)


def test_what_the_architecture_page_names_is_there() -> None:
    """Its files and tests, but for those that its recipes make up."""
    text = page("architecture")
    made_up = {
        f"{of}.py"
        for of in ("blocks/orientation/compass", "blocks/datasets/npz", "pipeline/optimise/reciprocal")
    }
    named = set(re.findall(r"`(?:flowgraph/)?([\w./]+(?:\.py|\.md|\.toml|/))`", text))
    assert len(named) > 30
    for name in named - made_up:
        found = [*ROOT.glob(name), *(ROOT / "flowgraph").glob(f"**/{name}"), *ROOT.glob(f"tests/**/{name}")]
        assert found or (ROOT / "flowgraph" / name).exists(), name
    tests = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    for name in re.findall(r"`(test_\w+)`", text):
        assert f"def {name}(" in tests, name


def test_the_instructions_listed_are_those_there_are() -> None:
    section = page("lowering").split("## Instructions")[1].split("\n`getitem`")[0]
    listed = set(re.findall(r"`(\w+)`", section))
    assert listed == set(OPS)


def test_every_field_of_the_description_is_explained() -> None:
    schema = json.loads((ROOT / "flowgraph" / "pipeline" / "pipeline.schema.json").read_text())
    names: set[str] = set()

    def visit(node: Any) -> None:
        if isinstance(node, dict):
            names.update(node.get("properties", {}))
            for child in node.values():
                visit(child)
        elif isinstance(node, list):
            for child in node:
                visit(child)

    visit(schema)
    missing = names - code_words(page("lowering"))
    assert not missing, f"docs/lowering.md does not explain {missing}"


def test_every_flight_setting_is_listed() -> None:
    words = code_words(page("data"))
    for name in set(flight_names()) - {"sim"}:
        missing = {
            s for s in flight_settings(name) if s not in words and f"STREAM.{s.split('.')[-1]}" not in words
        }
        assert not missing, name
    assert set(figure.DEFAULTS) <= words


def test_every_error_is_listed() -> None:
    kinds = {n for n, e in vars(errors).items() if isinstance(e, type) and issubclass(e, FlowgraphError)}
    assert kinds <= code_words(page("errors"))
