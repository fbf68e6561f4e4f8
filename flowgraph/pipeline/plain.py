"""Plain instructions: factorizations and powers written out in sums, products, quotients and roots.

An array engine is best served by `solve` as one operation. A machine that has adders and multipliers alone
needs its steps, and whoever asks what range a number has needs them as values. `plain` writes them out: the
same pipeline, whose new values follow the old ones in number, for any engine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.pipeline.pipeline import Pipeline, Stage
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.trace import Instruction, Trace

_LARGEST_POWER = 16


def plain(pipeline: Pipeline) -> Pipeline:
    """The same pipeline without `solve`, `cholesky`, `pow`, `mean`, `cross`, `outer` and `square`.

    Raises:
        LoweringError: for a power whose exponent is no small whole number, by line.
    """
    specs = pipeline.specs
    trace = _After(max(specs, default=-1) + 1)
    stages = tuple(_rewritten(stage, trace, specs, pipeline.constants) for stage in pipeline.stages)
    return replace(pipeline, stages=stages, constants={**pipeline.constants, **trace.constants})


class _After(Trace):
    """A trace whose values are numbered behind those that are there."""

    def __init__(self, first: int) -> None:
        super().__init__()
        self._count = first


def _rewritten(
    stage: Stage, trace: _After, specs: Mapping[int, Spec], constants: Mapping[int, np.ndarray]
) -> Stage:
    listed: list[Instruction] = []
    for i in stage.instructions:
        write = _WRITTEN_OUT.get(i.op)
        if write is None:
            listed.append(i)
            continue
        trace.instructions.clear()
        args = [Symbolic(trace, a, specs[a]) for a in i.args]
        known = [constants.get(a) for a in i.args]
        value = write(trace.namespace, i, args, known)
        steps = [replace(step, line=i.line) for step in trace.instructions]
        if not steps:  # a matrix without rows, or a power of one: the value itself
            steps = [Instruction("materialise", (value.number,), {}, i.out, i.spec, i.line)]
        elif steps[-1].out == value.number:
            steps[-1] = replace(steps[-1], out=i.out)
        else:
            steps.append(Instruction("materialise", (value.number,), {}, i.out, i.spec, i.line))
        listed += steps
    return replace(stage, instructions=tuple(listed))


def _solve(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    """Triangles where the matrix is assumed to be positive; else elimination with exchange of rows."""
    a, b = args
    vector = len(b.shape) == 1
    right = b[:, None] if vector else b
    n = a.shape[-1]
    batch = np.broadcast_shapes(a.shape[:-2], right.shape[:-2])
    a = xp.broadcast_to(a, (*batch, n, n))
    right = xp.broadcast_to(right, (*batch, *right.shape[-2:]))
    x = _by_triangles(xp, a, right) if i.attrs.get("assume_a") == "pos" else _by_pivots(xp, a, right)
    return x[..., 0] if vector else x


def _by_triangles(xp: Any, a: Any, right: Any) -> Any:
    """A symmetric positive matrix as L D L^T, of which each entry is one sum, and no rows are exchanged.

    Source: Golub and Van Loan, Matrix Computations, sec. 4.1.2.
    """
    n = a.shape[-1]
    below: list[Any] = []  # by column of L, what is under its diagonal, before and after the division
    lower: list[Any] = []
    pivots, y = [], right
    for k in range(n):
        column = a[..., k:, k]
        if k:
            row = xp.stack([c[..., k - j - 1] for j, c in enumerate(below)], axis=-1)
            rest = xp.stack([c[..., k - j - 1 :] for j, c in enumerate(lower)], axis=-1)
            column = column - (rest @ row[..., None])[..., 0]
            own = right[..., k, :] - (rest[..., :1, :] @ y)[..., 0, :]
        else:
            own = right[..., 0, :]
        y = xp.concat([y, own[..., None, :]], axis=-2) if k else own[..., None, :]
        pivots.append(column[..., :1])
        if k + 1 < n:
            below.append(column[..., 1:])
            lower.append(column[..., 1:] / pivots[k])
    x = y[..., n - 1 :, :] / pivots[-1][..., None]
    for k in reversed(range(n - 1)):
        own = y[..., k : k + 1, :] / pivots[k][..., None] - lower[k][..., None, :] @ x
        x = xp.concat([own, x], axis=-2)
    return x


def _by_pivots(xp: Any, a: Any, right: Any) -> Any:
    """Gauss-Jordan elimination with the largest pivot of each column."""
    n = a.shape[-1]
    m = xp.concat([a, right], axis=-1)
    rows = np.arange(n)
    for k in range(n):
        best = xp.argmax(xp.abs(m[..., k:, k]), axis=-1) + k
        chosen = (best[..., None] == rows)[..., None]
        pivot_row = xp.sum(xp.where(chosen, m, 0.0), axis=-2)
        m = xp.where(chosen, m[..., k, None, :], m)
        row = pivot_row / pivot_row[..., k, None]
        here = (rows == k)[:, None]
        factor = xp.where(here, 0.0, m[..., :, k, None])
        m = xp.where(here, row[..., None, :], m - factor * row[..., None, :])
    return m[..., n:]


def _cholesky(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    """Column by column (Golub and Van Loan, Matrix Computations, algorithm 4.2.1)."""
    a = args[0]
    n = a.shape[-1]
    columns: list[Any] = []
    for j in range(n):
        rest = a[..., j:, j]
        if columns:
            before = xp.stack([c[..., j:] for c in columns], axis=-1)
            rest = rest - xp.sum(before * before[..., :1, :], axis=-1)
        column = rest / xp.sqrt(rest[..., :1])
        above = np.zeros((*a.shape[:-2], j))
        columns.append(xp.concat([above, column], axis=-1) if j else column)
    return xp.stack(columns, axis=-1)


def _pow(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    base, exponent = args[0], known[1]
    whole = None if exponent is None or exponent.size != 1 else float(exponent.ravel()[0])
    if whole is None or whole != int(whole) or not 1 <= whole <= _LARGEST_POWER:
        raise LoweringError(
            "this power has no plain form",
            path=i.line,
            expected=f"a whole number from 1 to {_LARGEST_POWER} as exponent",
            got="a value" if whole is None else f"{whole:g}",
            fix="write it with exp and log, sqrt, or as a product",
        )
    value = base
    for _ in range(int(whole) - 1):
        value = value * base
    return xp.broadcast_to(value, i.spec.shape) if value.shape != i.spec.shape else value


def _mean(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    total = xp.sum(args[0], **i.attrs)
    return total * (total.size / args[0].size)


def _cross(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    a, b = args
    x, y, z = (a[..., n] for n in range(3))
    u, v, w = (b[..., n] for n in range(3))
    return xp.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def _outer(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    return args[0][:, None] * args[1]


def _square(xp: Any, i: Instruction, args: list[Any], known: list[Any]) -> Any:
    return args[0] * args[0]


_WRITTEN_OUT: dict[str, Callable[[Any, Instruction, list[Any], list[Any]], Any]] = {
    "solve": _solve,
    "cholesky": _cholesky,
    "pow": _pow,
    "mean": _mean,
    "cross": _cross,
    "outer": _outer,
    "square": _square,
}
