"""`orientation_complementary`: gravity from acceleration less thrust; the thesis's figures 9 and 10."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, load_flight, simulate
from flowgraph.blocks.geometry.rotations import geodesic_angle, rotate, slerp
from flowgraph.blocks.orientation.complementary import blend, remove_thrust
from flowgraph.blocks.signals import Attitude, CoordinateAcceleration, Thrust
from flowgraph.graphs import orientation_complementary
from tests.graphs.estimation import THESIS, engines_agree, is_lowered_and_drawn


@cache
def flight(seed: int = 0, **settings: str) -> Flight:
    named = {name.replace("acceleration_", "acceleration.").replace("thrust_", "thrust."): v
             for name, v in settings.items()}  # fmt: skip
    sensors = {"sensors": "gyro,coordinate_acceleration,thrust"}
    return load_flight("sim:thesis", seed=seed, settings={**sensors, **named})


@cache
def score(seed: int, alpha: float, heading: str = "shortest_arc") -> dict[str, float]:
    case = orientation_complementary.case(flight(seed), alpha=alpha, heading=heading, settle=15.0)
    return case.score(simulate(case.graph, case.inputs, engine="xla"))


def test_it_runs_at_every_reading_of_gyroscope_and_accelerometer():
    case: Any = orientation_complementary.case(flight(duration="2", coordinate_acceleration_rate="73"))
    result = simulate(case.graph, case.inputs)
    both = {*case.inputs["gyro"].time, *case.inputs["coordinate_acceleration"].time}
    assert result["attitude"].time.tolist() == sorted(both)
    assert result["seen"].time.tolist() == case.inputs["coordinate_acceleration"].time.tolist()
    np.testing.assert_allclose(np.linalg.norm(result["attitude"].attitude, axis=-1), 1.0, atol=1e-12)


@pytest.mark.parametrize("heading", ["shortest_arc", "gyroscope"])
@pytest.mark.parametrize("rate", ["200", "73"])
def test_engines_agree(heading, rate):
    case = orientation_complementary.case(flight(duration="2", thrust_rate=rate), heading=heading)
    engines_agree(case.graph, case.inputs)


def test_it_is_lowered_and_drawn():
    case = orientation_complementary.case(flight(duration="2"))
    is_lowered_and_drawn(case, "gyroscope", "remove_thrust", "seen", "attitude")


@pytest.mark.parametrize("seed", range(3))
def test_after_15_s_the_error_is_at_most_a_fifth_of_that_of_the_gyroscope_alone(seed):
    """Figures 9 and 10 of the thesis."""
    filtered, alone = score(seed, 0.98), score(seed, 1.0)
    assert filtered["attitude_rmse_deg"] <= alone["attitude_rmse_deg"] / 5.0
    assert filtered["attitude_rmse_deg"] < 1.5


def test_with_the_heading_of_the_gyroscope_the_tilt_is_as_good():
    """Root mean squares of three flights: in one the gyroscope alone drifts little about the level."""
    rms = lambda rows: np.sqrt(np.mean([row["tilt_rmse_deg"] ** 2 for row in rows]))
    filtered = [score(seed, 0.98, "gyroscope") for seed in range(3)]
    assert rms(filtered) <= rms([score(seed, 1.0) for seed in range(3)]) / 5.0
    for seed, row in enumerate(filtered):
        assert row["tilt_rmse_deg"] == pytest.approx(score(seed, 0.98)["tilt_rmse_deg"], rel=0.02)


def test_without_noise_gravity_alone_shows_the_attitude():
    """To the precision of the numbers: the vehicle's attitude is the shortest arc to its thrust."""
    quiet = {"coordinate_acceleration_noise": "0", "thrust_noise": "0", "duration": "5"}
    case = orientation_complementary.case(flight(**quiet))
    seen = simulate(case.graph, case.inputs, engine="xla")["seen"]
    truth = flight(**quiet).truth
    assert truth is not None
    assert geodesic_angle(seen.attitude, truth["attitude"]).max() < 1e-6


