"""A belief that has lost track: when that is said, what becomes of its covariance, and of a root of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flowgraph.blocks.kalman import UNKNOWN_TURN, find_back, in_doubt
from flowgraph.blocks.signals import Gaussian, GaussianRoot, KalmanInnovation


def told(accepted: bool, nis: float = 100.0, parts: float = 3.0) -> KalmanInnovation:
    """What `find_back` reads of an innovation."""
    return KalmanInnovation(
        residual=np.zeros(3),
        covariance=np.eye(3),
        nis=np.float64(nis),
        parts=np.float64(parts),
        accepted=np.bool_(accepted),
    )


def a_covariance(n: int, seed: int = 0) -> np.ndarray:
    root = np.random.default_rng(seed).normal(size=(n, n)) * 0.1
    return root @ root.T + 0.01 * np.eye(n)


def doubted(P: np.ndarray, words: str, **settings: Any) -> list[np.ndarray]:
    """The covariance after each of some measurements: `r` is refused, `.` passes."""
    state, found = np.float64(0.0), []
    belief = Gaussian(mean=np.zeros(len(P)), covariance=P)
    for word in words:
        state, after = find_back.step(state, belief, told(word == "."), xp=np, **settings)
        found.append(after.covariance)
    return found


@pytest.mark.parametrize(("words", "lost"), [
    ("rrr", "   "), ("rrr.rrr", "       "), ("rrrr", "   x"), ("rrrr.r", "   x x"), ("rrrr..r", "   x   "),
    ("rrrrr.r.r..r", "   xx x x   "), ("....", "    "),
])  # fmt: skip
def test_track_is_lost_after_so_many_refusals_and_trusted_again_after_two_that_pass(words, lost):
    P = a_covariance(6)
    found = doubted(P, words, patience=3, moving=6)
    assert "".join("x" if (after != P).any() else " " for after in found) == lost


def test_what_moves_is_as_unsure_as_the_residual_was_far_and_biases_keep_what_they_know():
    P = 0.1 * a_covariance(15)
    (after,) = doubted(P, "r", patience=0, moving=9, attitude=6)
    np.testing.assert_allclose(np.diag(after)[:9], np.diag(P)[:9] * 100.0 / 3.0)
    np.testing.assert_array_equal(after[:9, :9], np.diag(np.diag(after)[:9]))
    np.testing.assert_array_equal(after[9:, 9:], P[9:, 9:])
    np.testing.assert_array_equal(after[:9, 9:], 0.0)
    (hidden,) = doubted(P, "r", patience=0, moving=9, attitude=6, shown=False)
    np.testing.assert_allclose(np.diag(hidden)[6:9], np.diag(P)[6:9] * 16.0)
    np.testing.assert_allclose(np.diag(hidden)[:6], np.diag(after)[:6])
    (turn,) = doubted(P, "r", patience=0, moving=(6, 9), attitude=6)
    kept = [*range(6), *range(9, 15)]
    np.testing.assert_array_equal(turn[np.ix_(kept, kept)], P[np.ix_(kept, kept)])
    np.testing.assert_array_equal(turn[6:9][:, kept], 0.0)


@pytest.mark.parametrize("n", [9, 10])
def test_an_attitude_becomes_no_less_sure_than_unknown_and_a_place_has_a_reach(n):
    belief = Gaussian(mean=np.zeros(n), covariance=np.eye(n))
    _, after = find_back.step(
        np.float64(9.0), belief, told(False, nis=1e13), patience=0, moving=n, attitude=6, xp=np
    )
    np.testing.assert_allclose(np.diag(after.covariance)[:6], 1e12)
    unknown = UNKNOWN_TURN**2 if n == 9 else 1.0  # of half angles, and no less than it was
    np.testing.assert_allclose(np.diag(after.covariance)[6:], unknown)


@pytest.mark.parametrize("nis", [1e15, np.inf, np.nan])
def test_of_a_measurement_of_which_nothing_can_be_made_nothing_is_learned(nis):
    P = a_covariance(6)
    belief = Gaussian(mean=np.zeros(6), covariance=P)
    state, after = find_back.step(np.float64(9.0), belief, told(False, nis=nis), patience=3, moving=6, xp=np)
    np.testing.assert_array_equal(after.covariance, P)
    assert state == 10.0


@pytest.mark.parametrize("moving", [6, 4])
def test_a_root_is_doubted_as_its_square(moving):
    P = a_covariance(6)
    root = GaussianRoot(mean=np.zeros(6), root=np.linalg.cholesky(P))
    _, after = find_back.step(np.float64(0.0), root, told(False), patience=0, moving=moving, xp=np)
    (square,) = doubted(P, "r", patience=0, moving=moving)
    np.testing.assert_allclose(after.root @ after.root.T, square, atol=1e-12)
    _, after = find_back.step(np.float64(0.0), root, told(True), patience=0, moving=moving, xp=np)
    np.testing.assert_array_equal(after.root, root.root)


def test_variances_grow_sixteenfold_at_least():
    one = np.float64(1.0)
    _, lost, grow = in_doubt(5.0 * one, np.bool_(False), 2.0 * one, 3.0 * one, patience=5.0, xp=np)
    assert lost
    assert grow == 16.0
    count, lost, grow = in_doubt(9.0 * one, np.bool_(True), 2.0 * one, 3.0 * one, patience=5.0, xp=np)
    assert (count, lost, grow) == (5.0, False, 1.0)
