"""gnss_ins: any of its sensors, from any start, in every engine; how good it is, on drives and on real
flights."""

from __future__ import annotations

import functools
import itertools
import shutil
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowgraph import Flight, Series, load_flight, simulate
from flowgraph.blocks.flights.drive import SENSORS
from flowgraph.blocks.geometry.rotations import conjugate, multiply, rotate, to_matrix, to_rotation_vector
from flowgraph.blocks.inertial.outdoors import Antenna
from flowgraph.blocks.outdoor.errors import at_antenna, directed_errors
from flowgraph.blocks.scoring.outdoors import declination
from flowgraph.blocks.signals import GeodeticPosition, Position
from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from flowgraph.graphs.benches.drives import drives
from flowgraph.graphs.benches.outdoor import outdoor
from flowgraph.graphs.gnss_ins import gnss_ins
from tests.blocks.inertial.test_outdoors import moved
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn
from tests.recordings import recordings


def streams_of(flight: Flight) -> Mapping[str, Any]:
    """The streams that the graph has of a flight."""
    found = gnss_ins.case(flight).inputs
    assert isinstance(found, Mapping)
    return found


@functools.cache
def drive(seconds: float = 3.0, sensors: str = ",".join(SENSORS), seed: int = 1, **settings: str) -> Flight:
    named = {k.replace("__", "."): v for k, v in settings.items()}
    return load_flight(
        "sim:drive", seed=seed, settings={"duration": f"{seconds}", "sensors": sensors, **named}
    )


def scored(flight: Flight, **settings: Any) -> dict[str, float]:
    case = gnss_ins.case(flight, **settings)
    return dict(case.score(simulate(case.graph, case.inputs)))


SUBSETS = [s for k in range(len(SENSORS) + 1) for s in itertools.combinations(SENSORS, k)]
FEW = [(), *((name,) for name in SENSORS), SENSORS, ("gps", "wheels"), ("gps_velocity", "barometer")]


@pytest.mark.parametrize(
    "sensors", [pytest.param(s, marks=() if s in FEW else pytest.mark.slow) for s in SUBSETS], ids="+".join
)
def test_any_of_its_sensors_may_be_absent(sensors):
    """The graph builds and runs with every subset, and each that is there is heard and told."""
    flight = drive(imu__rate="25")
    given = {name: flight.streams[name] for name in ("imu", *sensors)}
    case = gnss_ins.case(replace(flight, streams=given))
    result = simulate(case.graph, case.inputs)
    heard = {n.removesuffix("_innovation") for n in result.series if n.endswith("innovation")}
    assert heard == {{"gps": "gnss", "gps_velocity": "gnss_velocity"}.get(s, s) for s in sensors}
    assert np.isfinite(result["belief"]["covariance"]).all()
    assert all(len(result[f"{name}_innovation"]) for name in heard)


def late(series: Series) -> Series:
    return Series(series.time + 30_000_000, series.values, name=series.name)


def dropped(series: Series) -> Series:
    return series[np.arange(len(series)) % 3 != 1]


def repeated(series: Series) -> Series:
    """Every reading comes again 20 ms later, as some drivers send it."""
    rows = np.repeat(np.arange(len(series)), 2)
    time = np.repeat(series.time, 2)
    time[1::2] += 20_000_000
    return Series(time, series[rows].values, name=series.name)


@pytest.mark.parametrize("fault", [late, dropped, repeated], ids=lambda f: f.__name__)
def test_sensors_may_be_late_dropped_or_repeated(fault):
    """All of them; the drive is 8 s, of which 5 are on the way."""
    flight = drive(8.0, imu__rate="25", gps__rate="5")
    streams = {n: s if n == "imu" else fault(s) for n, s in flight.streams.items()}
    found = scored(replace(flight, streams=streams), gate=0.999)
    assert found["position_rmse_m"] < 2.0
    assert found["attitude_rmse_deg"] < 3.0


def test_an_aid_that_goes_wrong_is_refused_and_found_again():
    """For 2 s all positions are 80 m off: with a gate they change little, and after it they count again."""
    flight = drive(20.0, "gps,gps_velocity,wheels", imu__rate="25", gps__rate="5")
    case = gnss_ins.case(flight, gate=0.999)
    assert isinstance(case.inputs, Mapping)
    gnss = case.inputs["gnss"]
    off = gnss.values.position.copy()
    wrong = (gnss.time >= 8 * 10**9) & (gnss.time < 10 * 10**9 - 10**8)
    off[wrong, 0] += 80.0
    bad = {**case.inputs, "gnss": Series(gnss.time, gnss.values.replace(position=off), name="gnss")}
    found = case.score(simulate(case.graph, bad))
    assert found["gnss_nis_rejected"] >= 5
    result = simulate(case.graph, bad)
    assert flight.truth is not None
    end = result["belief"]["position"][-1] - flight.truth["position"][-1]
    assert np.linalg.norm(end) < 4.0
    assert result["gnss_innovation"]["accepted"][-10:].all()


