"""The Kalman filter: predict and correct a Gaussian, with what its users ask for first.

- The covariance is corrected in Joseph form, so it stays symmetric, and positive up to rounding; the
  blocks of `roots` carry a triangular root of it instead, whose square cannot become negative.
- A measurement of which some entries are NaN corrects with the others (`arrays(..., not_finite="keep")` lets
  NaN pass as data). Nothing of the missing entries reaches the result.
- The innovation is an output with its normalised square (NIS), and an optional gate on it, which is as strict
  with a part of a measurement as with all of it.
- A state or measurement of angles and quaternions is declared once, as a `StateSpace`.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001: secs. 5.2 (filter, Joseph form) and 5.4 (NIS).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block, real, when
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.kalman.matrices import noise_matrix, observation_matrix
from flowgraph.blocks.kalman.robust import Robust, reweighted
from flowgraph.blocks.metrics.chi_square import gate_table
from flowgraph.blocks.signals import Gaussian, KalmanInnovation
from flowgraph.recorder.namespaces import solve_positive

__all__ = [
    "Correction",
    "Vector",
    "correct",
    "predict_linear",
    "update_extended",
    "update_linear",
]

Vector = Annotated[Any, real("m")]
"""A control or a measurement: m real numbers."""


Observe = Callable[..., Array | tuple[Array, Array]]
"""What is seen of a state, with or without its Jacobian."""


class Resets(Protocol):
    """What says how an error turns when its state is moved: a `StateSpace`, for one."""

    def reset(self, d: Array, xp: Any) -> Array | None:
        """The Jacobian (..., t, t) of the error when the state moves by d (..., t); None where it is I."""


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
    mean, F, Q = model.linearised(belief.mean, control, dt, xp)
    return Gaussian(mean=mean, covariance=_symmetric(F @ belief.covariance @ F.mT + Q))


@block
def update_linear(
    prior: Gaussian,
    measured: Vector | None,
    scale: Any = None,
    *,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    robust: Robust | None = None,
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
        R: (m, m) covariance of the noise; (m) is its diagonal, and one number the variance of each entry.
        space: of the state, where some of it are angles: x' = x plus K r. (For quaternions:
            `update_extended`.)
        measured_space: of z, where some of it are angles: r = z minus H x.
        gate: when given, a measurement that is too far off changes nothing. Below 1 it is the probability
            with which an honest one passes, such as 0.999; from 1 on the largest nis of a whole measurement,
            as `chi_square_gate` gives it, and where entries are missing one of the same probability
            (`gate_table`).
        robust: when given, `huber()` or `student_t()`, a measurement counts for less that is far off.
        scale: on R, where it is learned (`learned_scale`).

    Returns:
        The posterior, and the innovation where there was one.

    Raises:
        DeclarationError: where H or R does not fit, or R is no covariance.

    Source: Bar-Shalom et al. eqs. 5.2.3-9 to 5.2.3-17. (The thesis prints P' = P + K S K^T: the sign is
    minus.)
    """
    if measured is None:
        return prior, None
    m, n = measured.shape[-1], prior.mean.shape[-1]
    H = observation_matrix(H, m, n, "update_linear.H", kind=prior.mean.dtype, xp=xp)
    predicted = (H @ prior.mean[..., None])[..., 0]
    noise = noise_matrix(R, m, "R", kind=prior.mean.dtype, xp=xp)
    return updated(prior, measured, predicted, H, noise, space, measured_space, gate, robust, xp, scale)


