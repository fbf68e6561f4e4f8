"""A measurement's noise that is learned as it goes.

Nobody knows the noise of a receiver between houses. The innovations tell it: where they are larger than the
filter expects, the noise is; and the other way round. The noise is a register, fed back through a delay:

    noise = delay(R0, name="noise")
    posterior, innovation = update_learned(prior, measured, noise, observe=..., gate=0.999)
    noise.feed(learned_noise(noise, innovation, memory=50.0))

What the model of the motion does wrong ends in the noise as well: one of the two must be known.

Or only how large it is is learned, one number for each sensor, which keeps the NIS at 1 and fits any
correction:

    scale = scale_of(memory, "position")
    posterior, innovation = aid_position(prior, position, scale, noise=...)
    feed_scale(scale, innovation, memory, "position")

Sources: A. Mohamed and K. Schwarz, "Adaptive Kalman filtering for INS/GPS", J. Geodesy 73, 1999; C.
Hide, T. Moore, M. Smith, "Adaptive Kalman filtering for low-cost INS/GPS", J. Navigation 56(1), 2003.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np

from flowgraph import Scalar, block, delay, real
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.filters import Observe, Vector, observed, updated
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.signals import Gaussian, KalmanInnovation
from flowgraph.recorder.namespaces import solve_positive

__all__ = ["LEAST", "feed_scale", "learned_noise", "learned_scale", "scale_of", "update_learned"]

LEAST = 1e-4
"""Of the noise that was told, at least so much of its variance is believed to be there."""

Noise = Annotated[Any, real("m", "m")]
"""The covariance of a measurement."""


@block
def update_learned(
    prior: Gaussian,
    measured: Vector | None,
    noise: Noise,
    *,
    observe: Observe,
    space: StateSpace | None = None,
    measured_space: StateSpace | None = None,
    gate: float | None = None,
    robust: Robust | None = None,
    xp: Any,
) -> tuple[Gaussian, KalmanInnovation | None]:
    """`update_extended` with the covariance of the noise as a port.

    Args:
        prior, measured, observe, space, measured_space, gate, robust: as in `update_extended`.
        noise: R (m, m).
    """
    if measured is None:
        return prior, None
    predicted, H = observed(observe, prior.mean, space, measured_space, xp)
    return updated(prior, measured, predicted, H, noise, space, measured_space, gate, robust, xp)


@block
def learned_noise(noise: Noise, innovation: KalmanInnovation | None, *, memory: float, xp: Any) -> Noise:
    """The covariance of a measurement's noise, learned from what is left after each correction.

        e = R S^-1 r        R' = R + (e e^T - R S^-1 R) / memory

    It stays positive, and stands still where the innovations are as large as they were expected. What was
    refused by a gate, and a measurement of which entries are missing, teach nothing. Feed it back through a
    delay: `noise = delay(R0)`, then `update_learned(prior, measured, noise, ...)`.

    Args:
        noise: R (m, m), by which the innovation was made.
        innovation: of this tick; or absent.
        memory: how many measurements it remembers, about.

    Source: Mohamed and Schwarz 1999, eq. 18, where H P' H^T after the correction is R - R S^-1 R.
    """
    if innovation is None:
        return noise
    solved = solve_positive(
        innovation.covariance, xp.concat([innovation.residual[..., None], noise], axis=-1), xp
    )
    left = noise @ solved[..., :1]
    change = (left @ left.mT - noise @ solved[..., 1:]) / memory
    whole = innovation.accepted & (innovation.parts == float(noise.shape[-1]))
    made = noise + xp.where(whole[..., None, None], change, 0.0)
    return 0.5 * (made + made.mT)


def scale_of(memory: float | None, name: str) -> Any:
    """The scale of a sensor's noise as a register to read and to feed, 1 at first; None without a memory.

    Args:
        memory: how many measurements it remembers, about.
        name: of the sensor.
    """
    return None if memory is None else delay(np.float64(1.0), name=f"{name}_scale")


def feed_scale(scale: Any, innovation: Any, memory: float | None, name: str) -> None:
    """Feed a scale of `scale_of` with what an innovation teaches; nothing without a memory."""
    if memory is not None:
        scale.feed(learned_scale(scale, innovation, memory=memory, name=f"learn_{name}"))


@block
def learned_scale(scale: Scalar, innovation: KalmanInnovation | None, *, memory: float, xp: Any) -> Scalar:
    """By what the covariance of a sensor's noise is to be multiplied, so that its NIS is 1 a number.

        s' = s (1 + (nis / m - 1) / memory)        for an innovation of m numbers

    What a gate refused teaches nothing, and no innovation counts for more than `memory` numbers.

    Args:
        scale: by which the innovation was made.
        innovation: of this tick; or absent.
        memory: how many measurements it remembers, about; above 1.
    """
    if innovation is None:
        return scale
    parts = xp.maximum(innovation.parts, 0.0 * innovation.parts + 1.0)
    size = xp.minimum(innovation.nis / parts, 0.0 * parts + memory)
    made = xp.maximum(scale * (1.0 + (size - 1.0) / memory), 0.0 * scale + LEAST)
    return xp.where(innovation.accepted & (innovation.parts > 0.0), made, scale)
