"""Linearising on a space: how a small error of a state becomes one of what a function makes of it.

An extended filter needs of a motion or a sensor its value and this derivative. It is taken of the function's
own lines, so a model is written once; where a closed form is faster, it stands beside its model.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

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
) -> tuple[Array, Array]:
    """f(x), and its derivative from the tangent space at x to that at f(x).

    Args:
        f: `f(x, xp)`, on states (..., size), one a row; see `jacobian`.
        x: (..., size).
        space: of x.
        seen: of f(x), where it is no vector.
        more: how many numbers f takes behind those of x, such as noises; they are zero.

    Returns:
        y, and (..., t, tangent + more), where t is the tangent dimension of y.

    Raises:
        LoweringError: where a line of f loses the derivative.
    """
    lead = tuple(x.shape[:-1])
    whole = xp.concat([x, xp.zeros((*lead, more), dtype=x.dtype)], axis=-1) if more else x
    along = space.directions(x, xp)
    if along is not None and more:
        size = space.size
        none = [xp.zeros((*lead, more, d.shape[-1]), dtype=x.dtype) for d in along]
        along = [xp.concat([d, zero], axis=-2) for d, zero in zip(along, none, strict=True)]
        for i in range(more):
            one = xp.asarray(np.eye(size + more, 1, -(size + i)), dtype=x.dtype)
            along.append(xp.broadcast_to(one, (*lead, size + more, 1)) if lead else one)
    y, J = jacobian(f, whole, xp, along=along)
    if len(J.shape) <= len(y.shape):  # the same at each of the states
        J = xp.broadcast_to(J, (*y.shape, J.shape[-1]))
    return y, J if seen is None else seen.errors(y, J, xp)
