"""Particles that look at the measurement before they are drawn: kernels, each with a Kalman correction.

A cloud of n points is taken for a density, with a Gaussian kernel about each point: a part h^2 of the
cloud's covariance V. The points are drawn together by a = sqrt(1 - h^2), so that the density has the mean and
the covariance of the cloud. Given a kernel, a measurement is then what it is for a Kalman filter:

    m_i = mean + a (x_i - mean)         S = h^2 H V H^T + R          K = h^2 V H^T S^-1
    w_i' ~ w_i N(r_i; 0, S)             m_i' = m_i + K r_i           C = (I - K H) h^2 V (I - K H)^T + K R K^T

and new points are drawn from N(m_i', C) of the kernels that live on. That is the proposal for which weights
vary least, and a weight is known before its point is drawn; so no two points are copies of one. No derivative
of the motion is needed. h = 0 is the bootstrap filter, h = 1 a Gaussian filter with a sampled motion. The
weights tell what is not Gaussian, and chance has a say in them: a correction adds about (1 - h^2) V / N_eff
to the error of the mean. New points are drawn second-order exact: with the mean and covariance of kernels.

Sources: A. Doucet, S. Godsill and C. Andrieu, "On sequential Monte Carlo sampling methods for Bayesian
filtering", Statistics and Computing 10, 2000, sec. II-D (the optimal proposal, by local linearisation); M.
West, "Mixture models, Monte Carlo, Bayesian updating and dynamic models", Computing Science and Statistics
24, 1993 (kernels drawn together); C. Musso, N. Oudjane and F. Le Gland, "Improving regularised particle
filters", in "Sequential Monte Carlo Methods in Practice", 2001, sec. 12.2.3 (regularised before the
correction); D. T. Pham, "Stochastic methods for sequential data assimilation in strongly nonlinear systems",
Monthly Weather Review 129, 2001 (second-order-exact sampling); A. Stordal, H. Karlsen, G. Naevdal, H. Skaug
and B. Valles, "Bridging the ensemble Kalman filter and particle filters: the adaptive Gaussian mixture
filter", Computational Geosciences 15, 2011 (h between the two filters).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.lost import FARTHEST
from flowgraph.blocks.kalman.triangles import covariance_root
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.recorder.namespaces import solve_positive

__all__ = ["Kernels", "Spread", "corrected", "drawn", "spread_of"]

_FLAT = 1e-6
"""The share of its variance from which what the numbers before it leave of a number is its own spread."""


class Spread(NamedTuple):
    """How a cloud lies about its mean: tangent vectors (n, t) to its points, and their covariance (t, t)."""

    apart: Array
    covariance: Array


class Kernels(NamedTuple):
    """Corrected kernels: their middles (n, size), the covariance (t, t) of each, and their log weights (n),
    whose exponentials add up to 1."""

    middle: Array
    covariance: Array
    log_weight: Array


def spread_of(x: Array, weight: Array, mean: Array, *, space: StateSpace, xp: Any) -> Spread:
    """The spread of points x (n, size) with weights (n) about their mean (size)."""
    apart = space.minus(x, mean[None, :], xp)
    V = (apart * weight[:, None]).mT @ apart
    return Spread(apart, 0.5 * (V + V.mT))


def corrected(
    mean: Array,
    spread: Spread,
    log_weight: Array,
    residuals: Any,
    H: Array,
    R: Array,
    *,
    space: StateSpace,
    bandwidth: float,
    wider: Array | None = None,
    xp: Any,
) -> Kernels:
    """Correct each kernel of a cloud with a measurement, and weigh it by how likely that was.

    Args:
        mean: of the cloud (size).
        spread: of the cloud about it.
        log_weight: (n).
        residuals: `residuals(x) -> (n, m)`, measured minus predicted for states x (n, size); 0 where an entry
            is missing.
        H: (m, t) slope of the prediction about the mean; a row of zeros where an entry is missing.
        R: (m, m) covariance of the measurement.
        space: of the states.
        bandwidth: h, 0 to 1.
        wider: (t, t), added to the covariance of the kernels: of a cloud that has lost track.
    """
    middle = space.plus(mean[None, :], math.sqrt(1.0 - bandwidth**2) * spread.apart, xp)
    B = bandwidth**2 * spread.covariance
    B = B if wider is None else B + wider
    HB = H @ B
    S = HB @ H.mT + R
    r = residuals(middle)
    solved = solve_positive(S, xp.concat([HB, r.mT], axis=-1), xp)  # K^T and S^-1 r in one factorization
    t = B.shape[-1]
    K, white = solved[:, :t].mT, solved[:, t:].mT
    distance = xp.sum(r * white, axis=-1)
    distance = xp.where(distance < FARTHEST**2, distance, FARTHEST**2)
    both = log_weight - 0.5 * distance
    rest = xp.eye(t, dtype=B.dtype) - K @ H
    C = rest @ B @ rest.mT + K @ R @ K.mT
    return Kernels(
        middle=space.plus(middle, r @ K.mT, xp),
        covariance=0.5 * (C + C.mT),
        log_weight=both - log_sum_exp(both, xp=xp),
    )


def drawn(
    middle: Array,
    root: Array,
    normal: Array,
    weight: Array,
    mean: Array,
    covariance: Array,
    *,
    space: StateSpace,
    xp: Any,
) -> Array:
    """A point (n, size) of each kernel, all moved together so that they have a given mean and covariance.

    What chance does to the first two moments, in choosing kernels and in drawing, would add up over the
    corrections in whatever is told slowly; so it is taken back. The distances of the points from their own
    mean are multiplied by L S^-1, L the root (t, t) of the covariance and S that of theirs. Points that do
    not span all t directions, as with n <= t, are only centred.

    Args:
        middle: of the kernels that were chosen (n, size).
        root: (t, t), of the covariance of each.
        normal: standard normal draws (n, t).
        weight: of the points (n).
        mean, covariance: what the points shall have, (size) and (t, t).
    """
    apart = space.minus(space.plus(middle, normal @ root.mT, xp), mean[None, :], xp)
    apart = apart - (weight @ apart)[None, :]
    n, t = apart.shape
    if n <= t:
        return space.plus(mean[None, :], apart, xp)
    own = (apart * weight[:, None]).mT @ apart
    one = xp.eye(t, dtype=own.dtype)
    S, L = covariance_root(0.5 * (own + own.mT), xp=xp), covariance_root(covariance, xp=xp)
    pivot, variance = xp.sum(S * one, axis=-1), xp.sum(own * one, axis=-1)
    spans = xp.all(pivot * pivot > _FLAT * variance)
    stretch = xp.linalg.solve(xp.where(spans, S, one).mT, xp.where(spans, L, one).mT)
    return space.plus(mean[None, :], apart @ stretch, xp)
