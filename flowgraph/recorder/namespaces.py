"""NumPy as the engines use it: the array API, and the operations that pipelines add to it."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np

from flowgraph.recorder import ranges

_LAPACK: Any = getattr(np.linalg, "_umath_linalg", None)
"""What the functions of `numpy.linalg` call, whose wrappers take more time than a small matrix does. It is no
part of NumPy's interface: where it is missing, the wrappers are called."""

_DOUBLE = np.dtype(np.float64)


def _direct(x: Any) -> bool:
    """Whether LAPACK can be called without the wrapper, which would do nothing but hand this on."""
    return _LAPACK is not None and type(x) is np.ndarray and x.dtype == _DOUBLE


class _LinearAlgebra:
    """`numpy.linalg`, where a singular matrix gives NaN; `vecdot` is the ufunc itself, not its wrapper."""

    vecdot = staticmethod(np.vecdot)

    @staticmethod
    def cholesky(x: Any, /) -> Any:
        """`numpy.linalg.cholesky`; NaN where a matrix is not positive definite."""
        if _direct(x):
            with np.errstate(all="ignore"):
                return _LAPACK.cholesky_lo(x)
        try:
            return np.linalg.cholesky(x)
        except np.linalg.LinAlgError:
            return _one_by_one(np.linalg.cholesky, np.shape(x), x)

    @staticmethod
    def solve(a: Any, b: Any, /) -> Any:
        """`numpy.linalg.solve`; NaN where a matrix is singular."""
        if _direct(a) and _direct(b):
            with np.errstate(all="ignore"):
                return (_LAPACK.solve1 if b.ndim == 1 else _LAPACK.solve)(a, b)
        try:
            return np.linalg.solve(a, b)
        except np.linalg.LinAlgError:
            if np.ndim(b) == 1:
                return _LinearAlgebra.solve(a, np.asarray(b)[:, None])[..., 0]
            lead = np.broadcast_shapes(np.shape(a)[:-2], np.shape(b)[:-2])
            return _one_by_one(np.linalg.solve, lead + np.shape(b)[-2:], a, b)

    def __getattr__(self, name: str) -> Any:
        found = getattr(np.linalg, name)
        setattr(self, name, found)
        return found


def _one_by_one(function: Any, shape: tuple[int, ...], *matrices: Any) -> Any:
    """`function` of stacks of matrices, with NaN for those that it refuses."""
    found = np.full(shape, np.nan, np.result_type(*matrices))
    lead = shape[:-2]
    stacks = [np.broadcast_to(x, lead + np.shape(x)[-2:]) for x in matrices]
    for at in np.ndindex(lead) if lead else ():
        with suppress(np.linalg.LinAlgError):  # then it stays NaN
            found[at] = function(*(x[at] for x in stacks))
    return found


LEAST_ANGLE = 1e-30
"""Below it a sine is its angle, in every precision."""


def unnormalized_sinc(x: Any, xp: Any) -> Any:
    """sin(x) / x, and 1 at 0, of what `xp` has as floating-point numbers: never 0/0, and without a branch."""
    size = xp.maximum(xp.abs(x), LEAST_ANGLE)
    return xp.sin(size) / size


def solve_positive(a: Any, b: Any, xp: Any) -> Any:
    """`xp.linalg.solve` of a matrix that is symmetric and positive definite, as a covariance is.

    Where `xp` can be told so, it is: a pipeline then may do without the exchange of rows.
    """
    own = getattr(xp, "solve_positive", None)
    return own(a, b) if own is not None else xp.linalg.solve(a, b)


