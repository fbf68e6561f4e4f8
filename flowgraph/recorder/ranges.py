"""Operations outside their range: one rule for every engine, where IEEE and C leave it open.

A real number becomes a whole one by cutting off its fraction; beyond the range it becomes the nearest end of
it, and NaN becomes 0. A quotient or remainder of whole numbers by 0 is 0. A quotient of reals that is rounded
down is what NumPy gives: x // 0 is x / 0, and -1 // inf is -1. A shift by as many bits as there are, or
more, leaves 0, or -1 of a negative number shifted right. docs/semantics.md has the table.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np


def cast(xp: Any, x: Any, dtype: Any) -> Any:
    """`x` as another kind of number; reals saturate where they become whole ones."""
    kind = np.dtype(dtype)
    x = x if hasattr(x, "dtype") else xp.asarray(x)
    return _whole(xp, x, kind) if x.dtype.kind == "f" and kind.kind in "iu" else x.astype(kind)


def _whole(xp: Any, x: Any, kind: np.dtype[Any]) -> Any:
    least, beyond, square = _ends(kind, x.dtype)
    if isinstance(x, np.generic | np.ndarray) and not x.ndim:  # one number, as one meets it most
        limits, number = _limits(kind), float(x)
        if not limits.min <= number < 2.0 ** (limits.bits - (kind.kind == "i")):
            number = limits.min if number < 0.0 else limits.max if number > 0.0 else 0
        return kind.type(int(number))
    if isinstance(x, np.ndarray) and x.size and (np.vdot(x, x) < square or _within(x, least, beyond)):
        return x.astype(kind)  # as nearly always
    fits = (x >= least) & (x < beyond)  # False for NaN
    inside = xp.where(fits, x, x.dtype.type(0)).astype(kind)
    low, high = kind.type(_limits(kind).min), kind.type(_limits(kind).max)
    found = xp.where(x >= beyond, high, xp.where(x < least, low, inside))
    return found[()] if isinstance(found, np.ndarray) and not found.ndim else found


_limits = lru_cache(np.iinfo)


@lru_cache
def _ends(kind: np.dtype[Any], real: np.dtype[Any]) -> tuple[Any, Any, Any]:
    """The least real that fits, the first beyond, and below which sum of squares every number surely fits."""
    limits = _limits(kind)
    signed = kind.kind == "i"
    beyond = 2.0 ** (limits.bits - signed)
    return real.type(limits.min), real.type(beyond), real.type(0.25 * beyond * beyond * signed)


def _within(x: np.ndarray, least: Any, beyond: Any) -> bool:
    """Whether all entries are; a NaN is not."""
    low, high = np.minimum.reduce(x, axis=None), np.maximum.reduce(x, axis=None)
    return bool(least <= low and high < beyond)


def floor_divide(xp: Any, a: Any, b: Any) -> Any:
    """The quotient rounded down, in a namespace whose own may have another rule than NumPy's."""
    a, b = xp.asarray(a), xp.asarray(b)
    zero = b == 0
    if b.dtype.kind == "f":
        return xp.where(zero, a / b, xp.floor_divide(a, b))
    return xp.where(zero, 0, xp.floor_divide(a, xp.where(zero, 1, b)))


def remainder(xp: Any, a: Any, b: Any) -> Any:
    """The remainder that has the divisor's sign; of whole numbers by 0 it is 0."""
    a, b = xp.asarray(a), xp.asarray(b)
    if b.dtype.kind == "f":
        return xp.remainder(a, b)
    zero = b == 0
    return xp.where(zero, 0, xp.remainder(a, xp.where(zero, 1, b)))
