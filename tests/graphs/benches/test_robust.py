"""Experiments on outliers, a noise that is told wrong, and biases: short ones, and what they refuse."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError, load_flight
from flowgraph.graphs.benches.biases import biases
from flowgraph.graphs.benches.fault_kinds import faulty, outliers
from flowgraph.graphs.benches.robust import robust


def test_an_influence_function_bears_outliers_and_a_noise_is_learned():
    rows = robust(filters="kalman", flights=1, duration=6.0, noise_duration=8.0).rows
    off = {(r["robust"], r["outliers"]): r["position_rmse_m"] for r in rows if r["part"] == "outliers"}
    assert off["none", 0.1] > 10.0 * off["none", 0.0]
    for method in ("huber", "student_t"):
        assert off[method, 0.1] < 2.0 * off["none", 0.0]
    told = {(r["told"], r["adaptive"]): r for r in rows if r["part"] == "noise"}
    assert told[0.2, 0]["nees_mean"] > 3.0 * told[0.2, 20]["nees_mean"]
    assert told[5.0, 0]["position_rmse_m"] > 1.2 * told[5.0, 20]["position_rmse_m"]


def test_a_share_of_the_poses_is_off_to_any_side_and_all_else_is_as_before():
    flight = load_flight("sim", settings={"duration": "60"})
    off = faulty(flight, ["vicon"], outliers, 1.0, 0.1, 3)
    before, after = flight.streams["vicon"], off.streams["vicon"]
    far = np.linalg.norm(after["position"] - before["position"], axis=1)
    moved = far > 0.0
    assert 0.03 < np.mean(moved) < 0.2
    assert not moved[(before.time - before.time[0]) < 0.9e9].any()
    np.testing.assert_allclose(far[moved], 3.0)
    cosine = np.abs(np.sum(after["attitude"] * before["attitude"], axis=1))
    np.testing.assert_allclose(2.0 * np.arccos(np.minimum(cosine[moved], 1.0)), 0.5, atol=1e-6)
    assert (after["attitude"][~moved] == before["attitude"][~moved]).all()
    assert off.streams["imu"] is flight.streams["imu"]


@pytest.mark.parametrize("wrong", [{"flights": 0}, {"share": 0.0}, {"share": 1.0}])
def test_an_experiment_without_a_flight_or_a_share_is_refused(wrong):
    with pytest.raises(DeclarationError, match="a flight, and a share"):
        robust(**wrong)


def test_only_kalman_filters_of_sim_are_flown():
    with pytest.raises(UnknownNameError, match="tracker"):
        robust(filters="kalman,tracker")


@pytest.mark.slow
def test_biases_are_found_where_they_are_sought():
    rows = biases(flights=2, duration=6.0, particles=100, engine="python").rows
    found = {(r["filter"], r["biases"]): r for r in rows}
    for name in ("outdoor_eskf", "rbpf_outdoor"):
        without, with_them = found[name, "false"], found[name, "left out"]
        assert without["bias_deviations"] is None
        assert with_them["gyro_bias_rmse_rps"] < 0.5 * without["gyro_bias_rmse_rps"]


def test_biases_of_no_flight_are_refused():
    with pytest.raises(DeclarationError, match="needs a flight"):
        biases(flights=0)
