"""Hovering: at rest at a point, or drifting about it a little, as a quadrotor that holds its place does."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.signals import Drawn
from flowgraph.blocks.world.motion import Motion, World
from flowgraph.blocks.world.quadrotor import carried_by_thrust
from flowgraph.errors import DeclarationError

__all__ = ["Hover", "hover_waves"]

_WAVES = 3


@dataclass(frozen=True, eq=False)
class Hover(World):
    """A level quadrotor at a point.

    Args:
        duration: s.
        point: m, world.
        drift: m, root mean square on each axis, of three slow sine waves (0.1 to 0.5 Hz); 0 is rest.
        waves: (18,) of these, speeds (3, 3) in rad/s and phases (3, 3) in rad, as `hover_waves` draws them.
    """

    duration: float = 20.0  # type: ignore[misc]  # a field where World has a property
    point: tuple[float, float, float] = (0.0, 0.0, 1.0)
    drift: float = 0.0
    waves: Array | None = None

    @property
    def numbers(self) -> int:
        return 2 * 3 * _WAVES if self.drift else 0

    def shaped(self, numbers: Array) -> Hover:
        return replace(self, waves=numbers)

    def motion(self, seconds: Array, *, xp: Any) -> Motion:
        still = xp.zeros_like(seconds)[..., None] * np.zeros(3)
        here = still + np.array(self.point)
        if not self.drift:
            return carried_by_thrust(here, still, still, still, xp=xp)
        if self.waves is None:
            raise DeclarationError(
                "nobody has drawn how this body drifts",
                path="Hover",
                expected=f"waves of {self.numbers} numbers",
                got="none",
                fix="write Hover(drift=0.1).shaped(numbers), or draw them in a graph by hover_waves",
            )
        speed, phase = xp.reshape(xp.asarray(self.waves, dtype=seconds.dtype), (2, 3, _WAVES))
        size = self.drift * np.sqrt(2.0 / _WAVES)
        angle = speed * seconds[..., None, None] + phase
        sine, cosine = size * xp.sin(angle), size * xp.cos(angle)
        waves = (sine, speed * cosine, -speed * speed * sine, -speed * speed * speed * cosine)
        place, *others = (xp.sum(wave, axis=-1) for wave in waves)
        return carried_by_thrust(here + place, *others, xp=xp)


@block
def hover_waves(*, draw: Any, xp: Any) -> Drawn:
    """Draw how a `Hover` drifts: 0.1 to 0.5 Hz, any phase. Give it a clock that ticks once."""
    speeds = 2.0 * np.pi * (0.1 + 0.4 * draw.uniform("speeds", (3 * _WAVES,)))
    return Drawn(numbers=xp.concat([speeds, 2.0 * np.pi * draw.uniform("phases", (3 * _WAVES,))]))
