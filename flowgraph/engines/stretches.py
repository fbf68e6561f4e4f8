"""Outputs that come in stretches of ticks, put together.

An output that is present at every tick is written where it will stay; of another the rows are kept until the
end, since nobody knows how many there will be.
"""

from __future__ import annotations

import numpy as np

from flowgraph.data.tape import Tape
from flowgraph.pipeline.pipeline import Pipeline, Port
from flowgraph.types import DTYPES


class Gathered:
    """The rows of one output.

    Args:
        port: the output.
        time: of all ticks, (T,) int64 ns.
    """

    def __init__(self, port: Port, time: np.ndarray) -> None:
        self._port, self._time = port, time
        self._done = 0
        self._whole: list[np.ndarray] | None = []
        self._parts: list[tuple[np.ndarray, list[np.ndarray]]] = []

    def add(self, ticks: int, times: np.ndarray, leaves: list[np.ndarray]) -> None:
        """The next ticks: how many, the times of those in which it is present, and its leaves there."""
        here = slice(self._done, self._done + ticks)
        if self._whole is not None and len(times) == ticks:
            if ticks == len(self._time):
                self._whole = leaves
            else:
                if not self._done:
                    self._whole = [np.empty((len(self._time), *x.shape[1:]), x.dtype) for x in leaves]
                for kept, leaf in zip(self._whole, leaves, strict=True):
                    kept[here] = leaf
        else:
            if self._whole is not None and self._done:
                self._parts = [(self._time[: self._done], [x[: self._done] for x in self._whole])]
            self._whole = None
            self._parts.append((times, leaves))
        self._done = here.stop

    def rows(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """Times and leaves of all rows."""
        if self._whole is not None and self._done:
            return self._time[: self._done], self._whole
        if not self._parts:
            none: list[np.ndarray] = [
                np.zeros((0, *leaf.shape), DTYPES[leaf.dtype]) for leaf in self._port.leaves
            ]
            return self._time[:0], none
        times = np.concatenate([t for t, _ in self._parts])
        columns = zip(*(leaves for _, leaves in self._parts), strict=True)
        return times, [np.concatenate(column) for column in columns]


def gathered(pipeline: Pipeline, tape: Tape) -> list[Gathered]:
    """For each output what will hold its rows."""
    return [Gathered(port, tape.time) for port in pipeline.outputs]
