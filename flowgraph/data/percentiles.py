"""Percentiles of very many durations in little memory: counts by length, to three per cent.

A run that goes on for days cannot keep a number a tick. Durations are counted in bins whose width grows with
their length, thirty-two to each doubling, from a nanosecond to an hour.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

_PER_DOUBLING = 32
_BINS = 42 * _PER_DOUBLING


class Durations:
    """Counts of durations in ns.

    Attributes:
        count: how many.
        total, longest: ns.
    """

    def __init__(self) -> None:
        self._bins = [0] * _BINS
        self.count, self.total, self.longest = 0, 0, 0

    def add(self, ns: int) -> None:
        """Count one more."""
        ns = max(ns, 1)
        self._bins[min(int(math.log2(ns) * _PER_DOUBLING), _BINS - 1)] += 1
        self.count += 1
        self.total += ns
        self.longest = max(self.longest, ns)

    def percentile(self, share: float) -> float:
        """The duration in s below which this share in per cent lies, to 3 %; NaN where there are none."""
        if not self.count:
            return math.nan
        reached = np.cumsum(self._bins)
        k = int(np.searchsorted(reached, share / 100 * self.count))
        return float(min(2.0 ** ((min(k, _BINS - 1) + 1) / _PER_DOUBLING), self.longest) * 1e-9)


@dataclass(frozen=True)
class Latencies:
    """How long things took, in s: percentiles to 3 %.

    Args:
        arrival: from the arrival of the newest event of a tick to its end, what is held back for order too.
        response: from when a tick was complete to its end.
        work: in the tick itself.
        deadline_missed: ticks whose response was longer than the deadline.
    """

    arrival: Mapping[str, float]
    response: Mapping[str, float]
    work: Mapping[str, float]
    deadline_missed: int