def test_without_a_gate_all_is_believed():
    case = gnss_ins.case(drive(4.0, "gps", imu__rate="25"))
    assert case.score(simulate(case.graph, case.inputs))["gnss_nis_rejected"] == 0.0


@pytest.mark.slow
def test_engines_agree_with_all_sensors_and_all_parameters():
    flight = drive(1.0, gps__rate="10", imu__rate="50")
    every = "lever+time_offset+gyro_scale+accelerometer_scale+height_offset"
    case = gnss_ins.case(flight, estimate=every, zero_velocity=True, gate=0.99)
    result = engines_agree(case.graph, case.inputs)
    assert result["belief"]["parameters"].shape[1] == 11
    is_lowered_and_drawn(case, "predict", "fuse_gnss", "fuse_magnetometer", "fuse_barometer", "fuse_rest")


def angle_between(p: np.ndarray, q: np.ndarray) -> float:
    """The angle of the turn between two attitudes, rad."""
    return float(2.0 * np.arccos(np.clip(abs(np.sum(p * q)), 0.0, 1.0)))


def test_a_unit_of_navigation_grade_finds_north_by_the_turn_of_the_earth():
    """At rest for 3 s: its heading is off by what is said, to which the white noise of the gyroscope and its
    bias add up; over many seeds the errors are as large as their deviation."""
    shares = []
    for seed in range(12):
        flight = drive(4.0, "gps", seed=seed, unit="navigation", imu__rate="50")
        assert flight.truth is not None
        case = gnss_ins.case(flight, start="unknown_yaw", estimate="none")
        (said,) = [n for n in case.notes if "gyro compassing" in n]
        assert said.startswith("info: the heading at the start is that of gyro compassing")
        start = case.graph.settings["start"]
        covariance = start.covariance[6:9, 6:9]
        R = to_matrix(start.attitude, xp=np)
        heading = np.sqrt((R @ covariance @ R.T)[2, 2])
        assert np.degrees(heading) < 1.0
        turn = to_rotation_vector(
            multiply(flight.truth["attitude"][0], conjugate(start.attitude, xp=np), xp=np), xp=np
        )
        shares.append(turn[2] / heading)
        assert angle_between(start.attitude, flight.truth["attitude"][0]) < np.radians(3.0)
    assert 0.5 < np.sqrt(np.mean(np.square(shares))) < 1.6


@pytest.mark.parametrize("unit", ["consumer", "tactical"])
def test_a_unit_whose_bias_hides_the_turn_of_the_earth_is_no_compass(unit):
    flight = drive(4.0, "gps", unit=unit, imu__rate="50")
    case = gnss_ins.case(flight, start="unknown_yaw", estimate="none")
    (said,) = [n for n in case.notes if "gyro compassing" in n]
    assert said.startswith("refused: ")
    assert case.graph.settings["start"].covariance[6:9, 6:9].max() > 0.1


def test_a_unit_that_is_said_to_be_better_than_it_is_is_no_compass():
    """The consumer's bias, said to be the navigator's: what it reads cannot be the Earth's turn."""
    flight = drive(4.0, "gps", unit="consumer", imu__rate="50")
    case = gnss_ins.case(flight, start="unknown_yaw", estimate="none", gyro_bias=1e-7)
    assert any(n.startswith("refused: gyro compassing") for n in case.notes)


def test_standing_still_is_used_where_it_is_asked_for():
    """The drive begins with 3 s of rest, without fixes."""
    flight = drive(3.0, "barometer")
    loose = scored(flight, start="unknown_yaw", settle=2.0)
    held = scored(flight, start="unknown_yaw", settle=2.0, zero_velocity=True)
    assert held["velocity_rmse_mps"] < 0.02 < loose["velocity_rmse_mps"]


def test_a_vehicle_rolls_along_its_axis_without_wheels_that_tell():
    """Without positions for the last 30 s of 60, what is across stays known."""
    flight = drive(60.0, "gps,gps_velocity", imu__rate="25")
    streams = {n: s if n == "imu" else s[s.time < 30 * 10**9] for n, s in flight.streams.items()}
    cut = replace(flight, streams=streams)
    free, rolling = scored(cut), scored(cut, non_holonomic=True)
    assert rolling["position_rmse_m"] < 0.5 * free["position_rmse_m"]


