"""The array-API namespace of symbolic arrays: what a block is handed as `xp` while it is recorded.

A function with a symbolic argument records an instruction; without one it computes at once, in NumPy, so that
constants stay constants. What a pipeline has no instruction for is not there, and says so by line.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS
from flowgraph.recorder.refusals import caller, refuse
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.types import dtype_name

if TYPE_CHECKING:
    from flowgraph.recorder.trace import Trace


def _trace_of(args: Sequence[Any]) -> Trace | None:
    for arg in args:
        if isinstance(arg, Symbolic):
            return arg.trace
        if isinstance(arg, list | tuple):
            found = _trace_of(arg)
            if found is not None:
                return found
    return None


class _Linalg:
    """The `linalg` extension: `cholesky`, `solve`, `cross`, `vecdot`, `outer`, `matmul`."""

    def __getattr__(self, name: str) -> Any:
        if name not in ("cholesky", "solve", "cross", "vecdot", "outer", "matmul", "matrix_transpose"):
            raise _not_listed(f"linalg.{name}")
        return (
            getattr(namespace, name)
            if name in ("matmul", "matrix_transpose")
            else _recorder(name, NUMPY.linalg)
        )


def _not_listed(name: str) -> LoweringError:
    valid = ", ".join(sorted(set(OPS) - {"getitem"} | set(_CREATION) | set(_COMPOSED)))
    error = LoweringError(
        f"xp.{name} is not among the operations of a pipeline",
        path=caller(),
        expected=valid,
        got=f"xp.{name}",
        fix="write it with the operations above, or mark the block as a host block",
    )
    error.in_every_engine = not hasattr(np, name) and not hasattr(np.linalg, name.removeprefix("linalg."))
    return error


def _recorder(name: str, plain: Any = np) -> Callable[..., Any]:
    """`xp.name`: records when an argument is symbolic, computes at once when none is."""

    def call(*args: Any, **attrs: Any) -> Any:
        trace = _trace_of(args)
        if trace is None:
            return getattr(NUMPY if plain is np else plain, name)(*args, **attrs)
        return trace.apply(name, *args, **attrs)

    return call


def _solve_positive(a: Any, b: Any) -> Any:
    trace = _trace_of((a, b))
    return NUMPY.solve_positive(a, b) if trace is None else trace.apply("solve", a, b, assume_a="pos")


def _along(name: str) -> Callable[..., Any]:
    def call(arrays: Sequence[Any], *, axis: int = 0) -> Any:
        trace = _trace_of(arrays)
        return trace.apply(name, *arrays, axis=axis) if trace else getattr(np, name)(arrays, axis=axis)

    return call


def _reducer(name: str) -> Callable[..., Any]:
    def call(x: Any, /, *, axis: Any = None, keepdims: bool = False) -> Any:
        if not isinstance(x, Symbolic):
            return getattr(np, name)(x, axis=axis, keepdims=keepdims)
        return x.trace.apply(name, x, axis=list(axis) if isinstance(axis, tuple) else axis, keepdims=keepdims)

    return call


def _shaped(name: str, attr: str) -> Callable[..., Any]:
    def call(x: Any, /, value: Any) -> Any:
        if not isinstance(x, Symbolic):
            return getattr(np, name)(x, value)
        sizes = [value] if isinstance(value, int) else list(value)
        if attr == "shape" and tuple(sizes) == x.shape:
            return x
        return x.trace.apply(name, x, **{attr: sizes})

    return call


def _astype(x: Any, dtype: Any, /) -> Any:
    return x.cast(_kind(dtype)) if isinstance(x, Symbolic) else NUMPY.astype(x, dtype)


def _kind(dtype: Any) -> str:
    if np.dtype(dtype) == np.float32:
        refuse(
            "a fixed float32", "real, which the run makes float64 or float32", "float32", "use dtype=x.dtype"
        )
    return dtype_name(np.zeros((), dtype))


def _asarray(value: Any, /, *, dtype: Any = None) -> Any:
    if isinstance(value, Symbolic):
        return value if dtype is None else _astype(value, dtype)
    if isinstance(value, list | tuple) and _trace_of(value) is not None:
        refuse(
            "an array from a list of traced values", "xp.stack", "xp.asarray([...])", "write xp.stack([...])"
        )
    return NUMPY.asarray(value, dtype=dtype)


def _expand_dims(x: Any, /, *, axis: int = 0) -> Any:
    shape = list(x.shape)
    shape.insert(axis if axis >= 0 else axis + len(shape) + 1, 1)
    return namespace.reshape(x, tuple(shape))


def _squeeze(x: Any, /, axis: int | tuple[int, ...]) -> Any:
    axes = {a % x.ndim for a in ([axis] if isinstance(axis, int) else axis)}
    return namespace.reshape(x, tuple(n for i, n in enumerate(x.shape) if i not in axes))


def _clip(x: Any, /, min: Any = None, max: Any = None) -> Any:
    low = x if min is None else namespace.maximum(x, min)
    return low if max is None else namespace.minimum(low, max)


def _take(x: Any, indices: Any, /, *, axis: int = 0) -> Any:
    trace = _trace_of((x, indices))
    return np.take(x, indices, axis=axis) if trace is None else trace.apply("take", x, indices, axis=axis)


def _cumulative_sum(x: Any, /, *, axis: int | None = None) -> Any:
    if not isinstance(x, Symbolic):
        return np.cumulative_sum(x, axis=axis)
    if axis is None and x.ndim != 1:
        refuse("cumulative_sum without an axis", "axis=", f"shape {x.shape}", "say along which axis")
    return x.trace.apply("cumulative_sum", x, axis=0 if axis is None else axis)


def _roll(x: Any, /, shift: int, *, axis: int | None = None) -> Any:
    if not isinstance(x, Symbolic):
        return np.roll(x, shift, axis=axis)
    return x.trace.apply("roll", x, shift=shift, axis=axis)


def _argsort(x: Any, /, *, axis: int = -1) -> Any:
    if not isinstance(x, Symbolic):
        return NUMPY.argsort(x, axis=axis)
    return x.trace.apply("argsort", x, axis=axis)


def _trace_sum(x: Any, /) -> Any:
    eye = np.eye(x.shape[-1])
    return namespace.sum(x * eye, axis=(-2, -1))


_CREATION = ("zeros", "ones", "full", "eye", "arange", "linspace", "zeros_like", "ones_like")
_CONSTANTS = (
    "pi",
    "inf",
    "nan",
    "e",
    "newaxis",
    "float64",
    "float32",
    "int32",
    "int64",
    "uint32",
    "uint64",
    "bool",
)
_COMPOSED: dict[str, Callable[..., Any]] = {
    "concat": _along("concat"),
    "stack": _along("stack"),
    "reshape": _shaped("reshape", "shape"),
    "broadcast_to": _shaped("broadcast_to", "shape"),
    "permute_dims": _shaped("permute_dims", "axes"),
    "astype": _astype,
    "asarray": _asarray,
    "expand_dims": _expand_dims,
    "squeeze": _squeeze,
    "clip": _clip,
    "take": _take,
    "cumulative_sum": _cumulative_sum,
    "roll": _roll,
    "solve_positive": _solve_positive,
    "argsort": _argsort,
    "zeros_like": lambda x: np.zeros(x.shape, x.dtype),
    "ones_like": lambda x: np.ones(x.shape, x.dtype),
    **{name: _reducer(name) for name in ("sum", "prod", "max", "min", "mean", "any", "all")},
}


class Namespace:
    """The array-API namespace of symbolic arrays; without a symbolic argument it is NumPy."""

    linalg = _Linalg()

    def __getattr__(self, name: str) -> Any:
        if name in _COMPOSED:
            found: Any = _COMPOSED[name]
        elif name in _CREATION or name in _CONSTANTS:
            found = getattr(np, name)
        elif name in OPS and name not in ("getitem", "cholesky", "solve", "cross", "vecdot", "outer"):
            found = _recorder(name)
        else:
            raise _not_listed(name)
        setattr(self, name, found)
        return found


namespace = Namespace()
