"""What comes in live, before it makes a tick: each event is checked, and what did not come is counted.

An event that is refused leaves no trace. Whole periods without an event of a periodic source are packets that
were lost; after a jump of a clock without a phase, the next event is measured from the one that jumped.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from flowgraph.data.inputs import NOT_FINITE, check_value, periods_lost, rule_of
from flowgraph.data.tape import check_stamp, need_near
from flowgraph.errors import ClockError, DataError, UnknownNameError
from flowgraph.language.graph import Graph


@dataclass(frozen=True)
class Admitted:
    """Events that make a tick.

    Args:
        time: of the tick in ns.
        key: with bit k set where source k is present; 0 where no event is left, and so no tick.
        values: by source place, in order.
        lost: by source name, how many periods went by without an event.
        absent: names of the sources whose value is not finite, and so no event.
    """

    time: int
    key: int
    values: tuple[tuple[int, Any], ...]
    lost: Mapping[str, int]
    absent: tuple[str, ...]


class Entrance:
    """Checks the events of a live run of a graph.

    Args:
        graph: what they go to.
        last: the last time of each source.
        not_finite: what an event with a NaN or an infinity is: "raise", "absent" or "keep".

    Attributes:
        lost, absent: by source, counts.
    """

    def __init__(self, graph: Graph, last: Mapping[str, int], not_finite: str = "raise") -> None:
        self._graph = graph
        self._rule = rule_of("not_finite", not_finite, NOT_FINITE)
        self._heard = dict(last)  # the last event of each source, be it one that was refused
        self._first: int | None = None
        self.lost = dict.fromkeys(graph.sources, 0)
        self.absent = dict.fromkeys(graph.sources, 0)

    def events(self, time: Any, values: Mapping[str, Any]) -> list[tuple[str, int, Any]]:
        """The source, stamp and value of each event of one push, checked as `value` does.

        Raises:
            DataError: for a push without events, and as of `value`.
        """
        self._need_events(values)
        return [(name, *self.value(name, time, value)) for name, value in values.items()]

    def _need_events(self, values: Mapping[str, Any]) -> None:
        if not values:
            raise DataError(
                "a tick needs an event",
                path=self._graph.name,
                expected="a value for one source or more: " + ", ".join(self._graph.sources),
                got="none",
                fix="call push(time, name=value)",
            )

    def value(self, name: str, time: Any, value: Any) -> tuple[int, Any]:
        """The stamp and value of one event, checked; the value is None where it is absent.

        Raises:
            UnknownNameError, DataError, TypeMismatchError: for an event that is refused.
        """
        if name not in self._graph.sources:
            raise UnknownNameError("source", name, self._graph.sources, path=self._graph.name)
        time = check_stamp(name, time)
        return time, check_value(name, time, value, self._graph.sources[name].type, self._rule)

    def admit(self, time: int, values: Mapping[str, Any], after: int, *, checked: bool = False) -> Admitted:
        """The tick at `time` that these values make; nothing is counted before `done`.

        Args:
            time: int ns.
            values: by source name.
            after: the time of the tick before.
            checked: whether the values went through `value`.

        Raises:
            DataError, ClockError, TypeMismatchError, UnknownNameError: for an event that is refused.
        """
        self._need_events(values)
        key, lost = 0, {}
        found: list[tuple[int, Any]] = []
        absent = []
        for k, name in enumerate(self._graph.sources):
            if name not in values:
                continue
            value = values[name]
            if not checked:
                time, value = self.value(name, time, value)
            lost[name] = self._periods_lost(name, time)
            if value is None:
                absent.append(name)
                continue
            found.append((k, value))
            key |= 1 << k
        for name in values:
            if name not in self._graph.sources:
                raise UnknownNameError("source", name, self._graph.sources, path=self._graph.name)
        if time <= after:
            raise DataError(
                "time goes backwards",
                path=self._graph.name,
                expected=f"a time after {after} ns",
                got=f"{time} ns",
                fix="push all events of one time in one call, in order",
            )
        self._first = time if self._first is None else self._first
        need_near(self._first, time)
        return Admitted(time, key, tuple(found), lost, tuple(absent))

    def done(self, admitted: Admitted) -> None:
        """The tick has happened."""
        for name, periods in admitted.lost.items():
            self.lost[name] += periods
            self._heard[name] = admitted.time
        for name in admitted.absent:
            self.absent[name] += 1

    def _periods_lost(self, name: str, time: int) -> int:
        timing = self._graph.sources[name].clock.timing
        try:
            return periods_lost(name, time, timing, self._heard[name])
        except ClockError:
            if timing.phase is None and time > self._heard[name]:
                self._heard[name] = time  # the clock may have jumped, and the next event keeps its period
            raise
