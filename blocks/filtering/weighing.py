"""Weighing: what a measurement does to the weights of a cloud, and what a cloud expects to be measured.

    log p(z | x_i) = -(r_i^T R_i^-1 r_i + log det R_i + parts log(2 pi)) / 2      r_i = z minus h(x_i)

What a cloud expected, as one Gaussian, is its innovation, and on that stands a gate: a measurement that is
too far from it leaves the cloud as it was.

Source: N. Gordon, D. Salmond and A. Smith, "Novel approach to nonlinear/non-Gaussian Bayesian state
estimation", IEE Proceedings F 140(2), 1993.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from flowgraph import Array, Scalar, block, when
from flowgraph.blocks.kalman.filters import masked, passes
from flowgraph.blocks.particles.cloud import log_sum_exp
from flowgraph.blocks.signals import KalmanInnovation, StateCloud
from flowgraph.blocks.statespace import Measurement
from flowgraph.recorder.derivatives import jacobian

__all__ = ["weigh_cloud"]


@block
def weigh_cloud(
    cloud: StateCloud, message: Any | None, *, measurement: Measurement, gate: float | None = None, xp: Any
) -> tuple[StateCloud, KalmanInnovation | None, Scalar | None]:
    """Multiply the weights by the likelihood of what was measured, and normalise; without it nothing changes.

    R is the covariance of noise that is added; of noise that goes in, (dz/dv) noise (dz/dv)^T at each
    particle. An entry that is NaN counts as not measured.

    Args:
        cloud: the particles.
        message: what was measured; or absent.
        measurement: what is seen of a state.
        gate: as in `update_linear`, on the innovation.

    Returns:
        The cloud; and where there was a measurement the innovation, with the mean and covariance of what the
        cloud expected, and the log-likelihood.
    """
    if message is None:
        return cloud, None, None
    apart = residuals(cloud.state, message, measurement, xp)
    found, whole = weighed(cloud, log_density(apart, xp), xp)
    here = xp.any(apart.present)
    innovation = expected(cloud, apart.residual, apart.R, apart.present, gate, xp)
    return chosen(found, cloud, innovation, gate, xp), when(here, innovation), when(here, whole)


def weighed(cloud: Any, likely: Array, xp: Any) -> tuple[Any, Array]:
    """The cloud with its weights multiplied by likelihoods (n, logarithms), and that of the whole."""
    log_weight = cloud.log_weight + likely
    whole = log_sum_exp(log_weight, xp=xp)
    return cloud.replace(log_weight=log_weight - whole), whole


class Residuals(NamedTuple):
    """z minus what each particle expects (n, m), 0 where missing; R (m, m) or (n, m, m), which says nothing
    of what is missing; what is present (m); and the noise of the whole measurement."""

    residual: Array
    R: Array
    present: Array
    noise: Array


def residuals(x: Array, message: Any, measurement: Measurement, xp: Any) -> Residuals:
    """What a measurement is apart from what each of the states x (n, size) expects."""
    measured, kind = measurement.vector(message, xp), x.dtype
    if measurement.inside:
        noise = measurement.covariance(message, 0, kind, xp)
        still = xp.zeros((x.shape[0], noise.shape[-1]), dtype=kind)
        z = measurement.seen(x, still, message, xp)
        apart = lambda v, xp: measurement.apart(measurement.seen(x, v, message, xp), z, xp)
        _, V = jacobian(apart, still, xp)
        R = V @ noise @ V.mT
    else:
        z = measurement.seen(x, None, message, xp)
        R = None
    residual = measurement.apart(measured, z, xp)
    R = measurement.covariance(message, residual.shape[-1], kind, xp) if R is None else R
    present = ~xp.isnan(residual[0, :])
    whole = xp.all(present)  # as it mostly is: then nothing of the noise waits for the measurement
    residual = xp.where(whole, residual, xp.where(present, residual, 0.0))
    return Residuals(residual, xp.where(whole, R, masked(R, R, present, xp)[1]), present, R)


def log_density(apart: Residuals, xp: Any) -> Array:
    """The logarithm (n) of the density of N(0, R) at each residual, of the entries present."""
    residual, R, present, noise = apart
    one = xp.eye(R.shape[-1], dtype=R.dtype)
    if len(R.shape) == 3:
        L = xp.linalg.cholesky(R)
        white = xp.linalg.solve(L, residual[..., None])[..., 0]
        diagonal = xp.sum(L * one, axis=-1)
    else:
        rooted = lambda R: xp.linalg.solve(xp.linalg.cholesky(R), one)
        root = xp.where(xp.all(present), rooted(noise), rooted(R))
        white = (root @ residual.mT).mT
        diagonal = 1.0 / xp.sum(root * one, axis=-1)
    determinant = 2.0 * xp.sum(xp.log(diagonal), axis=-1)
    parts = xp.sum(xp.astype(present, residual.dtype))
    return -0.5 * (xp.sum(white * white, axis=-1) + determinant + math.log(2.0 * math.pi) * parts)


def likelihoods(x: Array, message: Any, measurement: Measurement, xp: Any) -> Array:
    """The log-likelihood (n) of each state."""
    return log_density(residuals(x, message, measurement, xp), xp)


def expected(
    cloud: Any, residual: Array, R: Array, present: Array, gate: float | None, xp: Any
) -> KalmanInnovation:
    """What the cloud before the measurement expected, as one Gaussian, and whether that passes."""
    weight = xp.exp(cloud.log_weight)
    mean = weight @ residual
    apart = residual - mean
    S = (apart * weight[:, None]).mT @ apart
    noise = R if len(R.shape) == 2 else xp.sum(R * weight[:, None, None], axis=0)
    S = S + noise
    solved = xp.linalg.solve(S, mean[:, None])[:, 0]
    nis, parts = mean @ solved, xp.sum(xp.astype(present, mean.dtype))
    return KalmanInnovation(
        residual=mean,
        covariance=S,
        nis=nis,
        parts=parts,
        accepted=(
            xp.any(present) | ~xp.any(present)
            if gate is None
            else passes(nis, gate, parts, residual.shape[-1], xp)
        ),
    )


def chosen(found: Any, plain: Any, innovation: KalmanInnovation, gate: float | None, xp: Any) -> Any:
    """What a measurement made of a cloud, or the cloud as it was where the gate refused it."""
    if gate is None:
        return found
    kept = {n: xp.where(innovation.accepted, getattr(found, n), getattr(plain, n)) for n in found._fields}
    return type(found)(**kept)
