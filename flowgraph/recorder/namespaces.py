"""NumPy as the engines use it: the array API, and the two operations that pipelines add to it."""

from __future__ import annotations

from typing import Any

import numpy as np


class _LinearAlgebra:
    """`numpy.linalg`; `vecdot` is the ufunc itself, not its wrapper in Python."""

    vecdot = staticmethod(np.vecdot)

    def __getattr__(self, name: str) -> Any:
        found = getattr(np.linalg, name)
        setattr(self, name, found)
        return found


class NumpyNamespace:
    """`numpy` with `float32_bits` and `materialise`.

    On small arrays a function's Python wrapper costs more than its work. Where blocks meet that often, the
    wrapper is passed by.
    """

    linalg: Any = _LinearAlgebra()

    @staticmethod
    def reshape(x: Any, /, shape: Any, *, copy: bool | None = None) -> Any:
        """`numpy.reshape`."""
        return x.reshape(shape) if type(x) is np.ndarray and copy is None else np.reshape(x, shape, copy=copy)

    @staticmethod
    def argsort(x: Any, /, *, axis: int = -1) -> Any:
        """`numpy.argsort`, with equal values in their order, as the array API has it."""
        return np.argsort(x, axis=axis, stable=True)

    @staticmethod
    def take(x: Any, indices: Any, /, *, axis: int = 0, mode: Any = "clip") -> Any:
        """`numpy.take`; an index outside is brought to the nearest end, as in a pipeline."""
        return np.take(x, indices, axis=axis, mode=mode)

    @staticmethod
    def float32_bits(x: Any) -> Any:
        """The bits of the IEEE binary32 number nearest to each int32, as int32: octave and leading bits."""
        return np.asarray(x).astype(np.float32).view(np.int32)

    @staticmethod
    def materialise(x: Any) -> Any:
        """The value itself; tells a compiler to compute it once and keep it."""
        return x

    def __getattr__(self, name: str) -> Any:
        found = getattr(np, name)
        setattr(self, name, found)
        return found


NUMPY = NumpyNamespace()
