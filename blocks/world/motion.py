"""What a world tells: where a body is, how it is turned, and all exact derivatives of both, at any time.

A `World` is immutable and answers for many times at once. Sensors read it; nothing else in a simulation does.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.signals import BodyMotion
from flowgraph.errors import DataError

__all__ = ["Motion", "World", "world_motion"]


@dataclass(frozen=True, eq=False)
class Motion:
    """The state of a rigid body at n times.

    Args:
        position, velocity, acceleration, jerk: (n, 3) in m, m/s, m/s^2, m/s^3, world (z up).
        attitude: (n, 4) unit quaternions (w, x, y, z), body to world, with no jumps of sign.
        rate: (n, 3) rad/s, body: the exact derivative of the attitude, dq/dt = q * (0, rate) / 2.
    """

    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    attitude: np.ndarray
    rate: np.ndarray

    @property
    def rotation(self) -> np.ndarray:
        """(n, 3, 3) rotation matrices, body to world."""
        return np.asarray(to_matrix(self.attitude, xp=np))

    def to_body(self, vector: npt.ArrayLike) -> np.ndarray:
        """(n, 3) world vectors in body coordinates."""
        return np.asarray(np.einsum("nji,nj->ni", self.rotation, np.broadcast_to(vector, (len(self), 3))))

    @property
    def coordinate_acceleration(self) -> np.ndarray:
        """(n, 3) m/s^2, body: R^T a, zero at rest; not what an accelerometer reads."""
        return self.to_body(self.acceleration)

    @property
    def specific_force(self) -> np.ndarray:
        """(n, 3) m/s^2, body: R^T (a - gravity), +9.81 upwards at rest; what an ideal accelerometer reads."""
        return self.to_body(self.acceleration - np.array(GRAVITY))

    @property
    def thrust(self) -> np.ndarray:
        """(n,) m/s^2: the specific force along body z. On a quadrotor's flight that is all of it, |a -
        gravity|."""
        return self.specific_force[:, 2]

    @property
    def tilt(self) -> np.ndarray:
        """(n,) rad: the angle between body z and world z."""
        return np.asarray(2.0 * np.arctan2(*np.hypot(self.attitude[:, [1, 0]], self.attitude[:, [2, 3]]).T))

    def __len__(self) -> int:
        return len(self.position)


class World(abc.ABC):
    """A body that moves for `duration` seconds."""

    @property
    @abc.abstractmethod
    def duration(self) -> float:
        """s: the world answers for 0 to this."""

    @abc.abstractmethod
    def motion(self, seconds: Array, *, xp: Any) -> Motion:
        """The motion at (...) seconds, all within 0 and `duration`, written in the array API."""

    def at(self, seconds: npt.ArrayLike) -> Motion:
        """The motion at times (n,) in s.

        Raises:
            DataError: for a time outside 0 .. `duration`.
        """
        t = np.atleast_1d(np.asarray(seconds, dtype=float))
        outside = ~((t >= 0.0) & (t <= self.duration + 1e-9))
        if outside.any():
            raise DataError(
                "this time is outside the world",
                path=type(self).__name__,
                expected=f"seconds from 0 to {self.duration:g}",
                got=f"{t[outside][0]:g}",
                fix="shorten the recording (until=), or make a longer world",
            )
        return self.motion(np.minimum(t, self.duration), xp=np)


@block
def world_motion(*, world: World, t: Any, xp: Any) -> BodyMotion:
    """Where the body of a world is at this tick, and how it moves; time counts from 0, and the world stands
    before that and after its `duration`. Give it a clock: `world_motion(world=Hover(20.0), at=imu)`."""
    seconds = xp.minimum(xp.maximum(xp.astype(t, xp.float64) * 1e-9, 0.0), world.duration)
    moved = world.motion(seconds, xp=xp)
    return BodyMotion(
        position=moved.position,
        velocity=moved.velocity,
        acceleration=moved.acceleration,
        attitude=moved.attitude,
        rate=moved.rate,
    )
