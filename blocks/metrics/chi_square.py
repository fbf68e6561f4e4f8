"""The chi-square distribution: how large the square of an honest error is, in its own deviations.

The squared length of k independent standard normal numbers is chi-square with k degrees of freedom. Bands
around its mean k tell honest filters from others, and its far tail tells a wrong measurement from an
unlucky one.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
secs. 1.4.17 (tables) and 5.4.2 (bands).
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt

from flowgraph.data.consistency import chi_square

__all__ = ["chi_square", "chi_square_band", "chi_square_gate", "gate_table", "inside"]


@lru_cache(maxsize=256)
def chi_square_band(parts: int, *, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """The two-sided band of the mean over `runs` of a chi-square variable with `parts` degrees of freedom."""
    tail = 0.5 * (1.0 - probability)
    low, high = (float(chi_square(p, parts * runs)) / runs for p in (tail, 1.0 - tail))
    return low, high


def chi_square_gate(parts: int, probability: float = 0.999) -> float:
    """The NIS that an honest measurement of `parts` numbers stays below with this probability."""
    return float(chi_square(probability, parts))


def gate_table(gate: float, parts: int) -> np.ndarray:
    """The largest NIS that passes, (parts + 1), by how many numbers of a measurement there are.

    A NIS grows with the numbers that it is made of, so one limit for a whole measurement and for half of one
    would let the half pass too easily. All limits here are passed with the same probability.

    Args:
        gate: below 1 that probability; from 1 on the limit for a whole measurement, of `parts` numbers.
        parts: of a whole measurement.
    """
    n = np.arange(1, parts + 1)
    if gate < 1.0:
        return np.r_[0.0, chi_square(gate, n)]
    from scipy.special import gammaincc, gammainccinv  # slow to import, and only gates need it

    beyond = gammaincc(0.5 * parts, 0.5 * gate)  # 0 for what nothing exceeds: then the limit stays
    return np.r_[0.0, np.minimum(2.0 * gammainccinv(0.5 * n[:-1], beyond), gate), gate]


def inside(values: npt.ArrayLike, band: tuple[float, float]) -> float:
    """The fraction of the values that lie in the band."""
    x = np.asarray(values)
    return float(np.mean((x >= band[0]) & (x <= band[1])))
