"""`ukf`: beside `ekf` on the same flights, consistent over many runs, in single precision, in all engines."""

from __future__ import annotations

import math
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, DeclarationError, Flight, LoweringError, load_flight, lower, simulate
from flowgraph import simulate_many as many
from flowgraph.blocks.geometry.rotations import from_rotation_vector, geodesic_angle, multiply
from flowgraph.blocks.metrics import chi_square_band, inside, state_nees
from flowgraph.blocks.models.unscented_pose import start_state
from flowgraph.blocks.signals import Gaussian
from flowgraph.graphs import ekf, ukf
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn, mean_nees, smooth, thesis

RUNS = 50


@cache
def a_case(seconds: float = 3.0, **settings: Any) -> Case:
    return ukf.case(thesis(1, seconds, vicon_phase=0.0123), **settings)


@pytest.mark.slow
@pytest.mark.parametrize("mean", ["markley", "kraft"])
def test_the_engines_agree(mean):
    pytest.importorskip("jax")
    case = a_case(1.5, mean=mean)
    result = engines_agree(case.graph, case.inputs)
    assert len(result["innovation"]) == 6


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(a_case(), "predict_unscented", "update_unscented", "named_pose")


FLIGHTS: dict[str, Any] = {
    "thesis": lambda seed: thesis(seed, 10.0),
    "figure": lambda seed: load_flight("sim", seed=seed, settings={"duration": "10"}),
    "smooth": smooth,
}


@pytest.mark.slow
@pytest.mark.parametrize("family", FLIGHTS)
def test_it_is_as_good_as_the_extended_filter(family):
    """Position and attitude within 2 %, the NEES within 5 %; over 50 smooth flights -0.2, 0.0 and 0.1 %."""
    total = {}
    for which in (ekf, ukf):
        scores = []
        for seed in (1, 2):
            flight = FLIGHTS[family](seed)
            case = which.case(flight)
            result = simulate(case.graph, case.inputs)
            assert flight.truth is not None
            nees = state_nees(result["belief"][200:], flight.truth).mean()
            score = case.score(result)
            assert score["position_3sigma"] > 0.97
            scores.append([score["position_rmse_m"], score["attitude_rmse_deg"], nees])
        total[which.name] = np.mean(scores, axis=0)
    assert (total["ukf"] < np.array([1.02, 1.02, 1.05]) * total["ekf"]).all(), total


@pytest.mark.slow
def test_single_precision_follows_double():
    """At alpha = 1, within 1 mm and 0.02 degrees over a flight of 10 s; alpha = 0.01 is refused there."""
    case = ukf.case(thesis(1, 10.0))
    double, single = (
        simulate(case.graph, case.inputs, engine="reference", dtype=dtype)["belief"]
        for dtype in ("float64", "float32")
    )
    assert (double.position != single.position).any()
    assert np.abs(double.position - single.position).max() < 1e-3
    assert geodesic_angle(double.attitude, single.attitude).max() < 0.02
    scale = np.sqrt(np.einsum("nii->ni", double.covariance))
    apart = np.abs(double.covariance - single.covariance) / (scale[:, :, None] * scale[:, None, :])
    assert apart.max() < 1e-3
    close = ukf.case(thesis(1, 10.0), alpha=0.01)
    refused = (
        r"predict_unscented: [\s\S]*alpha >= 0.1 in float32 or fixed point[\s\S]*central weight is -1e\+04"
    )
    for run in (
        lambda: lower(close.graph, dtype="float32"),
        lambda: lower(close.graph, dtype="fixed"),
        lambda: simulate(close.graph, close.inputs, engine="reference", dtype="float32"),
    ):
        with pytest.raises(LoweringError, match=refused):
            run()


def test_the_spread_of_the_points_changes_little():
    found = [case.score(simulate(case.graph, case.inputs)) for case in (a_case(), a_case(alpha=0.001))]
    assert abs(found[0]["position_rmse_m"] - found[1]["position_rmse_m"]) < 5e-3


# Consistency


def start(seed: int) -> dict[str, Gaussian]:
    """A start whose error is drawn from its spread."""
    truth = smooth(seed).truth
    assert truth is not None
    error = np.random.default_rng(seed).normal(size=9) * np.repeat([0.5, 0.5, 0.1], 3)
    q = multiply(truth["attitude"][0], from_rotation_vector(-error[6:], xp=np), xp=np)
    return {
        "belief": start_state(
            truth["position"][0] + error[:3],
            q,
            velocity=truth["velocity"][0] + error[3:6],
            position_deviation=0.5,
            velocity_deviation=0.5,
            attitude_deviation=0.1,
        )
    }


@cache
def consistent_ticks(base: int, factor: float) -> float:
    """The fraction of ticks at which the mean NEES of 50 runs lies in its band, with R times `factor`."""
    noise = 0.1 * factor**0.5
    case = ukf.case(smooth(base), position_noise=noise, attitude_noise=noise)
    seeds = range(base, base + RUNS)
    batch = many(case.graph, lambda seed: dict(smooth(seed).streams), seeds, init=start, keep=["belief"])
    found = mean_nees(batch["belief"], [smooth(seed) for seed in seeds])
    return inside(found, chi_square_band(9, runs=RUNS))


@pytest.mark.slow
def test_the_nees_of_50_runs_lies_in_its_band():
    pytest.importorskip("jax")
    assert consistent_ticks(0, 1.0) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2.0, 0.5])
def test_the_same_test_fails_with_a_wrong_noise(factor):
    pytest.importorskip("jax")
    assert consistent_ticks(0, factor) < 0.8


# Bad input


def test_a_flight_without_motion_capture_or_without_an_imu_is_refused():
    whole = thesis(1, 3.0)
    for kept in ("imu", "vicon"):
        with pytest.raises(DataError, match=rf"lacks what ukf needs[\s\S]*imu, vicon[\s\S]*got: +{kept}"):
            ukf.case(Flight(whole.name, {kept: whole.streams[kept]}, whole.truth, whole.info))


def test_settings_out_of_range_are_refused():
    with pytest.raises(DeclarationError, match=r"ukf\.alpha: setting 'alpha' is out of range"):
        ukf.case(thesis(1, 3.0), alpha=0.0)
    with pytest.raises(DeclarationError, match="kappa takes all the spread away"):
        ukf.case(thesis(1, 3.0), kappa=-15.0)
    with pytest.raises(DeclarationError, match=r"SigmaPoints: [\s\S]*finite beta"):
        ukf.case(thesis(1, 3.0), beta=math.inf)
