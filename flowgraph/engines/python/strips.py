"""Lines over many lanes, gone through for some thousands of them at a time.

Over a cloud of N particles most lines do the same for each. One after the other over whole arrays, they write
what is between them to memory and read it back, once N numbers leave the caches. In a strip all of them are
done for some particles before the next ones are, and what is between them stays in the cache; what is read
after it is put together.

The bits are those of the whole lines. NumPy adds a row in halves, down to a few numbers, so strips are the
halves of halves that it would make, and their sums are added as it would. Of a matrix times a matrix of many
columns a library may do the last columns in another way than those before: it is asked once whether it does.
Other products over the lanes stay whole, and what is made for them lies as it would lie.
"""

from __future__ import annotations

import math
import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import ELEMENTWISE, Spec
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

LANES = 12_800
"""At most in a strip: several rows of so many numbers stay in a core's own cache, and are long beside what a
line costs however short it is."""

LEAST = 30_000
"""Lanes from which on there are strips: fewer are as quick whole."""

_LEAST_LINES = 4
_TAKEN = ', None, "clip")'
_BYTES: dict[str, int] = {"real": 8} | {name: dtype().itemsize for name, dtype in DTYPES.items()}
_VIEWS = ("getitem", "reshape", "permute_dims")
_ACROSS = ("sum", "max", "min", "any", "all")
_PLACING = (np.add, np.subtract, np.multiply, np.divide, np.negative, np.concatenate)
"""What can be told where its result belongs, by its name among the instructions."""
_READ = re.compile(r"\b[a-z]\w*")
_WRITTEN = re.compile(r"\s*(w\d+_\d+) = [^;]*$")
_PLAIN = re.compile(r"[kwrx]\w+")


@dataclass(frozen=True)
class Whole:
    """A line that is an instruction: its arguments as text, and their shapes."""

    instruction: Instruction
    args: tuple[str, ...]
    shapes: tuple[tuple[int, ...], ...]


def halves(count: int) -> list[int]:
    """Where strips of so many lanes end: NumPy's halves of a sum, until each has at most so many."""
    if count <= LANES:
        return [count]
    first = _half(count)
    return [*halves(first), *(first + end for end in halves(count - first))]


def _half(count: int) -> int:
    """The first of NumPy's halves."""
    return count // 2 // 8 * 8


@lru_cache(maxsize=64)
def parts(count: int) -> tuple[tuple[Any, slice], ...]:
    """The strips as indices of arrays."""
    ends = halves(count)
    return tuple((..., slice(a, b)) for a, b in zip([0, *ends], ends, strict=False))


class Rooms:
    """Memory of a run for values of all lanes, each used again once nobody holds what lay there.

    The system clears a page before it hands it out, and takes back what is much: over and over that costs
    more than what is done with it.
    """

    def __init__(self) -> None:
        self._by_size: dict[int, list[np.ndarray]] = {}

    def only(self, sizes: Mapping[int, int]) -> None:
        """Let go of what nobody holds, but for so many rooms of these sizes in bytes."""
        for size, rooms in self._by_size.items():
            free = [k for k in range(len(rooms)) if _holders(rooms, k) == _ALONE]
            for k in reversed(free[sizes.get(size, 0) :]):
                del rooms[k]

    def take(self, shape: Sequence[int], dtype: Any) -> np.ndarray:
        size = math.prod(shape) * np.dtype(dtype).itemsize
        rooms = self._by_size.setdefault(size, [])
        free = next((k for k in range(len(rooms)) if _holders(rooms, k) == _ALONE), None)
        if free is None:
            free = len(rooms)
            rooms.append(np.empty(size, np.uint8))
        room: np.ndarray = rooms[free].view(dtype).reshape(shape)
        return room


def _holders(rooms: list[np.ndarray], k: int) -> int:
    """Who refers to a room, the list and this call among them, and each view of it."""
    return sys.getrefcount(rooms[k])


_ALONE = _holders([np.empty(0, np.uint8)], 0)


