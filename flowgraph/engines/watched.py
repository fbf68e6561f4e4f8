"""A run that is watched: the same run, with what stands on its wires now and then, and each block's time.

A result holds what a graph collects. Who looks for the block that goes wrong wants the rest as well, which
would be gigabytes if all of it were kept. So the Python engine hands every value on every wire to a watcher,
which keeps what it can show. The blocks are those of the graph, each with a clock around its step; the values
are the same to the bit. Other engines have no wires: their run is shown by the same events in the Python
engine once more (`replayed`), and how far the two are apart is told.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, Protocol

import numpy as np

from flowgraph.data.inputs import Inputs, need_inputs
from flowgraph.data.result import Result
from flowgraph.engines.options import RunOptions
from flowgraph.engines.python.engine import ENGINE
from flowgraph.engines.python.plan import presence
from flowgraph.engines.python.run import Run
from flowgraph.language.block import Block
from flowgraph.language.graph import CallNode, Graph, RegisterNode, Wire

_TOLD = 2048

Seen = Mapping[Wire, tuple[int, Any]]
"""By output of a block, the time (ns) and value of the last that it gave."""


class Watcher(Protocol):
    """Who is shown a run.

    Attributes:
        stride: every how many ticks it wants to see; read before each.
    """

    stride: int

    def see(self, time: int, seen: Seen, read: Mapping[int, tuple[int, Any]]) -> None:
        """After a tick at `time`: what the blocks gave last, and by delay what was read of it in this tick.

        The values are the run's own, to be looked at and not kept.
        """

    def took(self, blocks: Mapping[str, tuple[float, int]]) -> None:
        """At the end: by path of a block, the seconds that its steps took, and how many there were."""


def simulate_watched(graph: Graph, inputs: Inputs, watcher: Watcher, **options: Any) -> Result:
    """Run a graph over its inputs in the Python engine while `watcher` looks on.

    Args:
        options: of `simulate`, but for `engine`, `seeds` and `passes`.

    Raises:
        What `simulate` raises.
    """
    need_inputs(graph, inputs)
    watch = Watch(graph, watcher)
    meter = options.get("progress")

    def drive(run: Run) -> None:
        done = 0
        while run.step():
            done += 1
            watch.after(run.time)
            if meter is not None and done % _TOLD == 0:
                meter.update(done, run.time)
        if meter is not None:
            meter.update(run.ticks, run.time)
        watch.end()

    return ENGINE.driven(watch.graph, inputs, RunOptions(engine="python", **options), drive)


def replayed(graph: Graph, inputs: Inputs, watcher: Watcher, result: Result, **options: Any) -> str:
    """Show a watcher what was on the wires in a run of another engine: the same events in the Python engine.

    Args:
        result: of that run.
        options: as of `simulate_watched`, those of that run.

    Returns:
        A sentence: whose the values are, and by how much the outputs of the two runs differ at most.

    Raises:
        What `simulate` raises.
    """
    again = simulate_watched(graph, inputs, watcher, **options)
    apart, where = farthest(result, again)
    told = "are the same to the bit" if apart == 0.0 else f"differ by {apart:.2g} in {where}"
    return (
        "the values on the wires, the clouds and the times of blocks are the Python engine's, run again"
        f" over the same events; the outputs {told}"
    )


def farthest(one: Result, other: Result) -> tuple[float, str]:
    """The largest difference between two results, of all entries max(1, |x|), and in which output it is; an
    output that is not at the same times in both, or is a number in one only, differs without bound."""
    most, where = 0.0, ""
    for name, series in one.series.items():
        there = other.series[name]
        for leaf, array in series.leaves.items():
            second = np.asarray(there.leaves[leaf])
            if array.shape != second.shape or not np.array_equal(series.time, there.time):
                return float("inf"), name
            x, y = np.asarray(array, dtype=float), np.asarray(second, dtype=float)
            if (np.isnan(x) != np.isnan(y)).any():
                return float("inf"), f"{name}.{leaf}"
            gap = np.nan_to_num(np.abs(x - y) / np.maximum(1.0, np.abs(x)))
            if gap.size and gap.max() > most:
                most, where = float(gap.max()), f"{name}.{leaf}"
    return most, where


class Watch:
    """A graph whose blocks tell what they give, and when a watcher sees it.

    Args:
        graph: to be watched; `graph` of this is what is run instead.
        watcher: who is shown the run.
    """

    def __init__(self, graph: Graph, watcher: Watcher) -> None:
        self.watcher = watcher
        self._fired: list[tuple[int, Any]] = []
        self._seconds: dict[int, float] = {index: 0.0 for index, _ in graph.calls}
        self._times: dict[int, int] = {index: 0 for index, _ in graph.calls}
        nodes = list(graph.nodes)
        for index, call in graph.calls:
            nodes[index] = replace(call, block=self._timed(index, call.block))
        self.graph = replace(graph, nodes=tuple(nodes), plans={})
        self._gives = {index: _outputs(call, index) for index, call in graph.calls}
        self._feeds = {
            index: node.feed
            for index, node in enumerate(graph.nodes)
            if isinstance(node, RegisterNode) and node.role == "delay" and node.feed is not None
        }
        self._seen: dict[Wire, tuple[int, Any]] = {}
        self._done = 0

    def _timed(self, index: int, block: Block[Any]) -> Block[Any]:
        step, fired, seconds, times = block.step, self._fired.append, self._seconds, self._times

        def watched(*args: Any, **keywords: Any) -> Any:
            start = perf_counter()
            result = step(*args, **keywords)
            seconds[index] += perf_counter() - start
            times[index] += 1
            fired((index, result))
            return result

        made = copy.copy(block)
        made.step = watched
        return made

    def after(self, now: int, given: Mapping[Wire, Any] | None = None) -> None:
        """A tick at `now` was made.

        Args:
            given: by wire, what no block gave: the events of sources, for a watcher without a recording of
                them.
        """
        self._done += 1
        looks = self._done % self.watcher.stride == 0
        seen = self._seen
        read = {i: seen[feed] for i, feed in self._feeds.items() if feed in seen} if looks else {}
        for index, result in self._fired:
            for wire, take in self._gives[index]:
                there, value = presence(take(result))
                if there:
                    seen[wire] = now, value
        self._fired.clear()
        for wire, value in (given or {}).items():
            seen[wire] = now, value
        if looks:
            self.watcher.see(now, seen, read)

    def end(self) -> None:
        """The run has ended."""
        calls = self.graph.calls
        self.watcher.took({call.path: (self._seconds[k], self._times[k]) for k, call in calls})


def _outputs(call: CallNode, index: int) -> list[tuple[Wire, Callable[[Any], Any]]]:
    """For each output, how to take it from a step's result."""
    several, remembers = len(call.outputs) > 1, call.state is not None

    def taker(k: int) -> Callable[[Any], Any]:
        def take(result: Any) -> Any:
            outputs = result[1] if remembers else result
            return outputs[k] if several and outputs is not None else outputs

        return take

    return [(Wire(index, k), taker(k)) for k in range(len(call.outputs))]


__all__ = ["Seen", "Watch", "Watcher", "farthest", "replayed", "simulate_watched"]
