"""Calibration: offsets, levers and mounts that were put in are found, and what cannot be is refused."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from flowgraph import Flight, Series, load_flight
from flowgraph.blocks.signals import Position
from flowgraph.cli import app
from flowgraph.errors import DeclarationError
from flowgraph.graphs.gnss_ins import gnss_ins
from flowgraph.study.calibrate import _apart, _truth_stays, _unthinned, calibrate
from flowgraph.study.guess import Guess, _by_vectors, guess_offset
from flowgraph.study.tasks import prepared
from flowgraph.study.trials import Trials
from flowgraph.study.tune import Fit, Recording
from tests.calibration import off, recorded
from tests.recordings import recordings

RUNNER = CliRunner(env={"COLUMNS": "200", "NO_COLOR": "1"})


def shifted(seconds: float) -> Flight:
    """A flight whose motion capture stamps that much too early."""
    flight = load_flight("sim", settings={"duration": "25", "vicon.rate": "50"})
    vicon = flight.streams["vicon"]
    late = Series(vicon.time - round(seconds * 1e9), vicon.values, name="vicon")
    return Flight("late", {"imu": flight.streams["imu"], "vicon": late})


@pytest.mark.parametrize("seconds", [-0.13, 0.085])
def test_what_both_streams_see_of_the_motion_tells_the_offset(seconds):
    found = guess_offset(shifted(seconds), "vicon", -0.3, 0.3)
    assert found is not None
    assert found.sure
    assert found.offset == pytest.approx(seconds, abs=0.006)


def test_from_positions_alone_accelerations_tell_the_offset_and_a_number_tells_nothing():
    flight = shifted(0.1)
    vicon = flight.streams["vicon"]
    seen = Series(vicon.time, Position(position=vicon["position"]), name="place")
    found = guess_offset(Flight("a", {"imu": flight.streams["imu"], "place": seen}), "place", -0.3, 0.3)
    assert found is not None
    assert found.by == "accelerations of place and imu"
    assert found.offset == pytest.approx(0.1, abs=0.008)
    alone = Flight("b", {"imu": flight.streams["imu"], "depth": Series(vicon.time, vicon["position"][:, 2])})
    assert guess_offset(alone, "depth", -0.3, 0.3) is None


def driven(seconds: float, *, seed: int = 1) -> Flight:
    """A car around corners, whose receiver stamps that much too early."""
    made = {"duration": "25", "gps.rate": "10", "imu.rate": "50"}
    flight = load_flight("sim:drive", seed=seed, settings=made)
    truth = flight.truth
    assert truth is not None
    rows = np.arange(0, len(truth), 5)
    place = truth["position"][rows] + 0.003 * np.random.default_rng(seed).normal(size=(len(rows), 3))
    rtk = Series(truth.time[rows] - round(seconds * 1e9), Position(position=place), name="rtk")
    info = {"imu_noise": flight.info["imu_noise"]}
    return Flight("driven", {"imu": flight.streams["imu"], "rtk": rtk}, info=info)


@pytest.mark.parametrize(("seconds", "seed"), [(0.24, 1), (-0.31, 2)])
def test_the_vectors_of_two_streams_tell_the_offset_whichever_is_moved(seconds, seed):
    flight = driven(seconds, seed=seed)
    (found,) = _by_vectors(flight, "rtk", -0.5, 0.5)
    assert found.correlation > 0.9
    assert found.offset == pytest.approx(seconds, abs=0.02)
    (back,) = _by_vectors(flight, "imu", -0.5, 0.5)
    assert back.offset == pytest.approx(-seconds, abs=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("flown", "seconds"), [("path_2", 0.12), ("path_11", 0.47), ("path_23", -0.61)])
def test_where_sizes_do_not_agree_vectors_do(flown, seconds):
    """A quadrotor: its force is hardly more than gravity. The offsets are those of a correlation by the
    attitudes of the unit's own filter, which is not read here."""
    folder = recordings("outdoor_quadrotor") / flown
    flight = load_flight(f"outdoor_quadrotor:{folder}", settings={"bad_time": "drop"})
    found = guess_offset(flight, "rtk", -1.0, 1.0)
    assert found is not None
    assert found.by == "accelerations of rtk and imu, as vectors"
    assert found.offset == pytest.approx(seconds, abs=0.02)


