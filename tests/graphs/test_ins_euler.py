"""`tag_pose` and the 15-state filters with Euler angles: engines, lowering, accuracy, bad input."""

from __future__ import annotations

import inspect
import os
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from flowgraph import (
    Case,
    DataError,
    DeclarationError,
    Flight,
    LoweringError,
    Series,
    UnknownNameError,
    find_graph,
    load_flight,
    lower,
    simulate,
)
from flowgraph.blocks.metrics.errors import interpolate_pose, pose_errors, within_truth
from flowgraph.blocks.scoring.euler import SingularityWarning
from flowgraph.blocks.vision.mapping import map_of
from flowgraph.blocks.vision.motion import camera_motion_of
from flowgraph.blocks.vision.pnp import as_measurements, rotation_of
from flowgraph.drawing.trajectory import plot_ins, plot_space
from flowgraph.graphs import ins_ekf_pose, ins_particle, ins_ukf_pose, ins_ukf_velocity, tag_pose
from flowgraph.graphs.benches.apriltag import (
    SPANS,
    apriltag,
    drift,
    held_out,
    lasting,
    odd_reprojection,
    withheld,
)
from flowgraph.graphs.tag_pose import poses_of
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("FLOWGRAPH_DATA", ROOT.parent / "shared" / "datasets"))
VICON = pytest.mark.skipif(not (DATA / "nyu_rob6213").is_dir(), reason="no nyu_rob6213 under $FLOWGRAPH_DATA")
MAT = pytest.mark.skipif(not (DATA / "apriltag_umd").is_dir(), reason="no apriltag_umd under $FLOWGRAPH_DATA")
GRAPHS = [ins_ekf_pose, ins_ukf_pose, ins_ukf_velocity, ins_particle]
FEW: dict[str, Any] = {"ins_particle": {"particles": 50}}


@cache
def flight(seconds: float = 1.0, seed: int = 1) -> Flight:
    """A simulated flight of the course, with the poses of PnP as a stream."""
    made = load_flight("course", seed=seed, settings={"duration": str(seconds)})
    return Flight(made.name, {**made.streams, "pose": poses_of("test", made)}, made.truth, made.info)


@cache
def recorded(number: int) -> Flight:
    return load_flight(f"rob6213:{DATA / 'nyu_rob6213' / f'proj2_dataset{number}.mat'}")


def case_of(graph: Any, made: Flight, **settings: Any) -> Case:
    found: Case = graph.case(made, **{**FEW.get(graph.name, {}), **settings})
    return found


def run(graph: Any, made: Flight, **settings: Any) -> dict[str, float]:
    case = case_of(graph, made, **settings)
    return case.score(simulate(case.graph, case.inputs))


def raw_error(made: Flight) -> float:
    assert made.truth is not None
    return pose_errors(made.streams["pose"], made.truth, settle=1.0)["position_rmse_m"]


@pytest.mark.slow
@pytest.mark.parametrize("graph", GRAPHS, ids=lambda g: g.name)
def test_the_engines_agree(graph):
    pytest.importorskip("jax")
    case = case_of(graph, flight(0.3), settle=0.0)
    engines_agree(case.graph, case.inputs)


@pytest.mark.parametrize("graph", GRAPHS, ids=lambda g: g.name)
def test_it_is_lowered_and_drawn(graph):
    is_lowered_and_drawn(case_of(graph, flight(0.3)), "predict", "update", "navigation_belief")


def test_pnp_stays_on_the_host_and_lowering_says_so():
    """The filter's pipeline begins at the pose, and holds nothing of the host."""
    case = tag_pose.case(flight(0.3))
    assert "on the host" in case.graph.text()
    with pytest.raises(LoweringError, match=r"pnp[\s\S]*host"):
        lower(case.graph)
    pipeline = lower(ins_ukf_pose.case(flight(0.3)).graph)
    assert not any("pnp" in stage.path for stage in pipeline.stages)


@pytest.mark.slow
def test_a_whole_flight_of_the_course():
    """108 tags, 0.5 px, an IMU with biases: below half of PnP's error, in both conventions and filters."""
    made = flight(8.0)
    raw = raw_error(made)
    assert 0.003 < raw < 0.01
    for graph, order in ((ins_ukf_pose, "zxy"), (ins_ukf_pose, "zyx"), (ins_ekf_pose, "zxy")):
        score = run(graph, made, order=order)
        assert score["position_rmse_m"] < 0.5 * raw
        assert score["attitude_rmse_deg"] < 0.12
        assert min(score["position_3sigma"], score["tilt_3sigma"], score["heading_3sigma"]) > 0.97
        assert {"nees_mean", "nis_mean", "position_max_m", "least_cosine"} <= set(score)
    case = ins_ukf_pose.case(made)
    belief = simulate(case.graph, case.inputs)["belief"]
    raw_gyro, assumed = made.streams["imu"], made.truth
    assert assumed is not None
    at = np.searchsorted(assumed.time, raw_gyro.time)
    bias = (raw_gyro.gyro - assumed["rate"][at]).mean(axis=0)
    np.testing.assert_allclose(belief.gyro_bias[-1], bias, atol=0.004)


