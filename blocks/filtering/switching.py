"""The smoother of a bank: back over the run of filters between whose motions the truth goes over.

From the end back, let m_j be how likely motion j is over the step to a tick, given all measurements, and x_j
what is then believed of that tick. The one before it was i with

    p(i | j) ~ p_ij mu_i N(x_j; x-_ij, P-_ij)      m_i = sum_j p(i | j) m_j

where mu_i are the filter's weights and x-_ij what filter i predicts with motion j. For each pair the step is
gone back over as Rauch, Tung and Striebel do, from x_j to the belief of filter i; and the pairs of one i are
taken together by their mean and covariance, weighted by p(i | j) m_j. With one motion it is the smoother of a
Kalman filter; where nothing goes over, each filter is smoothed by itself, and the weights are those at the
end. Else it is an approximation, as the filter is: a mixture is taken for a Gaussian, and x_j for what the
tick was. (Kim's smoother leaves N(x_j; ...) out. Over 60 ticks of a point that turns now and then it was
worse than the filter.)

Source: D. Barber, "Expectation correction for smoothed inference in switching linear dynamical systems", JMLR
7, 2006, sec. 3 (with one Gaussian a motion, at the mean); C.-J. Kim, "Dynamic linear models with
Markov-switching", Journal of Econometrics 60, 1994; H. Rauch, F. Tung, C. Striebel, "Maximum likelihood
estimates of linear dynamic systems", AIAA Journal 3(8), 1965.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from flowgraph import Result, Series
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.smoothing import gone_back, lag_ticks, smoother_gain
from flowgraph.blocks.signals import Gaussian
from flowgraph.errors import DataError

__all__ = ["BankSteps", "bank_steps_of"]


class BankSteps(NamedTuple):
    """What the smoother of a bank needs of a run: of each tick the `Bank` with its measurements, and the
    `BankStep` to it; the state's space; and `named`, which makes beliefs with names of what it gives back."""

    bank: Series
    step: Series
    space: StateSpace
    named: Callable[[Series], Series]

    def smoothed(self) -> Series:
        """The whole run: `Gaussian` at every tick."""
        n = len(self.bank)
        weight, mean, P = (self.bank[leaf][-1:] for leaf in ("weight", "mean", "covariance"))
        found = [_whole(weight, mean, P, self.space)]
        for k in range(n - 2, -1, -1):
            weight, mean, P = self._back(np.array([k]), weight, mean, P)
            found.append(_whole(weight, mean, P, self.space))
        means, covariances = (np.concatenate(part)[::-1] for part in zip(*found, strict=True))
        return Series(self.bank.time, Gaussian(mean=means, covariance=covariances), name="smoothed")

    def lagged(self, seconds: float) -> Series:
        """Each tick with what came until so much later."""
        n = len(self.bank)
        here = np.arange(n)
        end = np.minimum(here + lag_ticks(self.bank.time, seconds), n - 1)
        weight, mean, P = (self.bank[leaf][end] for leaf in ("weight", "mean", "covariance"))
        for ahead in range(
            int((end - here).max(initial=0)) - 1, -1, -1
        ):  # all ticks, one step back at a time
            active = np.flatnonzero(here + ahead < end)
            weight[active], mean[active], P[active] = self._back(
                active + ahead, weight[active], mean[active], P[active]
            )
        mean, P = _whole(weight, mean, P, self.space)
        return Series(self.bank.time, Gaussian(mean=mean, covariance=P), name="smoothed")

    def _back(
        self, k: np.ndarray, weight: np.ndarray, mean: np.ndarray, P: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Weights (m, k), means and covariances at ticks k (m), of those at the ticks after them."""
        own, own_mean, own_P = (self.bank[leaf][k] for leaf in ("weight", "mean", "covariance"))
        chance, ahead, ahead_P, cross = (
            self.step[leaf][k + 1] for leaf in ("chance", "prior_mean", "prior_covariance", "cross")
        )
        models = own.shape[1]
        wide = lambda a: np.repeat(a[:, :, None], models, axis=2)  # of filter i, for each j
        later = lambda a: np.repeat(a[:, None], models, axis=1)  # of motion j, for each i
        off = np.asarray(self.space.minus(later(mean), ahead, np))
        with np.errstate(divide="ignore"):
            joint = np.log(chance * own[:, :, None]) + _log_density(off, ahead_P)
        joint = np.exp(joint - joint.max(axis=1, keepdims=True, initial=-1e300))
        before = joint / np.maximum(joint.sum(axis=1, keepdims=True), np.finfo(float).tiny)
        pair = before * weight[:, None, :]
        gain = smoother_gain(cross, ahead_P, np)
        means, covariances, _ = gone_back(
            gain, wide(own_mean), wide(own_P), ahead, ahead_P, later(mean), later(P), self.space, np
        )
        found = pair.sum(axis=2)
        share = np.where(found[..., None] > 0.0, pair / np.where(found > 0.0, found, 1.0)[..., None], chance)
        return found, *_whole(share, means, covariances, self.space)


def _log_density(off: np.ndarray, P: np.ndarray) -> np.ndarray:
    """log N(off; 0, P) but for a constant; a number that is known exactly does not count."""
    exact = (np.diagonal(P, axis1=-2, axis2=-1) == 0.0).astype(float)
    P = P + exact[..., None] * np.eye(P.shape[-1])
    square = np.sum(off * np.linalg.solve(P, off[..., None])[..., 0], axis=-1)
    return np.asarray(-0.5 * (square + np.linalg.slogdet(P)[1]))


def _whole(
    weight: np.ndarray, mean: np.ndarray, P: np.ndarray, space: StateSpace
) -> tuple[np.ndarray, np.ndarray]:
    """The mean and covariance of mixtures of k Gaussians: weight (..., k), mean (..., k, size)."""
    middle = np.asarray(space.mean(mean, weight, np))
    apart = np.asarray(space.minus(mean, middle[..., None, :], np))
    each = P + apart[..., :, None] * apart[..., None, :]
    whole = np.sum(each * weight[..., None, None], axis=-3)
    return middle, 0.5 * (whole + np.swapaxes(whole, -1, -2))


def bank_steps_of(result: Result, space: StateSpace, *, name: str = "filter") -> BankSteps:
    """What a run of `filtered(..., method=imm(...), smoothing=True)` collected for its smoother.

    Raises:
        DataError: where it did not.
    """
    own = "" if name == "filter" else f"{name}_"
    wanted = [f"{own}bank", f"{own}bank_step"]
    if any(part not in result.series for part in wanted):
        raise DataError(
            "this run did not collect what the smoother of a bank needs",
            path=result.graph,
            expected=", ".join(wanted),
            got=", ".join(result.series) or "nothing",
            fix="build the filter with filtered(..., method=imm(...), smoothing=True)",
        )
    bank, step = (result[part] for part in wanted)
    return BankSteps(bank, step, space, lambda series: series)