def test_a_thinned_aid_is_begun_with_by_all_its_rows():
    folder = recordings("outdoor_quadrotor") / "path_21"
    told = {"rtk.every": "1", "bad_time": "drop"}
    ours = Trials("gnss_ins", [Recording(f"outdoor_quadrotor:{folder}")], told, "likelihood", None, "c")
    (thinned,), (whole,) = ours.flights, _unthinned(ours, told)
    assert len(whole.streams["rtk"]) > 9 * len(thinned.streams["rtk"])
    assert guess_offset(thinned, "rtk", -1.0, 1.0) is None
    found = guess_offset(whole, "rtk", -1.0, 1.0)
    assert found is not None
    assert found.offset == pytest.approx(-0.34, abs=0.03)


@pytest.mark.slow
@pytest.mark.parametrize(("flown", "seconds"), [((17, 21), -0.34), ((23,), -0.61)])
def test_the_likelihood_of_a_session_finds_its_clock(flown, seconds):
    """The antenna is taken for the place of the unit, which must foretell the way from one fix of a second to
    the next."""
    folder = recordings("outdoor_quadrotor")
    found = calibrate(
        "gnss_ins", [Fit("rtk.time_offset", -1.0, 1.0)],
        [Recording(f"outdoor_quadrotor:{folder}/path_{k}") for k in flown], measure="likelihood",
        settings={"rtk.every": "1", "bad_time": "drop"}, engine="c",
    )  # fmt: skip
    assert found.parameters["rtk.time_offset"] == pytest.approx(seconds, abs=0.02)
    assert found.deviations["rtk.time_offset"] < 0.01
    assert not any("says no place" in said for said in found.notes)


@pytest.mark.slow
def test_where_the_likelihood_says_no_place_an_offset_stays_where_it_began():
    """With ten fixes a second the alignment in motion of this flight leaps at some offsets, and with it the
    likelihood."""
    folder = recordings("outdoor_quadrotor")
    found = calibrate(
        "gnss_ins", [Fit("rtk.time_offset", -1.0, 1.0)],
        [Recording(f"outdoor_quadrotor:{folder}/path_23")], engine="c",
    )  # fmt: skip
    assert any("says no place near" in said and "it stays at -0.6142 s" in said for said in found.notes)
    assert found.parameters["rtk.time_offset"] == pytest.approx(-0.6142, abs=1e-3)
    assert found.deviations["rtk.time_offset"] is None


def test_what_is_sought_is_not_estimated_by_the_filter_as_well():
    flight = driven(0.0)
    flight = replace(flight, info={**flight.info, "position_noise": 0.02})
    within = gnss_ins.case(flight).graph.settings["estimated"]
    sought = replace(flight, info={**flight.info, "sought": ("rtk.time_offset",)})
    assert set(within) == {"lever", "time_offset"}
    case = gnss_ins.case(sought)
    assert not case.graph.settings["estimated"]
    assert any("taken for the unit's place, while its clock is sought" in n for n in case.notes)
    with_lever = gnss_ins.case(sought, estimate="lever")
    assert with_lever.graph.settings["estimated"] == ("lever",)


def test_nothing_is_estimated_beside_the_fifteen_where_that_is_asked_for():
    told = {"sensors": "gps,barometer", "duration": "3"}
    for more, estimated in (({}, ("height_offset",)), ({"estimate": "none"}, ())):
        case, _ = prepared("gnss_ins", "sim:drive", 1, {**told, **more})
        assert case.graph.settings["estimated"] == estimated


def test_recordings_of_another_clock_are_named_and_left_out():
    told = [
        Guess(0.12, 0.95, "x"),
        Guess(0.13, 0.95, "x"),
        Guess(0.24, 0.95, "x"),
        Guess(0.9, 0.1, "x"),
        None,
    ]
    names = [Recording(f"csv:{k}") for k in range(5)]
    (said,), left = _apart("rtk.time_offset", names, told, 0.12)
    assert "csv:2 says 0.24 s" in said
    assert said.endswith("it is left out")
    assert left == {2}
    notes, left = _apart("rtk.time_offset", names[:2], [told[0], told[2]], 0.18)
    assert len(notes) == 2
    assert not left, "of two nobody knows which"