class Together:
    """A value of all lanes, put together of those of strips: it lies as they do."""

    def __init__(self, count: int, rooms: Rooms) -> None:
        self._count, self._rooms = count, rooms
        self.whole: Any = None
        self._given = False

    def room(self, at: tuple[Any, slice]) -> np.ndarray | None:
        """Where the part belongs, for what can write it there itself; None for the first."""
        self._given = at[1].start > 0
        return self.whole[at] if self._given else None

    def __call__(self, at: tuple[Any, slice], part: np.ndarray) -> None:
        if at[1].start == 0:
            order = sorted(range(part.ndim), key=lambda axis: -part.strides[axis])
            shape = (*part.shape[:-1], self._count)
            room = self._rooms.take([shape[axis] for axis in order], part.dtype)
            self.whole = room.transpose([order.index(axis) for axis in range(part.ndim)])
        if not self._given:
            self.whole[at] = part
        self._given = False


class Sum:
    """A sum over all lanes, of the sums of strips."""

    def __init__(self, count: int, rooms: Rooms, keepdims: bool) -> None:
        self._count, self._rooms, self._keepdims = count, rooms, keepdims
        self._sums: list[np.ndarray] = []
        self._parts: Together | None = None

    def __call__(self, at: tuple[Any, slice], part: np.ndarray) -> None:
        if part.strides[-1] == part.itemsize:
            self._sums.append(NUMPY.sum(part, axis=-1, keepdims=self._keepdims))
            return
        if self._parts is None:  # lanes that lie apart NumPy adds one by one
            self._parts = Together(self._count, self._rooms)
        self._parts(at, part)

    @property
    def whole(self) -> Any:
        if self._parts is not None:
            return NUMPY.sum(self._parts.whole, axis=-1, keepdims=self._keepdims)
        sums = iter(self._sums)

        def added(count: int) -> Any:
            if count <= LANES:
                return next(sums)
            first = _half(count)
            one = added(first)
            return one + added(count - first)

        return added(self._count)


@lru_cache(maxsize=256)
def by_columns(rows: int, inner: int, count: int) -> bool:
    """Whether a product of a matrix with one of so many columns is that of each strip's, to the bit."""
    numbers = np.random.default_rng(0)
    left, right = numbers.standard_normal((rows, inner)), numbers.standard_normal((inner, count))
    for a in (left, np.asfortranarray(left)):
        for b in (right, np.asfortranarray(right)):
            whole = a @ b
            if not all(
                np.array_equal(whole[at], a @ b[at]) and np.array_equal(whole[at], a @ b[at].copy("K"))
                for at in parts(count)
            ):
                return False
    return True


def lanes(line: Whole) -> int:
    """How many lanes a line goes over, all of its last axis, each alone or, in a sum, together; else 0."""
    i, wide = line.instruction, {s[-1] for s in line.shapes if s and s[-1] >= LEAST}
    if len(wide) != 1:
        return 0
    count: int = wide.pop()
    rest = [n for s in (*line.shapes, i.spec.shape) for n in s[:-1]]
    slim = [s for s in line.shapes if s and s[-1] not in (1, count)]
    named = all(_PLAIN.fullmatch(a) for a, s in zip(line.args, line.shapes, strict=True) if s)
    if count in rest or not named or (slim and i.op != "matmul"):
        return 0
    if _is_sum(i, line.shapes):
        return count
    return count if i.spec.shape[-1:] == (count,) and _alone(i, line.shapes, count) else 0


def _alone(i: Instruction, shapes: Sequence[tuple[int, ...]], count: int) -> bool:
    """Whether each lane of the result is of the same lane of the arguments."""
    rank = len(shapes[0])
    if i.op in ELEMENTWISE:
        return True
    if i.op == "getitem":
        return bool(i.attrs["index"][-1] == [None, None, None])
    if i.op in ("reshape", "permute_dims"):
        return i.op == "reshape" or i.attrs["axes"][-1] == rank - 1
    if i.op in ("concat", "stack"):
        axes = len(i.spec.shape)
        return all(s[-1:] == (count,) for s in shapes) and i.attrs["axis"] % axes != axes - 1
    if i.op in _ACROSS:
        return True  # its last axis is there still
    if i.op == "matmul" and len(shapes[0]) == len(shapes[1]) == 2 and shapes[0][-1] != count:
        return by_columns(*shapes[0], count)
    return False


