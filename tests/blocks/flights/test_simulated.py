"""The simulated flight: its derivatives belong together, its noise is what it says, and it repeats."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import load_flight, simulate
from flowgraph.blocks.flights.figure import DEFAULTS
from flowgraph.blocks.flights.simulated import SETTINGS, load
from flowgraph.blocks.flights.worlds import OF_STEPS, SENSORS, TRIP
from flowgraph.blocks.geometry import rotations as g
from flowgraph.blocks.metrics import pose_errors
from flowgraph.blocks.sensors import as_position
from flowgraph.data.inputs import clocks_of
from flowgraph.errors import DeclarationError, UnknownNameError

QUIET: dict[str, str | float] = {
    f"{sensor}.{part}": 0.0 for sensor in ("gyro", "accelerometer") for part in ("noise", "walk", "bias")
}


def motion_of(seed: int, rate: float, duration: float = 20.0) -> dict[str, np.ndarray]:
    """The exact motion: what perfect sensors read, and the truth."""
    flight = load(seed=seed, settings={**QUIET, "imu.rate": rate, "duration": duration})
    imu, truth = flight.streams["imu"], flight.truth
    assert truth is not None
    assert not truth.gyro_bias.any()
    assert not truth.accelerometer_bias.any()
    parts = {name: truth[name] for name in ("position", "velocity", "attitude")}
    return {"seconds": imu.seconds, **parts, "rate": imu.gyro, "force": imu.specific_force}


@pytest.mark.parametrize("seed", range(3))
def test_derivatives_of_the_figure_belong_together(seed):
    h, motion = 1e-4, motion_of(seed, 1e4)
    now, before, after = ({n: x[k::50][:3990] for n, x in motion.items()} for k in (8, 7, 9))
    assert np.abs(now["seconds"][:, None] - [1.0, 3.0]).min() > 2 * h, "the snap jumps there"
    slope = lambda name: (after[name] - before[name]) / (2 * h)
    np.testing.assert_allclose(now["velocity"], slope("position"), atol=1e-6)
    world_force = g.rotate(now["attitude"], now["force"], xp=np)
    np.testing.assert_allclose(world_force, slope("velocity") + np.array([0.0, 0.0, 9.81]), atol=1e-5)
    turn = g.multiply(g.conjugate(before["attitude"], xp=np), after["attitude"], xp=np)
    np.testing.assert_allclose(now["rate"], g.to_rotation_vector(turn, xp=np) / (2 * h), atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_it_starts_at_rest_and_then_moves_briskly_but_upright(seed):
    motion = motion_of(seed, 100.0)
    assert np.abs(motion["velocity"][:100]).max() == 0.0
    assert np.abs(motion["rate"][:100]).max() == 0.0
    np.testing.assert_allclose(motion["position"][0], 0.0, atol=1e-12)
    acceleration = g.rotate(motion["attitude"], motion["force"], xp=np) - [0.0, 0.0, 9.81]
    assert 2.0 < np.linalg.norm(acceleration, axis=-1).max() < 15.0
    assert g.to_matrix(motion["attitude"], xp=np)[:, 2, 2].min() > 0.3
    steps = np.einsum("ni,ni->n", motion["attitude"][1:], motion["attitude"][:-1])
    assert steps.min() > 0.9  # the sign of the quaternion does not jump


def test_a_flight_is_a_run_of_its_graph_whatever_it_is_called():
    flight = load(seed=4, settings={"duration": 2.0, "vicon.rate": 3.0})
    world = flight.experiment
    assert world is not None
    built = world.world.build(**clocks_of(world.ticks), **world.settings)
    run = simulate(built, world.ticks, engine="reference", seed=4)
    for name in ("", "quadrotor", "figure"):
        same = load(name, seed=4, settings={"duration": 2.0, "vicon.rate": 3.0})
        assert same.name == "sim-4"
        for stream, series in {**same.streams, "truth": same.truth}.items():
            assert series is not None
            np.testing.assert_array_equal(series.time, run[stream].time)
            for leaf, values in series.leaves.items():
                np.testing.assert_allclose(values, run[stream][leaf], rtol=1e-9, atol=1e-9)


def test_streams_have_their_rates_and_integer_times():
    flight = load(settings={"duration": "3", "imu.rate": 100, "vicon.rate": 10.0})
    imu, vicon = flight.streams["imu"], flight.streams["vicon"]
    assert imu.time.dtype == np.int64
    assert len(imu) == 301
    assert set(np.diff(imu.time)) == {10_000_000}
    assert set(np.diff(vicon.time)) == {100_000_000}
    assert flight.truth is not None
    assert (flight.truth.time == imu.time).all()


def test_noise_is_what_the_settings_say():
    flight = load(seed=5, settings={"duration": 100.0})
    imu, truth = flight.streams["imu"], flight.truth
    assert truth is not None
    motion = motion_of(5, 200.0, 100.0)
    white = imu.gyro - motion["rate"] - truth.gyro_bias
    np.testing.assert_allclose(white.std() / np.sqrt(200.0), DEFAULTS["gyro.noise"], rtol=0.02)
    steps = np.diff(truth.accelerometer_bias, axis=0)
    np.testing.assert_allclose(steps.std() * np.sqrt(200.0), DEFAULTS["accelerometer.walk"], rtol=0.02)
    errors = pose_errors(flight.streams["vicon"], truth, settle=0.0)
    np.testing.assert_allclose(errors["position_rmse_m"], np.sqrt(3) * 0.01, rtol=0.1)
    np.testing.assert_allclose(errors["attitude_rmse_deg"], np.degrees(np.sqrt(3) * 0.01), rtol=0.1)


def test_a_seed_repeats_and_settings_do_not_move_other_draws():
    first, again, other = load(seed=1), load(seed=1), load(seed=2)
    assert (first.streams["imu"].gyro == again.streams["imu"].gyro).all()
    assert (first.streams["imu"].gyro != other.streams["imu"].gyro).any()
    quiet = load(seed=1, settings={"accelerometer.noise": 0.0, "position.noise": 0.0})
    assert (quiet.streams["imu"].gyro == first.streams["imu"].gyro).all()
    assert (quiet.streams["vicon"].attitude == first.streams["vicon"].attitude).all()


def test_unknown_names_list_the_valid_ones():
    with pytest.raises(UnknownNameError, match=r"vicon\.rate"):
        load(settings={"vicon_rate": 3})
    with pytest.raises(UnknownNameError, match="quadrotor"):
        load("helicopter")


@pytest.mark.parametrize("value", ["fast", "nan", "-1", "0", float("inf")])
def test_bad_settings_are_refused(value):
    with pytest.raises(DeclarationError, match=r"setting 'imu\.rate' is not usable") as caught:
        load(settings={"imu.rate": value})
    assert "positive number" in str(caught.value)
    assert "imu.rate=200" in str(caught.value)


# Through the simulated world.

KINDS = ["thesis", "roundtrip", "hover"]


@pytest.mark.parametrize("kind", KINDS)
def test_worlds_give_a_flight_with_the_usual_streams(kind):
    flight = load_flight(f"sim:{kind}", seed=2, settings={"duration": "8"})
    assert set(flight.streams) == {"imu", "vicon"}
    assert len(flight.streams["imu"]) == 1601
    assert len(flight.streams["vicon"]) == 33
    assert flight.truth is not None
    assert (flight.truth.time == flight.streams["imu"].time).all()
    density = TRIP["gyro.noise"] if kind == "roundtrip" else np.sqrt(0.1 / 200.0)
    np.testing.assert_allclose(flight.info["imu_noise"].gyro, density)
    assert flight.info["position_noise"] == flight.info["attitude_noise"] == 0.1
    assert "RMS acceleration" in flight.notes[0]
    errors = pose_errors(flight.streams["vicon"], flight.truth, settle=0.0)
    np.testing.assert_allclose(errors["position_rmse_m"], np.sqrt(3) * 0.1, rtol=0.4)


def test_every_sensor_has_a_stream_and_settings():
    flight = load("thesis", settings={"sensors": "all", "duration": 4.0})
    assert list(flight.streams) == list(SENSORS)
    assert {f"{n}.{k}" for n, parts in SENSORS.items() for k in parts} <= set(SETTINGS)
    assert set(DEFAULTS) <= set(SETTINGS)
    for name, parts in SENSORS.items():
        own = {key.partition(".")[2]: value for key, value in OF_STEPS.items() if key.startswith(f"{name}.")}
        assert flight.info["noise"][name] == {**parts, **own}
        assert flight.info[f"{name}_period_ns"] == round(1e9 / parts["rate"])


def test_streams_do_not_disturb_each_other():
    alone = load("thesis", seed=3, settings={"sensors": "vicon"})
    among = load("thesis", seed=3, settings={"sensors": "gps,vicon,imu", "gps.noise": 5, "imu.rate": 100})
    assert (alone.streams["vicon"].attitude == among.streams["vicon"].attitude).all()
    biased = {"gyro.noise": 0, "accelerometer.noise": 0, "gyro.bias": 0.1, "accelerometer.walk": 0.1}
    together = load("thesis", seed=3, settings={"imu.oversample": 1, **biased})
    apart = load("thesis", seed=3, settings={"sensors": "gyro,accelerometer", "gyro.turn": 0, **biased})
    close = lambda a, b: np.testing.assert_allclose(a, b, atol=1e-12)  # a body has one bias of each kind
    close(apart.streams["gyro"].rate, together.streams["imu"].gyro)
    close(apart.streams["accelerometer"].force, together.streams["imu"].specific_force)


def test_truth_has_the_biases_of_the_readings():
    quiet = {"gyro.noise": 0.0, "accelerometer.noise": 0.0}
    wrong = {"gyro.bias": 0.1, "gyro.walk": 0.01, "accelerometer.bias": 0.2, "imu.phase": 0.01}
    wrong["imu.oversample"] = 1
    given: dict[str, str | float] = {"imu.rate": "50", "sensors": "imu,thrust", **quiet, **wrong}
    flight = load("thesis", seed=4, settings=given)
    imu, truth = flight.streams["imu"], flight.truth
    assert truth is not None
    assert (np.diff(truth.time) == 5_000_000).all()  # those of the fastest sensor
    rows = np.searchsorted(truth.time, imu.time)
    motion = flight.info["world"].at(imu.time / 1e9)
    np.testing.assert_allclose(imu.gyro - motion.rate, truth.gyro_bias[rows], atol=1e-12)
    push = imu.specific_force - motion.specific_force
    np.testing.assert_allclose(push, truth.accelerometer_bias[rows], atol=1e-12)
    assert np.ptp(truth.gyro_bias[:, 0]) > 0.0
    assert np.ptp(truth.accelerometer_bias[:, 0]) == 0.0


def test_late_sensors_tell_their_stamps():
    late: dict[str, str | float] = {"sensors": "imu,gps", "gps.latency": "0.3", "gps.jitter": 0.05}
    late["gps.lever_x"] = "-0.2"
    flight = load("thesis", seed=1, settings=late)
    gps, stamp = flight.streams["gps"], flight.info["stamps"]["gps"]
    assert set(flight.info["stamps"]) == {"gps"}
    assert len(stamp) == len(gps)
    assert abs(np.mean(gps.time - stamp) * 1e-9 - 0.3) < 0.03
    assert flight.info["gps_lever"] == (-0.2, 0.0, 0.0)


def test_worlds_take_their_settings():
    assert load("hover", settings={"drift": "0.2", "duration": 60}).info["still"] == 0.0
    assert load("hover", settings={"duration": 60}).info["still"] == 60.0
    trip = load("roundtrip", settings={"angle": -0.5, "rest": 2})
    assert trip.info["still"] == 2.0
    assert trip.info["world"].angle == -0.5
    tame = load("thesis", settings={"most_thrust": 25}).info["world"]
    assert tame.at(np.arange(0.0, 20.0, 0.01)).thrust.max() <= 25.0


def test_worlds_refuse_what_they_do_not_know():
    with pytest.raises(UnknownNameError, match=r"no setting is called 'gps\.lag'") as caught:
        load("thesis", settings={"sensors": "imu,gps", "gps.lag": 1})
    assert "gps.latency" in str(caught.value)
    with pytest.raises(UnknownNameError, match="no sensor is called 'lidar'"):
        load("thesis", settings={"sensors": "imu,lidar"})
    with pytest.raises(UnknownNameError, match="no setting is called 'drift'"):
        load("thesis", settings={"drift": 1})
    with pytest.raises(
        DeclarationError, match=r"setting 'gps\.rate' is of a sensor that this flight does not"
    ) as bad:
        load("thesis", settings={"gps.rate": 1})
    assert "sensors=imu,vicon,gps" in str(bad.value)
    with pytest.raises(DeclarationError, match="a flight needs a sensor"):
        load("thesis", settings={"sensors": " , "})
    with pytest.raises(DeclarationError, match="the thesis's flights are shorter"):
        load("thesis", settings={"duration": 30})


@pytest.mark.parametrize(
    ("name", "value"), [("vicon.rate", "0"), ("vicon.noise", "-1"), ("imu.latency", "x")]
)
def test_worlds_refuse_bad_numbers(name, value):
    with pytest.raises(DeclarationError, match=f"setting '{name}' is not usable") as caught:
        load("hover", settings={name: value})
    assert f"{name}=" in str(caught.value)


def test_an_oversampled_gyroscope_reads_the_turn_since_its_last_reading():
    """Also where the rate jumps, at 1 s; and the noise is that of the reading, as before."""
    quiet: dict[str, str | float] = {"gyro.noise": 0.0, "duration": 2.0}
    flight = load("thesis", seed=1, settings={**quiet, "imu.oversample": 20})
    assert flight.truth is not None
    q = flight.truth["attitude"]
    turn = g.to_rotation_vector(g.multiply(g.conjugate(q[:-1], xp=np), q[1:], xp=np), xp=np)
    read = load("thesis", seed=1, settings={**quiet, "sensors": "gyro"}).streams["gyro"].rate
    np.testing.assert_allclose(read[1:], turn * 200.0, atol=1e-9)
    np.testing.assert_array_equal(read[0], 0.0)  # before the world begins, it stands still
    apart = {n: np.abs(load("thesis", seed=1, settings={**quiet, "imu.oversample": n}).streams["imu"].gyro[1:]
                       - turn * 200.0).max() for n in (1, 20)}  # fmt: skip
    assert apart[20] < 0.02 < 1.0 < apart[1]
    one, many = (load("hover", settings={"imu.oversample": n}).streams["imu"].gyro for n in (1, 20))
    np.testing.assert_allclose(one, many, atol=1e-12)
    with pytest.raises(DeclarationError, match="'imu.oversample' is not usable"):
        load("hover", settings={"imu.oversample": 1.5})


@pytest.mark.parametrize("sensor", ["gyro", "body_rate"])
def test_a_rate_may_be_that_of_the_turn_since_the_last_reading(sensor):
    """Whatever the rate of the sensor, and also where it is late and oversamples: q' = q Exp(w T)."""
    settings = {"sensors": sensor, "duration": 3.0, f"{sensor}.noise": 0.0, f"{sensor}.rate": 40.0}
    flight = load("thesis", seed=2, settings={**settings, f"{sensor}.latency": 0.03})
    world, stamp = flight.info["world"], flight.info["stamps"][sensor][1:] / 1e9
    before, now = (world.at(t).attitude for t in (stamp - 0.025, stamp))
    ahead = g.multiply(before, g.from_rotation_vector(flight.streams[sensor].rate[1:] * 0.025, xp=np), xp=np)
    np.testing.assert_allclose(np.abs((ahead * now).sum(-1)), 1.0, atol=1e-12)
    instant = load("thesis", seed=2, settings={**settings, f"{sensor}.turn": 0}).streams[sensor]
    np.testing.assert_allclose(instant.rate, world.at(instant.time / 1e9).rate, atol=1e-12)
    with pytest.raises(DeclarationError, match=f"'{sensor}.turn' is not usable"):
        load("thesis", settings={"sensors": sensor, f"{sensor}.turn": 2})


