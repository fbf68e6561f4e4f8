"""The stamps of a series: int64 ns that nobody can write to, so they are shared and looked at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.errors import DataError

_PIECE = 16384


def settled(stamps: np.ndarray) -> np.ndarray:
    """These stamps as (n,) int64 that cannot be written to: themselves where they are that, or a copy."""
    owner: Any = stamps
    while isinstance(owner, np.ndarray) and not owner.flags.writeable:
        owner = owner.base
    if owner is not None or stamps.dtype != np.int64:
        stamps = stamps.astype(np.int64)
        stamps.flags.writeable = False
    return stamps


def extreme_steps(stamps: np.ndarray) -> tuple[int, int]:
    """The shortest and the longest step (ns), looked for a piece at a time: it stays in the cache.

    Of fewer than two stamps these are the largest int64 and 0. A step beyond int64 comes out negative.
    """
    least, most = 2**63 - 1, 0
    for start in range(0, len(stamps) - 1, _PIECE):
        part = stamps[start : start + _PIECE + 1]
        steps = part[1:] - part[:-1]
        least, most = min(least, int(steps.min())), max(most, int(steps.max()))
    return least, most


def from_dates(stamps: np.ndarray, name: str) -> np.ndarray:
    """datetime64 or timedelta64 of any unit, as int64 ns; finer ones are cut off."""
    exact = stamps.astype(f"{stamps.dtype.kind}8[ns]")
    finer = np.datetime_data(stamps.dtype)[0] in ("ps", "fs", "as")
    if np.isnat(stamps).any() or (not finer and (exact.astype(stamps.dtype) != stamps).any()):
        raise DataError(
            "a time is missing, or beyond what int64 nanoseconds hold",
            path=name,
            expected="times from 1677 to 2262, and no NaT",
            got=f"dtype {stamps.dtype}",
            fix="drop such rows at the source",
        )
    return exact.astype(np.int64)