def test_what_cannot_be_calibrated_is_refused():
    words = ["calibrate", "ekf", "--data", "sim"]
    for find, said in (
        ("vicon.lever=0.3:-0.3", "no bounds to search between"),
        ("vicon.lever", "KEY=LOW:HIGH"),
        ("vico.lever=-0.1:0.1", "no stream is called"),
        ("settle=0.1:1", "how a run is scored"),
    ):
        done = RUNNER.invoke(app, [*words, "--find", find])
        assert done.exit_code == 2, (find, done.output)
        assert said in done.stderr or "LOW:HIGH" in done.stderr
    assert RUNNER.invoke(app, [*words, "--find", "gyro_factor=0.1:9", "--by", "luck"]).exit_code == 2


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0])
def test_a_lever_and_a_mount_are_found_within_their_own_deviations(seed):
    assert np.abs(off(seed, 10.0)).max() < 3.5


@pytest.mark.slow
def test_the_command_finds_an_offset_that_run_then_reads(tmp_path):
    spec, settings = recorded(tmp_path, 2, 12.0)
    words = ["--data", spec, *(w for n, v in settings.items() for w in ("--set", f"{n}={v}"))]
    words += ["--set", "vicon.lever=0.1,-0.05,0.07", "--set", "vicon.mount=3,-2,5"]
    file = tmp_path / "found.json"
    done = RUNNER.invoke(
        app,
        [
            "calibrate",
            "ins_eskf",
            *words,
            "--find",
            "vicon.time_offset=-0.2:0.2",
            "--json",
            "--out",
            str(file),
        ],
    )
    assert done.exit_code == 0, done.output
    one = json.loads(file.read_text())["parameters"]["vicon.time_offset"]
    assert abs(one["value"]) < 0.006
    assert 0.0 < one["deviation"] < 0.006
    again = RUNNER.invoke(
        app, ["run", "ins_eskf", *words, "--settings", str(file), "--engine", "c", "--json"]
    )
    assert again.exit_code == 0, again.output
    assert f"shifted by {round(one['value'] * 1e9)} ns" in again.stdout


def test_a_noise_is_found_as_by_tune():
    found = calibrate(
        "ekf", [Fit("gyro_factor", 0.5, 2.0)], [Recording("sim")], engine="reference", most=2,
        settings={"duration": 2.0, "imu.rate": 25.0},
    )  # fmt: skip
    assert set(found.parameters) == {"gyro_factor"}
    assert found.evaluations >= 1


@pytest.mark.parametrize("verb", ["calibrate", "tune"])
@pytest.mark.parametrize(
    ("given", "fix"),
    [
        ("vicon.lever=0.2:-0.2", "vicon.lever=-0.2:0.2"),
        ("X=0.2:-0.2", "X=-0.2:0.2"),
        ("gyro_factor=2:0.5:1", "gyro_factor=0.5:2:1"),
        ("gyro_factor=0.5:2:7", "gyro_factor=0.5:2"),
        ("gyro_factor=1:1", "NAME=LOW:HIGH"),
        ("gyro_factor=nan:1", "NAME=LOW:HIGH"),
    ],
)
def test_bounds_the_wrong_way_round_are_told_by_their_option(verb, given, fix):
    option = {"calibrate": "--find", "tune": "--fit"}[verb]
    done = RUNNER.invoke(app, [verb, "ekf", "--data", "sim", option, given])
    assert done.exit_code == 2
    name = given.partition("=")[0]
    assert f"error: {option} {name}: these are no bounds to search between" in done.output
    assert f"write {option} {fix}\n" in done.output
    assert f"'{given}'" in done.output
    assert "Fit(" not in done.output


