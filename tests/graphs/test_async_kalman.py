"""`async_kalman`: consistent over many runs, the same in every engine, each measurement in its own time."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Case,
    DataError,
    Flight,
    Series,
    aperiodic,
    periodic,
    simulate,
    simulate_many,
)
from flowgraph.blocks.metrics import chi_square_band, inside
from flowgraph.blocks.models.point import point_model, start_point
from flowgraph.blocks.scoring.point import positions
from flowgraph.blocks.scoring.streams import told_acceleration
from flowgraph.blocks.signals import Gaussian, Position, Velocity, WorldAcceleration
from flowgraph.graphs import async_kalman, kalman
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn, mean_nees, thesis

RUNS = 50
BASES = [0, *(pytest.param(base, marks=pytest.mark.slow) for base in (100, 200))]
"""The first seed of three sets of runs."""


def flight(seed: int) -> Flight:
    """IMU at 100 Hz, motion capture at 4 Hz between its readings."""
    return thesis(seed, imu_rate=100.0, vicon_phase=0.0123)


def a_case(**settings: Any) -> Case:
    return async_kalman.case(flight(1), **settings)


def start(seed: int) -> dict[str, Gaussian]:
    """A start whose error is drawn from its spread."""
    truth = flight(seed).truth
    assert truth is not None
    error = np.random.default_rng(seed).normal(size=6) * 0.5
    place, speed = truth["position"][0] + error[:3], truth["velocity"][0] + error[3:]
    return {"belief": start_point(place, speed, position_deviation=0.5, velocity_deviation=0.5)}


def inputs(seed: int) -> dict[str, Series]:
    return {
        "acceleration": told_acceleration(flight(seed)),
        "position": positions(flight(seed).streams["vicon"]),
    }


@cache
def consistent_ticks(base: int, factor: float) -> float:
    """The fraction of ticks at which the mean NEES of 50 runs lies in its band, with R times `factor`."""
    case = async_kalman.case(flight(base), position_noise=0.1 * factor**0.5)
    seeds = range(base, base + RUNS)
    batch = simulate_many(case.graph, inputs, seeds, init=start, keep=["belief"])
    found = mean_nees(batch["belief"], [flight(seed) for seed in seeds])
    assert len(found) == 1041
    return inside(found, chi_square_band(6, runs=RUNS))


def is_consistent(base: int, factor: float = 1.0) -> bool:
    return consistent_ticks(base, factor) >= 0.9


@pytest.mark.parametrize("base", BASES)
def test_the_nees_of_50_runs_lies_in_its_band(base):
    pytest.importorskip("jax")
    assert is_consistent(base)


@pytest.mark.parametrize("factor", [2.0, 0.5])
@pytest.mark.parametrize("base", BASES)
def test_the_same_test_fails_with_a_wrong_noise(base, factor):
    pytest.importorskip("jax")
    assert not is_consistent(base, factor)


def test_the_engines_agree():
    pytest.importorskip("jax")
    case = a_case()
    result = engines_agree(case.graph, case.inputs)
    assert len(result["position_innovation"]) == 40
    assert len(result["belief"]) == 1039  # it starts at the first position, 12.3 ms after the first reading


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(a_case(), "predict_linear", "update_linear", "point_belief")


def test_it_follows_the_flights():
    for seed in range(3):
        case = async_kalman.case(flight(seed))
        score = case.score(simulate(case.graph, case.inputs))
        assert score["position_rmse_m"] < 0.12
        assert score["velocity_rmse_mps"] < 0.15


def test_with_measurements_at_times_of_the_controls_it_is_the_synchronous_filter():
    together = thesis(1, 3.0)
    a, b = kalman.case(together), async_kalman.case(together)
    one, other = simulate(a.graph, a.inputs), simulate(b.graph, b.inputs)
    np.testing.assert_allclose(other["posterior"]["mean"], one["posterior"]["mean"], atol=1e-12)
    np.testing.assert_allclose(other["posterior"]["covariance"], one["posterior"]["covariance"], atol=1e-12)


MS = 1_000_000


def by_hand(**streams: Series) -> Any:
    built = async_kalman.build(
        acceleration=periodic("10ms"),
        position=aperiodic(),
        velocity=aperiodic() if "velocity" in streams else None,
        start=start_point(np.zeros(3), [1.0, 0.0, 0.0]),
        noise=0.1,
        position_noise=0.05,
        velocity_noise=0.2,
    )
    return simulate(built, streams)


def pushes(n: int = 11, size: float = 2.0) -> Series:
    push = np.tile([size, 0.0, 0.0], (n, 1))
    return Series(np.arange(n) * 10 * MS, WorldAcceleration(acceleration=push))


def at(ms: int, value: Any) -> Series:
    return Series(np.array([ms * MS]), value)


def test_a_measurement_corrects_the_prediction_of_its_own_time():
    """Not x_(t-1), as the thesis prints: 4 ms after the last control there are 4 ms of prediction first."""
    z = np.array([[0.1, 0.0, 0.0]])
    result = by_hand(acceleration=pushes(), position=at(44, Position(position=z)))
    tick = int(np.flatnonzero(result["prior"].time == 44 * MS)[0])
    F, G, Q = point_model(0.1).discrete(0.004, np, float)
    before = result["posterior"]["mean"][tick - 1], result["posterior"]["covariance"][tick - 1]
    mean, P = F @ before[0] + G @ [2.0, 0.0, 0.0], F @ before[1] @ F.T + Q  # the last control, again
    np.testing.assert_allclose(result["prior"]["mean"][tick], mean, atol=1e-14)
    H = np.eye(3, 6)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(3) * 0.05**2)
    np.testing.assert_allclose(result["posterior"]["mean"][tick], mean + K @ (z[0] - mean[:3]), atol=1e-12)
    np.testing.assert_allclose(result["posterior"]["covariance"][tick], (np.eye(6) - K @ H) @ P, atol=1e-12)


def test_each_measurement_corrects_the_part_that_it_sees():
    fast, there = np.array([[2.0, 0.0, 0.0]]), np.array([[0.3, 0.0, 0.0]])
    streams = {
        "acceleration": pushes(),
        "position": at(44, Position(position=there)),
        "velocity": at(44, Velocity(velocity=fast)),
    }
    both = by_hand(**streams)
    assert len(both["position_innovation"]) == len(both["velocity_innovation"]) == 1
    tick = int(np.flatnonzero(both["prior"].time == 44 * MS)[0])
    mean, P = both["prior"]["mean"][tick], both["prior"]["covariance"][tick]
    R = np.diag([0.05**2] * 3 + [0.2**2] * 3)
    K = P @ np.linalg.inv(P + R)  # one after the other is as good as both at once
    expected = mean + K @ (np.r_[there[0], fast[0]] - mean)
    np.testing.assert_allclose(both["posterior"]["mean"][tick], expected, atol=1e-12)
    np.testing.assert_allclose(both["posterior"]["covariance"][tick], (np.eye(6) - K) @ P, atol=1e-12)


def test_a_flight_without_motion_capture_is_refused():
    whole = flight(1)
    part = Flight(whole.name, {"imu": whole.streams["imu"]}, whole.truth, whole.info)
    with pytest.raises(DataError, match=r"lacks what async_kalman needs[\s\S]*imu, vicon"):
        async_kalman.case(part)


@pytest.mark.parametrize("graph", [kalman, async_kalman])
def test_a_run_can_be_smoothed_by_a_setting(graph):
    """Both use what came later, so they are better than the filter; the whole run more than a lag: means of
    four flights."""
    errors = []
    for seed in range(1, 5):
        case = graph.case(thesis(seed), smooth="rts", lag=1.0)
        score = case.score(simulate(case.graph, case.inputs))
        errors.append([score[f"{front}position_rmse_m"] for front in ("smoothed_", "lagged_", "")])
    whole, lagged, plain = np.mean(errors, axis=0)
    assert whole < lagged < 0.95 * plain
