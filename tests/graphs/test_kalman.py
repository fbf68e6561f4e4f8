"""`kalman`: filterpy's numbers, the same in every engine, and the bound that no other filter beats."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, Series, arrays, periodic, simulate
from flowgraph.blocks.kalman.filters import predict_linear
from flowgraph.blocks.kalman.smoothing import rauch_tung_striebel
from flowgraph.blocks.metrics import chi_square_band, error_summary, nis_summary, state_error
from flowgraph.blocks.models.point import point_model, start_point
from flowgraph.blocks.scoring.point import readings
from flowgraph.blocks.signals import PointReading
from flowgraph.graphs import kalman
from flowgraph.study import Study, read_table, run_study
from tests.graphs.estimation import THESIS, engines_agree, is_lowered_and_drawn, thesis


@cache
def a_case(seconds: float = 3.0, **settings: Any) -> Case:
    return kalman.case(thesis(1, seconds), **settings)


@pytest.mark.parametrize("driven", [True, False])
def test_it_is_the_filter_and_smoother_of_filterpy(driven):
    """filterpy's smoother knows no control, so there is one to compare with where the control is zero."""
    peers = pytest.importorskip("filterpy.kalman")
    flight = thesis(1, 3.0, imu_oversample=1.0)  # readings of an instant: the mean of two drives a step
    case = kalman.case(flight)
    reading, model = readings(flight), point_model(THESIS)
    control = reading["acceleration"] * float(driven)
    values = PointReading(acceleration=control, position=reading["position"])
    result = simulate(case.graph, {"reading": arrays(reading.time, values, not_finite="keep")})

    start = start_point(flight.streams["vicon"]["position"][0])
    peer = peers.KalmanFilter(dim_x=6, dim_z=3, dim_u=3)
    peer.x, peer.P, peer.H, peer.R = start.mean, start.covariance, np.eye(3, 6), np.eye(3) * 0.01
    dt = np.r_[0.0, np.diff(reading.time) * 1e-9]
    held = 0.5 * (control + np.r_[np.zeros((1, 3)), control[:-1]])
    means: list[Any] = []
    covariances: list[Any] = []
    Fs: list[Any] = []
    Qs: list[Any] = []
    for k in range(len(reading)):
        peer.F, peer.B, peer.Q = model.discrete(dt[k], np, float)
        peer.predict(held[k])
        if np.isfinite(reading["position"][k]).all():
            peer.update(reading["position"][k])
        for rows, value in ((means, peer.x), (covariances, peer.P), (Fs, peer.F), (Qs, peer.Q)):
            rows.append(value)
    np.testing.assert_allclose(result["posterior"]["mean"], means, atol=1e-10)
    np.testing.assert_allclose(result["posterior"]["covariance"], covariances, atol=1e-10)

    smooth = rauch_tung_striebel(result["prior"], result["posterior"], model)
    mean, P, *_ = peer.rts_smoother(np.stack(means), np.stack(covariances), Fs=Fs, Qs=Qs)
    if not driven:
        np.testing.assert_allclose(smooth["mean"], mean, atol=1e-10)
    np.testing.assert_allclose(smooth["covariance"], P, atol=1e-10)


def test_the_engines_agree():
    pytest.importorskip("jax")
    case = a_case()
    result = engines_agree(case.graph, case.inputs)
    assert len(result["innovation"]) == 13  # 4 Hz over 3 s, of 601 records
    assert len(result["belief"]) == 601


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(a_case(), "predict_linear", "update_linear", "point_belief")


def test_it_follows_the_flights_and_knows_how_well():
    scores, nis = [], []
    for seed in range(6):
        case = kalman.case(thesis(seed, 20.0))
        result = simulate(case.graph, case.inputs)
        scores.append(case.score(result))
        nis.append(nis_summary(result["innovation"])["nis_mean"])
    place = [s["position_rmse_m"] for s in scores]
    assert 0.08 < np.mean(place) < 0.1  # its own covariance says 0.090 m
    assert all(s["velocity_rmse_mps"] < 0.12 for s in scores)
    low, high = chi_square_band(3 * 81, runs=6)
    assert low < 3 * 81 * np.mean(nis) < high


