"""Inertial sensors: gyroscope, accelerometer, and both in one unit.

Two things are called acceleration. A real accelerometer reads the *specific force* R^T (a - gravity), 9.81
m/s^2 upwards at rest. The thesis's reads the *coordinate acceleration* R^T a, zero at rest (gravity taken off
by an attitude that nobody has). They are two sensors with two signal types here.

Noise is a continuous density by default; `Noise.variance` takes the thesis's variances per sample.

A reading is what there was at its stamp or, with `oversample`, the mean over the interval that ends there, as
a unit gives it that samples fast inside and hands on averages. A gyroscope may also read the `turn`: the
rotation since its last reading, over the period, as the thesis's does. They differ where a rate jumps:
between two instants nobody knows when it did, but the mean and the turn hold all of the rotation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.blocks.geometry.rotations import conjugate, multiply, to_rotation_vector
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.sensors.noise import NO_NOISE, Noise
from flowgraph.blocks.sensors.sensor import Sensor
from flowgraph.blocks.signals import CoordinateAcceleration, Gyro, Imu, SpecificForce
from flowgraph.blocks.world.motion import Motion
from flowgraph.errors import DeclarationError

__all__ = [
    "MOST_LOOKS",
    "Accelerometer",
    "CoordinateAccelerometer",
    "Gyroscope",
    "InertialSensor",
    "InertialUnit",
    "RateSensor",
]

MOST_LOOKS = 1000
"""The most looks that make one reading."""


@dataclass(frozen=True, kw_only=True)
class InertialSensor(Sensor):
    """The base of those that may average.

    Args:
        oversample: 1: a reading is of its stamp. n > 1: it is the mean of n evenly spaced looks at the
            interval of one period that ends at the stamp (before the world begins, it stands still). The
            noise is that of the reading, in either case.

    Raises:
        DeclarationError: where `oversample` is no whole number from 1 to 1000.
    """

    oversample: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.oversample, int) or not 1 <= self.oversample <= MOST_LOOKS:
            raise DeclarationError(
                "a sensor cannot take so many looks",
                path=self.name,
                expected=f"oversample a whole number from 1 to {MOST_LOOKS}",
                got=repr(self.oversample),
                fix="write oversample=10, or 1 for readings of an instant",
            )

    def _looks(self, seconds: np.ndarray) -> np.ndarray:
        if self.oversample == 1:
            return seconds
        back = (np.arange(self.oversample)[::-1] + 0.5) / self.oversample * (self.period * 1e-9)
        return np.maximum(seconds[:, None] - back, 0.0).ravel()

    def _present(self, motion: Motion) -> np.ndarray:
        return np.ones(len(motion) // self.oversample, dtype=bool)

    def _mean(self, looks: np.ndarray) -> np.ndarray:
        """The reading (n, 3) without its error, from what there was at each look."""
        return looks.reshape(-1, self.oversample, 3).mean(1) if self.oversample > 1 else looks


@dataclass(frozen=True, kw_only=True)
class RateSensor(InertialSensor):
    """The base of those that read how fast the body turns, and nothing else.

    Args:
        turn: whether the rate is that of the whole turn since one period before, log(R(t - T)^T R(t)) / T,
            rad/s in the body; so R(t) = R(t - T) Exp(rate T). Before the world begins, it stands still.
    """

    turn: bool = False

    def _looks(self, seconds: np.ndarray) -> np.ndarray:
        looks = super()._looks(seconds)
        if not self.turn:
            return looks
        before = np.maximum(seconds - self.period * 1e-9, 0.0)
        return np.column_stack([looks.reshape(len(seconds), -1), before, seconds]).ravel()

    def _present(self, motion: Motion) -> np.ndarray:
        return np.ones(len(motion) // self._each, dtype=bool)

    def _mean(self, looks: np.ndarray) -> np.ndarray:
        looks = looks.reshape(-1, self._each, 3)[:, : self.oversample]
        return looks.mean(1) if self.oversample > 1 else looks[:, 0]

    def _turning(self, motion: Motion) -> np.ndarray:
        """The rate (n, 3) without its error."""
        if not self.turn:
            return self._mean(motion.rate)
        before, now = np.moveaxis(motion.attitude.reshape(-1, self._each, 4)[:, -2:], 1, 0)
        turn = to_rotation_vector(multiply(conjugate(before, xp=np), now, xp=np), xp=np)
        return np.asarray(turn / (self.period * 1e-9))

    @property
    def _each(self) -> int:
        """At how many times a reading needs the motion."""
        return self.oversample + 2 * self.turn


@dataclass(frozen=True, kw_only=True)
class Gyroscope(RateSensor):
    """Reads the angular rate in the body (`Gyro`, rad/s): rate + bias + noise."""

    name: str = "gyro"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Gyro:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return Gyro(rate=self._turning(motion) + error)


@dataclass(frozen=True, kw_only=True)
class Accelerometer(InertialSensor):
    """Reads the specific force in the body (`SpecificForce`, m/s^2): R^T (a - gravity) + bias + noise."""

    name: str = "accelerometer"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> SpecificForce:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return SpecificForce(force=self._mean(motion.specific_force) + error)


@dataclass(frozen=True, kw_only=True)
class CoordinateAccelerometer(InertialSensor):
    """Reads the second derivative of position in the body (`CoordinateAcceleration`, m/s^2): R^T a + bias +
    noise.

    The thesis's accelerometer (sec. "Sensors").
    """

    name: str = "coordinate_acceleration"
    rate: float = 200.0
    noise: Noise = NO_NOISE

    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> CoordinateAcceleration:
        error = self.noise.error(self.name, seed, seconds, 3, rate=self.rate)
        return CoordinateAcceleration(acceleration=self._mean(motion.coordinate_acceleration) + error)


@dataclass(frozen=True, kw_only=True)
class InertialUnit(InertialSensor):
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
        rate, force = self._mean(motion.rate), self._mean(motion.specific_force)
        return Imu(gyro=rate + turn, specific_force=force + push)

    @property
    def densities(self) -> ImuNoise:
        """The noise as continuous densities, for a filter; a deviation per sample is one over this rate."""
        white = [
            np.hypot(n.density, n.deviation / np.sqrt(self.rate)) for n in (self.gyro, self.accelerometer)
        ]
        return ImuNoise(float(white[0]), float(white[1]), self.gyro.walk, self.accelerometer.walk)
