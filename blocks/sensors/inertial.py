"""Inertial sensors: gyroscope, accelerometer, and both in one unit.

Two things are called acceleration. A real accelerometer reads the *specific force* R^T (a - gravity), 9.81
m/s^2 upwards at rest. The thesis's reads the *coordinate acceleration* R^T a, zero at rest (gravity taken off
by an attitude that nobody has). They are two sensors with two signal types here.

Noise is a continuous density by default; `Noise.variance` takes the thesis's variances per sample.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.inertial import ImuNoise
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import CoordinateAcceleration, Gyro, Imu, SpecificForce
from flowgraph.blocks.world.motion import Motion

__all__ = ["Accelerometer", "CoordinateAccelerometer", "Gyroscope", "InertialUnit"]


@dataclass(frozen=True, kw_only=True)
class Gyroscope(Sensor):
    """Reads the angular rate in the body (`Gyro`, rad/s): rate + bias + noise."""

    name: str = "gyro"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Gyro:
        return Gyro(rate=motion.rate + self.noise.error(self.name, seed, seconds, 3, rate=self.rate))


@dataclass(frozen=True, kw_only=True)
class Accelerometer(Sensor):
    """Reads the specific force in the body (`SpecificForce`, m/s^2): R^T (a - gravity) + bias + noise."""

    name: str = "accelerometer"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> SpecificForce:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return SpecificForce(force=motion.specific_force + error)


@dataclass(frozen=True, kw_only=True)
class CoordinateAccelerometer(Sensor):
    """Reads the second derivative of position in the body (`CoordinateAcceleration`, m/s^2): R^T a + bias +
    noise.

    The thesis's accelerometer (sec. "Sensors").
    """

    name: str = "coordinate_acceleration"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> CoordinateAcceleration:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return CoordinateAcceleration(acceleration=motion.coordinate_acceleration + error)


@dataclass(frozen=True, kw_only=True)
class InertialUnit(Sensor):
    """Reads rate and specific force at the same times (`Imu`).

    Args:
        gyro, accelerometer: their noise. They are drawn as "gyro" and "accelerometer", unless `parts` names
        them
            otherwise, so a lone gyroscope of that name reads the same as this one.
    """

    name: str = "imu"
    rate: float = 200.0
    gyro: Noise = NO_NOISE
    accelerometer: Noise = NO_NOISE
    parts: tuple[str, str] = ("gyro", "accelerometer")

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Imu:
        turn, push = (
            noise.error(part, seed, seconds, 3, rate=self.rate)
            for noise, part in zip((self.gyro, self.accelerometer), self.parts, strict=True)
        )
        return Imu(gyro=motion.rate + turn, specific_force=motion.specific_force + push)

    @property
    def densities(self) -> ImuNoise:
        """The noise as continuous densities, for a filter; a deviation per sample is one over this rate."""
        white = [
            np.hypot(n.density, n.deviation / np.sqrt(self.rate)) for n in (self.gyro, self.accelerometer)
        ]
        return ImuNoise(float(white[0]), float(white[1]), self.gyro.walk, self.accelerometer.walk)
