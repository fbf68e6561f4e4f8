"""A point on a smooth figure in the plane: sums of three waves an axis, from the origin."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.signals import PlanePosition, PlaneShape

__all__ = ["plane_motion", "plane_shape"]

_WAVES = 3


@block
def plane_shape(*, draw: Any) -> PlaneShape:
    """Draw the figure of a flight. Give it a clock that ticks once: `plane_shape(at=start)`."""
    return PlaneShape(
        sizes=draw.normal("sizes", (2, _WAVES)),
        phases=2.0 * np.pi * draw.uniform("phases", (2, _WAVES)),
        paces=0.3 + 1.2 * draw.uniform("paces", (_WAVES,)),
    )


@block
def plane_motion(shape: PlaneShape, *, t: Any, xp: Any) -> PlanePosition:
    """Where the point is at this tick, sum_k size_k (sin(pace_k t + phase_k) - sin phase_k); time counts from
    0."""
    angle = xp.astype(t, shape.sizes.dtype) * 1e-9 * shape.paces + shape.phases
    return PlanePosition(position=xp.sum(shape.sizes * (xp.sin(angle) - xp.sin(shape.phases)), axis=-1))
