"""Where filters start: at which pose, when, and what they do with a heading that nobody knows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, DataError, Flight, Series, find_graph, load_flight, simulate
from flowgraph.blocks.geometry import from_rotation_vector, multiply, rotate, to_matrix
from flowgraph.blocks.geometry.rotations import tilt_and_heading
from flowgraph.blocks.scoring import UNKNOWN_HEADING
from flowgraph.blocks.signals import MagneticField, Position
from flowgraph.language.declare import GraphFunction
from tests.recordings import recordings

MEASURE_POSES = ("ekf", "ukf", "ins_ekf_pose", "ins_ukf_pose", "ins_particle", "augmented_complementary")
BY_IMU = ("gyro_integration", "complementary", "quaternion_ukf")
THESIS = ("ins_eskf", "ekf", "ukf", "ins_ekf_pose", "ins_ukf_pose", "ins_particle", "rbpf_indoor",
          "augmented_complementary", "async_kalman", "gyro_integration")  # fmt: skip


@cache
def flight(duration: float = 4.0, seed: int = 1) -> Flight:
    return load_flight("sim", seed=seed, settings={"duration": str(duration)})


def late(base: Flight, name: str, seconds: float) -> Flight:
    """The flight, whose stream begins so much later."""
    series = base.streams[name]
    return replace(base, streams={**base.streams, name: series[series.time >= round(seconds * 1e9)]})


def few(name: str) -> dict[str, Any]:
    return {"particles": 50} if name in ("ins_particle", "rbpf_indoor") else {}


def moving(name: str) -> dict[str, Any]:
    """What tells a filter that knows of a rest that there is none."""
    return {"still": 0.0} if name == "rbpf_indoor" else {}


def inputs_of(case: Case) -> dict[str, Series]:
    """The inputs of a case, which are no flight."""
    assert not isinstance(case.inputs, Flight)
    return dict(case.inputs)


def truth_of(made: Flight) -> Series:
    assert made.truth is not None
    return made.truth


def heading_of(q: np.ndarray) -> float:
    R = to_matrix(q, xp=np)
    return float(np.arctan2(R[1, 0], R[0, 0]))


def first_attitude(name: str, case: Case) -> np.ndarray:
    """The attitude (4) in the first tick of a run."""
    head = {n: s[: max(int(np.searchsorted(s.time, min(x.time[0] for x in inputs_of(case).values()))) + 1, 2)]
            for n, s in inputs_of(case).items()}  # fmt: skip
    result = simulate(case.graph, head)
    return np.asarray(result[case.estimate]["attitude"][0])


def write_euroc(folder: Path, base: Flight, angle: float) -> Path:
    """A EuRoC folder of the flight's IMU, positions and truth, turned by `angle` degrees about the
    vertical."""
    turn = np.asarray(from_rotation_vector(np.array([0.0, 0.0, np.radians(angle)]), xp=np))
    imu, vicon, truth = base.streams["imu"], base.streams["vicon"], truth_of(base)
    assert truth is not None
    first = 1_400_000_000_000_000_000
    here = "T_BS:\n  cols: 4\n  rows: 4\n  data: [1,0,0,0, 0,1,0,0, 0,0,1,0, 0,0,0,1]\n"
    for name in ("imu0", "leica0"):
        (folder / "mav0" / name).mkdir(parents=True)
        (folder / "mav0" / name / "sensor.yaml").write_text(here)
    noise = base.info["imu_noise"]
    (folder / "mav0/imu0/sensor.yaml").write_text(
        f"{here}rate_hz: 200\n"
        f"gyroscope_noise_density: {noise.gyro}\ngyroscope_random_walk: {noise.gyro_bias}\n"
        f"accelerometer_noise_density: {noise.accelerometer}\n"
        f"accelerometer_random_walk: {noise.accelerometer_bias}\n"
    )

    def table(path: str, series: Series, *columns: np.ndarray) -> None:
        rows = (f"{first + t}," + ",".join(map(repr, row)) for t, row in
                zip(series.time.tolist(), np.hstack(columns).tolist(), strict=True))  # fmt: skip
        (folder / path).write_text("#t\n" + "\n".join(rows) + "\n")

    table("mav0/imu0/data.csv", imu, imu["gyro"], imu["specific_force"])
    table("mav0/leica0/data.csv", vicon, np.asarray(rotate(turn, vicon["position"], xp=np)))
    q = np.asarray(multiply(turn, truth["attitude"], xp=np))[:, [1, 2, 3, 0]]
    p = np.asarray(rotate(turn, truth["position"], xp=np))
    rows = (f"{(first + t) // 10**9}.{(first + t) % 10**9:09d} " + " ".join(map(repr, row)) for t, row in
            zip(truth.time.tolist(), np.hstack([p, q]).tolist(), strict=True))  # fmt: skip
    (folder / "groundtruth.tum").write_text("\n".join(rows) + "\n")
    return folder


def scored(made: Flight, **settings: Any) -> tuple[float, Case]:
    """The attitude RMSE of `ins_eskf` in degrees, and its case."""
    case = find_graph("ins_eskf").case(made, gyro_factor=1.0, accelerometer_factor=1.0, **settings)
    return case.score(simulate(case.graph, case.inputs))["attitude_rmse_deg"], case


@pytest.mark.slow
def test_a_heading_is_found_from_positions_in_a_file(tmp_path):
    excess = []
    for seed, angle in enumerate((150.0, -60.0, 180.0, 150.0, -60.0, 180.0)):
        made = load_flight(f"euroc:{write_euroc(tmp_path / f'flight{seed}', flight(12.0, seed), angle)}")
        known, _ = scored(made, settle=8.0)
        found, case = scored(made, settle=8.0, start="unknown_yaw")
        assert any("sought in the first" in note for note in case.notes)
        excess.append(found - known)
    assert max(excess) < 0.4


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [150.0, -90.0, 60.0])
def test_a_heading_that_was_set_wrong_is_found_with_a_warning(tmp_path, wrong):
    made = load_flight(f"euroc:{write_euroc(tmp_path / 'flight', flight(12.0), 30.0)}")
    known, right = scored(made, settle=8.0, start_heading=np.radians(30.0))
    assert not any(note.startswith("warning") for note in right.notes)
    found, case = scored(made, settle=8.0, start_heading=np.radians(30.0 + wrong))
    assert any("speak against the heading at the start" in note for note in case.notes)
    assert found < known + 0.5


def test_a_body_that_stays_where_it_is_shows_no_heading():
    base = flight(4.0)
    at = np.zeros((len(base.streams["vicon"]), 3))
    leica = Series(base.streams["vicon"].time, Position(position=at), name="leica")
    made = replace(base, streams={"imu": base.streams["imu"], "leica": leica})
    case = find_graph("ins_eskf").case(made, start="unknown_yaw")
    assert any("it stays unknown" in note for note in case.notes)
    belief = simulate(case.graph, case.inputs)["belief"]
    P = belief["covariance"][0, 6:9, 6:9]
    assert np.sqrt(np.linalg.eigvalsh(P)[-1]) == pytest.approx(UNKNOWN_HEADING, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 150.0, 180.0, -60.0])
def test_the_heading_of_a_recording_is_found(angle):
    made = load_flight(
        f"euroc:{recordings('euroc') / 'MH_01_easy'}", settings={"leica.time_offset": "-0.135"}
    )
    turn = np.asarray(from_rotation_vector(np.array([0.0, 0.0, np.radians(angle)]), xp=np))
    leica, truth = made.streams["leica"], truth_of(made)
    place = np.asarray(rotate(turn, leica["position"], xp=np))
    leica = Series(leica.time, Position(position=place), name="leica")
    values = truth.values.replace(
        position=np.asarray(rotate(turn, truth["position"], xp=np)),
        attitude=np.asarray(multiply(turn, truth["attitude"], xp=np)),
    )
    made = replace(
        made, streams={**made.streams, "leica": leica}, truth=Series(truth.time, values, name="truth")
    )
    cases = [find_graph("ins_eskf").case(made, settle=20.0, **s) for s in ({}, {"start": "unknown_yaw"})]
    known, found = (c.score(simulate(c.graph, c.inputs))["attitude_rmse_deg"] for c in cases)
    assert found < known + 0.5


# What is taken, and when it is of


@pytest.mark.parametrize("name", [*MEASURE_POSES, "rbpf_indoor"])
@pytest.mark.parametrize("first", [0.0, 0.3, 1.55])
def test_a_filter_starts_at_its_first_pose(name, first):
    base = late(flight(), "vicon", first)
    case = find_graph(name).case(base, start="file", **moving(name), **few(name))
    begins = min(int(series.time[0]) for series in inputs_of(case).values())
    assert begins == base.streams["vicon"].time[0]
    assert any(note.startswith("skipped: imu") for note in case.notes) == (first > 0.0)


def test_a_start_at_the_truth_is_not_of_its_future():
    base = flight()
    truth = truth_of(base)
    cut = replace(base, truth=truth[truth.time >= 1_600_000_000])
    for name in ("ins_eskf", "complementary", "ekf"):
        case = find_graph(name).case(cut, start="truth")
        assert min(int(s.time[0]) for s in inputs_of(case).values()) >= truth_of(cut).time[0]
    rests = find_graph("gyro_integration").case(cut, still=2.0)  # the pose of later is that of now
    assert inputs_of(rests)["imu"].time[0] == base.streams["imu"].time[0]


@pytest.mark.parametrize("name", [*MEASURE_POSES, "rbpf_indoor", *BY_IMU, "ins_eskf"])
@pytest.mark.parametrize(("settings", "said"), [
    ({"start": "truth"}, "assumed: the start is the truth's"),
    ({"start": "file"}, "assumed: the start has the first attitude that was measured"),
    ({"start": "unknown_yaw"}, "assumed: nothing is known of the heading at the start: 0 rad"),
    ({"start_heading": 0.3}, "assumed: the heading at the start is 0.3 rad, as it was set"),
])  # fmt: skip
def test_every_filter_says_what_it_took(name, settings, said):
    case = find_graph(name).case(flight(), **settings, **few(name))
    assert any(note.startswith(said) for note in case.notes)


@pytest.mark.parametrize("name", BY_IMU)
@pytest.mark.parametrize("heading", [0.3, -2.0, 3.0])
def test_a_heading_that_is_set_is_that_of_the_start(name, heading):
    case = find_graph(name).case(replace(flight(), truth=None), start_heading=heading)
    found = heading_of(first_attitude(name, case))
    assert abs((found - heading + np.pi) % (2.0 * np.pi) - np.pi) < 0.03


def test_a_magnetometer_shows_the_heading_where_nothing_else_does():
    base = flight()
    imu, truth = base.streams["imu"], truth_of(base)
    q = truth["attitude"][np.minimum(np.searchsorted(truth.time, imu.time), len(truth) - 1)]
    turn = np.asarray(from_rotation_vector(np.array([0.0, 0.0, 2.0]), xp=np))
    q = np.asarray(multiply(turn, q, xp=np))
    back = q * np.array([1.0, -1.0, -1.0, -1.0])
    field = np.asarray(rotate(back, np.tile([0.0, 2e-5, -4e-5], (len(q), 1)), xp=np))
    field[0] = 0.0  # the first shows none
    streams = {"imu": imu, "magnetometer": Series(imu.time, MagneticField(field=field), name="magnetometer")}
    made = replace(base, streams=streams, truth=None)
    for name in BY_IMU:
        case = find_graph(name).case(made)
        assert any("the heading of the first field that was measured" in n for n in case.notes)
        error = np.abs(tilt_and_heading(first_attitude(name, case), q[0])[1])
        assert error < 3.0, name


@pytest.mark.parametrize("field", ["position", "attitude"])
@pytest.mark.parametrize("name", [*MEASURE_POSES, "rbpf_indoor"])
def test_a_first_pose_that_was_not_measured_starts_nothing(name, field):
    base = flight()
    vicon = base.streams["vicon"]
    values = {n: np.array(vicon[n]) for n in ("position", "attitude")}
    values[field][:3] = np.nan
    series = Series(vicon.time, vicon.values.replace(**values), name="vicon", gaps=True)
    case = find_graph(name).case(
        replace(base, streams={**base.streams, "vicon": series}), start="file", **moving(name), **few(name)
    )
    assert inputs_of(case)["imu"].time[0] >= vicon.time[3]
    assert np.isfinite(first_attitude(name, case)).all()


def test_nothing_after_the_start_is_refused():
    base = flight()
    short = replace(base, streams={**base.streams, "imu": base.streams["imu"][:20]})
    with pytest.raises(DataError, match="nothing of imu comes after the pose that ekf starts with"):
        find_graph("ekf").case(late(short, "vicon", 2.0))


# The thesis's unit, and rest


@pytest.mark.parametrize("name", THESIS)
def test_the_unit_of_the_thesis_drives_a_filter(name):
    made = load_flight(
        "sim:thesis",
        settings={"sensors": "gyro,coordinate_acceleration,vicon", "duration": "3", "vicon.rate": "20"},
    )
    settings = {} if name == "async_kalman" else {"start": "truth", **few(name)}
    case = find_graph(name).case(made, **settings)
    score = case.score(simulate(case.graph, case.inputs))
    if name != "gyro_integration":
        assert score["position_rmse_m"] < 0.5
    else:
        assert score["heading_rmse_deg"] < 10.0


@pytest.mark.parametrize("name", ["quaternion_ukf", "complementary", "marg"])
def test_a_filter_that_needs_the_vertical_refuses_a_unit_without_gravity(name):
    made = load_flight(
        "sim:thesis", settings={"sensors": "gyro,coordinate_acceleration,vicon", "duration": "3"}
    )
    with pytest.raises(DataError, match=f"lacks what {name} needs"):
        find_graph(name).case(made)


def test_a_cloud_takes_its_rest_from_the_flight_or_its_readings(monkeypatch):
    rests, build = [], GraphFunction.build

    def spy(graph: Any, **settings: Any) -> Any:
        rests.append(settings["still"])
        return build(graph, **settings)

    monkeypatch.setattr(GraphFunction, "build", spy)
    base, graph = flight(), find_graph("rbpf_indoor")
    unsaid = replace(base, info={k: v for k, v in base.info.items() if k != "still"})
    graph.case(replace(base, info={**base.info, "still": 0.4}), particles=20)
    graph.case(unsaid, particles=20)
    graph.case(late(late(unsaid, "imu", 2.0), "vicon", 2.0), particles=20)  # it moves from the first on
    assert rests[0] == 0.4
    assert 0.5 < rests[1] <= 1.1
    assert rests[2] < 0.3
