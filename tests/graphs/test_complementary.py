"""`complementary`: low and high pass on rotations, good on the round trip, and why it fails in flight."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Case,
    DataError,
    DeclarationError,
    Flight,
    Scalar,
    Series,
    Stream,
    graph,
    high_pass,
    load_flight,
    low_pass,
    periodic,
    simulate,
)
from flowgraph.blocks.geometry.rotations import geodesic_angle, rotate
from flowgraph.blocks.signals import Attitude, Gyro, SpecificForce
from flowgraph.graphs import complementary
from tests.graphs.estimation import THESIS, engines_agree, is_lowered_and_drawn

UNIT = {"gyro.noise": "0.02236", "gyro.bias": "0", "accelerometer.noise": "0.02236"}
"""The thesis's: a variance of 0.1 per sample at 200 Hz, and no bias."""

LEVEL = Attitude(attitude=np.array([1.0, 0.0, 0.0, 0.0]))


@cache
def flight(spec: str = "sim:roundtrip", seed: int = 0, **settings: str) -> Flight:
    named = {name.replace("_", "."): value for name, value in settings.items()}
    return load_flight(spec, seed=seed, settings={"sensors": "gyro,accelerometer", **UNIT, **named})


@cache
def score(seed: int, alpha: float) -> dict[str, float]:
    case = complementary.case(flight(seed=seed), alpha=alpha, settle=15.0)
    return case.score(simulate(case.graph, case.inputs, engine="xla"))


