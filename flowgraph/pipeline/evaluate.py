"""What an instruction means: its value computed in NumPy, as the reference interpreter does.

Constants that are folded and descriptions that are tried out are computed here as well, so that what is known
before a run is to the bit what the run would have found. A singular factorization gives NaN, as in compiled
code, and never an exception.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import OPS, bound_attrs
from flowgraph.recorder.trace import Instruction


def evaluate(i: Instruction, *args: Any) -> Any:
    """The result of an instruction for these arrays, reals as float64; overflow passes in silence."""
    with np.errstate(all="ignore"):
        return OPS[i.op].run(NUMPY, *args, **bound_attrs(i.op, i.attrs, np.dtype("float64")))
