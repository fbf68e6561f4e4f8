"""Aids outdoors and the prediction over the Earth: Jacobians against differences, gravity, a start in
motion."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from flowgraph import Series
from flowgraph.blocks.flights.drive import ORIGIN, load_drive
from flowgraph.blocks.geometry.geodetic import to_enu
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    geodesic_angle,
    multiply,
    to_rotation_vector,
)
from flowgraph.blocks.inertial.alignment import start_belief
from flowgraph.blocks.inertial.imu import ImuNoise, predict
from flowgraph.blocks.inertial.moving import align_moving
from flowgraph.blocks.inertial.navigation import (
    PARAMETERS,
    earth_at,
    extended,
    gravity_at,
    navigation_crossing,
    places,
    predict_navigation,
)
from flowgraph.blocks.inertial.outdoors import (
    Antenna,
    Resting,
    aid_antennas,
    aid_compass,
    aid_gnss_position,
    aid_gnss_velocity,
    aid_height,
    aid_wheels,
    standing,
)
from flowgraph.blocks.signals import (
    GnssHeading,
    GnssPosition,
    GnssVelocity,
    Height,
    Imu,
    MagneticField,
    Position,
    WheelSpeed,
)

ALL = tuple(PARAMETERS)
SILENT = ImuNoise(0.0, 0.0, 0.0, 0.0)
G = (0.0, 0.0, -9.8)


def somewhere(seed: int, estimated: tuple[str, ...] = ALL) -> Any:
    """A belief about a moving, turned body, with everything estimated."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=4)
    b: Any = start_belief(rng.normal(size=3), q / np.linalg.norm(q), velocity=5.0 * rng.normal(size=3))
    b = b.replace(gyro_bias=0.1 * rng.normal(size=3), accelerometer_bias=rng.normal(size=3))
    b = extended(b, estimated)
    if estimated:
        size = np.concatenate(
            [np.full(PARAMETERS[n].size, 1e-3 if n.endswith("scale") else 0.1) for n in estimated]
        )
        b = b.replace(parameters=size * rng.normal(size=len(size)))
    A = rng.normal(size=b.covariance.shape)
    return b.replace(covariance=0.01 * (A @ A.T + np.eye(len(A))))


def moved(b: Any, d: np.ndarray) -> Any:
    """A belief with an error d added to it."""
    more = {"parameters": b.parameters + d[15:]} if len(d) > 15 else {}
    return b.replace(
        position=b.position + d[:3],
        velocity=b.velocity + d[3:6],
        attitude=multiply(b.attitude, from_rotation_vector(d[6:9], xp=np), xp=np),
        gyro_bias=b.gyro_bias + d[9:12],
        accelerometer_bias=b.accelerometer_bias + d[12:15],
        **more,
    )


def apart(a: Any, b: Any) -> np.ndarray:
    """The error of a from b."""
    turn = multiply(b.attitude * (1.0, -1.0, -1.0, -1.0), a.attitude, xp=np)
    return np.concatenate(
        [
            a.position - b.position,
            a.velocity - b.velocity,
            to_rotation_vector(turn, xp=np),
            a.gyro_bias - b.gyro_bias,
            a.accelerometer_bias - b.accelerometer_bias,
            a.parameters - b.parameters,
        ]
    )


@pytest.mark.parametrize("seed", range(2))
def test_the_prediction_knows_how_every_error_goes_on(seed):
    """F by hand, which the covariance and a smoother use, against differences of the step itself."""
    b, rng = somewhere(seed), np.random.default_rng(seed)
    imu = Imu(gyro=rng.normal(size=3), specific_force=10.0 * rng.normal(size=3))
    step = lambda b: predict_navigation.step(b, imu, noise=SILENT, gravity=G, estimated=ALL, dt=0.01, xp=np)
    n, e = len(b.covariance), 1e-6
    here = step(b)
    F = np.stack([apart(step(moved(b, e * np.eye(n)[k])), here) / e for k in range(n)], axis=-1)
    np.testing.assert_allclose(F @ b.covariance @ F.T, here.covariance, rtol=0.0, atol=3e-5)
    crossing = navigation_crossing(G, None, ALL)
    np.testing.assert_allclose(crossing(b, imu, 0.01, np), b.covariance @ F.T, rtol=0.0, atol=3e-5)


def test_with_nothing_more_it_is_the_prediction_of_ins_eskf():
    b, imu = somewhere(1, ()), Imu(gyro=np.array([0.1, 0.2, 0.3]), specific_force=np.array([1.0, 2.0, 9.0]))
    noise = ImuNoise(1e-3, 1e-2, 1e-5, 1e-4)
    ours = predict_navigation.step(b, imu, noise=noise, gravity=G, dt=0.01, xp=np)
    theirs = predict.step(b, imu, noise=noise, gravity=G, dt=0.01, xp=np)
    for name in ours._fields:
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))


