"""Random steps over arrays, as of a cloud of particles: rows of N numbers, matrices of three, and scalars.

Streams of scalars are drawn elsewhere; what loops over particles, strips and searches can get wrong needs
values of all lanes and single ones of them, read before and after a register is written.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import Array, Graph, Scalar, Series, Signal, Stream, aperiodic, block, graph, real

GIVEN = {"x": Series(np.arange(3) * 10, np.array([0.3, -1.0, 0.7]))}
"""Three ticks: more would let a difference of rounding grow to a different choice."""


@dataclass
class Pools:
    """What a step has so far, by kind, and the random numbers of the operation at hand.

    `row()`, `scalar()` and `matrix()` take one that was made; `whole(n)` is a number below n.
    """

    size: int
    rows: list[Any]
    scalars: list[Any]
    matrices: list[Any]
    random: np.random.Generator

    def whole(self, below: int) -> int:
        return int(self.random.integers(below))

    def _one(self, pool: Sequence[Any]) -> Any:
        # late ones rather than early ones, or most of what is made would be read by nobody
        return pool[max(self.whole(len(pool)), self.whole(len(pool)))]

    def row(self) -> Any:
        return self._one(self.rows)

    def scalar(self) -> Any:
        return self._one(self.scalars)

    def matrix(self) -> Any:
        return self._one(self.matrices)


def _elementwise(p: Pools, xp: Any) -> None:
    a, b = p.row(), p.row()
    ways: list[Callable[[], Any]] = [
        lambda: a + b, lambda: a * b, lambda: a / (1.0 + b * b), lambda: xp.maximum(a, b),
        lambda: a * p.scalar(), lambda: xp.where(a > 0.1, a, b), lambda: xp.exp(-a * a),
        lambda: xp.where(p.scalar() > 0.0, xp.sin(a), b),
    ]  # fmt: skip
    p.rows.append(xp.clip(ways[p.whole(len(ways))](), -10.0, 10.0))


def _searched(p: Pools, xp: Any) -> None:
    steps = xp.cumulative_sum(1e-3 + xp.abs(p.row()), axis=0)
    found = xp.searchsorted(steps, 3.0 * p.row(), side=("left", "right")[p.whole(2)])
    p.rows.append(xp.astype(found, xp.float64) / p.size)
    p.rows.append(xp.take(p.row(), xp.minimum(found, p.size - 1), axis=0))


def _sorted(p: Pools, xp: Any) -> None:
    p.rows.append(xp.sort(p.row()))


def _summed(p: Pools, xp: Any) -> None:
    p.scalars.append(xp.sin(xp.sum(p.row() * p.row())))
    p.scalars.append((xp.max, xp.min)[p.whole(2)](p.row()))


def _single(p: Pools, xp: Any) -> None:
    p.scalars.append(p.row()[(0, p.size - 1, p.whole(p.size))[p.whole(3)]])


def _pieces(p: Pools, xp: Any) -> None:
    at = 1 + p.whole(p.size - 1)
    a, b = p.row(), p.row()
    p.rows.append(xp.concat([b[at:], a[:at]], axis=0))


def _gathered(p: Pools, xp: Any) -> None:
    p.rows.append(xp.take(p.row(), xp.asarray(p.random.integers(0, p.size, p.size)), axis=0))
    p.scalars.append(xp.take(p.row(), xp.argmax(p.row()), axis=0))


def _turned(p: Pools, xp: Any) -> None:
    p.matrices.append(xp.tanh(xp.asarray(p.random.uniform(-1.0, 1.0, (3, 3))) @ p.matrix()))
    p.rows.append(p.matrix()[p.whole(3)])
    p.rows.append(xp.sin(xp.sum(p.matrix() * p.matrix(), axis=0)))


def _stacked(p: Pools, xp: Any) -> None:
    p.matrices.append(xp.stack([p.row(), p.row(), p.row()], axis=0))


def _covariance(p: Pools, xp: Any) -> None:
    tall = xp.concat([p.matrix(), p.matrix()[:2], p.row()[None]], axis=0)
    product = (tall * p.row()) @ tall.mT / p.size
    p.scalars.append(xp.sin(product[p.whole(6), p.whole(6)]))
    if p.whole(2):
        p.scalars.append(tall[p.whole(6), p.whole(p.size)])
        p.rows.append(tall[p.whole(6)])


OPERATIONS = (
    _elementwise, _elementwise, _elementwise, _searched, _sorted, _summed, _single, _single, _pieces,
    _gathered, _turned, _stacked, _covariance,
)  # fmt: skip


def cloud(seed: int, size: int) -> Graph:
    """A graph of one block with a state of `size` lanes, whose step is drawn."""

    class Cloud(Signal):
        a: Array = real(size)
        b: Array = real(size)
        m: Array = real(3, size)
        s: Array = real()

    class Seen(Signal):
        row: Array = real(size)
        number: Array = real()
        some: Array = real(4)

    @block
    def step(state: Cloud, x: Scalar, *, xp: Any) -> tuple[Cloud, Seen]:
        random = np.random.default_rng(seed)
        made = [state.a, state.b, xp.asarray(np.linspace(-1.0, 2.0, size)) + x]
        p = Pools(size, made, [x, state.s], [state.m], random)
        for k in random.integers(0, len(OPERATIONS), random.integers(3, 14)):
            OPERATIONS[k](p, xp)
        after = Cloud(a=p.row(), b=p.row(), m=p.matrix(), s=p.scalar())
        held = state.a[p.whole(size)]  # of before, beside those of after
        some = xp.stack([after.a[p.whole(size)], after.b[size - 1], after.m[1][p.whole(size)], held])
        return after, Seen(row=p.row(), number=p.scalar(), some=some)

    @step.init
    def start(x: Scalar) -> Cloud:
        random = np.random.default_rng(seed + 7)
        a, b, m = (random.normal(size=shape) for shape in (size, size, (3, size)))
        return Cloud(a=a, b=b, m=m, s=np.float64(0.3))

    @graph
    def drawn(x: Stream[Scalar]) -> Any:
        return step(x)

    made: Graph = drawn.build(x=aperiodic())
    return made
