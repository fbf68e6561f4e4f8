"""Linearising on a space: how a small error of a state becomes one of what a function makes of it.

An extended filter needs of a motion or a sensor its value and this derivative. It is taken of the function's
own lines, so a model is written once; where a closed form is faster, it stands beside its model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flowgraph import Array, jacobian
from flowgraph.blocks.geometry.manifold import StateSpace

__all__ = ["linearised"]


def linearised(
    f: Callable[[Array, Any], Array],
    x: Array,
    space: StateSpace,
    xp: Any,
    *,
    seen: StateSpace | None = None,
    more: int = 0,
    value: Array | None = None,
) -> tuple[Array, Array]:
    """f(x), and its derivative from the tangent space at x to that at f(x).

    Args:
        f: `f(x, xp)`, on states (..., size), one a row; see `jacobian`.
        x: (..., size).
        space: of x.
        seen: of f(x), where it is no vector.
        more: how many numbers f takes behind those of x, such as noises; they are zero.
        value: f(x), where it is known.

    Returns:
        y, and (..., t, tangent + more), where t is the tangent dimension of y.
    """
    t = space.tangent
    lead = tuple(x.shape[:-1])
    start = xp.concat([x, xp.zeros((*lead, more), dtype=x.dtype)], axis=-1) if more else x
    y = f(start, xp) if value is None else value

    def error(d: Array, xp: Any) -> Array:
        moved = space.plus(x, d[..., :t], xp)
        after = f(xp.concat([moved, d[..., t:]], axis=-1) if more else moved, xp)
        return after - y if seen is None else seen.minus(after, y, xp)

    return y, jacobian(error, xp.zeros((*lead, t + more), dtype=x.dtype), xp)[1]
