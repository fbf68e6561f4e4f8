"""What a world tells: where a body is, how it is turned, and all exact derivatives of both, at any time.

A `World` is immutable and answers for many times at once. What differs from flight to flight are `numbers`
that are drawn once: in a graph they are a value, which the blocks `world_motion` and `motion_over` hand to
their world at each tick.
"""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, block
from flowgraph.blocks.geometry.rotations import conjugate, multiply, rotate, to_matrix, to_rotation_vector
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.signals import BodyMotion, Drawn
from flowgraph.errors import DataError

__all__ = ["Motion", "World", "motion_over", "world_motion"]


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

    @property
    @abc.abstractmethod
    def numbers(self) -> int:
        """How many numbers make a flight of this world; 0 where all are the same."""

    @abc.abstractmethod
    def shaped(self, numbers: Array) -> World:
        """The flight of these `numbers` (n)."""

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
def world_motion(
    shape: Drawn | None = None, *, world: World, late: float = 0.0, t: Any, xp: Any
) -> BodyMotion:
    """Where the body of a world is at this tick, and how it moves; time counts from 0, and the world stands
    before that and after its `duration`. Give it a clock: `world_motion(world=Hover(20.0), at=imu)`.

    shape: of the flight, where some of it is drawn. late: s, how long ago it was what is told."""
    return _told(_moves(shape, world, t, late, np.zeros(()), xp))


@block
def motion_over(
    shape: Drawn | None = None, *, world: World, seconds: float, looks: int = 1, turn: bool = False,
    gravity: tuple[float, float, float] = GRAVITY, late: float = 0.0, t: Any, xp: Any,
) -> BodyMotion:  # fmt: skip
    """The motion as an inertial sensor takes it that reads the `seconds` up to now, not the instant.

    Position, velocity and attitude are those of now. rate: the mean over `looks`, evenly spaced; with `turn`
    that of the whole turn, log(R(t - T)^T R(t)) / T, so R(t) = R(t - T) Exp(rate T). acceleration: what at
    the attitude of now gives the mean specific force, R mean(R_k^T (a_k - gravity)) + gravity; with no
    gravity, the mean of R_k^T a_k. Before it begins the world stands still."""
    ago = (np.arange(looks)[::-1] + 0.5) / looks * seconds if looks > 1 else np.zeros(1)
    seen = _moves(shape, world, t, late, np.concatenate([ago, [seconds, 0.0]]), xp)
    down = xp.asarray(gravity, dtype=seen.acceleration.dtype)
    now, before = seen.attitude[-1], seen.attitude[-2]
    force = rotate(conjugate(seen.attitude[:looks], xp=xp), seen.acceleration[:looks] - down, xp=xp)
    turned = to_rotation_vector(multiply(conjugate(before, xp=xp), now, xp=xp), xp=xp) / seconds
    return BodyMotion(
        position=seen.position[-1],
        velocity=seen.velocity[-1],
        acceleration=rotate(now, xp.mean(force, axis=0), xp=xp) + down,
        attitude=now,
        rate=turned if turn else xp.mean(seen.rate[:looks], axis=0),
    )


def _moves(shape: Drawn | None, world: World, t: Any, late: float, ago: np.ndarray, xp: Any) -> Motion:
    """The motion at times `ago` (...) s before this tick less what it is `late`."""
    flight = world if shape is None else world.shaped(shape.numbers)
    now = xp.astype(t - round(late * 1e9), xp.float64) * 1e-9
    return flight.motion(xp.minimum(xp.maximum(now - ago, 0.0), world.duration), xp=xp)


def _told(moved: Motion) -> BodyMotion:
    return BodyMotion(
        position=moved.position,
        velocity=moved.velocity,
        acceleration=moved.acceleration,
        attitude=moved.attitude,
        rate=moved.rate,
    )
