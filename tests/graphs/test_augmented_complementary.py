"""`augmented_complementary`: pose and velocity from an IMU, corrected by a motion capture when it comes."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, load_flight, simulate
from flowgraph.blocks.metrics.errors import pose_errors
from flowgraph.blocks.orientation.complementary import correct_by_pose
from flowgraph.blocks.signals import Pose, PoseEstimate
from flowgraph.graphs import augmented_complementary
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn

QUIET = {name: "0" for name in ("gyro.noise", "accelerometer.noise", "vicon.noise", "vicon.attitude_noise")}


@cache
def flight(seed: int = 0, **settings: str) -> Flight:
    named = {name.replace("vicon_", "vicon."): value for name, value in settings.items()}
    return load_flight("sim:thesis", seed=seed, settings=named)


def played(on: Flight, **settings: Any) -> dict[str, float]:
    case = augmented_complementary.case(on, **settings)
    return case.score(simulate(case.graph, case.inputs, engine="xla"))


def test_it_runs_at_every_reading():
    case: Any = augmented_complementary.case(flight(duration="3", vicon_rate="7", vicon_phase="0.003"))
    pose = simulate(case.graph, case.inputs)["pose"]
    assert pose.time.tolist() == sorted({*case.inputs["imu"].time, *case.inputs["vicon"].time})
    np.testing.assert_allclose(np.linalg.norm(pose.attitude, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize("settings", [{}, {"vicon_rate": "7", "vicon_phase": "0.003"}], ids=["tied", "apart"])
def test_engines_agree(settings):
    case = augmented_complementary.case(flight(duration="3", **settings))
    engines_agree(case.graph, case.inputs)


def test_it_is_lowered_and_drawn():
    case = augmented_complementary.case(flight(duration="2"))
    is_lowered_and_drawn(case, "dead_reckon", "correct_by_pose", "now")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_it_is_about_as_good_at_all_times_as_a_measured_pose_at_its_own(seed):
    found = played(flight(seed))
    vicon, truth = flight(seed).streams["vicon"], flight(seed).truth
    assert truth is not None
    measured = pose_errors(vicon, truth)
    assert found["position_rmse_m"] < 1.3 * measured["position_rmse_m"]
    assert found["attitude_rmse_deg"] < 0.5 * measured["attitude_rmse_deg"]
    alone = played(flight(seed), alpha=1.0, velocity_alpha=1.0, attitude_alpha=1.0)
    assert found["position_rmse_m"] < 0.1 * alone["position_rmse_m"]


def test_the_acceleration_is_turned_to_the_world():
    """The thesis leaves that out; with it a perfect IMU alone follows the way."""
    quiet = load_flight("sim:thesis", settings={**QUIET, "duration": "4", "imu.rate": "1000"})
    alone = played(quiet, alpha=1.0, velocity_alpha=1.0, attitude_alpha=1.0)
    assert alone["position_rmse_m"] < 0.1
    assert alone["attitude_rmse_deg"] < 0.5


@pytest.mark.parametrize("velocity_alpha", [0.3, 0.6, 0.9])
def test_a_perfect_pose_does_not_disturb_a_perfect_velocity(velocity_alpha):
    """Also while the body accelerates: a mean over an interval is compared with one."""
    state: Any = correct_by_pose.initial([None, None], {})
    shares = {"alpha": 0.4, "velocity_alpha": velocity_alpha, "attitude_alpha": 0.5, "xp": np}
    for k in range(5):
        t = 0.25 * k
        place, speed = np.full(3, 4.0 * t**2), np.full(3, 8.0 * t)
        prior = PoseEstimate(position=place, velocity=speed, attitude=np.array([1.0, 0.0, 0.0, 0.0]))
        measured = Pose(position=prior.position, attitude=prior.attitude)
        state, found = correct_by_pose.step(state, prior, measured, dt=0.25 if k else 0.0, **shares)
        np.testing.assert_allclose(found.velocity, prior.velocity, atol=1e-12)
        np.testing.assert_allclose(found.position, prior.position, atol=1e-12)


def test_the_first_pose_says_nothing_of_the_velocity():
    state: Any = correct_by_pose.initial([None, None], {})
    prior = PoseEstimate(position=np.zeros(3), velocity=np.ones(3), attitude=np.array([1.0, 0.0, 0.0, 0.0]))
    pose = Pose(position=np.full(3, 5.0), attitude=prior.attitude)
    shares = {"alpha": 0.4, "velocity_alpha": 0.6, "attitude_alpha": 0.5}
    _, found = correct_by_pose.step(state, prior, pose, dt=0.0, xp=np, **shares)
    np.testing.assert_array_equal(found.velocity, np.ones(3))
    np.testing.assert_allclose(found.position, 3.0)


@pytest.mark.slow
def test_its_covariance_is_as_large_as_its_errors():
    """The NEES of 5 runs, nine numbers, on average over the ticks after 2 s: within a fifth of 9."""
    assert 7.2 < mean_nees() < 10.8
    assert mean_nees(position_noise=0.14, attitude_noise=0.14) < 7.2
    assert mean_nees(position_noise=0.07, attitude_noise=0.07) > 10.8


@cache
def mean_nees(**noise: float) -> float:
    on = [flight(seed, duration="10", **{"imu.oversample": "10"}) for seed in range(5)]
    return float(np.mean([played(f, covariance=True, settle=2.0, **noise)["nees_mean"] for f in on]))


@pytest.mark.parametrize("settings", [{}, {"vicon_rate": "7", "vicon_phase": "0.003"}], ids=["tied", "apart"])
def test_engines_agree_on_the_covariance(settings):
    case = augmented_complementary.case(flight(duration="3", **settings), covariance=True)
    result = engines_agree(case.graph, case.inputs)
    np.testing.assert_array_equal(result["belief"].position, result["pose"].position)
    is_lowered_and_drawn(case, "pose_spread")


def test_it_runs_without_a_truth():
    case = augmented_complementary.case(Flight("bare", flight(duration="2").streams))
    assert case.score(simulate(case.graph, case.inputs)) == {}


def test_a_flight_without_a_motion_capture_is_refused():
    bare = Flight("bare", {"imu": flight(duration="2").streams["imu"]})
    with pytest.raises(DataError, match="this flight lacks what augmented_complementary needs") as error:
        augmented_complementary.case(bare)
    assert error.value.got == "imu"


@pytest.mark.parametrize("name", ["alpha", "velocity_alpha", "attitude_alpha"])
def test_a_share_outside_its_range_is_refused(name):
    with pytest.raises(DeclarationError, match=r"alpha is outside \(0, 1\]"):
        augmented_complementary.case(flight(duration="2"), **{name: 0.0})
