"""Strips: parts of a program that can be computed a block of lanes at a time.

Over a cloud of N particles most instructions do the same for each particle. One after the other over whole
arrays, they write each intermediate to memory and read it back as soon as N numbers leave the caches. In a
strip, all of them are done for a block of particles before the next block, and what is between them stays in
the cache.

What is promised, for a program and a size n:

- A value has lanes where exactly one axis of its shape has size n: `axes` has that axis. Other values have
  none, those in whose shape n occurs twice among them.
- `parts` has each instruction of the program once, by itself or in a strip, in an order in which everything
  is computed before it is used.
- An instruction in a strip makes a value with lanes. Slices of its result along them, of whatever lengths,
  come of the same slices of those arguments that `slices` says, and of the others whole. `narrowed` is the
  instruction for a slice: what names a shape names that of the slice.
- An argument that an instruction of a strip takes whole, lanes or not, is not made in the same strip.
- There are as few strips as a program in which nothing is computed twice allows: each goes as far as its
  instructions need nothing that comes of all lanes of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import ELEMENTWISE
from flowgraph.recorder.specs import Spec
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Strip:
    """Instructions that can be done for a block of lanes at a time, in order.

    Args:
        instructions: each of which makes a value with lanes.
        whole: values from before that some take whole; those that others slice may be among them.
        sliced: values from before of which the block's slice is enough.
        kept: values made here that are needed after: their slices are put together.
    """

    instructions: tuple[Instruction, ...]
    whole: tuple[int, ...]
    sliced: tuple[int, ...]
    kept: tuple[int, ...]

    @cached_property
    def local(self) -> frozenset[int]:
        """Values that are made and used up here: they are never needed whole."""
        return frozenset(i.out for i in self.instructions) - set(self.kept)


@dataclass(frozen=True)
class Strips:
    """A program in strips, and what stands between them.

    Args:
        size: of the axis along lanes.
        axes: value -> its axis along lanes, counted from the first.
        parts: strips, and instructions that need all lanes or have none, in order.
    """

    size: int
    axes: Mapping[int, int]
    parts: tuple[Strip | Instruction, ...]

    def narrowed(self, i: Instruction, lanes: int) -> Instruction:
        """An instruction of a strip as it is for so many lanes."""
        shape = list(i.spec.shape)
        shape[self.axes[i.out]] = lanes
        attrs = {**i.attrs, "shape": shape} if "shape" in i.attrs else i.attrs
        return replace(i, spec=Spec(tuple(shape), i.spec.dtype), attrs=attrs)


def strips(program: Program, size: int) -> Strips:
    """The program in strips along axes of this size.

    Args:
        program: specialised for a pattern, or for all.
        size: of an axis along lanes, such as one of `program.lanes`; 2 or more.
    """
    specs = program.specs
    modes = {i.out: found for i in program.instructions if (found := slices(i, specs, size)) is not None}
    levels = _sunk(program, modes, _levels(program, modes))
    made: dict[tuple[int, bool], list[Instruction]] = {}
    for i in program.instructions:
        made.setdefault((levels[i.out], i.out in modes), []).append(i)
    after = _after(program, modes, levels)
    parts: list[Strip | Instruction] = []
    for (_, strip), some in sorted(made.items(), key=lambda item: item[0]):
        parts.extend([_strip(some, modes, after)] if strip else some)
    seen = {n for i in program.instructions for n in (i.out, *i.args)} | {*program.writes, *program.reads}
    axes = {n: axis for n in seen if (axis := lane_axis(specs[n], size)) is not None}
    return Strips(size, axes, tuple(parts))


def lane_axis(spec: Spec, size: int) -> int | None:
    """The one axis of this size; None where there is none, or two."""
    return spec.shape.index(size) if spec.shape.count(size) == 1 else None


def slices(i: Instruction, specs: Mapping[int, Spec], size: int) -> tuple[bool, ...] | None:
    """Which arguments a slice of the result needs the same slice of, not the whole; None: it needs more."""
    axis = lane_axis(i.spec, size)
    args = [specs[a] for a in i.args]
    if axis is None or size < 2 or any(a.shape.count(size) > 1 for a in args) or 0 in i.spec.shape:
        return None
    rule = _elementwise if i.op in ELEMENTWISE else _RULES.get(i.op)
    if rule is None:
        return None
    places = rule([a.shape for a in args], [lane_axis(a, size) for a in args], i.attrs, i.spec.shape)
    if places is None or any(p not in (None, axis) for p in places):
        return None
    # Without any argument to slice only a repetition has lanes: its number of lanes is in its attributes.
    if all(p is None for p in places) and i.op != "broadcast_to":
        return None
    return tuple(p is not None for p in places)


def _levels(program: Program, modes: Mapping[int, tuple[bool, ...]]) -> dict[int, int]:
    """At which level each value is made at the earliest: what needs all lanes of level k is of level k + 1.

    Of a level, instructions that are in no strip come first.
    """
    levels: dict[int, int] = {}
    for i in program.instructions:
        sliced = modes.get(i.out, (False,) * len(i.args))
        needs = [
            levels[a] + (a in modes and not part)
            for a, part in zip(i.args, sliced, strict=True)
            if a in levels
        ]
        levels[i.out] = max(needs, default=0)
    return levels


def _sunk(program: Program, modes: Mapping[int, tuple[bool, ...]], levels: dict[int, int]) -> dict[int, int]:
    """The same with what only later strips use in the first of these, where less is kept that way."""
    ends = _ends(program)
    uses = _uses(program, modes)
    levels = dict(levels)
    for i in reversed(program.instructions):
        if i.out not in modes or i.out in ends or not uses.get(i.out):
            continue
        last = min(levels[user] - late for user, late in uses[i.out])
        if last <= levels[i.out]:
            continue
        added = {
            a
            for a, part in zip(i.args, modes[i.out], strict=True)
            if part
            and a in modes
            and a not in ends
            and all(user == i.out or (levels[user] == levels[a] and not late) for user, late in uses[a])
        }
        if sum(math.prod(program.specs[a].shape) for a in added) <= math.prod(i.spec.shape):
            levels[i.out] = last
    return levels


def _uses(program: Program, modes: Mapping[int, tuple[bool, ...]]) -> dict[int, list[tuple[int, bool]]]:
    """By value, what takes it, and whether that needs all lanes of it."""
    found: dict[int, list[tuple[int, bool]]] = {}
    for i in program.instructions:
        for a, part in zip(i.args, modes.get(i.out, (False,) * len(i.args)), strict=True):
            found.setdefault(a, []).append((i.out, not part))
    return found


def _ends(program: Program) -> frozenset[int]:
    """What a tick hands on: registers and outputs."""
    flags = (n for flag, leaves in program.outputs for n in (*leaves, *(() if flag is None else (flag,))))
    return frozenset({*program.writes, *flags})


def _after(
    program: Program, modes: Mapping[int, tuple[bool, ...]], levels: Mapping[int, int]
) -> frozenset[int]:
    """The values that something after their own strip needs."""
    used = (
        a
        for i in program.instructions
        for a in i.args
        if a in modes and (i.out not in modes or levels[i.out] != levels[a])
    )
    return _ends(program) | frozenset(used)


def _strip(
    some: Sequence[Instruction], modes: Mapping[int, tuple[bool, ...]], after: frozenset[int]
) -> Strip:
    own = {i.out for i in some}
    reads = [(a, part) for i in some for a, part in zip(i.args, modes[i.out], strict=True) if a not in own]
    return Strip(
        tuple(some),
        tuple(dict.fromkeys(a for a, part in reads if not part)),
        tuple(dict.fromkeys(a for a, part in reads if part)),
        tuple(i.out for i in some if i.out in after),
    )


# Rules: shapes of the arguments, their axes along lanes, attributes and the result's shape -> for each
# argument that is sliced the axis of the result along which the slices then lie, and None for one that is
# taken whole; or None where slices of the result are not made of slices.
_Shape = tuple[int, ...]
_Places = list[int | None] | None
_Rule = Callable[[list[_Shape], list[int | None], dict[str, Any], _Shape], _Places]


def _elementwise(
    shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape
) -> _Places:
    """Broadcasting aligns the last axes."""
    return [
        None if lane is None else lane + len(out) - len(shape)
        for shape, lane in zip(shapes, lanes, strict=True)
    ]


def _axes(attrs: dict[str, Any], rank: int) -> set[int] | None:
    """The axes that an instruction names; None for all of them at once."""
    axis = attrs.get("axis")
    if axis is None:
        return None
    return {a % rank for a in (axis if isinstance(axis, list | tuple) else (axis,))}


def _reduced(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    (shape,), (lane,) = shapes, lanes
    gone = _axes(attrs, len(shape))
    if gone is None or lane is None or lane in gone:
        return None
    return [lane if attrs.get("keepdims") else lane - sum(a < lane for a in gone)]


def _along(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """What goes along an axis and leaves the shape as it is."""
    axes = _axes(attrs, len(shapes[0]))
    return None if axes is None or lanes[0] in axes else lanes


def _sorted(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    return _along(shapes, lanes, {"axis": attrs.get("axis", -1)}, out)


def _concat(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    along = attrs["axis"] % len(out)
    return None if any(lane in (None, along) for lane in lanes) else lanes


def _stack(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    along = attrs["axis"] % len(out)
    return [None if lane is None else lane + (along <= lane) for lane in lanes]


def _getitem(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    (shape,), (lane,), index = shapes, lanes, attrs["index"]
    if lane is None or isinstance(index[lane], int):
        return None
    if range(*slice(*index[lane]).indices(shape[lane])) != range(shape[lane]):
        return None
    return [sum(not isinstance(entry, int) for entry in index[:lane])]


def _take(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """By indices with lanes a table is taken whole; by others, lanes are no axis that is taken along."""
    (table, indices), (lane, chosen) = shapes, lanes
    along = attrs["axis"] % len(table)
    if chosen is not None:
        return [None, along + chosen]
    if lane is None or lane == along:
        return None
    return [lane if lane < along else lane + len(indices) - 1, None]


def _matmul(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """Rows of the left, columns of the right, or axes before those; not what the sum goes over."""
    flat = [len(shape) == 1 for shape in shapes]
    places: list[int | None] = []
    for right, (shape, lane) in enumerate(zip(shapes, lanes, strict=True)):
        if lane is None:
            places.append(None)
            continue
        back = len(shape) - lane  # 1 for the last axis
        if flat[right] or back == (2 if right else 1):
            return None
        # A vector beside it takes an axis away behind rows, and before columns none is left to count.
        fewer = (1 if flat[1 - right] else 0) if back > 1 else 0
        places.append(len(out) - back + fewer)
    return places


def _transpose(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    (shape,), (lane,) = shapes, lanes
    swapped = {len(shape) - 1: len(shape) - 2, len(shape) - 2: len(shape) - 1}
    return [None if lane is None else swapped.get(lane, lane)]


def _permuted(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    return [None if lanes[0] is None else list(attrs["axes"]).index(lanes[0])]


def _reshaped(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """The axis stays where as many elements lie before it."""
    (shape,), (lane,) = shapes, lanes
    if lane is None:
        return None
    axis = out.index(shape[lane])
    return [axis] if math.prod(out[:axis]) == math.prod(shape[:lane]) else None


def _matrices(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """Each matrix by itself: axes before the last two."""
    return _elementwise(shapes, lanes, attrs, out) if _before(shapes[0], lanes[0], 2) else None


def _solve(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    (a, b), (lane, of_b) = shapes, lanes
    if not _before(a, lane, 2):
        return None
    if len(b) == 1:
        return None if of_b is not None else [lane, None]
    return _elementwise(shapes, lanes, attrs, out) if of_b != len(b) - 2 else None


def _vectors(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """Each vector by itself: axes before the last; of `vecdot` that is gone."""
    if not all(_before(shape, lane, 1) for shape, lane in zip(shapes, lanes, strict=True)):
        return None
    rank = max(map(len, shapes))
    return [
        None if lane is None else lane + rank - len(shape) for shape, lane in zip(shapes, lanes, strict=True)
    ]


def _before(shape: _Shape, lane: int | None, last: int) -> bool:
    return lane is None or lane < len(shape) - last


def _outer(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    return [None if lane is None else side for side, lane in enumerate(lanes)]


def _searched(shapes: list[_Shape], lanes: list[int | None], attrs: dict[str, Any], out: _Shape) -> _Places:
    """What is searched in is whole."""
    return [None, lanes[1]]


_RULES: dict[str, _Rule] = {
    **dict.fromkeys(("sum", "prod", "max", "min", "mean", "any", "all", "argmax", "argmin"), _reduced),
    **dict.fromkeys(("flip", "roll", "cumulative_sum"), _along),
    **dict.fromkeys(("sort", "argsort"), _sorted),
    **dict.fromkeys(("cholesky", "tril", "triu"), _matrices),
    **dict.fromkeys(("cross", "vecdot"), _vectors),
    "concat": _concat,
    "stack": _stack,
    "getitem": _getitem,
    "take": _take,
    "matmul": _matmul,
    "matrix_transpose": _transpose,
    "permute_dims": _permuted,
    "reshape": _reshaped,
    "broadcast_to": _elementwise,
    "solve": _solve,
    "outer": _outer,
    "searchsorted": _searched,
}
"""What goes with a rule of its own; an operation that is missing needs all lanes."""
