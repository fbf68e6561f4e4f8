"""Loop fusion: work over the same axes comes together, so that a backend can do it in one nest of loops.

Instructions that work element by element on arrays of one shape are placed one after the other as far as
their arguments allow; what one makes and only the others use then needs no array at all, a local number
will do. `loops` tells the groups of a program; the list itself stays a plain list.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass

from flowgraph.pipeline.optimise.draft import Draft, ends
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import ELEMENTWISE
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Loop:
    """Instructions `start` to `stop` of a program, which one nest of loops over `shape` can do.

    Args:
        start, stop: of `program.instructions`.
        shape: of the nest; () is straight code.
        local: values that nothing outside of it needs.
    """

    start: int
    stop: int
    shape: tuple[int, ...]
    local: frozenset[int]


def gather(program: Program) -> Program:
    """Reorder a program so that work over the same axes comes together.

    A topological order: among the instructions whose arguments are there, one that continues the current loop
    goes first, else the one that came first before.
    """
    place = {i.out: n for n, i in enumerate(program.instructions)}
    waits = [len({a for a in i.args if a in place}) for i in program.instructions]
    users: dict[int, list[int]] = {}
    for n, i in enumerate(program.instructions):
        for a in {a for a in i.args if a in place}:
            users.setdefault(place[a], []).append(n)
    ready: dict[object, list[int]] = {}
    for n, count in enumerate(waits):
        if not count:
            ready.setdefault(kind(program.instructions[n]), []).append(n)
    draft = Draft(program)
    current: object = None
    for _ in program.instructions:
        if current is None or not ready.get(current):
            current = min((k for k, heap in ready.items() if heap), key=lambda k: ready[k][0])
        n = heapq.heappop(ready[current])
        draft.keep(program.instructions[n])
        for user in users.get(n, ()):
            waits[user] -= 1
            if not waits[user]:
                heapq.heappush(ready.setdefault(kind(program.instructions[user]), []), user)
    return draft.done()


def kind(i: Instruction) -> tuple[int, ...] | None:
    """The shape of the nest of loops that an instruction can be part of; None: it stands alone."""
    return i.spec.shape if i.op in ELEMENTWISE and i.op != "materialise" else None


def loops(program: Program) -> tuple[Loop, ...]:
    """The groups of consecutive instructions that one nest of loops can do."""
    groups: list[tuple[int, int, tuple[int, ...]]] = []
    for n, i in enumerate(program.instructions):
        shape = kind(i)
        if shape is None:
            continue
        if groups and groups[-1][1] == n and groups[-1][2] == shape:
            groups[-1] = (groups[-1][0], n + 1, shape)
        else:
            groups.append((n, n + 1, shape))
    last_use: dict[int, int] = {}
    for n, i in enumerate(program.instructions):
        for a in i.args:
            last_use[a] = n
    kept = set(ends(program.outputs, program.writes))
    found = []
    for start, stop, shape in groups:
        inside = (program.instructions[n].out for n in range(start, stop))
        local = frozenset(v for v in inside if v not in kept and last_use.get(v, start) < stop)
        found.append(Loop(start, stop, shape, local))
    return tuple(found)
