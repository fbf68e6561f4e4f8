"""The simulated sensors: what they read, how wrong it is, when it arrives, and that none disturbs another."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowgraph import timing_of
from flowgraph.blocks import sensors as s
from flowgraph.blocks.geometry import FLATTENING, SEMI_MAJOR_AXIS
from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.world import Hover, RoundTrip, thesis_flight
from flowgraph.errors import DeclarationError

FLIGHT = thesis_flight(5)
LONG = Hover(duration=500.0)

SENSORS = [
    s.Gyroscope(),
    s.Accelerometer(),
    s.CoordinateAccelerometer(),
    s.InertialUnit(),
    s.PositionSensor(lever=(0.1, 0.2, 0.3)),
    s.AttitudeSensor(),
    s.Vicon(),
    s.Gps(),
    s.Magnetometer(),
    s.MagneticAttitude(),
    s.Altimeter(),
    s.OpticalFlowSensor(),
    s.ThrustInput(),
    s.BodyRateInput(),
]


def noisy(sensor, noise):
    """The sensor with this noise in all its parts."""
    parts = [k for k in ("noise", "attitude_noise", "gyro", "accelerometer") if hasattr(sensor, k)]
    return replace(sensor, **dict.fromkeys(parts, noise))


def same(a, b):
    return all((a.leaves[name] == b.leaves[name]).all() for name in a.leaves)


def test_without_noise_each_reads_the_truth():
    at = lambda series: FLIGHT.at(series.time / 1e9)
    gyro = s.Gyroscope().sample(FLIGHT)
    np.testing.assert_array_equal(gyro.rate, at(gyro).rate)
    force = s.Accelerometer().sample(FLIGHT)
    world = g.rotate(at(force).attitude, force.force, xp=np)
    np.testing.assert_allclose(world, at(force).acceleration + np.array([0.0, 0.0, 9.81]), atol=1e-10)
    coordinate = s.CoordinateAccelerometer().sample(FLIGHT)
    world = g.rotate(at(coordinate).attitude, coordinate.acceleration, xp=np)
    np.testing.assert_allclose(world, at(coordinate).acceleration, atol=1e-10)
    imu = s.InertialUnit().sample(FLIGHT)
    assert (imu.gyro == gyro.rate).all()
    assert (imu.specific_force == force.force).all()
    vicon = s.Vicon().sample(FLIGHT)
    np.testing.assert_array_equal(vicon.position, at(vicon).position)
    np.testing.assert_allclose(vicon.attitude, at(vicon).attitude, atol=1e-15)
    thrust = s.ThrustInput().sample(FLIGHT)
    np.testing.assert_allclose(thrust.thrust, force.force[:, 2], atol=1e-12)
    # the thesis's way to the vertical: thrust less the coordinate acceleration is gravity in the body
    up = thrust.thrust[:, None] * [0.0, 0.0, 1.0] - coordinate.acceleration
    vertical = g.rotate(at(thrust).attitude, up, xp=np)
    np.testing.assert_allclose(vertical, [[0.0, 0.0, 9.81]] * len(up), atol=1e-9)


@pytest.mark.parametrize("sensor", SENSORS, ids=lambda sensor: sensor.name)
def test_a_seed_repeats_and_the_name_chooses_the_draws(sensor):
    sensor = noisy(sensor, s.Noise(density=0.01, deviation=0.1, bias=0.1, walk=0.01))
    first = sensor.sample(FLIGHT, seed=3)
    assert first.name == sensor.name
    assert same(first, sensor.sample(FLIGHT, seed=3))
    assert not same(first, sensor.sample(FLIGHT, seed=4))
    if not isinstance(sensor, s.InertialUnit):  # its noise is that of its parts
        assert not same(first, replace(sensor, name="other").sample(FLIGHT, seed=3))
    late = replace(sensor, latency=0.02, jitter=0.001).record(FLIGHT, seed=3)  # draws its latency apart
    rows = np.searchsorted(first.time, late.stamp)
    assert same(late.series, first[rows])


def test_a_short_recording_is_the_beginning_of_a_long_one():
    sensor = s.Gyroscope(noise=s.Noise(density=0.01, bias=0.1, walk=0.01))
    long, short = sensor.sample(FLIGHT, seed=1), sensor.sample(FLIGHT, seed=1, until="5s")
    assert len(short) == 1001
    assert same(short, long[:1001])


def test_white_noise_bias_and_walk_are_what_they_say():
    noise = s.Noise(density=0.02, deviation=0.1)
    white = s.Gyroscope(noise=noise).sample(LONG, seed=1).rate
    np.testing.assert_allclose(white.std(0), math.sqrt(0.02**2 * 200.0 + 0.01), rtol=0.02)
    assert np.abs(white.mean(0)).max() < 5 * white.std() / math.sqrt(len(white))
    whiteness = [np.corrcoef(white[1:, i], white[:-1, i])[0, 1] for i in range(3)]
    assert np.abs(whiteness).max() < 0.02
    halved = s.Gyroscope(noise=replace(noise, deviation=0.0), rate=50.0).sample(LONG, seed=1).rate
    np.testing.assert_allclose(halved.std(), 0.02 * math.sqrt(50.0), rtol=0.02)
    walk = s.PositionSensor(noise=s.Noise(walk=0.3)).sample(LONG, seed=2).position
    np.testing.assert_allclose(np.diff(walk, axis=0).std(), 0.3 * math.sqrt(0.1), rtol=0.03)
    starts = [
        s.PositionSensor(noise=s.Noise(bias=0.5)).sample(Hover(), seed=k).position[0] for k in range(300)
    ]
    np.testing.assert_allclose(np.std(starts, axis=0), 0.5, rtol=0.15)
    assert s.Noise.variance(0.25).deviation == 0.5


def test_attitude_noise_turns_the_body():
    read = s.AttitudeSensor(rate=50.0, noise=s.Noise(deviation=0.1)).sample(RoundTrip(duration=300.0), seed=1)
    truth = RoundTrip(duration=300.0).at(read.time / 1e9).attitude
    error = g.to_rotation_vector(g.multiply(g.conjugate(truth, xp=np), read.attitude, xp=np), xp=np)
    np.testing.assert_allclose(error.std(0), 0.1, rtol=0.03)
    np.testing.assert_allclose(np.linalg.norm(read.attitude, axis=-1), 1.0)


def test_an_inertial_unit_tells_its_densities():
    thesis = s.InertialUnit(
        gyro=s.Noise.variance(0.1, walk=1e-3), accelerometer=s.Noise(density=0.02, walk=1e-2)
    ).densities
    expected = ImuNoise.per_sample(200.0, gyro=0.1, accelerometer=0.08)
    assert thesis.gyro == pytest.approx(expected.gyro)
    assert thesis.accelerometer == pytest.approx(expected.accelerometer)
    assert (thesis.gyro_bias, thesis.accelerometer_bias) == (1e-3, 1e-2)


def test_antenna_is_where_the_lever_puts_it():
    lever = (0.1, -0.2, 0.3)
    read = s.Gps(rate=10.0, lever=lever).sample(FLIGHT)
    motion = FLIGHT.at(read.time / 1e9)
    np.testing.assert_allclose(
        read.position - motion.position, g.rotate(motion.attitude, np.tile(lever, (len(motion), 1)), xp=np)
    )
    np.testing.assert_allclose(
        np.linalg.norm(read.position - motion.position, axis=-1), np.linalg.norm(lever)
    )


degrees = lambda most: st.floats(-most, most).map(math.radians)
places = st.tuples(degrees(90.0), degrees(180.0), st.floats(-10e3, 500e3))


@given(places, st.tuples(*[st.floats(-5e5, 5e5)] * 2, st.floats(-1e4, 1e5)))
def test_geodetic_there_and_back(origin, enu):
    back = s.to_enu(s.from_enu(np.array(enu), origin), origin)
    np.testing.assert_allclose(back, enu, atol=1e-6)


@given(places, places)
def test_geodetic_back_and_there(place, origin):
    latitude, longitude, height = s.from_enu(s.to_enu(np.array(place), origin), origin)
    assert latitude == pytest.approx(place[0], abs=1e-9)
    assert height == pytest.approx(place[2], abs=1e-6)
    around = math.remainder(longitude - place[1], 2 * math.pi)
    assert abs(around) * math.cos(latitude) < 1e-9  # at a pole any longitude is right


def test_geodetic_known_places():
    origin = (0.0, 0.0, 0.0)
    b = SEMI_MAJOR_AXIS * (1.0 - FLATTENING)
    pole = s.to_enu(np.array([math.pi / 2, 0.0, 0.0]), origin)  # Earth-fixed (0, 0, b), seen from (a, 0, 0)
    np.testing.assert_allclose(pole, [0.0, b, -SEMI_MAJOR_AXIS], atol=1e-6)
    assert b == pytest.approx(6356752.3142, abs=1e-4)
    origin = (math.radians(45.0), math.radians(7.0), 300.0)
    # one second of arc at 45 degrees: the radii of curvature are M = a (1 - e^2) / W^3 and N = a / W
    e2 = FLATTENING * (2.0 - FLATTENING)
    W = math.sqrt(1.0 - e2 / 2.0)
    second = math.radians(1.0 / 3600.0)
    north, east, up = s.to_enu(np.array(origin) + np.diag([second, second, 5.0]), origin)
    np.testing.assert_allclose(north, [0, second * (SEMI_MAJOR_AXIS * (1 - e2) / W**3 + 300), 0], atol=1e-3)
    np.testing.assert_allclose(east, [second * (SEMI_MAJOR_AXIS / W + 300) * math.sqrt(0.5), 0, 0], atol=1e-3)
    np.testing.assert_allclose(up, [0.0, 0.0, 5.0], atol=1e-8)


def test_gps_as_a_receiver_gives_it():
    read, origin = s.Gps(noise=s.Noise(deviation=1.0)).sample(FLIGHT), (0.8, 0.1, 400.0)
    geodetic = s.as_geodetic(read, origin)
    assert np.abs(geodetic.height - 400.0).max() < 10.0
    np.testing.assert_allclose(s.as_position(geodetic, origin).position, read.position, atol=1e-6)
    assert (geodetic.time == read.time).all()


def test_magnetometer_reads_the_field_in_the_body():
    sensor = s.Magnetometer(declination=0.3, dip=1.0, strength=50e-6)
    read = sensor.sample(FLIGHT)
    field = s.earth_field(0.3, 1.0, 50e-6)
    world = g.rotate(FLIGHT.at(read.time / 1e9).attitude, read.field, xp=np)
    np.testing.assert_allclose(world, np.tile(field, (len(world), 1)), atol=1e-18)
    assert math.atan2(field[0], field[1]) == pytest.approx(0.3)  # east of north
    assert math.asin(-field[2] / 50e-6) == pytest.approx(1.0)  # below the horizon


def test_altimeter_sees_the_ground_along_the_body():
    read = s.Altimeter().sample(FLIGHT)
    motion = FLIGHT.at(read.time / 1e9)
    foot = motion.position - g.rotate(motion.attitude, read.distance[:, None] * [0.0, 0.0, 1.0], xp=np)
    np.testing.assert_allclose(foot[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(read.distance, motion.position[:, 2] / motion.rotation[:, 2, 2], atol=1e-9)


def test_altimeter_is_silent_when_tilted_too_far_and_that_moves_no_draws():
    world = RoundTrip(angle=2.0)
    sensor = s.Altimeter(noise=s.Noise(deviation=0.1))
    read = sensor.sample(world)
    tilt = world.at(np.arange(1001) / 50.0).tilt
    assert len(read) == (tilt <= math.radians(75.0)).sum() < 1001
    assert np.isfinite(read.distance).all()
    wide = replace(sensor, most_tilt=math.pi).sample(world)
    shared = np.searchsorted(wide.time, read.time)
    assert same(read, wide[shared])
    assert len(wide) == (tilt < math.radians(89.9)).sum()


@pytest.mark.parametrize("world", [FLIGHT, RoundTrip()], ids=["flight", "turning"])
def test_optical_flow_composes_to_the_pose(world):
    read = s.OpticalFlowSensor().sample(world)
    start = world.at(0.0)
    p, q = start.position[0], start.attitude[0]
    for step in read:
        p = p + g.rotate(q, step.displacement, xp=np)
        q = g.multiply(q, step.turn, xp=np)
    end = world.at(read.time[-1:] / 1e9)
    np.testing.assert_allclose(p, end.position[0], atol=1e-9)
    np.testing.assert_allclose(q, end.attitude[0], atol=1e-9)
    assert read.time[0] == 50_000_000  # the first picture has none before it
    np.testing.assert_array_equal(read.interval, 0.05)


def test_fixed_latency_moves_arrival_and_keeps_the_stamp():
    sensor = s.PositionSensor(rate=10.0, phase=0.03, latency=0.25)
    late = sensor.record(FLIGHT)
    assert late.stamp[0] == 30_000_000
    assert (late.series.time - late.stamp == 250_000_000).all()
    np.testing.assert_array_equal(late.series.position, FLIGHT.at(late.stamp / 1e9).position)
    assert late.series.time[-1] <= 20_000_000_000  # what comes later is not in the recording
    assert len(late.stamp) == 198
    assert timing_of(late.series).period == 100_000_000


def test_gaussian_latency_arrives_in_order_of_arrival():
    sensor = s.PositionSensor(rate=100.0, latency=0.05, jitter=0.02)
    late = sensor.record(LONG, seed=2)
    assert (np.diff(late.series.time) > 0).all()
    delay = (late.series.time - late.stamp) * 1e-9
    assert delay.min() >= 0.0
    np.testing.assert_allclose([delay.mean(), delay.std()], [0.05, 0.02], rtol=0.05)
    assert (np.diff(late.stamp) < 0).any()  # one overtakes another
    assert len(set(late.stamp.tolist())) == len(late.stamp)


def test_arrivals_at_one_time_are_set_apart():
    crowd = s.PositionSensor(rate=1e9, latency=1e-9, jitter=5e-9).record(LONG, until=300)
    assert (np.diff(crowd.series.time) > 0).all()


@pytest.mark.parametrize("bad", [{"rate": 0.0}, {"latency": -1.0}, {"jitter": math.nan}, {"phase": -0.1}])
def test_a_clock_that_cannot_be_is_refused(bad):
    with pytest.raises(DeclarationError, match="this sensor has no such clock") as caught:
        s.Vicon(**bad)
    assert "vicon" in str(caught.value)


def test_negative_noise_is_refused():
    with pytest.raises(DeclarationError, match="noise cannot be negative"):
        s.Noise(density=-1.0)


def test_a_sensor_that_starts_after_the_end_reads_nothing():
    assert len(s.Vicon(phase=5.0).sample(Hover(), until="1s")) == 0
