"""Smoothing: the state at a time given measurements after it too, by going back over a filter's run.

A filter gives p(x_k | z_1..z_k). The smoother of Rauch, Tung and Striebel goes back from the end and gives
p(x_k | z_1..z_n); with a fixed lag L it gives p(x_k | z_1..z_(k+L)), which a filter could report L ticks
late. Both need the whole run of a filter, so they are functions of its collected streams and run on the host;
nothing of them is lowered. An extended filter is smoothed in the tangent space, with the Jacobians of its
predictions.

    C_k = P_k F_k^T (P-_(k+1))^-1
    xs_k = x_k + C_k (xs_(k+1) - x-_(k+1))        Ps_k = P_k + C_k (Ps_(k+1) - P-_(k+1)) C_k^T

Sources: H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
Journal 3(8), 1965, eqs. 3.28-3.31; R. Fiszel, thesis (2017), which defines filtering and smoothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from flowgraph import Series
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.signals import Gaussian
from flowgraph.errors import DataError

__all__ = ["Steps", "fixed_lag", "lag_ticks", "rauch_tung_striebel"]

Transition = LinearModel | np.ndarray
"""How the state at one tick goes on to the next: a model, or the n - 1 Jacobians (t, t) of the steps."""


class Steps(NamedTuple):
    """What a smoother needs of a run; and `named`, which makes beliefs with names of what it gives back."""

    prior: Series
    posterior: Series
    transition: Transition
    space: StateSpace | None
    named: Callable[[Series], Series]


def rauch_tung_striebel(
    prior: Series, posterior: Series, transition: Transition, *, space: StateSpace | None = None
) -> Series:
    """Smooth a whole run.

    Args:
        prior, posterior: the collected `Gaussian` of each tick, predicted and corrected.
        transition: of the states between them.
        space: of the state, where it is not a vector.

    Returns:
        A series of `Gaussian` at the same times; the last is the last posterior.

    Raises:
        DataError: where the series do not belong together.
    """
    gains = _gains(prior, posterior, transition)
    mean, P = posterior["mean"].copy(), posterior["covariance"].copy()
    for k in range(len(mean) - 2, -1, -1):
        mean[k], P[k] = _back(posterior, prior, gains, k, mean[k + 1], P[k + 1], space)
    return Series(posterior.time, Gaussian(mean=mean, covariance=P), name="smoothed")


def fixed_lag(
    prior: Series, posterior: Series, transition: Transition, lag: npt.ArrayLike, *, space: StateSpace | None
    = None
) -> Series:  # fmt: skip
    """Smooth each tick with the measurements of the `lag` ticks after it, or of those there are.

    With a lag of 0 it is the posterior, with one as long as the run that of `rauch_tung_striebel`.

    Args:
        lag: in ticks, 0 or more; one number, or one for each tick (n,), as `lag_ticks` gives them.
        prior, posterior, transition, space: as for `rauch_tung_striebel`.

    Returns:
        A series of `Gaussian` at the same times. Its value at tick k is known at tick k + lag.

    Raises:
        DataError: where the series do not belong together, or the lag is negative.
    """
    lags = np.asarray(lag)
    if (lags < 0).any():
        raise DataError(
            "a lag cannot be negative",
            path="fixed_lag",
            expected="0 ticks or more",
            got=str(lags.min()),
            fix="give how many later ticks may be used",
        )
    gains = _gains(prior, posterior, transition)
    n = len(posterior)
    end = np.minimum(np.arange(n) + lags, n - 1)
    mean, P = posterior["mean"][end], posterior["covariance"][end]
    for ahead in range(
        int((end - np.arange(n)).max(initial=0)) - 1, -1, -1
    ):  # all ticks at once, one step back at a time
        active = np.flatnonzero(np.arange(n) + ahead < end)
        back = _back(posterior, prior, gains, active + ahead, mean[active], P[active], space)
        mean[active], P[active] = back
    return Series(posterior.time, Gaussian(mean=mean, covariance=P), name="smoothed")


def lag_ticks(time: np.ndarray, seconds: float) -> np.ndarray:
    """How many ticks after each of the times (n,) int64 ns come within so many seconds of it."""
    ends = np.searchsorted(time, time + round(seconds * 1e9), side="right") - 1
    return np.asarray(ends - np.arange(len(time)))


def _gains(prior: Series, posterior: Series, transition: Transition) -> np.ndarray:
    """C (n - 1, t, t): how much of the next tick's correction comes back to each."""
    if not np.array_equal(prior.time, posterior.time):
        raise DataError(
            "the priors and posteriors are not of the same ticks",
            path="smoothing",
            expected=f"the times of {posterior!r}",
            got=repr(prior),
            fix="collect both in one graph, at every tick",
        )
    F = transition.transitions(prior.time) if isinstance(transition, LinearModel) else np.asarray(transition)
    P = posterior["covariance"]
    if F.shape != P[1:].shape:
        raise DataError(
            "the transitions do not fit the states",
            path="smoothing",
            expected=f"shape {P[1:].shape}: one from each tick to the next",
            got=f"shape {F.shape}",
            fix="give the Jacobian of each prediction but the first",
        )
    return np.asarray(np.linalg.solve(prior["covariance"][1:], F @ P[:-1]).mT)


def _back(
    posterior: Series, prior: Series, gains: np.ndarray, k: int | np.ndarray, mean: np.ndarray, P: np.ndarray,
    space: StateSpace | None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Smoothed mean and covariance at k, given those at k + 1."""
    C, ahead = gains[k], prior["mean"][np.asarray(k) + 1]
    apart = mean - ahead if space is None else space.minus(mean, ahead, np)
    step = (C @ apart[..., None])[..., 0]
    here = posterior["mean"][k]
    moved = here + step if space is None else space.plus(here, step, np)
    smaller = posterior["covariance"][k] + C @ (P - prior["covariance"][np.asarray(k) + 1]) @ C.mT
    return np.asarray(moved), 0.5 * (smaller + smaller.mT)
