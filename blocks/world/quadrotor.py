"""A quadrotor's flight along key points: its thrust points where the acceleration asks, and that tilts it.

A quadrotor pushes along its body z axis only, so thrust and attitude follow from the acceleration:

    f n = a - gravity       q = shortest arc from world z to n = (1 + n_z, -n_y, n_x, 0) / sqrt(2 (1 + n_z))

and the body rate from the jerk, through dn/dt = (jerk - n (n . jerk)) / f and rate = 2 vec(q^-1 dq/dt). A
shortest arc has no heading of its own: it turns slowly about body z as the thrust moves round.

Source: Mueller, Hehn, D'Andrea 2015 (see `minimum_jerk`), eqs. 1-4; R. Fiszel's thesis (2017), data
generation.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np

from flowgraph import Array
from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.world.feasibility import LIMITS, Limits, feasible
from flowgraph.blocks.world.minimum_jerk import KeyPoint, Primitives, join
from flowgraph.blocks.world.motion import Motion, World

__all__ = ["Quadrotor", "carried_by_thrust"]


@dataclass(frozen=True, eq=False)
class Quadrotor(World):
    """A flight along minimum-jerk primitives.

    Args:
        primitives: see `join`; or use `Quadrotor.along`.
    """

    primitives: Primitives

    @classmethod
    def along(cls, key_points: Iterable[KeyPoint], **start: Any) -> Self:
        """The flight from a start (at rest at the origin, or `position`, `velocity`, `acceleration`)."""
        return cls(join(key_points, **start))

    @property
    def duration(self) -> float:
        return self.primitives.duration

    @property
    def numbers(self) -> int:
        return int(np.prod(np.shape(self.primitives.coefficients)))

    def shaped(self, numbers: Array) -> Quadrotor:
        """The flight with these coefficients of its primitives (n 6 3,) and their times."""
        shape = np.shape(self.primitives.coefficients)
        rows = numbers.__array_namespace__().reshape(numbers, shape)
        return replace(self, primitives=replace(self.primitives, coefficients=rows))

    def feasible(self, limits: Limits = LIMITS) -> bool:
        """Whether thrust and body rate stay within the limits."""
        return feasible(self.primitives, limits)

    def motion(self, seconds: Array, *, xp: Any) -> Motion:
        return carried_by_thrust(*self.primitives.at(seconds, xp=xp), xp=xp)


def carried_by_thrust(
    position: Array, velocity: Array, acceleration: Array, jerk: Array, *, xp: Any = np
) -> Motion:
    """The motion of a quadrotor whose path has these derivatives, (..., 3) each; upside down it has none."""
    force = acceleration - np.array(GRAVITY)
    strength = xp.sqrt(xp.sum(force * force, axis=-1, keepdims=True))
    n = force / strength
    dn = (jerk - n * xp.sum(n * jerk, axis=-1, keepdims=True)) / strength
    (x, y, z), (dx, dy, dz) = ([v[..., k] for k in range(3)] for v in (n, dn))
    up = 1.0 + z
    attitude = xp.stack([up, -y, x, 0.0 * z], axis=-1) / xp.sqrt(2.0 * up)[..., None]
    rate = xp.stack([-dy + dz * y / up, dx - dz * x / up, (y * dx - x * dy) / up], axis=-1)
    return Motion(position, velocity, acceleration, jerk, attitude, rate)
