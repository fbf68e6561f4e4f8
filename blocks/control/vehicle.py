"""A quadrotor that is told a thrust and a body rate, as a plant, and a controller that flies it to a place.

Its state is position, velocity, attitude, body rate and thrust. Rate and thrust follow what is told with a
lag, that of the rotors; the thrust is along body z, as the thesis's vehicle has it:

    dv/dt = R (0, 0, f) + gravity      dR/dt = R skew(w)
    df/dt = (f_c - f) / lag            dw/dt = (w_c - w) / lag

Source: R. Fiszel's thesis (2017), control inputs; D. Mellinger and V. Kumar, "Minimum snap trajectory
generation and control for quadrotors", ICRA 2011, sec. IV, whose controller tells moments in place of rates.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.control.plant import plant
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import conjugate, rotate
from flowgraph.blocks.signals import GRAVITY, BodyMotion, FlightCommand
from flowgraph.blocks.statespace import MotionModel, runge_kutta
from flowgraph.language.moore import Moore

__all__ = ["fly_to", "quadrotor", "quadrotor_motion"]

VEHICLE = StateSpace(
    position=euclidean(3),
    velocity=euclidean(3),
    attitude=quaternion(),
    rate=euclidean(3),
    thrust=euclidean(1),
)


def quadrotor(
    *, at: object, position: Any = (0.0, 0.0, 0.0), lag: float = 0.05, name: str = "quadrotor"
) -> Moore:
    """A quadrotor in a loop, level and hovering where it fires first: read its state, `feed` it a
    `FlightCommand`.

    Args:
        at: when its state is read, a stream or clock.
        position: m, world, at the start.
        lag: s, of rotors that follow what is told.
        name: of the node.
    """

    def rates(x: Any, u: Any, xp: Any) -> Any:
        f = xp.concat([xp.zeros_like(x.thrust), xp.zeros_like(x.thrust), x.thrust], axis=-1)
        push = rotate(x.attitude, f, xp=xp) + xp.asarray(np.array(GRAVITY), dtype=f.dtype)
        return {
            "position": x.velocity,
            "velocity": push,
            "attitude": x.rate,
            "rate": (u.rate - x.rate) / lag,
            "thrust": (u.thrust - x.thrust) / lag,
        }

    still, level = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    start = np.concatenate([np.asarray(position, dtype=float), still, level, still, [9.81]])
    hover = FlightCommand(thrust=9.81, rate=np.zeros(3))
    model = MotionModel(VEHICLE, runge_kutta(VEHICLE, rates))
    return plant(model, start=start, command=hover, at=at, name=name)


@block
def quadrotor_motion(state: Array, *, xp: Any) -> BodyMotion:  # type: ignore[no-untyped-def]
    """How the quadrotor of this state moves, for sensors to read."""
    x = VEHICLE.view(state, xp)
    none = xp.zeros_like(x.thrust)
    push = rotate(x.attitude, xp.concat([none, none, x.thrust], axis=-1), xp=xp)
    return BodyMotion(
        position=x.position,
        velocity=x.velocity,
        acceleration=push + xp.asarray(np.array(GRAVITY), dtype=push.dtype),
        attitude=x.attitude,
        rate=x.rate,
    )


@block
def fly_to(
    estimate, target: Array, *, place: float = 4.0, speed: float = 3.0, turn: float = 8.0,
    most_push: float = 6.0, xp: Any,
) -> FlightCommand:  # type: ignore[no-untyped-def]  # fmt: skip
    """Thrust and body rate that take a quadrotor to `target` (3, m, world), heading along world x.

    The push wanted is place (target - p) - speed v, each axis at most `most_push` m/s^2, and what carries it;
    the body's z axis is turned to it, and the heading to 0, at `turn` 1/s."""
    q = estimate.attitude
    wanted = place * (target - estimate.position) - speed * estimate.velocity
    wanted = xp.minimum(xp.maximum(wanted, -most_push), most_push)
    push = wanted - xp.asarray(np.array(GRAVITY), dtype=wanted.dtype)
    along = rotate(conjugate(q, xp=xp), push, xp=xp)  # in the body
    size = xp.sqrt(xp.linalg.vecdot(along, along))
    heading = 2.0 * xp.atan2(q[3], q[0])
    rate = turn * xp.stack([-along[1] / size, along[0] / size, -heading])
    return FlightCommand(thrust=along[2], rate=rate)
