"""What the state of an outdoor filter is made of, and where each part stands in its means and its errors.

The Gaussian filter has one state, each particle another; both may end with the biases of the unit. A part
takes so many numbers of the mean and has so many directions of error: an attitude four and three. The small
turn of a particle takes none, since it goes into the attitude as soon as it is known.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph import Array

__all__ = ["Layout", "belief_layout", "particle_layout"]


class Layout:
    """The parts of a state by name, in order.

    Args:
        parts: of each how many numbers of the mean it takes, and how many directions its error has.

    Attributes:
        means, errors: where each part stands in a mean, and in a covariance.
        size, directions: how many numbers and directions there are in all.
        biased: whether biases are among them.
    """

    def __init__(self, **parts: tuple[int, int]) -> None:
        self._parts = parts
        self.means, self.errors = (
            {name: slice(*pair) for name, pair in zip(parts, itertools.pairwise(ends), strict=True)}
            for ends in ([0, *itertools.accumulate(p[k] for p in parts.values())] for k in (0, 1))
        )
        self.size, self.directions = (sum(p[k] for p in parts.values()) for k in (0, 1))
        self.biased = "gyro_bias" in parts

    def with_biases(self) -> Layout:
        """And behind them the biases of gyroscope (rad/s) and accelerometer (m/s^2)."""
        return Layout(**self._parts, gyro_bias=(3, 3), accelerometer_bias=(3, 3))

    def diagonal(self, **values: float) -> np.ndarray:
        """A number for each direction (directions): of its part, 0 where none is said; of parts that are not
        here nothing."""
        return np.repeat([values.get(name, 0.0) for name in self.errors], 3)

    def blocks(self, entries: Mapping[tuple[str, str], float]) -> np.ndarray:
        """(directions, directions): multiples of I (3, 3), by the part of the row and that of the column."""
        found = np.zeros((self.directions, self.directions))
        for (row, column), value in entries.items():
            found[self.errors[row], self.errors[column]] = np.eye(3) * value
        return found

    def copied(self, parts: Mapping[str, str]) -> np.ndarray:
        """(directions, directions): of a state some of whose parts become others, and the rest stays."""
        return self.blocks({(name, parts.get(name, name)): 1.0 for name in self.errors})

    def but(self, part: str, x: Array, xp: Any) -> Array:
        """Of one number a direction (directions, ...) those of all other parts."""
        at = self.errors[part]
        if at.stop == self.directions:
            return x[: at.start, ...]
        return xp.concat([x[: at.start, ...], x[at.stop :, ...]], axis=0)

    def put(self, part: str, x: Array, numbers: Array, xp: Any) -> Array:
        """What `but` has taken apart, together again."""
        at = self.errors[part].start
        return xp.concat([x[:at, ...], numbers, *([x[at:, ...]] if self.biased else [])], axis=0)


BELIEF = Layout(
    position=(3, 3), velocity=(3, 3), attitude=(4, 3), picture_position=(3, 3), picture_attitude=(4, 3)
)
"""Of the Gaussian filter: 17 numbers, 15 directions."""

PARTICLE = Layout(velocity=(3, 3), position=(3, 3), moved=(3, 3), turn=(0, 3))
"""Of each particle, beside its attitude: 9 numbers, 12 directions."""

_BELIEFS, _PARTICLES = ((one, one.with_biases()) for one in (BELIEF, PARTICLE))


def belief_layout(x: Array) -> Layout:
    """That of a mean (..., 17) of the Gaussian filter, or (..., 23) with biases."""
    return next(one for one in _BELIEFS if one.size == x.shape[-1])


def particle_layout(state: Array) -> Layout:
    """That of particles whose errors are (12, ...), or (18, ...) with biases: of a covariance or a move."""
    return next(one for one in _PARTICLES if one.directions == state.shape[0])
