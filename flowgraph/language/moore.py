"""Blocks that a loop may close through: their output does not read this tick's input.

What moves by a law of motion, a plant, is where its past inputs took it: what it is told now acts from now
on. So its output of a tick is there before the input of that tick, and a loop may close through it without
another delay. Such a block is called a Moore machine, after E. Moore, "Gedanken-experiments on sequential
machines", 1956.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from flowgraph.language.block import Block
from flowgraph.language.declare import delay
from flowgraph.language.stream import Held, Stream


@dataclass(frozen=True)
class Moore:
    """A block wired as a Moore machine.

    Args:
        output: its output, of this tick.
        input: where its input is kept until it next fires.
    """

    output: Stream[Any]
    input: Held[Any]

    def feed(self, stream: Stream[Any]) -> None:
        """Give it its input; once."""
        self.input.feed(stream)


def moore(
    block: Block[Any], *more: Any, init: Any, at: object, name: str | None = None, **settings: Any
) -> Moore:
    """Wire a block so that its first port reads what it was fed before this tick.

        body = moore(move, init=0.0, at=clock)
        push = control(target, body.output)
        body.feed(push)

    With `dt`, an input acts over the time from the tick at which it came to the next firing: it is held.

    Args:
        block: fires at `at`.
        more: what the other ports of the block read.
        init: the input before the first, for a block that reads it then.
        at: a stream or clock.
        name: of the node; its input is kept in the register "name_input".
        settings: of the block.
    """
    called = name or block.name
    held = delay(init, name=f"{called}_input")
    return Moore(block(held, *more, at=at, name=name, **settings), held)
