"""Readings that are not there: which values may be none, and what operations make of them.

A reading that is NaN is a word of its own. What is computed from it is none as well, until a selection on
`isnan` puts a number in its place.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from flowgraph.engines.fixed.shifts import MOVES
from flowgraph.pipeline.formats import NOT_A_NUMBER
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.recorder.trace import Instruction

Run = Callable[..., Any]


def keeping_nan(run: Run) -> Run:
    return lambda x: np.where(x == NOT_A_NUMBER, NOT_A_NUMBER, run(x))


_COMPARE = frozenset(["equal", "not_equal", "less", "less_equal", "greater", "greater_equal"])
_ASK = frozenset(("isnan", "isfinite"))


def may_be_nan(instructions: Sequence[Instruction], given: Collection[int]) -> set[int]:
    """The values that may be no numbers when those in `given` may be.

    `where(isnan(x), c, x)` is a number again, and so is what compares.
    """
    found = set(given)
    asks: dict[
        int, tuple[int, bool]
    ] = {}  # a truth value -> the value it asks about, and whether true is a number
    for i in instructions:
        if i.op in _ASK:
            asks[i.out] = (i.args[0], i.op == "isfinite")
        elif i.op in ("logical_not", "bitwise_invert") and i.args[0] in asks:
            value, number = asks[i.args[0]]
            asks[i.out] = (value, not number)
        elif i.op == "where":
            value, number = asks.get(i.args[0], (-1, True))
            taken, other = (i.args[1], i.args[2]) if number else (i.args[2], i.args[1])
            if other in found or (taken in found and taken != value):
                found.add(i.out)
        elif i.spec.dtype == "real" and any(a in found for a in i.args):
            found.add(i.out)
    return found


def passing_nan(i: Instruction, run: Run) -> Run:
    """The same where arguments may be NaN: what depends on one is none, and compares as none does."""
    if i.op in _ASK or i.op == "where" or i.op in MOVES:
        return run
    op, attrs = OPS[i.op].run, bound_attrs(i.op, i.attrs, np.dtype(np.float64))

    def carried(*xs: Any) -> Any:
        lost = [np.asarray(x) == NOT_A_NUMBER for x in xs]
        if not any(n.any() for n in lost):
            return run(*xs)
        made = run(*[np.where(n, 0, x) for n, x in zip(lost, xs, strict=True)])
        if i.op in _COMPARE:
            return np.where(np.logical_or(*np.broadcast_arrays(*lost)), i.op == "not_equal", made)
        traces = op(NUMPY, *[np.where(n, np.nan, 0.0) for n in lost], **attrs)
        return np.where(np.isnan(traces), NOT_A_NUMBER, made)

    return carried
