"""Smoothing: the state at a time given measurements after it too, by going back over a filter's run.

A filter gives p(x_k | z_1..z_k). The smoother of Rauch, Tung and Striebel goes back from the end and gives
p(x_k | z_1..z_n); with a fixed lag L it gives p(x_k | z_1..z_(k+L)), which a filter could report L ticks
late. What it asks of a filter is the covariance D_k+1 that a belief has with what is predicted of it:

    C_k = D_k+1 (P-_k+1)^-1
    xs_k = x_k plus C_k (xs_k+1 minus x-_k+1)
    Ps_k = P_k + C_k (Ps_k+1 - P-_k+1) C_k^T        cov(xs_k+1, xs_k) = Ps_k+1 C_k^T

D is P F^T of a filter with derivatives F, and the weighted sum of products of an unscented one. On a manifold
the means move by plus and minus. The covariances stay as they are: each is of an error in the body's own
axes, as is the noise that made it, wherever the attitude is smoothed to. (Where corrections were 0.5 rad, the
NEES of three numbers was 3.0 to 3.3 so, and 3.6 with covariances turned as a filter's reset turns them.)

The functions here take a whole run and are of the host; `backward` is the same pass as a graph, which lowers.

Sources: H. Rauch, F. Tung, C. Striebel, "Maximum likelihood estimates of linear dynamic systems", AIAA
Journal 3(8), 1965, eqs. 3.28-3.31; S. Särkkä, "Unscented Rauch-Tung-Striebel smoother", IEEE TAC 53(3), 2008;
R. Fiszel, thesis (2017), which defines filtering and smoothing.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Result, Series
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.signals import Gaussian, SmoothedBelief
from flowgraph.errors import DataError

__all__ = [
    "Smoothing",
    "Steps",
    "fixed_lag",
    "gone_back",
    "lag_ticks",
    "rauch_tung_striebel",
    "smooth",
    "smoother_gain",
    "smoothing_pass",
    "steps_of",
]

Transition = LinearModel | np.ndarray | Series
"""How the state at one tick goes on to the next: a model, the n - 1 Jacobians (t, t) of the steps, or the n
`CrossCovariance` that a filter collects."""


class Steps(NamedTuple):
    """What a smoother needs of a run; and `named`, which makes beliefs with names of what it gives back."""

    prior: Series
    posterior: Series
    transition: Transition
    space: StateSpace | None
    named: Callable[[Series], Series]

    def smoothed(self) -> Series:
        """The whole run (`rauch_tung_striebel`)."""
        return rauch_tung_striebel(self.prior, self.posterior, self.transition, space=self.space)

    def lagged(self, seconds: float) -> Series:
        """Each tick with what came until so much later (`fixed_lag`)."""
        ticks = lag_ticks(self.posterior.time, seconds)
        return fixed_lag(self.prior, self.posterior, self.transition, ticks, space=self.space)


class Smoothing(Protocol):
    """A run that can be smoothed: `Steps`, and of other kinds of belief what goes back over them."""

    @property
    def named(self) -> Callable[[Series], Series]:
        """Makes beliefs with names of what is given back."""

    def smoothed(self) -> Series:
        """The whole run: a mean and covariance at every tick."""

    def lagged(self, seconds: float) -> Series:
        """Each tick with what came until so much later."""


def smooth(
    result: Result, space: StateSpace | None = None, *, lag: float | None = None, name: str = "filter"
) -> Series:
    """Smooth a run of `filtered(..., smoothing=True)`.

    Args:
        result: of the run.
        space: of the state, where it is not a vector.
        lag: s: with one, each tick is smoothed with what came until so much later (`fixed_lag`).
        name: of the filter, where it was given one.

    Returns:
        `SmoothedBelief` at every tick of the filter; with a lag `Gaussian`.

    Raises:
        DataError: where the run did not collect what a smoother needs.
    """
    steps = steps_of(result, space, name=name)
    return steps.smoothed() if lag is None else steps.lagged(lag)


def steps_of(result: Result, space: StateSpace | None = None, *, name: str = "filter") -> Steps:
    """What a run of `filtered(..., smoothing=True)` collected for a smoother.

    Raises:
        DataError: where it did not.
    """
    own = "" if name == "filter" else f"{name}_"
    wanted = [f"{own}{part}" for part in ("prior", "posterior", "cross")]
    missing = [part for part in wanted if part not in result.series]
    if missing:
        raise DataError(
            "this run did not collect what a smoother needs",
            path=result.graph,
            expected=", ".join(wanted),
            got=", ".join(result.series) or "nothing",
            fix="build the filter with filtered(..., smoothing=True)",
        )
    prior, posterior, cross = (result[part] for part in wanted)
    return Steps(prior, posterior, cross, space, lambda series: series)


def rauch_tung_striebel(
    prior: Series, posterior: Series, transition: Transition, *, space: StateSpace | None = None
) -> Series:
    """Smooth a whole run.

    Args:
        prior, posterior: the collected `Gaussian` of each tick, predicted and corrected.
        transition: of the states between them.
        space: of the state, where it is not a vector.

    Returns:
        A series of `SmoothedBelief` at the same times; the last is the last posterior.

    Raises:
        DataError: where the series do not belong together.
    """
    gains = _gains(prior, posterior, transition)
    before, after = ((s["mean"], s["covariance"]) for s in (prior, posterior))
    mean, P, lag_one = smoothing_pass(gains, *before, *after, space)
    return Series(posterior.time, SmoothedBelief(mean=mean, covariance=P, lag_one=lag_one), name="smoothed")


def smoothing_pass(
    gains: np.ndarray, prior: np.ndarray, prior_P: np.ndarray, mean: np.ndarray, P: np.ndarray,
    space: StateSpace | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:  # fmt: skip
    """The smoothed means, covariances and lag-one covariances of arrays with time in front; more leading
    axes are runs.

    Args:
        gains: C (n - 1, ..., t, t).
        prior, prior_P, mean, P: of each tick (n, ..., size) and (n, ..., t, t), before and after its
            measurements.
        space: of the state; None: a vector.
    """
    mean, P, lag_one = mean.copy(), P.copy(), np.zeros(P.shape)
    for k in range(len(mean) - 2, -1, -1):
        mean[k], P[k], lag_one[k] = gone_back(
            gains[k], mean[k], P[k], prior[k + 1], prior_P[k + 1], mean[k + 1], P[k + 1], space, np
        )
    return mean, P, lag_one


def smoother_gain(cross: Array, ahead_P: Array, xp: Any) -> Array:
    """C = cross ahead_P^-1 (..., t, t): how much of what is learnt of the next tick comes back.

    Of a number that is known exactly, whose variance is 0, nothing can be learnt, and its column is 0.
    """
    one = xp.eye(ahead_P.shape[-1], dtype=ahead_P.dtype)
    exact = xp.astype(xp.sum(ahead_P * one, axis=-1) == 0.0, ahead_P.dtype)
    return xp.linalg.solve(ahead_P + one * exact[..., None], cross.mT).mT


def gone_back(
    C: Array, x: Array, P: Array, ahead: Array, ahead_P: Array, later: Array, later_P: Array,
    space: StateSpace | None, xp: Any,
) -> tuple[Array, Array, Array]:  # fmt: skip
    """One step back: the smoothed mean and covariance of a tick, and the covariance of the next tick's error
    with its own.

    Args:
        C: the gain (..., t, t).
        x, P: the belief of the tick.
        ahead, ahead_P: what was predicted of the next.
        later, later_P: what the next is smoothed to.
        space: of the state; None: a vector.
    """
    apart = later - ahead if space is None else space.minus(later, ahead, xp)
    step = (C @ apart[..., None])[..., 0]
    moved = x + step if space is None else space.plus(x, step, xp)
    smaller = P + C @ (later_P - ahead_P) @ C.mT
    return moved, 0.5 * (smaller + smaller.mT), later_P @ C.mT


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
    before, here = ((s["mean"], s["covariance"]) for s in (prior, posterior))
    mean, P = here[0][end], here[1][end]
    for ahead in range(
        int((end - np.arange(n)).max(initial=0)) - 1, -1, -1
    ):  # all ticks at once, one step back at a time
        active = np.flatnonzero(np.arange(n) + ahead < end)
        k = active + ahead
        mean[active], P[active], _ = gone_back(
            gains[k], here[0][k], here[1][k], before[0][k + 1], before[1][k + 1],
            mean[active], P[active], space, np,
        )  # fmt: skip
    return Series(posterior.time, Gaussian(mean=mean, covariance=P), name="smoothed")


def lag_ticks(time: np.ndarray, seconds: float) -> np.ndarray:
    """How many ticks after each of the times (n,) int64 ns come within so many seconds of it."""
    ends = np.searchsorted(time, time + round(seconds * 1e9), side="right") - 1
    return np.asarray(ends - np.arange(len(time)))


def _gains(prior: Series, posterior: Series, transition: Transition) -> np.ndarray:
    """C (n - 1, t, t): how much of the next tick's correction comes back to each."""
    crossed = transition if isinstance(transition, Series) else None
    alike = [prior.time] if crossed is None else [prior.time, crossed.time]
    if not all(np.array_equal(time, posterior.time) for time in alike):
        raise DataError(
            "the priors and posteriors are not of the same ticks",
            path="smoothing",
            expected=f"the times of {posterior!r}",
            got=", ".join(repr(s) for s in (prior, crossed) if s is not None),
            fix="collect both in one graph, at every tick",
        )
    P = posterior["covariance"]
    if crossed is not None:
        return np.asarray(smoother_gain(crossed["covariance"][1:], prior["covariance"][1:], np))
    F = transition.transitions(prior.time) if isinstance(transition, LinearModel) else np.asarray(transition)
    if F.shape != P[1:].shape:
        raise DataError(
            "the transitions do not fit the states",
            path="smoothing",
            expected=f"shape {P[1:].shape}: one from each tick to the next",
            got=f"shape {F.shape}",
            fix="give the Jacobian of each prediction but the first",
        )
    return np.asarray(smoother_gain((F @ P[:-1]).mT, prior["covariance"][1:], np))