ANTENNA = Antenna((0.3, -0.2, 0.1), 0.05)
AIDS: dict[str, tuple[Any, Any, dict[str, Any]]] = {
    "position": (
        aid_gnss_position, GnssPosition(position=np.array([9.0, 8.0, 7.0]), covariance=np.diag([1.0, 2.0,
        3.0])), {"antenna": ANTENNA, "estimated": ALL},
    ),
    "velocity": (
        aid_gnss_velocity, GnssVelocity(velocity=np.array([1.0, 2.0, 3.0]), covariance=np.eye(3)),
        {"antenna": ANTENNA, "estimated": ALL},
    ),
    "height": (aid_height, Height(height=np.float64(3.0)), {"noise": 0.5, "estimated": ALL}),
    "compass": (
        aid_compass, MagneticField(field=np.array([2e-5, 1e-5, -4e-5])), {"north": 0.3, "noise": 0.1},
    ),
    "antennas": (
        aid_antennas, GnssHeading(angle=np.float64(0.4), deviation=np.float64(0.1)), {"baseline": (1.0, 0.4,
        0.1)},
    ),
    "wheels": (
        aid_wheels, WheelSpeed(speed=np.float64(4.0)), {"noise": 0.1, "slip": 0.2, "axle": (-1.0, 0.1, 0.2)},
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", AIDS)
def test_an_aid_knows_what_every_error_does_to_what_it_measures(name):
    """The gain by hand against one of the differences of the residual, for the same posterior."""
    block, z, settings = AIDS[name]
    b = somewhere(3)
    imu = Imu(gyro=np.array([0.5, -0.3, 0.8]), specific_force=np.array([0.0, 0.0, 9.8]))
    more = (imu,) if name in ("velocity", "wheels") else ()
    see = lambda b: block.step(b, z, *more, **settings, xp=np)
    posterior, innovation = see(b)
    n, e = len(b.covariance), 1e-6
    wrapped = lambda r: (r + np.pi) % (2.0 * np.pi) - np.pi if name in ("compass", "antennas") else r
    H = -np.stack(
        [wrapped(see(moved(b, e * np.eye(n)[k]))[1].residual - innovation.residual) / e for k in range(n)],
        axis=-1,
    )
    P, S = b.covariance, innovation.covariance
    R = S - H @ P @ H.T
    np.testing.assert_allclose(R, np.diag(np.diagonal(R)), atol=1e-4 * np.abs(S).max())
    K = P @ H.T @ np.linalg.inv(S)
    d = K @ innovation.residual
    np.testing.assert_allclose(
        apart(posterior, moved(b, d)), np.zeros(n), atol=1e-4 * max(1.0, np.abs(d).max())
    )


def test_one_entry_of_three_corrects_alone_and_an_absent_fix_does_nothing():
    b = somewhere(0, ())
    part = GnssVelocity(velocity=np.array([1.0, np.nan, np.nan]), covariance=np.eye(3))
    imu = Imu.at_rest()
    posterior, innovation = aid_gnss_velocity.step(b, part, imu, xp=np)
    assert innovation.parts == 1.0
    assert np.isfinite(posterior.covariance).all()
    assert aid_gnss_position.step(b, None, xp=np) == (b, None)


def test_the_estimated_lever_takes_the_place_of_the_known_one():
    b = somewhere(4)
    where = places(ALL)
    at = b.replace(parameters=np.zeros_like(b.parameters))
    z = GnssPosition(position=np.zeros(3), covariance=np.eye(3))
    _, one = aid_gnss_position.step(at, z, antenna=ANTENNA, estimated=ALL, xp=np)
    np.testing.assert_allclose(one.residual, -b.position)
    known = tuple(n for n in ALL if n not in ("lever", "time_offset"))
    _, other = aid_gnss_position.step(somewhere(4, known), z, antenna=ANTENNA, estimated=known, xp=np)
    assert np.linalg.norm(other.residual - one.residual) > 0.1
    assert where["time_offset"] == slice(9, 10)


def test_gravity_is_that_of_the_tables():
    """Normal gravity of WGS84 at the equator, at 45 degrees, at the pole; and a kilometre up."""
    for latitude, expected in ((0.0, 9.7803253), (45.0, 9.8061992), (90.0, 9.8321849)):
        assert gravity_at(math.radians(latitude), 0.0)[2] == pytest.approx(-expected, abs=2e-6)
    assert gravity_at(math.radians(45.0), 1000.0)[2] == pytest.approx(-9.803113, abs=1e-5)


def test_a_unit_at_rest_on_the_turning_earth_stays_where_it_is():
    """An exact unit reads the Earth's turn; without it the attitude is off by 15 degrees an hour."""
    earth, gravity = earth_at(ORIGIN[0]), gravity_at(ORIGIN[0], ORIGIN[2])
    still = Imu(gyro=np.asarray(earth.turn), specific_force=-np.asarray(gravity))
    b = start_belief(np.zeros(3), [1.0, 0.0, 0.0, 0.0])
    for _ in range(600):
        b = predict_navigation.step(b, still, noise=SILENT, gravity=gravity, earth=earth, dt=0.1, xp=np)
    assert np.linalg.norm(b.velocity) < 1e-9
    flat = start_belief(np.zeros(3), [1.0, 0.0, 0.0, 0.0])
    for _ in range(600):
        flat = predict_navigation.step(flat, still, noise=SILENT, gravity=gravity, dt=0.1, xp=np)
    assert geodesic_angle(flat.attitude, [1.0, 0.0, 0.0, 0.0]) == pytest.approx(0.25, rel=0.01)


def test_standing_still_is_told_from_moving_and_from_moving_steadily():
    rng = np.random.default_rng(0)
    b = start_belief(np.zeros(3), [1.0, 0.0, 0.0, 0.0])
    driven = b.replace(velocity=np.array([8.0, 0.0, 0.0]))

    def told(belief: Any, shake: float) -> np.ndarray:
        state: Any = {"mean": np.zeros(6), "calm": np.float64(0.0), "begun": np.float64(0.0)}
        found = []
        for _ in range(300):
            imu = Imu(gyro=1e-3 * rng.normal(size=3), specific_force=shake * rng.normal(size=3) - G)
            state, z = standing.step(state, belief, imu, resting=Resting(), dt=0.01, xp=np)
            found.append(bool(np.isfinite(z.velocity).all()))
        return np.array(found)

    assert told(b, 0.02)[150:].all()
    assert not told(b, 2.0).any()
    assert not told(driven, 0.02).any()


def test_a_drive_shows_the_attitude_at_its_start_to_which_nothing_led():
    """On a car's way of 60 s, from a moment of motion on, with fixes good to 2 cm a second."""
    flight = load_drive(seed=2, settings={"duration": 70.0})
    truth, imu = flight.truth, flight.streams["imu"]
    assert truth is not None
    imu, truth = imu[1000:], truth[1000:]
    rng = np.random.default_rng(0)
    fixes = Series(
        truth.time[::100], Position(position=truth["position"][::100] + 0.02 * rng.normal(size=(61, 3)))
    )
    found = align_moving(imu, fixes, gravity=gravity_at(ORIGIN[0], ORIGIN[2]), noise=0.1)
    assert found is not None
    turn = to_rotation_vector(
        multiply(found.belief.attitude * (1, -1, -1, -1), truth["attitude"][0], xp=np), xp=np
    )
    deviation = np.sqrt(np.diagonal(found.belief.covariance))[6:9]
    assert found.heading < 0.2
    assert (np.abs(turn) < 3.0 * deviation).all()
    assert np.linalg.norm(found.belief.velocity - truth["velocity"][0]) < 0.5
    assert align_moving(imu, fixes[:4], gravity=G, noise=0.1) is None


def test_a_body_at_rest_shows_no_heading():
    time = np.arange(0, 20 * 10**9, 10**7)
    n = len(time)
    imu = Series(time, Imu(gyro=np.zeros((n, 3)), specific_force=np.tile([0.0, 0.0, 9.8], (n, 1))))
    rng = np.random.default_rng(0)
    fixes = Series(time[::100], Position(position=0.02 * rng.normal(size=(20, 3))))
    found = align_moving(imu, fixes, gravity=G, noise=0.1)
    assert found is not None
    assert found.heading > 1.0


def test_fixes_of_a_drive_are_about_its_origin():
    flight = load_drive(seed=1, settings={"duration": 4.0, "gps.rate": 10.0})
    gps, truth = flight.streams["gps"], flight.truth
    assert truth is not None
    places = to_enu(np.stack([gps[n] for n in ("latitude", "longitude", "height")], axis=-1), ORIGIN)
    off = places - truth["position"][np.searchsorted(truth.time, gps.time)]
    assert 1.0 < float(np.sqrt(np.mean(off[:, :2] ** 2))) < 2.0