class NumpyNamespace:
    """`numpy` with `float32_bits`, `unnormalized_sinc`, `solve_positive` and `materialise`.

    On small arrays a function's Python wrapper costs more than its work. Where blocks meet that often, the
    wrapper is passed by.
    """

    linalg: Any = _LinearAlgebra()

    @staticmethod
    def reshape(x: Any, /, shape: Any, *, copy: bool | None = None) -> Any:
        """`numpy.reshape`."""
        return x.reshape(shape) if type(x) is np.ndarray and copy is None else np.reshape(x, shape, copy=copy)

    @staticmethod
    def astype(x: Any, dtype: Any, /, *, copy: bool = True) -> Any:
        """`numpy.astype`, by the rule of pipelines for what does not fit; see `ranges`."""
        return ranges.cast(np, x, dtype)

    @staticmethod
    def asarray(x: Any, /, *, dtype: Any = None, copy: bool | None = None) -> Any:
        """`numpy.asarray`; what becomes a whole number does so as in `astype`."""
        if type(x) is np.ndarray and copy is None and (dtype is None or x.dtype == dtype):
            return x
        if dtype is None:
            return np.asarray(x, copy=copy)
        found = np.asarray(x)
        return ranges.cast(np, found, dtype) if found.dtype != dtype else np.asarray(found, copy=copy)

    @staticmethod
    def sum(x: Any, /, *, axis: Any = None, dtype: Any = None, keepdims: bool = False) -> Any:
        """`numpy.sum`."""
        return np.add.reduce(x, axis, dtype, None, keepdims)  # type: ignore[call-overload]

    @staticmethod
    def max(x: Any, /, *, axis: Any = None, keepdims: bool = False) -> Any:
        """`numpy.max`."""
        return np.maximum.reduce(x, axis, None, None, keepdims)  # type: ignore[call-overload]

    @staticmethod
    def min(x: Any, /, *, axis: Any = None, keepdims: bool = False) -> Any:
        """`numpy.min`."""
        return np.minimum.reduce(x, axis, None, None, keepdims)  # type: ignore[call-overload]

    @staticmethod
    def any(x: Any, /, *, axis: Any = None, keepdims: bool = False) -> Any:
        """`numpy.any`."""
        return np.logical_or.reduce(x, axis, None, None, keepdims)  # type: ignore[call-overload]

    @staticmethod
    def all(x: Any, /, *, axis: Any = None, keepdims: bool = False) -> Any:
        """`numpy.all`."""
        return np.logical_and.reduce(x, axis, None, None, keepdims)  # type: ignore[call-overload]

    @staticmethod
    def cumulative_sum(x: Any, /, *, axis: int | None = None, dtype: Any = None, **more: Any) -> Any:
        """`numpy.cumulative_sum`."""
        if type(x) is np.ndarray and not more and (axis is not None or x.ndim == 1):
            return x.cumsum(axis, dtype)
        return np.cumulative_sum(x, axis=axis, dtype=dtype, **more)

    @staticmethod
    def searchsorted(x: Any, values: Any, /, *, side: Any = "left", sorter: Any = None) -> Any:
        """`numpy.searchsorted`."""
        return np.asarray(x).searchsorted(values, side, sorter)

    @staticmethod
    def argsort(x: Any, /, *, axis: int = -1) -> Any:
        """`numpy.argsort`, with equal values in their order, as the array API has it."""
        return np.argsort(x, axis=axis, stable=True)

    @staticmethod
    def take(x: Any, indices: Any, /, *, axis: int = 0, mode: Any = "clip") -> Any:
        """`numpy.take`; an index outside is brought to the nearest end, as in a pipeline."""
        return np.asarray(x).take(indices, axis, None, mode)

    @staticmethod
    def where(condition: Any, x: Any, y: Any, /) -> Any:
        """`numpy.where`; of a single condition what is taken, as it lies, whoever asks and however."""
        if not (condition.ndim if type(condition) is np.ndarray else np.ndim(condition)):
            first, second = type(x) is np.ndarray and x.ndim > 0, type(y) is np.ndarray and y.ndim > 0
            if first and second:
                if x.shape == y.shape and x.dtype == y.dtype:
                    return x if condition else y
            elif (first and np.ndim(y) == 0) or (second and np.ndim(x) == 0):
                whole, taken = x if first else y, x if condition else y
                if np.result_type(x, y) == whole.dtype:
                    return taken if taken is whole else np.full(whole.shape, taken, whole.dtype)
        return np.where(condition, x, y)

    @staticmethod
    def float32_bits(x: Any) -> Any:
        """The bits of the IEEE binary32 number nearest to each int32, as int32: octave and leading bits."""
        return np.asarray(x).astype(np.float32).view(np.int32)

    @staticmethod
    def unnormalized_sinc(x: Any, /) -> Any:
        """sin(x) / x, and 1 at 0."""
        return unnormalized_sinc(x, np)

    def solve_positive(self, a: Any, b: Any, /) -> Any:
        """`linalg.solve`, by which it makes no difference."""
        return self.linalg.solve(a, b)

    @staticmethod
    def materialise(x: Any) -> Any:
        """The value itself; tells a compiler to compute it once and keep it."""
        return x

    def __getattr__(self, name: str) -> Any:
        found = getattr(np, name)
        setattr(self, name, found)
        return found


NUMPY = NumpyNamespace()
