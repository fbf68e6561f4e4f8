"""Inputs of any length, some ticks at a time.

Each source is read only as far as the next ticks need: a recording by slices, an iterable by some events or
by the `Series` that it yields. What was read ahead of another source waits. Events are checked many at once,
as those of a recording are; one by one only where something is wrong with them, so that the message names it.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np

from flowgraph.data.inputs import Inputs, check_recording, single_events, sources_of
from flowgraph.data.series import Series, chained
from flowgraph.data.tape import Tape, read_all, stack
from flowgraph.errors import FlowgraphError
from flowgraph.language.graph import NEVER, Graph, SourceNode
from flowgraph.types import DTYPES, ArrayType, StructType, leaves_of, unflatten

_PLAIN = frozenset({int, float, np.ndarray, np.float64, np.float32, np.int64, np.int32})
_TRUTHS = frozenset({bool, np.bool_})
"""Kinds of a single value that NumPy stacks as they are; a masked array is none of them, and a truth value is
one only among its like."""
_PULLS = 16
"""In so many parts are the events of a stretch read, so that few of a slower source are read ahead."""
_TAKEN = {"real": "fiu", "bool": "b"}
"""Kinds of array that a leaf takes without a word; others are those of its own dtype."""


def stretches(
    graph: Graph, inputs: Inputs, last: Mapping[str, int], ticks: int
) -> Iterator[dict[str, Series]]:
    """The inputs, at most so many ticks at a time.

    Args:
        graph: whose sources they are of.
        inputs: as `simulate` takes them.
        last: the last time of each source in the state from which the run goes on, or `NEVER`. What is
            not after the latest of them is passed over.
        ticks: in a stretch; all but the last have so many.

    Raises:
        UnknownNameError, DataError, ClockError, TypeMismatchError: naming the source.
    """
    feeds = _feeds(graph, inputs, last)
    while True:
        known = _read(feeds, ticks)
        heads = tuple(feed.head(known, ticks) for feed in feeds)
        if not any(map(len, heads)):
            return
        found = Tape.of(heads).part(0, ticks).series
        for feed, series in zip(feeds, found, strict=True):
            feed.drop(len(series))
        yield dict(zip(graph.sources, found, strict=True))


def nothing(graph: Graph) -> dict[str, Series]:
    """Inputs without events."""
    return {name: stack([], [], node.type, name) for name, node in graph.sources.items()}


class _Feed:
    """What was read of a source and not played yet; `last` is the latest time that was read."""

    def __init__(self, name: str, node: SourceNode, events: Iterable[Any], before: int, start: int) -> None:
        self.name, self._node, self._events, self.last = name, node, iter(events), before
        self._start, self._waiting, self._from = start, list[Series](), 0
        self.ended = False

    def pull(self, count: int) -> None:
        """Read a piece: a series, or so many events."""
        head = next(self._events, None)
        if head is None:
            self.ended = True
            return
        timing = self._node.clock.timing
        if isinstance(head, Series):
            piece = check_recording(self.name, head, self._node.type, timing, self.last, self._start)
        else:
            events = [head, *itertools.islice(self._events, count - 1)]
            try:
                piece = check_recording(
                    self.name, self._stacked(events), self._node.type, timing, self.last, self._start
                )
            except (FlowgraphError, ValueError, TypeError, AttributeError, LookupError, OverflowError):
                one_by_one = single_events(self.name, events, self._node.type, timing, self.last, self._start)
                piece = read_all(self.name, one_by_one, self._node.type)
        if len(piece):
            self._waiting.append(piece)
            self.last = int(piece.time[-1])

    def waiting(self, until: int) -> int:
        """How many events wait up to a time; no fewer than there are."""
        return sum(int(np.searchsorted(p.time, until, "right")) for p in self._waiting) - self._from

    def head(self, until: int, most: int) -> Series:
        """The first events that wait, up to a time, and no more than are asked for."""
        if not self._waiting:
            return stack([], [], self._node.type, self.name)
        if len(self._waiting) > 1 or self._from > most:
            rest = [self._waiting[0][self._from :], *self._waiting[1:]] if self._from else self._waiting
            self._waiting, self._from = [chained(rest) if len(rest) > 1 else rest[0]], 0
        (piece,) = self._waiting
        end = min(int(np.searchsorted(piece.time, until, "right")), self._from + most)
        found: Series = piece[self._from : end]
        return found

    def drop(self, count: int) -> None:
        """The first events were played."""
        self._from += count
        if self._waiting and self._from >= len(self._waiting[0]):
            self._waiting, self._from = [], 0

    def _stacked(self, events: list[Any]) -> Series:
        """Events as a series; any error says no more than that they have to be looked at one by one."""
        if {type(e) for e in events} != {tuple} or {len(e) for e in events} != {2}:
            raise ValueError
        times, values = [t for t, _ in events], [v for _, v in events]
        if not {type(t) for t in times} <= {int, np.int64}:
            raise ValueError
        columns = [values]
        if isinstance(self._node.type, StructType):
            if {type(v) for v in values} != {self._node.type.cls} or self._node.type.cls in (tuple, dict):
                raise ValueError
            fields = self._node.type.fields
            if any(isinstance(inner, StructType) for _, inner in fields):
                raise ValueError
            columns = [[getattr(v, n) for v in values] for n, _ in fields]
        leaves = [leaf for _, leaf in leaves_of(self._node.type)]
        made = [_array(column, leaf) for column, leaf in zip(columns, leaves, strict=True)]
        values = unflatten(self._node.type, iter(made))
        return Series(times, values, type=self._node.type, name=self.name)


def _array(column: list[Any], leaf: ArrayType) -> np.ndarray:
    kinds = {type(x) for x in column}
    if not (kinds <= _PLAIN or kinds <= _TRUTHS):
        raise ValueError
    found = np.asarray(column)
    taken = _TAKEN.get(leaf.dtype, np.dtype(DTYPES[leaf.dtype]).kind)
    if found.shape != (len(column), *leaf.shape) or found.dtype.kind not in taken:
        raise ValueError
    return found


def _feeds(graph: Graph, inputs: Inputs, last: Mapping[str, int]) -> list[_Feed]:
    start = max(last.values(), default=NEVER)
    feeds = []
    for name, given in sources_of(graph, inputs).items():
        pieces: Iterable[Any] = [given] if isinstance(given, Series) else given
        pieces = pieces if start == NEVER else _after(pieces, start)
        feeds.append(_Feed(name, graph.sources[name], pieces, last[name], start))
    return feeds


def _after(pieces: Iterable[Any], start: int) -> Iterator[Any]:
    """Events or series, less what is not after a time."""
    for piece in pieces:
        if isinstance(piece, Series):
            yield piece[piece.time > start]
        elif not (isinstance(piece, tuple) and len(piece) == 2 and piece[0] <= start):
            yield piece


def _read(feeds: list[_Feed], ticks: int) -> int:
    """Read on until so many ticks wait, or all is read; returns the time up to which everything is known."""
    while reading := [feed for feed in feeds if not feed.ended]:
        known = min(feed.last for feed in reading)
        if any(feed.waiting(known) >= ticks for feed in feeds):
            return known
        min(reading, key=lambda feed: feed.last).pull(max(ticks // _PULLS, 1))
    return 2**63 - 1
