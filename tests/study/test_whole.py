"""Whole experiments: the figures of a study are those of the recorded way, whose flights are written down."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flowgraph import Case, Flight, Stream, Tick, find_graph, graph, load_flight, simulate, ticks
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.models.pose import pose_at_start
from flowgraph.blocks.sensors import read_imu, read_pose, true_state
from flowgraph.blocks.world import RoundTrip, world_motion
from flowgraph.data.experiment import Experiment
from flowgraph.data.inputs import clocks_of
from flowgraph.study import Study, run_study, tasks
from flowgraph.study.whole import whole_case

pytest.importorskip("pyarrow")
SHORT: dict[str, Any] = {"duration": 2.0, "imu.rate": 50, "start": "truth"}


def study(**more: Any) -> Study:
    parameters = {**SHORT, **more.pop("parameters", {})}
    return Study(
        **{
            "graphs": ["ekf"],
            "data": ["sim"],
            "seeds": 4,
            "engine": "c",
            "parameters": parameters,
            **more,
        }
    )


def figures(row: dict[str, Any]) -> dict[str, float]:
    return {n: v for n, v in row.items() if isinstance(v, float) and not n.endswith("_s")}


@pytest.mark.slow
def test_a_study_of_whole_experiments_has_the_figures_of_the_recorded_way(tmp_path, monkeypatch) -> None:
    found = run_study(study(), tmp_path / "whole").rows
    assert [row["load_s"] for row in found] == [0.0] * 4, "no flight was written down"
    monkeypatch.setattr(tasks, "_whole", lambda run: None)
    recorded = run_study(study(), tmp_path / "recorded").rows
    assert all(row["load_s"] > 0.0 for row in recorded)
    for one, other in zip(found, recorded, strict=True):
        want = figures(other)
        assert figures(one).keys() == want.keys()
        for name, value in want.items():
            assert figures(one)[name] == pytest.approx(value, rel=1e-9, abs=1e-9), name
    assert len({row["position_rmse_m"] for row in found}) == 4, "seeds choose the flight"


@pytest.mark.slow
def test_a_study_of_whole_experiments_goes_on_where_it_was_left(tmp_path) -> None:
    first = run_study(study(seeds=3), tmp_path)
    again = run_study(study(seeds=6), tmp_path)
    assert (first.done, again.done, again.kept) == (3, 3, 3)
    alone = run_study(study(seeds=6), tmp_path / "alone")
    assert [figures(row) for row in again.rows] == [figures(row) for row in alone.rows]


@pytest.mark.slow
def test_a_setting_that_a_program_cannot_take_is_an_error_of_its_rows_alone(tmp_path) -> None:
    rows = run_study(study(seeds=2, parameters={"position_noise": [0.01, -1.0]}), tmp_path).rows
    assert [row["error"] is None for row in rows] == [True, True, False, False]


def cases_of(name: str, settings: dict[str, str], more: dict[str, Any]) -> list[tuple[Case, Flight]]:
    """Those of two seeds, and their flights."""
    found = []
    for seed in (0, 1):
        flight = load_flight("sim", seed=seed, settings={"duration": "1.5", "imu.rate": "50", **settings})
        case, _ = tasks.prepared(name, "sim", seed, more, flight)
        found.append((case, flight))
    return found


@pytest.mark.parametrize(
    ("name", "settings", "more"),
    [
        ("ekf", {"vicon.latency": "0.02"}, {"start": "truth"}),
        ("ekf", {}, {"start": "unknown_yaw"}),
        ("ins_eskf", {}, {"start": "file"}),
        ("rbpf_indoor", {}, {"particles": 5, "start": "file"}),
    ],
    ids=["a reading that comes late", "half a first pose", "a measured pose, levelled", "a mean at rest"],
)
def test_what_hangs_on_the_recording_has_no_whole_case(
    name: str, settings: dict[str, str], more: dict[str, Any]
) -> None:
    found = cases_of(name, settings, more)
    made_by = found[0][1].experiment
    if settings:
        assert made_by is None
    else:
        assert made_by is not None
        assert whole_case(made_by, *found) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "more"), [("ekf", {}), ("ukf", {}), ("ins_eskf", {}), ("rbpf_indoor", {"particles": 8})]
)
def test_a_start_that_follows_from_the_flight_is_made_in_the_graph(name: str, more: dict[str, Any]) -> None:
    found = cases_of(name, {}, more)
    experiment = found[0][1].experiment
    assert experiment is not None
    whole = whole_case(experiment, *found)
    assert whole is not None
    assert "begin" in whole.graph.sources
    for seed, (case, _) in enumerate(found):
        got = whole.score(simulate(whole.graph, whole.inputs, engine="python", seed=seed))
        want = case.score(simulate(case.graph, case.inputs, engine="reference", seed=seed))
        assert got.keys() == want.keys()
        for figure, value in want.items():
            assert got[figure] == pytest.approx(value, rel=1e-9, abs=1e-9), figure


def test_a_start_in_the_graph_that_is_not_the_case_s_is_not_taken() -> None:
    found = cases_of("ekf", {}, {})
    experiment = found[0][1].experiment
    assert experiment is not None
    (case, flight), other = found
    assert case.begin is not None
    off = lambda first, at: {"belief": pose_at_start(first("vicon"), deviations=(0.7, 0.7, 0.31), at=at)}
    assert whole_case(experiment, (replace(case, begin=off), flight), other) is None
    assert whole_case(experiment, (replace(case, begin=None), flight), other) is None


@pytest.mark.slow
def test_a_whole_experiment_is_the_same_in_every_engine() -> None:
    found = []
    for seed in (0, 1):
        flight = load_flight("sim", seed=seed, settings={"duration": "1.5", "imu.rate": "50"})
        found.append((find_graph("ekf").case(flight, start="truth"), flight))
    experiment = found[0][1].experiment
    assert experiment is not None
    case = whole_case(experiment, *found)
    assert case is not None
    want = case.score(simulate(case.graph, case.inputs, engine="python", seed=3))
    assert all(map(math.isfinite, want.values()))
    for engine in ("reference", "xla", "c"):
        got = case.score(simulate(case.graph, case.inputs, engine=engine, seed=3))
        np.testing.assert_allclose(list(got.values()), list(want.values()), rtol=1e-9, atol=1e-9)


@graph
def own_world(clock: Stream[Tick], seen: Stream[Tick], *, world: RoundTrip):
    """Its clocks are not called as its streams are."""
    motion = world_motion(at=clock, world=world)
    pose = read_pose(world_motion(at=seen, world=world), position_noise=0.01, attitude_noise=0.01)
    return {
        "imu": read_imu(motion, gyro=0.01, accelerometer=0.1),
        "vicon": pose,
        "truth": true_state(motion),
    }


def flights_of_their_own(made: Experiment) -> list[tuple[Case, Flight]]:
    known = {"imu_noise": ImuNoise(1e-3, 1e-2, 0.0, 0.0), "position_noise": 0.01, "attitude_noise": 0.01}
    found = []
    for seed in (0, 1):
        run = simulate(made.world.build(**clocks_of(made.ticks), **made.settings), made.ticks, seed=seed)
        streams = {name: run[name] for name in ("imu", "vicon")}
        flight = Flight(f"own-{seed}", streams, run["truth"], known, experiment=made)
        found.append((find_graph("ekf").case(flight), flight))
    return found


def test_a_world_of_ones_own_is_flown_whole_whatever_its_clocks_are_called() -> None:
    clocks = {"clock": ticks("20ms", until="1.5s"), "seen": ticks("100ms", until="1.5s")}
    made = Experiment(own_world, clocks, {"world": RoundTrip(2.0, trip=0.4, rest=0.1)})
    found = flights_of_their_own(made)
    whole = whole_case(made, *found)
    assert whole is not None
    for seed, (case, _) in enumerate(found):
        got = whole.score(simulate(whole.graph, whole.inputs, seed=seed))
        want = case.score(simulate(case.graph, case.inputs, seed=seed))
        assert got == pytest.approx(want, rel=1e-9, abs=1e-9)
    taken = replace(made, ticks={"imu": clocks["clock"], "vicon": clocks["seen"]}, world=swapped)
    assert whole_case(taken, *flights_of_their_own(taken)) is None, "of clocks that mean another stream"


@graph
def swapped(imu: Stream[Tick], vicon: Stream[Tick], *, world: RoundTrip):
    """The pose comes at each other tick of the unit, and nothing at the clock of its name."""
    motion = world_motion(at=imu, world=world)
    pose = read_pose(world_motion(at=imu.every(2), world=world), position_noise=0.01, attitude_noise=0.01)
    return {
        "imu": read_imu(motion, gyro=0.01, accelerometer=0.1),
        "vicon": pose,
        "truth": true_state(motion),
        "other": world_motion(at=vicon, world=world),
    }
