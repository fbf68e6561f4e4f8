"""A run of a graph in the Python engine: all state is here, none in the graph.

`run.step()` advances one tick, `run.push(time, imu=...)` makes one from live events, and `run.state` is a
plain tree of arrays, which can be saved, loaded and resumed to the same bits.
"""

from __future__ import annotations

import itertools
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial, wraps
from threading import Lock, get_ident
from time import perf_counter
from typing import Any, TypeVar, cast

import numpy as np

from flowgraph.data.arrival import stamp_events
from flowgraph.data.inputs import Inputs, prepare
from flowgraph.data.result import Result, statistics
from flowgraph.data.series import Series, chained
from flowgraph.data.tape import Tape, batches, joined, merged, stack
from flowgraph.engines.entrance import Admitted, Entrance
from flowgraph.engines.options import Meter
from flowgraph.engines.python.draws import Ahead
from flowgraph.engines.python.loop import Loop, feed, loop, numbers
from flowgraph.engines.python.plan import Plan, Reactions, bindings, bound, explain
from flowgraph.engines.state import check_start, initial_registers, load_registers, state_tree
from flowgraph.engines.trouble import overflow_error
from flowgraph.errors import DataError, FifoOverflowError
from flowgraph.language.graph import NEVER, CallNode, Graph
from flowgraph.recorder.random import NumpyDraw, seed_words
from flowgraph.types import leaves_of

_BATCH = 2048
_PACKED = 65_536
"""Values of a stream that are kept as objects, each with a place of its own; more become arrays."""
_F = TypeVar("_F", bound=Callable[..., Any])


def _alone(method: _F) -> _F:
    """A run is for one thread: a method that would enter it while it is in a tick is refused."""

    @wraps(method)
    def entered(run: Run, /, *args: Any, **keywords: Any) -> Any:
        with run._entered(method.__name__):
            return method(run, *args, **keywords)

    return cast("_F", entered)


