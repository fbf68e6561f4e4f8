"""A stream as it grows: rows put one after the other into arrays, without an object a row."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.types import DTYPES, Type, leaves_of, unflatten


class Columns:
    """Times and leaves of values of one type, in arrays that double when they are full."""

    def __init__(self, type_: Type, name: str, *, gaps: bool = False) -> None:
        self._type, self._name, self._gaps = type_, name, gaps
        self._count = 0
        self._time = np.empty(64, np.int64)
        self._leaves: list[np.ndarray] = [
            np.empty((64, *map(int, leaf.shape)), DTYPES[leaf.dtype]) for _, leaf in leaves_of(type_)
        ]

    def add(self, time: int, leaves: Sequence[Any]) -> None:
        """One more row."""
        n = self._count
        if n == len(self._time):
            self._time = _doubled(self._time)
            self._leaves = [_doubled(leaf) for leaf in self._leaves]
        self._time[n] = time
        for column, value in zip(self._leaves, leaves, strict=True):
            column[n] = value
        self._count = n + 1

    def series(self) -> Series:
        """The rows so far."""
        n = self._count
        values = unflatten(self._type, iter([leaf[:n].copy() for leaf in self._leaves]))
        return Series(self._time[:n].copy(), values, type=self._type, name=self._name, gaps=self._gaps)


def _doubled(array: np.ndarray) -> np.ndarray:
    more = np.empty((2 * len(array), *array.shape[1:]), array.dtype)
    more[: len(array)] = array
    return more
