"""Consistency: bands, NEES and NIS of errors that are what they say, and of errors that are not."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Array, DataError, Series, Signal, real
from flowgraph.blocks import metrics as c
from flowgraph.blocks.geometry import from_rotation_vector, multiply
from flowgraph.blocks.kalman import update_linear
from flowgraph.blocks.metrics import gate_table, nis_remarks
from flowgraph.blocks.signals import Gaussian, KalmanInnovation, NavigationState, PointBelief

RNG = np.random.default_rng(8)
TIME = np.arange(400) * 5_000_000


def a_truth() -> Series:
    n, none = len(TIME), np.zeros((len(TIME), 3))
    line = TIME[:, None] * 1e-9 * np.array([1.0, -2.0, 0.5])
    q = from_rotation_vector(np.full((n, 3), 0.3), xp=np)
    return Series(TIME, NavigationState(line, none + np.array([1.0, -2.0, 0.5]), q, none, none), name="truth")


def beliefs(scale: float = 1.0) -> Series:
    """Beliefs whose errors are drawn from their covariance, times `scale`."""
    root = RNG.normal(size=(6, 6)) * 0.1
    error = RNG.normal(size=(len(TIME), 6)) @ root.T * scale
    truth = a_truth()
    P = np.broadcast_to(root @ root.T, (len(TIME), 6, 6))
    return Series(TIME, PointBelief(truth["position"] + error[:, :3], truth["velocity"] + error[:, 3:], P))


def test_bands_are_those_of_the_tables():
    np.testing.assert_allclose(c.chi_square_band(2), (0.0506, 7.378), rtol=1e-3)
    np.testing.assert_allclose(c.chi_square_band(4, runs=50), (3.2545, 4.8212), rtol=1e-3)  # 162.7, 241.1
    np.testing.assert_allclose(c.chi_square_gate(3), 16.27, rtol=1e-3)
    assert c.inside([0.0, 1.0, 2.0, 9.0], (0.5, 2.0)) == 0.5


def test_nees_of_one_number_is_its_square_in_deviations():
    np.testing.assert_allclose(c.nees([[3.0], [0.5]], [[[9.0]], [[0.25]]]), [1.0, 1.0])


@pytest.mark.parametrize(("scale", "low", "high"), [(1.0, 5.6, 6.4), (1.5, 12.0, 15.0), (0.5, 1.3, 1.7)])
def test_nees_tells_honest_beliefs_from_others(scale, low, high):
    assert low < c.state_nees(beliefs(scale), a_truth()).mean() < high


def test_an_attitude_error_is_taken_in_the_body():
    truth, turn = a_truth(), np.array([0.01, -0.02, 0.03])
    q = multiply(truth["attitude"], from_rotation_vector(-turn + np.zeros((len(TIME), 3)), xp=np), xp=np)
    error = c.state_error(TIME, truth, truth["position"], truth["velocity"], q)
    np.testing.assert_allclose(error, np.broadcast_to(np.r_[np.zeros(6), turn], error.shape), atol=1e-12)


def test_errors_are_summed_up():
    found = c.error_summary([[3.0, 4.0], [0.0, 1.0]])
    assert found == {"rmse": pytest.approx(np.sqrt(13.0)), "mean": 3.0, "max": 5.0}


def test_errors_of_a_point():
    found = c.point_errors(beliefs(), a_truth(), settle=0.5)
    assert found["compared_ticks"] == 300
    assert found["position_mean_m"] < found["position_rmse_m"] < found["position_max_m"]
    assert 5.0 < found["nees_mean"] < 7.0
    with pytest.raises(DataError, match="no tick of the estimate lies within the truth"):
        c.point_errors(beliefs(), a_truth(), settle=3.0)
    with pytest.raises(DataError, match="no tick of the estimate lies within the truth"):
        c.point_errors(beliefs(), a_truth()[:0])


def innovations(scale: float) -> Series:
    r = RNG.normal(size=(300, 3)) * scale
    missing = RNG.uniform(size=(300, 3)) < 0.3
    missing[:, 0] = False
    r[missing] = 0.0
    S = np.broadcast_to(np.eye(3), (300, 3, 3))
    nis, parts = (r**2).sum(-1), (~missing).sum(-1).astype(float)
    return Series(np.arange(300), KalmanInnovation(r, S, nis, parts, nis < 20.0))


def test_nis_counts_the_entries_that_there_were():
    found = c.nis_summary(innovations(1.0))
    assert found["nis_low"] < found["nis_mean"] < found["nis_high"]
    assert found["nis_inside"] > 0.9
    assert found["nis_count"] == 300.0
    too_large = c.nis_summary(innovations(1.6))
    assert too_large["nis_mean"] > too_large["nis_high"]
    assert too_large["nis_rejected"] > 0.0


class Ungated(Signal):
    """An innovation of one's own, that says nothing of a gate."""

    residual: Array = real(3)
    nis: Array = real()


def test_what_no_gate_is_said_of_is_not_said_to_have_been_accepted():
    r = RNG.normal(size=(200, 3))
    found = c.nis_summary(Series(np.arange(200), Ungated(r, (r**2).sum(-1))))
    assert found["nis_low"] < found["nis_mean"] < found["nis_high"]
    assert "nis_rejected" not in found


