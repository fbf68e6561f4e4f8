"""What can be proved of the size of values: intervals that hold for every flight, whatever the inputs.

Sines, probabilities, what is divided by its own norm or sum, indices and what is made of them are bounded by
what they are. A register is bounded where the bound survives a tick: it is assumed of all, and dropped
where what is written may be outside, until nothing is dropped any more. Inputs have no bound.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from flowgraph.engines.fixed.shifts import MOVES, axes_of, moved
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, SINC, Spec
from flowgraph.recorder.trace import Instruction
from flowgraph.types import DTYPES

Interval = tuple[np.ndarray, np.ndarray]
"""The least and the most that each element of a value may be."""

_LEAST_SINC = -0.2172336282112217


def proven_sizes(pipeline: Pipeline, varying: Collection[int] = ()) -> dict[int, np.ndarray]:
    """The size that no element of a real value exceeds, of the value's shape; infinite where none is known.

    Args:
        pipeline: in plain instructions. Its registers start at their reset or between it and -1 or 1.
        varying: constants that are others on other flights, of which nothing is known.
    """
    cells = [c for r in pipeline.registers for c in r.cells if c.dtype == "real"]
    tries = {c.read: _candidates(np.asarray(c.reset, dtype=np.float64)) for c in cells}
    while True:
        found = _Intervals(pipeline, {n: some[0] for n, some in tries.items()}, varying)
        kept = True
        for c in cells:
            low, high = tries[c.read][0]
            least, most = found[c.write]
            if len(tries[c.read]) > 1 and not ((least >= low).all() and (most <= high).all()):
                tries[c.read].pop(0)
                kept = False
        if kept:
            return {
                n: np.maximum(np.abs(low), np.abs(high))
                for n, (low, high) in found.known.items()
                if pipeline.specs[n].dtype == "real"
            }


def _candidates(reset: np.ndarray) -> list[Interval]:
    """What may be true of a register from one tick to the next, the most first and nothing last."""
    infinite = np.full(reset.shape, math.inf)
    some = [(np.minimum(reset, -1.0), np.maximum(reset, 1.0))]
    if (reset <= 0.0).all():
        some.append((-infinite, 0.0 * reset))
    if (reset >= 0.0).all():
        some.append((0.0 * reset, infinite))
    return [*some, (-infinite, infinite)]


class _Intervals:
    """The intervals of all values of a pipeline, given those of its registers."""

    def __init__(
        self, pipeline: Pipeline, registers: Mapping[int, Interval], varying: Collection[int]
    ) -> None:
        self._specs = pipeline.specs
        self._made: dict[int, Instruction] = {}
        self.known: dict[int, Interval] = dict(registers)
        for n, a in pipeline.constants.items():
            if a.dtype.kind != "b" and n not in varying:
                self.known[n] = (a.astype(np.float64),) * 2
        with np.errstate(all="ignore"):
            for i in pipeline.instructions:
                self._made[i.out] = i
                low, high = self._of(i)
                unknown = np.isnan(low) | np.isnan(high)
                low, high = np.where(unknown, -math.inf, low), np.where(unknown, math.inf, high)
                low, high = (np.broadcast_to(x, i.spec.shape) for x in (low, high))
                first, last = _everything(i.spec)
                wraps = (low < first) | (high > last)
                self.known[i.out] = np.where(wraps, first, low), np.where(wraps, last, high)

    def __getitem__(self, n: int) -> Interval:
        return self.known.get(n) or _everything(self._specs[n])

    def _of(self, i: Instruction) -> Interval:
        args = [self[a] for a in i.args]
        if i.op == "subtract" and self._covers(i.args[1], i.args[0]):
            low, high = _RULES["subtract"](i, args)
            return low, np.minimum(high, 0.0)
        if i.op == "divide" and (part := self._part(i)) is not None:
            return part
        if i.op == "multiply" and i.args[0] == i.args[1]:
            return _square(args[0])
        if i.op == "vecdot" and i.args[0] == i.args[1]:
            low, high = _square(args[0])
            return low.sum(axis=-1), high.sum(axis=-1)
        if i.op == "sum" and self._has_a_one(i.args[0]):
            low, high = _RULES["sum"](i, args)
            return np.maximum(low, 1.0), high
        if i.op == "where":
            args = args[1:]
        rule = _RULES.get(i.op)
        return _everything(i.spec) if rule is None else rule(i, args)

    def _root(self, n: int) -> int:
        """The value of which this is another shape."""
        while (i := self._made.get(n)) is not None and i.op in ("reshape", "broadcast_to", "materialise"):
            n = i.args[0]
        return n

    def _covers(self, n: int, x: int) -> bool:
        """Whether a value is the largest element of x, or that and more."""
        i = self._made.get(self._root(n))
        if i is None:
            return False
        if i.op == "max":
            whole = i.attrs.get("axis") is None or len(self._specs[i.args[0]].shape) == 1
            return whole and self._root(i.args[0]) == self._root(x)
        if i.op == "add":
            a, b = i.args
            return (self._covers(a, x) and bool((self[b][0] >= 0.0).all())) or (
                self._covers(b, x) and bool((self[a][0] >= 0.0).all())
            )
        return False

    def _has_a_one(self, n: int) -> bool:
        """Whether all elements are exp(x - max(x)): one is 1, and none negative."""
        i = self._made.get(n)
        if i is None or i.op != "exp":
            return False
        before = self._made.get(i.args[0])
        if before is None or before.op != "subtract":
            return False
        largest = self._made.get(self._root(before.args[1]))
        return largest is not None and largest.op == "max" and self._covers(before.args[1], before.args[0])

    def _part(self, i: Instruction) -> Interval | None:
        """The interval of x / |x|, and of x / sum(x) where x is not negative."""
        shape, x = i.spec.shape, self._root(i.args[0])
        under = self._made.get(self._root(i.args[1]))
        if under is None:
            return None
        if under.op == "sqrt":
            total = self._made.get(self._root(under.args[0]))
            if total is not None and total.op == "vecdot" and {self._root(a) for a in total.args} == {x}:
                return np.full(shape, -1.0), np.ones(shape)
            squares = self._made.get(total.args[0]) if total is not None and total.op == "sum" else None
            if squares is not None and squares.op == "multiply" and {*map(self._root, squares.args)} == {x}:
                return np.full(shape, -1.0), np.ones(shape)
        if under.op == "sum" and self._root(under.args[0]) == x and (self[x][0] >= 0.0).all():
            return np.zeros(shape), np.ones(shape)
        return None


def _everything(spec: Spec) -> Interval:
    """The interval of a value of which nothing is known but its kind."""
    kind: np.dtype[Any] = np.dtype(DTYPES[spec.dtype])
    low, high = -math.inf, math.inf
    if kind.kind == "b":
        low, high = 0.0, 1.0
    elif kind.kind in "iu":
        low, high = float(np.iinfo(kind).min), float(np.iinfo(kind).max)
    return np.full(spec.shape, low), np.full(spec.shape, high)


def _square(x: Interval) -> Interval:
    a, b = x[0] * x[0], x[1] * x[1]
    return np.where((x[0] <= 0.0) & (x[1] >= 0.0), 0.0, np.minimum(a, b)), np.maximum(a, b)


def _times(x: Interval, y: Interval) -> Interval:
    """Zero times what has no bound is zero: no value is infinite."""
    ends = [np.nan_to_num(a * b, nan=0.0, posinf=math.inf, neginf=-math.inf) for a in x for b in y]
    return np.minimum.reduce(ends), np.maximum.reduce(ends)


def _product(i: Instruction, x: list[Interval]) -> Interval:
    return _times(*x)


def _matmul(i: Instruction, x: list[Interval]) -> Interval:
    (a, b), (c, d) = x
    if a.ndim == 1:
        a, b = a[None], b[None]
    if c.ndim == 1:
        c, d = c[:, None], d[:, None]
    terms = _times((a[..., :, :, None], b[..., :, :, None]), (c[..., None, :, :], d[..., None, :, :]))
    low, high = (t.sum(axis=-2).reshape(i.spec.shape) for t in terms)
    return low, high


def _vecdot(i: Instruction, x: list[Interval]) -> Interval:
    low, high = _times(*x)
    return low.sum(axis=-1), high.sum(axis=-1)


def _divide(i: Instruction, x: list[Interval]) -> Interval:
    (a, b), (c, d) = x
    clear = (c > 0.0) | (d < 0.0)
    low, high = _times((a, b), (np.where(clear, 1.0 / d, -math.inf), np.where(clear, 1.0 / c, math.inf)))
    return low, high


def _rising(function: Callable[..., np.ndarray]) -> Callable[[Instruction, list[Interval]], Interval]:
    """Of what grows with its argument."""
    return lambda i, x: (function(x[0][0]), function(x[0][1]))


def _along(name: str) -> Callable[[Instruction, list[Interval]], Interval]:
    def found(i: Instruction, x: list[Interval]) -> Interval:
        axes = axes_of(i)(x[0][0].ndim)
        keep = bool(i.attrs.get("keepdims", False))
        run = getattr(np, name)
        return run(x[0][0], axis=axes, keepdims=keep), run(x[0][1], axis=axes, keepdims=keep)

    return found


def _moves(i: Instruction, x: list[Interval]) -> Interval:
    if i.op == "take":
        axis = i.attrs["axis"] % x[0][0].ndim
        least, most = x[0][0].min(axis=axis, keepdims=True), x[0][1].max(axis=axis, keepdims=True)
        return moved(i, [least]), moved(i, [most])
    run = OPS[i.op].run
    return run(NUMPY, *[a for a, _ in x], **i.attrs), run(NUMPY, *[b for _, b in x], **i.attrs)


def _within(low: float, high: float) -> Callable[[Instruction, list[Interval]], Interval]:
    return lambda i, x: (np.full(i.spec.shape, low), np.full(i.spec.shape, high))


def _abs(i: Instruction, x: list[Interval]) -> Interval:
    a, b = x[0]
    size = np.maximum(np.abs(a), np.abs(b))
    return np.where((a <= 0.0) & (b >= 0.0), 0.0, np.minimum(np.abs(a), np.abs(b))), size


def _copysign(i: Instruction, x: list[Interval]) -> Interval:
    size = _abs(i, x)[1]
    return -size, size


def _shifted(i: Instruction, x: list[Interval]) -> Interval:
    (a, b), (c, d) = x
    if (c != d).any() or (a < 0).any():
        return _everything(i.spec)
    return np.floor(np.ldexp(a, -c.astype(int))), np.floor(np.ldexp(b, -c.astype(int)))


def _masked(i: Instruction, x: list[Interval]) -> Interval:
    """Bitwise and: no more than either where none is negative."""
    (a, b), (c, d) = x
    if (a < 0).any() or (c < 0).any():
        return _everything(i.spec)
    return np.zeros(i.spec.shape), np.minimum(b, d)


_RULES: Mapping[str, Callable[[Instruction, list[Interval]], Interval]] = {
    **dict.fromkeys(MOVES - {"negative", "abs"}, _moves),
    "negative": lambda i, x: (-x[0][1], -x[0][0]),
    "abs": _abs,
    "add": lambda i, x: (x[0][0] + x[1][0], x[0][1] + x[1][1]),
    "subtract": lambda i, x: (x[0][0] - x[1][1], x[0][1] - x[1][0]),
    "multiply": _product,
    "matmul": _matmul,
    "vecdot": _vecdot,
    "divide": _divide,
    "where": lambda i, x: (np.minimum(x[0][0], x[1][0]), np.maximum(x[0][1], x[1][1])),
    "maximum": lambda i, x: (np.maximum(x[0][0], x[1][0]), np.maximum(x[0][1], x[1][1])),
    "minimum": lambda i, x: (np.minimum(x[0][0], x[1][0]), np.minimum(x[0][1], x[1][1])),
    "sqrt": lambda i, x: (np.sqrt(np.maximum(x[0][0], 0.0)), np.sqrt(np.maximum(x[0][1], 0.0))),
    "exp": _rising(np.exp),
    "log": lambda i, x: (np.log(np.maximum(x[0][0], 0.0)), np.log(np.maximum(x[0][1], 0.0))),
    "floor": _rising(np.floor),
    "ceil": _rising(np.ceil),
    "trunc": _rising(np.trunc),
    "round": _rising(np.round),
    "astype": lambda i, x: x[0],
    "sin": _within(-1.0, 1.0),
    "cos": _within(-1.0, 1.0),
    SINC: _within(_LEAST_SINC, 1.0),
    "sign": _within(-1.0, 1.0),
    "atan2": _within(-math.pi, math.pi),
    "copysign": _copysign,
    "sum": _along("sum"),
    "max": _along("max"),
    "min": _along("min"),
    "bitwise_right_shift": _shifted,
    "bitwise_and": _masked,
}
