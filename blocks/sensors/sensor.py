"""What all sensors share: a name, a clock, and a way for the data to arrive late.

A sensor is a recipe, an immutable object. `sample(world, seed=, until=)` reads the world by it and gives a
`Series`. What it draws depends on the seed and the sensor's name only, so no sensor changes another.

**Latency.** A sample is *true* at its stamp and *arrives* later: a fixed time, plus a normal one where
`jitter` is given, never less than zero. The times of the `Series` are those of arrival, for that is when a
filter can know; so the values lie behind them. `record` also gives the stamp of each row. Samples are
delivered as they arrive: with much jitter one may overtake another, and then the stamps go backwards. What
arrives after `until` is not in the recording. Two that would arrive at one nanosecond are set one apart.
"""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass

import numpy as np

from flowgraph import Series, Signal
from flowgraph.blocks.world.draws import generator
from flowgraph.blocks.world.motion import Motion, World
from flowgraph.errors import DeclarationError
from flowgraph.language.clock import nanoseconds

__all__ = ["Recording", "Sensor"]


@dataclass(frozen=True)
class Recording:
    """What a sensor delivered.

    Args:
        series: times of arrival and readings.
        stamp: (n,) int64 ns, when each reading was true.
    """

    series: Series
    stamp: np.ndarray


@dataclass(frozen=True, kw_only=True)
class Sensor(abc.ABC):
    """The base of all sensors.

    Args:
        name: of the stream, and of all random numbers.
        rate: Hz; the period is rounded to nanoseconds once.
        phase: s, of the first sample.
        latency: s, from the stamp to the arrival.
        jitter: s, standard deviation of the latency (normal, cut off at zero).

    Raises:
        DeclarationError: for a rate that is not positive, or a negative time.
    """

    name: str
    rate: float
    phase: float = 0.0
    latency: float = 0.0
    jitter: float = 0.0

    def __post_init__(self) -> None:
        times = (self.phase, self.latency, self.jitter)
        if not (0.0 < self.rate <= 1e9 and all(math.isfinite(t) and t >= 0.0 for t in times)):
            raise DeclarationError(
                "this sensor has no such clock",
                path=self.name,
                expected="rate > 0 (Hz), and phase, latency and jitter of 0 s or more",
                got=f"rate={self.rate}, phase={self.phase}, latency={self.latency}, jitter={self.jitter}",
                fix="for example rate=200.0, latency=0.05",
            )

    @property
    def period(self) -> int:
        """ns."""
        return round(1e9 / self.rate)

    def sample(self, world: World, *, seed: int = 0, until: str | int | None = None) -> Series:
        """The readings, by time of arrival.

        Args:
            world: what is read.
            seed: of the random numbers; those of the sensor depend on its name too.
            until: the end of the recording, "20s" or integer nanoseconds; the world's duration when left out.
        """
        return self.record(world, seed=seed, until=until).series

    def record(self, world: World, *, seed: int = 0, until: str | int | None = None) -> Recording:
        """The readings, with the stamps at which they were true."""
        end = math.floor(world.duration * 1e9 + 0.5) if until is None else nanoseconds(until, what="until")
        stamp = np.arange(round(self.phase * 1e9), end + 1, self.period, dtype=np.int64)
        motion = world.at(self._looks(stamp / 1e9))
        values = self._read(motion, stamp / 1e9, seed)
        arrival = stamp + self._lateness(len(stamp), seed)
        here = np.flatnonzero(self._present(motion))
        order = here[np.argsort(arrival[here], kind="stable")]
        place = np.arange(len(order))
        arrival = np.maximum.accumulate(arrival[order] - place) + place  # strictly increasing
        order, arrival = order[arrival <= end], arrival[arrival <= end]
        series = Series(stamp, values, name=self.name)[order]
        return Recording(Series(arrival, series.values, type=series.type, name=self.name), stamp[order])

    def _lateness(self, count: int, seed: int) -> np.ndarray:
        """(count,) int64 ns."""
        spread = generator(seed, f"{self.name}.latency").standard_normal(count) * self.jitter
        return np.rint(np.maximum(self.latency + spread, 0.0) * 1e9).astype(np.int64)

    def _looks(self, seconds: np.ndarray) -> np.ndarray:
        """The times in s at which `_read` needs the motion, for stamps (n,) in s: those of the stamps."""
        return seconds

    @abc.abstractmethod
    def _read(self, motion: Motion, seconds: np.ndarray, seed: int) -> Signal:
        """The readings at (n,) seconds, with the motion at `_looks`; leaves have a leading axis of n."""

    def _present(self, motion: Motion) -> np.ndarray:
        """(n,) whether there is a reading at all; all are drawn, so that what is left out moves no draws."""
        return np.ones(len(motion), dtype=bool)
