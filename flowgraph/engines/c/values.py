"""Array values in the making of C: elements that are scalar operations, or a view of memory, or both.

Small axes are unrolled: each element along them is an operation of its own. Long axes are lanes: one
operation stands for all places along them, and becomes the body of a loop. So an array of particles (3, 3,
1000) is nine operations in one loop over 1000, its chain of operations is fused, and a compiler finds one
stream for each of the nine (a structure of arrays). Which axes are lanes depends on the shape alone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph.engines.c.constants import without_repeats
from flowgraph.engines.c.nodes import Buffer, Node, Space, Tape, View
from flowgraph.recorder.ops import Spec

LONG = 16
"""An axis longer than this is a lane."""

UNROLLED = 64
"""At most so many elements are unrolled; beyond them, axes longer than 6 are lanes too."""


def lanes(shape: tuple[int, ...]) -> tuple[bool, ...]:
    """For each axis whether it is a lane."""
    flags = [n > LONG for n in shape]
    for limit in (6, 1):
        if math.prod(n for n, lane in zip(shape, flags, strict=True) if not lane) <= UNROLLED:
            break
        flags = [lane or n > limit for n, lane in zip(shape, flags, strict=True)]
    return tuple(flags)


def space_of(shape: tuple[int, ...]) -> Space:
    """The sizes of the lanes of a shape."""
    return tuple(n for n, lane in zip(shape, lanes(shape), strict=True) if lane)


def unrolled(shape: tuple[int, ...]) -> tuple[int, ...]:
    """The shape with every lane of size one."""
    return tuple(1 if lane else n for n, lane in zip(shape, lanes(shape), strict=True))


def row_major(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Strides of an array in C's order."""
    return tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))


class Value:
    """An array of known shape and kind of number.

    Args:
        spec: its shape and kind.
        elements: the operations that make it, lanes of size one.
        view: where it lies in memory.

    `told` is what the optimiser says of each element, as in `Program.elements`.
    """

    told: Any = None

    def __init__(self, spec: Spec, elements: Any = None, view: View | None = None) -> None:
        self.spec, self.view = spec, view
        self.elements: Any = elements
        assert elements is None or elements.shape == unrolled(spec.shape), (elements.shape, spec)

    shape = property(lambda self: self.spec.shape)