def test_the_smoother_is_better_than_the_filter():
    flight, case = thesis(1, 20.0), a_case(20.0)
    result = simulate(case.graph, case.inputs)
    smooth = rauch_tung_striebel(result["prior"], result["posterior"], point_model(THESIS))
    assert flight.truth is not None
    filtered, smoothed = (
        error_summary(state_error(s.time, flight.truth, s["mean"][:, :3], s["mean"][:, 3:])[200:, :3])["rmse"]
        for s in (result["posterior"], smooth)
    )
    assert smoothed < 0.75 * filtered


def test_a_coordinate_that_was_not_measured_is_left_out():
    case, reading = a_case(), readings(thesis(1, 3.0))
    flat = reading["position"].copy()
    flat[:, 2] = np.nan
    values = PointReading(acceleration=reading["acceleration"], position=flat)
    result = simulate(case.graph, {"reading": arrays(reading.time, values, not_finite="keep")})
    whole = simulate(case.graph, case.inputs)
    for axis in (0, 1):  # the axes do not depend on each other here
        np.testing.assert_allclose(
            result["belief"].position[:, axis], whole["belief"].position[:, axis], atol=1e-12
        )
    height = result["belief"].covariance[:, 2, 2]
    assert np.all(np.diff(height) > 0.0)
    assert set(result["innovation"].parts) == {2.0}


def test_an_outlier_is_gated():
    reading = readings(thesis(1, 3.0))
    position = reading["position"].copy()
    wrong = np.flatnonzero(np.isfinite(position[:, 0]))[6]
    position[wrong] += 5.0
    values = PointReading(acceleration=reading["acceleration"], position=position)
    inputs = {"reading": arrays(reading.time, values, not_finite="keep")}
    gated, open_ = a_case(gate=16.3), a_case()
    result = simulate(gated.graph, inputs)
    assert result["innovation"].accepted.tolist() == [k != 6 for k in range(13)]
    assert gated.score(result)["position_max_m"] < 0.5
    assert open_.score(simulate(open_.graph, inputs))["position_max_m"] > 0.5


def test_positions_between_the_controls_are_refused():
    between = thesis(1, 3.0, vicon_phase=0.0012)
    with pytest.raises(DataError, match=r"positions do not come with the controls[\s\S]*use async_kalman"):
        kalman.case(between)


def test_a_flight_without_a_truth_is_refused():
    flight = thesis(1, 3.0)
    blind = type(flight)(flight.name, flight.streams, None, flight.info)
    with pytest.raises(DataError, match=r"acceleration in the world is not known[\s\S]*no truth"):
        kalman.case(blind)


def test_it_can_be_built_by_hand():
    built = kalman.build(
        reading=periodic("10ms"), start=start_point(np.zeros(3)), noise=0.1, position_noise=0.1
    )
    time = np.arange(100) * 10_000_000
    zeros = np.zeros((100, 3))
    result = simulate(built, {"reading": Series(time, PointReading(acceleration=zeros, position=zeros))})
    assert np.abs(result["belief"].position).max() == 0.0
    assert predict_linear.name == "predict_linear"


@pytest.mark.slow
def test_no_filter_beats_the_bound(tmp_path):
    """Over 10 flights of the thesis, told the exact attitude it is better than each filter that is not."""
    pytest.importorskip("pyarrow")
    study = Study(
        graphs=["kalman", "async_kalman", "ekf", "ins_eskf", "augmented_complementary", "rbpf_indoor"],
        data=["sim:thesis"],
        seeds=10,
        parameters={"duration": 20.0, "rbpf_indoor": {"particles": 300}},
        engine="c",
        chunk=10,
    )
    outcome = run_study(study, tmp_path)
    assert (outcome.done, len(outcome.failed)) == (60, 0)
    rows = sorted(read_table(tmp_path), key=lambda row: row["seed"])
    for what in ("position_rmse_m", "velocity_rmse_mps"):
        found = {name: np.array([r[what] for r in rows if r["graph"] == name]) for name in study.graphs}
        bound = found["kalman"]
        assert bound.shape == (10,)
        for name, errors in found.items():
            assert np.mean(errors**2) >= np.mean(bound**2) * (1.0 - 1e-9), (name, what)
            # on one flight luck counts too, but not much of it
            assert (errors >= 0.9 * bound).all(), (name, what)
