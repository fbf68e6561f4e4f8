"""Sensors of a point in the plane, as blocks: where it is, and how fast it went since the reading before."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.signals import PlanePosition, PlaneVelocity

__all__ = ["read_plane_position", "read_plane_velocity"]


@block
def read_plane_position(here: PlanePosition, *, noise: float, draw: Any) -> PlanePosition:
    """Where the point is, with white noise; m."""
    return PlanePosition(position=here.position + noise * draw.normal("noise", (2,)))


@block
def read_plane_velocity(
    before: PlanePosition, here: PlanePosition, *, noise: float, first: float, dt: float, draw: Any, xp: Any
) -> tuple[PlanePosition, PlaneVelocity]:
    """The mean velocity since this fired last, (p1 - p0) / dt + error, m/s; so its integral is the way.

    noise: density of the error, m/s/sqrt(Hz). first: s, for what time the first reading stands, before which
    there is none.

    State: the position at the reading before, at first the origin."""
    seconds = xp.asarray(dt, dtype=here.position.dtype)
    seconds = xp.where(seconds > 0.0, seconds, first)
    white = noise / xp.sqrt(seconds) * draw.normal("noise", (2,))
    return here, PlaneVelocity(velocity=(here.position - before.position) / seconds + white)


@read_plane_velocity.init
def _(here: Any, *, noise: float, first: float) -> PlanePosition:
    return PlanePosition(position=np.zeros(2))
