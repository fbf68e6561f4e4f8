"""Hovering: at rest at a point, or drifting about it a little, as a quadrotor that holds its place does."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.world.draws import generator
from flowgraph.blocks.world.motion import Motion, World
from flowgraph.blocks.world.quadrotor import carried_by_thrust

__all__ = ["Hover"]


@dataclass(frozen=True)
class Hover(World):
    """A level quadrotor at a point.

    Args:
        duration: s.
        point: m, world.
        drift: m, root mean square on each axis, of three slow sine waves (0.1 to 0.5 Hz); 0 is rest.
        seed: of the drift.
    """

    duration: float = 20.0  # type: ignore[misc]  # a field where World has a property
    point: tuple[float, float, float] = (0.0, 0.0, 1.0)
    drift: float = 0.0
    seed: int = 0

    def motion(self, seconds: Array, *, xp: Any) -> Motion:
        random = generator(self.seed, "hover")
        speed = 2.0 * np.pi * random.uniform(0.1, 0.5, (3, 3))
        angle = speed * seconds[..., None, None] + random.uniform(0.0, 2.0 * np.pi, (3, 3))
        size = self.drift * np.sqrt(2.0 / 3.0)
        wave = lambda k: xp.sum(size * speed**k * xp.sin(angle + k * np.pi / 2.0), axis=-1)
        return carried_by_thrust(np.array(self.point) + wave(0), wave(1), wave(2), wave(3), xp=xp)
