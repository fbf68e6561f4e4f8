"""The Kalman filter on triangular roots of covariances, out of operations that every backend has.

A covariance P = L L^T kept as its root L has twice the digits and cannot become negative. Filters on roots
need one thing: the triangle of a wide matrix, usually by a QR factorization. That is no instruction of a
pipeline, so here it is written out: one Householder reflection a row, a fixed number of them.

The linear filter is here whole, of the extended one the correction. Its prediction is its user's own model:
`predict_root` shows the one line that it takes, the triangle of [F L, Q^(1/2)]. The graph `ekf` does not run
on roots: its 10 x 10 covariance is singular along the quaternion.

Sources: G. Golub and C. Van Loan, "Matrix Computations", 4th ed., 2013: algorithms 5.1.1, 5.2.1 and 4.2.2
(the triangles); P. Kaminski, A. Bryson, S. Schmidt, "Discrete square root filtering: a survey", IEEE TAC
16(6), 1971 (the filter).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import Vector, accepts, innovate, masked, moved, where_any
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.matrices import noise_matrix, observation_matrix
from flowgraph.blocks.signals import GaussianRoot, KalmanInnovation

__all__ = [
    "covariance_root",
    "lower_root",
    "predict_root",
    "semidefinite_root",
    "update_extended_root",
    "update_root",
]

_FIRM = 1e-12
"""The share of its diagonal from which a pivot is not made by rounding: Cholesky's signs are then sure."""


@block
def predict_root(
    belief: GaussianRoot, control: Vector, *, model: LinearModel, dt: float, xp: Any
) -> GaussianRoot:
    """`predict_linear` on a root: L' is the triangle of [F L, Q^(1/2)], so P' = F P F^T + Q without being
    formed.

    Source: Kaminski et al. 1971, sec. IV.
    """
    F, G, Q = model.discrete(dt, xp, belief.mean.dtype)
    wide = xp.concat([F @ belief.root, semidefinite_root(Q, xp=xp)], axis=-1)
    return GaussianRoot(
        mean=(F @ belief.mean[..., None] + G @ control[..., None])[..., 0], root=lower_root(wide, xp=xp)
    )


@block
def update_root(
    prior: GaussianRoot,
    measured: Vector | None,
    *,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    xp: Any,
) -> tuple[GaussianRoot, KalmanInnovation | None]:
    """`update_linear` on a root. One triangularisation holds all of it:

        [R^(1/2)  H L]          [S^(1/2)    0 ]
        [0          L]  Theta = [K S^(1/2)  L']        Theta orthogonal

    Nothing is subtracted from a covariance, so P' = L' L'^T cannot become negative.

    Source: Kaminski et al. 1971, sec. IV.
    """
    if measured is None:
        return prior, None
    m, n = measured.shape[-1], prior.mean.shape[-1]
    H = observation_matrix(H, m, n, "update_root.H", kind=prior.mean.dtype, xp=xp)
    predicted = (H @ prior.mean[..., None])[..., 0]
    return _update(prior, measured, predicted, H, R, space, measured_space, gate, xp)


@block
def update_extended_root(
    prior: GaussianRoot,
    measured: Vector | None,
    *,
    observe: Callable[..., tuple[Array, Array]],
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    xp: Any,
) -> tuple[GaussianRoot, KalmanInnovation | None]:
    """`update_extended` on a root: `update_root` with the Jacobian that `observe` gives at the prior."""
    if measured is None:
        return prior, None
    predicted, H = observe(prior.mean, xp)
    return _update(prior, measured, predicted, H, R, space, measured_space, gate, xp)


