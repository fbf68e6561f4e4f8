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

from flowgraph.pipeline.optimise.draft import ends
from flowgraph.pipeline.optimise.loops import Loop, loops
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction
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
        place: for each array that an instruction makes, the index of its buffer. Scalars, views, and what is
            local to a loop have none.
        view: for an array that is part of another's memory, that other and at which element it begins: a
            `reshape`, whole rows that `getitem` takes, a transpose that changes no byte, and what a `stack`
            puts together, which is made where the stack will be.
        order: for a value with an axis of lanes, its axes from the slowest to the fastest; others are in
            row-major order.
    """

    loops: tuple[Loop, ...]
    buffers: tuple[Buffer, ...]
    place: Mapping[int, int]
    view: Mapping[int, tuple[int, int]]
    order: Mapping[int, tuple[int, ...]]

    @property
    def bytes(self) -> int:
        """Of all buffers, with 8 bytes for a real."""
        return sum(b.bytes for b in self.buffers)


PLANS = ("loops", "reuse", "layout")
"""The passes by name that say how a program is run, and leave its list alone."""


def plan(program: Program, passes: Collection[str] = PLANS, *, scalars: bool = False) -> Plan:
    """Loops, buffers and layout of a program.

    Args:
        program: as `optimise` left it.
        passes: without "loops" every instruction is a loop of its own, without "reuse" every array has a
            buffer of its own, without "layout" every array is in row-major order.
        scalars: whether these have buffers as well, for whoever cannot leave them to a compiler.
    """
    groups = loops(program) if "loops" in passes else ()
    order = layout(program) if "layout" in passes else {}
    buffers, place, view = _assign(program, groups, order, reuse="reuse" in passes, scalars=scalars)
    return Plan(groups, buffers, place, view, order)


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
    program: Program,
    groups: tuple[Loop, ...],
    order: Mapping[int, tuple[int, ...]],
    *,
    reuse: bool,
    scalars: bool,
) -> tuple[tuple[Buffer, ...], dict[int, int], dict[int, tuple[int, int]]]:
    step = list(range(len(program.instructions)))  # the whole of a loop is one step
    local: set[int] = set()
    for group in groups:
        step[group.start : group.stop] = [group.start] * (group.stop - group.start)
        local |= group.local
    view = _views(program, order, local)
    root = {}
    for value in program.specs:
        found = value
        while found in view:
            found = view[found][0]
        root[value] = found
    born: dict[int, int] = {}
    last: dict[int, int] = {}
    for n, i in enumerate(program.instructions):
        for a in i.args:
            last[root[a]] = step[n]
        if i.out not in local:
            born.setdefault(root[i.out], step[n])
            last.setdefault(root[i.out], step[n])
    for value in ends(program.outputs, program.writes):
        last[root[value]] = len(program.instructions)
    made = {i.out for i in program.instructions} - local
    roots = [v for v in born if v in made and (scalars or program.specs[v].shape != ())]
    buffers, place = _shared(program, sorted(roots, key=born.__getitem__), born, last, reuse=reuse)
    return buffers, place, view


def _shared(
    program: Program, roots: list[int], born: Mapping[int, int], last: Mapping[int, int], *, reuse: bool
) -> tuple[tuple[Buffer, ...], dict[int, int]]:
    """Each value in turn gets the free buffer that fits best, grown if need be."""
    sizes: list[int] = []
    kinds: list[str] = []
    free: list[int] = []
    busy: list[tuple[int, int]] = []
    place: dict[int, int] = {}
    for value in roots:
        spec = program.specs[value]
        size = math.prod(spec.shape)
        if reuse:
            free += [b for until, b in busy if until < born[value]]
            busy = [(until, b) for until, b in busy if until >= born[value]]
        fitting = [b for b in free if kinds[b] == spec.dtype]
        if fitting:
            chosen = min(fitting, key=lambda b: (max(size - sizes[b], 0), sizes[b]))
            free.remove(chosen)
            sizes[chosen] = max(sizes[chosen], size)
        else:
            chosen = len(sizes)
            sizes.append(size)
            kinds.append(spec.dtype)
        place[value] = chosen
        busy.append((last[value], chosen))
    return tuple(Buffer(k, n) for k, n in zip(kinds, sizes, strict=True)), place


def _views(
    program: Program, order: Mapping[int, tuple[int, ...]], local: set[int]
) -> dict[int, tuple[int, int]]:
    """The arrays that are a part of another's memory, and where in it they begin."""
    view: dict[int, tuple[int, int]] = {}
    parts: set[int] = set()
    whole = {i.out: i for i in program.instructions if i.out not in local}
    for i in program.instructions:
        if i.out in local or i.spec.shape == () or not i.args:
            continue
        source = i.args[0]
        if i.op == "stack" and _rows(i.out, program, order) and _rows_of_parts(i, program, order):
            size = math.prod(program.specs[source].shape)
            for k, part in enumerate(i.args):
                if part in whole and part not in view and part not in parts:
                    view[part] = (i.out, k * size)
                    parts.add(part)
            continue
        if source in local:
            continue
        begin = _begin(i, program, order)
        if begin is not None:
            view[i.out] = (source, begin)
    return view


def _rows(value: int, program: Program, order: Mapping[int, tuple[int, ...]]) -> bool:
    """Whether a value is in row-major order."""
    axes = tuple(range(len(program.specs[value].shape)))
    return order.get(value, axes) == axes


def _rows_of_parts(i: Instruction, program: Program, order: Mapping[int, tuple[int, ...]]) -> bool:
    return i.attrs["axis"] == 0 and i.spec.shape[1:] != () and all(_rows(a, program, order) for a in i.args)


def _begin(i: Instruction, program: Program, order: Mapping[int, tuple[int, ...]]) -> int | None:
    """Where in its argument's memory a result begins, if it is a part of it as it stands."""
    source, shape = i.args[0], program.specs[i.args[0]].shape
    if shape == ():
        return None
    if i.op == "matrix_transpose":
        axes = tuple(range(len(shape)))
        swapped = (*axes[:-2], axes[-1], axes[-2])
        places = order.get(source, axes), order.get(i.out, axes)
        return 0 if places in ((axes, swapped), (swapped, axes)) else None
    if not (_rows(source, program, order) and _rows(i.out, program, order)):
        return None
    if i.op == "reshape":
        return 0
    if i.op == "getitem":  # rows one after the other, whole ones
        begin, stride = 0, math.prod(shape)
        fixed = True
        for entry, n in zip(i.attrs["index"], shape, strict=True):
            stride //= n
            if isinstance(entry, int):
                if not fixed:
                    return None
                begin += entry % n * stride
                continue
            span = range(n)[slice(*entry)]
            if not fixed and span != range(n):
                return None
            if span.step != 1:
                return None
            begin += span.start * stride
            fixed = False
        return begin
    return None
