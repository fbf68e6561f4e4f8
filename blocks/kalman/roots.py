"""The Kalman filter on triangular roots of covariances.

A covariance P = L L^T kept as its root L has twice the digits and cannot become negative. All that filters on
roots need is the triangle of a wide matrix; see `triangles`.

The linear filter is here whole, of the extended one the correction. Its prediction is its user's own model:
`predict_root` shows the one line that it takes, the triangle of [F L, Q^(1/2)]. The graph `ekf` does not run
on roots: its 10 x 10 covariance is singular along the quaternion.

Source: P. Kaminski, A. Bryson, S. Schmidt, "Discrete square root filtering: a survey", IEEE TAC 16(6), 1971.
"""

from __future__ import annotations

from typing import Any

import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import (
    Observe,
    Vector,
    accepts,
    innovate,
    masked,
    moved,
    observed,
    where_any,
    within,
)
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.matrices import noise_matrix, observation_matrix
from flowgraph.blocks.kalman.triangles import lower_root, semidefinite_root
from flowgraph.blocks.signals import GaussianRoot, KalmanInnovation

__all__ = ["correct_root", "predict_root", "update_extended_root", "update_root"]


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
    observe: Observe,
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    xp: Any,
) -> tuple[GaussianRoot, KalmanInnovation | None]:
    """`update_extended` on a root: `update_root` with the Jacobian that `observe` gives at the prior."""
    if measured is None:
        return prior, None
    predicted, H = observed(observe, prior.mean, space, measured_space, xp)
    return _update(prior, measured, predicted, H, R, space, measured_space, gate, xp)


def _update(
    prior: GaussianRoot, measured: Array, predicted: Array, H: Array, R: npt.ArrayLike,
    space: StateSpace | None, measured_space: StateSpace | None, gate: float | None, xp: Any,
) -> tuple[GaussianRoot, Any]:  # fmt: skip
    R = noise_matrix(R, H.shape[-2], "R", kind=prior.mean.dtype, xp=xp)
    residual, present = innovate(measured, predicted, measured_space, xp)
    shift, root, innovation = correct_root(
        prior.root, residual, H, R, present=present, gate=gate, space=space, xp=xp
    )
    posterior = GaussianRoot(mean=moved(prior.mean, shift, space, xp), root=root)
    return posterior, where_any(present, innovation, xp)


def correct_root(
    L: Array, residual: Array, H: Array, R: Array, *,
    present: Array, gate: float | None = None, space: StateSpace | None = None, xp: Any,
) -> tuple[Array, Array, KalmanInnovation]:  # fmt: skip
    """The correction on a root: the gain times the residual, the new root, and the innovation.

    Args:
        L: prior root (..., t, t).
        residual, H, R, present, gate, space: as for `correct`; a missing entry of the residual is 0.
    """
    kind, m = L.dtype, H.shape[-2]
    residual = within(residual, gate, xp)
    H, R = masked(H, R, present, xp)
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
    return shift, xp.where(accepted[..., None, None], new, L), innovation
