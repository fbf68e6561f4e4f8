"""Whether the numbers of an array are numbers."""

from __future__ import annotations

from typing import Any

import numpy as np


def finite(array: np.ndarray | Any) -> bool:
    """Whether no entry is NaN or infinite; whole numbers and truth values never are.

    A recording is asked when it comes and when it goes: where the sum of the squares is finite so is each
    entry, which takes one pass and no array of truth values.
    """
    if array.dtype.kind != "f":
        return True
    if array.flags.c_contiguous:
        flat = array.reshape(-1)
        with np.errstate(all="ignore"):
            if np.isfinite(np.dot(flat, flat)):
                return True
    return bool(np.isfinite(array).all())
