"""What goes into one call of a compiled scan: arrays of the ticks of a chunk, filled again for each chunk.

They lie where XLA takes an array as it is, at a multiple of 64 bytes; one at another address would be copied.
An input that is not there at every tick is spread over the ticks here, a chunk at a time, so that no array
of all ticks is made of it: with zeros between its values, or with the last of them. A run that ends leaves
its buffers to the next, which the system need not give it new memory for.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from flowgraph.data.tape import Rows

_ALIGNMENT = 64


class Buffers:
    """The choice of a program, the time and the inputs at the ticks of one chunk.

    Args:
        ticks: of a chunk.
        choice: the dtype of what chooses a program.
        timed: whether the time is read.
        inputs: for each input port its leaves, (..., T or fewer, ...).
        axis: of the ticks in these.
        real: the dtype of real numbers.
        idle: the choice at ticks in which nothing is present.
        held: places of inputs whose values stay until the next; None where nobody asks since when they do.
    """

    def __init__(
        self,
        ticks: int,
        choice: Any,
        timed: bool,
        inputs: Sequence[Sequence[np.ndarray]],
        axis: int,
        real: Any,
        idle: int,
        held: Collection[int] | None = None,
    ) -> None:
        self._ticks, self._axis, self._idle, self._held = ticks, axis, idle, held or ()
        self._since = None if held is None else np.zeros(len(inputs), np.int32)
        self._choice = aligned((ticks,), choice)
        self._time = aligned((ticks,), np.int64) if timed else None
        self._written: list[Rows] = [slice(0, 0, 1)] * len(inputs)  # for each port, where it is not 0
        self._leaves = tuple(
            tuple(
                aligned(
                    (*x.shape[:axis], ticks, *x.shape[axis + 1 :]), real if x.dtype.kind == "f" else x.dtype
                )
                for x in port
            )
            for port in inputs
        )

    @property
    def bytes(self) -> int:
        """What they take."""
        return sum(a.nbytes for a in self._filled)

    def fits(self, inputs: Sequence[Sequence[np.ndarray]]) -> bool:
        """Whether these inputs go into them, but for the number of their rows."""
        axis = self._axis
        return all(
            x.shape[:axis] == kept.shape[:axis] and x.shape[axis + 1 :] == kept.shape[axis + 1 :]
            for port, leaves in zip(inputs, self._leaves, strict=True)
            for x, kept in zip(port, leaves, strict=True)
        )

    @property
    def arrays(self) -> tuple[Any, ...]:
        """What the scan goes through: choice, time (None where it is not read), the leaves, and since when.

        Since which tick of the chunk each input that is held has a value; before it may be anything.
        """
        return self._choice, self._time, self._leaves, self._since

    def fill(
        self,
        choice: np.ndarray,
        time: np.ndarray,
        rows: Sequence[Rows],
        inputs: Sequence[Sequence[np.ndarray]],
        here: slice,
    ) -> None:
        """Take the ticks `here` of a recording; those that are short of a chunk are idle.

        Args:
            choice, time: of all ticks, (T,).
            rows: for each input port at which ticks it has its rows.
            inputs: for each input port its leaves, as they were given to the constructor.
            here: from one tick to before another.
        """
        count = here.stop - here.start
        self._choice[:count] = choice[here]
        self._choice[count:] = self._idle
        if self._time is not None:
            self._time[:count] = time[here]
            self._time[count:] = time[here.stop - 1]
        before = (slice(None),) * self._axis
        for k, (at, port, leaves) in enumerate(zip(rows, inputs, self._leaves, strict=True)):
            places, part = _within(at, here)
            values = [array[(*before, part)] for array in port]
            if self._since is not None and k in self._held:
                self._since[k] = first = _first(places, self._ticks)
                for some, kept in zip(values, leaves, strict=True):
                    whole = np.moveaxis(kept, self._axis, 0)
                    _hold(whole[first:], np.moveaxis(some, self._axis, 0), places)
                continue
            last, self._written[k] = self._written[k], places
            same = isinstance(places, slice) and isinstance(last, slice) and places == last
            for some, kept in zip(values, leaves, strict=True):
                if isinstance(at, slice) and at.step is None:  # at all ticks
                    kept[(*before, slice(count, None))] = 0
                elif not same:
                    kept[...] = 0
                kept[(*before, places)] = some

    def holds(self, array: np.ndarray) -> bool:
        """Whether an array lies in one of these, and so will not stay as it is."""
        return any(np.may_share_memory(array, kept) for kept in self._filled)

    @property
    def _filled(self) -> list[np.ndarray]:
        """What is filled again for each chunk."""
        some = [self._choice, self._time, *(leaf for port in self._leaves for leaf in port)]
        return [a for a in some if a is not None]


def _within(rows: Rows, here: slice) -> tuple[Rows, slice]:
    """Of some ticks those `here`, counted from its start, and which of them these are."""
    if isinstance(rows, np.ndarray):
        first, last = np.searchsorted(rows, (here.start, here.stop)).tolist()
        return rows[first:last] - here.start, slice(first, last)
    start, step = rows.start or 0, rows.step or 1
    last = here.stop if rows.stop is None else min(here.stop, rows.stop)
    before, within = (max(0, -(-(tick - start) // step)) for tick in (here.start, last))
    return slice(start + before * step - here.start, max(last - here.start, 0), step), slice(before, within)


def _first(places: Rows, ticks: int) -> int:
    """The first of some ticks of a chunk; after its last where there is none."""
    if isinstance(places, slice):
        return min(places.start, ticks) if places.start < places.stop else ticks
    return int(places[0]) if len(places) else ticks


def _hold(kept: np.ndarray, values: np.ndarray, places: Rows) -> None:
    """Write values at some ticks, and at those after each the same; `kept` begins at the first."""
    if not len(values):
        return
    if isinstance(places, np.ndarray):
        kept[...] = np.repeat(values, np.diff(places - places[0], append=len(kept)), axis=0)
        return
    step, whole = places.step or 1, len(values) - 1
    kept[: whole * step].reshape(whole, step, *kept.shape[1:])[...] = values[:-1, None]
    kept[whole * step :] = values[-1]


def aligned(shape: tuple[int, ...], dtype: Any) -> np.ndarray:
    """An array of zeros at an address that XLA takes as it is."""
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    room = np.zeros(size + _ALIGNMENT, np.uint8)
    start = -room.ctypes.data % _ALIGNMENT
    made: np.ndarray = room[start : start + size].view(dtype).reshape(shape)
    return made
