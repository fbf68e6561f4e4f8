"""Linear passes: all steps at once give what one after the other gives, which is what the formulas say."""

from __future__ import annotations

import numpy as np
import pytest

from flowgraph import DeclarationError, UnknownNameError
from flowgraph.blocks.kalman.parallel import LinearSteps, associative_scan, linear_pass


def problem(count: int, seed: int, *, n: int = 4, m: int = 2) -> tuple[LinearSteps, np.ndarray, np.ndarray]:
    """A model whose matrices change from step to step, with some rows that were not measured."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(count, n, n)) * 0.3
    z = rng.normal(size=(count, m))
    z[rng.random(count) < 0.2] = np.nan
    steps = LinearSteps(
        F=np.eye(n) * 0.9 + 0.1 * rng.normal(size=(count, n, n)),
        u=rng.normal(size=(count, n)),
        Q=root @ np.swapaxes(root, 1, 2) + 0.01 * np.eye(n),
        H=rng.normal(size=(count, m, n)),
        R=np.broadcast_to(np.diag(rng.uniform(0.1, 1.0, m)), (count, m, m)).copy(),
        z=z,
    )
    return steps, rng.normal(size=n), np.eye(n) * 2.0


def by_least_squares(
    steps: LinearSteps, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Smoothed means and covariances by one large information matrix, without any recursion."""
    count, n = steps.u.shape
    information, right = np.zeros((count * n, count * n)), np.zeros(count * n)
    for k, (F, u, Q, H, R, z) in enumerate(zip(*steps, strict=True)):
        here = slice(k * n, (k + 1) * n)
        if k == 0:
            W = np.linalg.inv(F @ covariance @ F.T + Q)
            information[here, here] += W
            right[here] += W @ (F @ mean + u)
        else:
            both = slice((k - 1) * n, (k + 1) * n)
            J, W = np.hstack([-F, np.eye(n)]), np.linalg.inv(Q)
            information[both, both] += J.T @ W @ J
            right[both] += J.T @ W @ u
        if not np.isnan(z).any():
            information[here, here] += H.T @ np.linalg.solve(R, H)
            right[here] += H.T @ np.linalg.solve(R, z)
    P = np.linalg.inv(information)
    x = (P @ right).reshape(count, n)
    return x, np.stack([P[k * n : (k + 1) * n, k * n : (k + 1) * n] for k in range(count)])


@pytest.mark.parametrize("count", [1, 2, 3, 7, 64, 257])
def test_all_at_once_is_one_after_the_other(count):
    given = problem(count, count)
    one, other = (linear_pass(*given, way=way) for way in ("sequential", "parallel"))
    for name, a, b in zip(one._fields, one, other, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-9, atol=1e-9, err_msg=name)


@pytest.mark.parametrize("way", ["sequential", "parallel"])
def test_smoothed_is_what_least_squares_gives(way):
    given = problem(20, 5)
    found = linear_pass(*given, way=way)
    mean, covariance = by_least_squares(*given)
    np.testing.assert_allclose(found.smoothed_mean, mean, atol=1e-9)
    np.testing.assert_allclose(found.smoothed_covariance, covariance, atol=1e-9)
    np.testing.assert_allclose(found.mean[-1], mean[-1], atol=1e-9)


def test_the_same_compiled():
    jax = pytest.importorskip("jax")
    given = problem(50, 9)
    with jax.enable_x64(True):
        run = jax.jit(lambda *a: linear_pass(LinearSteps(*a[:6]), *a[6:], way="parallel", xp=jax.numpy))
        found = run(*given[0], *given[1:])
        for a, b in zip(linear_pass(*given), found, strict=True):
            np.testing.assert_allclose(np.asarray(b), a, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("count", range(1, 18))
def test_prefixes_keep_their_order(count):
    rng = np.random.default_rng(count)
    parts = rng.normal(size=(count, 2, 2))
    (found,) = associative_scan(lambda i, j: [i[0] @ j[0]], [parts], np)
    product = np.eye(2)
    for k in range(count):
        product = product @ parts[k]
        np.testing.assert_allclose(found[k], product, rtol=1e-9)


def test_what_does_not_fit_is_refused():
    steps, mean, covariance = problem(3, 1)
    with pytest.raises(UnknownNameError, match="backwards"):
        linear_pass(steps, mean, covariance, way="backwards")
    with pytest.raises(DeclarationError, match="do not fit") as error:
        linear_pass(steps._replace(u=steps.u[:2]), mean, covariance)
    assert "u (2, 4)" in str(error.value.got)