def test_what_calibrate_refuses_is_said_in_its_name():
    with pytest.raises(DeclarationError, match="calibrate, fit gyro_factor: this cannot be calibrated"):
        calibrate("ekf", [Fit("gyro_factor", 0.5, 2.0)] * 2, [Recording("sim")])
    with pytest.raises(DeclarationError, match=r"vicon.lever: these are no bounds") as refused:
        calibrate("ekf", [Fit("vicon.lever", 0.2, -0.2)], [Recording("sim")])
    assert refused.value.fix == "swap the bounds: low -0.2, high 0.2"


@pytest.mark.parametrize(("verb", "option"), [("calibrate", "--find"), ("tune", "--fit")])
def test_a_misspelt_parameter_is_told_before_its_bounds(verb, option):
    def said(key: str) -> str:
        done = RUNNER.invoke(app, [verb, "ins_eskf", "--data", "sim", option, f"{key}=-0.3:0.1"])
        assert done.exit_code == 2
        return done.output

    for key, meant in (
        ("vicon.time_offst", "vicon.time_offset"),
        ("leica.lver", "leica.lever"),
        ("gyro_facto", "gyro_factor"),
    ):
        assert f"no setting is called '{key}'" in said(key)
        assert f"did you mean '{meant}'?" in said(key)
    assert "give bounds above 0" in said("gyro_factor")


@pytest.mark.parametrize(("verb", "option"), [("calibrate", "--find"), ("tune", "--fit")])
def test_a_file_that_cannot_be_written_is_told_before_the_search(verb, option, tmp_path):
    (tmp_path / "folder").mkdir()
    for place in (tmp_path / "gone" / "found.json", tmp_path / "folder"):
        words = [verb, "ekf", "--data", "sim", option, "gyro_factor=0.5:2", "--out", str(place)]
        done = RUNNER.invoke(app, words)
        assert done.exit_code == 1
        assert "this cannot be written" in done.output
        assert "tried" not in done.output


def test_what_is_set_as_well_is_told_with_the_option_to_leave_out():
    with pytest.raises(DeclarationError) as refused:
        calibrate("ekf", [Fit("gyro_factor", 0.5, 2.0)], [Recording("sim")], settings={"gyro_factor": 1.0})
    assert refused.value.fix == "leave out --set gyro_factor, or its bounds"


SHORT = {"duration": 2.0, "imu.rate": 50.0, "vicon.rate": 25.0}


@pytest.mark.slow
def test_a_clock_is_that_of_the_truth_where_there_is_one_of_its_own():
    """A unit whose stamps are 20 ms off: the innovations follow it, the truth does not."""
    fits = [Fit("vicon.time_offset", -0.1, 0.1)]
    settings = {**SHORT, "duration": 8.0, "imu.time_offset": 0.02}
    found = {
        m: calibrate("ekf", fits, [Recording("sim")], engine="c", settings=settings, measure=m)
        for m in (None, "error", "likelihood")
    }
    clocks = {m: float(f.parameters["vicon.time_offset"]) for m, f in found.items()}
    assert clocks[None] == clocks["error"]
    assert clocks["likelihood"] == pytest.approx(0.02, abs=0.006)
    assert abs(clocks["error"]) < 0.012


@pytest.mark.parametrize(("truth", "stays"), [("sim", True), ("moved", False), ("none", False)])
def test_a_truth_that_an_offset_moves_or_that_is_none_judges_no_clock(truth, stays, monkeypatch):
    import flowgraph.study.trials as trials

    def flight(data, seed, settings):
        made = load_flight("sim", settings={n: str(v) for n, v in SHORT.items()})
        assert made.truth is not None
        late = round(float(settings.get("vicon.time_offset", 0.0)) * 1e9)
        known = made.truth if truth == "sim" else Series(made.truth.time + late, made.truth.values)
        return replace(made, truth=None if truth == "none" else known)

    monkeypatch.setattr(trials, "loaded", flight)
    monkeypatch.setattr(trials, "prepared", lambda g, data, seed, settings: (None, flight(data, seed, {})))
    problem = Trials("ekf", [Recording("sim")], SHORT, "likelihood", None, "reference")
    assert _truth_stays(problem, [Fit("vicon.time_offset", -0.1, 0.1)]) is stays
