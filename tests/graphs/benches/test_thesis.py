"""`bench thesis`: the thesis's table, our figures below its own, and nobody below the bound."""

from __future__ import annotations

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph.cli import app
from flowgraph.graphs.benches.thesis import FILTERS, PUBLISHED, SETTINGS, Noise, fly, thesis

KEYS = {
    *("setting", "filter", "position_rmse_m", "attitude_rmse_deg", "thesis_metric_position"),
    *("thesis_metric_attitude", "thesis_position", "thesis_attitude", "bound_position_rmse_m"),
}


def test_the_flight_is_that_of_a_world_without_gravity():
    flight = fly(3, Noise.of("HLH"), duration=2.0)
    assert flight.truth is not None
    assert list(flight.streams) == ["imu", "vicon"]
    exact = fly(3, Noise.of("HLH"), duration=2.0).info["world"].at(flight.streams["imu"].time / 1e9)
    error = flight.streams["imu"]["specific_force"] - exact.coordinate_acceleration
    assert 0.9 < np.std(error) < 1.1  # a variance of 1 per sample
    assert 0.28 < np.std(flight.streams["imu"]["gyro"] - exact.rate) < 0.36  # and one of 0.1


@pytest.mark.slow
def test_a_row_a_setting_and_filter(tmp_path):
    arguments = [
        "--flights",
        "1",
        "--set",
        "duration=2",
        "--set",
        "settings=LLL",
        "--set",
        "particles=50",
    ]
    done = CliRunner().invoke(app, ["bench", "thesis", *arguments, "--json", "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    rows = json.loads(done.stdout)["rows"]
    assert [(row["setting"], row["filter"]) for row in rows] == [(s, f) for s in ("LLL",) for f in FILTERS]
    for row in rows:
        assert set(row) >= KEYS
        expected = PUBLISHED.get((row["filter"], row["setting"]), (None, None))
        assert (row["thesis_position"], row["thesis_attitude"]) == expected
        assert row["thesis_metric_position"] == pytest.approx(row["position_rmse_m"] ** 2)
        assert row["position_rmse_low_m"] <= row["position_rmse_m"] <= row["position_rmse_high_m"]
    assert (tmp_path / "thesis.png").stat().st_size > 10_000


@pytest.mark.parametrize("setting", [("filters", "acf,pf"), ("settings", "HHX")])
def test_an_unknown_filter_or_setting_is_refused(setting):
    done = CliRunner().invoke(app, ["bench", "thesis", "--set", "=".join(setting)])
    assert done.exit_code == 2
    assert setting[1].split(",")[-1] in done.stderr
    assert "expected" in done.stderr


@pytest.mark.slow
def test_our_filters_are_below_the_figures_of_the_thesis_and_above_the_bound():
    """And particles come near the error-state filter."""
    rows = thesis(flights=5, engine="c").rows
    assert {row["setting"] for row in rows} == set(SETTINGS)
    reference = {row["setting"]: row["position_rmse_m"] for row in rows if row["filter"] == "eskf"}
    for row in rows:
        where = f"{row['setting']} {row['filter']}"
        assert row["position_rmse_m"] >= row["bound_position_rmse_m"], where
        if row["filter"] in ("acf", "ekf", "ukf"):
            assert row["thesis_metric_position"] < row["thesis_position"], where
            assert row["thesis_metric_attitude"] < row["thesis_attitude"], where
        if row["filter"] == "rbpf":
            assert row["position_rmse_m"] <= 1.12 * reference[row["setting"]], where
