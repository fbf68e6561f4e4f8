"""A GPS receiver: where its antenna is, seldom and late.

The antenna is not the inertial unit: it sits at `lever` in the body. The world is east, north, up at a place
on the Earth; `geodetic` turns what is read into latitude, longitude and height, and back.
"""

from __future__ import annotations

from dataclasses import dataclass

from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.pose import PositionSensor

__all__ = ["Gps"]


@dataclass(frozen=True, kw_only=True)
class Gps(PositionSensor):
    """Reads the antenna's position (`Position`, m, east north up): p + R lever + error.

    Args:
        noise: m. A bias that walks, with `latency` and `jitter`, is what receivers show.
        lever: m, body: the antenna, from the origin of the body.
    """

    name: str = "gps"
    rate: float = 2.0
    noise: Noise = NO_NOISE
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)