def test_positions_may_be_geodetic_or_in_metres_with_covariances_or_without():
    flight = drive(6.0, "gps", imu__rate="25", gps__rate="5")
    gps = flight.streams["gps"]
    kinds = {
        "gps": gps,
        "geodetic": Series(
            gps.time, GeodeticPosition(gps["latitude"], gps["longitude"], gps["height"]), name="gps"
        ),
        "metres": Series(gps.time, Position(position=streams_of(flight)["gnss"]["position"]), name="rtk"),
    }
    for kind, series in kinds.items():
        made = replace(flight, streams={"imu": flight.streams["imu"], series.name: series})
        case = gnss_ins.case(made)
        assert case.score(simulate(case.graph, case.inputs))["position_rmse_m"] < 2.0
        assert any("a position is good to 2.5 m" in n for n in case.notes) == (kind != "gps")
        assert any("latitude" in n or "degrees" in n for n in case.notes)


def test_where_magnetic_north_is_is_said_by_a_setting_or_by_date_and_place():
    pytest.importorskip("pygeomag")
    place = (np.radians(47.4), np.radians(8.55), 430.0)
    assert np.degrees(declination("2024-07-01", place, "gnss_ins")) == pytest.approx(3.4, abs=0.3)
    with pytest.raises(DeclarationError, match="is no date"):
        declination("1.7.2024", place, "gnss_ins")
    case = gnss_ins.case(drive(2.0, "gps,magnetometer", imu__rate="25"), date="2024-07-01")
    assert any("World Magnetic Model" in n for n in case.notes)


def test_a_date_without_a_place_tells_nothing():
    flight = drive(2.0, "magnetometer", imu__rate="25")
    with pytest.raises(DataError, match="declination of this place"):
        gnss_ins.case(flight, date="2024-07-01")


def test_what_cannot_be_estimated_is_named():
    with pytest.raises(UnknownNameError, match="lever"):
        gnss_ins.case(drive(2.0, "gps", imu__rate="25"), estimate="levers")


def test_it_needs_an_inertial_unit():
    flight = drive(2.0, "gps", imu__rate="25")
    with pytest.raises(DataError, match="imu"):
        gnss_ins.case(replace(flight, streams={"gps": flight.streams["gps"]}))


def test_a_drive_is_followed_as_well_as_is_said():
    """Positions to 1.5 m and velocities to 5 cm/s, once a second: NEES of nine numbers, and NIS of one."""
    found = [scored(drive(60.0, "gps,gps_velocity", seed=s, imu__rate="25"), settle=10.0) for s in range(2)]
    mean = lambda name: float(np.mean([f[name] for f in found]))
    assert mean("position_rmse_m") < 1.3
    assert mean("velocity_rmse_mps") < 0.15
    assert 5.0 < mean("nees_mean") < 14.0
    assert 0.7 < mean("gnss_nis_mean") < 1.3
    assert 0.7 < mean("gnss_velocity_nis_mean") < 1.3


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="the bench runs in C, and there is no compiler")
def test_drives_are_as_good_as_their_bound_to_what_so_many_flights_tell():
    """Their starts are drawn as wrong as is said; a filter with a wrong noise or equation is beyond it."""
    row, *published, ticks = drives(flights=30, units="tactical", duration=30.0).rows
    for what in ("position", "velocity", "attitude"):
        ratio, deviation = row[f"{what}_over_bound"], row[f"{what}_over_bound_deviation"]
        assert 0.01 < deviation < 0.12, what
        assert abs(ratio - 1.0) < 3.0 * deviation + 0.02, what
    assert np.hypot(row["east_rmse_m"], row["north_rmse_m"]) < row["position_rmse_m"]
    assert [r["heading_rmse_deg"] for r in published] == [8.9, 0.81]
    assert 0.1 < ticks["ticks_ratio"] < 5.0  # a machine that does other work tells no more


@pytest.mark.slow
def test_a_unit_of_navigation_grade_goes_on_alone_on_a_turning_earth():
    """Two minutes without fixes: taken for an Earth that does not turn it is twice as far off."""
    flight = drive(180.0, "gps,gps_velocity", unit="navigation", imu__rate="25")
    cut = lambda s: s[s.time < 60 * 10**9]
    streams = {n: s if n == "imu" else cut(s) for n, s in flight.streams.items()}
    assert scored(replace(flight, streams=streams), settle=60.0)["position_rmse_m"] < 25.0
    flat = {n: s for n, s in streams.items() if n == "imu"} | {
        "gnss": streams_of(flight)["gnss"], "gnss_velocity": streams["gps_velocity"]
    }  # fmt: skip
    flat["gnss"] = cut(flat["gnss"])
    assert scored(replace(flight, streams=flat), settle=60.0)["position_rmse_m"] > 40.0


