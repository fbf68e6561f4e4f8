"""Pictures of orientation estimates: what is drawn is what there is."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import DataError, Series, UnknownNameError
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.signals import Attitude, AttitudeBiasBelief
from flowgraph.cli import app
from flowgraph.drawing.angles import euler_angles, euler_variances
from flowgraph.drawing.attitude import plot_comparison, plot_orientation


def belief(n: int = 50) -> tuple[Series, Series]:
    """An estimate that is off by 2 degrees of heading, and its truth with a gap."""
    time = np.arange(n, dtype=np.int64) * 10**7
    turns = np.stack(
        [0.3 * np.sin(np.arange(n) / 9), 0.2 * np.cos(np.arange(n) / 7), np.arange(n) / 8], axis=1
    )
    right = from_rotation_vector(turns, xp=np)
    off = np.tile([np.cos(np.radians(1.0)), 0.0, 0.0, np.sin(np.radians(1.0))], (n, 1))
    P = np.tile(np.diag([1e-4, 1e-4, 4e-4, 1e-6, 1e-6, 1e-6]), (n, 1, 1))
    values = AttitudeBiasBelief(
        attitude=multiply(off, right, xp=np), gyro_bias=np.zeros((n, 3)), covariance=P
    )
    known = right + 0.0
    known[20:25] = np.nan
    return Series(time, values, name="belief"), Series(time, Attitude(attitude=known), gaps=True)


def lines(figure, title: str) -> list[np.ndarray]:
    """The lines' values of the panel whose title starts so."""
    (axis,) = [a for a in figure.axes if a.get_title(loc="left").startswith(title)]
    return [np.asarray(line.get_ydata(), dtype=float) for line in axis.lines]


def test_angles_errors_and_biases_are_drawn_with_bands(tmp_path):
    estimate, truth = belief()
    figure = plot_orientation(estimate, truth, tmp_path / "a.png")
    titles = [a.get_title(loc="left") for a in figure.axes]
    assert titles[:3] == ["roll, with 3σ", "pitch, with 3σ", "yaw, with 3σ"]
    assert titles[3:6] == ["total error", "inclination error, with 3σ", "heading error, with 3σ"]
    assert titles[6] == "gyro bias x, with 3σ"
    assert (tmp_path / "a.png").stat().st_size > 5000
    heading = lines(figure, "heading error")[-1]
    gap = np.isnan(heading)
    assert gap[20:25].all()
    assert not gap[:20].any()
    np.testing.assert_allclose(heading[~gap], 2.0, atol=1e-6)
    np.testing.assert_allclose(lines(figure, "inclination error")[-1][~gap], 0.0, atol=1e-5)


def test_filters_are_compared_over_the_truth(tmp_path):
    estimate, truth = belief()
    other = Series(estimate.time[::2], Attitude(attitude=estimate["attitude"][::2]))
    figure = plot_comparison({"filter": estimate, "gyroscope": other}, truth, tmp_path / "c.svg")
    assert [a.get_title(loc="left") for a in figure.axes] == ["roll", "pitch", "yaw"]
    legend = figure.axes[0].get_legend()
    assert legend is not None
    assert [t.get_text() for t in legend.get_texts()] == ["gyroscope", "truth", "filter"]
    seen, right, ours = lines(figure, "yaw")
    assert [len(y) for y in (seen, right, ours)] == [25, 50, 50]
    assert np.isnan(right[20:25]).all()
    both = np.isfinite(right) & np.isfinite(ours)
    np.testing.assert_allclose((ours - right)[both], 2.0, atol=1e-6)
    assert len(plot_comparison({"filter": estimate}).axes[0].lines) == 1
    with pytest.raises(DataError, match="there is nothing to compare"):
        plot_comparison({})
    with pytest.raises(UnknownNameError, match="attitude"):
        plot_comparison({"bias": Series(estimate.time, estimate["gyro_bias"])})


def test_only_what_exists_is_drawn():
    estimate, _ = belief()
    alone = Series(estimate.time, Attitude(attitude=estimate["attitude"]))
    figure = plot_orientation(alone)
    assert [a.get_title(loc="left") for a in figure.axes] == ["roll", "pitch", "yaw"]
    with pytest.raises(UnknownNameError, match="no field is called 'attitude'"):
        plot_orientation(Series(estimate.time, estimate["gyro_bias"]))
    with pytest.raises(DataError, match="no values to plot"):
        plot_orientation(alone[:0])


def test_the_band_of_an_angle_is_what_small_turns_make_of_it():
    """Sampled: roll, pitch and yaw of q * Exp(e) with e of the covariance."""
    rng = np.random.default_rng(0)
    q = from_rotation_vector(np.array([[0.4, -0.5, 1.0]]), xp=np)
    P = np.array([[[4e-4, 1e-4, 0.0], [1e-4, 2e-4, 0.0], [0.0, 0.0, 9e-4]]])
    errors = rng.multivariate_normal(np.zeros(3), P[0], size=20000)
    angles = euler_angles(multiply(np.tile(q, (20000, 1)), from_rotation_vector(errors, xp=np), xp=np))
    np.testing.assert_allclose(np.sqrt(euler_variances(q, P)[0]), angles.std(axis=0), rtol=0.03)


def test_the_command_draws_them(tmp_path: Path):
    settings = ("--set", "sensors=imu,magnetometer", "--set", "duration=3")
    arguments = ["run", "marg", "--data", "sim:hover", *settings, "--out", str(tmp_path / "o"), "--json"]
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert {"orientation.png", "estimate.tum"} <= {f.name for f in (tmp_path / "o").iterdir()}
    report = json.loads(done.stdout)
    assert report["total_rmse_deg"] < 20.0
    assert {"roll_rmse_rad", "heading_rmse_deg", "inclination_rmse_deg"} <= set(report)
