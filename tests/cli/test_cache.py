"""`flowgraph cache`: what is kept is told and cleared, and nothing else is touched."""

from __future__ import annotations

import json
import shutil

import pytest
from typer.testing import CliRunner

from flowgraph.cli import app
from flowgraph.engines.c.compile import build, kept

needs_cc = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")


def asked(*words: str) -> dict:
    done = CliRunner().invoke(app, ["cache", "--json", *words])
    assert done.exit_code == 0, done.output
    return json.loads(done.stdout)


@needs_cc
def test_what_is_kept_is_told_by_filter_and_cleared(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    assert asked()["filters"] == []
    for text in ("int one(void) { return 1; }", "int one(void) { return 2; }"):
        build({"my_filter.c": text})
    build({"other-one.c": "int two(void) { return 2; }"})
    (tmp_path / "mine-too.txt").write_text("a user's own")
    (tmp_path / "mine-too.so").write_text("and another")
    (tmp_path / "work-left").mkdir()
    found = asked()
    assert {row["filter"]: row["libraries"] for row in found["filters"]} == {"my_filter": 2, "other-one": 1}
    assert found["folder"] == str(tmp_path)
    assert sum(row["bytes"] for row in found["filters"]) == sum(k.bytes for k in kept(tmp_path)) > 0
    assert asked("--clear")["freed_bytes"] == sum(row["bytes"] for row in found["filters"])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["mine-too.so", "mine-too.txt"]
    assert asked()["filters"] == []


@needs_cc
def test_the_table_names_the_folder_and_how_to_clear_it(tmp_path, monkeypatch):
    monkeypatch.setenv("FLOWGRAPH_CACHE", str(tmp_path))
    build({"my_filter.c": "int one(void) { return 1; }"})
    done = CliRunner().invoke(app, ["cache"])
    assert "my_filter" in done.output
    assert f"kept: 1 libraries, 0.0 MB, in {tmp_path}" in done.output
    assert "--clear" in done.output


def test_without_a_home_it_is_an_error(monkeypatch):
    monkeypatch.setattr("flowgraph.cli.cache.cache_folder", lambda: None)
    done = CliRunner().invoke(app, ["cache"])
    assert done.exit_code == 1
    assert "set FLOWGRAPH_CACHE" in done.output
