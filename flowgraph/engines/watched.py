"""A run that is watched: the same run, with what stands on its wires now and then, and each block's time.

A result holds what a graph collects. Who looks for the block that goes wrong wants the rest as well, which
would be gigabytes if all of it were kept. So the Python engine hands every value on every wire to a watcher,
which keeps what it can show. The blocks are those of the graph, each with a clock around its step; the values
are the same to the bit.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter
from typing import Any, Protocol

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
    watch = _Watch(graph, watcher, options.get("progress"))
    return ENGINE.driven(watch.graph, inputs, RunOptions(engine="python", **options), watch.drive)


class _Watch:
    def __init__(self, graph: Graph, watcher: Watcher, meter: Any) -> None:
        self.watcher, self.meter = watcher, meter
        self.fired: list[tuple[int, Any]] = []
        self.seconds: dict[int, float] = {index: 0.0 for index, _ in graph.calls}
        self.times: dict[int, int] = {index: 0 for index, _ in graph.calls}
        nodes = list(graph.nodes)
        for index, call in graph.calls:
            nodes[index] = replace(call, block=self.timed(index, call.block))
        self.graph = replace(graph, nodes=tuple(nodes), plans={})
        self.feeds = {
            index: node.feed
            for index, node in enumerate(graph.nodes)
            if isinstance(node, RegisterNode) and node.role == "delay" and node.feed is not None
        }

    def timed(self, index: int, block: Block[Any]) -> Block[Any]:
        step, fired, seconds, times = block.step, self.fired.append, self.seconds, self.times

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

    def drive(self, run: Run) -> None:
        seen: dict[Wire, tuple[int, Any]] = {}
        done = 0
        gives = {
            index: _outputs(call, index) for index, call in self.graph.calls
        }  # what a step's result holds of each output
        while run.step():
            done += 1
            now = run.time
            looks = done % self.watcher.stride == 0
            read = {i: seen[feed] for i, feed in self.feeds.items() if feed in seen} if looks else {}
            for index, result in self.fired:
                for wire, take in gives[index]:
                    there, value = presence(take(result))
                    if there:
                        seen[wire] = now, value
            self.fired.clear()
            if looks:
                self.watcher.see(now, seen, read)
            if self.meter is not None and done % _TOLD == 0:
                self.meter.update(done, now)
        if self.meter is not None:
            self.meter.update(run.ticks, run.time)
        self.watcher.took(
            {call.path: (self.seconds[index], self.times[index]) for index, call in self.graph.calls}
        )


def _outputs(call: CallNode, index: int) -> list[tuple[Wire, Callable[[Any], Any]]]:
    """For each output, how to take it from a step's result."""
    several, remembers = len(call.outputs) > 1, call.state is not None

    def taker(k: int) -> Callable[[Any], Any]:
        def take(result: Any) -> Any:
            outputs = result[1] if remembers else result
            return outputs[k] if several and outputs is not None else outputs

        return take

    return [(Wire(index, k), taker(k)) for k in range(len(call.outputs))]


__all__ = ["Seen", "Watcher", "simulate_watched"]