class Run:
    """One run in plain NumPy.

    Args:
        graph: what to run.
        inputs: a `Flight`, or events by source name; left out for a run that is fed with `push`.
        init: other initial values, by register path.
        state: a `run.state` from which to go on; give it the inputs that come after.
        seed: of the random numbers, 0 .. 2^64 - 1; a `state` brings its own.
        not_finite: what a pushed event with a NaN or an infinity is: an error ("raise"), no event ("absent",
            counted in `absent`), or data ("keep").
    """

    engine = "python"

    def __init__(
        self,
        graph: Graph,
        inputs: Inputs | None = None,
        *,
        init: Mapping[str, Any] | None = None,
        state: Mapping[str, Any] | None = None,
        seed: int = 0,
        not_finite: str = "raise",
    ) -> None:
        self.graph = graph
        self.ticks = 0
        self.wall_s = 0.0
        self._drained = 0, 0.0
        self._registers = initial_registers(graph, init)
        self._last = dict.fromkeys(graph.sources, NEVER)
        self._key = seed_words(seed)
        self._stopped: int | None = None
        self._busy, self._thread = Lock(), 0
        self._full: dict[int, FifoOverflowError] = {}  # by call
        self._told: set[int] = set()  # the calls whose overflow was raised
        check_start(init, state, path=graph.name)
        self._ahead: dict[str, Ahead] = {}
        if state is not None:
            self.state = state
        self._entrance = Entrance(graph, self._last, not_finite)
        self._recorded = True
        self._loop: Loop | None = None
        self._played, self._packed_at = 0, 0  # ticks of the tape
        self._through: list[int | None] = [None]  # the last tick of a loop's that is in the registers
        self._values: list[list[Any]] = [[] for _ in graph.collected]
        self._times: list[list[int]] = [[] for _ in graph.collected]
        self._packed: list[dict[str, Series]] = []  # what was collected before, as arrays
        self._pushed: list[deque[Any]] | None = None
        if inputs is None:
            self._pushed = [deque() for _ in graph.sources]
            self._ticks: Iterator[tuple[int, int]] = iter(())
            feeds: list[Callable[[], Any]] = [q.popleft for q in self._pushed]
        else:
            prepared = prepare(graph, inputs, self._last)
            series = tuple(s for s in prepared.values() if isinstance(s, Series))
            self._recorded = len(series) == len(prepared)
            if self._recorded:
                self._tape = Tape.of(series)
                self._loop = loop(graph, self._tape.patterns)
                read = [feed(s, k, self._loop) for k, s in enumerate(series)]
                steady = [] if self._loop is None else [read[k] for k in self._loop.steady]
                self._ticks = zip(numbers(self._tape.time), numbers(self._tape.key), *steady, strict=True)
                feeds = [values.__next__ for values in read]
            else:
                self._ticks, feeds = merged(prepared)
        here = weakref.proxy(self)  # a run that nobody holds is gone at once, with all that it has kept
        self._names = {
            **bindings(graph),
            "r": self._registers,
            "overflow": lambda index, time: here._overflow(index, time),
            **{
                f"d{index}": partial(NumpyDraw, call.draws, self._key)
                for index, call in graph.calls
                if "draw" in call.block.handed
            },
            **{f"n{k}": feed for k, feed in enumerate(feeds)},
            **{f"c{k}": values.append for k, values in enumerate(self._values)},
            **{f"u{k}": times.append for k, times in enumerate(self._times)},
        }
        self._reactions: dict[int, Callable[[int], None]] = Reactions(graph, self._names)
        self._stamped: Mapping[int, frozenset[int]] = {}
        self._columns: dict[int, list[list[Any]]] = {}  # of what the loop keeps by leaves
        if self._loop is not None:
            self._stamped = self._loop.stamped
            types = [graph.port(c.wire).type for c in graph.collected]
            self._columns = {k: [[] for _ in leaves_of(types[k])] for k in self._loop.kept}
            keep = {f"c{k}_{n}": c.append for k, some in self._columns.items() for n, c in enumerate(some)}
            self._ahead = {
                name: Ahead(site, self._tape.times(() if at is None else at), self._key)
                for name, (site, at) in self._loop.sites.items()
            }
            names = self._names | self._loop.names | keep | self._ahead | {"through": self._through}
            self._goes_through = bound(self._loop.plan, names)
        self.time = max(self._last.values(), default=NEVER)

    @_alone
    def step(self) -> bool:
        """Advance one tick; False when the inputs have ended."""
        self._refuse_if_stopped()
        if self._loop is not None:
            before = self._played
            self._go_on(1)
            return self._played > before
        tick = next(self._ticks, None)
        if tick is None:
            return False
        self._advance([tick])
        return True

    @_alone
    def push(self, time: int, /, **values: Any) -> None:
        """One tick at `time` (int ns) in which the named sources have these values.

        Whole periods without an event of a periodic source are packets that were lost, which `lost` counts.
        An event that is refused leaves no trace; the next may be pushed. Where the graph asks when the values
        of a source NAME were true, `**{"NAME.stamp": ns}` says it; left out, it is `time`.

        Raises:
            DataError, ClockError, TypeMismatchError: for an event that is refused.
            FifoOverflowError: once for each join whose queue is full. This tick has happened, and the run
                goes on; the join gives up its oldest value, counted, whenever it is full again.
        """
        if self._pushed is None:
            raise DataError(
                "this run reads recorded inputs",
                path=self.graph.name,
                expected="a run without inputs",
                got="push",
                fix="start it as Run(graph)",
            )
        stamp_events(self.graph.sources, time, values)
        admitted = self._entrance.admit(time, values, self.time)
        self._react(admitted)
        self._entrance.done(admitted)
        for index, error in self._full.items():
            if index not in self._told:
                self._told.add(index)
                raise error

    @_alone
    def react(self, admitted: Admitted) -> list[list[Any]]:
        """The tick of events that were checked; what each output has of it, which the run forgets."""
        self._react(admitted)
        made = [list(values) for values in self._values]
        for kept in (*self._times, *self._values):
            kept.clear()
        return made

    def overflows(self) -> list[FifoOverflowError]:
        """The errors of queues that were full for the first time since the last call."""
        new = [index for index in self._full if index not in self._told]
        self._told.update(new)
        return [self._full[index] for index in new]

    def _react(self, admitted: Admitted) -> None:
        """The tick of these events; where it fails it did not happen, and the next may come."""
        assert self._pushed is not None
        for k, value in admitted.values:
            self._pushed[k].append(value)
        try:
            if admitted.key:
                self._advance([(admitted.time, admitted.key)])
        except BaseException:
            for k, _ in admitted.values:
                self._pushed[k].clear()
            self._stopped = None
            raise

    @_alone
    def to_end(self, meter: Meter | None = None, *, most: int | None = None) -> Run:
        """Run until the inputs end, or for `most` ticks, telling `meter` now and then."""
        self._refuse_if_stopped()
        if self._loop is not None:
            left = len(self._tape.time) - self._played
            left = left if most is None else min(left, most)
            while left > 0:
                count = min(left, _PACKED if meter is None else _BATCH)
                self._go_on(count)
                self._pack()
                left -= count
                if meter is not None:
                    meter.update(self.ticks, self.time)
            return self
        for batch in batches(itertools.islice(self._ticks, most), _BATCH if self._recorded else 1):
            self._advance(batch)
            self._pack()
            if meter is not None:
                meter.update(self.ticks, self.time)
        return self

    def _pack(self) -> None:
        """Make arrays of what was collected, once it is much."""
        stamped = self._played - self._packed_at if self._stamped else 0
        if max(stamped, *map(len, self._times), 0) >= _PACKED:
            self._forget([*self._packed, self._collected()])

    def _forget(self, packed: list[dict[str, Series]]) -> None:
        """Collect anew, after these parts; in one call, within which Python hears no signal."""
        clearing = map(list.clear, [*self._times, *self._values, *itertools.chain(*self._columns.values())])
        self._packed, self._packed_at = packed, self._played
        deque(clearing, 0)

    @contextmanager
    def _entered(self, what: str) -> Iterator[None]:
        if not self._busy.acquire(blocking=False):
            raise self._entered_twice(what)
        self._thread = get_ident()
        try:
            yield
        finally:
            self._thread = 0
            self._busy.release()

    def _entered_twice(self, what: str) -> DataError:
        inside = "a block of this run calls it" if self._thread == get_ident() else "another thread is in it"
        return DataError(
            f"Run.{what} while this run is in a tick",
            path=self.graph.name,
            expected="one call after the other: a run is for one thread",
            got=inside,
            fix="let one thread push, and hand it the events of others through a queue.Queue",
        )

    def _refuse_others(self, what: str) -> None:
        """In the middle of a tick of another thread some registers are new and some old."""
        if self._busy.locked() and self._thread != get_ident():
            raise self._entered_twice(what)

    def _advance(self, batch: list[tuple[int, int]]) -> None:
        start = perf_counter()
        reactions = self._reactions
        done = 0
        try:
            for time, key in batch:
                reactions[key](time)
                done += 1
            self._account(batch)
        except BaseException as error:
            self._account(batch[:done])
            if done < len(batch):
                self._stop(error, batch[done][0])
            raise
        self.wall_s += perf_counter() - start

    def _go_on(self, count: int) -> None:
        """So many ticks of a recording in its loop, or as many as there are."""
        start, first = perf_counter(), self._played
        last = min(first + count, len(self._tape.time))
        self._through[0] = None
        try:
            self._goes_through(itertools.islice(self._ticks, last - first))
            self._has_gone(last)
        except BaseException as error:
            through = self._through[0]
            done = first if through is None else int(np.searchsorted(self._tape.time, through)) + 1
            self._has_gone(done)
            if done < last:
                self._stop(error, int(self._tape.time[done]))
            raise
        self.wall_s += perf_counter() - start

    def _has_gone(self, last: int) -> None:
        """Count the ticks of the tape before `last`, and note when each source came last."""
        first = self._played
        if last > first:
            self.time = max(self.time, int(self._tape.time[last - 1]))
        for k, name in enumerate(self._last):
            rows = np.flatnonzero(self._tape.key[first:last] >> k & 1)
            if len(rows):
                self._last[name] = int(self._tape.time[first + rows[-1]])
        self._played, self.ticks = last, self.ticks + last - first

    def _stop(self, error: BaseException, time: int) -> None:
        """Go on no more from the tick at `time`, which was broken off: nothing is kept of what it gave."""
        self._stopped = time
        for k, values in enumerate(self._values):
            times = self._times[k]
            while times and times[-1] >= time:
                times.pop()
            there = len(self._stamps(k))
            for some in (values, *self._columns.get(k, ())):
                del some[there:]
        known = [k.plan if isinstance(k, Loop) else k for k in self.graph.plans.copy().values()]
        explain(error, [p for p in known if isinstance(p, Plan)], self.graph.name, time)

    def _refuse_if_stopped(self) -> None:
        if self._stopped is not None:
            raise DataError(
                "this run stopped at an error and cannot go on",
                path=f"{self.graph.name}, t = {self._stopped} ns",
                expected="a run without errors",
                got="another step after one",
                fix="start a new one: Run(graph, inputs from that time on, state=run.state)",
            )

    def _account(self, batch: list[tuple[int, int]]) -> None:
        keys = 0
        for time, key in reversed(batch):
            self.time = max(self.time, time)
            for k, name in enumerate(self._last):
                if key & ~keys & (1 << k):
                    self._last[name] = time
            keys |= key
            if keys == (1 << len(self._last)) - 1:
                break
        self.ticks += len(batch)

    def _overflow(self, index: int, time: int) -> None:
        """Stop at a full queue, or, where events are live, remember it and go on with what is in it."""
        if index in self._full:
            return
        call = self.graph.nodes[index]
        assert isinstance(call, CallNode)
        message = call.block.fault[1] if call.block.fault else "a queue is full"
        error = overflow_error(message, call.path, call.settings.get("size"), time)
        if self._pushed is None or "full" not in call.settings:
            raise error
        self._full[index] = error

    @property
    def state(self) -> dict[str, Any]:
        """All registers by path, and the last time of each source: a tree of arrays."""
        self._refuse_others("state")
        return state_tree(self.graph, self._registers, self._last, self.seed)

    @state.setter
    def state(self, tree: Mapping[str, Any]) -> None:
        self._refuse_others("state")
        self._registers[:], self._last, seed = load_registers(self.graph, tree)
        self._key[:] = seed_words(seed)
        for ahead in self._ahead.values():
            ahead.forget()
        self.time = max(self._last.values(), default=NEVER)

    @property
    def seed(self) -> int:
        """The seed of the random numbers."""
        return int(self._key[0]) | int(self._key[1]) << 32

    @property
    def lost(self) -> dict[str, int]:
        """By source, how many pushed events of a periodic one did not come: whole periods without any."""
        return dict(self._entrance.lost)

    @property
    def absent(self) -> dict[str, int]:
        """By source, how many pushed events were not finite and so no events (`not_finite="absent"`)."""
        return dict(self._entrance.absent)

    @property
    def stats(self) -> dict[str, int]:
        """What joins discarded by definition, by path."""
        return statistics(self.graph, self.state)

    def result(self) -> Result:
        """The collected streams so far."""
        self._refuse_others("result")
        parts = [*self._packed, self._collected()]
        series = {name: chained([p[name] for p in parts]) for name in parts[0]} if self._packed else parts[0]
        return Result(self.graph.name, self.engine, series, self.state, self.stats, self.ticks, self.wall_s)

    def _collected(self) -> dict[str, Series]:
        """The collected streams since they were last packed or drained."""
        series = {}
        for k, collected in enumerate(self.graph.collected):
            type_, name = self.graph.port(collected.wire).type, collected.name
            times, values, columns = self._stamps(k), self._values[k], self._columns.get(k)
            series[name] = (
                stack(times, values, type_, name) if columns is None else joined(times, columns, type_, name)
            )
        return series

    def _stamps(self, k: int) -> list[int] | np.ndarray:
        """The times of collected stream k since it was last packed or drained."""
        if k not in self._stamped:
            return self._times[k]
        return self._tape.times(self._stamped[k], self._packed_at, self._played)

    def drain(self) -> Result:
        """The collected streams since the last call; the run forgets them, and its memory stays flat."""
        found = self.result()
        found = replace(found, ticks=self.ticks - self._drained[0], wall_s=self.wall_s - self._drained[1])
        self._drained = self.ticks, self.wall_s
        self._forget([])
        return found
