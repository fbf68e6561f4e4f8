"""The array API of `jax.numpy` as pipelines need it: their own operations, and what they define further."""

from __future__ import annotations

import operator
from collections.abc import Callable
from functools import partial, reduce
from typing import Any

import numpy as np

from flowgraph.pipeline.optimise.rows import LEAST_LANES
from flowgraph.recorder import ranges
from flowgraph.recorder.namespaces import unnormalized_sinc
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.recorder.replay import Case, body_of

_SHORT = 16
_MANY = 2048
"""A reduction over so few of so many goes slice by slice."""


class JaxLinearAlgebra:
    """`jax.numpy.linalg`, where a singular matrix gives NaN throughout, as in the other engines."""

    def __init__(self, jax: Any) -> None:
        self._jax = jax

    def cholesky(self, x: Any) -> Any:
        jnp = self._jax.numpy
        lower = jnp.linalg.cholesky(x)
        last = lower[..., -1:, -1:]  # NaN where a pivot was not positive
        return jnp.where(jnp.isnan(last), last, lower)

    def solve(self, a: Any, b: Any) -> Any:
        jnp = self._jax.numpy
        x = jnp.linalg.solve(a, b)
        axes = -1 if b.ndim == 1 else (-2, -1)
        fits = jnp.isfinite(a).all(axis=(-2, -1)) & jnp.isfinite(b).all(axis=axes)
        singular = fits & ~jnp.isfinite(x).all(axis=axes)
        return jnp.where(singular[..., None] if b.ndim == 1 else singular[..., None, None], jnp.nan, x)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._jax.numpy.linalg, name)


