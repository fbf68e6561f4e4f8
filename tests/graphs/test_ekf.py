"""`ekf`: Jacobians against automatic differentiation, consistency over many runs, engines that agree."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, DeclarationError, Flight, Series, load_flight, simulate, simulate_many
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, rotate, to_rotation_vector
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics import chi_square_band, inside, nis_summary
from flowgraph.blocks.models import pose as x
from flowgraph.blocks.signals import Imu, Pose, QuaternionBelief
from flowgraph.graphs import ekf
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn, mean_nees, smooth, thesis

RUNS = 50
BASES = [0, *(pytest.param(base, marks=pytest.mark.slow) for base in (100, 200))]
"""The first seed of three sets of runs."""
DT, LEVER = 0.01, np.array([0.1, -0.2, 0.3])


def a_state(seed: int) -> tuple[np.ndarray, Imu]:
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    state = np.concatenate([rng.normal(size=6), q / np.linalg.norm(q)])
    return state, Imu(gyro=rng.normal(size=3) * 3.0, specific_force=rng.normal(size=3) * 10.0)


def a_belief(seed: int = 0) -> QuaternionBelief:
    state, _ = a_state(seed)
    return x.start_pose(state[3:6], state[6:], velocity=state[:3])


# Jacobians


@pytest.fixture
def jax() -> Any:
    found = pytest.importorskip("jax")
    with found.enable_x64(True):
        yield found


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_of_the_prediction_is_that_of_automatic_differentiation(jax, seed):
    state, imu = a_state(seed)
    jnp = jax.numpy

    def moved(s: Any) -> Any:
        return jnp.concatenate(x.move(s[:3], s[3:6], s[6:], imu, DT, jnp))

    automatic = jax.jacfwd(moved)(jnp.asarray(state))
    np.testing.assert_allclose(x.move_jacobian(state[6:], imu, DT, np), automatic, atol=1e-9, rtol=0)


@pytest.mark.parametrize("seed", range(5))
def test_the_jacobian_of_the_measurement_is_that_of_automatic_differentiation(jax, seed):
    state, _ = a_state(seed)
    jnp = jax.numpy

    def seen(s: Any) -> Any:
        return jnp.concatenate([s[3:6] + rotate(s[6:], jnp.asarray(LEVER), xp=jnp), s[6:]])

    expected = seen(jnp.asarray(state))
    automatic = jax.jacfwd(lambda s: x.POSE.minus(seen(s), expected, jnp))(jnp.asarray(state))
    found = x.observe_jacobian(state[6:], LEVER, np)
    np.testing.assert_allclose(found, automatic, atol=1e-9, rtol=0)


# Noise and norm


def test_the_unscented_noise_of_the_quaternion():
    """To first order it is (s^2 dt / 4)(I - q q^T); it adds no noise along q, and none over no time."""
    q, density = a_state(1)[0][6:], 0.3
    Q = x.quaternion_noise(q, density, DT, np)
    np.testing.assert_allclose(Q, 0.25 * density**2 * DT * (np.eye(4) - np.outer(q, q)), rtol=2e-3, atol=1e-9)
    np.testing.assert_allclose(Q @ q, 0.0, atol=1e-15)
    np.testing.assert_array_equal(x.quaternion_noise(q, density, 0.0, np), np.zeros((4, 4)))
    turns = np.random.default_rng(0).normal(size=(200_000, 3)) * density * DT**0.5
    drawn = multiply(q, from_rotation_vector(turns, xp=np), xp=np)
    np.testing.assert_allclose(Q, np.cov(drawn.T), atol=0.02 * Q.max())


def test_the_quaternion_stays_of_unit_norm_and_the_covariance_normal_to_it():
    belief, noise = a_belief(), ImuNoise(0.02, 0.02, 0.0, 0.0)
    z = Pose(position=belief.position + 0.3, attitude=a_state(3)[0][6:])
    for step in range(5):
        belief = x.predict_pose.step(belief, a_state(step)[1], noise=noise, dt=DT, xp=np)
        belief, _ = x.update_pose.step(belief, z, position_noise=0.1, attitude_noise=0.1, xp=np)
        q, P = belief.attitude, belief.covariance
        np.testing.assert_allclose(np.linalg.norm(q), 1.0, atol=1e-15)
        np.testing.assert_allclose(P[6:, 6:] @ q, 0.0, atol=1e-14)
        np.testing.assert_array_equal(P, P.T)
        assert np.linalg.eigvalsh(P)[0] > -1e-14


def test_no_time_changes_nothing():
    belief = a_belief()
    found = x.predict_pose.step(belief, a_state(0)[1], noise=ImuNoise(1.0, 1.0, 0.0, 0.0), dt=0.0, xp=np)
    for name in belief._fields:
        np.testing.assert_allclose(getattr(found, name), getattr(belief, name), atol=1e-15)


def test_a_quaternion_and_its_negative_are_one_measurement():
    belief, z = a_belief(), a_state(3)[0][6:]
    settings: dict[str, Any] = {"position_noise": 0.1, "attitude_noise": 0.1, "xp": np}
    a, b = (
        x.update_pose.step(belief, Pose(position=belief.position, attitude=s * z), **settings)[0]
        for s in (1.0, -1.0)
    )
    np.testing.assert_allclose(a.attitude, b.attitude, atol=1e-14)
    assert x.update_pose.step(belief, None, **settings) == (belief, None)


def test_the_covariance_in_the_tangent_space():
    belief = a_belief()
    found = x.pose_belief.step(belief, xp=np)
    diagonal = np.diag([0.7**2] * 6 + [0.3**2] * 3)
    np.testing.assert_allclose(found.covariance, diagonal, atol=1e-15)
    small = np.array([1e-7, -2e-7, 3e-7])
    apart = multiply(belief.attitude, from_rotation_vector(small, xp=np), xp=np) - belief.attitude
    np.testing.assert_allclose(x._to_angle(belief.attitude, np) @ apart, small, atol=1e-13)


# The graph


@cache
def a_case(seconds: float = 3.0) -> Case:
    return ekf.case(thesis(1, seconds, vicon_phase=0.0123))


def test_the_engines_agree():
    pytest.importorskip("jax")
    case = a_case()
    result = engines_agree(case.graph, case.inputs)
    assert len(result["innovation"]) == 12


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(a_case(), "predict_pose", "update_pose", "pose_belief")


def test_it_follows_the_flights_of_the_thesis():
    for seed in range(3):
        case = ekf.case(thesis(seed, 20.0))
        result = simulate(case.graph, case.inputs)
        score = case.score(result)
        assert score["position_rmse_m"] < 0.2
        assert score["attitude_rmse_deg"] < 4.0
        assert score["position_3sigma"] > 0.97
        assert 0.8 < nis_summary(result["innovation"])["nis_mean"] < 1.25


def test_a_unit_with_biases_is_trusted_less():
    case = ekf.case(load_flight("sim", seed=1))
    score = case.score(simulate(case.graph, case.inputs))
    assert score["position_rmse_m"] < 0.03
    assert score["attitude_rmse_deg"] < 1.2


def test_a_flight_without_motion_capture_is_refused():
    whole = thesis(1, 3.0)
    with pytest.raises(DataError, match=r"lacks what ekf needs[\s\S]*imu, vicon[\s\S]*got: +imu"):
        ekf.case(Flight(whole.name, {"imu": whole.streams["imu"]}, whole.truth, whole.info))


@pytest.mark.parametrize("settings", [{"smooth": "rts"}, {"lag": 1.0}, {"smooth": "rts", "lag": 0.5}])
def test_a_smoother_is_better_than_the_filter(settings):
    case = ekf.case(thesis(1, 10.0), **settings)
    score = case.score(simulate(case.graph, case.inputs))
    for front in ("smoothed",) * ("smooth" in settings) + ("lagged",) * ("lag" in settings):
        assert score[f"{front}_position_rmse_m"] < 0.75 * score["position_rmse_m"]
        assert score[f"{front}_attitude_rmse_deg"] < 0.9 * score["attitude_rmse_deg"]
        assert 5.0 < score[f"{front}_nees_mean"] < 14.0
    assert ("smoothed_nees_mean" in score) == ("smooth" in settings)


def test_settings_that_make_no_sense_are_refused():
    flight = thesis(1, 3.0)
    with pytest.raises(DeclarationError, match=r"'smooth' has no such value[\s\S]*none or rts"):
        ekf.case(flight, smooth="yes")
    with pytest.raises(DeclarationError, match="'lag' is out of range"):
        ekf.case(flight, lag=-1.0)
    perfect = thesis(1, 3.0, vicon_noise=0.0)
    with pytest.raises(DeclarationError, match=r"weigh measurements without noise[\s\S]*the flight's own"):
        ekf.case(perfect)
    assert ekf.case(perfect, position_noise=0.001).graph is not None
    with pytest.raises(DataError, match="does not say the noise of its imu"):
        ekf.case(Flight("bare", flight.streams))


# Consistency


def instants(seed: int) -> Flight:
    """A flight of the thesis whose IMU reads its stamp alone, not the step before it."""
    return thesis(seed, imu_oversample=1.0)


def start(truth: Series | None, seed: int) -> dict[str, QuaternionBelief]:
    """A start whose error is drawn from its spread."""
    assert truth is not None
    error = np.random.default_rng(seed).normal(size=9) * np.repeat([0.5, 0.5, 0.1], 3)
    q = multiply(truth["attitude"][0], from_rotation_vector(-error[6:], xp=np), xp=np)
    assert np.linalg.norm(to_rotation_vector(q, xp=np)) < 4.0
    belief = x.start_pose(
        truth["position"][0] + error[:3],
        q,
        velocity=truth["velocity"][0] + error[3:6],
        position_deviation=0.5,
        velocity_deviation=0.5,
        attitude_deviation=0.1,
    )
    return {"belief": belief}


@cache
def nees_of_50(make: Callable[[int], Flight], base: int, factor: float) -> tuple[np.ndarray, np.ndarray]:
    """The time of each tick in s, and the mean NEES of 50 runs at it, with R times `factor`."""
    noise = 0.1 * factor**0.5
    case = ekf.case(make(base), position_noise=noise, attitude_noise=noise)
    seeds = range(base, base + RUNS)
    batch = simulate_many(
        case.graph,
        lambda seed: dict(make(seed).streams),
        seeds,
        init=lambda seed: start(make(seed).truth, seed),
        keep=["belief"],
        engine="c",
    )
    return batch["belief"].time * 1e-9, mean_nees(batch["belief"], [make(seed) for seed in seeds])


def is_consistent(make: Callable[[int], Flight], base: int, factor: float = 1.0) -> bool:
    return inside(nees_of_50(make, base, factor)[1], chi_square_band(9, runs=RUNS)) >= 0.8


@pytest.mark.slow
@pytest.mark.parametrize("make", [smooth, thesis])
@pytest.mark.parametrize("base", BASES)
def test_the_nees_of_50_runs_lies_in_its_band(base, make):
    assert is_consistent(make, base)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [2.0, 0.5])
@pytest.mark.parametrize("make", [smooth, thesis])
@pytest.mark.parametrize("base", BASES)
def test_the_same_test_fails_with_a_wrong_noise(base, make, factor):
    assert not is_consistent(make, base, factor)


@pytest.mark.slow
def test_readings_of_an_instant_cannot_tell_when_a_rate_jumped():
    """The thesis's body rate jumps at the key points. Before the first, instants are as good as means."""
    time, found = nees_of_50(instants, 0, 1.0)
    band = chi_square_band(9, runs=RUNS)
    jumps = np.array([1.0, 2.0, 4.0, 5.0, 6.0, 8.0, 9.0])
    assert inside(found[time < jumps[0]], band) >= 0.8
    assert inside(found[time >= jumps[0]], band) < 0.8
    after = np.concatenate([found[(time >= jump) & (time < jump + 0.25)] for jump in jumps])
    assert np.mean(after > band[1]) > 0.5
    assert np.mean(found < band[0]) < 0.02  # it errs to one side only: too sure of itself


def test_an_entry_that_was_not_measured_leaves_the_others_to_correct():
    from flowgraph import arrays

    flight = load_flight("sim", seed=1)
    case = ekf.case(flight)
    inputs: Any = case.inputs
    vicon = inputs["vicon"]
    position = np.array(vicon.position)
    position[5, 0] = np.nan
    gappy = arrays(vicon.time, type(vicon.values)(position, vicon.attitude), not_finite="keep")
    whole = simulate(case.graph, inputs)[case.estimate].position
    partial = simulate(case.graph, {**inputs, "vicon": gappy})[case.estimate].position
    assert np.isfinite(partial).all()
    assert 0 < np.abs(partial - whole).max() < 0.1
