"""Roll, pitch and yaw are drawn in the convention of the graph that holds them."""

from __future__ import annotations

import json
from functools import cache

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from flowgraph import Case, Flight, Result, load_flight, simulate
from flowgraph.drawing.angles import angle_rates, euler_angles, euler_variances
from flowgraph.drawing.plot import plot_navigation
from flowgraph.drawing.trajectory import plot_ins
from flowgraph.graphs import ins_ekf_pose, ins_eskf, ins_ukf_pose


@pytest.mark.parametrize(("order", "theirs"), [("zyx", "ZYX"), ("zxy", "ZXY")])
def test_the_angles_are_those_of_scipy(order, theirs):
    turns = Rotation.random(50, random_state=0)
    with np.errstate(invalid="ignore"):
        expected = turns.as_euler(theirs)
    places = {"zyx": [2, 1, 0], "zxy": [1, 2, 0]}[order]
    found = np.stack([euler_angles(q[None], order)[0] for q in turns.as_quat()[:, [3, 0, 1, 2]]])
    np.testing.assert_allclose(found, np.rad2deg(expected[:, places]), atol=1e-9)


@pytest.mark.parametrize("order", ["zyx", "zxy"])
def test_the_rates_of_the_angles_are_those_of_small_turns(order):
    turns = Rotation.from_euler("ZYX", np.random.default_rng(1).uniform(-1.0, 1.0, (20, 3)))
    E = angle_rates(turns.as_quat()[:, [3, 0, 1, 2]], order)
    for k, step in enumerate(np.eye(3) * 1e-6):
        moved = [(turns * Rotation.from_rotvec(s)).as_quat()[:, [3, 0, 1, 2]] for s in (step, -step)]
        angles = [np.stack([euler_angles(q[None], order)[0] for q in m]) for m in moved]
        np.testing.assert_allclose(E[:, :, k], np.deg2rad(angles[0] - angles[1]) / 2e-6, atol=1e-6)


@cache
def flown(order: str) -> tuple[Flight, Case, Result]:
    made = load_flight("sim", seed=1, settings={"duration": "2"})
    graph = ins_ekf_pose if order == "zxy" else ins_ukf_pose
    case = graph.case(made, order=order)
    return made, case, simulate(case.graph, case.inputs)


@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_a_graph_is_drawn_as_it_holds_itseuler_angles(order):
    made, case, result = flown(order)
    assert case.order == order
    held = np.rad2deg(result["angles"]["angles"])
    name = lambda k: ("roll", "pitch", "yaw")[k] + (" (zxy)" if order == "zxy" else "")
    for figure in (
        plot_navigation(result["belief"], made.truth, order=case.order),
        plot_ins(result["belief"], made.truth, order=case.order),
    ):
        for k in range(3):
            (axis,) = [a for a in figure.axes if a.get_title(loc="left").startswith(name(k))]
            lines = [np.asarray(line.get_ydata(), dtype=float) for line in axis.lines]
            assert any(len(y) == len(held) and np.allclose(y, held[:, k], atol=1e-6) for y in lines)


@pytest.mark.parametrize("order", ["zxy", "zyx"])
def test_the_band_is_what_the_filter_claims_for_itseuler_angles(order):
    _, _, result = flown(order)
    own = np.rad2deg(result["angles"]["deviations"])
    for k in range(3):
        belief = result["belief"]
        variance = euler_variances(belief["attitude"], belief["covariance"][:, 6:9, 6:9], order)[:, k]
        np.testing.assert_allclose(np.sqrt(variance), own[:, k], rtol=1e-6)


def test_other_graphs_are_drawn_as_before():
    assert ins_eskf.case(load_flight("sim", settings={"duration": "0.1"})).order == "zyx"


def test_the_command_draws_in_the_graphs_convention(tmp_path, monkeypatch):
    from typer.testing import CliRunner

    from flowgraph.cli import app

    seen = []

    def drawn(*arguments, **options):
        seen.append(options["order"])
        return plot_navigation(*arguments, **options)

    monkeypatch.setattr("flowgraph.drawing.plot.plot_navigation", drawn)
    words = ["run", "ins_ekf_pose", "--data", "sim", "--set", "duration=1", "--out", str(tmp_path), "--json"]
    found = CliRunner().invoke(app, words)
    assert found.exit_code == 0, found.output
    assert seen == ["zxy"]
    assert json.loads((tmp_path / "metrics.json").read_text())["graph"] == "ins_ekf_pose"
