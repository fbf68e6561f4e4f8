"""How good any filter can be: the posterior Cramér-Rao bound along a true trajectory.

The errors of no filter, on average, are smaller than the inverse of the information J that controls and
measurements carry. Of a state that moves by F with noise Q, and is measured by H with noise R, it follows

    J_0 = P_0^-1      J_k = (Q + F J_{k-1}^-1 F^T)^-1 + H^T R^-1 H

with the Jacobians taken at the truth, which a filter does not know: an extended Kalman filter's covariance,
had it linearised there. A filter whose controls are measured knows the trajectory but for noise, so each
flight has a bound of its own; the mean of their traces bounds the mean squared error over flights. What is
carried on is P = J^-1, for Q may be singular and a start exact.

A smoother's errors have a bound too, which knows the later measurements: from the end back,

    S_n = P_n      S_k = P_k + C_k (S_{k+1} - P-_{k+1}) C_k^T      C_k = P_k F^T (P-_{k+1})^-1

with P-_{k+1} = F P_k F^T + Q: the block of a tick in the inverse of the whole trajectory's information.

Source: P. Tichavsky, C. Muravchik, A. Nehorai, "Posterior Cramér-Rao bounds for discrete-time nonlinear
filtering", IEEE Trans. Signal Processing 46(5), 1998 (eqs. 21 and 34 to 36).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

__all__ = ["posterior_bound", "smoothing_bound"]


def posterior_bound(
    F: np.ndarray,
    Q: np.ndarray,
    H: npt.ArrayLike,
    R: npt.ArrayLike,
    *,
    start: npt.ArrayLike,
    measured: np.ndarray,
) -> np.ndarray:
    """The covariance (n, ..., k, k) below which that of no filter's error lies, at each of n ticks.

    Args:
        F: (n - 1, ..., k, k) Jacobians of the steps from each tick to the next, at the truth; further axes
            are flights.
        Q: (n - 1, ..., k, k), or what broadcasts to it: the noise of the steps.
        H: (..., m, k) Jacobian of what is measured, at the truth.
        R: (m, m) its noise.
        start: (k, k), or (..., k, k): how well the start is known; zero where it is exactly.
        measured: (n,) bool, the ticks with a measurement.
    """
    H, R = np.asarray(H, dtype=float), np.asarray(R, dtype=float)
    Q = np.broadcast_to(Q, F.shape)
    bound = np.empty((len(measured), *F.shape[1:]))
    P = np.broadcast_to(np.asarray(start, dtype=float), F.shape[1:])
    for k, seen in enumerate(measured):
        if k:
            P = F[k - 1] @ P @ F[k - 1].mT + Q[k - 1]
        if seen:
            gain = np.linalg.solve(H @ P @ H.mT + R, H @ P).mT
            P = P - gain @ H @ P
            P = 0.5 * (P + P.mT)
        bound[k] = P
    return bound


def smoothing_bound(F: np.ndarray, Q: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """The covariance (n, ..., k, k) below which that of no smoother's error lies, at each of n ticks.

    Args:
        F, Q: as for `posterior_bound`.
        bound: which that gave.
    """
    Q = np.broadcast_to(Q, F.shape)
    smoothed = bound.copy()
    for k in range(len(bound) - 2, -1, -1):
        across = F[k] @ bound[k]
        ahead = across @ F[k].mT + Q[k]
        C = np.linalg.solve(ahead, across).mT
        P = bound[k] + C @ (smoothed[k + 1] - ahead) @ C.mT
        smoothed[k] = 0.5 * (P + P.mT)
    return smoothed
