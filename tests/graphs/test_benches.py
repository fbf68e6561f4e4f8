"""The experiments over recordings: a row a file and filter, peers only where they are installed."""

from __future__ import annotations

import json
import sys

import numpy as np
import pytest
from scipy.io import savemat
from typer.testing import CliRunner

from flowgraph import DataError, UnknownNameError
from flowgraph.cli import app
from flowgraph.graphs.benches import recordings
from flowgraph.graphs.benches.broad import broad
from flowgraph.graphs.benches.ese650 import PUBLISHED, ese650
from tests.blocks.datasets.test_datasets import course
from tests.graphs.test_marg import made


@pytest.fixture
def trials(tmp_path):
    """A folder with two trials that are made: 4 s at 100 Hz, at rest and turning."""
    folder = tmp_path / "broad"
    folder.mkdir()
    for n in (1, 2):
        flight = made(n, seconds=4.0, rest=1.0)
        imu, truth = flight.streams["imu"], flight.truth
        assert truth is not None
        fields = {
            "imu_gyr": imu["gyro"],
            "imu_acc": imu["specific_force"],
            "imu_mag": flight.streams["magnetometer"]["field"] * 1e6,
            "opt_quat": truth["attitude"],
            "opt_pos": np.zeros((len(truth), 3)),
            "movement": np.arange(len(truth)) > 100,
            "sampling_rate": 100.0,
        }
        savemat(folder / f"0{n}_made.mat", fields)
    return tmp_path


def test_broad_has_a_row_a_trial_and_filter_and_their_means(trials):
    report = broad(data=str(trials), engine="python")
    filters = {row["filter"] for row in report.rows}
    assert "marg" in filters
    assert len(report.rows) == 3 * len(filters)
    assert len(filters) + len(report.notes) == 3
    ours = [row for row in report.rows if row["filter"] == "marg"]
    assert [row["trial"] for row in ours] == ["01_made", "02_made", "mean of 2"]
    for figure in ("total_rmse_deg", "heading_rmse_deg", "inclination_rmse_deg"):
        assert ours[2][figure] == pytest.approx((ours[0][figure] + ours[1][figure]) / 2)
        assert 0.0 < ours[2][figure] < 2.0
    for figure in ("tilt_nees_median", "heading_nees_median"):
        one, two, all_of_them = (row[figure] for row in ours)
        assert 0.0 < min(one, two) <= all_of_them <= max(one, two)
        assert not any(figure in row for row in report.rows if row["filter"] != "marg")


@pytest.mark.parametrize("peer", ["vqf", "madgwick"])
def test_a_peer_is_given_the_same_readings_in_its_own_frame(trials, peer):
    """Each finds what was made to some degrees: a frame turned by 90 degrees would not."""
    pytest.importorskip({"vqf": "vqf", "madgwick": "ahrs"}[peer], reason="needs the extra bench")
    rows = broad(data=str(trials), engine="python", trials="01").rows
    (row,) = [r for r in rows if r["filter"] == peer and r["trial"] == "01_made"]
    assert row["total_rmse_deg"] < 30.0 if peer == "madgwick" else row["total_rmse_deg"] < 5.0


def test_a_peer_that_is_not_installed_is_a_note(trials, monkeypatch):
    for package in ("vqf", "ahrs"):
        monkeypatch.setitem(sys.modules, package, None)
    report = broad(data=str(trials), engine="python", duration=2.0)
    assert {row["filter"] for row in report.rows} == {"marg"}
    assert any("vqf is left out" in note and "flowgraph-filters[bench]" in note for note in report.notes)


def test_ese650_has_a_row_a_set_and_filter_beside_what_was_published(tmp_path):
    for n in (1, 2):
        course(tmp_path, n, seconds=4.0)
    report = ese650(data=str(tmp_path), engine="python", filters="imu_calibration")
    assert [(row["set"], row["filter"]) for row in report.rows] == [
        (1, "imu_calibration"),
        (1, "published"),
        (2, "imu_calibration"),
        (2, "published"),
    ]
    assert report.rows[3]["yaw_rmse_rad"] == PUBLISHED[2][2] == 0.411
    with pytest.raises(UnknownNameError, match="no graph is called 'kalmann'"):
        ese650(data=str(tmp_path), filters="kalmann")


def test_ese650_draws_filter_accelerometer_and_gyroscope_against_the_truth(tmp_path):
    for n in (1, 2):
        course(tmp_path, n, seconds=4.0)
    report = ese650(data=str(tmp_path), engine="python")
    assert set(report.figures) == {"set1.png", "set2.png"}
    report.figures["set2.png"](tmp_path / "set2.png")
    assert (tmp_path / "set2.png").stat().st_size > 20_000
    assert ese650(data=str(tmp_path), engine="python", filters="imu_calibration").figures == {}


def test_data_come_from_the_option_the_environment_or_beside(trials, tmp_path, monkeypatch):
    assert len(recordings(str(trials), "broad", "*.mat")) == 2
    assert len(recordings(str(trials / "broad"), "broad", "*.mat")) == 2
    monkeypatch.setenv("FLOWGRAPH_DATA", str(trials))
    assert len(recordings(None, "broad", "*.mat")) == 2
    with pytest.raises(DataError, match="there are no recordings of broad") as caught:
        broad(data=str(tmp_path / "none"))
    assert "no such folder" in str(caught.value)
    with pytest.raises(DataError, match="there are no recordings of broad"):
        broad(data=str(trials), trials="none")


def test_the_command_prints_the_table(trials):
    command = (
        "bench",
        "broad",
        "--data",
        str(trials),
        "--set",
        "engine=python",
        "--set",
        "trials=01",
        "--json",
    )
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, command)
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["rows"]
    assert rows[0]["trial"] == "01_made"
    assert rows[0]["filter"] == "marg"
    listed = CliRunner(env={"COLUMNS": "200"}).invoke(app, ("bench",))
    assert "broad" in listed.stdout
    assert "ese650" in listed.stdout
