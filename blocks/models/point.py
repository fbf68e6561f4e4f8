"""A point in space driven by its acceleration: the model, the signals and the start of the linear filters.

State x = (position, velocity), m and m/s in the world. The control is the coordinate acceleration in the
world, which an accelerometer gives to whoever knows the attitude: a = R(q) (f - bias) + gravity. A filter
that is told the exact attitude and biases is the bound: no filter on the same accelerometer and positions can
do better.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 6.2.2 (white noise acceleration).
"""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Flight, Series, Signal, block, real
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.inertial.imu import GRAVITY, reading_of
from flowgraph.blocks.kalman.filters import Gaussian
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.metrics.errors import interpolate_pose
from flowgraph.errors import DataError

__all__ = [
    "PointBelief",
    "PointReading",
    "WorldAcceleration",
    "between",
    "point_belief",
    "point_model",
    "start_point",
    "told_acceleration",
]


class WorldAcceleration(Signal):
    """The second derivative of position, m/s^2, in world coordinates."""

    acceleration: Array = real(3, unit="m/s^2", frame="world")

    @classmethod
    def at_rest(cls) -> Self:
        """None."""
        return cls(acceleration=np.zeros(3))


class PointReading(Signal):
    """A control and what was measured with it: acceleration (m/s^2) and position (m), both world.

    A coordinate that was not measured is NaN.
    """

    acceleration: Array = real(3, unit="m/s^2", frame="world")
    position: Array = real(3, unit="m", frame="world")


class PointBelief(Signal):
    """The belief about a point: position (m) and velocity (m/s), world, with the covariance of both."""

    position: Array = real(3, unit="m", frame="world")
    velocity: Array = real(3, unit="m/s", frame="world")
    covariance: Array = real(6, 6)


@block
def point_belief(belief: Gaussian) -> PointBelief:
    """A Gaussian over (position, velocity), with names and units."""
    x = belief.mean
    return PointBelief(position=x[..., :3], velocity=x[..., 3:6], covariance=belief.covariance)


@block
def between(before: WorldAcceleration, now: WorldAcceleration) -> WorldAcceleration:
    """The mean of the last control and this one, which a step between their times holds.

    Holding either alone lags or leads by half a step. Where no new control came, both are the last one.
    """
    return WorldAcceleration(acceleration=0.5 * (before.acceleration + now.acceleration))


def point_model(density: float) -> LinearModel:
    """p' = v, v' = a, with white noise of `density` (m/s^2/sqrt(Hz)) on the acceleration.

        F = [I  dt I]    G = [dt^2/2 I]    Q = density^2 [dt^3/3 I  dt^2/2 I]
            [0     I]        [dt I    ]                  [dt^2/2 I  dt I    ]

    (The thesis prints the control matrix without its dt.)
    """
    one, none = np.eye(3), np.zeros((3, 3))
    A = np.block([[none, one], [none, none]])
    return LinearModel(A, np.vstack([none, one]), np.diag([0.0] * 3 + [density**2] * 3))


def start_point(
    position: npt.ArrayLike,
    velocity: npt.ArrayLike = (0.0, 0.0, 0.0),
    *,
    position_deviation: float = 0.7,
    velocity_deviation: float = 0.7,
) -> Gaussian:
    """A belief to start from: position (3,) m and velocity (3,) m/s, with their standard deviations."""
    P = np.diag([position_deviation**2] * 3 + [velocity_deviation**2] * 3)
    mean = np.concatenate([np.asarray(position, dtype=float), np.asarray(velocity, dtype=float)])
    return Gaussian(mean=mean, covariance=P)


def told_acceleration(flight: Flight) -> Series:
    """The flight's specific force as a `WorldAcceleration`, by the truth's attitude and accelerometer bias.

    Raises:
        DataError: for a flight without an IMU or without a truth.
    """
    imu, truth = flight.streams.get("imu"), flight.truth
    if imu is None or truth is None:
        raise DataError(
            "the acceleration in the world is not known",
            path=flight.name,
            expected="a stream imu, and a truth that tells the attitude",
            got=", ".join(flight.streams) + (", no truth" if truth is None else ""),
            fix="choose a simulated flight, or give the filter accelerations of your own",
        )
    half = flight.info["imu_period_ns"] // 2 if reading_of(flight) == "mean" else 0
    attitude = interpolate_pose(truth, imu.time - half)[1]  # of a mean, that of its middle
    force = imu["specific_force"]
    if "accelerometer_bias" in truth.leaves:
        last = np.maximum(np.searchsorted(truth.time, imu.time, side="right") - 1, 0)
        force = force - truth["accelerometer_bias"][last]
    turned = (to_matrix(attitude, xp=np) @ force[..., None])[..., 0]
    found = WorldAcceleration(acceleration=turned + np.array(GRAVITY))
    return Series(imu.time, found, name="acceleration")
