"""What the pages list is what there is: blocks, joins, instructions, fields, settings, errors."""

from __future__ import annotations

import importlib.util
import json
import re
from pathlib import Path
from typing import Any

import pytest

import flowgraph
from flowgraph import Block, FlowgraphError, Signal, errors, find_graph
from flowgraph.blocks.datasets import broad, csv_file, ese650, euroc, rosbag, tum
from flowgraph.blocks.flights import simulated
from flowgraph.data.registry import graph_names
from flowgraph.recorder.ops import OPS

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
    joins = {"apply", "delay", "latest", "zip", "zip_latest", "zip_latest_right", "match", "merge", "every"}
    assert joins <= set(flowgraph.__all__)
    assert joins | {"collect", "sink"} <= code_words(page("blocks"))


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
    assert set(simulated.DEFAULTS) <= words
    for module in (broad, csv_file, ese650, euroc, rosbag, tum):
        assert set(module.SETTINGS) <= words, module.__name__


def test_every_error_is_listed() -> None:
    kinds = {n for n, e in vars(errors).items() if isinstance(e, type) and issubclass(e, FlowgraphError)}
    assert kinds <= code_words(page("errors"))
