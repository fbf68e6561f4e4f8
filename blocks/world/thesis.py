"""The random flights of the thesis: five rounds of three key points, 20 s, from rest at the origin.

A round is [position, velocity and acceleration given, 1 s; position only, 1 s; position and velocity, 2 s].
All that is given is drawn: mean plus the square root of a variance times a standard normal number on each
axis. A flight that the vehicle cannot fly is thrown away as a whole, and another drawn.

The text leaves the limits open. Ours, thrust 5 to 30 m/s^2 and body rate 35 rad/s, let one draw in eleven
pass. Over 200 seeds the root mean squares are 8.2 m/s^2 of acceleration, 36 degrees of tilt and 2.8 rad/s of
body rate, as `figures` prints them. Lower limits make the family tamer: 7.4 m/s^2, 34 degrees and 2.5 rad/s
with 25 m/s^2 and 20 rad/s, where one draw in fifty passes.

Source: R. Fiszel's thesis (2017), "Data generation".
"""

from __future__ import annotations

import math

import numpy as np

from flowgraph.blocks.world.draws import generator
from flowgraph.blocks.world.feasibility import LIMITS, Limits
from flowgraph.blocks.world.minimum_jerk import KeyPoint, Vector
from flowgraph.blocks.world.quadrotor import Quadrotor
from flowgraph.errors import DataError

__all__ = ["ROUND", "ROUNDS", "VARIANCES", "random_key_points", "thesis_flight"]

ROUNDS = 5

ROUND: tuple[KeyPoint, ...] = (
    KeyPoint(1.0, position=(0.0, 0.75, 1.0), velocity=(1.0, 1.0, 1.0), acceleration=(0.0, 0.0, 0.0)),
    KeyPoint(1.0, position=(1.0, 1.0, 0.8)),
    KeyPoint(2.0, position=(-1.0, -1.0, 1.0), velocity=(0.0, 0.0, 0.0)),
)
"""The means of one round."""

VARIANCES = (0.6, 0.2, 0.1)
"""Of position (m^2), velocity (m^2/s^2) and acceleration (m^2/s^4), on each axis."""


def random_key_points(random: np.random.Generator) -> list[KeyPoint]:
    """The fifteen key points of one draw."""

    def around(mean: Vector | None, variance: float) -> Vector | None:
        if mean is None:
            return None
        x, y, z = (np.array(mean) + math.sqrt(variance) * random.standard_normal(3)).tolist()
        return (x, y, z)

    p, v, a = VARIANCES
    return [
        KeyPoint(
            mean.seconds, around(mean.position, p), around(mean.velocity, v), around(mean.acceleration, a)
        )
        for _ in range(ROUNDS)
        for mean in ROUND
    ]


def thesis_flight(seed: int = 0, *, limits: Limits = LIMITS, attempts: int = 20_000) -> Quadrotor:
    """The first feasible flight of the draws of `seed`.

    Raises:
        DataError: when none of `attempts` draws is feasible.
    """
    random = generator(seed, "thesis")
    for _ in range(attempts):
        flight = Quadrotor.along(random_key_points(random))
        if flight.feasible(limits):
            return flight
    raise DataError(
        "no random flight is feasible",
        path="thesis_flight",
        expected=f"one of {attempts} draws within {limits}",
        got="none",
        fix="widen the limits (least_thrust 5, most_thrust 30, rate 35 do), or allow more attempts",
    )
