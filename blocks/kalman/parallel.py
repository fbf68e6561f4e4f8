"""A linear filter and smoother over a whole recording, one step after the other or all steps at once.

What a step of a linear filter does is a map that can be joined with the next before it is known where it
begins. So the steps of a recording can be joined in pairs, these in pairs again, and all beliefs are there
after log2(n) rounds of work on stacks, instead of n turns. It is more work in all, some ten times, so that
it pays where much of it is done at once, as on a GPU. Both ways give the same beliefs to rounding.

Source: S. Särkkä and Á. García-Fernández, "Temporal parallelization of Bayesian smoothers", IEEE TAC 66(1),
2021.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array
from flowgraph.errors import DeclarationError, UnknownNameError

__all__ = ["LinearSteps", "Passed", "linear_pass"]

WAYS = ("sequential", "parallel")


class LinearSteps(NamedTuple):
    """The steps of a linear model, and what was measured after each.

    x_k = F_k x_(k-1) + u_k + w_k with covariance Q_k, and z_k = H_k x_k + v_k with R_k. A row of z with a NaN
    was not measured. Shapes: F, Q (T, n, n), u (T, n), H (T, m, n), R (T, m, m), z (T, m).
    """

    F: Array
    u: Array
    Q: Array
    H: Array
    R: Array
    z: Array


class Passed(NamedTuple):
    """Means (T, n) and covariances (T, n, n) after each step, and smoothed, which know all measurements."""

    mean: Array
    covariance: Array
    smoothed_mean: Array
    smoothed_covariance: Array


def linear_pass(
    steps: LinearSteps, mean: Array, covariance: Array, *, way: str = "sequential", xp: Any = np
) -> Passed:
    """Filter and smooth a recording.

    Args:
        steps: of the model, T of them.
        mean, covariance: (n), (n, n), before the first step.
        way: "sequential" or "parallel".
        xp: the array namespace; `jax.numpy` may be compiled around it.

    Raises:
        UnknownNameError: for another way. DeclarationError: where the shapes do not fit together.
    """
    if way not in WAYS:
        raise UnknownNameError("way of a linear pass", way, WAYS)
    _check(steps, mean, covariance)
    known = ~xp.any(xp.isnan(steps.z), axis=-1)
    one = xp.eye(steps.z.shape[-1])
    seen = steps._replace(
        z=xp.where(known[:, None], steps.z, 0.0),
        H=xp.where(known[:, None, None], steps.H, 0.0),
        R=xp.where(known[:, None, None], steps.R, one),
    )
    forward, backward = (_in_turn, _back_in_turn) if way == "sequential" else (_joined, _joined_back)
    means, covariances = forward(seen, mean, covariance, xp)
    return Passed(means, covariances, *backward(seen, means, covariances, xp))


def _check(steps: LinearSteps, mean: Array, covariance: Array) -> None:
    (count, m), n = steps.z.shape, mean.shape[-1]
    wanted = ((count, n, n), (count, n), (count, n, n), (count, m, n), (count, m, m), (count, m))
    if tuple(part.shape for part in steps) != wanted or covariance.shape != (n, n) or not count:
        raise DeclarationError(
            "the steps of a linear pass do not fit together",
            path="linear_pass",
            expected="F, Q (T, n, n), u (T, n), H (T, m, n), R (T, m, m), z (T, m), with T of 1 or more",
            got=", ".join(f"{name} {part.shape}" for name, part in zip(steps._fields, steps, strict=True)),
            fix="give each step matrices of its own, repeated where they are the same",
        )


def _t(matrix: Array, xp: Any) -> Array:
    return xp.matrix_transpose(matrix)


def _by(matrix: Array, vector: Array) -> Array:
    """Matrices (..., a, b) by vectors (..., b)."""
    return (matrix @ vector[..., None])[..., 0]


def _gain(H: Array, R: Array, P: Array, xp: Any) -> Array:
    """K (..., n, m) of a belief with covariance P."""
    S = H @ P @ _t(H, xp) + R
    return _t(xp.linalg.solve(S, H @ P), xp)


def _half(matrix: Array, xp: Any) -> Array:
    return 0.5 * (matrix + _t(matrix, xp))


# -- one after the other -----------------------------------------------------------------------------


def _in_turn(steps: LinearSteps, mean: Array, covariance: Array, xp: Any) -> tuple[Array, Array]:
    means, covariances = [], []
    one = xp.eye(mean.shape[-1])
    for F, u, Q, H, R, z in zip(*steps, strict=True):
        mean, covariance = F @ mean + u, F @ covariance @ F.T + Q
        K = _gain(H, R, covariance, xp)
        rest = one - K @ H
        mean, covariance = mean + K @ (z - H @ mean), rest @ covariance @ rest.T + K @ R @ K.T
        means.append(mean)
        covariances.append(covariance)
    return xp.stack(means), xp.stack(covariances)


def _back_in_turn(steps: LinearSteps, means: Array, covariances: Array, xp: Any) -> tuple[Array, Array]:
    mean, covariance = means[-1], covariances[-1]
    found = [(mean, covariance)]
    for k in range(means.shape[0] - 2, -1, -1):
        F = steps.F[k + 1]
        before = F @ covariances[k] @ F.T + steps.Q[k + 1]
        G = xp.linalg.solve(before, F @ covariances[k]).T
        mean = means[k] + G @ (mean - F @ means[k] - steps.u[k + 1])
        covariance = _half(covariances[k] + G @ (covariance - before) @ G.T, xp)
        found.append((mean, covariance))
    return xp.stack([m for m, _ in reversed(found)]), xp.stack([P for _, P in reversed(found)])


# -- all at once -------------------------------------------------------------------------------------


def associative_scan(join: Callable[[Any, Any], Any], parts: Sequence[Array], xp: Any) -> list[Array]:
    """All prefixes of stacks of elements under a join that is associative: log2 of their number rounds."""
    count = parts[0].shape[0]
    if count < 2:
        return list(parts)
    even, odd = [p[: count - 1 : 2] for p in parts], [p[1::2] for p in parts]
    joined = associative_scan(join, join(even, odd), xp)  # prefixes that end at odd places
    if count == 2:
        rest = [p[:1] for p in parts]
    else:
        later = [p[2::2] for p in parts]
        before = [done[: p.shape[0]] for done, p in zip(joined, later, strict=True)]
        rest = [xp.concat([p[:1], made], axis=0) for p, made in zip(parts, join(before, later), strict=True)]
    return [_interleaved(r, j, xp) for r, j in zip(rest, joined, strict=True)]


def _interleaved(even: Array, odd: Array, xp: Any) -> Array:
    """The rows of two stacks in turn; the first may have one more."""
    count = odd.shape[0]
    pairs = xp.stack([even[:count], odd], axis=1)
    made = xp.reshape(pairs, (2 * count, *even.shape[1:]))
    return xp.concat([made, even[count:]], axis=0) if even.shape[0] > count else made


def _joined(steps: LinearSteps, mean: Array, covariance: Array, xp: Any) -> tuple[Array, Array]:
    F, u, Q, H, R, z = steps
    first = F[0] @ covariance @ F[0].T + Q[0]
    own = xp.concat([first[None], Q[1:]], axis=0)  # of what comes before a step only the first knows
    drift = xp.concat([(F[0] @ mean + u[0])[None], u[1:]], axis=0)
    turn = xp.concat([xp.zeros_like(F[:1]), F[1:]], axis=0)
    S = H @ own @ _t(H, xp) + R
    K = _gain(H, R, own, xp)
    rest = xp.eye(F.shape[-1]) - K @ H
    off = z - _by(H, drift)
    back = _t(xp.linalg.solve(S, H @ turn), xp)  # F^T H^T S^-1
    parts = (
        rest @ turn,
        drift + _by(K, off),
        _half(rest @ own @ _t(rest, xp) + K @ R @ _t(K, xp), xp),
        _by(back, off),
        _half(back @ H @ turn, xp),
    )

    def join(i: Sequence[Array], j: Sequence[Array]) -> list[Array]:
        (A, b, C, eta, J), (B, c, D, nu, L) = i, j
        one = xp.eye(A.shape[-1])
        # B (1 + C L)^-1 and, transposed, A^T (1 + L C)^-1
        left = _t(xp.linalg.solve(_t(one + C @ L, xp), _t(B, xp)), xp)
        right = _t(xp.linalg.solve(_t(one + L @ C, xp), A), xp)
        return [
            left @ A,
            _by(left, b + _by(C, nu)) + c,
            _half(left @ C @ _t(B, xp), xp) + D,
            _by(right, nu - _by(L, b)) + eta,
            _half(right @ L @ A, xp) + J,
        ]

    found = associative_scan(join, parts, xp)
    return found[1], found[2]


def _joined_back(steps: LinearSteps, means: Array, covariances: Array, xp: Any) -> tuple[Array, Array]:
    F, u = steps.F[1:], steps.u[1:]
    now, P = means[:-1], covariances[:-1]
    before = F @ P @ _t(F, xp) + steps.Q[1:]
    G = _t(xp.linalg.solve(before, F @ P), xp)
    parts = (
        xp.concat([G, xp.zeros_like(covariances[-1:])], axis=0),
        xp.concat([now - _by(G, _by(F, now) + u), means[-1:]], axis=0),
        xp.concat([_half(P - G @ before @ _t(G, xp), xp), covariances[-1:]], axis=0),
    )

    def join(j: Sequence[Array], i: Sequence[Array]) -> list[Array]:
        (B, c, D), (A, b, C) = j, i  # j comes later: the stacks are turned round
        return [A @ B, _by(A, c) + b, _half(A @ D @ _t(A, xp), xp) + C]

    found = associative_scan(join, [xp.flip(p, axis=0) for p in parts], xp)
    return xp.flip(found[1], axis=0), xp.flip(found[2], axis=0)
