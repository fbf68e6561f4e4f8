"""Memory: which array lies where, and in which order of its axes.

A value needs its place from where it is made to where it is last used. Two whose times do not overlap may
share a place, so that a fixed-size program needs far less memory than the sum of its arrays. Within a loop
nothing is freed: its instructions run interleaved, element by element.

Along an axis of particles the same is done for each, so this axis is laid out innermost (a structure of
arrays): neighbours in memory are neighbours in the loop, and a compiler can take several at once.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np

from flowgraph.ops import Spec
from flowgraph.optimise.draft import ends
from flowgraph.optimise.loops import Loop, loops
from flowgraph.program import Program
from flowgraph.types import DTYPES


@dataclass(frozen=True)
class Buffer:
    """A place for arrays of one kind of number, one after the other: `size` elements."""

    dtype: str
    size: int

    @property
    def bytes(self) -> int:
        """With 8 bytes for a real."""
        return self.size * np.dtype(DTYPES[self.dtype]).itemsize


@dataclass(frozen=True)
class Plan:
    """How a backend may run a program.

    Args:
        loops: groups of instructions for one nest of loops each.
        buffers: places for what instructions make; inputs, registers and constants have their own.
        place: for each array that an instruction makes, the index of its buffer. Scalars and what is local to a
            loop have none. A `reshape`, and a transpose that changes no byte, has that of its argument.
        order: for a value with an axis of lanes, its axes from the slowest to the fastest; others are in
            row-major order.
    """

    loops: tuple[Loop, ...]
    buffers: tuple[Buffer, ...]
    place: Mapping[int, int]
    order: Mapping[int, tuple[int, ...]]

    @property
    def bytes(self) -> int:
        """Of all buffers, with 8 bytes for a real."""
        return sum(b.bytes for b in self.buffers)


PLANS = ("loops", "reuse", "layout")
"""The passes by name that say how a program is run, and leave its list alone."""


def plan(program: Program, passes: Collection[str] = PLANS) -> Plan:
    """Loops, buffers and layout of a program.

    Args:
        program: as `optimise` left it.
        passes: without "loops" every instruction is a loop of its own, without "reuse" every array has a buffer
            of its own, without "layout" every array is in row-major order.
    """
    groups = loops(program) if "loops" in passes else ()
    order = layout(program) if "layout" in passes else {}
    buffers, place = _assign(program, groups, order, reuse="reuse" in passes)
    return Plan(groups, buffers, place, order)


def layout(program: Program) -> dict[int, tuple[int, ...]]:
    """The order of axes of each value that has an axis of lanes, with that axis innermost."""
    found = {}
    for value, spec in program.specs.items():
        wide = [k for k, n in enumerate(spec.shape) if n in program.lanes]
        if wide:
            last = wide[-1]
            found[value] = (*(k for k in range(len(spec.shape)) if k != last), last)
    return found


def _assign(
    program: Program, groups: tuple[Loop, ...], order: Mapping[int, tuple[int, ...]], *, reuse: bool
) -> tuple[tuple[Buffer, ...], dict[int, int]]:
    step = list(range(len(program.instructions)))  # the whole of a loop is one step
    local: set[int] = set()
    for group in groups:
        step[group.start : group.stop] = [group.start] * (group.stop - group.start)
        local |= group.local
    owner = _owners(program, order, local)
    never = len(program.instructions)
    last: dict[int, int] = {}
    for n, i in enumerate(program.instructions):
        for a in i.args:
            last[owner.get(a, a)] = step[n]
    for value in ends(program.outputs, program.writes):
        last[owner.get(value, value)] = never
    sizes: list[int] = []
    kinds: list[str] = []
    free: list[int] = []
    place: dict[int, int] = {}
    busy: list[tuple[int, int]] = []
    for n, i in enumerate(program.instructions):
        if reuse:
            free += [b for until, b in busy if until < step[n]]
            busy = [(until, b) for until, b in busy if until >= step[n]]
        if i.out not in owner:
            continue
        if owner[i.out] != i.out:
            if owner[i.out] in place:
                place[i.out] = place[owner[i.out]]
            continue
        size = math.prod(i.spec.shape)
        fitting = [b for b in free if kinds[b] == i.spec.dtype]
        if fitting:
            chosen = min(fitting, key=lambda b: (max(size - sizes[b], 0), sizes[b]))
            free.remove(chosen)
            sizes[chosen] = max(sizes[chosen], size)
        else:
            chosen = len(sizes)
            sizes.append(size)
            kinds.append(i.spec.dtype)
        place[i.out] = chosen
        busy.append((last.get(i.out, step[n]), chosen))
    return tuple(Buffer(k, n) for k, n in zip(kinds, sizes, strict=True)), place


def _owners(program: Program, order: Mapping[int, tuple[int, ...]], local: set[int]) -> dict[int, int]:
    """For each array that an instruction makes, the value whose memory it is."""
    owner: dict[int, int] = {}
    for i in program.instructions:
        if i.out in local or i.spec.shape == ():
            continue
        source = i.args[0] if i.args else i.out
        if source not in local and _same_memory(i.op, program.specs[source], i.spec, source, i.out, order):
            owner[i.out] = owner.get(source, source)
        else:
            owner[i.out] = i.out
    return owner


def _same_memory(
    op: str, before: Spec, after: Spec, source: int, out: int, order: Mapping[int, tuple[int, ...]]
) -> bool:
    """Whether a result has the bytes of its argument, in their order."""
    if op == "materialise" or before.shape == ():
        return False
    rows = tuple(range(len(before.shape))), tuple(range(len(after.shape)))
    places = order.get(source, rows[0]), order.get(out, rows[1])
    if op == "reshape":
        return places == rows
    if op == "matrix_transpose":
        swapped = (*rows[1][:-2], rows[1][-1], rows[1][-2])
        return places in ((rows[0], swapped), (swapped, rows[1]))
    return False
