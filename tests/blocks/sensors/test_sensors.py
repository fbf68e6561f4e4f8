"""Sensors of the simulated worlds: what they read, how wrong, when it arrives; none disturbs another."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flowgraph import Flight, Series, simulate, timing_of
from flowgraph.blocks import sensors as s
from flowgraph.blocks.flights.sensed import sensed
from flowgraph.blocks.flights.worlds import SENSORS, load_world
from flowgraph.blocks.geometry import FLATTENING, SEMI_MAJOR_AXIS
from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.world import Motion
from flowgraph.data.inputs import clocks_of


def fly(sensors: str, *, world: str = "thesis", seed: int = 5, noisy: bool = False, **given: Any) -> Flight:
    """A flight with sensors that are perfect, but for what is given; NAME__PART stands for NAME.PART."""
    parts = {
        name: SENSORS[name]
        for name in (*sensors.split(","), *(("gyro", "accelerometer") if "imu" in sensors else ()))
    }
    quiet: dict[str, Any] = {
        f"{name}.{part}": 0.0 for name, own in parts.items() for part in own if part.endswith("noise")
    }
    instant = {
        f"{n}.{part}": v for n in parts for part, v in (("turn", 0), ("oversample", 1)) if part in SENSORS[n]
    }
    biased = {"gyro.bias": 0.0} if world == "roundtrip" and "gyro" in parts else {}
    told: dict[str, Any] = {name.replace("__", "."): value for name, value in given.items()}
    start = {} if noisy else quiet
    return load_world(world, seed=seed, settings={"sensors": sensors, **start, **instant, **biased, **told})


def motion_at(flight: Flight, time: np.ndarray) -> Motion:
    return flight.info["world"].at(time / 1e9)  # type: ignore[no-any-return]


def one(name: str, **given: Any) -> tuple[Series, Motion]:
    """The readings of one sensor and the motion at their times."""
    flight = fly(name, **given)
    series = flight.streams[name]
    return series, motion_at(flight, series.time)


def same(a: Series, b: Series) -> bool:
    return all((a.leaves[name] == b.leaves[name]).all() for name in a.leaves)


def test_without_noise_each_reads_the_truth() -> None:
    gyro, motion = one("gyro")
    np.testing.assert_allclose(gyro["rate"], motion.rate, atol=1e-12)
    force, motion = one("accelerometer")
    world = g.rotate(motion.attitude, force["force"], xp=np)
    np.testing.assert_allclose(world, motion.acceleration + np.array([0.0, 0.0, 9.81]), atol=1e-10)
    coordinate, motion = one("coordinate_acceleration")
    world = g.rotate(motion.attitude, coordinate["acceleration"], xp=np)
    np.testing.assert_allclose(world, motion.acceleration, atol=1e-10)
    imu, _ = one("imu")
    np.testing.assert_allclose(imu["gyro"], gyro["rate"], atol=1e-12)
    np.testing.assert_allclose(imu["specific_force"], force["force"], atol=1e-12)
    vicon, motion = one("vicon")
    np.testing.assert_allclose(vicon["position"], motion.position, atol=1e-12)
    np.testing.assert_allclose(vicon["attitude"], motion.attitude, atol=1e-12)
    thrust, motion = one("thrust")
    np.testing.assert_allclose(thrust["thrust"], force["force"][:, 2], atol=1e-12)
    # the thesis's way to the vertical: thrust less the coordinate acceleration is gravity in the body
    up = thrust["thrust"][:, None] * [0.0, 0.0, 1.0] - coordinate["acceleration"]
    vertical = g.rotate(motion.attitude, up, xp=np)
    np.testing.assert_allclose(vertical, [[0.0, 0.0, 9.81]] * len(up), atol=1e-9)


@pytest.mark.parametrize("name", SENSORS)
def test_a_seed_repeats_and_the_name_chooses_the_draws(name: str) -> None:
    wrong: dict[str, Any] = {
        f"{name}__{part}": 0.1 for part in SENSORS[name] if part.endswith(("noise", "bias", "walk"))
    }
    wrong = wrong or {
        f"{part}__{what}": 0.1 for part in ("gyro", "accelerometer") for what in ("noise", "bias", "walk")
    }
    common: dict[str, Any] = {"world": "hover", "noisy": True, "duration": 2, **wrong}
    first = fly(name, seed=3, **common).streams[name]
    assert first.name == name
    assert same(first, fly(name, seed=3, **common).streams[name])
    assert not same(first, fly(name, seed=4, **common).streams[name])
    # one that trembles draws its latency apart
    trembling: dict[str, Any] = {f"{name}__latency": 0.02, f"{name}__jitter": 0.001}
    late = fly(name, seed=3, **common, **trembling)
    rows = np.searchsorted(first.time, late.info["stamps"][name])
    assert same(late.streams[name], first[rows])
    pairs = {"gps": "gps2", "attitude": "magnetic_attitude"}
    if name in pairs:
        twin = pairs[name]
        more: dict[str, Any] = {f"{twin}__rate": SENSORS[name]["rate"], f"{twin}__noise": 0.1}
        both = fly(f"{name},{twin}", seed=3, **common, **more)
        assert same(first, both.streams[name])
        assert not same(first, both.streams[twin])


def test_a_short_recording_is_the_beginning_of_a_long_one() -> None:
    wrong: dict[str, Any] = {"gyro__noise": 0.01, "gyro__bias": 0.1, "gyro__walk": 0.01}
    long, short = (fly("gyro", duration=until, **wrong).streams["gyro"] for until in (20, 5))
    assert len(short) == 1001
    assert same(short, long[:1001])


def test_white_noise_bias_and_walk_are_what_they_say() -> None:
    still: dict[str, Any] = {"world": "hover", "duration": 500, "seed": 1}
    white = one("gyro", gyro__noise=0.02, **still)[0]["rate"]
    np.testing.assert_allclose(white.std(0), 0.02 * math.sqrt(200.0), rtol=0.02)
    assert np.abs(white.mean(0)).max() < 5 * white.std() / math.sqrt(len(white))
    whiteness = [np.corrcoef(white[1:, i], white[:-1, i])[0, 1] for i in range(3)]
    assert np.abs(whiteness).max() < 0.02
    slow = one("gyro", gyro__noise=0.02, gyro__rate=50, **still)[0]["rate"]
    np.testing.assert_allclose(slow.std(), 0.02 * math.sqrt(50.0), rtol=0.02)
    walk = one("position", position__walk=0.3, position__rate=10, **still)[0]["position"]
    np.testing.assert_allclose(np.diff(walk, axis=0).std(), 0.3 * math.sqrt(0.1), rtol=0.03)
    short: dict[str, Any] = {"world": "hover", "duration": 0.1, "position__bias": 0.5}
    starts = [one("position", seed=k, **short)[0]["position"][0] - [0.0, 0.0, 1.0] for k in range(300)]
    np.testing.assert_allclose(np.std(starts, axis=0), 0.5, rtol=0.15)
    assert np.abs(np.mean(starts, axis=0)).max() < 4 * 0.5 / math.sqrt(300)


def test_attitude_noise_turns_the_body() -> None:
    read, truth = one("attitude", world="roundtrip", duration=300, attitude__rate=50, attitude__noise=0.1)
    error = g.to_rotation_vector(
        g.multiply(g.conjugate(truth.attitude, xp=np), read["attitude"], xp=np), xp=np
    )
    np.testing.assert_allclose(error.std(0), 0.1, rtol=0.03)
    np.testing.assert_allclose(np.linalg.norm(read["attitude"], axis=-1), 1.0)


def test_an_inertial_unit_tells_its_densities() -> None:
    given: dict[str, Any] = {
        "gyro__noise": 0.02,
        "gyro__walk": 1e-3,
        "accelerometer__noise": 0.03,
        "accelerometer__walk": 1e-2,
    }
    assert fly("imu", duration=0.1, **given).info["imu_noise"] == ImuNoise(0.02, 0.03, 1e-3, 1e-2)


@pytest.mark.parametrize("turn", [False, True])
def test_readings_over_a_time_are_means_of_looks_and_turns(turn: bool) -> None:
    """Against the motion at the looks; before it begins the world stands still."""
    over: dict[str, Any] = {
        "gyro__turn": float(turn),
        "gyro__oversample": 4,
        "coordinate_acceleration__oversample": 4,
    }
    sensors = "gyro,coordinate_acceleration,accelerometer"
    flight = fly(sensors, accelerometer__oversample=4, **over)
    time = flight.streams["gyro"].time
    ago = (np.arange(4)[::-1] + 0.5) / 4 * 5e6
    looks = motion_at(flight, np.maximum(time[:, None] - ago, 0.0).ravel())
    mean = lambda x: x.reshape(-1, 4, 3).mean(1)
    now, before = motion_at(flight, time), motion_at(flight, np.maximum(time - 5_000_000, 0))
    turned = g.to_rotation_vector(g.multiply(g.conjugate(before.attitude, xp=np), now.attitude, xp=np), xp=np)
    rate = turned / 0.005 if turn else mean(looks.rate)
    np.testing.assert_allclose(flight.streams["gyro"]["rate"], rate, atol=1e-9)
    np.testing.assert_allclose(
        flight.streams["accelerometer"]["force"], mean(looks.specific_force), atol=1e-9
    )
    seen = flight.streams["coordinate_acceleration"]["acceleration"]
    np.testing.assert_allclose(seen, mean(looks.coordinate_acceleration), atol=1e-9)


def test_antenna_is_where_the_lever_puts_it() -> None:
    lever = (0.1, -0.2, 0.3)
    arm: dict[str, Any] = {f"gps__lever_{axis}": value for axis, value in zip("xyz", lever, strict=True)}
    read, motion = one("gps", gps__rate=10, **arm)
    apart = read["position"] - motion.position
    np.testing.assert_allclose(
        apart, g.rotate(motion.attitude, np.tile(lever, (len(motion), 1)), xp=np), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.norm(apart, axis=-1), np.linalg.norm(lever))


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


def test_gps_as_a_receiver_gives_it() -> None:
    read, origin = one("gps", gps__noise=1.0)[0], (0.8, 0.1, 400.0)
    earth: dict[str, Any] = {
        "gps__latitude": 0.8,
        "gps__longitude": 0.1,
        "gps__height": 400.0,
        "gps__geodetic": 1,
    }
    geodetic = one("gps", gps__noise=1.0, **earth)[0]
    assert np.abs(geodetic["height"] - 400.0).max() < 10.0
    np.testing.assert_allclose(s.as_position(geodetic, origin)["position"], read["position"], atol=1e-6)
    for leaf, values in s.as_geodetic(read, origin).leaves.items():
        np.testing.assert_allclose(geodetic[leaf], values, rtol=1e-12)


def test_magnetometer_reads_the_field_in_the_body() -> None:
    given: dict[str, Any] = {
        "magnetometer__declination": 0.3,
        "magnetometer__dip": 1.0,
        "magnetometer__strength": 50e-6,
    }
    read, motion = one("magnetometer", **given)
    field = s.earth_field(0.3, 1.0, 50e-6)
    world = g.rotate(motion.attitude, read["field"], xp=np)
    np.testing.assert_allclose(world, np.tile(field, (len(world), 1)), atol=1e-18)
    assert math.atan2(field[0], field[1]) == pytest.approx(0.3)  # east of north
    assert math.asin(-field[2] / 50e-6) == pytest.approx(1.0)  # below the horizon


def test_altimeter_sees_the_ground_along_the_body() -> None:
    read, motion = one("altimeter")
    foot = motion.position - g.rotate(motion.attitude, read["distance"][:, None] * [0.0, 0.0, 1.0], xp=np)
    np.testing.assert_allclose(foot[:, 2], 0.0, atol=1e-9)
    np.testing.assert_allclose(read["distance"], motion.position[:, 2] / motion.rotation[:, 2, 2], atol=1e-9)


def test_altimeter_is_silent_when_tilted_too_far_and_that_moves_no_draws() -> None:
    given: dict[str, Any] = {"world": "roundtrip", "angle": 2, "altimeter__noise": 0.1, "altimeter__rate": 50}
    flight = fly("altimeter", **given)
    read = flight.streams["altimeter"]
    tilt = motion_at(flight, np.arange(1001) * 20_000_000).tilt
    assert len(read) == (tilt <= math.radians(75.0)).sum() < 1001
    assert np.isfinite(read["distance"]).all()
    wide = fly("altimeter", altimeter__most_tilt=math.pi, **given).streams["altimeter"]
    shared = np.searchsorted(wide.time, read.time)
    assert same(read, wide[shared])
    assert len(wide) == (tilt < math.radians(89.9)).sum()


@pytest.mark.parametrize("world", ["thesis", "roundtrip"])
def test_optical_flow_composes_to_the_pose(world: str) -> None:
    flight = fly("optical_flow", world=world)
    read = flight.streams["optical_flow"]
    start, end = (motion_at(flight, np.array([t])) for t in (0, read.time[-1]))
    p, q = start.position[0], start.attitude[0]
    for step in read:
        p = p + g.rotate(q, step.displacement, xp=np)
        q = g.multiply(q, step.turn, xp=np)
    np.testing.assert_allclose(p, end.position[0], atol=1e-9)
    np.testing.assert_allclose(q, end.attitude[0], atol=1e-9)
    assert read.time[0] == 50_000_000  # the first picture has none before it
    np.testing.assert_allclose(read["interval"], 0.05, rtol=1e-12)


def test_fixed_latency_moves_arrival_and_keeps_the_stamp() -> None:
    flight = fly("position", position__rate=10, position__phase=0.03, position__latency=0.25)
    late, stamp = flight.streams["position"], flight.info["stamps"]["position"]
    assert stamp[0] == 30_000_000
    assert (late.time - stamp == 250_000_000).all()
    np.testing.assert_allclose(late["position"], motion_at(flight, stamp).position, atol=1e-12)
    assert late.time[-1] <= 20_000_000_000  # what comes later is not in the recording
    assert len(stamp) == 198
    assert timing_of(late).period == 100_000_000


def test_a_late_inertial_unit_reads_what_was() -> None:
    late = fly("imu", imu__latency=0.03, imu__oversample=5, gyro__noise=0.0)
    fresh = fly("imu", imu__oversample=5)
    a, b = late.streams["imu"], fresh.streams["imu"]
    rows = np.searchsorted(b.time, late.info["stamps"]["imu"])
    np.testing.assert_allclose(a["gyro"], b["gyro"][rows], atol=1e-9)
    np.testing.assert_allclose(a["specific_force"], b["specific_force"][rows], atol=1e-9)


def test_gaussian_latency_arrives_in_order_of_arrival() -> None:
    trembles: dict[str, Any] = {"position__latency": 0.05, "position__jitter": 0.02, "position__rate": 100}
    flight = fly("position", world="hover", duration=500, **trembles)
    late, stamp = flight.streams["position"], flight.info["stamps"]["position"]
    assert (np.diff(late.time) > 0).all()
    delay = (late.time - stamp) * 1e-9
    assert delay.min() >= 0.0
    np.testing.assert_allclose([delay.mean(), delay.std()], [0.05, 0.02], rtol=0.05)
    assert (np.diff(stamp) < 0).any()  # one overtakes another
    assert len(set(stamp.tolist())) == len(stamp)
    assert flight.experiment is None, "when its readings arrive no graph can draw"


def test_arrivals_at_one_time_are_set_apart() -> None:
    trembles: dict[str, Any] = {"position__latency": 1e-9, "position__jitter": 5e-9, "position__rate": 1e9}
    crowd = fly("position", world="hover", duration=3e-7, **trembles).streams["position"]
    assert len(crowd) > 200
    assert (np.diff(crowd.time) > 0).all()


def test_a_sensor_that_starts_after_the_end_reads_nothing() -> None:
    flight = fly("vicon,imu", world="hover", duration=1, vicon__phase=5)
    assert len(flight.streams["vicon"]) == 0
    assert len(flight.streams["imu"]) == 201


EVERYTHING: dict[str, Any] = {
    "gyro__bias": 0.1, "gyro__walk": 0.01, "accelerometer__walk": 0.1, "vicon__latency": 0.0375,
    "vicon__attitude_bias": 0.1, "gps__walk": 0.1, "gps2__geodetic": 1, "altimeter__bias": 0.1,
    "magnetometer__bias": 1e-6, "optical_flow__walk": 0.1, "imu__oversample": 3, "body_rate__turn": 1,
    "thrust__phase": 0.01, "duration": 1.5,
}  # fmt: skip


@pytest.mark.parametrize("engine", ["numpy", "python", "c", pytest.param("xla", marks=pytest.mark.slow)])
@pytest.mark.parametrize("world", ["hover", "roundtrip", "thesis"])
def test_a_flight_in_a_graph_is_what_was_recorded(world: str, engine: str) -> None:
    more: dict[str, Any] = {"hover": {"drift": 0.2}, "roundtrip": {"rest": 0.1, "trip": 0.6}, "thesis": {}}[
        world
    ]
    flight = fly(",".join(SENSORS), world=world, seed=7, noisy=True, **EVERYTHING, **more)
    made_by = flight.experiment
    assert made_by is not None
    inputs = {**made_by.ticks, **made_by.given(7)}
    if engine == "xla":
        pytest.importorskip("jax")
    sizes = {"n": made_by.settings["world"].numbers}
    built = sensed.build(**clocks_of(inputs), **made_by.settings, sizes=sizes)
    found = simulate(built, inputs, engine=engine, seed=7)
    for name, series in {**flight.streams, "truth": flight.truth}.items():
        assert series is not None
        np.testing.assert_array_equal(found[name].time, series.time, err_msg=name)
        for leaf, values in series.leaves.items():
            if engine == "numpy":
                np.testing.assert_array_equal(found[name][leaf], values, err_msg=f"{name}.{leaf}")
            np.testing.assert_allclose(
                found[name][leaf], values, rtol=1e-9, atol=1e-9, err_msg=f"{name}.{leaf}"
            )
