"""An altimeter fixed to the body: the distance to flat ground along body z, downwards.

Tilted, it sees farther than the height: z = 0 lies at p_z / R_33, with R_33 = cos(tilt). (The thesis prints
sin(pitch) times the height: that is neither the cosine nor the quotient.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import Range
from flowgraph.blocks.world.motion import Motion

__all__ = ["Altimeter"]


@dataclass(frozen=True, kw_only=True)
class Altimeter(Sensor):
    """Reads the distance to the ground (`Range`, m): p_z / R_33 + error; nothing beyond `most_tilt`.

    Below the ground, where simulated flights may come, it reads a negative distance.

    Args:
        noise: m.
        most_tilt: rad; tilted more, there is no ground in view and no reading.
    """

    name: str = "altimeter"
    rate: float = 50.0
    noise: Noise = NO_NOISE
    most_tilt: float = math.radians(75.0)

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Range:
        upright = np.where(self._present(motion), np.cos(motion.tilt), 1.0)
        error = self.noise.error(self.name, seed, seconds, 1, rate=self.rate)[:, 0]
        return Range(distance=motion.position[:, 2] / upright + error)

    def _present(self, motion: Motion) -> np.ndarray:
        return motion.tilt <= min(self.most_tilt, math.radians(89.9))
