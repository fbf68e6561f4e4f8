"""Stamps: when the values of a source were true, for graphs that ask.

A tick is when something arrives. `stamp_of(stream)` is a stream beside that of a source, present whenever
it is, of the times at which its values were true. It is a source of its own, `NAME.stamp`, of the same clock,
and is filled from the stamps of the series that is given for NAME; without stamps it is the time of the tick.
"""

from __future__ import annotations

from typing import Any

from flowgraph.errors import DeclarationError
from flowgraph.language.graph import SourceNode, Wire
from flowgraph.language.stream import Stream
from flowgraph.types import ArrayType

__all__ = ["STAMP", "stamp_of"]

STAMP = ".stamp"
"""What the name of a source of stamps ends in."""


def stamp_of(stream: Stream[Any]) -> Stream[Any]:
    """When each value of a source was true: int64 ns, present with it, never after the tick.

    Raises:
        DeclarationError: for what is no source of the graph: what a block makes is true when it is made.
    """
    if isinstance(stream, Stream):
        build, node = stream.builder, stream.builder.nodes[stream.wire.node]
        if isinstance(node, SourceNode) and not node.path.endswith(STAMP):
            path = node.path + STAMP
            for index, other in enumerate(build.nodes):
                if isinstance(other, SourceNode) and other.path == path:
                    return build.stream(Wire(index, 0))
            made = SourceNode(build.claim(path, given=True), ArrayType((), "int64", "ns"), node.clock)
            return build.stream(Wire(build.add(made), 0))
    raise DeclarationError(
        "only what arrives has stamps",
        path="stamp_of",
        expected="a source of the graph",
        got=repr(stream),
        fix="take the stamp of the source; a stream of its clock goes with it",
    )
