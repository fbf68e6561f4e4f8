"""Resampling: replace a weighted cloud by an equally weighted one of the same size.

Particle i gets on average n w_i copies, in every scheme; they differ in how much the number of copies varies.
Each scheme draws n places on the line from 0 to 1 and takes, for each, the particle in whose part of the line
it falls: a cumulative sum and a search.

Which particle is taken is a decision, and engines must decide alike although their floating-point sums need
not agree in the last bit (a compiler reorders them and fuses multiplications into additions). So weights
become integers first, multiples of 2^-38; their sums are then exact in any order and places are compared with
them as integers. Guaranteed: every index is between 0 and n - 1; a particle whose weight rounds to zero is
never taken; ties are decided alike everywhere; engines that agree on the integers agree on every index. If
weights differ by a relative d between engines, an index differs with a chance of about n sqrt(n) d a
resampling: 3e-8 for n = 1,000 and d = 1e-12.

Source: R. Douc, O. Cappé and E. Moulines, "Comparison of resampling schemes for particle filtering", ISPA
2005, sec. 2.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from flowgraph import Array, Scalar, block
from flowgraph.blocks.signals import Ancestors, Cloud
from flowgraph.errors import UnknownNameError

__all__ = [
    "MOST_PARTICLES",
    "SCHEMES",
    "ancestor_index",
    "draw_ancestors",
    "quantised",
    "roughening",
    "take_ancestors",
]

WEIGHT_BITS = 38
"""A weight is a multiple of 2^-38: n times the sum of all then fits int64, for n up to 2^24."""

MOST_PARTICLES = 2**20
"""As many as a graph may be set to."""


def quantised(weight: Array, *, xp: Any) -> Array:
    """Weights (n), which add up to 1, as int64 multiples of 2^-38, rounded to the nearest."""
    return xp.astype(xp.floor(weight * 2.0**WEIGHT_BITS + 0.5), xp.int64)


def _search(parts: Array, places: Array, xp: Any) -> Array:
    """The i for which a place is at or after the start of part i and before its end; all int64 (n)."""
    return xp.searchsorted(xp.cumulative_sum(parts), places, side="right")


def _scaled(fraction: Array, total: Array, xp: Any) -> Array:
    """floor(fraction * total) < total, int64: one rounded product, which no engine computes otherwise."""
    product = xp.astype(xp.floor(fraction * xp.astype(total, xp.float64)), xp.int64)
    return xp.minimum(product, total - 1)  # in float32 the product may round up to the total


def _fine(draw: Any, n: int) -> Array:
    """n uniform numbers of 48 bits: a place anywhere on the line needs more than the 24 of one draw."""
    both = draw.uniform("place", (2, n))
    return both[0, :] + both[1, :] * 2.0**-24


def _strata(parts: Array, offset: Array, xp: Any) -> Array:
    """One place in each of n equal parts of the line, `offset` (0 to 1) of the way through it."""
    n, ends = parts.shape[-1], xp.cumulative_sum(parts)
    total = ends[-1]
    places = (xp.arange(n, dtype=xp.int64) * total + _scaled(offset, total, xp)) // n
    return xp.searchsorted(ends, places, side="right")


def systematic(parts: Array, *, draw: Any, xp: Any) -> Array:
    """Places (j + u)/n with one u for all: the fewest draws, and the least variance in practice."""
    return _strata(parts, draw.uniform("place", ()), xp)


def stratified(parts: Array, *, draw: Any, xp: Any) -> Array:
    """Places (j + u_j)/n: one draw in each of n equal parts."""
    return _strata(parts, draw.uniform("place", (parts.shape[-1],)), xp)


def multinomial(parts: Array, *, draw: Any, xp: Any) -> Array:
    """Places u_j anywhere: independent copies."""
    return _search(parts, _scaled(_fine(draw, parts.shape[-1]), xp.sum(parts), xp), xp)


def residual(parts: Array, *, draw: Any, xp: Any) -> Array:
    """floor(n w_i) copies of each particle for certain; what is left, multinomially from the remainders."""
    n = parts.shape[-1]
    total = xp.sum(parts)
    certain = parts * n // total
    remainder = parts * n - certain * total
    slot = xp.arange(n, dtype=xp.int64)
    places = _scaled(_fine(draw, n), xp.sum(remainder), xp)
    return xp.where(slot < xp.sum(certain), _search(certain, slot, xp), _search(remainder, places, xp))


SCHEMES: Mapping[str, Callable[..., Array]] = {
    "systematic": systematic,
    "stratified": stratified,
    "residual": residual,
    "multinomial": multinomial,
}
"""The schemes by name: `(parts (n) int64, draw, xp) -> index (n) int64`."""


def ancestor_index(weight: Array, *, scheme: str, draw: Any, xp: Any) -> Array:
    """The particle (n) int64 of which each new one is a copy, for weights (n) that add up to 1.

    Raises:
        UnknownNameError: for a scheme that does not exist.
    """
    if scheme not in SCHEMES:
        raise UnknownNameError("resampling scheme", scheme, SCHEMES)
    index = SCHEMES[scheme](quantised(weight, xp=xp), draw=draw, xp=xp)
    return xp.minimum(index, weight.shape[-1] - 1)  # of use only where the weights are not numbers


def roughening(apart: Array, spread: float, *, xp: Any) -> Array:
    """The deviations (t) by which copies are shaken apart: spread n^(-1/t) times the range of the sample.

    Args:
        apart: (n, t), the points before resampling, from anywhere among them.
        spread: 0.2 in the source.

    Source: N. Gordon, D. Salmond and A. Smith, IEE Proc. F 140, 1993, sec. 3.
    """
    n, t = apart.shape
    return (xp.max(apart, axis=0) - xp.min(apart, axis=0)) * (spread * n ** (-1.0 / t))


@block
def draw_ancestors(
    cloud: Cloud,
    effective_sample_size: Scalar,
    *,
    below: float,
    scheme: str = "systematic",
    draw: Any,
    xp: Any,
) -> Ancestors:
    """Choose which particles live on, if the weights have become too uneven; else each is its own ancestor.

    Resamples when effective_sample_size < below * n. Draws `place`: (1) systematic, (n) stratified, (2, n)
    else; they are drawn whether or not they are used.

    Args:
        below: a fraction of the number of particles; 0 never resamples, above 1 always.
        scheme: "systematic", "stratified", "residual" or "multinomial".
    """
    n = cloud.log_weight.shape[-1]
    drawn = ancestor_index(xp.exp(cloud.log_weight), scheme=scheme, draw=draw, xp=xp)
    resampled = effective_sample_size < below * n
    index = xp.where(resampled, drawn, xp.arange(n, dtype=xp.int64))
    return Ancestors(index=xp.astype(index, xp.int32), resampled=resampled)


@block
def take_ancestors(cloud: Cloud, ancestors: Ancestors, *, xp: Any) -> Cloud:
    """The cloud of the chosen particles; equally weighted if it was resampled."""
    n = cloud.log_weight.shape[-1]
    copy = lambda field: xp.take(field, ancestors.index, axis=-1)
    return Cloud(
        log_weight=xp.where(ancestors.resampled, -math.log(n), cloud.log_weight),
        attitude=copy(cloud.attitude),
        velocity=copy(cloud.velocity),
        position=copy(cloud.position),
        velocity_covariance=copy(cloud.velocity_covariance),
        cross_covariance=copy(cloud.cross_covariance),
        position_covariance=copy(cloud.position_covariance),
    )
