"""The round trip: a body that stays in its place and turns out and back about each of its axes in turn.

Made by hand for judging attitude filters: it does not accelerate, so an accelerometer shows the vertical, and
it ends each trip where it began, so drift is plain to see. With s = 0 to 1 along a trip,

    angle = A (1 - cos 2 pi s) / 2,     q = Exp(angle axis),     rate = d(angle)/dt axis    (exact: one axis)

A trip about x, then y, then z, each after a rest; then again from x.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.rotations import from_rotation_vector
from flowgraph.blocks.world.motion import Motion, World

__all__ = ["RoundTrip"]


@dataclass(frozen=True)
class RoundTrip(World):
    """Turns out and back about body x, y and z.

    Args:
        duration: s.
        angle: rad, how far out.
        trip: s, out and back.
        rest: s, before each trip.
        point: m, world; where the body is.
    """

    duration: float = 20.0  # type: ignore[misc]  # a field where World has a property
    angle: float = 1.0
    trip: float = 5.0
    rest: float = 1.0
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def numbers(self) -> int:
        return 0

    def shaped(self, numbers: Array) -> RoundTrip:
        return self

    def motion(self, seconds: Array, *, xp: Any) -> Motion:
        number, into = seconds // (self.rest + self.trip), seconds % (self.rest + self.trip)
        phase = 2.0 * np.pi * xp.maximum(into - self.rest, 0.0) / self.trip
        which = xp.astype(number % 3.0, xp.int32)
        axis = xp.take(xp.asarray(np.eye(3), dtype=into.dtype), which, axis=0)
        turn = axis * (0.5 * self.angle * (1.0 - xp.cos(phase)))[..., None]
        rate = axis * (np.pi / self.trip * self.angle * xp.sin(phase))[..., None]
        still = xp.zeros_like(turn)
        attitude = from_rotation_vector(turn, xp=xp)
        return Motion(still + np.array(self.point), still, still, still, attitude, rate)