class Values:
    """Changes of form: elements from memory, memory from elements, elements in another array's lanes."""

    def __init__(self, tape: Tape) -> None:
        self.tape = tape
        self.constants: dict[Any, Buffer] = {}

    def elements(self, v: Value) -> Any:
        """The elements (object array of nodes, lanes of size one)."""
        if v.elements is None:
            v.elements = self._loads(v.view, v.shape)  # type: ignore[arg-type]
        return v.elements

    def _loads(self, view: View, shape: tuple[int, ...]) -> Any:
        """Loads of a view that is broadcast to a shape (sizes equal or one)."""
        flags, space = lanes(shape), space_of(shape)
        along = tuple(
            s if n > 1 else 0 for s, n, lane in zip(view.strides, view.shape, flags, strict=True) if lane
        )
        sizes = tuple(1 if lane else n for n, lane in zip(view.shape, flags, strict=True))
        made = np.empty(sizes, object)
        for index in np.ndindex(sizes):
            offset = view.offset + sum(i * s for i, s in zip(index, view.strides, strict=True))
            made[index] = self.load(view.buffer, offset, along, space)
        return made

    def load(self, buffer: Buffer, offset: int, strides: tuple[int, ...], space: Space) -> Node:
        """A load; a constant row of equal numbers or of numbers in equal steps needs no memory."""
        tape = self.tape
        if buffer.data is not None and len(space) == 1 and strides[0]:
            row = buffer.data.ravel()[offset :: strides[0]][: space[0]]
            if (row == row[0]).all():
                return tape.const(row[0], buffer.dtype)
            whole = row.dtype.kind == "i" or row.dtype == np.uint32
            steps = np.diff(row.astype(np.int64)) if whole else np.zeros(0)
            if steps.size and (steps == steps[0]).all():
                count = tape.op("multiply", "int64", tape.iota(0, space), tape.const(steps[0], "int64"))
                count = tape.op("add", "int64", count, tape.const(row[0], "int64"))
                return tape.op("astype", buffer.dtype, count)
        return tape.load(buffer, offset, strides, space)

    def aligned(self, v: Value, shape: tuple[int, ...]) -> Any:
        """Elements of `v` in the lanes of a shape to which it broadcasts."""
        flags = lanes(shape)
        short = len(shape) - len(v.shape)
        sizes = (1,) * short + v.shape
        mine = (False,) * short + lanes(v.shape)
        fits = all(
            (n == 1 and not m) or (n == wide and m == f)
            for n, m, wide, f in zip(sizes, mine, shape, flags, strict=True)
        )
        if fits and (space_of(v.shape) in ((), space_of(shape))):
            elements = self.elements(v)
            return elements.reshape((1,) * short + elements.shape)
        view = self.stored(v)
        return self._loads(View(view.buffer, sizes, view.offset, (0,) * short + view.strides), shape)

    def stored(self, v: Value) -> View:
        """The array in memory; lanes are put last, so that a loop runs along them."""
        if v.view is None:
            flags = lanes(v.shape)
            order = [k for k, f in enumerate(flags) if not f] + [k for k, f in enumerate(flags) if f]
            packed = row_major(tuple(v.shape[k] for k in order))
            strides = tuple(packed[order.index(k)] for k in range(len(order)))
            v.view = self.put(v, strides)
        return v.view

    def packed(self, v: Value) -> View:
        """The array in memory in C's order without gaps."""
        wanted = row_major(v.shape)
        view = self.stored(v)
        if _same_strides(view, wanted):
            return View(view.buffer, v.shape, view.offset, wanted)
        if view.buffer.kind == "const":
            return self._in_work(v)
        return self.put(Value(v.spec, self.elements(v)), wanted)

    def own(self, v: Value) -> View:
        """The array in memory in C's order, and not among the constants."""
        view = self.packed(v)
        if view.buffer.kind != "const":
            return view
        return self._in_work(v)

    def _in_work(self, v: Value) -> View:
        made = View(self.tape.work(v.spec.dtype, math.prod(v.shape)), v.shape, 0, row_major(v.shape))
        self.write(made, self.elements(v))
        return made

    def put(self, v: Value, strides: tuple[int, ...]) -> View:
        elements = self.elements(v)
        flat = list(elements.ravel())
        if all(e.op == "const" for e in flat) and flat:
            array = np.broadcast_to(
                np.array([e.extra[0] for e in flat], dtype=_HOST[v.spec.dtype]).reshape(elements.shape),
                v.shape,
            )
            return self.constant(np.ascontiguousarray(array), v.spec.dtype)
        buffer = self.tape.work(v.spec.dtype, math.prod(v.shape))
        view = View(buffer, v.shape, 0, strides)
        self.write(view, elements)
        return view

    def write(self, view: View, elements: Any) -> None:
        """Store elements (in the lanes of the view's shape) into a view."""
        flags, space = lanes(view.shape), space_of(view.shape)
        along = tuple(s for s, lane in zip(view.strides, flags, strict=True) if lane)
        for index in np.ndindex(unrolled(view.shape)):
            offset = view.offset + sum(i * s for i, s in zip(index, view.strides, strict=True))
            self.tape.store(view.buffer, offset, along, elements[index], space)

    def constant(self, array: np.ndarray, dtype: str) -> View:
        """A constant in memory; equal ones share it."""
        kept, steps = without_repeats(array)
        key = (kept.tobytes(), kept.shape, dtype)
        if key not in self.constants:
            self.constants[key] = Buffer("", dtype, kept.size, "const", data=kept)
        return View(self.constants[key], array.shape, 0, steps)


_HOST: dict[str, Any] = {
    "real": float,
    "bool": bool,
    **{k: np.dtype(k) for k in ("int32", "int64", "uint32", "uint64")},
}


def _same_strides(view: View, wanted: tuple[int, ...]) -> bool:
    pairs = zip(view.strides, wanted, view.shape, strict=True)
    return all(a == b or n == 1 for a, b, n in pairs)
