"""Banks: several motions over one state, any of which may be the true one, each with a filter of its own.

The interacting multiple model filter lets the truth go over from one to another: p_ij is the chance that a
motion i becomes j over a step. Before each prediction the filters are mixed,

    c_j = sum_i p_ij mu_i      mu_i|j = p_ij mu_i / c_j
    x_j = sum_i mu_i|j x_i     P_j = sum_i mu_i|j (P_i + (x_i minus x_j)(x_i minus x_j)^T)

each predicts with its own motion and corrects, and a measurement weighs them, mu_j = c_j p(z | x_j) / sum.
In a bank of independent filters nothing goes over: c_j = mu_j, and none is mixed. One of the motions is then
the true one from first to last, and wins (multiple model adaptive estimation). The belief is the mixture's
mean and covariance. Over no time nothing goes over.

Source: D. Magill, "Optimal adaptive estimation of sampled stochastic processes", IEEE TAC 10(4), 1965
(independent filters); H. Blom and Y. Bar-Shalom, "The interacting multiple model algorithm for systems with
Markovian switching coefficients", IEEE TAC 33(8), 1988; Y. Bar-Shalom et al., "Estimation with Applications
to Tracking and Navigation", 2001, sec. 11.6.6.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.filtering.gaussian import GaussianMethod
from flowgraph.blocks.filtering.methods import Advanced, GaussianFilter, Method, extended
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import passes
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.blocks.signals import Bank, BankStep, Gaussian, KalmanInnovation
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.errors import DeclarationError
from flowgraph.language.block import When
from flowgraph.recorder.namespaces import solve_positive

__all__ = ["BankFilter", "Interacting", "bank_step", "imm", "mmae"]


@dataclass(frozen=True)
class Interacting(GaussianMethod):
    """The interacting multiple model filter, and without transitions a bank of filters; see `imm`, `mmae`."""

    motions: tuple[Motion, ...]
    transition: npt.NDArray[np.float64] | None
    weights: npt.NDArray[np.float64]
    maths: GaussianMethod

    def need(self, model: Motion | Measurement) -> None:
        for motion in self.motions:
            self.maths.need(motion)
            if motion.space != model.space:
                raise DeclarationError(
                    "the motions of a bank are not of one state",
                    path="imm",
                    expected=str(model.space),
                    got=str(motion.space),
                    fix="declare all over one StateSpace; where a part does not matter, let it stay",
                )

    def begin(self, start: Gaussian, space: StateSpace, xp: Any) -> Bank:
        n, kind = len(self.motions), start.mean.dtype
        return Bank(
            weight=xp.asarray(self.weights, dtype=kind),
            mean=xp.stack([start.mean] * n),
            covariance=xp.stack([start.covariance] * n),
        )

    def believed(self, kept: Bank, space: StateSpace, xp: Any) -> Gaussian:
        mean, P = _mixed(kept.mean, kept.covariance, kept.weight, space, xp)
        return Gaussian(mean=mean, covariance=P)

    def predicted(self, kept: Bank, control: Any, motion: Motion, dt: Any, xp: Any) -> Bank:
        kind, n = kept.weight.dtype, len(self.motions)
        if self.transition is None:
            each = [Gaussian(mean=kept.mean[j, :], covariance=kept.covariance[j, ...]) for j in range(n)]
            return self._moved(each, kept.weight, control, dt, xp)
        passed = xp.asarray(dt, dtype=kind) > 0.0
        p = xp.where(passed, xp.asarray(self.transition, dtype=kind), xp.eye(n, dtype=kind))
        joint = p * kept.weight[:, None]
        weight = xp.sum(joint, axis=0)
        share = joint / xp.where(weight > 0.0, weight, 1.0)
        mixed = []
        for j, own in enumerate(self.motions):
            mean, P = _mixed(kept.mean, kept.covariance, share[:, j], own.space, xp)
            mean, P = xp.where(passed, mean, kept.mean[j, :]), xp.where(passed, P, kept.covariance[j, ...])
            mixed.append(Gaussian(mean=mean, covariance=P))
        return self._moved(mixed, weight, control, dt, xp)

    def _moved(self, each: Sequence[Gaussian], weight: Array, control: Any, dt: Any, xp: Any) -> Bank:
        """Each belief after its own motion."""
        found = [
            self.maths.predicted(belief, control, own, dt, xp)
            for belief, own in zip(each, self.motions, strict=True)
        ]
        mean, P = xp.stack([one.mean for one in found]), xp.stack([one.covariance for one in found])
        return Bank(weight=weight, mean=mean, covariance=P)

    def corrected(
        self, kept: Bank, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[Bank, When, Array]:
        found, innovations, likelihoods = [], [], []
        for j in range(len(self.motions)):
            prior = Gaussian(mean=kept.mean[j, :], covariance=kept.covariance[j, ...])
            posterior, innovation, likely = self.maths.corrected(prior, message, measurement, None, xp)
            found.append(posterior)
            innovations.append(innovation)
            likelihoods.append(likely)
        log_weight = xp.log(kept.weight) + xp.stack(likelihoods)
        likely = log_sum_exp(log_weight, xp=xp)
        weight = xp.exp(log_weight - likely)
        whole = _one_innovation(kept.weight, innovations, gate, xp)
        choose = lambda new, old: xp.where(whole.accepted, new, old)
        corrected = Bank(
            weight=choose(weight, kept.weight),
            mean=choose(xp.stack([one.mean for one in found]), kept.mean),
            covariance=choose(xp.stack([one.covariance for one in found]), kept.covariance),
        )
        return corrected, When(innovations[0].present, whole), likely


@block
def bank_step(bank: Bank, control: Any | None, *, method: Interacting, dt: float, xp: Any) -> BankStep:
    """What the smoother of a bank (`switching`) needs of a step of `dt` seconds: each filter, each motion.

    Args:
        bank: that of the tick before.
        control: of the step.
        method: the bank's.
    """
    kind, models = bank.weight.dtype, range(len(method.motions))
    chance = xp.eye(len(models), dtype=kind)
    if method.transition is not None:
        passed = xp.asarray(dt, dtype=kind) > 0.0
        chance = xp.where(passed, xp.asarray(method.transition, dtype=kind), chance)
    ahead, crossed = [], []
    for i in models:
        own = Gaussian(mean=bank.mean[i, :], covariance=bank.covariance[i, ...])
        ahead += [method.maths.predicted(own, control, motion, dt, xp) for motion in method.motions]
        crossed += [method.maths.crossed(own, control, motion, dt, xp) for motion in method.motions]
    square = lambda parts: xp.reshape(xp.stack(parts), (len(models), len(models), *parts[0].shape))
    return BankStep(
        chance=chance,
        prior_mean=square([one.mean for one in ahead]),
        prior_covariance=square([one.covariance for one in ahead]),
        cross=square(crossed),
    )


@dataclass(frozen=True)
class BankFilter(GaussianFilter):
    """The filter of a bank."""

    maths: Interacting

    def smoothable(
        self, kept: Any, control: Any, motion: Motion, found: Advanced, *, at: Any
    ) -> Mapping[str, Any]:
        still = motion.space.resting()
        if type(self.maths.maths).crossed is GaussianMethod.crossed:  # refuses, before anything is wired
            self.maths.maths.crossed(still, None, motion, 0.0, np)
        step = bank_step(kept, control, method=self.maths, at=at, name="bank_step")
        return {"bank": found.kept, "bank_step": step}


def _mixed(
    means: Array, covariances: Array, weight: Array, space: StateSpace, xp: Any
) -> tuple[Array, Array]:
    """The mean and covariance of a mixture: means (k, size), covariances (k, t, t), weight (k)."""
    mean = space.mean(means, weight, xp)
    apart = space.minus(means, mean[None, :], xp)
    each = covariances + apart[:, :, None] * apart[:, None, :]
    P = xp.sum(each * weight[:, None, None], axis=0)
    return mean, 0.5 * (P + P.mT)


def _one_innovation(
    weight: Array, innovations: Sequence[When], gate: float | None, xp: Any
) -> KalmanInnovation:
    """What the bank expected, as one Gaussian."""
    each = [one.value for one in innovations]
    residuals = xp.stack([one.residual for one in each])
    residual = weight @ residuals
    apart = residuals - residual
    S = xp.stack([one.covariance for one in each]) + apart[:, :, None] * apart[:, None, :]
    S = xp.sum(S * weight[:, None, None], axis=0)
    nis = residual @ solve_positive(S, residual[:, None], xp)[:, 0]
    parts = each[0].parts
    accepted = passes(nis, gate, parts, S.shape[-1], xp)
    return KalmanInnovation(residual=residual, covariance=S, nis=nis, parts=parts, accepted=accepted)


def imm(
    *motions: Motion,
    transition: npt.ArrayLike | None = None,
    weights: npt.ArrayLike | None = None,
    method: Method | None = None,
) -> Method:
    """A bank of filters, one a motion, between which the truth goes over: the interacting multiple model.

        filtered(walk, {gps: fix}, method=imm(walk, drive, transition=[[0.97, 0.03], [0.03, 0.97]]))

    Args:
        motions: two or more, over one state, with one kind of control.
        transition: (k, k), the chance that motion i (row) becomes j (column) over a step; 0.95 to stay, and
            the rest shared by the others, if left out.
        weights: (k), of each motion at first; equal if left out.
        method: of each filter: linear, extended, unscented or cubature; extended if left out.

    Raises:
        DeclarationError: where these do not fit together.
    """
    k = len(motions)
    stay = np.full((k, k), 0.05 / max(k - 1, 1))
    np.fill_diagonal(stay, 0.95)
    p = stay if transition is None else np.array(transition, dtype=float)
    if k < 2 or p.shape != (k, k) or (p < 0.0).any() or not np.allclose(p.sum(axis=1), 1.0):
        raise _no_bank("imm", k, f"transition {p.tolist()}")
    p.flags.writeable = False
    return _bank("imm", motions, p, weights, method)


def mmae(*motions: Motion, weights: npt.ArrayLike | None = None, method: Method | None = None) -> Method:
    """A bank of independent filters, one a motion, of which one is the true one: multiple model adaptive
    estimation, of parameters such as a density of noise.

        filtered(walk, {gps: fix}, method=mmae(walk, run))

    A motion that has lost does not come back; where the truth may go over from one to another, take `imm`.

    Args:
        motions, weights, method: as in `imm`.

    Raises:
        DeclarationError: where these do not fit together.
    """
    return _bank("mmae", motions, None, weights, method)


def _no_bank(path: str, k: int, got: str) -> DeclarationError:
    return DeclarationError(
        "this is no bank of motions",
        path=path,
        expected="k > 1 motions; transition (k, k), whose rows add up to 1, and weights (k) that do",
        got=f"{k} motions, {got}",
        fix="write imm(walk, drive, transition=[[0.97, 0.03], [0.03, 0.97]]), or mmae(walk, drive)",
    )


def _bank(
    path: str,
    motions: tuple[Motion, ...],
    transition: npt.NDArray[np.float64] | None,
    weights: npt.ArrayLike | None,
    method: Method | None,
) -> Method:
    k = len(motions)
    w = np.full(k, 1.0 / max(k, 1)) if weights is None else np.array(weights, dtype=float)
    if k < 2 or w.shape != (k,) or (w < 0.0).any() or not np.isclose(w.sum(), 1.0):
        raise _no_bank(path, k, f"weights {w.tolist()}")
    inner = extended() if method is None else method
    kept_plainly = isinstance(inner, GaussianFilter) and type(inner.maths).begin is GaussianMethod.begin
    if not isinstance(inner, GaussianFilter) or not kept_plainly:
        raise DeclarationError(
            "the filters of a bank keep a mean and a covariance",
            path=f"{path}.method",
            expected="linear(), extended(), unscented() or cubature()",
            got=repr(method),
            fix=f"write {path}(..., method=extended())",
        )
    w.flags.writeable = False
    return BankFilter(Interacting(motions, transition, w, inner.maths))
