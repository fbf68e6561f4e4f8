"""`marg`: nine axes to an orientation; a magnet cannot tilt it, and a shake is no tilt."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, Series, load_flight, simulate
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    rotate,
    tilt_and_heading,
)
from flowgraph.blocks.inertial.alignment import static_alignment
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.orientation.heading import FieldTrust, update_heading
from flowgraph.blocks.orientation.marg import RestRule, detect_rest, hold_velocity
from flowgraph.blocks.signals import Attitude, HeadingBelief, Imu, LevelBelief, MagneticField, Rest
from flowgraph.graphs import marg
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn
from tests.recordings import recordings

RATE = 100
EARTH = np.array([0.0, 20e-6, -40e-6])
QUIET = ImuNoise(gyro=2e-4, accelerometer=2e-3, gyro_bias=1e-5, accelerometer_bias=1e-3)
BIAS = np.array([0.01, -0.02, 0.015])


@cache
def made(seed: int = 0, seconds: float = 20.0, rest: float = 3.0, shake: float = 0.0) -> Flight:
    """A body that rests, then turns about all axes and is shaken with `shake` m/s^2, its gyroscope biased."""
    rng = np.random.default_rng(seed)
    n = int(seconds * RATE)
    t = np.arange(n) / RATE
    moving = np.clip((t - rest) / 0.5, 0.0, 1.0)[:, None]
    rate = (
        np.stack([0.8 * np.sin(1.1 * t), 0.7 * np.sin(0.7 * t + 1.0), 0.9 * np.cos(0.5 * t)], axis=1) * moving
    )
    q = [np.array([0.9, 0.1, -0.2, np.sqrt(1.0 - 0.86)])]
    for w in rate[:-1]:
        q.append(multiply(q[-1], from_rotation_vector(w / RATE, xp=np), xp=np))
    attitude = np.array(q)
    push = shake * moving * np.sin(2.0 * np.pi * 2.0 * t)[:, None] * np.array([1.0, 0.6, 0.0])
    back = conjugate(attitude, xp=np)
    force = rotate(back, push + np.array([0.0, 0.0, 9.81]), xp=np) + rng.normal(size=(n, 3)) * 0.02
    gyro = rate + BIAS + rng.normal(size=(n, 3)) * 0.002
    field = rotate(back, np.tile(EARTH, (n, 1)), xp=np) + rng.normal(size=(n, 3)) * 2e-7
    time = np.arange(n, dtype=np.int64) * (10**9 // RATE)
    streams = {
        "imu": Series(time, Imu(gyro=gyro, specific_force=force), name="imu"),
        "magnetometer": Series(time, MagneticField(field=field), name="magnetometer"),
    }
    return Flight("made", streams, Series(time, Attitude(attitude=attitude)), {"imu_noise": QUIET})


def with_field(flight: Flight, field: np.ndarray) -> Flight:
    changed = Series(flight.streams["magnetometer"].time, MagneticField(field=field), name="magnetometer")
    return Flight("changed", {**flight.streams, "magnetometer": changed}, flight.truth, flight.info)


def ran(flight: Flight, engine: str = "python"):
    case = marg.case(flight)
    return case, simulate(case.graph, case.inputs, engine=engine)


def test_it_runs_at_every_reading_and_finds_orientation_and_bias():
    flight = made()
    case = marg.case(flight)
    result = simulate(case.graph, case.inputs)
    assert result["belief"].time.tolist() == flight.streams["imu"].time.tolist()
    np.testing.assert_allclose(np.linalg.norm(result["belief"]["attitude"], axis=1), 1.0, atol=1e-12)
    errors = case.score(result)
    assert errors["total_rmse_deg"] < 1.0
    assert errors["inclination_rmse_deg"] < 0.5
    np.testing.assert_allclose(result["belief"]["gyro_bias"][-1], BIAS, atol=2e-3)
    still = result["rest"]["still"]
    assert still[250] == 1.0  # it has rested for 2.5 s
    assert not still[400:].any()


def test_engines_agree():
    flight = made(seconds=5.0)
    case = marg.case(flight)
    engines_agree(case.graph, case.inputs)
    slow = flight.streams["magnetometer"]
    fewer = Flight("slow", {**flight.streams, "magnetometer": slow[::4]}, flight.truth, flight.info)
    case = marg.case(fewer)
    python, reference = (simulate(case.graph, case.inputs, engine=e) for e in ("python", "reference"))
    np.testing.assert_array_equal(python["belief"]["attitude"], reference["belief"]["attitude"])


def test_it_is_lowered_and_drawn():
    is_lowered_and_drawn(marg.case(made(seconds=5.0)), "rest", "level", "heading", "belief")


def test_a_magnet_cannot_tilt_it_nor_move_its_bias():
    """To the last bit: whatever the magnetometer reads, tilt and bias are the same."""
    flight = made()
    rng = np.random.default_rng(7)
    wild = flight.streams["magnetometer"]["field"] + 0.0
    wild[500:] += np.array([1.0, -1.0, 0.3]) * 1e-5 + rng.normal(size=(len(wild) - 500, 3)) * 2e-6
    clean, disturbed = ran(flight)[1]["belief"], ran(with_field(flight, wild))[1]["belief"]
    np.testing.assert_array_equal(clean["gyro_bias"], disturbed["gyro_bias"])
    up = [
        rotate(conjugate(b["attitude"], xp=np), np.array([0.0, 0.0, 1.0]), xp=np) for b in (clean, disturbed)
    ]
    np.testing.assert_allclose(up[0], up[1], atol=1e-14)
    tilt, heading = tilt_and_heading(clean["attitude"], disturbed["attitude"])
    assert np.abs(heading).max() > 1.0  # the disturbance was felt where it may be
    assert tilt.max() < 1e-5


def test_a_field_of_wrong_strength_is_refused():
    """A magnet beside the body for 5 s turns the field by 60 degrees and doubles its strength: the heading
    follows by a small part."""
    flight = made()
    back = conjugate(flight.truth["attitude"], xp=np)  # type: ignore[index]
    field = flight.streams["magnetometer"]["field"] + 0.0
    field[800:1300] += rotate(back, np.tile([50e-6, 0.0, 0.0], (2000, 1)), xp=np)[800:1300]
    _, result = ran(with_field(flight, field))
    _, heading = tilt_and_heading(result["belief"]["attitude"], flight.truth["attitude"])  # type: ignore[index]
    assert np.abs(heading[800:1300]).max() < 3.0


def beside_a_magnet(field: np.ndarray, hold: float) -> float:
    """By how many degrees a field (n, 3), level and at 100 Hz, moves a heading that was sure to 1 degree."""
    level = LevelBelief(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.eye(9) * 1e-4)
    strength, dip = np.linalg.norm(EARTH), np.arctan2(-EARTH[2], EARTH[1])
    belief = HeadingBelief(np.float64(0.0), np.float64(np.radians(1.0) ** 2), strength, dip)
    state = {"time": np.int64(0), "held": np.float64(0.0)}
    moved = 0.0
    for k, m in enumerate(field, start=1):
        settings = {"trust": FieldTrust(hold=hold), "north": np.pi / 2.0, "t": np.int64(k * 10**7), "xp": np}
        state, belief = update_heading.step(state, belief, level, MagneticField(m), **settings)
        moved = max(moved, abs(float(np.degrees(belief.angle))))
    return moved


TIME = np.arange(500) / RATE
TURN = 2.0 * np.pi * 0.8 * TIME
STILL = 0.0 * TIME
MAGNETS = {
    "one that turns about the vertical": [40e-6 * np.sin(TURN), 40e-6 * np.cos(TURN), STILL],
    "one that tilts": [20e-6 + STILL, -20e-6 + STILL, 40e-6 * np.sin(TURN)],
    "one that comes and goes": [20e-6 * np.sin(TURN), 15e-6 * np.sin(1.3 * TURN) - 20e-6, STILL],
    "one that swings": [15e-6 * (1.0 + np.sin(TURN)), STILL, 12e-6 * np.sin(1.7 * TURN)],
}


@pytest.mark.parametrize("magnet", MAGNETS)
def test_a_field_that_is_normal_for_an_instant_is_not_trusted(magnet):
    """Strength and dip pass through those of the Earth while the heading is off."""
    field = EARTH + np.stack(MAGNETS[magnet], axis=-1)
    at_once, held = beside_a_magnet(field, 0.0), beside_a_magnet(field, 0.3)
    assert held < 0.6 * at_once
    assert held < 0.6


def test_a_doubt_fades_and_a_clean_field_is_followed():
    """With no magnet the held doubt changes nothing; seconds after one the heading is corrected again."""
    turned = np.tile([-20e-6 * np.sin(0.1), 20e-6 * np.cos(0.1), -40e-6], (500, 1))
    assert beside_a_magnet(turned, 0.3) == pytest.approx(beside_a_magnet(turned, 0.0), rel=1e-9)
    after = turned + 0.0
    after[:100] += [0.0, 0.0, -60e-6]
    assert 0.5 * beside_a_magnet(turned[100:], 0.3) < beside_a_magnet(after, 0.3)
    assert beside_a_magnet(after, 0.3) < 0.9 * beside_a_magnet(turned, 0.3)


@pytest.mark.parametrize("still", [0.0, 1.0])
def test_the_level_is_corrected_as_the_equations_say(still):
    rng = np.random.default_rng(3)
    root = rng.normal(size=(9, 9))
    prior = LevelBelief(
        rng.normal(size=3), np.array([0.5, 0.5, -0.5, 0.5]), rng.normal(size=3), root @ root.T
    )
    reading = Imu(gyro=rng.normal(size=3), specific_force=np.array([0.0, 0.0, 9.81]))
    settings = {"noise": QUIET, "speed": 0.4, "speed_memory": 0.5, "dt": 0.01, "xp": np}
    found = hold_velocity.step(prior, reading, Rest(still=np.float64(still)), **settings)
    sigma = 0.005 if still else 0.4
    H = np.eye(9)[[0, 1, 2, 6, 7, 8]] if still else np.eye(9)[:3]
    R = np.diag([2.0 * sigma**2 * 0.5 / 0.01] * 3 + [QUIET.gyro**2 / 0.01] * 3)[: len(H), : len(H)]
    residual = np.concatenate([-prior.velocity, reading.gyro - prior.gyro_bias])[: len(H)]
    P = prior.covariance
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    d = K @ residual
    G = np.eye(9)
    G[3:6, 3:6] -= 0.5 * np.cross(np.eye(3), -d[3:6]).T
    np.testing.assert_allclose(found.velocity, prior.velocity + d[:3], rtol=1e-9)
    np.testing.assert_allclose(found.gyro_bias, prior.gyro_bias + d[6:], rtol=1e-9)
    turned = multiply(prior.attitude, from_rotation_vector(d[3:6], xp=np), xp=np)
    np.testing.assert_allclose(found.attitude, turned, atol=1e-12)
    np.testing.assert_allclose(found.covariance, G @ (P - K @ H @ P) @ G.T, rtol=1e-6, atol=1e-9)


def test_the_usual_speed_is_that_of_the_flight():
    flight = made(seconds=5.0)
    slow = replace(flight, info={**flight.info, "speed": 0.25})
    told, by_hand = ran(slow)[1]["belief"], marg.case(flight, speed=0.25)
    asked = simulate(by_hand.graph, by_hand.inputs)["belief"]
    np.testing.assert_array_equal(told["attitude"], asked["attitude"])
    assert np.abs(told["attitude"] - ran(flight)[1]["belief"]["attitude"]).max() > 1e-6


def test_a_shake_is_no_tilt():
    """5 m/s^2 at 2 Hz tilts the vertical that an accelerometer shows by 20 degrees; the filter by less than
    one."""
    flight = made(shake=5.0)
    force = flight.streams["imu"]["specific_force"][400:]
    seen = force / np.linalg.norm(force, axis=1, keepdims=True)
    up = rotate(conjugate(flight.truth["attitude"], xp=np), np.array([0.0, 0.0, 1.0]), xp=np)[400:]  # type: ignore[index]
    by_force = np.degrees(np.arccos(np.clip(np.sum(seen * up, axis=1), -1.0, 1.0)))
    assert np.sqrt(np.mean(by_force**2)) > 10.0
    case, result = ran(flight)
    assert case.score(result)["inclination_rmse_deg"] < 1.0


def test_errors_stay_within_what_the_filter_claims():
    inside = []
    for seed in range(3):
        flight = made(seed, seconds=10.0)
        belief = ran(flight)[1]["belief"]
        tilt, _ = tilt_and_heading(belief["attitude"], flight.truth["attitude"])  # type: ignore[index]
        R = np.array([rotate(q, np.eye(3), xp=np).T for q in belief["attitude"]])
        P = R @ belief["covariance"][:, :3, :3] @ R.transpose(0, 2, 1)
        claimed = np.degrees(3.0 * np.sqrt(P[:, 0, 0] + P[:, 1, 1]))
        inside.append(np.mean(tilt <= claimed))
    assert np.mean(inside) > 0.97


def test_rest_is_told_from_a_slow_turn():
    rule = RestRule()
    state = {"rate": np.zeros(3), "force": np.zeros(3), "seconds": np.float64(-1.0)}
    reading = Imu(gyro=np.array([0.01, 0.0, 0.0]), specific_force=np.array([0.0, 0.0, 9.81]))
    for k in range(200):
        state, rest = detect_rest.step(state, reading, rule=rule, dt=0.01 * (k > 0), xp=np)
    assert rest.still == 1.0
    turning = Imu(gyro=np.array([0.1, 0.0, 0.0]), specific_force=np.array([0.0, 0.0, 9.81]))
    for _ in range(300):
        state, rest = detect_rest.step(state, turning, rule=rule, dt=0.01, xp=np)
    assert rest.still == 0.0  # a constant 6 deg/s is no bias


def test_the_alignment_at_rest_is_that_of_the_mean():
    flight = made(seconds=5.0)
    found = static_alignment(flight.streams["imu"], flight.streams["magnetometer"], seconds=2.0)
    assert found.resting == 1.0
    assert found.seconds == pytest.approx(2.0)
    np.testing.assert_allclose(found.gyro_bias, BIAS, atol=5e-4)
    tilt, heading = tilt_and_heading(found.attitude, flight.truth["attitude"][0])  # type: ignore[index]
    assert tilt < 0.1
    assert abs(heading) < 0.2
    moving = flight.streams["imu"][flight.streams["imu"].time > 4 * 10**9]
    assert static_alignment(moving).resting == 0.0
    np.testing.assert_array_equal(static_alignment(moving).gyro_bias, np.zeros(3))


def test_on_a_simulated_flight_north_is_where_the_world_has_it():
    settings = {"sensors": "imu,magnetometer", "duration": "4", "magnetometer.declination": "0.3"}
    settings |= {"gyro.noise": "1e-4", "accelerometer.noise": "1e-3"}
    flight = load_flight("sim:hover", seed=1, settings=settings)
    case, result = ran(flight)
    assert abs(case.score(result)["heading_rmse_deg"]) < 2.0


def test_bad_input_is_refused():
    with pytest.raises(DataError, match="this flight lacks what marg needs"):
        marg.case(load_flight("sim"))
    with pytest.raises(DeclarationError, match="'speed' is out of range"):
        marg.case(made(), speed=0.0)


@pytest.mark.parametrize(
    ("trial", "bounds"),
    [
        ("01_undisturbed_slow_rotation_A", (3.26, 3.14, 0.85)),
        ("15_undisturbed_fast_translation_A", (8.69, 7.35, 4.64)),
        ("28_disturbed_stationary_magnet_A", (6.18, 4.72, 3.98)),
    ],
)
@pytest.mark.slow
def test_on_recordings_it_is_better_than_the_filter_of_madgwick(trial, bounds):
    """Total, heading and inclination in degrees, beside that filter's with gain 0.12 on the same trial."""
    case, result = ran(load_flight(f"broad:{recordings('broad') / trial}.mat"), "xla")
    errors = case.score(result)
    found = [errors[f"{name}_rmse_deg"] for name in ("total", "heading", "inclination")]
    assert all(ours < theirs for ours, theirs in zip(found, bounds, strict=True))