@pytest.mark.slow
def test_5000_particles_are_better_than_pnp():
    made = flight(20.0)
    case = case_of(ins_particle, made, particles=5000)
    pytest.importorskip("jax")
    score = case.score(simulate(case.graph, case.inputs, engine="xla"))
    assert score["position_rmse_m"] < raw_error(made)


@pytest.mark.slow
def test_a_camera_velocity_bounds_the_drift():
    """The same flight without it goes astray by an order of magnitude."""
    made = flight(8.0)
    for rate in ("gyro", "camera"):
        assert run(ins_ukf_velocity, made, rate=rate)["position_rmse_m"] < 0.1
    without = run(ins_ukf_velocity, made, velocity_noise=1e3)["position_rmse_m"]
    assert without > 1.0


def test_a_roll_through_its_singularity_warns_and_the_other_convention_does_not():
    """A full turn about x, at 1 rad/s: phi passes +-90 degrees in both; only zxy fails there."""
    time = np.arange(0, 500) * 10_000_000
    angle = time * 1e-9
    from flowgraph.blocks.signals import Imu

    none = np.zeros_like(angle)
    q = np.stack([np.cos(angle / 2), np.sin(angle / 2), none, none], axis=1)
    force = 9.81 * np.stack([none, np.sin(angle), np.cos(angle)], axis=1)
    gyro = np.stack([none + 1.0, none, none], axis=1)
    position = np.zeros((500, 3))
    base = flight(0.3)
    streams = {
        "imu": Series(time, Imu(gyro=gyro, specific_force=force)),
        "pose": Series(time[::5], as_measurements(position[::5], q[::5])),
    }
    truth = Series(
        time,
        type(base.streams["pose"].values)(position, q, np.zeros((500, 6, 6)), none, none.astype(np.int32)),
    )
    rolling = Flight("rolling", streams, truth, base.info)
    for graph in (ins_ekf_pose, ins_ukf_pose):
        with pytest.warns(SingularityWarning, match=r"zxy, phi \(roll\) = \+-90 degrees"):
            score = run(graph, rolling, order="zxy")
        assert np.isfinite(list(score.values())).all()
        score = run(graph, rolling, order="zyx")
        assert score["attitude_rmse_deg"] < 0.5


@pytest.mark.parametrize("graph", [ins_ekf_pose, ins_ukf_pose], ids=lambda g: g.name)
def test_it_takes_a_motion_capture_too(graph):
    score = run(graph, load_flight("sim", seed=1, settings={"duration": "3"}))
    assert score["position_rmse_m"] < 0.05


# Bad input


def test_bad_input_is_refused():
    made = flight(0.3)
    with pytest.raises(UnknownNameError, match=r"zxy, zyx"):
        ins_ukf_pose.case(made, order="xyz")
    with pytest.raises(UnknownNameError, match=r"all, even, odd"):
        tag_pose.case(made, tags="some")
    with pytest.raises(UnknownNameError, match=r"camera, gyro"):
        ins_ukf_velocity.case(made, rate="wheel")
    for graph in GRAPHS:
        with pytest.raises(DeclarationError, match=r"gyro_factor"):
            graph.case(made, gyro_factor=-1.0)
    with pytest.raises(DeclarationError, match=r"particles"):
        ins_particle.case(made, particles=0)
    blind = Flight("blind", {"imu": made.streams["imu"]}, made.truth, made.info)
    with pytest.raises(DataError, match=r"lacks what ins_ukf_pose needs[\s\S]*pose, tags and vicon"):
        ins_ukf_pose.case(blind)
    with pytest.raises(DataError, match=r"lacks what ins_ukf_velocity needs"):
        ins_ukf_velocity.case(blind)
    lost = Flight("lost", {k: made.streams[k] for k in ("imu", "motion")}, None, made.info)
    with pytest.raises(DataError, match=r"does not tell where ins_ukf_velocity starts"):
        ins_ukf_velocity.case(lost)
    tags = made.streams["tags"]
    values = tags.values.replace(ids=tags["ids"] + 1000)
    strange = Flight(
        "strange", {"imu": made.streams["imu"], "tags": Series(tags.time, values)}, None, made.info
    )
    with pytest.raises(DataError, match=r"no image of this flight gives a pose"):
        ins_ukf_pose.case(strange)


# Pictures


