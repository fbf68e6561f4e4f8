"""Learning a linear model: what a peer learns, and what was put in."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DataError, DeclarationError
from flowgraph.blocks.kalman.learning import LEARNT, LinearGaussian, learn
from flowgraph.errors import UnknownNameError

BEGIN = LinearGaussian(
    F=[[1.0, 0.3], [-0.1, 0.9]], Q=np.eye(2), H=[[1.0, 0.2]], R=[[1.0]], mean=[0.5, -0.5],
    covariance=np.eye(2),
)  # fmt: skip
TRUE = LinearGaussian(
    F=[[0.95, 0.25], [-0.2, 0.9]], Q=[[0.3, 0.05], [0.05, 0.1]], H=[[1.0, 0.2]], R=[[0.2]], mean=[1.0, 0.0],
    covariance=0.5 * np.eye(2),
)  # fmt: skip


def measured(T: int, *, seed: int = 2, lost: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    x, rows = rng.multivariate_normal(TRUE.mean, TRUE.covariance), []
    for _ in range(T):
        rows.append(TRUE.H @ x + rng.normal(size=1) * np.sqrt(TRUE.R[0]))
        x = TRUE.F @ x + rng.multivariate_normal(np.zeros(2), TRUE.Q)
    z = np.array(rows)
    z[1:][rng.random(T - 1) < lost] = np.nan
    return z


@pytest.mark.parametrize("what", [("Q", "R", "mean", "covariance"), LEARNT, ("F", "covariance")])
@pytest.mark.parametrize("lost", [0.0, 0.2])
def test_five_rounds_are_those_of_a_peer(what, lost):
    pykalman = pytest.importorskip("pykalman", reason="a peer: pip install 'flowgraph-filters[test]'")
    z = measured(60, lost=lost)
    names = {
        "F": "transition_matrices", "Q": "transition_covariance", "H": "observation_matrices",
        "R": "observation_covariance", "mean": "initial_state_mean", "covariance": "initial_state_covariance",
    }  # fmt: skip
    peer = pykalman.KalmanFilter(**{word: getattr(BEGIN, n) for n, word in names.items()})
    peer = peer.em(np.ma.masked_invalid(z), n_iter=5, em_vars=[names[n] for n in what])
    found = learn(BEGIN, z, rounds=5, what=what)
    for name, word in names.items():
        np.testing.assert_allclose(getattr(found.model, name), getattr(peer, word), rtol=0, atol=1e-9)


def test_no_round_explains_the_recording_worse_and_the_noise_that_was_put_in_is_found():
    z = measured(1500)
    begin = LinearGaussian(TRUE.F, 4.0 * np.eye(2), TRUE.H, [[2.0]], TRUE.mean, TRUE.covariance)
    found = learn(begin, z, rounds=60, what=("Q", "R"))
    assert np.diff(found.log_likelihoods).min() > -1e-9
    assert len(found.log_likelihoods) == 61
    assert found.model.R[0, 0] == pytest.approx(0.2, abs=0.12)
    np.testing.assert_array_equal(found.model.F, TRUE.F)
    stays = TRUE.F @ found.model.Q @ TRUE.F.T + found.model.Q
    assert np.trace(stays) == pytest.approx(np.trace(TRUE.F @ TRUE.Q @ TRUE.F.T + TRUE.Q), rel=0.3)


def test_what_cannot_be_learnt_is_refused():
    with pytest.raises(UnknownNameError, match="'G'"):
        learn(BEGIN, measured(10), what=("G",))
    with pytest.raises(DataError, match="nothing can be learnt"):
        learn(BEGIN, np.full((10, 1), np.nan))
    with pytest.raises(DataError, match="nothing can be learnt"):
        learn(BEGIN, measured(1))
    with pytest.raises(DeclarationError, match="R does not fit"):
        LinearGaussian(np.eye(2), np.eye(2), [[1.0, 0.0]], [1.0], [0.0, 0.0], np.eye(2))