def test_thrust_less_acceleration_is_the_reaction_of_gravity():
    q = np.array([0.9, 0.3, -0.2, np.sqrt(1.0 - 0.94)])
    body_z = rotate(q, np.array([0.0, 0.0, 1.0]), xp=np)
    in_world = 14.0 * body_z + np.array([0.0, 0.0, -9.81])
    back = q * np.array([1.0, -1.0, -1.0, -1.0])
    a = CoordinateAcceleration(acceleration=rotate(back, in_world, xp=np))
    found = remove_thrust.step(a, Thrust(thrust=np.array(14.0)), xp=np)
    np.testing.assert_allclose(rotate(q, found.force, xp=np), [0.0, 0.0, 9.81], atol=1e-12)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_blend_is_a_step_on_the_shortest_way(sign):
    a, b = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.6, 0.8, 0.0, 0.0])
    found = blend.step(Attitude(attitude=a), Attitude(attitude=sign * b), alpha=0.7, xp=np)
    np.testing.assert_allclose(found.attitude, slerp(a, b, 0.3), atol=1e-12)
    assert blend.step(Attitude(attitude=a), None, alpha=0.7, xp=np).attitude is a


def test_without_a_truth_it_starts_at_what_gravity_shows():
    bare = Flight("bare", flight(duration="2").streams)
    case = orientation_complementary.case(bare)
    assert case.score(simulate(case.graph, case.inputs, engine="xla")) == {}


def test_a_flight_without_thrust_is_refused():
    with pytest.raises(DataError, match="this flight lacks what orientation_complementary needs") as error:
        orientation_complementary.case(load_flight("sim:thesis"))
    assert str(error.value.got).startswith("imu, vicon")
    assert "sensors=gyro,coordinate_acceleration,thrust" in str(error.value.fix)


def test_a_body_that_is_held_is_refused():
    """Its thrust is not what carries it, so thrust less acceleration shows no vertical."""
    held = load_flight("sim:roundtrip", settings={"sensors": "gyro,coordinate_acceleration,thrust"})
    with pytest.raises(DataError, match=r"thrust is not all that carries this vehicle[\s\S]*complementary"):
        orientation_complementary.case(held)


@pytest.mark.slow
@pytest.mark.parametrize("heading", ["shortest_arc", "gyroscope"])
def test_its_covariance_is_as_large_as_its_errors(heading):
    """As in `complementary`; a gyroscope of means, for the thesis's rates jump."""
    half, whole = 0.5 * 0.1**0.5, THESIS
    assert 1.9 < mean_nees(heading) < 4.6
    twice = {"gyro_noise": 2.0 * whole, "acceleration_noise": 2.0 * whole, "thrust_noise": 4.0 * half}
    assert mean_nees(heading, **twice) < 1.9
    less = {"gyro_noise": 0.5 * whole, "acceleration_noise": 0.5 * whole, "thrust_noise": half}
    assert mean_nees(heading, **less) > 4.6


@cache
def mean_nees(heading: str, **noise: float) -> float:
    found = []
    for seed in range(5):
        on = load_flight(
            "sim:thesis", seed=seed,
            settings={"sensors": "gyro,coordinate_acceleration,thrust", "gyro.oversample": "10",
                      "duration": "10"},
        )  # fmt: skip
        case = orientation_complementary.case(on, heading=heading, covariance=True, settle=2.0, **noise)
        found.append(case.score(simulate(case.graph, case.inputs))["nees_mean"])
    return float(np.mean(found))


@pytest.mark.parametrize("heading", ["shortest_arc", "gyroscope"])
def test_engines_agree_on_the_covariance(heading):
    case = orientation_complementary.case(flight(duration="2"), heading=heading, covariance=True)
    engines_agree(case.graph, case.inputs)
    is_lowered_and_drawn(case, "attitude_spread")


def test_a_wrong_setting_is_refused():
    with pytest.raises(DeclarationError, match="'heading' has no such value"):
        orientation_complementary.case(flight(), heading="compass")
    with pytest.raises(DeclarationError, match=r"alpha is outside \(0, 1\]"):
        orientation_complementary.case(flight(), alpha=2.0)
