"""Calibration of raw counts: the fit finds what was made, the graph finds what the fit does."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError, Flight, Series, find_graph, load_flight, simulate
from flowgraph.blocks.inertial import CountsCalibration, calibrated, fit_counts, windows_of
from flowgraph.blocks.signals import Attitude, ImuCounts, Window
from tests.blocks.datasets.test_datasets import course
from tests.graphs.estimation import engines_agree, is_lowered_and_drawn
from tests.recordings import recordings


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sets")
    for n in (1, 2):
        course(folder, n, seconds=8.0)
    return load_flight(f"ese650:{folder}:1")


def whole(flight: Flight, **more: int) -> Window:
    counts, truth = flight.streams["counts"], flight.truth
    assert truth is not None
    seen = truth[np.isfinite(truth["attitude"]).all(axis=1)]
    readings = np.concatenate([counts["gyro"], counts["force"]], axis=1)
    return windows_of(counts.time, readings, seen.time, seen["attitude"], **more)


def test_the_fit_finds_scale_and_zero(flight):
    found = fit_counts([whole(flight)])
    np.testing.assert_allclose(np.diag(found.gyro), 0.016, rtol=0.01)
    np.testing.assert_allclose(found.gyro_zero, [370.0, 372.0, 374.0], atol=0.3)
    np.testing.assert_allclose(found.force_zero, [511.0, 500.0, 505.0], atol=0.5)


def test_a_body_that_accelerates_does_not_shrink_the_scale():
    """Counts hold accelerations that the force leaves out: y on c loses a third of the scale, c on y none."""
    rng = np.random.default_rng(0)
    n = 4000
    force = rng.normal(size=(n, 3)) * [2.0, 2.0, 1.0] + [0.0, 0.0, 9.5]
    counts = (force + rng.normal(size=(n, 3)) * [1.4, 1.4, 0.7]) * 10.0 + [510.0, 500.0, 505.0]
    turns = rng.normal(size=(n, 3))
    windows = [Window(counts=np.hstack([turns, counts]), rate=turns, force=force)]
    usual, aligned = (fit_counts(windows, aligned=a) for a in (False, True))
    assert (np.diag(usual.force) < 0.075).all()
    np.testing.assert_allclose(aligned.force, np.eye(3) * 0.1, atol=0.002)
    np.testing.assert_allclose(aligned.force_zero, [510.0, 500.0, 505.0], atol=3.0)


def test_the_rate_is_that_of_the_body_not_of_the_world(flight):
    """log(R0^T R1) explains what the gyroscope read; log(R1 R0^T), turned into the world, does not."""
    windows = whole(flight)
    truth = flight.truth
    known = np.isfinite(truth["attitude"]).all(axis=1)
    turned = Series(truth.time[known], Attitude(attitude=truth["attitude"][known] * [1, -1, -1, -1]))
    counts = flight.streams["counts"]
    readings = np.concatenate([counts["gyro"], counts["force"]], axis=1)
    world = windows_of(counts.time, readings, turned.time, turned["attitude"])
    left = []
    for w in (windows, world):
        A = np.column_stack([w.counts[:, :3], np.ones(len(w.counts))])
        left.append(np.std(w.rate - A @ np.linalg.lstsq(A, w.rate, rcond=None)[0]))
    assert left[0] < 0.1 * left[1]


def test_the_graph_finds_what_the_fit_finds(flight):
    """The same windows, and (A^T A)^-1 A^T y over all of them."""
    case = find_graph("imu_calibration").case(flight, gated=False)
    result = simulate(case.graph, case.inputs)
    expected = whole(flight)
    np.testing.assert_allclose(result["window"]["counts"], expected.counts, rtol=1e-9)
    np.testing.assert_allclose(result["window"]["rate"], expected.rate, atol=1e-9)
    np.testing.assert_allclose(result["window"]["force"], expected.force, atol=1e-9)
    plain = fit_counts([expected], robust=False)
    beta = CountsCalibration.of(result["gyro"]["value"][-1], result["force"]["value"][-1])
    np.testing.assert_allclose(beta.gyro, plain.gyro, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(beta.force_zero, plain.force_zero, rtol=1e-4)
    score = case.score(result)
    assert score["rate_r2"] > 0.999
    assert score["rate_windows"] == len(expected.counts)


def test_windows_that_do_not_fit_are_left_out(flight):
    """A tenth of the motion capture is garbage; by the calibration of the other set it is told."""
    truth = flight.truth
    q = truth["attitude"] + 0.0
    q[200:280] = [0.5, 0.5, 0.5, 0.5]
    bad = Flight("bad", flight.streams, Series(truth.time, Attitude(attitude=q), gaps=True), flight.info)
    scales = []
    for gated in (True, False):
        case = find_graph("imu_calibration").case(bad, gated=gated)
        result = simulate(case.graph, case.inputs)
        scales.append(CountsCalibration.of(result["gyro"]["value"][-1], result["force"]["value"][-1]))
    np.testing.assert_allclose(np.diag(scales[0].gyro), 0.016, rtol=0.01)
    assert np.abs(np.diag(scales[1].gyro) / 0.016 - 1.0).max() > 0.05
    robust = fit_counts([whole(bad)])
    np.testing.assert_allclose(np.diag(robust.gyro), 0.016, rtol=0.01)


def test_engines_agree(flight):
    part = {n: s[s.time <= s.time[0] + 2 * 10**9] for n, s in flight.streams.items()}
    short = Flight("short", part, flight.truth[:200], flight.info)  # type: ignore[index]
    case = find_graph("imu_calibration").case(short)
    engines_agree(case.graph, case.inputs)
    is_lowered_and_drawn(case, "sums", "window", "collect", "solve")


def test_readings_are_scaled_and_shifted():
    c = CountsCalibration.of(
        np.vstack([np.eye(3) * 0.5, [1.0, 2.0, 3.0]]), np.vstack([np.eye(3), np.zeros(3)])
    )
    counts = ImuCounts(gyro=np.array([[2.0, 4.0, 6.0]]), force=np.array([[1.0, 2.0, 3.0]]))
    imu = calibrated.step(counts, calibration=c, xp=np)
    np.testing.assert_array_equal(imu.gyro, [[2.0, 4.0, 6.0]])
    np.testing.assert_array_equal(imu.specific_force, [[1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(c.gyro_zero, [-2.0, -4.0, -6.0])


def test_what_cannot_be_fitted_is_refused(flight):
    still = Window(counts=np.ones((50, 6)), rate=np.zeros((50, 3)), force=np.zeros((50, 3)))
    with pytest.raises(DataError, match="do not determine the gyroscope's calibration"):
        fit_counts([still])
    with pytest.raises(DataError, match="do not determine"):
        fit_counts([])
    counts = flight.streams["counts"]
    with pytest.raises(DataError, match="share no window"):
        windows_of(counts.time, np.zeros((len(counts), 6)), counts.time + 10**12, np.zeros((len(counts), 4)))
    graph = find_graph("imu_calibration")
    with pytest.raises(DataError, match="a truth with attitudes"):
        graph.case(Flight("bare", flight.streams))
    with pytest.raises(DataError, match="lacks what imu_calibration needs"):
        graph.case(load_flight("sim"))
    with pytest.raises(DeclarationError, match="gate_rate"):
        graph.case(flight, gate_rate=-1.0)


def test_on_a_real_set():
    """Set 3, each window alike: the part of the rates that is explained, at least what was published."""
    folder = recordings("ese650")
    case = find_graph("imu_calibration").case(load_flight(f"ese650:{folder}:3"))
    score = case.score(simulate(case.graph, case.inputs))
    assert score["rate_r2"] > 0.99
    assert score["force_r2"] > 0.95
