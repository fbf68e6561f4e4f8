"""The Kalman filter: predict and correct a Gaussian, with what its users ask for first.

- The covariance is corrected in Joseph form, so it stays symmetric, and positive up to rounding;
  `predict_root` and `update_root` carry a triangular root of it instead, whose square cannot become negative.
- A measurement of which some entries are NaN corrects with the others (`arrays(..., not_finite="keep")` lets
  NaN pass as data). Nothing of the missing entries reaches the result.
- The innovation is an output with its normalised square (NIS), and an optional gate on it.
- A state or measurement of angles and quaternions is declared once, as a `StateSpace`.

Sources: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001: secs. 5.2 (filter), 5.4 (NIS), 7.2-7.4 (Joseph form, square roots); P. Kaminski, A. Bryson, S. Schmidt,
"Discrete square root filtering: a survey", IEEE TAC 16(6), 1971 (the covariance root by orthogonal
triangularisation).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Signal, block, boolean, real, when
from flowgraph.blocks.linear import LinearModel
from flowgraph.blocks.manifold import StateSpace
from flowgraph.blocks.roots import lower_root, semidefinite_root

__all__ = [
    "Correction",
    "Gaussian",
    "GaussianRoot",
    "KalmanInnovation",
    "Vector",
    "correct",
    "predict_linear",
    "predict_root",
    "update_extended",
    "update_linear",
    "update_root",
]

Vector = Annotated[Any, real("m")]
"""A control or a measurement: m real numbers."""


class Gaussian(Signal):
    """A Gaussian belief: its mean (n) and its covariance (t, t) in the tangent space; t = n for vectors."""

    mean: Array = real("n")
    covariance: Array = real("t", "t")


class GaussianRoot(Signal):
    """A Gaussian belief by the lower triangular root of its covariance: covariance = root root^T."""

    mean: Array = real("n")
    root: Array = real("t", "t")


class KalmanInnovation(Signal):
    """What a measurement said beyond its prediction.

    residual: measured minus predicted, 0 where an entry is missing. covariance: of the residual, as the
    filter expects it; 1 on the diagonal where an entry is missing. nis: residual^T covariance^-1 residual.
    parts: how many entries there were, which is the mean of `nis` in a consistent filter. accepted: whether
    it passed the gate.
    """

    residual: Array = real("m")
    covariance: Array = real("m", "m")
    nis: Array = real()
    parts: Array = real()
    accepted: Array = boolean()


class Correction(NamedTuple):
    """What a measurement does: the gain times the residual, the new covariance, and the innovation."""

    shift: Array
    covariance: Array
    innovation: KalmanInnovation


@block
def predict_linear(belief: Gaussian, control: Vector, *, model: LinearModel, dt: float, xp: Any) -> Gaussian:
    """Predict over `dt` seconds with a linear model and a control that is held over the step.

        x' = F x + G u        P' = F P F^T + Q

    F, G and Q are those of `model` for dt. With dt = 0, as at the first firing, this is the identity.

    Args:
        belief: mean (n) and covariance (n, n).
        control: u (m).
        model: `LinearModel`.

    Source: Bar-Shalom et al. eqs. 5.2.3-2, 5.2.3-5. (R. Fiszel's thesis, 2017, prints S- for S there.)
    """
    F, G, Q = model.discrete(dt, xp, belief.mean.dtype)
    return Gaussian(
        mean=(F @ belief.mean[..., None] + G @ control[..., None])[..., 0],
        covariance=_symmetric(F @ belief.covariance @ F.mT + Q),
    )


@block
def update_linear(
    prior: Gaussian,
    measured: Vector | None,
    *,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """Correct with z = H x + noise, where there is a measurement; without one the prior passes through.

        r = z - H x        S = H P H^T + R        K = P H^T S^-1
        x' = x + K r       P' = (I - K H) P (I - K H)^T + K R K^T

    An entry of z that is NaN counts as not measured. If all are, the prior passes through and there is no
    innovation.

    Args:
        prior: mean (n) and covariance (t, t).
        measured: z (m); or absent.
        H: (m, n).
        R: (m, m) covariance of the noise.
        space: of the state, where some of it are angles: x' = x plus K r. (For quaternions:
            `update_extended`.)
        measured_space: of z, where some of it are angles: r = z minus H x.
        gate: when given, a measurement with a nis above it changes nothing (`chi_square_gate` gives one).

    Returns:
        The posterior, and the innovation where there was one.

    Source: Bar-Shalom et al. eqs. 5.2.3-9 to 5.2.3-17. (The thesis prints P' = P + K S K^T: the sign is
    minus.)
    """
    if measured is None:
        return prior, None
    H = xp.asarray(H, dtype=prior.mean.dtype)
    predicted = (H @ prior.mean[..., None])[..., 0]
    return _update(prior, measured, predicted, H, R, space, measured_space, gate, xp)


@block
def update_extended(
    prior: Gaussian,
    measured: Vector | None,
    *,
    observe: Callable[..., tuple[Array, Array]],
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """`update_linear` with a measurement that is any function of the state: z = h(x) + noise.

    Args:
        observe: `observe(x, xp) -> (h(x), H)`, where H (m, t) is the Jacobian of h with respect to the
            tangent vectors of `space` and `measured_space`, at x.
        R: (m, m) covariance of the noise, in the tangent space of z.
        space, measured_space: of the state and of z, of any parts.
        prior, measured, gate: as in `update_linear`.

    Source: Bar-Shalom et al. sec. 10.3.3; on manifolds Hertzberg et al. 2013, sec. 4.
    """
    if measured is None:
        return prior, None
    predicted, H = observe(prior.mean, xp)
    return _update(prior, measured, predicted, H, R, space, measured_space, gate, xp)


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
    kind, m = prior.mean.dtype, np.shape(H)[0]
    H, R = xp.asarray(H, dtype=kind), xp.asarray(R, dtype=kind)
    residual, present = _residual(measured, (H @ prior.mean[..., None])[..., 0], measured_space, xp)
    H, R = _masked(H, R, present, xp)
    L = prior.root
    top = xp.concat([semidefinite_root(R, xp=xp), H @ L], axis=-1)
    below = xp.concat([0.0 * (H @ L).mT, L], axis=-1)
    whole = lower_root(xp.concat([top, below], axis=-2), xp=xp)
    root_S, gain, new = whole[..., :m, :m], whole[..., m:, :m], whole[..., m:, m:]
    white = xp.linalg.solve(root_S, residual[..., None])
    nis = xp.linalg.vecdot(white[..., 0], white[..., 0])
    accepted = _accepted(nis, gate)
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
    posterior = GaussianRoot(mean=_moved(prior.mean, shift, space, xp), root=root)
    return posterior, _where_any(present, innovation, xp)


def correct(
    P: Array,
    residual: Array,
    H: Array,
    R: Array,
    *,
    present: Array | None = None,
    gate: float | None = None,
    space: StateSpace | None = None,
    xp: Any,
) -> Correction:
    """The correction that every Kalman filter shares, linear or extended, in Joseph form.

    Args:
        P: prior covariance (..., t, t).
        residual: (..., m); 0 where an entry is missing.
        H: Jacobian (..., m, t).
        R: covariance of the noise (..., m, m).
        present: (..., m) which entries there are; None: all.
        gate, space: as in `update_linear`.
    """
    if present is None:
        present = residual == residual
    H, R = _masked(H, R, present, xp)
    HP = H @ P
    S = HP @ H.mT + R
    column = residual[..., None]
    solved = xp.linalg.solve(S, xp.concat([HP, column], axis=-1))  # K^T and S^-1 r in one factorization
    nis = (column.mT @ solved[..., -1:])[..., 0, 0]
    accepted = _accepted(nis, gate)
    K = solved[..., :-1].mT * xp.astype(accepted, P.dtype)[..., None, None]
    shift = (K @ column)[..., 0]
    turn = None if space is None else space.reset(shift, xp)
    rest = xp.eye(P.shape[-1], dtype=P.dtype) - K @ H
    if turn is not None:
        rest, K = turn @ rest, turn @ K
    innovation = KalmanInnovation(
        residual=residual,
        covariance=S,
        nis=nis,
        parts=xp.sum(xp.astype(present, P.dtype), axis=-1),
        accepted=accepted,
    )
    return Correction(shift, _symmetric(rest @ P @ rest.mT + K @ R @ K.mT), innovation)


def _update(
    prior: Gaussian, measured: Array, predicted: Array, H: Array, R: npt.ArrayLike,
    space: StateSpace | None, measured_space: StateSpace | None, gate: float | None, xp: Any,
) -> tuple[Gaussian, Any]:  # fmt: skip
    residual, present = _residual(measured, predicted, measured_space, xp)
    noise = xp.asarray(R, dtype=prior.mean.dtype)
    found = correct(prior.covariance, residual, H, noise, present=present, gate=gate, space=space, xp=xp)
    mean = _moved(prior.mean, found.shift, space, xp)
    return Gaussian(mean=mean, covariance=found.covariance), _where_any(present, found.innovation, xp)


def _residual(measured: Array, predicted: Array, space: StateSpace | None, xp: Any) -> tuple[Array, Array]:
    """Measured minus predicted, 0 where an entry is NaN, and which entries there are."""
    apart = measured - predicted if space is None else space.minus(measured, predicted, xp)
    present = ~xp.isnan(apart)
    return xp.where(present, apart, 0.0), present


def _masked(H: Array, R: Array, present: Array, xp: Any) -> tuple[Array, Array]:
    """H and R with zero rows and unit variance for entries that are missing: they then say nothing."""
    here = xp.astype(present, H.dtype)
    both = here[..., :, None] * here[..., None, :]
    return H * here[..., :, None], R * both + xp.eye(H.shape[-2], dtype=H.dtype) * (1.0 - here)[..., None]


def _accepted(nis: Array, gate: float | None) -> Array:
    return nis == nis if gate is None else nis <= gate


def _moved(mean: Array, shift: Array, space: StateSpace | None, xp: Any) -> Array:
    return mean + shift if space is None else space.plus(mean, shift, xp)


def _where_any(present: Array, innovation: KalmanInnovation, xp: Any) -> Any:
    return when(xp.any(present), innovation)


def _symmetric(P: Array) -> Array:
    return 0.5 * (P + P.mT)