def _update(
    prior: GaussianRoot, measured: Array, predicted: Array, H: Array, R: npt.ArrayLike,
    space: StateSpace | None, measured_space: StateSpace | None, gate: float | None, xp: Any,
) -> tuple[GaussianRoot, Any]:  # fmt: skip
    kind, m = prior.mean.dtype, H.shape[-2]
    R = noise_matrix(R, m, "R", kind=kind, xp=xp)
    residual, present = innovate(measured, predicted, measured_space, xp)
    H, R = masked(H, R, present, xp)
    L = prior.root
    top = xp.concat([semidefinite_root(R, xp=xp), H @ L], axis=-1)
    below = xp.concat([0.0 * (H @ L).mT, L], axis=-1)
    whole = lower_root(xp.concat([top, below], axis=-2), xp=xp)
    root_S, gain, new = whole[..., :m, :m], whole[..., m:, :m], whole[..., m:, m:]
    white = xp.linalg.solve(root_S, residual[..., None])
    nis = xp.linalg.vecdot(white[..., 0], white[..., 0])
    accepted = accepts(nis, gate, present, xp)
    shift = (gain @ white)[..., 0] * xp.astype(accepted, kind)[..., None]
    turn = None if space is None else space.reset(shift, xp)
    new = new if turn is None else lower_root(turn @ new, xp=xp)
    innovation = KalmanInnovation(
        residual=residual,
        covariance=root_S @ root_S.mT,
        nis=nis,
        parts=xp.sum(xp.astype(present, kind), axis=-1),
        accepted=accepted,
    )
    root = xp.where(accepted[..., None, None], new, L)
    posterior = GaussianRoot(mean=moved(prior.mean, shift, space, xp), root=root)
    return posterior, where_any(present, innovation, xp)


def lower_root(wide: Array, *, xp: Any) -> Array:
    """The lower triangle L (..., n, n) with L L^T = A A^T and no negative diagonal, of A (..., n, m), m >= n.

    A is turned from the right by n reflections, each of which clears one row beyond its diagonal; A A^T is
    never formed. A row of zeros stays one.
    """
    n, m = wide.shape[-2:]
    one = np.eye(m)
    for j in range(n):
        row = wide[..., j, :] * xp.asarray(np.arange(m) >= j, dtype=wide.dtype)
        first = row[..., j : j + 1]
        length = xp.sqrt(xp.linalg.vecdot(row, row))[..., None]
        u = row + xp.where(first < 0.0, -length, length) * xp.asarray(one[j], dtype=wide.dtype)
        square = xp.linalg.vecdot(u, u)[..., None]
        scale = xp.where(square > 0.0, 2.0 / xp.where(square > 0.0, square, 1.0), 0.0)
        wide = wide - (wide @ u[..., None]) * (scale * u)[..., None, :]
    lower = xp.tril(wide[..., :n])
    diagonal = xp.sum(lower * xp.eye(n, dtype=lower.dtype), axis=-2)
    return lower * xp.where(diagonal < 0.0, -1.0, 1.0)[..., None, :]


def semidefinite_root(P: Array, *, xp: Any) -> Array:
    """The lower triangle L (..., n, n) with L L^T = P, for a P that may be singular, or zero.

    Cholesky's factorization by outer products; a pivot below 1e-15 of its own diagonal counts as zero.
    """
    return _outer_root(P, xp)[0]


def covariance_root(P: Array, *, xp: Any) -> Array:
    """`semidefinite_root`, which is Cholesky's own wherever P is clearly positive definite.

    So a filter whose start is known in some direction goes on, and others have the digits of Cholesky.
    """
    if isinstance(P, np.ndarray):  # the same root, without computing what will not be taken
        try:
            root = np.linalg.cholesky(P)
        except np.linalg.LinAlgError:
            root = np.zeros_like(P)
        pivots, variances = (np.diagonal(x, axis1=-2, axis2=-1) for x in (root, P))
        if (pivots * pivots > 2.0 * _FIRM * variances).all():
            return root
    root, firm = _outer_root(P, xp)
    firm = firm[..., None, None]
    return xp.where(firm, xp.linalg.cholesky(xp.where(firm, P, xp.eye(P.shape[-1], dtype=P.dtype))), root)


def _outer_root(P: Array, xp: Any) -> tuple[Array, Array]:
    """The root, and whether (...) every pivot is well above the rounding of its diagonal."""
    n = P.shape[-1]
    variance = xp.sum(P * xp.eye(n, dtype=P.dtype), axis=-1)
    columns, firm = [], variance[..., :1] > 0.0
    for j in range(n):
        pivot, least = P[..., j, j : j + 1], variance[..., j : j + 1]
        solid = (pivot > least * 1e-15) & (pivot > 0.0)
        firm = firm & (pivot > least * _FIRM)
        column = P[..., :, j] / xp.sqrt(xp.where(solid, pivot, 1.0)) * xp.astype(solid, P.dtype)
        columns.append(column)
        P = P - column[..., :, None] * column[..., None, :]
    return xp.tril(xp.stack(columns, axis=-1)), firm[..., 0] & xp.all(variance > 0.0, axis=-1)
