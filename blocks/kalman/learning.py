"""Learning a linear model from a recording: expectation and maximisation, in turn.

    x' = F x + w, w ~ N(0, Q)      z = H x + v, v ~ N(0, R)      x_0 ~ N(m, P)

Smoothing the recording with the model as it is gives what the states must have been, with their covariances
P_t and those of neighbours P_t,t-1; the model that makes these most likely is then written down at once, and
each round explains the recording at least as well as the one before. With sums over all steps of

    A = E[x_t-1 x_t-1^T]      B = E[x_t x_t-1^T]      C = E[x_t x_t^T]

    F = B A^-1      Q = (C - B F^T - F B^T + F A F^T) / (T - 1)
    H = sum z E[x]^T (sum E[x x^T])^-1      R = mean of (z - H E[x]) (z - H E[x])^T + H P_t H^T

A round needs no step size and keeps covariances positive; near the end it is slow, where `flowgraph tune`,
which takes any model, is quick.

Source: R. Shumway and D. Stoffer, "An approach to time series smoothing and forecasting using the EM
algorithm", Journal of Time Series Analysis 3(4), 1982.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = ["LEARNT", "Learned", "LinearGaussian", "learn"]

LEARNT = ("F", "Q", "H", "R", "mean", "covariance")
"""What can be learnt, by name."""


@dataclass(frozen=True)
class LinearGaussian:
    """A linear model in steps, and the belief before the first measurement.

    Args:
        F, Q: (n, n) motion of a step and its noise: `DiscreteModel(F, Q)`.
        H, R: (m, n) and (m, m) what is measured and its noise: `LinearMeasurement(space, H, R)`.
        mean, covariance: (n) and (n, n).

    Raises:
        DeclarationError: for shapes that do not fit.
    """

    F: np.ndarray
    Q: np.ndarray
    H: np.ndarray
    R: np.ndarray
    mean: np.ndarray
    covariance: np.ndarray

    def __post_init__(self) -> None:
        for name in LEARNT:
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=float))
        n, m = self.mean.size, len(np.atleast_2d(self.H))
        shapes = {"F": (n, n), "Q": (n, n), "H": (m, n), "R": (m, m), "mean": (n,), "covariance": (n, n)}
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise DeclarationError(
                    f"{name} does not fit the others",
                    path=f"LinearGaussian.{name}",
                    expected=f"shape {shape}, for {n} states and {m} numbers measured",
                    got=f"shape {getattr(self, name).shape}",
                    fix="give matrices, also for one number: [[1.0]]",
                )


@dataclass(frozen=True)
class Learned:
    """What the rounds came to.

    Args:
        model: after the last.
        log_likelihoods: of the recording by the model before each round, and by the last: they do not fall.
    """

    model: LinearGaussian
    log_likelihoods: tuple[float, ...]


def learn(
    model: LinearGaussian,
    measurements: np.ndarray,
    *,
    rounds: int = 10,
    what: Collection[str] = ("Q", "R", "mean", "covariance"),
) -> Learned:
    """Make a linear model more likely, given a recording, by rounds of expectation and maximisation.

    Args:
        model: to begin with.
        measurements: (T, m), evenly spaced; a row with a NaN was not measured.
        rounds: how many.
        what: of `LEARNT`; the others stay.

    Raises:
        UnknownNameError: for another name. DataError: for fewer than two rows, or none that was measured.
    """
    for name in what:
        if name not in LEARNT:
            raise UnknownNameError("part of a linear model", name, LEARNT, path="learn")
    z = np.asarray(measurements, dtype=float)
    if z.ndim != 2 or z.shape[1] != len(model.H) or len(z) < 2 or np.isnan(z).any(axis=1).all():
        raise DataError(
            "nothing can be learnt of this",
            path="learn",
            expected=f"measurements (T, {len(model.H)}) with T from 2, not all missing",
            got=f"shape {z.shape}",
            fix="give a row a step, NaN where nothing was measured",
        )
    found = []
    for _ in range(rounds):
        x, P, pairs, likelihood = _expected(model, z)
        found.append(likelihood)
        model = _most_likely(model, z, x, P, pairs, what)
    found.append(_expected(model, z)[3])
    return Learned(model, tuple(found))


def _expected(model: LinearGaussian, z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Smoothed means (T, n) and covariances, those of each with the one before (T - 1, n, n), and the
    log-likelihood."""
    F, Q, H, R = model.F, model.Q, model.H, model.R
    T, n = len(z), model.mean.size
    x, P = np.empty((T, n)), np.empty((T, n, n))
    ahead, before = np.empty((T, n, n)), np.empty((T, n))
    likelihood = 0.0
    mean, spread = model.mean, model.covariance
    for t in range(T):
        before[t], ahead[t] = mean, spread
        if not np.isnan(z[t]).any():
            S = H @ spread @ H.T + R
            gain = np.linalg.solve(S, H @ spread).T
            residual = z[t] - H @ mean
            likelihood -= 0.5 * float(
                residual @ np.linalg.solve(S, residual)
                + np.linalg.slogdet(S)[1]
                + len(S) * math.log(2.0 * math.pi)
            )
            mean = mean + gain @ residual
            kept = np.eye(n) - gain @ H
            spread = _even(kept @ spread @ kept.T + gain @ R @ gain.T)
        x[t], P[t] = mean, spread
        mean, spread = F @ mean, _even(F @ spread @ F.T + Q)
    pairs = np.empty((T - 1, n, n))
    for t in range(T - 2, -1, -1):
        back = np.linalg.solve(ahead[t + 1], F @ P[t]).T
        x[t] += back @ (x[t + 1] - before[t + 1])
        P[t] = _even(P[t] + back @ (P[t + 1] - ahead[t + 1]) @ back.T)
        pairs[t] = P[t + 1] @ back.T
    return x, P, pairs, likelihood


def _most_likely(
    model: LinearGaussian,
    z: np.ndarray,
    x: np.ndarray,
    P: np.ndarray,
    pairs: np.ndarray,
    what: Collection[str],
) -> LinearGaussian:
    """The model that makes the expected states and the measurements most likely."""
    seen = ~np.isnan(z).any(axis=1)
    z, at, spread = z[seen], x[seen], P[seen].sum(axis=0)
    if "H" in what:
        model = replace(model, H=_over(z.T @ at, spread + at.T @ at))
    if "R" in what:
        apart = z - at @ model.H.T
        model = replace(model, R=_even(apart.T @ apart + model.H @ spread @ model.H.T) / len(z))
    A = P[:-1].sum(axis=0) + x[:-1].T @ x[:-1]
    if "F" in what:
        model = replace(model, F=_over(pairs.sum(axis=0) + x[1:].T @ x[:-1], A))
    if "Q" in what:
        F, moved = model.F, x[1:] - x[:-1] @ model.F.T
        across = pairs.sum(axis=0) @ F.T
        S = moved.T @ moved + F @ P[:-1].sum(axis=0) @ F.T + P[1:].sum(axis=0) - across - across.T
        model = replace(model, Q=_even(S / len(moved)))
    if "mean" in what:
        model = replace(model, mean=x[0])
    if "covariance" in what:
        off = x[0] - model.mean
        model = replace(model, covariance=P[0] + np.outer(off, off))
    return model


def _even(S: np.ndarray) -> np.ndarray:
    """A covariance without what rounding makes uneven of it, which many rounds would let grow."""
    return np.asarray(0.5 * (S + S.T))


def _over(B: np.ndarray, A: np.ndarray) -> np.ndarray:
    """B A^-1, of a symmetric A that may be singular."""
    return np.asarray(B @ np.linalg.pinv(A, hermitian=True))
