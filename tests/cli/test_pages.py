"""`show -o graph.html`, `run --html` and `--beside`."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flowgraph.cli import app
from tests.drawing.test_page import _Reader

SHORT = ("run", "ins_eskf", "--data", "sim", "--set", "duration=1", "--json")


def call(*arguments: str) -> Any:
    return CliRunner().invoke(app, list(arguments))


def runs_in(file: Path) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = _Reader(file.read_text()).data("runs")
    return found


def test_show_writes_a_page_with_what_the_lowered_graph_costs(tmp_path: Path) -> None:
    file = tmp_path / "graph.html"
    done = call("show", "ins_eskf", "--fold", "0", "-o", str(file))
    assert done.exit_code == 0, done.output
    graph = _Reader(file.read_text()).data("graph")
    assert graph["costs"]["real is"] == "float64"
    assert graph["costs"]["operations"] > 1000
    predict = next(node for node in graph["nodes"] if node and node["path"] == "predict")
    assert predict["costs"]["operations"] > 100


def test_runs_stand_beside_each_other_and_change_no_figure(tmp_path: Path) -> None:
    file = tmp_path / "run.html"
    plain = json.loads(call(*SHORT).stdout)
    done = call(*SHORT, "--html", str(file))
    assert done.exit_code == 0, done.output
    shown = json.loads(done.stdout)
    assert {k: v for k, v in shown.items() if "_s" not in k} == {
        k: v for k, v in plain.items() if "_s" not in k
    }
    (first,) = runs_in(file)
    assert first["title"] == "ins_eskf, sim, duration=1, seed 0, python"
    assert first["notes"] == shown["notes"]
    assert first["watch"] is not None
    assert dict(first["figures"])["position_rmse_m"] == f"{shown['position_rmse_m']:.6g}"

    done = call(*SHORT, "--engine", "reference", "--html", str(file), "--beside")
    assert done.exit_code == 0, done.output
    titles = [run["title"] for run in runs_in(file)]
    assert titles == [first["title"], first["title"].replace("python", "reference")]
    said = "info: the page has no values on the wires: engine=reference does not show them"
    assert said in json.loads(done.stdout)["notes"]
    assert runs_in(file)[1]["watch"] is None
    assert call(*SHORT, "--html", str(file)).exit_code == 0
    assert len(runs_in(file)) == 1


@pytest.mark.parametrize(
    ("more", "status", "words"),
    [
        (["--beside"], 2, "there is no page to put this run in"),
        (["--html", "{folder}/other.html", "--beside"], 1, "there are no runs in this file"),
        (["--html", "{folder}/other.html/run.html"], 1, "run.html"),
    ],
)
def test_a_page_that_cannot_be(more: list[str], status: int, words: str, tmp_path: Path) -> None:
    (tmp_path / "other.html").write_text("no page")
    done = call(*SHORT, *(part.format(folder=tmp_path) for part in more))
    assert done.exit_code == status
    assert words in done.stderr


def test_a_run_to_watch_says_where_and_ends_by_itself_where_nobody_is_waited_for() -> None:
    done = call("watch", "ins_eskf", "--data", "sim", "--set", "duration=1", "--speed", "0", "--no-wait")
    assert done.exit_code == 0, done.output
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/\n", done.stdout)
    assert "ended: 201 ticks" in done.stderr
