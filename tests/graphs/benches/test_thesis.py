"""`bench thesis`: the thesis's table, our figures below its own and at the bound."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.geometry.rotations import conjugate, multiply, to_rotation_vector
from flowgraph.blocks.scoring.tuning import reading_of
from flowgraph.graphs import rbpf_indoor
from flowgraph.graphs.benches.thesis import SETTINGS, Noise, fly, thesis
from tests.drawing.test_page import _Reader

KEYS = {
    *("setting", "filter", "position_rmse_m", "attitude_rmse_deg", "thesis_metric_position"),
    *("thesis_metric_attitude", "thesis_position", "thesis_attitude", "bound_position_rmse_m"),
    *("bound_attitude_rmse_deg", "nees_mean"),
}

HONEST = {"ekf", "ukf", "eskf"} | ({"rbpf"} if "covariance" in rbpf_indoor.parameters[1] else set())
"""Those that tell a covariance."""


def test_the_flight_is_that_of_a_world_without_gravity():
    flight = fly(3, Noise.of("HLH"), duration=2.0)
    assert flight.truth is not None
    assert list(flight.streams) == ["imu", "vicon"]
    imu = flight.streams["imu"]
    exact = flight.info["world"].at(imu.time / 1e9)
    push = exact.coordinate_acceleration
    error = imu["specific_force"][1:] - 0.5 * (push[1:] + push[:-1])
    assert 0.9 < np.std(error.reshape(20, 20, 3).sum(1)) / np.sqrt(20.0) < 1.1  # a variance of 1 per sample
    q = exact.attitude
    turn = to_rotation_vector(multiply(conjugate(q[:-1], xp=np), q[1:], xp=np), xp=np) * 200.0
    assert 0.28 < np.std(imu["gyro"][1:] - turn) < 0.36  # and one of 0.1
    assert reading_of(flight) == "mean"


@pytest.mark.slow
def test_our_filters_are_below_the_figures_of_the_thesis_and_reach_the_bound():
    """Over 40 flights; of the particles `test_rbpf_settings` says it."""
    rows = thesis(flights=40, filters="acf,ekf,ukf", smoothed="").rows
    assert {row["setting"] for row in rows} == set(SETTINGS)
    for row in rows:
        where = f"{row['setting']} {row['filter']}"
        assert row["thesis_metric_position"] < row["thesis_position"], where
        assert row["thesis_metric_attitude"] < row["thesis_attitude"], where
        if row["filter"] == "acf":
            assert row["position_rmse_m"] > 1.2 * row["bound_position_rmse_m"], where
    for name in ("ekf", "ukf"):
        mine = [row for row in rows if row["filter"] == name]
        for key in ("position_rmse_m", "attitude_rmse_deg"):
            assert 0.98 < np.mean([row[key] / row[f"bound_{key}"] for row in mine]) < 1.03, name
        assert 0.95 < np.mean([row["nees_mean"] / 9.0 for row in mine]) < 1.05, name


@pytest.mark.slow
def test_the_page_has_the_table_as_charts_and_the_filters_on_one_flight(tmp_path):
    found = thesis(
        flights=1, duration=1.0, settings="HHH,LLL", filters="ekf,eskf", smoothed="", engine="python"
    )
    assert list(found.figures) == ["thesis.png", "thesis.html"]
    file = tmp_path / "thesis.html"
    found.figures["thesis.html"](file)
    page = _Reader(file.read_text())
    position, *_, metric = page.data("charts")
    assert position["x"]["names"] == ["HHH", "LLL"]
    for bars in position["series"]:
        mine = [row for row in found.rows if row["filter"] == bars["name"]]
        assert bars["y"] == [row["position_rmse_m"] for row in mine]
        assert bars["low"] == [row["position_rmse_low_m"] for row in mine]
    assert [mark["y"] for mark in position["marks"]] == [
        row["bound_position_rmse_m"] for row in found.rows if row["filter"] == "ekf"
    ]
    assert metric["y"]["log"] is True
    assert metric["series"][-1]["y"] == [
        row["thesis_attitude"] for row in found.rows if row["thesis_attitude"]
    ]
    runs = page.data("runs")
    assert [run["title"] for run in runs] == ["ekf", "eskf"]
    for run in runs:  # the flight of the first setting, the same that is in the table
        (row,) = [r for r in found.rows if (r["filter"], r["setting"]) == (run["title"], "HHH")]
        assert float(dict(run["figures"])["position_rmse_m"]) == pytest.approx(
            row["position_rmse_m"], rel=1e-4
        )
    assert "<td" in file.read_text()
