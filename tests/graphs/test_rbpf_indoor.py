"""The Rao-Blackwellized particle filter: accuracy, the same numbers in every engine, and draws that stay
put."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import pytest

from flowgraph import (
    Case,
    DataError,
    DeclarationError,
    Flight,
    Result,
    Scalar,
    Series,
    Stream,
    graph,
    simulate,
)
from flowgraph.blocks.flights import simulated
from flowgraph.blocks.geometry.rotations import geodesic_angle
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.metrics.errors import interpolate_pose, pose_errors
from flowgraph.blocks.particles.cloud import start_cloud
from flowgraph.blocks.particles.resampling import SCHEMES
from flowgraph.blocks.signals import Imu, Pose
from flowgraph.graphs.rbpf_indoor import rbpf_indoor
from tests.bench import direct_eskf, direct_rbpf

SETTINGS: dict[str, Any] = {
    "noise": ImuNoise(3e-3, 1e-2, 0.0, 0.0),
    "position_noise": 0.01,
    "attitude_noise": 0.01,
    "still": 1.0,
}


@functools.cache
def a_flight(seconds: float = 3.0, seed: int = 0) -> Flight:
    return simulated.load(seed=seed, settings={"duration": seconds})


def a_case(particles: int = 100, seconds: float = 3.0, **settings: Any) -> Case:
    return rbpf_indoor.case(a_flight(seconds), particles=particles, **settings)


def same_bits(a: Result, b: Result, outputs: tuple[str, ...] = ("pose", "ancestors")) -> None:
    for name in outputs:
        for leaf, values in a[name].leaves.items():
            np.testing.assert_array_equal(values, b[name][leaf], err_msg=f"{name}.{leaf}")


def agree(a: Result, b: Result) -> None:
    """DESIGN section 5: states within 1e-9, and the same decisions."""
    for leaf in ("index", "resampled"):
        np.testing.assert_array_equal(a["ancestors"][leaf], b["ancestors"][leaf])
    for leaf, values in a["pose"].leaves.items():
        assert np.all(np.abs(b["pose"][leaf] - values) <= 1e-9 * np.maximum(1.0, np.abs(values))), leaf
    for leaf, values in a.state["registers"]["cloud"].items():
        other = b.state["registers"]["cloud"][leaf]
        assert np.all(np.abs(other - values) <= 1e-9 * np.maximum(1.0, np.abs(values))), leaf


@pytest.mark.slow
def test_the_engines_agree():
    pytest.importorskip("jax")
    case = a_case()
    python, reference, xla = (
        simulate(case.graph, case.inputs, engine=e) for e in ("python", "reference", "xla")
    )
    assert np.any(python["ancestors"]["resampled"])
    same_bits(python, reference)
    agree(python, xla)


@pytest.mark.slow
def test_the_engines_agree_with_a_thousand_particles_over_twenty_seconds():
    pytest.importorskip("jax")
    case = a_case(particles=1000, seconds=20.0)
    python, reference, xla = (
        simulate(case.graph, case.inputs, engine=e) for e in ("python", "reference", "xla")
    )
    assert python["ancestors"]["resampled"].sum() > 10
    same_bits(python, reference)
    agree(python, xla)


def test_it_gives_the_numbers_of_the_same_filter_written_by_hand():
    n, flight = 200, a_flight()
    case = a_case(particles=n, still=1.0)
    imu, vicon = flight.streams["imu"], flight.streams["vicon"]
    time, imu_index, pose_index = direct_eskf.ticks(imu.time, vicon.time)
    start = start_cloud(n, position=vicon["position"][0])
    noise = flight.info["imu_noise"].scaled(gyro=3.0, accelerometer=2.0)
    by_hand = direct_rbpf.run(
        time,
        imu_index,
        pose_index,
        np.concatenate([imu["gyro"], imu["specific_force"]], axis=1),
        np.concatenate([vicon["position"], vicon["attitude"]], axis=1),
        start=direct_rbpf.Cloud(*start.__dict__.values()),
        seed=7,
        gyro_noise=noise.gyro,
        accelerometer_noise=noise.accelerometer,
        position_noise=flight.info["position_noise"],
        attitude_noise=flight.info["attitude_noise"],
        resample_below=0.5,
        still=1.0,
    )
    result = simulate(case.graph, case.inputs, seed=7)
    pose = result["pose"]
    found = np.concatenate([pose["position"], pose["velocity"], pose["attitude"]], axis=1)
    np.testing.assert_allclose(found, by_hand.poses, atol=1e-10)
    np.testing.assert_array_equal(result["ancestors"]["index"], by_hand.index)
    np.testing.assert_array_equal(result["ancestors"]["resampled"], by_hand.resampled)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_it_follows_the_flight_with_every_scheme(scheme):
    case = a_case(particles=300, seconds=6.0, scheme=scheme, resample_below=0.5)
    score = case.score(simulate(case.graph, case.inputs))
    assert score["position_rmse_m"] < 0.03
    assert score["attitude_rmse_deg"] < 1.0


@pytest.mark.slow
def test_half_the_precision_is_enough():
    pytest.importorskip("jax")
    case = a_case()
    score = case.score(simulate(case.graph, case.inputs, engine="xla", dtype="float32"))
    assert score["position_rmse_m"] < 0.03
    assert score["attitude_rmse_deg"] < 1.0


def test_it_starts_from_a_given_attitude():
    case = a_case(particles=300, unknown_yaw=False)
    score = case.score(simulate(case.graph, case.inputs))
    assert score["position_rmse_m"] < 0.03
    assert score["attitude_rmse_deg"] < 1.0


def test_all_that_it_collects():
    case = a_case(particles=50)
    result = simulate(case.graph, case.inputs)
    poses = len(a_flight().streams["vicon"])
    at_poses = {"innovation", "effective_sample_size", "depleted", "ancestors"}
    assert set(result.series) == {"pose", "belief"} | at_poses
    for name, series in result.series.items():
        assert len(series) == (poses if name in at_poses else result.ticks)
    for leaf in ("position", "velocity", "attitude"):
        np.testing.assert_array_equal(result["pose"][leaf], result["belief"][leaf])
    plain = a_case(particles=50, covariance=False)
    bare = simulate(plain.graph, plain.inputs)
    assert set(bare.series) == {"pose"} | at_poses
    np.testing.assert_array_equal(bare["pose"]["attitude"], result["pose"]["attitude"])
    size = result["effective_sample_size"]["value"]
    assert np.all((size >= 1.0) & (size <= 50.0 + 1e-9))
    np.testing.assert_array_equal(result["ancestors"]["resampled"], size < 0.5 * 50)


def test_its_parts_fold_into_predict_update_resample_average():
    case = a_case(particles=10)
    folders = {path.split("/")[0] for path in (node.path for node in case.graph.nodes) if "/" in path}
    assert folders == {"predict", "update", "resample", "average"}


# The draws stay where they are.


@graph
def alone(imu: Stream[Imu], vicon: Stream[Pose], *, start):
    """The filter as it is."""
    found = rbpf_indoor(imu, vicon, start=start, **SETTINGS)
    return {"pose": found["pose"], "ancestors": found["ancestors"]}


@graph
def beside_a_sensor(thermometer: Stream[Scalar], imu: Stream[Imu], vicon: Stream[Pose], *, start):
    """The filter beside another sensor, whose ticks fall between its own."""
    warm = thermometer.map(lambda x: x + 1.0)
    found = rbpf_indoor(imu, vicon, start=start, **SETTINGS)
    return {"pose": found["pose"], "ancestors": found["ancestors"], "warm": warm}


@graph
def deep(imu: Stream[Imu], vicon: Stream[Pose], *, start):
    """The filter two levels down, under another name."""
    return alone(imu, vicon, start=start, name="inner")


def _run(which: Any, **extra: Any) -> Result:
    flight = a_flight()
    start = start_cloud(100, position=flight.streams["vicon"]["position"][0])
    return simulate(which.build(start=start), {**flight.streams, **extra}, seed=11)


def test_nesting_changes_no_draw():
    flight = a_flight()
    start = start_cloud(100, position=flight.streams["vicon"]["position"][0])
    plain = simulate(rbpf_indoor.build(start=start, **SETTINGS), flight, seed=11)
    same_bits(plain, _run(alone))
    same_bits(plain, _run(deep))


def test_another_sensor_changes_no_draw():
    time = np.arange(1, 3_000_000_000, 7_000_000)
    same_bits(_run(alone), _run(beside_a_sensor, thermometer=Series(time, np.ones(len(time)))))


def test_two_filters_in_one_graph_need_names_for_their_draws():
    @graph
    def pair(imu: Stream[Imu], vicon: Stream[Pose], *, start, draws):
        a = rbpf_indoor(imu, vicon, start=start, name="a", **SETTINGS)
        b = rbpf_indoor(imu, vicon, start=start, name="b", draws=draws, **SETTINGS)
        return {"a": a["pose"], "b": b["pose"]}

    start = start_cloud(20)
    with pytest.raises(DeclarationError, match="taken by"):
        pair.build(start=start, draws="rbpf_indoor")
    result = simulate(pair.build(start=start, draws="second"), a_flight())
    assert not np.array_equal(result["a"]["attitude"], result["b"]["attitude"])


def test_a_run_goes_on_from_a_saved_state():
    case = a_case(particles=50)
    flight = a_flight()
    whole = simulate(case.graph, case.inputs, seed=4)
    halves = [
        {name: s[(s.time <= 1_500_000_000) == early] for name, s in flight.streams.items()}
        for early in (True, False)
    ]
    first = simulate(case.graph, halves[0], seed=4)
    second = simulate(case.graph, halves[1], state=first.state)
    np.testing.assert_array_equal(
        np.concatenate([first["pose"]["attitude"], second["pose"]["attitude"]]), whole["pose"]["attitude"]
    )


def test_a_flight_without_motion_capture_is_refused():
    flight = a_flight()
    with pytest.raises(DataError, match=r"lacks what rbpf_indoor needs[\s\S]*imu, vicon[\s\S]*got: +imu"):
        rbpf_indoor.case(Flight(flight.name, {"imu": flight.streams["imu"]}, None, flight.info, ()))


@pytest.mark.slow
def test_an_unknown_yaw_is_found_within_three_seconds_in_twenty_flights():
    pytest.importorskip("jax")
    case = a_case(particles=1000, seconds=20.0)
    scores = []
    for seed in range(20):
        flight = a_flight(20.0, seed)
        start = start_cloud(1000, seed=seed, position=flight.streams["vicon"]["position"][0])
        result = simulate(case.graph, flight, engine="xla", seed=seed, init={"cloud": start})
        pose = result["pose"]
        assert flight.truth is not None
        error = geodesic_angle(pose["attitude"], interpolate_pose(flight.truth, pose.time)[1])
        assert np.all(error[pose.time >= 3_000_000_000] < 5.0), f"seed {seed}"
        scores.append(pose_errors(pose, flight.truth))
    assert np.median([s["position_rmse_m"] for s in scores]) < 0.02
    assert np.median([s["attitude_rmse_deg"] for s in scores]) < 0.35
