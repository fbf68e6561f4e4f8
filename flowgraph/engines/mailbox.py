"""Where live events wait: bounded queues between threads, and a merge by stamp.

Any number of threads put events into a queue for each source; one thread takes them out, in the order in
which they came. What a full queue does is declared: whoever puts waits ("block"), the oldest waiting event
gives way ("drop_oldest"), or the new one is turned away ("refuse"). Nothing is lost uncounted.

What was taken out is put in order of its stamps. The watermark is the newest stamp that has come, less the
lateness that was declared: what is older than the watermark is complete and makes ticks, all events of one
stamp one tick. What comes when a later tick has been made is too late, and counted. So the ticks follow from
the order of arrival, and from no clock on the wall.
"""

from __future__ import annotations

import heapq
from collections import deque
from collections.abc import Sequence
from threading import Condition
from typing import Any, NamedTuple

from flowgraph.language.graph import NEVER

POLICIES = ("block", "drop_oldest", "refuse")
"""What a full queue does."""


class Event(NamedTuple):
    """A value of a source: its stamp in ns, its place among the sources, and when it came in ns.

    What was put together has one number.
    """

    number: int
    stamp: int
    source: int
    value: Any
    arrived: int


class Mailboxes:
    """A bounded queue for each source.

    Args:
        sources: how many.
        size: events that wait in each at most.
        full: what a full queue does, of `POLICIES`.

    Attributes:
        taken_in, dropped, refused: by source, counts.
    """

    def __init__(self, sources: int, size: int, full: str) -> None:
        self._queues: list[deque[Event]] = [deque() for _ in range(sources)]
        self._size, self._full = size, full
        self._changed = Condition()
        self._numbers, self._closed = 0, False
        self.taken_in = [0] * sources
        self.dropped = [0] * sources
        self.refused = [0] * sources

    def put(self, events: Sequence[tuple[int, int, Any]], arrived: int, timeout: float | None = None) -> bool:
        """Put events (source, stamp, value) of different sources into their queues, and nothing between them.

        A queue that blocks turns its event away after `timeout` s, or at once for 0; one that is closed,
        always. What is turned away is counted.

        Returns:
            Whether all were taken in.
        """
        sources = [source for source, _, _ in events]
        with self._changed:
            if self._full == "block":
                self._changed.wait_for(lambda: self._closed or self.have_room(sources), timeout)
            self._numbers += 1
            taken = [self._put(Event(self._numbers, t, k, value, arrived)) for k, t, value in events]
            self._changed.notify_all()
        return all(taken)

    def _put(self, event: Event) -> bool:
        source, queue = event.source, self._queues[event.source]
        if self._closed or (len(queue) >= self._size and self._full != "drop_oldest"):
            self.refused[source] += 1
            return False
        if len(queue) >= self._size:
            queue.popleft()
            self.dropped[source] += 1
        self.taken_in[source] += 1
        queue.append(event)
        return True

    def have_room(self, sources: Sequence[int]) -> bool:
        """Whether none of these queues is full now."""
        return all(len(self._queues[k]) < self._size for k in sources)

    @property
    def waiting(self) -> bool:
        """Whether any queue holds an event."""
        return any(self._queues)

    def take(self, timeout: float | None) -> list[Event] | None:
        """All waiting events in the order in which they came; none after `timeout` s, None once closed."""
        with self._changed:
            if not self._changed.wait_for(lambda: self._closed or any(self._queues), timeout):
                return []
            found = [event for queue in self._queues for event in queue]
            if not found and self._closed:
                return None
            for queue in self._queues:
                queue.clear()
            self._changed.notify_all()
        return sorted(found) if len(found) > 1 else found

    def close(self) -> None:
        """Take nothing in from now on."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()


class Order:
    """Events put in order of their stamps.

    Args:
        sources: how many.
        lateness: ns by which an event may come after a newer one.
        most: events that are held back at most; beyond, the oldest are complete at once.
        after: the time of the last tick.

    Attributes:
        late, twice: by source, how many events came too late, and how many of one stamp came again.
        crowded: how many ticks were complete because too many events were held back.
    """

    def __init__(self, sources: int, lateness: int, most: int, after: int = NEVER) -> None:
        self._lateness, self._most = lateness, most
        self._stamps: list[int] = []
        self._held: dict[int, dict[int, Event]] = {}
        self._newest, self._done, self._count = NEVER, after, 0
        self.late = [0] * sources
        self.twice = [0] * sources
        self.crowded = 0

    def put(self, event: Event) -> bool:
        """Hold an event; False where it is too late or came before, and is counted."""
        if event.stamp <= self._done:
            self.late[event.source] += 1
            return False
        tick = self._held.get(event.stamp)
        if tick is None:
            tick = self._held[event.stamp] = {}
            heapq.heappush(self._stamps, event.stamp)
        if event.source in tick:
            self.twice[event.source] += 1
            return False
        tick[event.source] = event
        self._newest = max(self._newest, event.stamp)
        self._count += 1
        return True

    def ready(self, *, everything: bool = False) -> list[tuple[int, Sequence[Event]]]:
        """The ticks that are complete, in order: the stamp, and the events of each."""
        found: list[tuple[int, Sequence[Event]]] = []
        while self._stamps and (
            everything or self._stamps[0] <= self._newest - self._lateness or self._count > self._most
        ):
            stamp = heapq.heappop(self._stamps)
            self.crowded += not everything and stamp > self._newest - self._lateness
            events = self._held.pop(stamp)
            self._count -= len(events)
            self._done = stamp
            found.append((stamp, [events[k] for k in sorted(events)]))
        return found

    @property
    def waiting(self) -> bool:
        """Whether events are held back."""
        return bool(self._stamps)