def test_motion_capture_and_optical_flow_have_biases():
    for sensor, leaf in (("vicon", "position"), ("optical_flow", "displacement")):
        plain: dict[str, str | float] = {
            "sensors": sensor,
            f"{sensor}.noise": 0.0,
            f"{sensor}.attitude_noise": 0.0,
        }
        a, b = (load("hover", settings={**plain, **more}).streams[sensor][leaf]
                for more in ({}, {f"{sensor}.bias": 1.0}))  # fmt: skip
        np.testing.assert_allclose(b - a, np.broadcast_to((b - a)[0], b.shape), atol=1e-12)
        assert np.abs(b - a).max() > 0.1
        walks = load("hover", settings={**plain, f"{sensor}.attitude_walk": 0.1}).streams[sensor]
        assert np.ptp(walks["attitude" if sensor == "vicon" else "turn"], axis=0).max() > 0.01


def test_a_gps_gives_geodetic_positions_on_request():
    given: dict[str, str | float] = {"sensors": "gps", "gps.latitude": 0.8, "gps.longitude": -1.2}
    enu = load("thesis", settings=given).streams["gps"]
    flight = load("thesis", settings={**given, "gps.geodetic": 1})
    assert flight.info["gps_origin"] == (0.8, -1.2, 0.0)
    back = as_position(flight.streams["gps"], flight.info["gps_origin"])
    np.testing.assert_allclose(back["position"], enu["position"], atol=1e-6)
    with pytest.raises(DeclarationError, match="'gps.geodetic' is not usable"):
        load("thesis", settings={"sensors": "gps", "gps.geodetic": 2})


def test_a_late_sensor_is_noted_with_how_far_the_body_has_gone():
    note = load("thesis", settings={"vicon.latency": 0.05}).notes[1]
    assert "vicon arrives 50.0 ms late" in note
    assert " m and " in note
    assert len(load("thesis").notes) == 1
