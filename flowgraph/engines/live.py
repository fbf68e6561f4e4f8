"""A graph that runs while its events come in: from threads, from an event loop, from packets.

Whoever has an event pushes it, from any thread, and goes on; one thread of the run puts what came in order of
its stamps and makes the ticks, or those who push do so in turn. Events wait in bounded queues with a declared
policy. Each that came is in one of the counts in the end: in a tick, too late, come twice, dropped or refused
at a full queue, refused by the clock, or no event because it was not finite. What was in ticks is kept as
`arrived`; the same engine run over it gives the same result to the bit.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from itertools import groupby
from operator import attrgetter
from threading import Lock, RLock, Thread, get_ident
from time import perf_counter, perf_counter_ns, sleep
from types import TracebackType
from typing import Any

from flowgraph.data.arrival import stamp_events
from flowgraph.data.columns import Columns
from flowgraph.data.inputs import Inputs, need_graph, prepare, rule_of
from flowgraph.data.notes import note
from flowgraph.data.percentiles import Durations, Latencies
from flowgraph.data.result import Result, statistics
from flowgraph.data.series import Series
from flowgraph.data.tape import merged
from flowgraph.engines.contract import BlockEngine
from flowgraph.engines.entrance import Admitted, Entrance
from flowgraph.engines.mailbox import POLICIES, Event, Mailboxes, Order
from flowgraph.engines.options import RunOptions
from flowgraph.engines.pace import Pace
from flowgraph.engines.registry import find_engine
from flowgraph.engines.stepping import stepper
from flowgraph.engines.watched import Watch, Watcher
from flowgraph.errors import ClockError, DataError
from flowgraph.language.checks import need_callable, need_count, need_numbers
from flowgraph.language.clock import nanoseconds
from flowgraph.language.graph import Graph, SourceNode, Wire
from flowgraph.types import flatten, unflatten

RECORDED = ("all", "arrived", "nothing")
"""What is kept of a live run."""

OnOutput = Callable[[str, int, Any], object]


class Live:
    """A live run of a graph.

    Args:
        graph: what to run. Sources that lose packets are declared `aperiodic`, or periodic with a jitter.
        engine: "python" or "c".
        dtype, init, state, seed: as of `simulate`.
        queue: events of one source that wait at most.
        full: what a full queue does: "block", "drop_oldest" or "refuse".
        lateness: by how much an event may come after a newer one, such as "20ms"; 0: whatever is older than
            what came is too late.
        deadline: for the end of a tick once it is complete, such as "1ms"; longer ones are counted.
        not_finite: what an event with a NaN or an infinity is: an error ("raise"), no event ("absent",
            counted), or data ("keep").
        record: what is kept of the run: what arrived and the outputs ("all"), the one ("arrived"), or
            neither ("nothing"), so that memory stays flat.
        on_output: called in the thread that makes the ticks with name, time and value of each output.
        thread: whether a thread of its own makes the ticks. If not, whoever pushes makes those that his
            events complete before `push` returns: nothing is handed over, so that no wake-up is waited for;
            a tick that is complete only since nothing comes any more waits for the next push, or `close`.
        watcher: who is shown what is on the wires (`flowgraph.LiveView` for a browser), in the same thread;
            of an engine other than Python's the events and the outputs.

    Raises:
        DeclarationError: for an engine that makes no single ticks; UnknownNameError: for another policy.
    """

    def __init__(
        self,
        graph: Graph,
        *,
        engine: str = "python",
        dtype: str = "float64",
        init: Mapping[str, Any] | None = None,
        state: Mapping[str, Any] | None = None,
        seed: int = 0,
        queue: int = 1024,
        full: str = "block",
        lateness: str | int = 0,
        deadline: str | int | None = None,
        not_finite: str = "raise",
        record: str = "all",
        on_output: OnOutput | None = None,
        thread: bool = True,
        watcher: Watcher | None = None,
    ) -> None:
        need_graph(graph, "Live")
        self.graph, self._engine = graph, engine
        rule_of("full", full, POLICIES)
        rule_of("record", record, RECORDED)
        need_callable("Live", on_output=on_output)
        need_count("Live", "queue", queue, least=1)
        options = RunOptions(engine=engine, dtype=dtype, init=init, state=state, seed=seed)
        self._watch = None if watcher is None else Watch(graph, watcher)
        self._blocks = self._watch is not None and isinstance(find_engine(engine), BlockEngine)
        self._steps = stepper(
            self._watch.graph if self._watch is not None and self._blocks else graph, options
        )
        self._names = list(graph.sources)
        places = {node.path: Wire(k, 0) for k, node in enumerate(graph.nodes) if isinstance(node, SourceNode)}
        self._wires = [places[node.path] for node in graph.sources.values()]
        self._types = [node.type for node in graph.sources.values()]
        self._outputs = [(c.name, graph.port(c.wire).type) for c in graph.collected]
        last = {n: int(t) for n, t in self._steps.state["sources"].items()}
        self._entrance = Entrance(graph, last, not_finite)
        self._boxes = Mailboxes(len(self._names), queue, full)
        held = nanoseconds(lateness, what="lateness", least=0)
        self._order = Order(len(self._names), held, queue * len(self._names), self._steps.time)
        self._patience = held * 1e-9 if held else None
        self._deadline = None if deadline is None else nanoseconds(deadline, what="deadline", least=1)
        self._missed, self._unclocked = 0, dict.fromkeys(self._names, 0)
        self._times = [Durations(), Durations(), Durations()]
        gaps = not_finite == "keep"
        self._arrived, self._made = (
            [Columns(t, n, gaps=gaps) for n, t in zip(self._names, self._types, strict=True)],
            [Columns(t, n, gaps=True) for n, t in self._outputs],
        )
        self._record, self._on_output = record, on_output
        if watcher is not None and hasattr(watcher, "facts"):
            watcher.facts = self._facts
        self._error: BaseException | None = None
        self._ended, self._maker = False, 0
        self._notes: dict[str, str] = {}
        self._pace, self._wall, self._alone = Pace(), 0.0, RLock()
        self._turn, self._queued = Lock(), asyncio.Lock()
        self._thread = Thread(target=self._run, name=f"live {graph.name}", daemon=True) if thread else None
        if self._thread is not None:
            self._thread.start()

    # -- what comes in -----------------------------------------------------------------------------------

    def push(self, time: int, /, *, timeout: float | None = None, **values: Any) -> bool:
        """Hand over events that were true at `time` (int ns), by source name; from any thread.

        Events of one push are one tick, whatever the lateness.

        Returns:
            Whether all were taken in; what was not is counted.

        Raises:
            DataError, TypeMismatchError, UnknownNameError: for an event that is refused and leaves no trace.
            FlowgraphError: what ended the run, where it has ended.
        """
        arrived = perf_counter_ns()
        if timeout is not None:
            need_numbers(self.graph.name, not_negative={"timeout": timeout})
        checked = self._entrance.events(time, values)
        return self._put(checked, arrived, timeout)

    async def push_async(self, time: int, /, **values: Any) -> bool:
        """As `push`, from an event loop, which goes on while a full queue blocks; none overtakes another."""
        arrived = perf_counter_ns()
        checked = self._entrance.events(time, values)
        places = [self._names.index(name) for name, _, _ in checked]
        async with self._queued:  # at once where nobody waits for it: its waiters come first
            if self._boxes.have_room(places):
                return self._put(checked, arrived, None)
            return await asyncio.to_thread(self._put, checked, arrived, None)

    def play(self, inputs: Inputs, *, speed: float = 1.0) -> int:
        """Push a recording at the pace of its stamps, or `speed` times as fast.

        Returns:
            How many ticks were handed over later than the deadline (1 ms, if none was set) allows.

        Raises:
            DataError: for a speed that is not positive.
        """
        if not speed > 0.0:
            raise DataError(
                "a recording is played forwards",
                path=f"{self.graph.name}.play",
                expected="a speed above 0",
                got=f"speed={speed:g}",
                fix="leave it out for the pace of the stamps",
            )
        given = prepare(self.graph, inputs)
        ticks, feeds = merged(given)
        begun, first, behind = perf_counter(), None, 0
        allowed = (self._deadline or 1_000_000) * 1e-9
        for time, key in ticks:
            first = time if first is None else first
            ahead = begun + (time - first) * 1e-9 / speed - perf_counter()
            if ahead > 0:
                sleep(ahead)
            behind += -ahead > allowed
            self.push(time, **{n: feeds[k]() for k, n in enumerate(self._names) if key >> k & 1})
        return behind

    def _put(self, checked: list[tuple[str, int, Any]], arrived: int, timeout: float | None) -> bool:
        self._refuse_if_ended()
        events = [(self._names.index(name), stamp, value) for name, stamp, value in checked]
        taken = self._boxes.put(events, arrived, timeout)
        if self._thread is None:
            self._make_ticks()
        return taken

    def _refuse_if_ended(self) -> None:
        if self._error is not None:
            raise self._error
        if self._ended:
            raise DataError(
                "this live run has ended",
                path=self.graph.name,
                expected="events before close()",
                got="push after it",
                fix="start a new one: Live(graph, state=live.state)",
            )

    # -- ticks -------------------------------------------------------------------------------------------

    def _run(self) -> None:
        """What the thread of the run does."""
        with self._failing():
            while (events := self._boxes.take(self._patience if self._order.waiting else None)) is not None:
                self._take_in(events)
                if not events:  # nothing has come for as long as anything may be late
                    self._ticks(self._order.ready(everything=True), perf_counter_ns())
            self._end()

    def _make_ticks(self) -> None:
        """The ticks of what waits, in the thread that brought it; one at it takes what others bring."""
        while self._boxes.waiting and self._turn.acquire(blocking=False):
            try:
                with self._failing():
                    self._take_in(self._boxes.take(0.0) or [])
            finally:
                self._turn.release()
            if self._error is not None:
                raise self._error

    @contextmanager
    def _failing(self) -> Iterator[None]:
        """What is raised here ends the run."""
        try:
            yield
        except BaseException as error:
            self._error, self._ended = error, True
            self._boxes.close()

    def _take_in(self, events: list[Event]) -> None:
        for _, together in groupby(events, attrgetter("number")):
            held = [event for event in together if self._order.put(event)]
            if held:
                self._ticks(self._order.ready(), held[0].arrived)

    def _end(self) -> None:
        self._ticks(self._order.ready(everything=True), perf_counter_ns())
        if self._watch is not None:
            self._watch.end()
        self._ended = True

    def _stop(self) -> None:
        """Take nothing in any more, and make the ticks of all that waits."""
        if self._maker == get_ident():
            raise DataError(
                "a tick cannot end its own run",
                path=self.graph.name,
                expected="close() where events are pushed",
                got="close() in on_output, or in a watcher",
                fix="remember there that it is to end, and close it where events are pushed",
            )
        self._boxes.close()
        if self._thread is not None:
            self._thread.join()
            return
        with self._turn:
            if not self._ended:
                with self._failing():
                    self._take_in(self._boxes.take(0.0) or [])
                    self._end()

    def _ticks(self, ticks: Any, complete: int) -> None:
        for stamp, events in ticks:
            with self._alone:
                self._maker = get_ident()
                try:
                    self._tick(stamp, events, complete)
                finally:
                    self._maker = 0

    def _tick(self, stamp: int, events: list[Event], complete: int) -> None:
        begun = perf_counter_ns()
        values = {self._names[e.source]: e.value for e in events}
        try:
            stamp_events(self.graph.sources, stamp, values)
            admitted = self._entrance.admit(stamp, values, self._steps.time, checked=True)
        except (ClockError, DataError) as error:
            for name in values:
                self._unclocked[name] += 1
                sentence = f"{error.path}: {error.message}; first: {error.got}"
                self._notes.setdefault(name, note("refused", sentence))
            return
        if not admitted.key:
            self._entrance.done(admitted)
            return
        made = self._steps.step(admitted)
        for full in self._steps.overflows():
            sentence = f"{full.path}: {full.message}; its oldest values give way"
            self._notes[str(full.path)] = note("counted", sentence)
        self._entrance.done(admitted)
        self._pace.tick(stamp, events[0].arrived)
        if self._record != "nothing":
            for k, value in admitted.values:
                self._arrived[k].add(stamp, flatten(value, self._types[k]))
        for columns, (name, type_), leaves in zip(self._made, self._outputs, made, strict=False):
            if leaves is not None:
                if self._record == "all":
                    columns.add(stamp, leaves)
                if self._on_output is not None:
                    self._on_output(name, stamp, unflatten(type_, iter(leaves)))
        if self._watch is not None:
            self._show(self._watch, stamp, admitted, made)
        ended = perf_counter_ns()
        self._wall += (ended - begun) * 1e-9
        for kept, since in zip(self._times, (max(e.arrived for e in events), complete, begun), strict=True):
            kept.add(ended - since)
        self._missed += self._deadline is not None and ended - complete > self._deadline

    def _show(self, watch: Watch, stamp: int, admitted: Admitted, made: list[tuple[Any, ...] | None]) -> None:
        """Let the watcher see a tick."""
        given = {self._wires[k]: value for k, value in admitted.values}
        if not self._blocks:
            for collected, (_, type_), leaves in zip(self.graph.collected, self._outputs, made, strict=True):
                if leaves is not None:
                    given[collected.wire] = unflatten(type_, iter(leaves))
        watch.after(stamp, given)

    def _facts(self) -> dict[str, str]:
        """What a watcher is told with the wires: what became of the events, and how long ticks took."""
        times = self.latencies
        told = {name.replace(".", " "): str(n) for name, n in self.counts.items() if n}
        if self._times[1].count:
            told |= {
                f"{what} {p}": f"{1e3 * of[p]:.3g} ms"
                for what, of in (("arrival to end", times.arrival), ("work", times.work))
                for p in ("p50", "p99", "max")
            }
        return told | ({"deadline missed": str(self._missed)} if self._deadline is not None else {})

    # -- what comes out ----------------------------------------------------------------------------------

    def close(self) -> Result:
        """Take nothing in any more, make the ticks of all that waits, and end.

        Raises:
            FlowgraphError: what ended the run before. DataError: from within a tick of this run.
        """
        self._stop()
        if self._error is not None:
            raise self._error
        return self.result()

    def result(self) -> Result:
        """The run so far; whole after `close`."""
        with self._alone:
            return self._result()

    def _result(self) -> Result:
        state = self._steps.state
        series = {name: c.series() for c, (name, _) in zip(self._made, self._outputs, strict=True)}
        stats = {**statistics(self.graph, state), **{kind: n for kind, n in self.counts.items() if n}}
        notes = (*self._notes.values(), *self._count_notes(), *self._pace.notes())
        return Result(
            self.graph.name, self._engine, series, state, stats, self._steps.ticks, self._wall, notes
        )

    @property
    def arrived(self) -> dict[str, Series]:
        """What was in ticks, by source: run over it, the same engine gives the same result."""
        with self._alone:
            return {name: c.series() for c, name in zip(self._arrived, self._names, strict=True)}

    @property
    def state(self) -> dict[str, Any]:
        """The registers after the last tick, from which another run may go on."""
        with self._alone:
            return self._steps.state

    @property
    def counts(self) -> dict[str, int]:
        """By source and kind, such as "imu.late": nothing that came is in none of them.

        `taken` into the queue; of these `late`, `twice` (one stamp came again), `dropped` (gave way),
        `unclocked` (not as the clock was declared) and `absent` (not finite) made no tick. `refused` at a
        full or closed queue; `lost` are whole periods of a periodic source without an event.
        """
        kinds = {
            "taken": self._boxes.taken_in, "late": self._order.late, "twice": self._order.twice,
            "dropped": self._boxes.dropped, "refused": self._boxes.refused,
            "unclocked": list(self._unclocked.values()), "absent": list(self._entrance.absent.values()),
            "lost": list(self._entrance.lost.values()),
        }  # fmt: skip
        return {f"{n}.{kind}": counts[k] for k, n in enumerate(self._names) for kind, counts in kinds.items()}

    @property
    def latencies(self) -> Latencies:
        """How long the ticks took so far."""
        shown = [
            {f"p{p:g}": d.percentile(p) for p in (50.0, 90.0, 99.0, 99.9)} | {"max": d.longest * 1e-9}
            for d in self._times
        ]
        return Latencies(shown[0], shown[1], shown[2], self._missed)

    def _count_notes(self) -> list[str]:
        found = []
        for name in self._names:
            said = [
                f"{n} {kind}"
                for kind in ("late", "twice", "dropped", "refused", "unclocked", "absent", "lost")
                if (n := self.counts[f"{name}.{kind}"])
            ]
            if said:
                found.append(note("counted", f"{name}: {', '.join(said)}"))
        if self._order.crowded:
            early = f"{self._order.crowded} ticks were made before their lateness was over"
            found.append(note("counted", f"{early}: too many events waited; a larger queue holds them"))
        if self._missed:
            found.append(
                note("counted", f"{self._missed} of {self._times[1].count} ticks missed the deadline")
            )
        return found

    def __enter__(self) -> Live:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()
        if kind is None and self._error is not None:
            raise self._error
