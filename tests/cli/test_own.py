"""Graphs and flights in a file of the user's: run, drawn, lowered, tuned, in a study; and what is refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import pytest

from flowgraph import DeclarationError, FlowgraphError, PluginError, UnknownNameError, find_graph, load_flight
from flowgraph.study import OnDask, Study, read_table, run_study
from flowgraph.study.report import write_report
from tests.cli.test_cli import invoke

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the car of the examples in it, where commands run."""
    for name in ("own_tracker.py", "own_tracker_study.toml"):
        shutil.copy(EXAMPLES / name, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


CAR = ("own_tracker.py:tracker", "--data", "own_tracker.py:drive", "--set", "duration=10")


def test_a_graph_of_a_file_runs_is_scored_and_drawn(here: Path):
    done = invoke("run", *CAR, "--engine", "reference", "--json", "--out", "out")
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert 0.2 < figures["position_rmse_m"] < 2.0  # a fix alone is 2.8 m off
    assert {"heading_rmse_deg", "speed_rmse_mps", "nees_mean", "nis_mean"} <= set(figures)
    assert {p.name for p in (here / "out").iterdir()} == {
        "metrics.json", "diagram.svg", "states.png", "innovations.png",
    }  # fmt: skip


def test_a_graph_of_a_file_that_collects_it_is_smoothed_by_a_setting(here: Path):
    done = invoke("run", *CAR[:3], "--set", "smooth=rts", "--set", "lag=2", "--json")
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    for part in ("position_rmse_m", "heading_rmse_deg", "speed_rmse_mps"):
        assert figures[f"smoothed_{part}"] < figures[f"lagged_{part}"] < figures[part]
    assert figures["smoothed_nees_mean"] < 6.0  # of 4 numbers, whose errors last for seconds
    assert "lag" in invoke("run", *CAR, "--set", "lag=-1").stderr


def test_a_graph_of_a_file_is_shown_and_lowered_to_c(here: Path):
    assert "steering" in invoke("show", *CAR).stdout
    assert invoke("lower", *CAR, "--target", "c", "-o", "made").exit_code == 0
    assert (here / "made" / "tracker.c").exists()


def test_a_table_feeds_it_by_the_names_of_its_head_or_by_settings(here: Path):
    (here / "drive.csv").write_text(
        "t,yaw,push,east,north\n"
        + "\n".join(f"{0.05 * k:.2f},0.1,0.2,{0.25 * k if k % 5 == 0 else ''},{1 if k % 5 == 0 else ''}"
                    for k in range(60))
    )  # fmt: skip
    named = ("--set", "steering.rate=yaw", "--set", "steering.acceleration=push")
    done = invoke(
        "run", CAR[0], "--data", "table:drive.csv", *named, "--set", "fix.position=east,north",
        "--set", "fix_noise=0.5", "--json",
    )  # fmt: skip
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["nis_count"] == 12
    without = invoke("run", CAR[0], "--data", "table:drive.csv", *named)
    assert without.exit_code == 1
    assert "streams steering, fix" in without.stderr


@pytest.mark.parametrize(
    "workers",
    [
        1,
        pytest.param(2, marks=pytest.mark.slow),
        pytest.param("dask", marks=pytest.mark.slow),
    ],
)
def test_a_study_finds_graph_and_flight_beside_its_file_and_a_report_runs_neither(
    here: Path, workers: int | str
):
    """In this process, in others, and in workers of Dask, which run the file themselves."""
    (here / "small.toml").write_text(
        'graphs = ["own_tracker.py:tracker"]\ndata = ["own_tracker.py:drive"]\nseeds = 2\n'
        'engine = "reference"\n[parameters]\nduration = 3\n'
        '[parameters."own_tracker.py:tracker"]\nfix_noise = [1.5, 2.0]\n'
    )
    study = Study.load(here / "small.toml")
    assert study.graphs == (f"{here / 'own_tracker.py'}:tracker",)
    assert len(list(study.combinations(study.graphs[0]))) == 2
    if isinstance(workers, str):
        pytest.importorskip("distributed")
        with OnDask(workers=2) as executor:
            outcome = run_study(study, here / "out", executor=executor)
    else:
        outcome = run_study(study, here / "out", workers=workers)
    assert (outcome.done, outcome.failed) == (4, [])
    rows = read_table(here / "out")
    assert len({row["position_rmse_m"] for row in rows}) == 4  # of two seeds, at two settings
    assert run_study(study, here / "out").done == 0
    (here / "own_tracker.py").write_text("raise SystemExit('a report must not run this')")
    assert write_report(here / "out").page.exists()


def test_a_run_of_a_study_is_done_anew_when_the_file_says_something_else(here: Path):
    given: dict[str, Any] = {
        "graphs": ["own_tracker.py:tracker"],
        "data": ["own_tracker.py:drive"],
        "engine": "reference",
    }
    study = Study(**given, parameters={"duration": 2})
    assert run_study(study, here / "out").done == 1
    file = here / "own_tracker.py"
    file.write_text(file.read_text().replace("return x.position + v", "return x.position + 1.0 + v"))
    assert run_study(Study(**given), here / "out").done == 1


@pytest.mark.parametrize(
    ("spec", "text", "error", "said"),
    [
        ("gone.py:tracker", None, DeclarationError, ["no such file", "gone.py", "check the path"]),
        ("my.py", "", DeclarationError, ["names a file", "FILE.py:NAME"]),
        ("my.py:car", "from flowgraph import *", UnknownNameError, ["my.py", "'car'"]),
        ("my.py:car", "def car(): ...", DeclarationError, ["the function car", "put @graph over"]),
        ("my.py:car", "car = 3", DeclarationError, ["int: 3"]),
        ("my.py:car", "x = 1\ny = x / 0\n", PluginError, ["my.py, line 2", "ZeroDivisionError"]),
        ("my.py:car", "x = (\n", PluginError, ["my.py, line 1", "SyntaxError"]),
        ("my.py:car", "import nothing_of_that_name", PluginError, ["line 1", "ModuleNotFoundError"]),
        ("my.py:car", "def f():\n    raise SystemExit(3)\nf()\n", PluginError, ["line 2", "SystemExit: 3"]),
    ],
)  # fmt: skip
def test_what_is_wrong_with_a_file_is_said_with_its_place(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    spec: str,
    text: str | None,
    error: type[FlowgraphError],
    said: list[str],
):
    monkeypatch.chdir(tmp_path)
    if text is not None:
        (tmp_path / "my.py").write_text(text)
    with pytest.raises(error) as caught:
        find_graph(spec)
    for words in said:
        assert words in str(caught.value)
    assert caught.value.expected
    assert caught.value.fix


NEEDY = """
from flowgraph import Flight, Scalar, Series, Stream, graph, delay
import numpy as np

@graph
def needy(x: Stream[Scalar], *, start, gain: float):
    return {"y": x.map(lambda v: v * 2.0)}

@graph
def doubled(x: Stream[Scalar]):
    return {"y": x.map(lambda v: v * 2.0)}

def sampled(*, seed: int = 0, count: int = 5) -> Flight:
    return Flight("sampled", {"x": Series(np.arange(count) * 10**8, np.arange(count) + float(seed))})

def placed(place, *, seed=0):
    return Flight(place, {"x": Series(np.arange(3), np.zeros(3))})

def broken(*, seed=0):
    return [][1]

def nothing(*, seed=0):
    return 3
"""


def test_what_is_wrong_with_a_case_or_a_flight_of_a_file_is_said(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.py").write_text(NEEDY)
    flight = load_flight("my.py:sampled", seed=3, settings={"count": "4"})
    assert flight.streams["x"].values.tolist() == [3.0, 4.0, 5.0, 6.0]
    assert load_flight("my.py:placed:there").name == "there"
    case = find_graph("my.py:doubled").case(flight)
    assert case.score is not None
    for spec, words in {
        "my.py:broken": ["my.py, line", "IndexError"],
        "my.py:nothing": ["returned no flight", "int: 3"],
        "my.py:sampled:there": ["takes no place", "there"],
        "my.py:gone": ["no function that makes a flight", "broken, nothing, placed, sampled"],
        "my.py:doubled": ["makes no flight", "GraphFunction"],
    }.items():
        with pytest.raises(Exception, match=words[0]) as caught:
            load_flight(spec)
        assert all(w in str(caught.value) for w in words), str(caught.value)
    with pytest.raises(DeclarationError, match="nobody says start, gain of this graph") as caught:
        find_graph("my.py:needy").case(flight)
    assert "@on_flight(needy" in str(caught.value)
    done = invoke("run", "my.py:doubled", "--data", "my.py:sampled", "--set", "cuont=3")
    assert done.exit_code == 2
    assert "'cuont'" in done.stderr
