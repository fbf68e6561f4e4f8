"""Gyro compassing: north by the turn of the Earth, while a body rests.

A gyroscope at rest reads the Earth's turn, 15 degrees an hour, and its own bias. Levelled by the mean
specific force, the horizontal part of what it reads points north, by

    tan(error) = horizontal error of the rate / (turn cos(latitude))

so that a bias b turns the heading by b / (turn cos(latitude)): 0.06 degrees for 0.01 degrees an hour, half a
circle and more for a unit of a telephone. A tilt of an accelerometer's bias brings in the vertical part.

Source: P. Groves, "Principles of GNSS, inertial, and multisensor integrated navigation systems", 2nd ed.,
2013, sec. 5.6.2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.inertial.alignment import aligned, usable
from flowgraph.blocks.inertial.imu import ImuNoise

__all__ = ["Compassed", "compass_by_gyro"]

_SURE = 4.0  # deviations, by which the vertical part may miss the Earth's


class Compassed(NamedTuple):
    """What a body at rest shows of its attitude.

    Args:
        attitude: (4,), body to a world of east, north, up.
        heading, tilt: rad, their deviations.
        missed: by how many deviations the vertical part of the turn is not the Earth's.
    """

    attitude: np.ndarray
    heading: float
    tilt: float
    missed: float

    @property
    def believed(self) -> bool:
        """Whether what was read can be the Earth's turn."""
        return self.missed <= _SURE


def compass_by_gyro(
    imu: Series,
    seconds: float,
    *,
    turn: tuple[float, float, float],
    noise: ImuNoise,
    gyro_bias: float,
    accelerometer_bias: float,
) -> Compassed:
    """The attitude of a body that rests for the first `seconds` of a recording.

    Args:
        imu: a series of `Imu`, of which a reading shows where up is.
        turn: rad/s, of the Earth, in a world of east, north, up.
        noise: white densities of the unit.
        gyro_bias, accelerometer_bias: rad/s and m/s^2, deviations of its constant biases, an axis.
    """
    at = usable(imu["specific_force"]) & np.isfinite(imu["gyro"]).all(axis=-1)
    at &= imu.time - imu.time[0] <= round(seconds * 1e9)
    force, rate = imu["specific_force"][at].mean(axis=0), imu["gyro"][at].mean(axis=0)
    q = np.asarray(aligned(force, rate, north=0.5 * math.pi, nearest=np.array([1.0, 0, 0, 0]), xp=np))
    lasts = max(seconds, 1e-9)
    unsure = math.hypot(gyro_bias, noise.gyro / math.sqrt(lasts))
    tilt = math.hypot(accelerometer_bias, noise.accelerometer / math.sqrt(lasts)) / np.linalg.norm(force)
    level, up = turn[1], turn[2]
    heading = math.hypot(unsure / level, tilt * up / level) if level > 0.0 else math.inf
    missed = abs(float(rotate(q, rate, xp=np)[2]) - up) / math.hypot(unsure, tilt * level)
    return Compassed(q, heading, float(tilt), missed)
