"""Where a tick keeps what it needs for a while: small arrays on the stack, large ones in the state.

Two arrays share a place where one is done with before the other begins. Of each kind of number there is one
piece of memory, in which each array lies as low as it can, the largest first; all reactions use the same
piece, which is as long as the most that one of them needs. So what a tick touches is little more than what it
needs at one time, which is what counts where particles leave the caches.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from flowgraph.engines.c.nodes import Buffer

_LOCAL_BYTES = 512
_BYTES = {"bool": 1, "int32": 4, "uint32": 4, "int64": 8, "uint64": 8}
_STEP = 16
"""Arrays begin at multiples of so many numbers."""

Span = tuple[int, int]


class Memory:
    """The memory that all reactions of a file share.

    Args:
        real: "double" or "float".
        typed: what C calls a kind of number where it stands for one value, or for one of each lane.

    `sizes` says how many numbers there are of each kind, by the name of the state's member.
    """

    def __init__(self, real: str, typed: Callable[[str], str]) -> None:
        self.real, self.typed = real, typed
        self.sizes: dict[str, int] = {}
        self.dtypes: dict[str, str] = {}

    def placed(self, spans: Mapping[Buffer, Span], whose: str = "") -> tuple[dict[Buffer, str], list[str]]:
        """Names for work buffers, as C writes them, and the declarations of those on the stack.

        Args:
            spans: first and last level at which each is in use.
            whose: before the kind: a function beside the reactions has memory of its own.
        """
        names: dict[Buffer, str] = {}
        local: list[str] = []
        large: dict[str, list[Buffer]] = {}
        for buffer, _ in sorted(spans.items(), key=lambda item: item[1][0]):
            if buffer.name:
                names[buffer] = buffer.name
            elif _BYTES.get(buffer.dtype, 8 if self.real == "double" else 4) * buffer.size <= _LOCAL_BYTES:
                names[buffer] = f"w{len(local)}"
                local.append(f"    {self.typed(buffer.dtype)} w{len(local)}[{max(buffer.size, 1)}];")
            else:
                large.setdefault(buffer.dtype, []).append(buffer)
        for dtype, buffers in large.items():
            member = f"fg_work_{whose}{dtype}"
            ends, self.dtypes[member] = [0], dtype
            for buffer, first in _packed(buffers, spans).items():
                names[buffer] = f"(s->{member} + {first})" if first else f"s->{member}"
                ends.append(first + buffer.size)
            self.sizes[member] = max(self.sizes.get(member, 0), *ends)
        return names, local

    def members(self) -> list[tuple[str, str, int]]:
        """The members of the state: kind of number, name, and how many."""
        return [(self.dtypes[name], name, size) for name, size in sorted(self.sizes.items())]


def _packed(buffers: list[Buffer], spans: Mapping[Buffer, Span]) -> dict[Buffer, int]:
    """The place of each, as low as those that are in use at the same time allow."""
    placed: dict[Buffer, int] = {}
    for buffer in sorted(buffers, key=lambda b: -b.size):
        first, last = spans[buffer]
        taken = sorted(
            (at, at + other.size)
            for other, at in placed.items()
            if spans[other][0] <= last and first <= spans[other][1]
        )
        here = 0
        for begin, end in taken:
            if here + buffer.size <= begin:
                break
            here = max(here, -(-end // _STEP) * _STEP)
        placed[buffer] = here
    return placed