def _is_sum(i: Instruction, shapes: Sequence[tuple[int, ...]]) -> bool:
    """Whether a line is a sum over the lanes and nothing else."""
    axis, rank = i.attrs.get("axis"), len(shapes[0]) if shapes else 0
    axes = [axis] if isinstance(axis, int) else axis or []
    return i.op == "sum" and i.spec.dtype == "real" and [a % rank for a in axes] == [rank - 1]


def _size(spec: Spec) -> int:
    """Bytes of a value."""
    return int(math.prod(spec.shape)) * _BYTES[spec.dtype]


def _placed(line: Whole, held: str) -> str | None:
    """The text of a line that writes its part where it belongs; None for what cannot."""
    i = line.instruction
    if i.spec.dtype != "real" or i.op not in ("add", "subtract", "multiply", "divide", "negative", "concat"):
        return None
    if i.op == "concat":
        return f"concatenate(({', '.join(line.args)},), {i.attrs['axis']}, {held}.room(at))"
    return f"{i.op}({', '.join(line.args)}, {held}.room(at))"


class Strips:
    """The lines of a tick, those over many lanes in strips.

    Args:
        lines: of one function, in its order.
        known: those that are instructions, by where they stand.

    `made` has the new lines, each with the place of the one that it is of; `arrays` the variables in them
    that hold arrays; `names` what they need.
    """

    def __init__(self, lines: Sequence[str], known: Mapping[int, Whole]) -> None:
        self._lines, self._known = lines, known
        self.made: list[tuple[str, int]] = []
        self.arrays: set[str] = set()
        self.names: dict[str, Any] = {}
        self._lanes = {k: n for k, line in known.items() if (n := lanes(line))}
        self._strips = 0
        self._sizes: Counter[int] = Counter()
        if not self._lanes:
            self.made = list(zip(lines, range(len(lines)), strict=True))
            return
        outer = len(lines[0]) - len(lines[0].lstrip())
        self._indent = " " * outer
        names_ = [m[1] if (m := _WRITTEN.match(line)) else "" for line in lines]
        times = Counter(names_)
        self._names = [
            n if times[n] == 1 and line[outer] != " " else "" for n, line in zip(names_, lines, strict=True)
        ]
        self._reads = [
            set(_READ.findall(line.partition(" = ")[2] if name else line))
            for line, name in zip(lines, self._names, strict=True)
        ]
        self._readers: dict[str, set[int]] = {}
        for k, names in enumerate(self._reads):
            for name in names:
                self._readers.setdefault(name, set()).add(k)
        within, at = set[int](), 0  # the selections with whole lines under an arm
        for k, line in enumerate(lines):
            at = k if line[outer] != " " and line[outer:] != "else:" else at
            if at != k and k in self._lanes:
                within.add(at)
        segment: list[int] = []
        for k in range(len(lines)):
            if self._names[k]:
                segment.append(k)
                continue
            if lines[k][outer:] == "pass":  # what nobody reads was there
                continue
            self._segment(segment)
            segment = []
            if k in within and self._strips:
                self.made.append((f"{self._indent}rooms.only({{}})", k))  # whole lines find memory free
            self._plain([k])
        self._segment(segment)
        if self._strips:
            self.made.insert(0, (f"{self._indent}rooms.only({dict(self._sizes)})", 0))

    def _plain(self, places: Sequence[int]) -> None:
        for k in places:
            line, known = self._lines[k], self._known.get(k)
            if known is not None and known.instruction.op == "take" and line.endswith(_TAKEN):
                spec = known.instruction.spec
                if spec.dtype == "real" and max(spec.shape, default=0) >= LEAST:
                    line = f'{line.removesuffix(_TAKEN)}, rooms.take({tuple(spec.shape)}, real), "clip")'
                    self._sizes[_size(spec)] += 1
            self.made.append((line, k))

    def _segment(self, places: Sequence[int]) -> None:
        """Lines that can stand in any order in which what they read is there."""
        while places:
            places = self._with_a_strip(places)

    def _with_a_strip(self, places: Sequence[int]) -> list[int]:
        """Those of the first strip, and those that can stand before it; gives those that are left."""
        count = next((self._lanes[k] for k in places if k in self._lanes), 0)
        before, strip, after = [], [], []
        inside: set[str] = set()
        late: set[str] = set()  # is there only after the strip
        for k in places:
            reads = self._reads[k]
            if self._lanes.get(k) == count and count and reads.isdisjoint(late):
                strip.append(k)
                line = self._known[k]
                (late if _is_sum(line.instruction, line.shapes) else inside).add(self._names[k])
            elif not (reads.isdisjoint(late) and reads.isdisjoint(inside)):
                after.append(k)
                late.add(self._names[k])
            else:
                before.append(k)
        if not strip:
            self._plain(places)
            return []
        if sum(self._known[k].instruction.op not in _VIEWS for k in strip) < _LEAST_LINES:
            self._plain([*before, *strip])
        else:
            self._plain(before)
            self._strip(strip, count)
        return after

    def _strip(self, places: Sequence[int], count: int) -> None:
        self.names |= {f"parts_{count}": parts(count), "Together": Together, "Sum": Sum}
        self.names |= {function.__name__: function for function in _PLACING}
        here, views, needed = set(places), set[int](), list[int]()
        for k in reversed(places):  # what is read after the strip; a view is taken there anew
            name = self._names[k]
            if self._readers.get(name, set()) - here or any(name in self._reads[v] for v in views):
                views.add(k) if self._known[k].instruction.op in _VIEWS else needed.append(k)
        held = {k: f"h{self._strips}_{n}" for n, k in enumerate(reversed(needed))}
        for k, name in held.items():
            i = self._known[k].instruction
            kept = f"Together({count}, rooms)"
            if _is_sum(i, self._known[k].shapes):
                kept = f"Sum({count}, rooms, {i.attrs.get('keepdims', False)})"
            else:
                self._sizes[_size(i.spec)] += 1
            self.made.append((f"{self._indent}{name} = {kept}", k))
        self.made.append((f"{self._indent}for at in parts_{count}:", places[0]))
        parts_ = self._body(places, count, held, views)
        self.arrays |= {*parts_, *held.values()}
        self.made += [(f"{self._indent}{self._names[k]} = {name}.whole", k) for k, name in held.items()]
        self._plain(sorted(views))
        self._strips += 1

    def _body(self, places: Sequence[int], count: int, held: Mapping[int, str], views: set[int]) -> list[str]:
        """The lines within a strip, and the variables that are of a part there and of all lanes without."""
        renamed: dict[str, str] = {}
        here, made = set(places), {self._names[k] for k in places}

        def part(name: str) -> str:
            return renamed.setdefault(name, f"v{self._strips}_{len(renamed)}")

        def of_parts(text: str) -> str:
            return _READ.sub(lambda found: renamed.get(found[0], found[0]), text)

        def add(text: str, k: int) -> None:
            self.made.append((f"{self._indent}    {text}", k))

        for k in places:
            line, name = self._known[k], self._names[k]
            if k not in held and not self._readers.get(name, set()) & here:
                continue  # nobody reads it, or as a view after the strip
            for arg, shape in zip(line.args, line.shapes, strict=True):
                if shape[-1:] == (count,) and arg not in made and arg not in renamed:
                    add(f"{part(arg)} = {arg}[at]", k)
            if _is_sum(line.instruction, line.shapes):
                add(f"{held[k]}(at, {of_parts(line.args[0])})", k)
                continue
            text = _placed(line, held[k]) if k in held else None
            if line.instruction.op == "reshape":
                text = f"{line.args[0]}.reshape({(*line.instruction.spec.shape[:-1], -1)})"
            text = of_parts(text or self._lines[k].partition(" = ")[2])
            target = part(name) if k in held or k in views else name
            add(f"{target} = {text}", k)
            if k in held:
                add(f"{held[k]}(at, {target})", k)
        return list(renamed.values())
