"""What an instruction means: its value computed in NumPy, as the reference interpreter does.

Constants that are folded and descriptions that are tried out are computed here as well, so that what is known
before a run is to the bit what the run would have found. A singular factorization gives NaN, as in compiled
code, and never an exception.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NumpyNamespace
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.recorder.trace import Instruction


class _LinearAlgebra:
    """`numpy.linalg`, with NaN in place of an exception."""

    def __getattr__(self, name: str) -> Callable[..., Any]:
        function = getattr(np.linalg, name)

        def total(*args: Any, **attrs: Any) -> Any:
            try:
                return function(*args, **attrs)
            except np.linalg.LinAlgError:
                return np.full_like(args[-1], np.nan)

        return total if name in ("cholesky", "solve") else function


class _TotalNumpy(NumpyNamespace):
    linalg = _LinearAlgebra()


TOTAL_NUMPY = _TotalNumpy()
"""NumPy with a value for every argument: what the instructions of a pipeline are defined by."""


def evaluate(i: Instruction, *args: Any) -> Any:
    """The result of an instruction for these arrays, reals as float64; overflow passes in silence."""
    with np.errstate(all="ignore"):
        return OPS[i.op].run(TOTAL_NUMPY, *args, **bound_attrs(i.op, i.attrs, np.dtype("float64")))
