"""`run --stream`: the run of the whole recording, gone on with, and what is refused beside it."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from flowgraph import find_graph, load_flight, simulate
from flowgraph.cli import app
from flowgraph.engines.streaming import NOTE

dataset = pytest.importorskip("pyarrow.dataset")

RUN = ("run", "ins_eskf", "--data", "sim", "--set", "duration=1")


def invoke(*words: str):
    return CliRunner().invoke(app, list(words), catch_exceptions=False)


def test_a_streamed_run_writes_what_a_whole_one_gives_and_goes_on(tmp_path):
    folder = tmp_path / "streamed"
    done = invoke(*RUN, "--stream", str(folder), "--json")
    report = json.loads(done.stdout)
    assert done.exit_code == 0
    assert any(n.startswith("info: streamed to") for n in report["notes"])
    assert "assumed: the start is the truth's" in report["notes"]
    flight = load_flight("sim", settings={"duration": "1"})
    case = find_graph("ins_eskf").case(flight)
    whole = simulate(case.graph, case.inputs)
    assert report["ticks"] == whole.ticks
    table = dataset.dataset(folder / "belief").to_table()
    assert table["time"].to_pylist() == whole["belief"].time.tolist()
    assert table["position.x"].to_pylist() == whole["belief"]["position"][:, 0].tolist()
    again = json.loads(invoke("run", "--resume", str(folder), "--json").stdout)
    assert (again["graph"], again["ticks"], again["settings"]) == ("ins_eskf", whole.ticks, ["duration=1"])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--out", "plots"), "nothing that --out could take"),
        (("--html", "page.html"), "nothing that --html could take"),
        (("--checkpoint", "run.npz"), "nothing that --checkpoint could take"),
        (("--resume", "run.npz"), "goes on in its own folder"),
    ],
)
def test_what_asks_for_a_whole_result_is_refused(tmp_path, words, said):
    done = invoke(*RUN, "--stream", str(tmp_path / "s"), *words)
    assert done.exit_code == 2
    assert said in " ".join(done.output.split())
    assert not (tmp_path / "s").exists()


def test_a_folder_that_holds_a_run_or_none_is_refused(tmp_path):
    (tmp_path / NOTE).write_text("{}")
    done = invoke(*RUN, "--stream", str(tmp_path))
    assert done.exit_code == 1
    assert "--resume DIR" in " ".join(done.output.split())
    empty = tmp_path / "empty"
    empty.mkdir()
    done = invoke(*RUN, "--resume", str(empty))
    assert done.exit_code == 1
    assert "no streamed run to go on with" in " ".join(done.output.split())


def test_without_pyarrow_the_extra_is_named(tmp_path: Path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    done = invoke(*RUN, "--stream", str(tmp_path / "s"))
    assert done.exit_code == 1
    assert "flowgraph-filters[parquet]" in " ".join(done.output.split())
    assert not (tmp_path / "s").exists()