def test_the_pictures(tmp_path):
    made = flight(1.0)
    case = ins_ukf_pose.case(made)
    belief = simulate(case.graph, case.inputs)["belief"]
    figure = plot_space(belief, made.truth, made.streams["pose"], tmp_path / "space.png")
    (axis,) = figure.axes
    spans = [np.ptp(getattr(axis, f"get_{n}lim")()) for n in "xyz"]  # type: ignore[attr-defined]
    np.testing.assert_allclose(spans, spans[0])
    legend = axis.get_legend()
    assert legend is not None
    assert [t.get_text() for t in legend.get_texts()] == [
        "observed", "truth", "estimate", "start", "end",
    ]  # fmt: skip
    figure = plot_ins(belief, made.truth, made.streams["pose"], tmp_path / "states.png")
    titles = [a.get_title(loc="left") for a in figure.axes]
    assert {"roll", "pitch", "yaw", "velocity x", "gyro bias z", "error of position"} <= set(titles)
    assert (tmp_path / "space.png").stat().st_size > 10_000
    assert len(plot_ins(belief).axes) == 15
    with pytest.raises(DataError, match=r"there is nothing to plot"):
        plot_space(belief[:0])


# Recordings


@VICON
@pytest.mark.parametrize("number", [1, 4])
def test_recorded_poses_are_bettered(number):
    """At most 0.7 of the recorded vision's error, which is that of poses in the tags' own frame."""
    made = recorded(number)
    assert "info: imu: derived from the motion capture, not recorded" in made.notes
    raw = load_flight(
        f"rob6213:{DATA / 'nyu_rob6213' / f'proj2_dataset{number}.mat'}", settings={"frame": "raw"}
    )
    score = run(ins_ukf_pose, made, order="zyx")
    assert score["position_rmse_m"] <= 0.7 * raw_error(raw)
    assert score["attitude_rmse_deg"] < 0.6


@VICON
@pytest.mark.parametrize(("number", "other"), [(1, 4), (4, 1)])
def test_the_shift_between_the_worlds_may_come_from_the_other_flight(number, other):
    """Nothing of a flight's own truth then goes into its poses; 0.7 is reached all the same."""
    raw = {
        n: load_flight(f"rob6213:{DATA / 'nyu_rob6213' / f'proj2_dataset{n}.mat'}", settings={"frame": "raw"})
        for n in (number, other)
    }
    pose, truth = raw[other].streams["pose"], raw[other].truth
    assert truth is not None
    seen = within_truth(pose, truth, 0.0)
    shift = (interpolate_pose(truth, seen.time)[0] - seen["position"]).mean(axis=0)
    made = raw[number]
    pose = made.streams["pose"]
    moved = Series(pose.time, as_measurements(pose["position"] + shift, pose["attitude"]))
    used = Flight(made.name, {**made.streams, "pose": moved}, made.truth, made.info)
    assert run(ins_ukf_pose, used, order="zyx")["position_rmse_m"] <= 0.7 * raw_error(made)


@pytest.mark.slow
@VICON
@pytest.mark.parametrize("number", [1, 4])
def test_recorded_velocities_do_not_diverge(number):
    """Over any span, the horizontal place drifts less with the gyroscope's rate than with the camera's.

    Not so the height: the optical flow's own error, 0.03 m/s for all of flight 4, outweighs the rate there.
    """
    made = recorded(number)
    far: dict[str, float] = {}
    grown: dict[str, np.ndarray] = {}
    assert made.truth is not None
    for rate in ("gyro", "camera"):
        case = case_of(ins_ukf_velocity, made, rate=rate)
        result = simulate(case.graph, case.inputs)
        score = case.score(result)
        assert score["position_rmse_m"] < 0.2
        assert score["tilt_rmse_deg"] < 0.5
        belief = within_truth(result["belief"], made.truth, 1.0)
        apart = belief["position"] - interpolate_pose(made.truth, belief.time)[0]
        far[rate] = np.sqrt(np.mean(np.sum(apart[:, :2] ** 2, axis=1)))
        grown[rate] = np.array([drift(result["belief"], made.truth, span) for span in SPANS])
    assert far["gyro"] < far["camera"] < 0.07
    better = grown["gyro"] < grown["camera"]
    assert better[:, 1].all()
    assert better[:, 0].all() or number == 4
    assert grown["camera"][:, 1].max() < 0.06