@functools.cache
def flown() -> tuple[Flight, Any, Any]:
    """A minute of a drive with a centimetre's positions of an antenna at (0.4, -0.2, 0.6) m whose stamps are
    50 ms late, and its truth: the antenna's path alone."""
    flight = drive(60.0, "gps", imu__rate="50", gps__rate="50")
    truth = flight.truth
    assert truth is not None
    path = truth["position"] + rotate(truth["attitude"], np.tile([0.4, -0.2, 0.6], (len(truth), 1)), xp=np)
    series = Series(truth.time + 50_000_000, Position(position=path), name="truth")
    rng = np.random.default_rng(0)
    rows = np.arange(0, len(series) - 5, 50)
    fixes = Series(
        series.time[rows], Position(position=path[rows] + 0.01 * rng.normal(size=(len(rows), 3))), name="rtk"
    )
    info = {**flight.info, "position_noise": 0.01}
    del info["gps_lever"]
    made = replace(flight, streams={"imu": flight.streams["imu"], "rtk": fixes}, truth=series, info=info)
    case = gnss_ins.case(made, smooth="rts")
    return made, case, simulate(case.graph, case.inputs)


def test_lever_and_time_offset_are_found_by_the_filter_itself():
    """A car that does not roll shows the arm ahead and aside, and no more of its height than its tilts."""
    _, case, result = flown()
    assert any("both are estimated" in n for n in case.notes)
    assert any("alignment in motion" in n or "heading" in n for n in case.notes)
    found = result["belief"]["parameters"][-1]
    deviation = np.sqrt(np.diagonal(result["belief"]["covariance"][-1]))[15:]
    assert found[:2] == pytest.approx([0.4, -0.2], abs=0.1)
    assert found[3] == pytest.approx(0.05, abs=0.01)
    assert (np.abs(found - [0.4, -0.2, 0.6, 0.05]) < 4.0 * deviation + 0.005).all()


def test_where_the_truth_is_a_path_the_antenna_is_compared_and_the_smoothed_run_is_better():
    _, case, result = flown()
    figures = case.score(result)
    assert figures["position_rmse_m"] < 0.15
    assert figures["smoothed_position_rmse_m"] < 0.5 * figures["position_rmse_m"]
    assert figures["position_3sigma"] > 0.9


def test_errors_by_direction():
    flight = drive(10.0, "gps", imu__rate="25")
    truth = flight.truth
    assert truth is not None
    q = truth["attitude"]
    ahead = np.stack(
        [1.0 - 2.0 * (q[:, 2] ** 2 + q[:, 3] ** 2), 2.0 * (q[:, 1] * q[:, 2] + q[:, 0] * q[:, 3])], -1
    )
    ahead /= np.linalg.norm(ahead, axis=-1, keepdims=True)
    shift = np.concatenate([0.3 * ahead, np.full((len(q), 1), 0.4)], axis=-1)
    moved = Series(truth.time, truth.values.replace(position=truth["position"] + shift), name="belief")
    found = directed_errors(moved, truth)
    assert found["up_rmse_m"] == pytest.approx(0.4)
    assert np.hypot(found["east_rmse_m"], found["north_rmse_m"]) == pytest.approx(0.3)
    assert found["along_rmse_m"] == pytest.approx(0.3, abs=1e-3)
    assert found["across_rmse_m"] < 0.01


def test_the_antenna_of_a_belief_has_a_covariance_of_its_own():
    """By draws of the error: position, attitude and lever together."""
    _, _, result = flown()
    belief = result["belief"][-1:]
    names = ("lever", "time_offset")
    there = at_antenna(belief, Antenna(), names)
    rng = np.random.default_rng(0)
    d = rng.multivariate_normal(np.zeros(19), belief["covariance"][0], size=1500)
    draws = [
        at_antenna(Series(belief.time, _row(moved(belief[0], e))), Antenna(), names)["position"][0] for e in d
    ]
    np.testing.assert_allclose(
        np.cov(np.transpose(draws)),
        there["covariance"][0, :3, :3],
        rtol=0.2,
        atol=0.15 * there["covariance"][0, :3, :3].max(),
    )


def _row(belief: Any) -> Any:
    return belief.replace(**{n: np.asarray(getattr(belief, n))[None] for n in belief._fields})


@pytest.mark.slow
def test_a_recorded_flight_with_one_fix_a_second():
    """The heading, the clocks and the place of the antenna found by itself; smoothed better than a spline."""
    folder = recordings("outdoor_quadrotor")
    rows = outdoor(data=str(folder), flights="path_13", aids="1 Hz").rows
    found = {r["method"]: r for r in rows if r["flight"] == "path_13"}
    assert found["filter"]["position_rmse_m"] < 0.15
    assert found["smoothed"]["position_rmse_m"] < 0.08
    assert found["filter"]["position_3sigma"] > 0.95
    assert 0.5 < found["filter"]["nis_mean"] < 1.3
    assert (
        found["smoothed"]["position_rmse_m"]
        < found["spline"]["position_rmse_m"]
        < found["linear"]["position_rmse_m"]
    )
