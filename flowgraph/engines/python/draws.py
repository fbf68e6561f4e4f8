"""Random numbers of a recording, made for some of its ticks at once.

A draw is a function of seed, name and time, and a recording says its times beforehand. NumPy takes about a
microsecond over each pass however short the array is, so a few hundred numbers a tick cost several times less
where the passes go over those of many ticks. Over how many it goes grows while most are used, and falls where
they are not, as where a cloud is seldom drawn anew.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.random import Site

_NUMBERS = 8192
"""At most in one pass: arrays of 64 KiB stay in a processor's cache, and memory for them is at hand."""

_TICKS, _START = 256, 4


class Ahead:
    """The draws of one site, by time.

    Args:
        times: at which it is expected to be drawn, int64 ns; none where nobody knows, and each is made alone.
        seed: of the run, (2,) uint32.
    """

    def __init__(self, site: Site, times: np.ndarray, seed: np.ndarray) -> None:
        self._site, self._times, self._seed = site, times, seed
        self._most = max(1, min(_TICKS, _NUMBERS // max(1, math.prod(site.shape))))
        self._many, self._first = _START, 0
        self._made: dict[int, Any] = {}

    def forget(self) -> None:
        """Make all draws anew, since the seed is another."""
        self._made = {}

    def __call__(self, time: int) -> Any:
        if self._most == 1:
            return self._site.numbers(time, self._seed, xp=NUMPY)
        if time in self._made:
            return self._made.pop(time)
        first, used = int(np.searchsorted(self._times, time)), self._many - len(self._made)
        dense = first - self._first <= 2 * used
        self._many = min(2 * self._many, self._most) if dense else max(self._many // 2, 1)
        self._first, self._made = first, {}
        times = self._times[first : first + self._many]
        if len(times) < 2 or times[0] != time:
            return self._site.numbers(time, self._seed, xp=NUMPY)
        rows = np.moveaxis(self._site.at(times, self._seed), -1, 0)
        self._made = dict(zip(times.tolist(), np.ascontiguousarray(rows), strict=True))
        return self._made.pop(time)
