"""Calibration: offsets, levers and mounts that were put in are found, and what cannot be is refused."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import Flight, Series, load_flight
from flowgraph.blocks.signals import Position
from flowgraph.cli import app
from flowgraph.study.calibrate import calibrate
from flowgraph.study.guess import guess_offset
from flowgraph.study.tune import Fit, Recording
from tests.calibration import off, recorded

RUNNER = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"})


def shifted(seconds: float) -> Flight:
    """A flight whose motion capture stamps that much too early."""
    flight = load_flight("sim", settings={"duration": "25", "vicon.rate": "50"})
    vicon = flight.streams["vicon"]
    late = Series(vicon.time - round(seconds * 1e9), vicon.values, name="vicon")
    return Flight("late", {"imu": flight.streams["imu"], "vicon": late})


@pytest.mark.parametrize("seconds", [-0.13, 0.085])
def test_what_both_streams_see_of_the_motion_tells_the_offset(seconds):
    found = guess_offset(shifted(seconds), "vicon", -0.3, 0.3)
    assert found is not None
    assert found.sure
    assert found.offset == pytest.approx(seconds, abs=0.006)


def test_from_positions_alone_accelerations_tell_the_offset_and_a_number_tells_nothing():
    flight = shifted(0.1)
    vicon = flight.streams["vicon"]
    seen = Series(vicon.time, Position(position=vicon["position"]), name="place")
    found = guess_offset(Flight("a", {"imu": flight.streams["imu"], "place": seen}), "place", -0.3, 0.3)
    assert found is not None
    assert found.by == "accelerations of place and imu"
    assert found.offset == pytest.approx(0.1, abs=0.008)
    alone = Flight("b", {"imu": flight.streams["imu"], "depth": Series(vicon.time, vicon["position"][:, 2])})
    assert guess_offset(alone, "depth", -0.3, 0.3) is None


def test_what_cannot_be_calibrated_is_refused():
    words = ["calibrate", "ekf", "--data", "sim"]
    for find, said in (
        ("vicon.lever=0.3:-0.3", "low <= start"),
        ("vicon.lever", "KEY=LOW:HIGH"),
        ("vicon.lever=-0.1:0.1", "vicon.lever"),  # of a simulated flight it is no setting
        ("settle=0.1:1", "how a run is scored"),
    ):
        done = RUNNER.invoke(app, [*words, "--find", find])
        assert done.exit_code == 2, (find, done.output)
        assert said in done.stderr or "LOW:HIGH" in done.stderr
    assert RUNNER.invoke(app, [*words, "--find", "gyro_factor=0.1:9", "--by", "luck"]).exit_code == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0])
def test_a_lever_and_a_mount_are_found_within_their_own_deviations(seed):
    assert np.abs(off(seed, 10.0)).max() < 3.5


@pytest.mark.slow
def test_the_command_finds_an_offset_that_run_then_reads(tmp_path):
    spec, settings = recorded(tmp_path, 2, 12.0)
    words = ["--data", spec, *(w for n, v in settings.items() for w in ("--set", f"{n}={v}"))]
    words += ["--set", "vicon.lever=0.1,-0.05,0.07", "--set", "vicon.mount=3,-2,5"]
    file = tmp_path / "found.json"
    done = RUNNER.invoke(
        app,
        [
            "calibrate",
            "ins_eskf",
            *words,
            "--find",
            "vicon.time_offset=-0.2:0.2",
            "--json",
            "--out",
            str(file),
        ],
    )
    assert done.exit_code == 0, done.output
    one = json.loads(file.read_text())["parameters"]["vicon.time_offset"]
    assert abs(one["value"]) < 0.006
    assert 0.0 < one["deviation"] < 0.006
    again = RUNNER.invoke(
        app, ["run", "ins_eskf", *words, "--settings", str(file), "--engine", "c", "--json"]
    )
    assert again.exit_code == 0, again.output
    assert f"shifted by {round(one['value'] * 1e9)} ns" in again.stdout


def test_a_noise_is_found_as_by_tune():
    found = calibrate(
        "ekf", [Fit("gyro_factor", 0.5, 2.0)], [Recording("sim")], engine="reference", most=2,
        settings={"duration": 2.0, "imu.rate": 25.0},
    )  # fmt: skip
    assert set(found.parameters) == {"gyro_factor"}
    assert found.evaluations >= 1
