"""The information form: the belief by the inverse of its covariance, in which measurements add up.

With the information Y = P^-1, a step of x' = F x + w, w ~ N(0, Q), and a measurement z = h(x) + v are

    M = F^-T Y F^-1        Y' = (I + M Q)^-1 M
    Y' = Y + H^T R^-1 H    x' = x plus Y'^-1 H^T R^-1 (z minus h(x))

A start of which almost nothing is known has an information of almost zero, of which no digit is lost when
the first measurements come, where a large covariance loses as many as it has: with a deviation a million
times that of a measurement, twelve. (Beyond ten million the covariance, which is given at every tick, can no
longer be had of it.) A correction inverts a matrix of the size of the state, not of the measurement.

Source: P. Maybeck, "Stochastic Models, Estimation, and Control", vol. 1, 1979, sec. 5.7; Y. Bar-Shalom, X.
Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, sec. 7.2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flowgraph import Array
from flowgraph.blocks.filtering.gaussian import GaussianMethod, innovation_log_likelihood
from flowgraph.blocks.filtering.methods import GaussianFilter, Method
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import accepts, masked, moved, where_any, within
from flowgraph.blocks.signals import Gaussian, GaussianInformation, KalmanInnovation
from flowgraph.blocks.statespace import Measurement, Motion
from flowgraph.language.block import When

__all__ = ["Information", "information"]


@dataclass(frozen=True)
class Information(GaussianMethod):
    """The extended information filter; see `information`."""

    def begin(self, start: Gaussian, space: StateSpace, xp: Any) -> GaussianInformation:
        return GaussianInformation(mean=start.mean, information=_inverse(start.covariance, xp))

    def believed(self, kept: GaussianInformation, space: StateSpace, xp: Any) -> Gaussian:
        return Gaussian(mean=kept.mean, covariance=_inverse(kept.information, xp))

    def predicted(
        self, kept: GaussianInformation, control: Any, motion: Motion, dt: Any, xp: Any
    ) -> GaussianInformation:
        mean, F, Q = motion.linearised(kept.mean, control, dt, xp)
        M = _turned(kept.information, F, xp)
        if Q is not None:
            M = xp.linalg.solve(xp.eye(M.shape[-1], dtype=M.dtype) + M @ Q, M)
        return GaussianInformation(mean=mean, information=0.5 * (M + M.mT))

    def crossed(self, kept: GaussianInformation, control: Any, motion: Motion, dt: Any, xp: Any) -> Array:
        F = motion.linearised(kept.mean, control, dt, xp)[1]
        return xp.linalg.solve(kept.information, F.mT)

    def corrected(
        self, kept: GaussianInformation, message: Any, measurement: Measurement, gate: float | None, xp: Any
    ) -> tuple[GaussianInformation, When, Array]:
        Y, space, kind = kept.information, measurement.space, kept.mean.dtype
        z, H, R = measurement.linearised(kept.mean, None, message, xp)
        apart = measurement.apart(measurement.vector(message, xp), z, xp)
        present = ~xp.isnan(apart)
        residual = within(xp.where(present, apart, 0.0), gate, xp)
        H, R = masked(H, R, present, xp)
        column = residual[..., None]
        weighed = xp.linalg.solve(R, xp.concat([H, column], axis=-1))  # R^-1 H and R^-1 r
        gained = H.mT @ weighed
        S = H @ xp.linalg.solve(Y, H.mT) + R
        S = 0.5 * (S + S.mT)
        nis = (column.mT @ xp.linalg.solve(S, column))[..., 0, 0]
        accepted = accepts(nis, gate, present, xp)
        more = gained * xp.astype(accepted, kind)[..., None, None]
        Y = Y + more[..., :-1]
        shift = xp.linalg.solve(Y, more[..., -1:])[..., 0]
        turn = space.reset(shift, xp)
        Y = Y if turn is None else _turned(Y, turn, xp)
        innovation = KalmanInnovation(
            residual=residual,
            covariance=S,
            nis=nis,
            parts=xp.sum(xp.astype(present, kind), axis=-1),
            accepted=accepted,
        )
        posterior = GaussianInformation(mean=moved(kept.mean, shift, space, xp), information=0.5 * (Y + Y.mT))
        return posterior, where_any(present, innovation, xp), innovation_log_likelihood(innovation, xp=xp)


def _inverse(P: Array, xp: Any) -> Array:
    found = xp.linalg.solve(P, xp.eye(P.shape[-1], dtype=P.dtype))
    return 0.5 * (found + found.mT)


def _turned(Y: Array, F: Array, xp: Any) -> Array:
    """F^-T Y F^-1: the information after x' = F x."""
    half = xp.linalg.solve(F.mT, Y)
    return xp.linalg.solve(F.mT, half.mT)


def information() -> Method:
    """The extended Kalman filter in information form: what is kept is the inverse of the covariance.

    For a start of which almost nothing is known: give it deviations of up to a million times those of the
    measurements. It needs a motion that can be undone, as all in continuous time can.
    """
    return GaussianFilter(Information())
