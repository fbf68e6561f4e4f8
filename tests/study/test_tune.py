"""Tuning: it finds what was put in, judges by what was held out, and refuses what cannot be."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import (
    DataError,
    DeclarationError,
    MissingDependencyError,
    UnknownNameError,
    find_graph,
    load_flight,
    simulate,
)
from flowgraph.cli import app
from flowgraph.study import slopes, trials
from flowgraph.study.search import first_steps
from flowgraph.study.tune import Fit, Recording, start_of_fit, surprise, tune
from tests.blocks.datasets.test_datasets import course
from tests.recordings import recordings

PERFECT: dict[str, Any] = {
    "gyro.walk": 0.0, "accelerometer.walk": 0.0, "gyro.bias": 0.0, "accelerometer.bias": 0.0,
    "duration": 4.0, "imu.rate": 25.0, "vicon.rate": 25.0,
}  # fmt: skip
"""A flight without biases, which `ekf` does not know."""

NOISES = [Fit("position_noise", 1e-3, 0.1, 0.05), Fit("attitude_noise", 1e-3, 0.1, 0.002)]


@pytest.mark.slow
def test_likelihood_finds_the_true_noise_of_the_measurement():
    found = tune(
        "ekf", NOISES, [Recording("sim", 0), Recording("sim", 1)], [Recording("sim", 2)], most=60,
        settings={**PERFECT, "position.noise": 0.02, "attitude.noise": 0.005},
    )  # fmt: skip
    assert found.parameters["position_noise"] == pytest.approx(0.02, rel=0.2)
    assert found.parameters["attitude_noise"] == pytest.approx(0.005, rel=0.2)
    assert found.converged
    assert found.at_bound == {}
    assert [j.held_out for j in found.judged] == [False, False, True]
    means = found.mean(held_out=False)
    assert means is not None
    before, after, own = means
    assert after < before  # the start, a factor 2.5 off
    assert after <= own + 1e-9  # its own are the true values, which the fit can only beat on its own data


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_likelihood_finds_all_noises_of_a_longer_flight(factor):
    pytest.importorskip("jax")
    fits = [*NOISES, Fit("gyro_factor", 0.1, 30.0), Fit("accelerometer_factor", 0.1, 30.0)]
    truth = {"gyro.noise": 1e-3 * factor, "accelerometer.noise": 1e-2 * factor}
    settings = {**PERFECT, **truth, "duration": 10.0, "imu.rate": 100.0, "vicon.rate": 10.0}
    found = tune("ekf", fits, [Recording("sim", k) for k in range(4)], settings=settings, engine="xla")
    wanted = {"position_noise": 0.01, "attitude_noise": 0.01, "gyro_factor": 1.0, "accelerometer_factor": 1.0}
    for name, value in wanted.items():  # the factors are on the flight's own densities
        assert found.parameters[name] == pytest.approx(value, rel=0.2), name


def test_error_against_the_truth_gets_smaller_on_what_is_held_out():
    found = tune(
        "ekf", [Fit("position_noise", 1e-3, 1.0, 0.5)], [Recording("sim", 0)], [Recording("sim", 1)],
        measure="error", metric="position_rmse_m", settings={**PERFECT, "attitude_noise": 0.01}, most=25,
    )  # fmt: skip
    assert found.metric == "position_rmse_m"
    assert found.parameters["position_noise"] < 0.1
    judged = found.judged[1]
    assert judged.held_out
    assert judged.after == pytest.approx(math.log(judged.metrics["position_rmse_m"][1]))
    assert judged.after < judged.before
    assert judged.before == pytest.approx(math.log(judged.metrics["position_rmse_m"][0]))
    assert judged.own == pytest.approx(math.log(judged.metrics["position_rmse_m"][2]))


@pytest.mark.slow
def test_each_recording_is_held_out_once_and_judged_by_the_search_that_did_without_it():
    fit, flights = [Fit("position_noise", 1e-3, 1.0, 0.5)], [Recording("sim", k) for k in range(3)]
    how: Any = {"measure": "error", "settings": {**PERFECT, "attitude_noise": 0.01}, "most": 12}
    found = tune("ekf", fit, flights, folds=2, **how)
    assert [(j.recording.seed, j.held_out, j.fold) for j in found.judged] == [
        (0, True, 0), (1, True, 1), (2, True, 0),
    ]  # fmt: skip
    alone = tune("ekf", fit, [flights[1]], [flights[0], flights[2]], **how)
    assert found.folds[0].parameters == alone.parameters
    assert [j.after for j in found.judged if j.fold == 0] == [j.after for j in alone.judged if j.held_out]
    assert found.parameters == tune("ekf", fit, flights, **how).parameters
    assert found.mean(held_out=False) is None
    means = found.mean(held_out=True)
    assert means is not None
    assert means[1] < means[0]


def test_a_search_starts_as_told_or_at_the_own_value_or_in_the_middle():
    assert start_of_fit("quaternion_ukf", Fit("force_noise", 0.1, 40.0)) == 2.0
    assert start_of_fit("quaternion_ukf", Fit("force_noise", 0.1, 40.0, 3.0)) == 3.0
    # of these two the own value is outside, or that of a flight
    assert start_of_fit("quaternion_ukf", Fit("force_noise", 4.0, 9.0)) == pytest.approx(6.0)
    assert start_of_fit("ekf", Fit("position_noise", 1e-3, 0.1)) == pytest.approx(0.01)


def test_a_simplex_moves_each_parameter_at_first_also_from_one():
    """At 1 the logarithm is 0, of which a part is nothing."""
    seen = []
    tune(
        "ekf", [Fit("gyro_factor", 0.1, 10.0, 1.0), Fit("accelerometer_factor", 0.1, 10.0, 10.0)],
        [Recording("sim")], measure="error", settings=PERFECT, most=3,
        watch=lambda count, best, value: seen.append(value),
    )  # fmt: skip
    assert len(seen) == 3
    steps = first_steps(np.log([1.0, 10.0]), np.log([0.1, 0.1]), np.log([10.0, 10.0]))
    np.testing.assert_allclose(steps, [1.0, -1.0])


def test_surprise_is_the_negative_logarithm_of_the_density():
    from scipy.stats import multivariate_normal

    settings = {n: str(v) for n, v in PERFECT.items()}
    case = find_graph("ekf").case(load_flight("sim", seed=3, settings=settings))
    result = simulate(case.graph, case.inputs, engine="reference", seed=3)
    seen = result["innovation"]
    wanted = [
        -multivariate_normal.logpdf(r, np.zeros(6), S)
        for r, S in zip(seen.residual, seen.covariance, strict=True)
    ]
    assert surprise(result) == pytest.approx(np.sum(wanted) / (6 * len(wanted)), rel=1e-9)


@pytest.mark.slow
def test_vectorised_evaluation_is_that_of_one_at_a_time():
    pytest.importorskip("jax")
    how: Any = {"settings": PERFECT, "most": 1}
    fits, flights = [Fit("position_noise", 1e-3, 0.1)], [Recording("sim", 0), Recording("sim", 1)]
    one = tune("ekf", fits, flights, **how)
    many = tune("ekf", fits, flights, engine="xla", **how)
    for a, b in zip(one.judged, many.judged, strict=True):
        assert a.before == pytest.approx(b.before, abs=1e-8)


def test_a_parameter_that_ends_at_its_bound_is_said():
    found = tune("ekf", [Fit("position_noise", 0.1, 0.5)], [Recording("sim")], settings=PERFECT, most=15)
    assert found.at_bound == {"position_noise": "low"}


BAD = [
    ({"fits": []}, "fit"),
    ({"recordings": []}, "data"),
    ({"held_out": [Recording("sim")]}, "held out"),
    ({"fits": [Fit("position_noise", 0.1, 0.01)]}, "swap the bounds: low 0.01, high 0.1"),
    ({"fits": [Fit("position_noise", 0.0, 0.01)]}, "give bounds above 0"),
    ({"fits": [Fit("position_noise", 0.2, -0.2)]}, "low 0.2, high -0.2"),
    ({"fits": [Fit("position_noise", float("nan"), 1.0)]}, "give two finite numbers"),
    ({"fits": [Fit("position_noise", "a", 1.0)]}, "give two finite numbers"),  # type: ignore[arg-type]
    ({"fits": [Fit("position_noise", 0.01, 0.1, 0.2)]}, "start"),
    ({"fits": [Fit("position_noise", 0.01, 0.1)] * 2}, "once"),
    ({"fits": [Fit("duration", 1.0, 2.0)]}, "flight"),
    ({"fits": [Fit("noize", 1.0, 2.0)]}, "noize"),
    ({"settings": {"position_noise": 0.1}}, "once"),
    ({"measure": "guess"}, "guess"),
    ({"method": "guess"}, "guess"),
    ({"engine": "guess"}, "guess"),
    ({"most": 0}, "most"),
    ({"folds": 1}, "folds"),
    ({"folds": 2}, "recordings, 1"),
    ({"recordings": [Recording("sim")] * 2}, "each once"),
    (
        {"recordings": [Recording("sim", k) for k in (0, 1)], "held_out": [Recording("sim", 2)], "folds": 2},
        "either folds",
    ),
    ({"measure": "error", "metric": "speed"}, "position_rmse_m"),
]


@pytest.mark.parametrize(("wrong", "said"), BAD, ids=[str(k) for k in range(len(BAD))])
def test_what_cannot_be_tuned_is_refused(wrong, said):
    how: Any = {"fits": NOISES[:1], "recordings": [Recording("sim")], "settings": {"imu.rate": 50}, **wrong}
    with pytest.raises((DataError, DeclarationError, UnknownNameError)) as caught:
        tune("ekf", how.pop("fits"), how.pop("recordings"), how.pop("held_out", ()), **how)
    assert said in str(caught.value)
    assert caught.value.fix


def test_a_graph_without_innovations_is_refused():
    with pytest.raises(DataError, match="no innovations"):
        tune(
            "augmented_complementary", [Fit("alpha", 0.1, 0.9)], [Recording("sim")],
            settings={"duration": 1.2}, most=1,
        )  # fmt: skip


def test_the_command_prints_what_it_found(tmp_path):
    words = ["tune", "ekf", "--data", "sim", "--held-out-seeds", "1", "--fit", "position_noise=0.001:0.1"]
    words += [w for n, v in PERFECT.items() for w in ("--set", f"{n}={v}")]
    runner = CliRunner(env={"COLUMNS": "200"})
    done = runner.invoke(app, [*words, "--most", "9", "--json", "--out", str(tmp_path / "found.json")])
    assert done.exit_code == 0, done.output
    found = json.loads((tmp_path / "found.json").read_text())
    assert 0.001 < found["parameters"]["position_noise"]["value"] < 0.1
    assert [r["held_out"] for r in found["recordings"]] == [False, True]
    assert found["recordings"][1]["metrics"]["position_rmse_m"].keys() == {"before", "after", "own"}
    assert found["mean"]["held_out"]["after"] == found["recordings"][1]["after"]
    plain = runner.invoke(app, [*words, "--most", "3"])
    assert "--set position_noise=" in plain.output
    assert "before: position_noise=0.01\n" in plain.output
    assert "stopped early, after" in plain.output
    assert "--most is 3" in plain.output
    assert runner.invoke(app, [*words[:-2], "--fit", "x"]).exit_code == 2


def test_the_command_says_at_which_bound_a_search_ended():
    words = ["tune", "ekf", "--data", "sim", "--seeds", "2", "--folds", "2", "--by", "error", "--most", "20"]
    words += ["--fit", "position_noise=0.2:0.5:0.3", "--set", "attitude_noise=0.01"]
    words += [w for n, v in PERFECT.items() for w in ("--set", f"{n}={v}")]
    done = CliRunner(env={"COLUMNS": "200"}).invoke(app, words)
    assert done.exit_code == 0, done.output
    for said in ("held out, fold 0", "held out, fold 1", "geometric mean", "after, without fold 1: pos"):
        assert said in done.output
    assert "note: position_noise ended at its low bound, 0.2 without fold 0" in done.output
    assert "widen --fit position_noise=" in done.output


@pytest.mark.slow
def test_tuning_from_the_data_sheet_lowers_the_error_on_a_recording_that_was_held_out():
    """As in docs/studies.md, with one parameter, three recordings and few points."""
    folder = recordings("ese650")
    words = ["tune", "quaternion_ukf", *(w for k in (3, 6) for w in ("--data", f"ese650:{folder}:{k}"))]
    words += ["--held-out", f"ese650:{folder}:5", "--by", "error", "--metric", "inclination_rmse_deg"]
    words += ["--engine", "c", "--fit", "force_noise=0.01:30:0.03", "--most", "10"]
    done = CliRunner().invoke(app, [*words, "--json"])
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)
    assert [r["held_out"] for r in found["recordings"]] == [False, False, True]
    means = found["mean"]["held_out"]
    assert means["after"] < means["before"] - 0.3  # of a logarithm: by a quarter


@pytest.mark.parametrize("engine", ["reference", "c"])
def test_what_fails_at_every_point_is_said_and_not_searched(monkeypatch, engine):
    """A missing compiler, say, is no matter of the parameters."""

    def missing(*_: Any, **__: Any) -> Any:
        raise MissingDependencyError(
            "needs a C compiler", path="c", expected="cc", got="none", fix="install one"
        )

    for name in ("run_graph", "simulate_together"):
        monkeypatch.setattr(trials, name, missing)
    monkeypatch.setattr(slopes, "play", missing)
    with pytest.raises(MissingDependencyError, match="C compiler"):
        tune("ekf", NOISES[:1], [Recording("sim")], settings={"imu.rate": 50}, engine=engine, most=2)


def test_a_file_is_one_recording_whatever_its_seed(tmp_path):
    course(tmp_path, 1, seconds=4.0)
    course(tmp_path, 2, seconds=4.0)
    one, again = Recording(f"ese650:{tmp_path}:1"), Recording(f"ese650:{tmp_path}/.:1", seed=1)
    with pytest.raises(DeclarationError, match="recordings that differ"):
        tune("quaternion_ukf", [Fit("force_noise", 0.1, 10.0)], [one], [again], measure="error")


@pytest.mark.parametrize(
    ("graph", "name"), [("ekf", "settle"), ("kalman", "settle"), ("ekf", "lag"), ("marg", "settle")]
)
def test_a_setting_of_the_scoring_is_not_tuned(graph, name):
    """Errors get smaller by leaving more of them out, which makes no filter better."""
    with pytest.raises(DeclarationError, match="changes how a run is scored"):
        tune(graph, [Fit(name, 0.1, 2.0)], [Recording("sim")], measure="error", settings=PERFECT)


def test_a_parameter_without_effect_is_said(tmp_path):
    """A gate that refuses nothing, whatever it is; of the other the measure depends."""
    fits = [Fit("gate", 1e4, 1e8, 1e5), Fit("position_noise", 5e-3, 0.1)]
    found = tune("ekf", fits, [Recording("sim")], settings=PERFECT, most=12)
    assert found.without_effect == ("gate",)
    words = ["tune", "ekf", "--data", "sim", "--fit", "gate=1e4:1e8", "--most", "4"]
    words += [w for n, v in PERFECT.items() for w in ("--set", f"{n}={v}")]
    done = CliRunner(env={"COLUMNS": "300", "NO_COLOR": "1"}).invoke(app, words)
    assert "note: warning: gate has no effect on the likelihood" in done.stderr
    as_json = json.loads(CliRunner().invoke(app, [*words, "--json"]).stdout)
    assert as_json["without_effect"] == ["gate"]
    assert as_json["notes"][0].startswith("warning: gate has no effect")


def test_a_parameter_that_matters_on_one_recording_has_an_effect():
    flights = [Recording("sim", 0), Recording("sim", 1)]
    found = tune("ekf", [Fit("gyro_factor", 0.1, 10.0)], flights, settings=PERFECT, most=6)
    assert found.without_effect == ()
