"""Models of things that move, for any method of `filtering`: points, vehicles that turn, a pendulum.

Points, in any number of dimensions, are linear, and their steps are exact over any time:

    constant_velocity      v' = w
    constant_acceleration  a' = w
    singer                 a' = -a / time + w, an acceleration that lasts

Vehicles in the plane, whose speed is along their heading or whose velocity turns:

    coordinated_turn       the velocity turns by a rate that wanders
    bicycle                turns by its front wheel; the control is what its driver does

A `pendulum` swings. w is white noise, of the density that each is given.

Sources: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
2001, secs. 6.2, 8.2.3 (Singer) and 11.7.1 (turns); R. Rajamani, "Vehicle Dynamics and Control", 2nd ed.,
2012, sec. 2.2 (the kinematic bicycle).
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.groups import swept, turned_by
from flowgraph.blocks.geometry.manifold import StateSpace, angle, euclidean
from flowgraph.blocks.kalman.linear import LinearModel
from flowgraph.blocks.signals import Steering
from flowgraph.blocks.statespace import MotionModel, runge_kutta

__all__ = [
    "BICYCLE",
    "PENDULUM",
    "TURNING",
    "bicycle",
    "constant_acceleration",
    "constant_velocity",
    "coordinated_turn",
    "pendulum",
    "singer",
]

TURNING = StateSpace(position=euclidean(2), velocity=euclidean(2), rate=euclidean(1))
"""m, m/s, rad/s."""

BICYCLE = StateSpace(position=euclidean(2), heading=angle(), speed=euclidean(1))
"""Of the middle of the rear axle: m, rad, m/s."""

PENDULUM = StateSpace(angle=angle(), rate=euclidean(1))
"""rad from hanging, rad/s."""


def constant_velocity(density: float, *, dimensions: int = 2) -> LinearModel:
    """A point (position, velocity) whose velocity wanders.

    Args:
        density: of the acceleration, white: m/s^2/sqrt(Hz).
        dimensions: of space.
    """
    return _point(("position", "velocity"), dimensions, 0.0, density)


def constant_acceleration(density: float, *, dimensions: int = 2) -> LinearModel:
    """A point (position, velocity, acceleration) whose acceleration wanders.

    Args:
        density: of the jerk, white: m/s^3/sqrt(Hz).
        dimensions: of space.
    """
    return _point(("position", "velocity", "acceleration"), dimensions, 0.0, density)


def singer(deviation: float, time: float, *, dimensions: int = 2) -> LinearModel:
    """A point (position, velocity, acceleration) that manoeuvres: Singer's model of 1970.

    Args:
        deviation: of the acceleration, m/s^2.
        time: how long a manoeuvre lasts, s: the acceleration forgets itself as exp(-t / time).
        dimensions: of space.
    """
    density = deviation * np.sqrt(2.0 / time)
    return _point(("position", "velocity", "acceleration"), dimensions, -1.0 / time, float(density))


def _point(names: tuple[str, ...], d: int, decay: float, density: float) -> LinearModel:
    k = len(names)
    A = np.eye(k, k, 1)
    A[-1, -1] = decay
    driven = np.zeros(k)
    driven[-1] = density**2
    space = StateSpace(**{name: euclidean(d) for name in names})
    return LinearModel(np.kron(A, np.eye(d)), None, np.kron(np.diag(driven), np.eye(d)), space=space)


def coordinated_turn(acceleration: float, turn: float) -> MotionModel:
    """A point over `TURNING`, whose velocity turns by a rate: an aircraft, seen from above.

        p' = p + S(rate dt) v dt      v' = R(rate dt) v + a dt      rate' = rate + w dt

    S is the mean of R over the turn; over a step the turn is exact.

    Args:
        acceleration: density of a, white on each axis of the world: m/s^2/sqrt(Hz).
        turn: density of the rate's own change: rad/s^2/sqrt(Hz).
    """
    return MotionModel(TURNING, _turn, density=np.array([acceleration**2, acceleration**2, turn**2]))


def _turn(x: Any, w: Array, dt: Any, xp: Any) -> tuple[Array, ...]:
    theta, push = x.rate * dt, w[..., :2] * dt
    gone = (swept(theta, x.velocity, xp) + 0.5 * push) * dt
    return x.position + gone, turned_by(theta, x.velocity, xp) + push, x.rate + w[..., 2:] * dt


def bicycle(wheelbase: float, *, steering: float, acceleration: float) -> MotionModel:
    """A vehicle over `BICYCLE` that is steered by its front wheels; the control is a `Steering`.

        p' = speed (cos, sin)(heading)      heading' = speed tan(angle) / wheelbase      speed' = acceleration

    Args:
        wheelbase: from axle to axle, m.
        steering: density of the error of tan(angle), white: 1/sqrt(Hz).
        acceleration: density of the error of the acceleration: m/s^2/sqrt(Hz).
    """

    def drive(x: Any, u: Steering, w: Array, xp: Any) -> tuple[Array, ...]:
        along = xp.concat([xp.cos(x.heading), xp.sin(x.heading)], axis=-1)
        turn = x.speed[..., 0] * (xp.tan(u.angle) + w[..., 0]) / wheelbase
        return x.speed * along, turn, u.acceleration + w[..., 1]

    density = np.array([steering**2, acceleration**2])
    return MotionModel(BICYCLE, runge_kutta(BICYCLE, drive), density=density)


def pendulum(length: float, *, push: float, gravity: float = 9.81, damping: float = 0.0) -> MotionModel:
    """A pendulum over `PENDULUM`: angle' = rate, rate' = -gravity/length sin(angle) - damping rate + w.

    Args:
        length: m.
        push: density of w, white: rad/s^2/sqrt(Hz).
        gravity: m/s^2. damping: 1/s.
    """

    def swing(x: Any, w: Array, xp: Any) -> tuple[Array, ...]:
        return x.rate, -gravity / length * xp.sin(x.angle) - damping * x.rate + w

    return MotionModel(PENDULUM, runge_kutta(PENDULUM, swing), density=np.array([push**2]))