class JaxNamespace:
    """`jax.numpy` with what pipelines add to it or define further, and a faster `take` and short reductions.

    Args:
        jax: the module.
        true: what is so, but XLA cannot know, where branches are cheap; None elsewhere.

    A reduction over a short axis of a large array, such as the sum of the squares of three numbers for each
    particle, is written as operations on slices, in the order of the axis. These XLA computes in one loop
    with what is around them; a reduction, on a processor, is a call that keeps the loops around it apart.
    """

    def __init__(self, jax: Any, true: Any = None) -> None:
        self._jax, self._true = jax, true
        self.linalg = JaxLinearAlgebra(jax)

    def float32_bits(self, x: Any) -> Any:
        jnp = self._jax.numpy
        return self._jax.lax.bitcast_convert_type(x.astype(jnp.float32), jnp.int32)

    def unnormalized_sinc(self, x: Any) -> Any:
        return unnormalized_sinc(x, self._jax.numpy)

    def solve_positive(self, a: Any, b: Any) -> Any:
        return self.linalg.solve(a, b)

    def floor_divide(self, a: Any, b: Any) -> Any:
        return ranges.floor_divide(self._jax.numpy, a, b)

    def remainder(self, a: Any, b: Any) -> Any:
        return ranges.remainder(self._jax.numpy, a, b)

    def sum(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("sum", operator.add, x, axis, keepdims, real=True)

    def prod(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("prod", operator.mul, x, axis, keepdims, real=True)

    def maximum(self, a: Any, b: Any) -> Any:
        jnp = self._jax.numpy
        return self._or_nan(jnp.maximum(a, b), jnp.isnan(a) | jnp.isnan(b))

    def minimum(self, a: Any, b: Any) -> Any:
        jnp = self._jax.numpy
        return self._or_nan(jnp.minimum(a, b), jnp.isnan(a) | jnp.isnan(b))

    def _or_nan(self, extreme: Any, missing: Any) -> Any:
        """NaN where a number is missing: of a large array XLA leaves extremes, and sums of them, to a library
        that passes over it (YNNPACK, with JAX 0.10 on a processor)."""
        jnp = self._jax.numpy
        return jnp.where(missing, jnp.nan, extreme) if extreme.dtype.kind == "f" else extreme

    def max(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("max", self.maximum, x, axis, keepdims)

    def min(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("min", self.minimum, x, axis, keepdims)

    def any(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("any", self._jax.numpy.logical_or, x, axis, keepdims)

    def all(self, x: Any, *, axis: Any = None, keepdims: bool = False) -> Any:
        return self._reduced("all", self._jax.numpy.logical_and, x, axis, keepdims)

    def _reduced(
        self, name: str, fold: Callable[..., Any], x: Any, axis: Any, keepdims: bool, real: bool = False
    ) -> Any:
        """A reduction by `jax.numpy`, or slice by slice: with `real` of reals only."""
        jnp = self._jax.numpy
        x = jnp.asarray(x)
        few = isinstance(axis, int) and 2 <= x.shape[axis] <= _SHORT and x.size // x.shape[axis] >= _MANY
        if not few or (real and x.dtype.kind != "f"):
            whole = getattr(jnp, name)(x, axis=axis, keepdims=keepdims)
            if name not in ("max", "min"):
                return whole
            return self._or_nan(whole, jnp.isnan(x).any(axis=axis, keepdims=keepdims))
        parts = [self._jax.lax.index_in_dim(x, k, axis, keepdims) for k in range(x.shape[axis])]
        return reduce(fold, parts)

    def materialise(self, x: Any) -> Any:
        """Past a barrier XLA on a processor still computes twice what is used twice; past a branch not."""
        lax, jnp = self._jax.lax, self._jax.numpy
        if self._true is None or x.size < LEAST_LANES:
            return lax.optimization_barrier(x)
        return lax.cond(self._true, lambda y: y, jnp.zeros_like, x)

    def take(self, x: Any, indices: Any, *, axis: int = 0, mode: str = "clip") -> Any:
        """`jnp.take`, along the last axis from a flat array.

        For a gather of columns XLA lays the whole array out column by column, and as a scan carries it, every
        tick that does not gather then pays for the change to and fro.
        """
        jnp = self._jax.numpy
        x = jnp.asarray(x)
        if x.ndim == 1 or axis % x.ndim != x.ndim - 1 or not x.size:
            return jnp.take(x, indices, axis=axis, mode=mode)
        n = x.shape[-1]
        starts = np.arange(0, x.size, n, dtype=np.int32 if x.size < 2**31 else np.int64)
        column = jnp.clip(jnp.asarray(indices), 0, n - 1).astype(starts.dtype)
        at = starts.reshape(*x.shape[:-1], *(1,) * column.ndim) + column
        return jnp.take(x.reshape(-1), at, axis=0, mode=mode)

    def replay(self, history: Any, rows: Any, first: Any, count: Any, *, body: Any) -> Any:
        """The history (N, k) after `count` turns from place `first` of the ring on."""
        lax, jnp = self._jax.lax, self._jax.numpy
        places, cases = history.shape[0], [partial(self._turn, case) for case in body_of(body).cases]
        first, count = jnp.mod(first, places), jnp.clip(count, 0, places)

        def turn(k: Any, now: Any) -> Any:
            at = jnp.mod(first + k, places)
            before, row = now[jnp.mod(at - 1, places)], rows[at]
            if len(cases) == 1:
                after = cases[0](before, row)
            else:
                which = jnp.clip(row[0].astype(jnp.int32), 0, len(cases) - 1)
                after = lax.switch(which, cases, before, row)
            return lax.dynamic_update_index_in_dim(now, after, at, 0)

        return lax.fori_loop(jnp.int32(0), count.astype(jnp.int32), turn, history)

    def _turn(self, case: Case, before: Any, row: Any) -> Any:
        jnp, real = self._jax.numpy, before.dtype
        values: dict[int, Any] = {0: before, 1: row}
        for n, array in case.constants.items():
            values[n] = jnp.asarray(array.astype(real) if array.dtype.kind == "f" else array)
        for t in case.turns:
            args = (values[a] for a in t.args)
            values[t.out] = OPS[t.op].run(self, *args, **bound_attrs(t.op, t.attrs, real))
        return values[case.result]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._jax.numpy, name)
