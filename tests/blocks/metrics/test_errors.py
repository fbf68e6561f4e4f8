"""Errors against a truth, and how honest a filter's covariance is."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.metrics import tilt_and_heading_nees
from flowgraph.blocks.signals import Attitude, AttitudeBiasBelief


def claimed(claim: float, seed: int, n: int = 4000) -> tuple[Series, Series]:
    """Random attitudes whose errors have a full covariance in the body, and a filter that claims `claim`
    times as much."""
    rng = np.random.default_rng(seed)
    q = rng.normal(size=(n, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    root = rng.normal(size=(3, 3)) * 0.01
    true = multiply(q, from_rotation_vector(rng.normal(size=(n, 3)) @ root.T, xp=np), xp=np)
    P = np.zeros((n, 6, 6))
    P[:, :3, :3] = claim * root @ root.T
    time = np.arange(n, dtype=np.int64) * 10**7
    belief = AttitudeBiasBelief(attitude=q, gyro_bias=np.zeros((n, 3)), covariance=P)
    return Series(time, belief), Series(time, Attitude(attitude=true))


@pytest.mark.parametrize(("claim", "seed"), [(1.0, 0), (4.0, 1), (0.25, 2)])
def test_the_nees_of_tilt_and_heading_is_chi_square(claim, seed):
    tilt, heading = tilt_and_heading_nees(*claimed(claim, seed))
    assert np.median(tilt) * claim == pytest.approx(1.386, rel=0.08)
    assert np.median(heading) * claim == pytest.approx(0.455, rel=0.08)
    assert np.mean(tilt) * claim == pytest.approx(2.0, rel=0.08)
    assert np.mean(heading) * claim == pytest.approx(1.0, rel=0.08)


def test_a_wrong_heading_is_no_error_of_the_tilt():
    estimate, truth = claimed(1.0, 3, 50)
    turn = from_rotation_vector(np.array([0.0, 0.0, 2.0]), xp=np)
    away = Series(truth.time, Attitude(attitude=multiply(turn, estimate["attitude"], xp=np)))
    tilt, heading = tilt_and_heading_nees(estimate, away)
    assert tilt.max() < 1e-12
    assert heading.min() > 100.0