def test_it_runs_at_the_readings_of_the_gyroscope():
    case: Any = complementary.case(flight(duration="2"))
    result = simulate(case.graph, case.inputs)
    for name in ("attitude", "gyroscope", "accelerometer"):
        np.testing.assert_array_equal(result[name].time, case.inputs["gyro"].time)
        np.testing.assert_allclose(np.linalg.norm(result[name].attitude, axis=-1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(result["rejected"].time, case.inputs["accelerometer"].time)


@pytest.mark.parametrize("alpha", [0.98, 1.0])
@pytest.mark.parametrize("rate", ["200", "73"])
def test_engines_agree(alpha, rate):
    case = complementary.case(flight(duration="2", accelerometer_rate=rate), alpha=alpha)
    engines_agree(case.graph, case.inputs)


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(
        complementary.case(flight(duration="2")), "gyroscope", "carried", "low_pass", "high_pass", "attitude"
    )


@pytest.mark.parametrize("seed", range(3))
def test_on_the_round_trip_it_takes_the_drift_out_of_the_tilt(seed):
    """Gravity shows no heading: that drifts with the gyroscope."""
    filtered, alone = score(seed, 0.98), score(seed, 1.0)
    assert filtered["tilt_rmse_deg"] <= alone["tilt_rmse_deg"] / 5.0
    assert filtered["tilt_rmse_deg"] < 1.0
    assert filtered["heading_rmse_deg"] == pytest.approx(alone["heading_rmse_deg"], rel=0.2)


def test_on_one_axis_it_is_the_high_pass_of_one_sensor_and_the_low_pass_of_the_other():
    alpha, time = 0.98, np.arange(1000) * 5_000_000
    angle = 0.8 * np.sin(2.0 * time * 1e-9)
    rate = 1.6 * np.cos(2.0 * time * 1e-9) + 0.05  # a bias, so that the gyroscope drifts
    turned = np.r_[0.0, np.cumsum(0.5 * (rate[1:] + rate[:-1]) * 0.005)]

    fast = simulate(_passed(high_pass, alpha), {"x": (time, turned)})["output"]["value"]
    slow = simulate(_passed(low_pass, 1.0 - alpha), {"x": (time, angle)})["output"]["value"]

    x_axis = np.array([[1.0, 0.0, 0.0]])
    up = np.stack([0.0 * angle, np.sin(angle), np.cos(angle)], axis=-1) * 9.81
    inputs = {
        "gyro": Series(time, Gyro(rate=rate[:, None] * x_axis)),
        "accelerometer": Series(time, SpecificForce(force=up)),
    }
    clocks: Any = {name: periodic("5ms") for name in inputs}
    q = simulate(complementary.build(**clocks, start=LEVEL, alpha=alpha), inputs)["attitude"].attitude
    np.testing.assert_allclose(2.0 * np.arctan2(q[:, 1], q[:, 0]), fast + slow, atol=1e-4)
    assert np.abs(fast + slow - angle).max() < 0.1 * np.abs(turned - angle).max()


def _passed(operation: Any, alpha: float) -> Any:
    @graph
    def passed(x: Stream[Scalar]):
        return operation(x, alpha=alpha, init=0.0)

    return passed.build(x=periodic("5ms"))


def test_on_a_flying_quadrotor_it_fails_even_with_perfect_sensors():
    """The specific force is the thrust, always along body z: the accelerometer says that it is level."""
    perfect = {"gyro_noise": "0", "accelerometer_noise": "0", "duration": "10"}
    flying = flight("sim:thesis", **perfect)
    assert np.abs(flying.streams["accelerometer"]["force"][:, :2]).max() < 1e-9
    case = complementary.case(flying)
    result = simulate(case.graph, case.inputs, engine="xla")
    assert flying.truth is not None
    by_gyro = geodesic_angle(result["gyroscope"].attitude, flying.truth["attitude"])
    assert case.score(result)["tilt_rmse_deg"] > 15.0
    assert np.sqrt(np.mean(by_gyro**2)) < 3.0


def test_the_ratio_of_the_thesis_is_met_in_the_tilt_and_not_in_the_whole_attitude():
    """What remains is the heading, which gravity does not show: it bounds how far the whole can come down."""
    filtered, alone = ([score(seed, alpha) for seed in range(3)] for alpha in (0.98, 1.0))
    rms = lambda rows: np.sqrt(np.mean([row["attitude_rmse_deg"] ** 2 for row in rows]))
    assert rms(filtered) > rms(alone) / 5.0  # 4.5 and 10.3 degrees; how the drifts fall differs by flight
    for row in filtered:
        rest = np.hypot(row["tilt_rmse_deg"], row["heading_rmse_deg"])
        assert row["attitude_rmse_deg"] == pytest.approx(rest, rel=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("alpha", [0.98, 0.9])
def test_its_covariance_is_as_large_as_its_errors(alpha):
    """The mean NEES of 5 runs after 2 s, 3 in a consistent filter; a run holds one drift of the heading, so
    five scatter by two thirds. Noise of twice or half the size is told from it."""
    assert 1.9 < mean_nees(alpha) < 4.6
    assert mean_nees(alpha, accelerometer_noise=2.0 * THESIS, gyro_noise=2.0 * THESIS) < 1.9
    assert mean_nees(alpha, accelerometer_noise=0.5 * THESIS, gyro_noise=0.5 * THESIS) > 4.6


@cache
def mean_nees(alpha: float, **noise: float) -> float:
    found = []
    for seed in range(5):
        trip = flight(seed=seed, duration="8")
        case = complementary.case(trip, alpha=alpha, covariance=True, settle=2.0, **noise)
        found.append(case.score(simulate(case.graph, case.inputs))["nees_mean"])
    return float(np.mean(found))


def test_asking_for_the_covariance_does_not_change_the_estimate():
    plain, asked = (complementary.case(flight(duration="2"), covariance=c) for c in (False, True))
    a, b = (simulate(case.graph, case.inputs) for case in (plain, asked))
    np.testing.assert_array_equal(a["attitude"].attitude, b["attitude"].attitude)
    np.testing.assert_array_equal(a["attitude"].attitude, b["belief"].attitude)
    assert "belief" not in a.series


@pytest.mark.parametrize("rate", ["200", "73"])
def test_engines_agree_on_the_covariance(rate):
    case = complementary.case(flight(duration="2", accelerometer_rate=rate), covariance=True)
    engines_agree(case.graph, case.inputs)
    is_lowered_and_drawn(case, "attitude_spread")


def test_a_covariance_needs_a_noise():
    bare = Flight("bare", flight(duration="2").streams)
    with pytest.raises(DataError, match="does not say the noise of its accelerometer"):
        complementary.case(bare, covariance=True)
    assert (
        complementary.case(bare, covariance=True, accelerometer_noise=0.1, gyro_noise=0.1).score is not None
    )


def test_alpha_1_is_the_gyroscope_alone():
    case = complementary.case(flight(duration="2"), alpha=1.0)
    result = simulate(case.graph, case.inputs)
    np.testing.assert_array_equal(result["attitude"].attitude, result["gyroscope"].attitude)


def test_by_the_accelerometer_alone_the_force_points_up():
    case: Any = complementary.case(flight(duration="2"))
    result = simulate(case.graph, case.inputs)
    force = rotate(result["accelerometer"].attitude, case.inputs["accelerometer"].force, xp=np)
    np.testing.assert_allclose(force[:, :2], 0.0, atol=1e-9)


def test_an_imu_is_taken_apart():
    whole = load_flight("sim:roundtrip", settings={"duration": "2", "sensors": "imu"})
    imu = whole.streams["imu"]
    parts = {
        "gyro": Series(imu.time, Gyro(rate=imu["gyro"])),
        "accelerometer": Series(imu.time, SpecificForce(force=imu["specific_force"])),
    }
    cases: list[Case] = [complementary.case(f) for f in (whole, replace(whole, streams=parts))]
    a, b = (simulate(case.graph, case.inputs)["attitude"] for case in cases)
    np.testing.assert_array_equal(a.attitude, b.attitude)


def test_without_a_truth_it_starts_at_what_the_force_shows():
    full = flight(duration="2")
    case = complementary.case(Flight("bare", full.streams))
    result = simulate(case.graph, case.inputs)
    assert case.score(result) == {}
    up = rotate(result["gyroscope"].attitude[0], full.streams["accelerometer"]["force"][0], xp=np)
    np.testing.assert_allclose(up[:2], 0.0, atol=1e-9)


def test_a_flight_without_an_accelerometer_is_refused():
    bare = Flight("bare", {"gyro": flight().streams["gyro"]})
    with pytest.raises(DataError, match="this flight lacks what complementary needs") as error:
        complementary.case(bare)
    assert error.value.got == "gyro"
    assert "imu" in str(error.value.fix)


@pytest.mark.parametrize("alpha", [0.0, -0.1, 1.01, float("nan")])
def test_a_share_outside_its_range_is_refused(alpha):
    with pytest.raises(DeclarationError, match=r"alpha is outside \(0, 1\]"):
        complementary.case(flight(), alpha=alpha)


def test_a_score_needs_ticks_within_the_truth():
    case = complementary.case(flight(duration="2"), settle=5.0)
    with pytest.raises(DataError, match="no tick of the estimate lies within the truth"):
        case.score(simulate(case.graph, case.inputs))
