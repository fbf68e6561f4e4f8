"""Lines of C as they are written: what straight code, loops and larger operations write into."""

from __future__ import annotations

from collections.abc import Callable

from flowgraph.engines.c.expressions import Expressions
from flowgraph.engines.c.nodes import Buffer


class Lines:
    """The lines of one reaction, with the depth at which the next one stands.

    Args:
        expressions: of the file.
        names: the C expression of a buffer.
    """

    def __init__(self, expressions: Expressions, names: Callable[[Buffer], str]) -> None:
        self.write, self.names = expressions, names
        self.lines: list[str] = []
        self.depth = 1

    def line(self, text: str) -> None:
        """Write one line."""
        self.lines.append("    " * self.depth + text)

    def at(self, buffer: Buffer, index: str) -> str:
        """A place in a buffer."""
        return self.names(buffer) if buffer.bare else f"{self.names(buffer)}[{index}]"
