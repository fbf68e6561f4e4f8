"""Reports: what is in the page, and how two studies are compared."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import DataError, UnknownNameError
from flowgraph.cli import app
from flowgraph.study import Study, run_study
from flowgraph.study.report import write_comparison, write_report
from flowgraph.study.shown import chosen, shown_again
from flowgraph.study.statistics import compared, differing, quantiles, summarised
from flowgraph.study.store import read_table
from tests.drawing.test_page import _Reader

pytest.importorskip("pyarrow")
FLIGHT = {"duration": 1.5, "imu.rate": 50}


def invoke(*arguments):
    return CliRunner(env={"COLUMNS": "300", "NO_COLOR": "1"}).invoke(app, [str(a) for a in arguments])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    target = tmp_path_factory.mktemp("study")
    study = Study(
        graphs=["ekf", "ins_eskf", "orientation_complementary"], data=["sim"], seeds=3, keep=True,
        parameters=FLIGHT | {"ekf": {"position_noise": [0.005, 0.01, 0.05]}},
    )  # fmt: skip
    run_study(study, target)
    return target


def test_the_page_holds_all_and_needs_nothing_else(folder):
    found = write_report(folder)
    page = found.page.read_text()
    for part in ("Summary by setting", "Worst runs by position_rmse_m", "Failed runs (3)", "ins_eskf"):
        assert part in page
    assert "default-src 'none'" in page
    assert not re.findall(r'(?:src|href)="https?:', page)
    assert page.count('src="data:image/png;base64,') == 2
    assert [f.name for f in found.figures] == ["boxes.png", "against-position-noise.png"]
    assert all(f.read_bytes().startswith(b"\x89PNG") for f in found.figures)


def test_charts_say_what_their_pictures_show(folder):
    charts = _Reader(write_report(folder).page.read_text()).data("charts")
    rows = read_table(folder)
    boxes, against = charts
    assert boxes["x"]["names"] == ["sim"]
    assert [s["name"] for s in boxes["series"]] == ["ekf", "ins_eskf", "orientation_complementary"]
    mine = [r["position_rmse_m"] for r in rows if r["graph"] == "ekf"]
    five = boxes["series"][0]["boxes"][0]
    np.testing.assert_allclose(five[1:4], np.quantile(mine, [0.25, 0.5, 0.75]), rtol=1e-6)
    assert sorted(d["y"] for d in boxes["series"][0]["dots"]) == pytest.approx(sorted(mine))
    assert (against["x"]["label"], against["x"]["log"]) == ("position_noise", True)
    line = against["series"][0]
    assert line["x"] == [0.005, 0.01, 0.05]
    assert line["low"][0] <= line["y"][0] <= line["high"][0]


def test_some_runs_are_in_the_page_whole(folder):
    """The worst first and the middle one last, run again: the same figures, and rims in the chart."""
    found = write_report(folder, runs=2)
    reader = _Reader(found.page.read_text())
    ranked = sorted(
        (r for r in read_table(folder) if r.get("error") is None), key=lambda r: -(r["position_rmse_m"])
    )
    runs = reader.data("runs")
    assert [dict(run["figures"])["position_rmse_m"] for run in runs] == [
        f"{r['position_rmse_m']:.6g}" for r in (ranked[0], ranked[len(ranked) // 2])
    ]
    assert runs[0]["title"].startswith(f"{ranked[0]['graph']}, sim, duration=1.5, imu.rate=50")
    assert runs[0]["notes"][0] == "info: run again for this page, in the Python engine"
    assert not any("in the study's table" in words for words in runs[0]["notes"])
    assert all(run["watch"]["wires"] for run in runs)
    dots = [d for s in reader.data("charts")[0]["series"] for d in s["dots"]]
    assert sorted(d["run"] for d in dots if d["run"] is not None) == [0, 1]
    assert found.notes == ()


def test_a_run_that_cannot_be_run_again_is_said(folder, tmp_path):
    said: list[str] = []
    row = {"graph": "ekf", "data": f"csv:{tmp_path}/gone.csv", "seed": 0, "e": 1.0}
    assert shown_again(row, [], "e", share=1.0, dtype="float64", say=said.append) is None
    assert said[0].startswith(f"skipped: the run ekf, csv:{tmp_path}/gone.csv, seed 0 is not on the page: ")


def test_which_runs_are_shown():
    rows = [run("x", k, float(k), wall_s=0.1 if k % 2 else 50.0) for k in range(9)]
    assert [r["seed"] for r in chosen(rows, "e", 3, "python")] == [8, 7, 4]
    assert [r["seed"] for r in chosen(rows, "e", 1, "python")] == [8]
    assert [r["seed"] for r in chosen(rows, "e", None, "python")] == [7, 5, 3]  # those that are quick
    assert chosen(rows, "e", None, "c") == []
    assert chosen([{**rows[0], "error": "no"}, run("x", 1, None)], "e", 3, "python") == []


def test_the_worst_runs_are_linked_and_can_be_run_again(folder):
    page = write_report(folder, metric="tilt_rmse_deg").page.read_text()
    assert "Worst runs by tilt_rmse_deg" in page
    links = re.findall(r'href="(trajectories/[0-9a-f]+\.npz)"', page)
    assert len(links) == 10
    assert all((folder / link).exists() for link in links)
    command = re.search(r"<code>flowgraph (run [^<]*)</code>", page)
    assert command is not None
    words = command[1].replace("&#x27;", "'").split()
    done = invoke(*words, "--json")
    assert done.exit_code == 0
    assert f"{json.loads(done.stdout)['tilt_rmse_deg']:.4g}" in page


def test_the_summary_is_by_setting(folder):
    rows = write_report(folder).summary
    mine = [r for r in rows if r["graph"] == "ekf" and r["metric"] == "position_rmse_m"]
    assert [r["position_noise"] for r in mine] == [0.005, 0.01, 0.05]
    assert all(r["runs"] == 3 and r["q25"] <= r["q50"] <= r["q75"] for r in mine)


def test_the_commands(folder, tmp_path):
    done = invoke("report", folder)
    assert done.exit_code == 0
    assert "position_rmse_m" in done.stdout
    assert json.loads(invoke("report", folder, "--json").stdout)["rows"]
    assert invoke("report").exit_code == 2
    assert invoke("report", folder, "--metric", "speed").exit_code == 2
    assert invoke("report", tmp_path).exit_code == 1
    both = invoke("report", "--compare", folder, folder, "--out", tmp_path, "--json")
    assert all(r["ratio"] == 1.0 for r in json.loads(both.stdout)["rows"])
    assert (tmp_path / "comparison.html").exists()


def run(graph, seed, error, **more):
    return {"graph": graph, "data": "sim", "seed": seed, "error": None, "e": error, **more}


def test_pairs_are_by_seed_and_flight():
    draw = np.random.default_rng(1)
    hard = np.exp(draw.normal(size=60))  # how hard a flight is spreads far more than the filters differ
    a = [run("x", k, h) for k, h in enumerate(hard)]
    b = [run("x", k, 0.9 * h * np.exp(0.05 * draw.normal())) for k, h in enumerate(hard)][::-1]
    (line,) = compared(a, b, ["e"])
    assert line["pairs"] == 60
    assert 0.87 < line["low"] < line["ratio"] < line["high"] < 0.93
    assert line["less"] > 0.9


def test_the_interval_covers_the_truth_as_often_as_it_says():
    draw = np.random.default_rng(2)
    inside = 0
    for _ in range(100):
        a = [run("x", k, 1.0) for k in range(40)]
        b = [run("x", k, float(np.exp(0.2 * draw.normal()))) for k in range(40)]
        (line,) = compared(a, b, ["e"])
        inside += line["low"] <= 1.0 <= line["high"]
    assert 88 <= inside <= 100


def test_grids_are_paired_by_what_both_have():
    a = [run("x", s, 1.0 + p, p=p) for s in range(3) for p in (1, 2)]
    b = [run("x", s, 2.0 * (1.0 + p), p=p, q=7) for s in range(3) for p in (1, 2)]
    (line,) = compared(a, b, ["e"], ["p", "q"])
    assert (line["pairs"], line["ratio"]) == (6, pytest.approx(2.0))


def test_two_filters_that_are_alone_are_compared():
    (line,) = compared([run("x", 1, 2.0)], [run("y", 1, 1.0)], ["e"])
    assert (line["graph"], line["ratio"]) == ("y / x", 0.5)
    failed = {**run("y", 1, 1.0), "error": "no"}
    with pytest.raises(DataError, match="no runs in common"):
        compared([run("x", 1, 2.0)], [failed], ["e"])


def test_failures_count_and_values_that_are_none_do_not():
    rows = [run("x", 0, 1.0), run("x", 1, 3.0), {**run("x", 2, 9.0), "error": "no"}]
    (line,) = quantiles(rows, [])
    assert (line["q50"], line["runs"], line["failed"]) == (2.0, 2, 1)
    (short,) = summarised(rows, [])
    assert (short["runs"], short["failed"], short["e"]) == (3, 1, "2 (1.5 .. 2.5)")


def test_unknown_names_and_missing_results_are_errors(folder, tmp_path):
    with pytest.raises(UnknownNameError, match="speed"):
        write_report(folder, metric="speed")
    with pytest.raises(UnknownNameError, match="speed"):
        write_comparison(folder, folder, tmp_path, metric="speed")
    with pytest.raises(DataError):
        write_comparison(folder, tmp_path, tmp_path)


# What a comparison leaves out


@pytest.mark.parametrize(
    ("b", "failed", "unusable", "unpaired", "pairs"),
    [
        ([run("x", 0, 1.0), {**run("x", 1, None), "error": "no"}, run("x", 2, 1.0)], 1, 0, 1, 2),
        ([run("x", 0, 1.0), run("x", 1, 0.0), run("x", 2, -1.0)], 0, 2, 2, 1),
        ([run("x", 0, 1.0), run("x", 1, float("nan")), run("x", 2, None)], 0, 2, 2, 1),
        ([run("x", 0, 1.0), run("x", 7, 1.0), run("x", 8, 1.0)], 0, 0, 4, 1),
        ([run("x", 0, 1.0), run("x", 1, 1.0), run("x", 2, 1.0)], 0, 0, 0, 3),
        ([run("x", 0, 1.0), {**run("x", 0, 2.0), "error": "no"}, run("x", 0, 3.0)], 1, 0, 2, 1),
    ],
)
def test_what_a_ratio_leaves_out_is_counted_by_reason(b, failed, unusable, unpaired, pairs):
    a = [run("x", k, 1.0) for k in range(3)]
    for first, second in ((a, b), (b, a)):
        (line,) = compared(first, second, ["e"])
        assert (line["failed"], line["unusable"], line["unpaired"], line["pairs"]) == (
            failed, unusable, unpaired, pairs,
        )  # fmt: skip


@pytest.mark.parametrize("values", [(1.5, 4.0), (None, 4.0), (1.5, "long")])
def test_flights_of_other_settings_are_other_flights(values):
    a, b = ([run("x", k, 1.0 + k, d=v) for k in range(3)] for v in values)
    with pytest.raises(DataError, match="no runs in common(?s:.*)d: .* and (4|long)(?s:.*)across"):
        compared(a, b, ["e"], ["d"], flight=["d"])
    (line,) = compared(a, [*b, run("x", 1, 6.0, d=values[0])], ["e"], ["d"], flight=["d"])
    assert (line["pairs"], line["ratio"], line["unpaired"]) == (1, pytest.approx(3.0), 5)
    (line,) = compared(a, b, ["e"], ["d"])  # a setting of the filter may be what is compared
    assert line["pairs"] == 3


def test_nothing_to_compare_says_how_many_failed():
    failed = [{**run("x", k, None), "error": "no"} for k in range(3)]
    with pytest.raises(DataError, match="0 of 1 runs failed; 3 of 3 runs failed"):
        compared([run("x", 0, 1.0)], failed, ["e"])


def test_settings_that_differ_are_named_with_their_values():
    a = [run("x", k, 1.0, p=p, q=1) for k in range(2) for p in (0.5, 1.0)]
    b = [run("x", k, 1.0, p=1.0, q=1.0, r=None, s=k) for k in range(9)]
    assert differing(a, b, ["p", "q", "r", "s", "p"]) == {
        "p": ("0.5, 1", "1"),
        "s": ("not set", "0, 1, 2, 3, 4, 5, ... (9 values)"),
    }


@pytest.fixture(scope="module")
def studies(tmp_path_factory):
    """Three of one filter: a flight, a longer one, and settings with which most runs fail."""
    root = tmp_path_factory.mktemp("studies")
    for name, length, noises in (
        ("one", 1.5, 0.01), ("long", 2.0, 0.01), ("bad", 1.5, [-0.01, 0.01, 0]), ("other", 1.5, 0.02),
    ):  # fmt: skip
        parameters = {"duration": length, "imu.rate": 50, "position_noise": noises}
        run_study(Study(graphs=["ekf"], data=["sim"], parameters=parameters), root / name)
    return root


def test_a_comparison_says_what_failed_and_what_differs(studies, tmp_path):
    found = write_comparison(studies / "one", studies / "bad", tmp_path, metric="position_rmse_m")
    assert (found.rows[0]["pairs"], found.rows[0]["failed"]) == (1, 2)
    assert found.notes[0].startswith("warning: position_noise differs: 0.01 in the first, -0.01, 0.01, 0")
    assert found.notes[1] == "skipped: ekf, position_rmse_m: runs left out: 2 failed"
    page = found.page.read_text()
    assert all(part in page for part in ("position_noise differs", "2 failed", "<th>unpaired</th>"))
    told = invoke("report", "--compare", studies / "one", studies / "other", "--out", tmp_path)
    assert "note: warning: position_noise differs: 0.01 in the first, 0.02 in the second" in told.stderr
    alike = invoke("report", "--compare", studies / "one", studies / "one", "--out", tmp_path, "--json")
    assert json.loads(alike.stdout)["notes"] == []


def test_flights_of_other_lengths_are_compared_only_when_it_is_asked_for(studies, tmp_path):
    both = ("report", "--compare", studies / "one", studies / "long", "--out", tmp_path)
    done = invoke(*both)
    assert done.exit_code == 1
    assert "duration: 1.5 and 2" in done.stderr
    asked = json.loads(invoke(*both, "--across", "duration", "--json").stdout)
    assert asked["rows"][0]["pairs"] == 1
    assert "warning: duration differs: 1.5 in the first, 2 in the second" in asked["notes"]
    wrong = invoke(*both, "--across", "position_noise")
    assert wrong.exit_code == 2
    assert "duration" in wrong.stderr
