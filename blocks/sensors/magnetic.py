"""Magnetometers: the field itself, or the attitude that a field gives.

The Earth's field in a world with x east, y north and z up, for a declination D (east of north) and a dip I
(below the horizon), and what a magnetometer in the body reads of it:

    m = strength (cos I sin D, cos I cos D, -sin I)          reading = R^T m + error

One field fixes two of three angles, so the field is the honest form. The thesis's magnetometer reads the
whole attitude; that is `MagneticAttitude`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.pose import AttitudeSensor
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import MagneticField
from flowgraph.blocks.world.motion import Motion

__all__ = ["MagneticAttitude", "Magnetometer", "earth_field"]


def earth_field(declination: float, dip: float, strength: float) -> np.ndarray:
    """The field (3,) in the world, in the unit of `strength`; angles in rad."""
    level, down = math.cos(dip), math.sin(dip)
    return strength * np.array([level * math.sin(declination), level * math.cos(declination), -down])


@dataclass(frozen=True, kw_only=True)
class Magnetometer(Sensor):
    """Reads the magnetic field in the body (`MagneticField`, T).

    Args:
        noise: T. Its bias is the hard iron of the body.
        declination: rad, from north to east.
        dip: rad, down from the horizon.
        strength: T.
    """

    name: str = "magnetometer"
    rate: float = 50.0
    noise: Noise = NO_NOISE
    declination: float = 0.0
    dip: float = math.radians(60.0)
    strength: float = 50e-6

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> MagneticField:
        field = motion.to_body(earth_field(self.declination, self.dip, self.strength))
        return MagneticField(field=field + self.noise.error(self.name, seed, seconds, 3, rate=self.rate))


@dataclass(frozen=True, kw_only=True)
class MagneticAttitude(AttitudeSensor):
    """Reads the whole attitude (`Attitude`), as the thesis's magnetometer: q * Exp(error), error in rad,
    body."""

    name: str = "magnetic_attitude"
    rate: float = 50.0
