"""What is wrong with a reading: white noise, a constant bias, and a bias that walks.

    reading = truth + bias + walk(t) + white

White noise is a continuous density, a deviation of each sample, or both. It is made discrete here and nowhere
else: a sample at `rate` Hz has the variance density^2 rate + deviation^2, and the walk adds walk^2 dt between
samples dt apart.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from flowgraph.blocks.world.draws import generator
from flowgraph.errors import DeclarationError

__all__ = ["NO_NOISE", "Noise"]


@dataclass(frozen=True)
class Noise:
    """Errors of a reading, the same on each of its axes. U is the reading's unit.

    Args:
        density: of white noise, U/sqrt(Hz); for what samples a continuous signal, as inertial sensors do.
        deviation: standard deviation of white noise in each sample, U.
        bias: standard deviation of the constant bias, U; drawn once for a recording.
        walk: density of the bias's random walk, U/s/sqrt(Hz).

    Raises:
        DeclarationError: when one is negative or not finite.
    """

    density: float = 0.0
    deviation: float = 0.0
    bias: float = 0.0
    walk: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(x) and x >= 0.0 for x in vars(self).values()):
            raise DeclarationError(
                "noise cannot be negative",
                path="Noise",
                expected="finite numbers that are not negative",
                got=repr(self),
                fix="give standard deviations and densities, not covariances",
            )

    @classmethod
    def variance(cls, variance: float, *, bias: float = 0.0, walk: float = 0.0) -> Self:
        """White noise from its variance per sample, U^2, as the thesis gives it."""
        return cls(deviation=math.sqrt(variance), bias=bias, walk=walk)

    def white(self, name: str, seed: int, count: int, axes: int, *, rate: float) -> np.ndarray:
        """White noise (count, axes) of samples at `rate` Hz, drawn as "name.noise"."""
        size = math.hypot(self.density * math.sqrt(rate), self.deviation)
        return generator(seed, f"{name}.noise").standard_normal((count, axes)) * size

    def drift(self, name: str, seed: int, seconds: np.ndarray, axes: int) -> np.ndarray:
        """Bias and walk (n, axes) at times (n,) in s, drawn as "name.bias" and "name.walk"."""
        start = generator(seed, f"{name}.bias").standard_normal(axes) * self.bias
        steps = generator(seed, f"{name}.walk").standard_normal((max(len(seconds) - 1, 0), axes))
        steps *= self.walk * np.sqrt(np.diff(seconds))[:, None]
        return np.asarray(start + np.concatenate([np.zeros((1, axes)), np.cumsum(steps, axis=0)]))[
            : len(seconds)
        ]

    def error(self, name: str, seed: int, seconds: np.ndarray, axes: int, *, rate: float) -> np.ndarray:
        """All of it, (n, axes), at times (n,) in s."""
        return self.drift(name, seed, seconds, axes) + self.white(name, seed, len(seconds), axes, rate=rate)


NO_NOISE = Noise()
"""A perfect reading."""