@VICON
@pytest.mark.parametrize(("number", "falling"), [(1, -0.03), (4, -0.07)])
def test_the_optical_flow_reads_a_descent_too_slow(number, falling):
    """Why the height of flight 4 drifts: no mount, lever or scale is wrong by itself in one direction."""
    made = recorded(number)
    assert made.truth is not None
    motion = made.streams["motion"]
    motion = motion[(motion.time >= made.truth.time[0]) & (motion.time <= made.truth.time[-1])]
    expected, _ = camera_motion_of(made.truth, motion.time, made.info["mount"])
    down = expected[:, 2]
    error = motion["velocity"][:, 2] - down
    assert falling < error[down > 0.2].mean() < -0.008
    assert abs(error[down < -0.2].mean()) < 0.005


def test_drift_is_what_the_error_grows_by():
    made = flight(1.0)
    truth = made.truth
    assert truth is not None
    seconds = truth.seconds[:, None] - truth.seconds[0]
    walked = truth["position"] + seconds * np.array([0.3, 0.4, 1.2])
    belief = Series(truth.time, truth.values.replace(position=walked), name="belief")
    np.testing.assert_allclose(drift(belief, truth, 0.25), (0.25 * 1.3, 0.25 * 0.5), rtol=1e-9)
    shifted = Series(truth.time, truth.values.replace(position=truth["position"] + 1.0), name="belief")
    np.testing.assert_allclose(drift(shifted, truth, 0.25), 0.0, atol=1e-12)
    with pytest.raises(DataError, match=r"shorter than the span[\s\S]*more than 5 s"):
        drift(belief, truth, 5.0)


def test_what_lasts_of_a_reprojection():
    """Corners with noise of their own in each image keep nothing; a wrong map keeps nearly all."""
    made = flight(1.0)
    truth, tags = made.truth, made.streams["tags"]
    assert truth is not None
    position, attitude = interpolate_pose(truth, tags.time)
    poses = dict(zip(tags.time.tolist(), zip(position, rotation_of(attitude), strict=True), strict=True))
    tag_map = map_of(made)
    assert abs(lasting(made, tag_map, poses)) < 0.1
    shaken = np.random.default_rng(1).normal(scale=4e-3, size=tag_map.corners.shape)
    assert lasting(made, replace(tag_map, corners=tag_map.corners + shaken), poses) > 0.5
    with pytest.raises(DataError, match=r"no odd tag is seen twice"):
        lasting(made, tag_map, {})


def test_the_kalman_filters_of_poses_share_their_settings():
    kinds = [inspect.signature(cast(Any, g.prepare)).parameters for g in (ins_ekf_pose, ins_ukf_pose)]
    assert list(kinds[0].values()) == [p for n, p in kinds[1].items() if n not in ("alpha", "beta", "kappa")]
    assert {"order", "tags", "gate", "position_noise", "R", "gyro_bias_noise"} <= set(kinds[0])


@MAT
@pytest.mark.slow
@pytest.mark.parametrize("name", ["Square", "Mapping"])
def test_tags_that_took_no_part_are_where_the_filter_puts_them(name):
    made = load_flight(f"umd:{DATA / 'apriltag_umd' / f'Data{name}New.mat'}")
    tag_map = map_of(made)
    made = Flight(made.name, made.streams, None, {**made.info, "tag_map": tag_map})
    pixels, apart = held_out(made, tag_map)
    assert pixels <= 1.2
    assert apart <= 6.6e-3
    even = poses_of("test", made, tags="even")
    blind, hidden = withheld(even, 0.5)
    used = Flight(made.name, {**made.streams, "pose": blind}, None, made.info)
    case = ins_ukf_pose.case(used)
    belief = simulate(case.graph, case.inputs)["belief"]
    of = lambda s: odd_reprojection(
        made, tag_map, dict(zip(s.time.tolist(), zip(s["position"], _matrices(s), strict=True), strict=True))
    )
    # what PnP errs by lasts: little is left that a filter could average
    raw = dict(zip(even.time.tolist(), zip(even["position"], _matrices(even), strict=True), strict=True))
    assert lasting(made, tag_map, raw) > 0.85
    ours, held = of(belief), of(blind)
    middle = lambda found, times: np.median(np.concatenate([found[t] for t in times if t in found]))
    assert middle(ours, list(held)) < middle(held, list(held))
    assert middle(ours, hidden) < 0.6 * middle(held, hidden)


def _matrices(series: Series) -> np.ndarray:
    from flowgraph.blocks.vision.pnp import rotation_of

    return rotation_of(series["attitude"])


def test_the_bench_gives_a_table_without_recordings(tmp_path):
    report = apriltag(data=str(tmp_path), seconds=2.0)
    assert [r["what"] for r in report.rows] == ["PnP", "ins_ekf_pose", "ins_ukf_pose"]
    assert report.rows[2]["of_raw"] < 1.0
    assert any("no recordings under" in n for n in report.notes)
    for name, draw in report.figures.items():
        draw(tmp_path / name)
        assert (tmp_path / name).is_file()
    assert find_graph("ins_particle") is ins_particle