@block
def update_extended(
    prior: Gaussian,
    measured: Vector | None,
    scale: Any = None,
    *,
    observe: Observe,
    R: npt.ArrayLike,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """`update_linear` with a measurement that is any function of the state: z = h(x) + noise.

    Args:
        observe: `observe(x, xp) -> h(x)`, on states one a row, whose Jacobian is derived; or
            `observe(x, xp) -> (h(x), H)`, where H (m, t) is that Jacobian with respect to the tangent
            vectors of `space` and `measured_space`, at x.
        R: as in `update_linear`, in the tangent space of z.
        space, measured_space: of the state and of z, of any parts.
        prior, measured, gate, robust, scale: as in `update_linear`.

    Source: Bar-Shalom et al. sec. 10.3.3; on manifolds Hertzberg et al. 2013, sec. 4.
    """
    if measured is None:
        return prior, None
    predicted, H = observed(observe, prior.mean, space, measured_space, xp)
    noise = noise_matrix(R, H.shape[-2], "R", kind=prior.mean.dtype, xp=xp)
    return updated(prior, measured, predicted, H, noise, space, measured_space, gate, robust, xp, scale)


def correct(
    P: Array,
    residual: Array,
    H: Array,
    R: Array,
    *,
    present: Array | None = None,
    gate: float | None = None,
    space: Resets | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> Correction:
    """The correction that every Kalman filter shares, linear or extended, in Joseph form.

    Args:
        P: prior covariance (..., t, t).
        residual: (..., m); NaN, or 0 and not `present`, where an entry is missing.
        H: Jacobian (..., m, t).
        R: covariance of the noise (..., m, m).
        present: (..., m) which entries there are; None: all.
        gate, robust: as in `update_linear`. The innovation is that of the noise as it was told.
        space: of the state, or what else says how the error turns when the state is corrected.
    """
    if present is None:
        present = ~xp.isnan(residual)
        residual = xp.where(present, residual, 0.0)
    residual = within(residual, gate, xp)
    H, R = masked(H, R, present, xp)
    HP = H @ P
    S = HP @ H.mT + R
    column = residual[..., None]
    solved = solve_positive(S, xp.concat([HP, column], axis=-1), xp)  # K^T and S^-1 r in one factorization
    nis = (column.mT @ solved[..., -1:])[..., 0, 0]
    accepted = accepts(nis, gate, present, xp)
    parts = xp.sum(xp.astype(present, P.dtype), axis=-1)
    if robust is not None:
        R = reweighted(robust, HP @ H.mT, residual, R, parts, xp)
        solved = solve_positive(HP @ H.mT + R, xp.concat([HP, column], axis=-1), xp)
    K = solved[..., :-1].mT
    if gate is not None:
        K = K * xp.astype(accepted, P.dtype)[..., None, None]
    shift = (K @ column)[..., 0]
    turn = None if space is None else space.reset(shift, xp)
    if turn is None:
        turn = xp.eye(P.shape[-1], dtype=P.dtype)
    else:
        K = turn @ K
    rest = turn - K @ H
    innovation = KalmanInnovation(
        residual=residual,
        covariance=S,
        nis=nis,
        parts=parts,
        accepted=accepted,
    )
    return Correction(shift, _symmetric(rest @ P @ rest.mT + K @ R @ K.mT), innovation)


def updated(
    prior: Gaussian, measured: Array, predicted: Array, H: Array, R: Array,
    space: StateSpace | None, measured_space: StateSpace | None, gate: float | None,
    robust: Robust | None, xp: Any, scale: Any = None,
) -> tuple[Gaussian, Any]:  # fmt: skip
    """The posterior and the innovation, of what was measured and predicted, with noise R (m, m)."""
    residual, present = innovate(measured, predicted, measured_space, xp)
    R = scaled(R, scale, xp)
    found = correct(
        prior.covariance, residual, H, R, present=present, gate=gate, space=space, robust=robust, xp=xp
    )
    mean = moved(prior.mean, found.shift, space, xp)
    return Gaussian(mean=mean, covariance=found.covariance), where_any(present, found.innovation, xp)


def scaled(R: Array, scale: Any, xp: Any) -> Array:
    """The covariance of a noise, times its scale (...), where it has one."""
    return R if scale is None else R * xp.asarray(scale, dtype=R.dtype)[..., None, None]


def observed(
    observe: Observe, x: Array, space: StateSpace | None, measured_space: StateSpace | None, xp: Any
) -> tuple[Array, Array]:
    """What is seen of x (n), and the Jacobian (m, t), which is derived where `observe` does not give it."""
    found = observe(x, xp)
    if isinstance(found, tuple):
        return found
    space = StateSpace(euclidean(x.shape[-1])) if space is None else space
    return linearised(observe, x, space, xp, seen=measured_space)


def innovate(measured: Array, predicted: Array, space: StateSpace | None, xp: Any) -> tuple[Array, Array]:
    """Measured minus predicted, 0 where an entry is NaN, and which entries there are."""
    apart = measured - predicted if space is None else space.minus(measured, predicted, xp)
    present = ~xp.isnan(apart)
    return xp.where(present, apart, 0.0), present


def masked(H: Array, R: Array, present: Array, xp: Any) -> tuple[Array, Array]:
    """H and R with zero rows and unit variance for entries that are missing: they then say nothing."""
    here = xp.astype(present, H.dtype)
    both = here[..., :, None] * here[..., None, :]
    return H * here[..., :, None], R * both + xp.eye(H.shape[-2], dtype=H.dtype) * (1.0 - here)[..., None]


FARTHEST = 1e100
"""How far off a measurement is taken to be at most before a gate: the square of more is no number."""


def within(residual: Array, gate: float | None, xp: Any) -> Array:
    """A residual whose NIS is a number, which a gate can refuse; without a gate as it is."""
    return residual if gate is None else xp.clip(residual, -FARTHEST, FARTHEST)


def accepts(nis: Array, gate: float | None, present: Array, xp: Any) -> Array:
    """Whether an innovation (...) of the entries `present` (..., m) passes the gate; all do without one."""
    return passes(nis, gate, xp.sum(xp.astype(present, nis.dtype), axis=-1), present.shape[-1], xp)


def passes(nis: Array, gate: float | None, parts: Array, m: int, xp: Any) -> Array:
    """Whether an innovation (...) of so many parts (...) of m passes the gate; all do without one."""
    if gate is None:
        return nis == nis
    limits, parts = gate_table(gate, m), parts[..., None]
    places = xp.asarray(np.arange(len(limits)), dtype=nis.dtype)
    return nis <= xp.sum(xp.where(parts == places, xp.asarray(limits, dtype=nis.dtype), 0.0), axis=-1)


def moved(mean: Array, shift: Array, space: StateSpace | None, xp: Any) -> Array:
    """The mean, moved by a tangent vector."""
    return mean + shift if space is None else space.plus(mean, shift, xp)


def where_any(present: Array, innovation: KalmanInnovation, xp: Any) -> Any:
    """The innovation, present where any entry was measured."""
    return when(xp.any(present), innovation)


def _symmetric(P: Array) -> Array:
    return 0.5 * (P + P.mT)
