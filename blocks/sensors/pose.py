"""Sensors of where and how: position, attitude, and motion capture, which gives both.

An attitude is wrong by a right (body) rotation vector: reading = q * Exp(error), error in rad (the thesis's
R2Q).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import Attitude, Pose, Position
from flowgraph.blocks.world.motion import Motion

__all__ = ["AttitudeSensor", "PositionSensor", "Vicon", "turned"]


def turned(q: np.ndarray, error: np.ndarray) -> np.ndarray:
    """(n, 4) q * Exp(error), the error (n, 3) in rad, body."""
    return np.asarray(multiply(q, from_rotation_vector(error, xp=np), xp=np))


@dataclass(frozen=True, kw_only=True)
class PositionSensor(Sensor):
    """Reads where a point of the body is (`Position`, m, world): p + R lever + error.

    Args:
        noise: m.
        lever: m, body: the point, from the origin of the body.
    """

    name: str = "position"
    rate: float = 10.0
    noise: Noise = NO_NOISE
    lever: tuple[float, float, float] = (0.0, 0.0, 0.0)

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Position:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return Position(position=motion.position + motion.rotation @ np.array(self.lever) + error)


@dataclass(frozen=True, kw_only=True)
class AttitudeSensor(Sensor):
    """Reads the attitude (`Attitude`): q * Exp(error), error in rad, body."""

    name: str = "attitude"
    rate: float = 10.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Attitude:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return Attitude(attitude=turned(motion.attitude, error))


@dataclass(frozen=True, kw_only=True)
class Vicon(Sensor):
    """Reads position and attitude (`Pose`), as motion capture does.

    Args:
        noise: m, of the position p + error; drawn as "vicon.position".
        attitude_noise: rad, of the attitude q * Exp(error); drawn as "vicon.attitude".
    """

    name: str = "vicon"
    rate: float = 4.0
    noise: Noise = NO_NOISE
    attitude_noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Pose:
        place = self.noise.error(f"{self.name}.position", seed, seconds, 3, rate=self.rate)
        turn = self.attitude_noise.error(f"{self.name}.attitude", seed, seconds, 3, rate=self.rate)
        return Pose(position=motion.position + place, attitude=turned(motion.attitude, turn))
