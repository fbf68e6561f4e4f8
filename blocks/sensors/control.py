"""Control inputs: the thrust and body rate that the flight controller commands.

The vehicle follows them exactly; what differs from the truth is the noise, which stands for rotors and wind
(R. Fiszel's thesis, 2017, "Control inputs").
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.sensors.inertial import RateSensor
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import BodyRate, Thrust
from flowgraph.blocks.world.motion import Motion

__all__ = ["BodyRateInput", "ThrustInput"]


@dataclass(frozen=True, kw_only=True)
class ThrustInput(Sensor):
    """The thrust per mass along body z (`Thrust`, m/s^2): that of the motion + error."""

    name: str = "thrust"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Thrust:
        error = self.noise.error(self.name, seed, seconds, 1, rate=self.rate)[:, 0]
        return Thrust(thrust=motion.thrust + error)


@dataclass(frozen=True, kw_only=True)
class BodyRateInput(RateSensor):
    """The body rate (`BodyRate`, rad/s, body): that of the motion + error."""

    name: str = "body_rate"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> BodyRate:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return BodyRate(rate=self._turning(motion) + error)
