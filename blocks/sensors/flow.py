"""Optical flow: how a camera moved and turned since its picture before.

With q0, p0 at the picture before and q1, p1 now:

    displacement = R(q0)^T (p1 - p0) + error         turn = q0^-1 q1 * Exp(error)

A camera knows no world, so the displacement is in body coordinates of the picture before, and its companion
distance sensor makes it metres. (The thesis prints q0 q1, without the inverse, and a difference in the
world.) Displacements and turns compose: the pose after many intervals follows from the first one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.geometry.rotations import conjugate, multiply
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.pose import turned
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import OpticalFlow
from flowgraph.blocks.world.motion import Motion

__all__ = ["OpticalFlowSensor"]


@dataclass(frozen=True, kw_only=True)
class OpticalFlowSensor(Sensor):
    """Reads displacement and turn over the period that ends at the stamp (`OpticalFlow`).

    The first picture has none before it: the first reading is one period after the phase.

    Args:
        noise: m, of the displacement; drawn as "optical_flow.displacement".
        attitude_noise: rad, of the turn; drawn as "optical_flow.turn".
    """

    name: str = "optical_flow"
    rate: float = 20.0
    noise: Noise = NO_NOISE
    attitude_noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> OpticalFlow:
        before = np.maximum(np.arange(len(seconds)) - 1, 0)
        moved = np.einsum("nji,nj->ni", motion.rotation[before], motion.position - motion.position[before])
        turn = multiply(conjugate(motion.attitude[before], xp=np), motion.attitude, xp=np)
        place = self.noise.error(f"{self.name}.displacement", seed, seconds, 3, rate=self.rate)
        angle = self.attitude_noise.error(f"{self.name}.turn", seed, seconds, 3, rate=self.rate)
        return OpticalFlow(
            displacement=moved + place,
            turn=turned(turn, angle),
            interval=np.full(len(seconds), self.period * 1e-9),
        )

    def _present(self, motion: Motion) -> np.ndarray:
        return np.arange(len(motion)) > 0
