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
    said = (
        "info: the values on the wires, the clouds and the times of blocks are the Python engine's, run again"
        " over the same events; the outputs are the same to the bit"
    )
    assert said in json.loads(done.stdout)["notes"]
    assert said in runs_in(file)[1]["notes"]
    assert runs_in(file)[1]["watch"] == first["watch"]
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


@pytest.mark.parametrize("engine", ["python", "c"])
def test_a_flight_is_pushed_live_to_who_watches(engine: str) -> None:
    done = call("watch", "ins_eskf", "--data", "sim", "--set", "duration=0.4", "--live", "--engine", engine,
                "--no-wait")  # fmt: skip
    assert done.exit_code == 0, done.output
    assert "ended: 81 ticks" in done.stderr


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--engine", "c"], "the Python engine alone shows what is on the wires as they go on"),
        (["--live", "--speed", "0"], "events that are pushed have a pace"),
    ],
)
def test_a_run_that_cannot_be_watched_so(more: list[str], words: str) -> None:
    done = call("watch", "ins_eskf", "--data", "sim", "--no-wait", *more)
    assert done.exit_code == 2
    assert words in done.stderr


def test_what_a_page_warns_of_stands_in_the_terminal(tmp_path: Path) -> None:
    """A filter that is told far too small a noise: its NIS is far from 1, on the page and in the notes."""
    file = tmp_path / "run.html"
    wrong = ["--set", "position_noise=0.001", "--html", str(file)]
    done = call("run", "ins_eskf", "--data", "sim", "--set", "duration=3", *wrong, "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)["notes"]
    (run,) = runs_in(file)
    warned = [words for words in run["notes"] if words.startswith("warning: ")]
    assert any("the NIS is far from 1" in words for words in warned)
    assert set(warned) <= set(told)
    assert all(f"note: {words}" in done.stderr for words in warned)
    assert any(panel.get("wrong") for panel in run["panels"] if panel["title"].endswith("NIS"))
