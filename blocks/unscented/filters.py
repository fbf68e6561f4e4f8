"""The unscented Kalman filter: sigma points through the model itself, in place of its Jacobian.

Two blocks, over any state that a `StateSpace` describes. Points of the state are drawn from a root of its
covariance and points of the noise from a root of its own, so the root of neither is ever mixed with the
other's, and the noise goes through the model as it comes: into a rotation, for example. All sums are over
deviations (`sigma_points`), and the corrected covariance is a sum of squares,

    P' = W sum (dx_i - K dz_i)(dx_i - K dz_i)^T + (beta - alpha^2) (K c)(K c)^T + K R K^T

with c the central deviation of the measurements: the Joseph form of this filter. It is what P - K S K^T is in
exact numbers, and stays positive in single precision.

Source: E. Wan and R. van der Merwe, "The unscented Kalman filter for nonlinear estimation", AS-SPCC 2000;
on manifolds C. Hertzberg et al., "Integrating generic sensor fusion algorithms with sound
state representations through encapsulation of manifolds", Information Fusion 14(1), 2013, table 3; S.
Särkkä, "Unscented Rauch-Tung-Striebel smoother", IEEE TAC 53(3), 2008.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import (
    Vector,
    accepts,
    innovate,
    masked,
    moved,
    scaled,
    where_any,
    within,
)
from flowgraph.blocks.kalman.matrices import noise_matrix
from flowgraph.blocks.kalman.robust import Robust, reweighted
from flowgraph.blocks.kalman.triangles import covariance_root, semidefinite_root
from flowgraph.blocks.signals import Gaussian, KalmanInnovation
from flowgraph.blocks.unscented.sigma_points import GAUSSIAN, Cluster, SigmaPoints
from flowgraph.language.block import Limit
from flowgraph.recorder.namespaces import solve_positive

__all__ = [
    "motion_cross",
    "predict_unscented",
    "through_motion",
    "through_observation",
    "unscented_crossing",
    "update_unscented",
]


@block
def predict_unscented(
    belief: Gaussian,
    control,
    *,
    move: Callable[..., Array],
    noise: npt.ArrayLike | None = None,
    Q: npt.ArrayLike | None = None,
    Q_first: bool = False,
    space: StateSpace | None = None,
    points: SigmaPoints = GAUSSIAN,
    dt: float,
    xp: Any,
) -> Gaussian:
    """Predict over `dt` seconds with a control that is held over the step.

        X_0 = x, X_i = x plus +-s L_j          L L^T = P (with Q_first: P + Q dt)
        Y_i = move(X_i, control, w_i, dt)      w_i = 0, or +-s N_j for n_w more pairs with X = x, N N^T =
                                               noise dt
        x' and P' the mean and covariance of the Y_i, and Q dt added to P' (not with Q_first)

    With dt = 0, as at the first firing, this is the identity.

    Args:
        belief: mean (size) and covariance (t, t).
        control: of any type; it goes to `move` as it is.
        move: `move(x, control, w, dt, xp) -> x'`, on x (..., k, size) and w (..., k, n_w), a point a row; w
            is None without noise. w is white noise, integrated over the step.
        noise: (n_w, n_w) spectral density of the noise that goes through `move`.
        Q: (t, t) spectral density of noise that is added, in the tangent space of the state; (t) is its
            diagonal, and one number the density of each entry.
        Q_first: whether it is added before the points are drawn, as Kraft does, so that it goes through the
            model too (Kraft 2003, eqs. 33-35).
        space: of the state; without one it is a vector.
        points: the set of sigma points.
    """
    t, kind = belief.covariance.shape[-1], belief.mean.dtype
    added = None if Q is None else noise_matrix(Q, t, "predict_unscented.Q", kind=kind, xp=xp) * dt
    P = belief.covariance + added if added is not None and Q_first else belief.covariance
    shaken = None if noise is None else _shaken(noise, dt, kind, xp)
    carry = lambda x, w: move(x, control, w, dt, xp)
    mean, P = through_motion(belief.mean, P, carry, shaken, space=space, points=points, xp=xp)
    if added is not None and not Q_first:
        P = P + added
    return Gaussian(mean=mean, covariance=0.5 * (P + P.mT))


def through_motion(
    x: Array,
    P: Array,
    carry: Callable[..., Array],
    shaken: Array | None,
    *,
    space: StateSpace | None,
    points: SigmaPoints,
    xp: Any,
) -> tuple[Array, Array]:
    """The mean and covariance of what a motion makes of a Gaussian (x, P) and of its own noise.

    Args:
        carry: `carry(x, w) -> x'`, on x (..., k, size) and w (..., k, n_w), a point a row.
        shaken: a root (n_w, n_w) of the covariance of w; None: w is None.
        space, points: as in `predict_unscented`.
    """
    apart, w, scale = _placed(P, shaken, space, points, xp)
    cluster = points.cluster(carry(_spread(x, apart, space, xp), w), space, scale, xp)
    return cluster.mean, points.covariance(cluster, cluster, scale)


def motion_cross(
    x: Array,
    P: Array,
    carry: Callable[..., Array],
    shaken: Array | None,
    *,
    space: StateSpace | None,
    points: SigmaPoints,
    xp: Any,
) -> Array:
    """The covariance (..., t, t) of a Gaussian (x, P) and of what `through_motion` makes of it: the sum of
    products of the points, before and after. (Särkkä 2008, eq. 30.)"""
    apart, w, scale = _placed(P, shaken, space, points, xp)
    after = points.cluster(carry(_spread(x, apart, space, xp), w), space, scale, xp)
    return points.covariance(Cluster(x, apart, 0.0 * apart[..., :1, :]), after, scale)


def unscented_crossing(
    move: Callable[..., Array], noise: npt.ArrayLike | None, space: StateSpace | None, points: SigmaPoints
) -> Callable[..., Array]:
    """What `cross_covariance` asks of a filter that predicts with `predict_unscented`.

    Args:
        move, noise, space, points: as there.
    """

    def crossing(belief: Gaussian, control: Any, dt: Any, xp: Any) -> Array:
        shaken = None if noise is None else _shaken(noise, dt, belief.mean.dtype, xp)
        carry = lambda x, w: move(x, control, w, dt, xp)
        return motion_cross(belief.mean, belief.covariance, carry, shaken, space=space, points=points, xp=xp)

    return crossing


def _shaken(noise: npt.ArrayLike, dt: Any, kind: Any, xp: Any) -> Array:
    """A root of noise of a constant density over dt; it is scaled, since the noise over no time has none."""
    extra = np.atleast_1d(np.asarray(noise)).shape[-1]
    density = noise_matrix(noise, extra, "predict_unscented.noise", kind=np.float64, xp=np)
    root = xp.asarray(semidefinite_root(density, xp=np), dtype=kind)
    return root * xp.sqrt(xp.asarray(dt, dtype=kind))


@block
def update_unscented(
    prior: Gaussian,
    measured: Vector | None,
    scale: Any = None,
    *,
    observe: Callable[..., Array],
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    points: SigmaPoints = GAUSSIAN,
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """Correct with z = h(x) + noise, where there is a measurement; without one the prior passes through.

        Z_i = h(X_i)       S = cov(Z) + R      C = cov(X, Z)       K = C S^-1
        x' = x plus K (z minus mean(Z))        P' as in the head of this module

    An entry of z that is NaN counts as not measured. If all are, the prior passes through and there is no
    innovation.

    Args:
        prior: mean (size) and covariance (t, t).
        measured: z; or absent.
        observe: `observe(x, xp) -> h(x)`, on x (..., k, size), a point a row.
        R: as in `update_linear`, in the tangent space of z.
        space, measured_space: of the state and of z; without one it is a vector.
        points: the set of sigma points.
        gate, robust, scale: as in `update_linear`.

    Returns:
        The posterior, and the innovation where there was one.
    """
    if measured is None:
        return prior, None
    seen = lambda x, v: observe(x, xp)
    kind = prior.mean.dtype
    noise = lambda m: scaled(noise_matrix(R, m, "update_unscented.R", kind=kind, xp=xp), scale, xp)
    return through_observation(
        prior, measured, seen, noise, None,
        space=space, measured_space=measured_space, points=points, gate=gate, robust=robust,
        xp=xp,
    )  # fmt: skip


def through_observation(
    prior: Gaussian,
    measured: Array,
    seen: Callable[..., Array],
    added: Callable[[int], Array] | None,
    shaken: Array | None,
    *,
    space: StateSpace | None,
    measured_space: StateSpace | None,
    points: SigmaPoints,
    gate: float | None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, Any]:
    """Correct with what is seen of a Gaussian, and the innovation, present where any entry was measured.

    Args:
        seen: `seen(x, v) -> z`, on x (..., k, size) and v (..., k, n_v), a point a row.
        added: the covariance of noise that is added, by the number of entries; None where it goes in.
        shaken: a root (n_v, n_v) of the covariance of v; None: v is None.
        prior, measured, space, measured_space, points, gate, robust: as in `update_unscented`.
    """
    x, P, kind = prior.mean, prior.covariance, prior.mean.dtype
    apart, v, scale = _placed(P, shaken, space, points, xp)
    z = points.cluster(seen(_spread(x, apart, space, xp), v), measured_space, scale, xp)
    residual, present = innovate(measured, z.mean, measured_space, xp)
    m = residual.shape[-1]
    noise = xp.zeros((m, m), dtype=kind) if added is None else added(m)
    outer, noise = masked(z.outer.mT, noise, present, xp)
    around = Cluster(z.mean, outer.mT, z.centre * xp.astype(present, kind)[..., None, :])
    spread = points.covariance(around, around, scale)
    S = spread + noise
    C = points.covariance(Cluster(x, apart, 0.0 * apart[..., :1, :]), around, scale)
    residual = within(residual, gate, xp)
    column = residual[..., None]
    solved = solve_positive(S, xp.concat([C.mT, column], axis=-1), xp)  # K^T and S^-1 r in one factorization
    nis = (column.mT @ solved[..., -1:])[..., 0, 0]
    accepted = accepts(nis, gate, present, xp)
    parts = xp.sum(xp.astype(present, P.dtype), axis=-1)
    if robust is not None:
        noise = reweighted(robust, spread, residual, noise, parts, xp)
        solved = solve_positive(spread + noise, xp.concat([C.mT, column], axis=-1), xp)
    K = solved[..., :-1].mT * xp.astype(accepted, P.dtype)[..., None, None]
    shift = (K @ column)[..., 0]
    turn = None if space is None else space.reset(shift, xp)
    left, central = apart - around.outer @ K.mT, -around.centre @ K.mT
    if turn is not None:
        left, central, K = left @ turn.mT, central @ turn.mT, turn @ K
    rest = Cluster(x, left, central)
    P = points.covariance(rest, rest, scale) + K @ noise @ K.mT
    posterior = Gaussian(mean=moved(x, shift, space, xp), covariance=0.5 * (P + P.mT))
    innovation = KalmanInnovation(
        residual=residual,
        covariance=S,
        nis=nis,
        parts=parts,
        accepted=accepted,
    )
    return posterior, where_any(present, innovation, xp)


@predict_unscented.limited
@update_unscented.limited
def _limits(*, points: SigmaPoints = GAUSSIAN, **_: Any) -> Sequence[Limit]:
    return points.limits()


def _placed(
    P: Array, shaken: Array | None, space: StateSpace | None, points: SigmaPoints, xp: Any
) -> tuple[Array, Array | None, Any]:
    """The outer points (..., 2 (t + n), t) as tangent vectors, the noises (..., 1 + 2 (t + n), n) of all, and
    the scale."""
    n = 0 if shaken is None else shaken.shape[-1]
    root = covariance_root(P, xp=xp)
    scale = points.reach(root, points.scale(P.shape[-1] + n), space, xp)
    apart = points.around(root, scale, xp)
    if shaken is None:
        return apart, None, scale
    blown = points.around(shaken, scale, xp)
    still = xp.zeros((*blown.shape[:-2], 1 + apart.shape[-2], n), dtype=P.dtype)
    none = xp.zeros((*apart.shape[:-2], 2 * n, P.shape[-1]), dtype=P.dtype)
    return xp.concat([apart, none], axis=-2), xp.concat([still, blown], axis=-2), scale


def _spread(x: Array, apart: Array, space: StateSpace | None, xp: Any) -> Array:
    """The centre and the outer points (..., 1 + k, size) around it."""
    centre = x[..., None, :]
    outer = centre + apart if space is None else space.plus(centre, apart, xp)
    return xp.concat([centre, outer], axis=-2)
