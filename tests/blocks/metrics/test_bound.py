"""The posterior Cramér-Rao bound: it is what the paper's formula says, and a linear filter reaches it."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph.blocks.metrics import posterior_bound

K, N = 4, 30


def model(seed, flights=3):
    random = np.random.default_rng(seed)
    F = np.eye(K) + 0.2 * random.standard_normal((N - 1, flights, K, K))
    half = random.standard_normal((N - 1, 1, K, K))
    H = random.standard_normal((2, K))
    seen = random.random(N) < 0.4
    return F, 0.1 * (half @ half.mT + np.eye(K)), H, np.diag([0.3, 0.5]), np.eye(K) * 0.7, seen


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_recursion_of_the_information(seed):
    """Tichavsky et al. 1998, eq. 21, with D11 = F^T Q^-1 F, D12 = -F^T Q^-1 and D22 = Q^-1 + H^T R^-1 H."""
    F, Q, H, R, start, seen = model(seed)
    found = posterior_bound(F, Q, H, R, start=start, measured=seen)
    told = H.T @ np.linalg.inv(R) @ H
    J = np.broadcast_to(np.linalg.inv(start) + seen[0] * told, (3, K, K))
    for k in range(N):
        if k:
            weight = np.linalg.inv(Q[k - 1])
            D11, D12 = F[k - 1].mT @ weight @ F[k - 1], -F[k - 1].mT @ weight
            J = weight + seen[k] * told - D12.mT @ np.linalg.inv(J + D11) @ D12
        np.testing.assert_allclose(found[k], np.linalg.inv(J), rtol=1e-7, atol=1e-9)


def test_the_errors_of_a_kalman_filter_reach_it():
    """Over many runs of a linear system, and not those of one with another gain."""
    F, Q, H, R, start, seen = model(7, flights=1)
    bound = posterior_bound(F, Q, H, R, start=start, measured=seen)[:, 0]
    random = np.random.default_rng(1)
    runs = 4000
    x = random.multivariate_normal(np.zeros(K), start, runs)
    guesses = {1.0: np.zeros((runs, K)), 0.5: np.zeros((runs, K))}
    P = start
    for k in range(N):
        if k:
            P = F[k - 1, 0] @ P @ F[k - 1, 0].T + Q[k - 1, 0]
            x = x @ F[k - 1, 0].T + random.multivariate_normal(np.zeros(K), Q[k - 1, 0], runs)
            guesses = {share: guess @ F[k - 1, 0].T for share, guess in guesses.items()}
        if seen[k]:
            z = x @ H.T + random.multivariate_normal(np.zeros(2), R, runs)
            gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
            guesses = {s: guess + s * (z - guess @ H.T) @ gain.T for s, guess in guesses.items()}
            P = P - gain @ H @ P
        error = {share: np.mean(np.sum((x - guess) ** 2, axis=-1)) for share, guess in guesses.items()}
        assert error[1.0] == pytest.approx(np.trace(bound[k]), rel=0.12)
    assert error[0.5] > 1.2 * np.trace(bound[-1])


def test_an_exact_start_and_a_step_without_noise_stay_exact():
    F, _, H, R, _, seen = model(2)
    assert not posterior_bound(F, np.zeros((K, K)), H, R, start=np.zeros((K, K)), measured=seen).any()
    dark = posterior_bound(F, np.eye(K), H, R, start=np.eye(K), measured=np.zeros(N, dtype=bool))
    np.testing.assert_array_equal(dark[1], F[0] @ F[0].mT + np.eye(K))
