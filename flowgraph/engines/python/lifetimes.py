"""Arrays of a tick, let go in the line after which nobody reads them.

A variable holds its array until the next tick writes it anew, so that all that a tick computes would lie
beside one another: a thousand numbers a particle for a cloud, of which a few dozen are needed at one time.
Once let go, the memory of an array is that of the next, which finds it in the processor's cache.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence

_NAME = re.compile(r"\b[hvw]\d+_\d+\b")
_WRITTEN = re.compile(r"\s*([hvw]\d+_\d+) = ")
_INDENT = 4

Place = tuple[tuple[int, int], ...]
"""Of a line: from the outside, the block that it is in and the statement there."""


def let_go(lines: Sequence[str], arrays: Collection[str]) -> list[str]:
    """The lines of a tick, with `del` for these variables in the last statement of theirs that names them.

    Let go is what is surely there: a variable that its block writes, or both arms of a selection in it.
    """
    places = _places(lines)
    simple = {place: k for k, place in enumerate(places) if not lines[k].endswith(":")}
    named: dict[str, list[int]] = {}
    written: dict[str, list[int]] = {}
    for k, line in enumerate(lines):
        for name in dict.fromkeys(_NAME.findall(line)):
            if name in arrays:
                named.setdefault(name, []).append(k)
        if (found := _WRITTEN.match(line)) is not None:
            written.setdefault(found[1], []).append(k)
    ends: dict[int, list[str]] = {}
    for name, at in named.items():
        home = _home([places[k] for k in at])
        depth = len(home) - 1
        if not _sure([places[k] for k in written.get(name, ())], depth):
            continue
        last = max(places[k][depth][1] for k in at)
        while (place := (*home[:-1], (home[-1][0], last))) not in simple and last < len(lines):
            last += 1
        if place in simple:
            ends.setdefault(simple[place], []).append(name)
    return [f"{line}; del {', '.join(ends[k])}" if k in ends else line for k, line in enumerate(lines)]


def _places(lines: Sequence[str]) -> list[Place]:
    found: list[Place] = []
    open_: list[list[int]] = []  # of the blocks that a line may be in: number, and its last statement
    outer = min((len(line) - len(line.lstrip()) for line in lines), default=0)
    blocks = 0
    for line in lines:
        depth = (len(line) - len(line.lstrip()) - outer) // _INDENT
        del open_[depth + 1 :]
        if depth == len(open_):
            open_.append([blocks, -1])
            blocks += 1
        if line.lstrip() != "else:":
            open_[depth][1] += 1
        found.append(tuple((block, at) for block, at in open_))
    return found


def _home(places: Sequence[Place]) -> Place:
    """The innermost block that all of these are in, as the place of the first of them there."""
    first, depth = places[0], 1
    while (
        all(len(p) > depth and p[:depth] == first[:depth] for p in places)
        and len({p[depth][0] for p in places}) == 1
    ):
        depth += 1
    return first[:depth]


def _sure(places: Sequence[Place], depth: int) -> bool:
    """Whether a variable that is written there surely is, in the block at a depth."""
    if any(len(p) == depth + 1 for p in places):
        return True
    arms: dict[tuple[int, int], set[int]] = {}
    for p in places:
        if len(p) == depth + 2:
            arms.setdefault(p[depth], set()).add(p[depth + 1][0])
    return any(len(blocks) > 1 for blocks in arms.values())
