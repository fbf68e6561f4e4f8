"""How large numbers get: the sizes of all values of a pipeline, over recorded flights in floating point.

What is rounding alone has no size of its own in floating point, such as an element of a product that is zero
by symmetry. In words it takes the rounding of what is around it, which is larger; so the error of each value
is bounded to the first order from the formats of its arguments, and a format fits that too.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.engines.fixed.abreast import Recorded, abreast, varying
from flowgraph.engines.fixed.bounds import proven_sizes
from flowgraph.engines.fixed.shifts import MOVES, READ_WHOLE, Site, moved
from flowgraph.pipeline.format_files import structure_of
from flowgraph.pipeline.formats import FREE, WIDEST, Formats, fraction_for, fraction_of_constant
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import needed
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction

_TOGETHER, _AT_ONCE = 1 << 22, 1 << 25
"""Numbers that are looked at in one go, and in a tick of flights that are played at once."""

_HELD = 16.0
"""Errors of a register, in units of its last place: it gathers those of many ticks."""

_MOST = 256.0
"""Errors of a value at most, in units of its last place: a bound that is followed further only grows."""

_ROUNDED = 1.0 / 64.0
"""The part by which rounding may exceed what is proven of real numbers."""

_ALIKE = frozenset(["particles", "members"])
"""Axes along which elements are alike and share a format; those of a state differ by powers of ten."""

_CORRELATION = 2.0**-7
"""The smallest that an element of a matrix is taken for, beside its diagonal."""


class Sizes:
    """The largest size of each element of each real value, so far.

    Args:
        pipeline: in plain instructions; it is played in float64.

    Attributes:
        largest: by value number, an array that broadcasts to the value's shape.
        untaken: the same of elements that no selection took, whatever they were.
        absent: the inputs and registers that were NaN at some time.
        ticks: how many were played.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self.pipeline = pipeline
        self.largest: dict[int, np.ndarray] = {}
        self.untaken: dict[int, np.ndarray] = {}
        self.absent: set[int] = set()
        self.ticks = 0
        self._cells = [c for r in pipeline.registers for c in r.cells]
        self._real = {n for n, s in pipeline.specs.items() if s.dtype == "real"} - set(pipeline.constants)
        self._shared = {
            n
            for part in _parts(pipeline)
            for n, axis in zip(part.shape, part.axes, strict=False)
            if axis in _ALIKE
        }
        self._waiting: dict[int, list[Any]] = {}
        self._idle: dict[int, list[Any]] = {}
        self._numbers = 0
        self._fits: dict[int, np.ndarray] = {}
        self._wider: dict[int, np.ndarray] = {}
        self._varying: set[int] = set()
        self._proven: dict[int, np.ndarray] | None = None

    def play(self, flights: Sequence[Recorded]) -> None:
        """Play some flights, as many at once as memory is for, and widen the sizes by what occurs in them.

        Args:
            flights: of pipelines of the same structure, with numbers of their own.
        """
        self._varying |= varying([self.pipeline, *(f.pipeline for f in flights)])
        self._proven = None
        most = max(1, _AT_ONCE // sum(math.prod(spec.shape) for spec in self.pipeline.specs.values()))
        for first in range(0, len(flights), most):
            self._play(flights[first : first + most])

    def _play(self, flights: Sequence[Recorded]) -> None:
        for flight in flights:
            for cell, value in zip(self._cells, flight.cells, strict=True):
                self._see(cell.read, cell.dtype, np.asarray(value)[..., None])
        real = [[leaf.value for leaf in port.leaves if leaf.dtype == "real"] for port in self.pipeline.inputs]
        with np.errstate(all="ignore"):
            for step in abreast(flights):
                env, tail = step.values, (len(step.flights),)
                given = [n for k, leaves in enumerate(real) if step.key >> k & 1 for n in leaves]
                taken = needed(step.program, env, tail)
                for n in (*given, *(i.out for i in step.program.instructions if i.spec.dtype == "real")):
                    mask = taken.get(n, False)
                    if mask is not True:
                        self._keep(self._idle, n, env[n])
                    self._see(n, "real", env[n] if mask is True else np.where(mask, env[n], 0.0))
                self.absent |= {n for n in given if np.isnan(env[n]).any()}
                for cell, n in zip(self._cells, step.program.writes, strict=True):
                    self._see(cell.read, cell.dtype, env[n])
                self.ticks += len(step.flights)
                if self._numbers > _TOGETHER:
                    self._look()
        self._look()

    def _see(self, value: int, dtype: str, x: Any) -> None:
        if dtype == "real":
            self._keep(self._waiting, value, x)

    def _keep(self, waiting: dict[int, list[Any]], value: int, x: Any) -> None:
        waiting.setdefault(value, []).append(x)
        self._numbers += x.size

    def _look(self) -> None:
        """Widen the sizes by the values that wait."""
        held = {c.read for c in self._cells}
        for waiting, sizes in ((self._waiting, self.largest), (self._idle, self.untaken)):
            for value, rows in waiting.items():
                size = np.abs(np.concatenate(rows, axis=-1))
                axes = tuple(a for a, n in enumerate(size.shape[:-1]) if n in self._shared)
                finite = np.isfinite(size)
                if not finite.all():
                    if value in held and np.isnan(size).any():
                        self.absent.add(value)
                    size = np.where(finite, size, 0.0)
                size = size.max(axis=-1).max(axis=axes, keepdims=True, initial=0.0)
                sizes[value] = np.maximum(sizes.get(value, 0.0), size)
            waiting.clear()
        self._numbers = 0

    def _size(self, value: int) -> np.ndarray | None:
        """Of what was taken; where an element never was, of what it would have been."""
        found = self.largest.get(value)
        if found is None or value not in self.untaken:
            return found
        return np.asarray(np.where(found > 0.0, found, self.untaken[value]))

    def _bound(self, value: int, seen: np.ndarray) -> np.ndarray:
        """What no element can exceed, with room for rounding; no bound where one did."""
        if self._proven is None:
            self._proven = proven_sizes(self.pipeline, self._varying)
        size = self._proven.get(value)
        if size is None:
            return np.full(seen.shape, np.inf)
        axes = tuple(a for a, n in enumerate(size.shape) if n in self._shared)
        most = size.max(axis=axes, keepdims=True, initial=0.0)
        return np.where((most > 0.0) & (seen <= most), most * (1.0 + _ROUNDED), np.inf)

    def _fitting(self, value: int, seen: np.ndarray, margin: float) -> tuple[np.ndarray, bool]:
        """The size that a format is for, and whether all of it is proven."""
        size, bound = margin * _beside_its_diagonal(seen), self._bound(value, seen)
        asked = margin * self._wider.get(value, np.zeros(()))
        proven = bool((bound <= size).all()) and not (asked > bound).any()
        return np.maximum(np.minimum(size, bound), asked), proven

    def widen(self, value: int, marks: np.ndarray, factor: float) -> None:
        """Make the elements that are marked larger than what the last formats were made for, by so much."""
        axes = tuple(a for a, n in enumerate(marks.shape) if n in self._shared)
        wider = marks.any(axis=axes, keepdims=True)
        size = np.where(wider, self._fits[value] * factor, 0.0)
        self._wider[value] = np.maximum(self._wider.get(value, 0.0), size)

    def forget(self) -> None:
        """Take back what was made wider."""
        self._wider.clear()

    def formats(
        self, width: int, margin: float = 2.0, held_width: int = 0, wider: Mapping[int, int] | None = None
    ) -> Formats:
        """Formats in which numbers fit that are `margin` times as large as any that was seen, or as large as
        any can be, where that is proven and less.

        Args:
            width: bits of a word.
            margin: as above.
            held_width: bits of inputs, registers and what is added up in them; 0: those of `width`.
            wider: bits of other values, where they are more.
        """
        fractions: dict[int, np.ndarray] = {}
        proven: set[int] = set()
        bits = dict(wider or {})
        bits |= dict.fromkeys(_held(self.pipeline) if held_width > width else (), held_width)
        errors = _Errors(self.pipeline, width, {n: w - WIDEST for n, w in bits.items() if w > WIDEST})
        for n in self.largest:
            if n in errors.given:
                wide, sure = self._fitting(n, np.asarray(self._size(n)), margin)
                proven |= {n} if sure else set()
                fractions[n] = fraction_for(wide, bits.get(n, width))
                errors.start(n, fractions[n], wide)
        for i in self.pipeline.instructions:
            found = self._size(i.out)
            if found is None:
                continue
            rounding = errors.of(i)
            axes = tuple(a for a, n in enumerate(i.spec.shape) if n in self._shared)
            rounding = rounding.max(axis=axes, keepdims=True, initial=0.0)
            size, sure = self._fitting(i.out, np.maximum(found, rounding), margin)
            proven |= {i.out} if sure else set()
            fractions[i.out] = fraction_for(size, bits.get(i.out, width))
            errors.add(i, fractions[i.out], size, rounding, np.where(rounding > found, rounding, 0.0))
        self._fits = {
            n: np.ldexp(0.5, bits.get(n, width) - 1 - f.astype(int)) / margin for n, f in fractions.items()
        }
        structure = structure_of(self.pipeline)
        absent = frozenset(self.absent)
        return Formats(width, fractions, margin, absent, structure, bits, frozenset(proven))


def _held(pipeline: Pipeline) -> frozenset[int]:
    """Inputs and registers, and the values that come into registers by sums, selections and moves alone."""
    specs = pipeline.specs
    cells = [c for r in pipeline.registers for c in r.cells if c.dtype == "real"]
    found = {c.read for c in cells} | {c.write for c in cells}
    found |= {leaf.value for port in pipeline.inputs for leaf in port.leaves if leaf.dtype == "real"}
    for i in reversed(pipeline.instructions):
        if i.out in found and (i.op in MOVES or i.op in _CARRYING):
            found.update(a for a in i.args if specs[a].dtype == "real")
        elif i.out in found and i.op == "divide":
            found.add(i.args[0])
    for i in pipeline.instructions:  # and what is added to them: an adder costs less than a multiplier
        if i.spec.dtype == "real" and i.op in _CARRYING | MOVES and any(a in found for a in i.args):
            found.add(i.out)
    return frozenset(found - set(pipeline.constants))


_CARRYING = frozenset(["add", "subtract", "where", "maximum", "minimum"])
"""What only adds or chooses; of a quotient, as by a norm, the numerator is carried as well."""


def _beside_its_diagonal(size: np.ndarray) -> np.ndarray:
    """The elements of a square matrix, no smaller than a small part of what its diagonal would let them be.

    In a covariance P_ij^2 <= P_ii P_jj, and where it is near zero it is what is left of larger numbers. Finer
    formats than this only tell the rounding of the diagonal.
    """
    if size.ndim < 2 or size.shape[-1] != size.shape[-2] or size.shape[-1] < 2:
        return size
    root = np.sqrt(np.diagonal(size, axis1=-2, axis2=-1))
    return np.asarray(np.maximum(size, _CORRELATION * root[..., :, None] * root[..., None, :]))


class _Errors:
    """Sizes and rounding errors of values, in the order in which they are computed.

    Attributes:
        given: the inputs and registers.
    """

    def __init__(self, pipeline: Pipeline, width: int, drop: Mapping[int, int]) -> None:
        self._specs: Mapping[int, Spec] = pipeline.specs
        self._width = width
        self._drop = dict(drop)
        self._size: dict[int, np.ndarray] = {}
        self._error: dict[int, np.ndarray] = {}
        self._fraction: dict[int, np.ndarray] = {}
        self._registers = {c.read for r in pipeline.registers for c in r.cells}
        self.given = self._registers | {x.value for port in pipeline.inputs for x in port.leaves}
        for n, array in pipeline.constants.items():
            if array.dtype.kind == "f":
                fraction = fraction_of_constant(array, width)
                self._keep(n, fraction, np.abs(array), 0.0)

    def _keep(self, n: int, fraction: np.ndarray, size: np.ndarray, error: Any, alone: Any = 0.0) -> None:
        shape = self._specs[n].shape
        last = np.where(fraction == FREE, 0.0, np.ldexp(1.0, -np.minimum(fraction, 1000).astype(int)))
        self._fraction[n] = np.broadcast_to(fraction, shape)
        self._size[n] = np.broadcast_to(size, shape)
        most = np.maximum(_MOST * last, alone)
        self._error[n] = np.broadcast_to(np.minimum(error + last, most), shape)

    def start(self, n: int, fraction: np.ndarray, size: np.ndarray) -> None:
        """A value that is given."""
        last = np.ldexp(1.0, -fraction.astype(int))
        self._keep(n, fraction, size, (_HELD - 1.0) * last if n in self._registers else 0.0)

    def add(
        self, i: Instruction, fraction: np.ndarray, size: np.ndarray, error: np.ndarray, alone: np.ndarray
    ) -> None:
        """A value that was computed, `alone` the error of what is nothing else; what is only moved keeps its
        formats."""
        if i.op in MOVES and all(a in self._fraction for a in i.args[:1]):
            given = [self._fraction.get(a) for a in i.args]
            if all(f is not None for f in given) or i.op == "take":
                self._drop[i.out] = max(self._drop.get(a, 0) for a in i.args)
                fraction = moved(i, given)
                last = np.ldexp(1.0, -np.minimum(fraction, 1000))
                self._keep(i.out, fraction, size, error - last, alone)
                return
        self._keep(i.out, fraction, size, error, alone)

    def of(self, i: Instruction) -> np.ndarray:
        """The error of a result from those of its arguments, of its shape; zero where none is known."""
        rule = _GROWTH.get(i.op)
        if i.op in MOVES and i.op != "take":
            rule = _moved
        if rule is None or any(a not in self._size for a in i.args):
            return np.zeros(i.spec.shape)
        site = Site(i, [], None, self._specs, self._width)
        sizes, errors = [self._size[a] for a in i.args], [self._read(a, i.op) for a in i.args]
        return np.asarray(np.broadcast_to(rule(site, sizes, errors), i.spec.shape))

    def _read(self, n: int, op: str) -> np.ndarray:
        """The error of an argument as an operation reads it."""
        drop = 0 if op in READ_WHOLE else self._drop.get(n, 0)
        if not drop:
            return self._error[n]
        f = self._fraction[n]
        upper = np.where(f == FREE, 0.0, np.ldexp(1.0, drop - np.minimum(f, 1000).astype(int)))
        return np.asarray(np.maximum(self._error[n], upper))


def _moved(s: Site, sizes: list[np.ndarray], errors: list[np.ndarray]) -> np.ndarray:
    op = s.i.op
    return errors[0] if op in ("negative", "abs", "positive", "materialise") else moved(s.i, list(errors))


def _product(s: Site, sizes: list[np.ndarray], errors: list[np.ndarray]) -> np.ndarray:
    return np.asarray(sizes[0] * errors[1] + errors[0] * sizes[1])


_GROWTH: dict[str, Callable[[Site, list[np.ndarray], list[np.ndarray]], Any]] = {
    "add": lambda s, x, e: e[0] + e[1],
    "subtract": lambda s, x, e: e[0] + e[1],
    "multiply": _product,
    "matmul": lambda s, x, e: x[0] @ e[1] + e[0] @ x[1],
    "vecdot": lambda s, x, e: (x[0] * e[1] + e[0] * x[1]).sum(axis=-1),
    "sum": lambda s, x, e: np.sum(
        e[0],
        axis=tuple(s.i.attrs["axis"]) if isinstance(s.i.attrs.get("axis"), list) else s.i.attrs.get("axis"),
        keepdims=bool(s.i.attrs.get("keepdims", False)),
    ),
}


def _parts(pipeline: Pipeline) -> Iterable[Any]:
    yield from (c for r in pipeline.registers for c in r.cells)
    yield from (x for port in (*pipeline.inputs, *pipeline.outputs) for x in port.leaves)