@pytest.mark.parametrize("gate", [0.99, 11.345])
def test_a_gate_is_as_strict_with_a_part_of_a_measurement(gate):
    """11.345 is what three numbers stay below with a probability of 0.99."""
    np.testing.assert_allclose(gate_table(gate, 3), [0.0, 6.635, 9.210, 11.345], atol=1e-3)
    assert (gate_table(1e6, 3)[1:] == 1e6).all()
    prior = Gaussian(mean=np.zeros(3), covariance=np.zeros((3, 3)))
    for z, passes in (([3.0, np.nan, np.nan], False), ([2.5, np.nan, np.nan], True), ([3.0, 0.0, 0.0], True)):
        _, found = update_linear.step(prior, np.array(z), H=np.eye(3), R=np.eye(3), gate=gate, xp=np)
        assert bool(found.value.accepted if hasattr(found, "value") else found.accepted) is passes


# -- remarks ---------------------------------------------------------------------------------------------


def judged(nis: np.ndarray, *, parts: float = 3.0, accepted: np.ndarray | None = None) -> Series:
    n = len(nis)
    return Series(
        np.arange(n) * 100_000_000,
        KalmanInnovation(
            residual=np.zeros((n, 3)),
            covariance=np.tile(np.eye(3), (n, 1, 1)),
            nis=nis,
            parts=np.full(n, parts),
            accepted=np.ones(n, dtype=bool) if accepted is None else accepted,
        ),
    )


def test_an_honest_run_has_no_remark():
    for seed in range(20):
        nis = np.random.default_rng(seed).chisquare(3.0, size=400)
        assert nis_remarks("position", judged(nis)) == ()
    assert nis_remarks("position", judged(np.zeros(0))) == ()


def test_a_nis_far_from_one_is_said_with_its_time():
    nis = np.random.default_rng(1).chisquare(3.0, size=400)
    jumped = nis.copy()
    jumped[200:206] += 60.0
    (said,) = nis_remarks("position", judged(jumped))
    assert said.startswith("warning: position: the NIS is far from 1, from 19.")
    (said,) = nis_remarks("", judged(2.0 * nis))
    assert said.startswith("warning: the NIS is far from 1: ")
    assert "told too small" in said
    (said,) = nis_remarks("leica", judged(0.1 * nis))
    assert said.startswith("warning: leica: the NIS is far from 1: 0.09")
    assert "told too large" in said
    assert nis_remarks("leica", judged(0.1 * nis[:19])) == ()  # too few for a mean


def test_what_a_gate_refused_is_not_judged_twice():
    nis = np.random.default_rng(1).chisquare(3.0, size=100)
    nis[50:60] = 1e4
    accepted = nis < 100.0
    (said,) = nis_remarks("position", judged(nis, accepted=accepted))
    assert said.startswith("refused: position: 10 measurements in a row")


def drawn(seed: int, n: int = 400, m: int = 3) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(n, m))


def whitened(white: np.ndarray, *, scale: float = 2.0, accepted: np.ndarray | None = None) -> Series:
    """Innovations whose residuals are so many of their own deviations; the covariance is no diagonal."""
    n, m = white.shape
    root = scale * (np.eye(m) + 0.3 * np.eye(m, k=-1))
    return Series(
        np.arange(n) * 100_000_000,
        KalmanInnovation(
            residual=white @ root.T,
            covariance=np.tile(root @ root.T, (n, 1, 1)),
            nis=(white**2).sum(axis=-1),
            parts=np.full(n, float(m)),
            accepted=np.ones(n, dtype=bool) if accepted is None else accepted,
        ),
    )


def test_innovations_that_know_nothing_of_each_other_are_no_remark():
    for seed in range(30):
        for m in (1, 3, 6):
            assert nis_remarks("position", whitened(drawn(seed, m=m))) == ()
    assert nis_remarks("position", whitened(drawn(0, n=15))) == ()


def test_innovations_that_are_alike_are_said_though_each_is_small():
    """Each is as large as expected; over the whole run, and over a part of it."""
    white = drawn(3)
    for k in range(1, len(white)):
        white[k] = 0.5 * white[k - 1] + np.sqrt(0.75) * white[k]
    (said,) = nis_remarks("vicon", whitened(white))
    assert said.startswith("warning: vicon: one innovation is like the next: 0.4")
    assert nis_remarks("vicon", whitened(white), loose=True) == ()
    part = drawn(3)
    part[100:130] = np.sqrt(0.5) * part[100:130] + 1.1
    (said,) = nis_remarks("", whitened(part))
    assert said.startswith(
        (
            "warning: one innovation is like the next, from 9.",
            "warning: one innovation is like the next, from 10",
        )
    )


def test_innovations_that_lean_one_way_are_said():
    white = drawn(5, m=6)
    white[200:260] += 0.7
    (said,) = nis_remarks("gnss", whitened(white))
    assert said.startswith("warning: gnss: the mean of 40 innovations is not 0, from ")


def test_a_gate_that_refuses_more_than_chance_does_is_said():
    white = drawn(7)
    limit = 16.27  # 99.9 % of three numbers
    honest = (white**2).sum(axis=-1) < limit
    assert nis_remarks("leica", whitened(white, accepted=honest)) == ()
    white[::40] += 4.0
    refused = (white**2).sum(axis=-1) < limit
    (said,) = nis_remarks("leica", whitened(white, accepted=refused))
    assert said.startswith("refused: leica: ")
    assert f"{int((~refused).sum())} of 400 measurements; chance has " in said


def test_a_refused_measurement_that_is_far_off_is_not_hidden_by_one_that_is_not():
    white = np.zeros((400, 3))
    white[10, 0], white[200, 0] = 8.0, 4.05  # the latter is one in a thousand
    said = nis_remarks("leica", whitened(white, accepted=(white**2).sum(axis=-1) < 16.27))[0]
    assert said.startswith("refused: leica: 2 of 400 measurements; chance has ")
    assert said.endswith(" as far off as 1 of them")
