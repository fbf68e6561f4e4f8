"""The random flights of the thesis: five rounds of three key points, 20 s, from rest at the origin.

A round is [position, velocity and acceleration given, 1 s; position only, 1 s; position and velocity, 2 s].
All that is given is drawn: mean plus the square root of a variance times a standard normal number on each
axis. A flight that the vehicle cannot fly is thrown away as a whole, and another drawn. The numbers are those
of the generator of graphs, the first try at time 0 ns, the next at 1 ns and so on. To try hundreds of whole
flights is nothing for a reaction of fixed size: a graph is handed the flight that was found.

The text leaves the limits open; they are those of its program, thrust 5 to 20 m/s^2 and body rate 20 rad/s,
and let one draw in six hundred pass. Over 200 seeds the root mean squares are 6.4 m/s^2 of acceleration, 30
degrees of tilt and 2.2 rad/s of body rate, as `figures` prints them. Wider limits make the family wilder: 8.2
m/s^2, 36 degrees and 2.8 rad/s with 30 m/s^2 and 35 rad/s, where one draw in eleven passes.

Source: R. Fiszel's thesis (2017), "Data generation"; the limits, those of its program, scala-flow.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator

import numpy as np

from flowgraph.blocks.inertial.imu import GRAVITY
from flowgraph.blocks.world.feasibility import LIMITS, Limits
from flowgraph.blocks.world.minimum_jerk import KeyPoint, Vector, primitive
from flowgraph.blocks.world.quadrotor import Quadrotor
from flowgraph.errors import DataError
from flowgraph.recorder.random import Site, seed_words

__all__ = ["AVERAGE", "ROUND", "ROUNDS", "VARIANCES", "random_key_points", "thesis_flight"]

ROUNDS = 5

ROUND: tuple[KeyPoint, ...] = (
    KeyPoint(1.0, position=(0.0, 0.75, 1.0), velocity=(1.0, 1.0, 1.0), acceleration=(0.0, 0.0, 0.0)),
    KeyPoint(1.0, position=(1.0, 1.0, 0.8)),
    KeyPoint(2.0, position=(-1.0, -1.0, 1.0), velocity=(0.0, 0.0, 0.0)),
)
"""The means of one round."""

AVERAGE = Quadrotor.along(ROUND * ROUNDS)
"""The flight of the means, whose times are those of all."""

VARIANCES = (0.6, 0.2, 0.1)
"""Of position (m^2), velocity (m^2/s^2) and acceleration (m^2/s^4), on each axis."""

_NUMBERS = 90
"""The standard normal numbers of one draw: six vectors a round."""

_AT_ONCE = 256
"""Draws that are looked at together: most are thrown away."""

_LOOKS = np.linspace(0.0, 1.0, 9)
"""Where on each primitive."""


def random_key_points(seed: int, *, tried: int = 0) -> list[KeyPoint]:
    """The fifteen key points of one draw of a seed, after so many others."""
    return _key_points(_draws(seed, tried, 1)[0])


def thesis_flight(seed: int = 0, *, limits: Limits = LIMITS, attempts: int = 20_000) -> Quadrotor:
    """The first feasible flight of the draws of `seed`.

    Raises:
        DataError: when none of `attempts` draws is feasible.
    """
    return _first_feasible(seed, limits, attempts)


@functools.lru_cache(maxsize=1024)
def _first_feasible(seed: int, limits: Limits, attempts: int) -> Quadrotor:
    for tried in range(0, attempts, _AT_ONCE):
        draws = _draws(seed, tried, min(_AT_ONCE, attempts - tried))
        for draw in draws[_may_be_feasible(draws, limits)]:
            flight = Quadrotor.along(_key_points(draw))
            if flight.feasible(limits):
                return flight
    raise DataError(
        "no random flight is feasible",
        path="thesis_flight",
        expected=f"one of {attempts} draws within {limits}",
        got="none",
        fix="widen the limits (least_thrust 5, most_thrust 20, rate 20 do), or allow more attempts",
    )


_SITE = Site("thesis/key_points", "normal", (_NUMBERS,))


def _draws(seed: int, first: int, count: int) -> np.ndarray:
    """(count, 90)."""
    numbers = _SITE.at(np.arange(first, first + count), seed_words(seed))
    return np.ascontiguousarray(numbers.T)


def _goals(draws: np.ndarray) -> Iterator[tuple[KeyPoint, tuple[bool, bool, bool], np.ndarray]]:
    """For each key point its means, what it gives, and what was drawn (..., 3, 3), by draws (..., 90)."""
    at = 0
    for _ in range(ROUNDS):
        for mean in ROUND:
            goal = np.full((*draws.shape[:-1], 3, 3), np.nan)
            parts = (mean.position, mean.velocity, mean.acceleration)
            for k, (part, variance) in enumerate(zip(parts, VARIANCES, strict=True)):
                if part is not None:
                    goal[..., k, :] = np.array(part) + math.sqrt(variance) * draws[..., at : at + 3]
                    at += 3
            p, v, a = (part is not None for part in parts)
            yield mean, (p, v, a), goal


def _key_points(draw: np.ndarray) -> list[KeyPoint]:
    def row(known: bool, values: np.ndarray) -> Vector | None:
        x, y, z = values.tolist()
        return (x, y, z) if known else None

    return [KeyPoint(mean.seconds, *map(row, given, goal)) for mean, given, goal in _goals(draw)]


def _may_be_feasible(draws: np.ndarray, limits: Limits) -> np.ndarray:
    """Which of many draws (n, 90) keep the limits of thrust at a few times: the others surely break them."""
    state = np.zeros((len(draws), 3, 3))
    kept = np.ones(len(draws), dtype=bool)
    low, high = limits.least_thrust * (1.0 - 1e-9), limits.most_thrust * (1.0 + 1e-9)
    for mean, given, goal in _goals(draws):
        row, state = primitive(state, goal, given, mean.seconds)
        t = mean.seconds * _LOOKS
        powers = np.stack([2.0 + 0.0 * t, 6.0 * t, 12.0 * t**2, 20.0 * t**3])
        push = np.einsum("nki,kt->nti", row[:, 2:], powers) - np.array(GRAVITY)
        thrust = np.sqrt((push**2).sum(-1))
        kept &= ((thrust >= low) & (thrust <= high)).all(-1)
    return kept
