"""Generated C that is kept: written once, and again where the file or the graph is another."""

from __future__ import annotations

import json

import numpy as np
import pytest

from flowgraph import find_graph, load_flight, lower
from flowgraph.engines.c import library
from flowgraph.engines.c.library import Compiled
from flowgraph.engines.c.texts import _MARK, kept_text

pytestmark = pytest.mark.usefixtures("own_cache")


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def pipeline_of(noise: str = "0.1"):
    flight = load_flight("sim", settings={"duration": "1", "position.noise": noise})
    return lower(find_graph("kalman").case(flight).graph)


def counted(made):
    def write():
        made.append(1)
        return {"text": "int x;", "rows": [[None, 1, 2], [3, 4, 5]]}

    return write


def test_what_was_written_once_is_read_again():
    pipeline = pipeline_of()
    made: list[int] = []
    first = kept_text(pipeline, "k", ("a", None), counted(made))
    assert kept_text(pipeline_of(), "k", ("a", None), counted(made)) == first
    assert len(made) == 1


@pytest.mark.parametrize("other", ["asked", "graph", "stem"])
def test_another_question_or_graph_is_written_anew(other):
    made: list[int] = []
    kept_text(pipeline_of(), "k", ("a",), counted(made))
    pipeline = pipeline_of("0.2" if other == "graph" else "0.1")
    stem, asked = ("l" if other == "stem" else "k"), (("b",) if other == "asked" else ("a",))
    kept_text(pipeline, stem, asked, counted(made))
    assert len(made) == 2


@pytest.mark.parametrize("damage", ["cut", "changed", "empty"])
def test_a_damaged_text_is_written_anew(own_cache, damage):
    pipeline = pipeline_of()
    made: list[int] = []
    first = kept_text(pipeline, "k", (), counted(made))
    (file,) = own_cache.glob("k-*.json")
    content = file.read_bytes()
    file.write_bytes(
        {"cut": content[:-5], "changed": content.replace(b"int x", b"int y"), "empty": b""}[damage]
    )
    assert kept_text(pipeline, "k", (), counted(made)) == first
    assert len(made) == 2
    assert json.loads(file.read_bytes().rpartition(_MARK)[0]) == first


def test_a_place_that_cannot_be_written_only_costs_time(tmp_path, monkeypatch):
    file = tmp_path / "file"
    file.write_text("")
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(file))
    made: list[int] = []
    kept_text(pipeline_of(), "k", (), counted(made))
    kept_text(pipeline_of(), "k", (), counted(made))
    assert len(made) == 2


def test_a_library_of_a_kept_text_is_the_same(monkeypatch):
    first = Compiled(pipeline_of(), np.float64, (1, 2, 3))

    def refuse(*args, **more):
        raise AssertionError("written again")

    monkeypatch.setattr(library, "generate", refuse)
    second = Compiled(pipeline_of(), np.float64, (1, 2, 3))
    assert second.size == first.size
    assert [second.presence_of(k) for k in range(4)] == [first.presence_of(k) for k in range(4)]
    assert second._library._name == first._library._name
