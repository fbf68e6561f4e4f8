"""Verbs: the table of what higher rooms do for lower ones is whole, lazy, and says what it lacks."""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import flowgraph
from flowgraph import UnknownNameError, verbs

ROOT = Path(flowgraph.__file__).parent


def asked() -> Iterator[str]:
    """The verbs that any module of flowgraph asks for."""
    for path in ROOT.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "verb":
                assert isinstance(node.args[0], ast.Constant), path
                yield str(node.args[0].value)


def test_every_verb_is_asked_for_by_its_method_and_found() -> None:
    names = sorted(asked())
    assert names == sorted(verbs._places)
    for name in names:
        owner, _, method = name.partition(".")
        assert callable(getattr(getattr(flowgraph, owner), method))
        assert callable(verbs.verb(name))


def test_a_verb_that_no_room_provides_is_named() -> None:
    with pytest.raises(UnknownNameError, match=r"no verb is called 'Graph\.drow'") as caught:
        verbs.verb("Graph.drow")
    assert caught.value.fix == "did you mean 'Graph.draw'?"


def test_a_verb_can_be_provided_anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(verbs, "_places", dict(verbs._places))
    monkeypatch.setattr(verbs, "_functions", dict(verbs._functions))
    assert verbs.verb("Graph.draw").__module__ == "flowgraph.drawing.draw"
    verbs.provide({"Graph.draw": "json:dumps"})
    assert verbs.verb("Graph.draw").__module__ == "json"


def test_a_verb_is_imported_when_it_is_used() -> None:
    code = "import sys, flowgraph; print(*[m for m in sys.modules if m.startswith('flowgraph.drawing')])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == []
