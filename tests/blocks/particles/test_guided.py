"""Kernels about particles: what is known of the Gaussian case, and how a cloud is judged."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Series
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.particles.guided import corrected, drawn, spread_of
from flowgraph.blocks.particles.lost import depletion_remarks, verdict, within_reach
from flowgraph.blocks.particles.resampling import roughening
from flowgraph.blocks.signals import Depletion

FLAT = StateSpace(euclidean(3))
H = np.eye(2, 3)
R = np.diag([0.04, 0.09])
Z = np.array([0.7, -0.4])


@pytest.mark.parametrize("bandwidth", [0.0, 0.4, 0.8, 1.0])
def test_kernels_of_a_gaussian_cloud_have_the_kalman_posterior(bandwidth):
    """Whatever their width: mean and covariance of the cloud are kept, and the correction is exact."""
    rng = np.random.default_rng(1)
    n = 40_000
    root = np.array([[0.5, 0.0, 0.0], [0.2, 0.4, 0.0], [0.3, -0.1, 0.3]])
    x = rng.normal(size=(n, 3)) @ root.T
    weight = np.full(n, 1.0 / n)
    mean = weight @ x
    spread = spread_of(x, weight, mean, space=FLAT, xp=np)
    found = corrected(
        mean, spread, np.log(weight), lambda m: Z - m @ H.T, H, R, space=FLAT, bandwidth=bandwidth, xp=np
    )
    P = spread.covariance
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    w = np.exp(found.log_weight)
    assert w.sum() == pytest.approx(1.0)
    centre = w @ found.middle
    apart = found.middle - centre
    np.testing.assert_allclose(centre, mean + K @ (Z - H @ mean), atol=0.02)
    whole = (apart * w[:, None]).T @ apart + found.covariance
    np.testing.assert_allclose(whole, (np.eye(3) - K @ H) @ P, atol=0.006)


def test_wider_kernels_have_more_even_weights():
    rng = np.random.default_rng(2)
    x, weight = rng.normal(size=(500, 3)), np.full(500, 1.0 / 500)
    mean = weight @ x
    spread = spread_of(x, weight, mean, space=FLAT, xp=np)
    sizes = []
    for h in (0.0, 0.5, 0.9):
        w = np.exp(
            corrected(
                mean, spread, np.log(weight), lambda m: Z - m @ H.T, H, R, space=FLAT, bandwidth=h, xp=np
            ).log_weight
        )
        sizes.append(1.0 / (w @ w))
    assert sizes[0] < 0.6 * sizes[1] < 0.6 * sizes[2]


@pytest.mark.parametrize("even", [True, False])
def test_points_are_drawn_with_the_mean_and_covariance_that_are_asked_for(even):
    rng = np.random.default_rng(3)
    n, root = 40, np.array([[0.5, 0.0, 0.0], [0.2, 0.4, 0.0], [0.3, -0.1, 0.3]])
    weight = np.full(n, 1.0 / n) if even else rng.dirichlet(np.ones(n))
    mean, covariance = np.array([1.0, -2.0, 3.0]), root @ root.T
    points = drawn(
        rng.normal(size=(n, 3)),
        0.3 * root,
        rng.normal(size=(n, 3)),
        weight,
        mean,
        covariance,
        space=FLAT,
        xp=np,
    )
    np.testing.assert_allclose(weight @ points, mean, atol=1e-12)
    np.testing.assert_allclose(
        spread_of(points, weight, mean, space=FLAT, xp=np).covariance, covariance, atol=1e-12
    )


def test_points_that_are_as_asked_for_stay():
    rng = np.random.default_rng(4)
    x, weight = rng.normal(size=(20, 3)), rng.dirichlet(np.ones(20))
    V = spread_of(x, weight, weight @ x, space=FLAT, xp=np).covariance
    points = drawn(x, np.zeros((3, 3)), rng.normal(size=(20, 3)), weight, weight @ x, V, space=FLAT, xp=np)
    np.testing.assert_allclose(points, x, atol=1e-12)


@pytest.mark.parametrize("n", [1, 3, 20])
def test_points_that_lie_in_a_plane_are_only_centred(n):
    """Or too few: nothing stretches them into what they do not span."""
    x = np.random.default_rng(5).normal(size=(n, 3))
    if n > 3:
        x[:, 2] = x[:, 0] - x[:, 1]
    weight, mean = np.full(n, 1.0 / n), np.array([1.0, -2.0, 3.0])
    points = drawn(x, np.zeros((3, 3)), np.zeros((n, 3)), weight, mean, np.eye(3), space=FLAT, xp=np)
    np.testing.assert_allclose(points, x - weight @ x + mean, atol=1e-12)


def test_roughening_goes_by_the_range_of_the_sample():
    apart = np.array([[0.0, -1.0], [2.0, 1.0], [1.0, 5.0], [0.5, 0.0]])
    np.testing.assert_allclose(roughening(apart, 0.2, xp=np), 0.2 * 4**-0.5 * np.array([2.0, 6.0]))


def judged(state, residual, **settings):
    present = np.array([True, True])
    return verdict(np.float64(state), np.array(residual), R, present, xp=np, **settings)


def test_a_gate_refuses_for_as_long_as_it_has_patience():
    for state, accepted, grows in ((0.0, False, False), (4.0, False, False), (5.0, True, True)):
        count, innovation, grow = judged(state, [3.0, 0.0], gate=0.999, patience=5)
        assert (count, bool(innovation.accepted), bool(grow > 1.0)) == (state + 1.0, accepted, grows)
    count, innovation, grow = judged(4.0, [0.1, 0.0], gate=0.999, patience=5)
    assert (count, bool(innovation.accepted), grow) == (0.0, True, 1.0)


def test_without_a_gate_all_is_believed_of_which_something_can_be_made():
    count, innovation, grow = judged(0.0, [3.0, 0.0], gate=None, patience=5)
    assert (count, bool(innovation.accepted), grow) == (1.0, True, 1.0)
    _, innovation, grow = judged(0.0, [3.0, 0.0], gate=None, patience=5, at_once=True)
    assert innovation.accepted
    assert grow == pytest.approx(225.0 / 2.0)
    for far in (1e160, -1e300, np.inf, np.nan):
        _, innovation, grow = judged(9.0, [far, 0.0], gate=None, patience=5, at_once=True)
        assert not innovation.accepted
        assert grow == 1.0
    np.testing.assert_array_equal(within_reach(np.array([1e160, -1e13, 3.0]), xp=np), [1e12, -1e12, 3.0])


@pytest.mark.parametrize(
    ("pattern", "said"),
    [("0000000000000000", False), ("1000000000000001", False), ("0011100000000000", True),
     ("1001001001000100", True)],
)  # fmt: skip
def test_depletion_is_a_note_where_it_lasts_or_is_often(pattern, said):
    flags = np.array([c == "1" for c in pattern])
    series = Series(np.arange(len(flags)) * 10**9, Depletion(depleted=flags), name="depleted")
    remarks = depletion_remarks("", series)
    assert bool(remarks) is said
    assert all(r.startswith("warning: the cloud was depleted") for r in remarks)
