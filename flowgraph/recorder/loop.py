"""A loop over a history that a step can call: a body with what plays it, in numbers or in symbols."""

from __future__ import annotations

from typing import Any

from flowgraph.recorder.ops import OPS
from flowgraph.recorder.replay import Body
from flowgraph.recorder.symbolic import Symbolic


class Loop:
    """`loop(history, rows, first, count, xp=xp)`: see `replay`. It never changes."""

    def __init__(self, body: Body) -> None:
        self.body = body

    def __call__(self, history: Any, rows: Any, first: Any, count: Any, *, xp: Any) -> Any:
        """The history (N, k) after `count` turns from place `first` on; recorded where that is asked."""
        given = (history, rows, first, count)
        trace = next((x.trace for x in given if isinstance(x, Symbolic)), None)
        if trace is not None:
            return trace.apply("replay", *given, body=self.body)
        return OPS["replay"].run(xp, *given, body=self.body)
