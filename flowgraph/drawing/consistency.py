"""Whether a filter is as good as it says: its errors in the size that it claims, as numbers with bounds.

The normalised estimation error squared (NEES) of a filter whose covariance is right has a chi-squared
distribution with as many degrees as there are errors; so has the normalised innovation squared (NIS) with as
many as a measurement has parts.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation",
Wiley 2001, sec. 5.4.
"""

from __future__ import annotations

import numpy as np

from flowgraph.data.consistency import chi_square
from flowgraph.data.series import Series
from flowgraph.drawing.angles import between, turn_between
from flowgraph.drawing.fields import SIZES, STATES, find

FAR = 2.0
"""A mean that is so many times too large or too small is worth a warning."""

# where errors stand in a covariance of this size, by what else the estimate has
_WITHOUT_POSITION = {3: {"attitude": 0}, 6: {"attitude": 0, "gyro_bias": 3}, 9: {"attitude": 6}, 15: STATES}
_LEVEL = {"velocity": 0, "attitude": 3, "gyro_bias": 6}
_QUATERNION = {"velocity": 0, "position": 3}


def places(series: Series) -> dict[str, int]:
    """Where the error of each field stands in the covariance of an estimate; empty where that is unknown."""
    found, position = find(series, "covariance"), find(series, "position")
    if found is None or found[0].ndim != 3 or found[0].shape[1] != found[0].shape[2]:
        return {}
    size = found[0].shape[1]
    if position is None:
        level = find(series, "velocity") is not None and size == 9
        table = _LEVEL if level else _WITHOUT_POSITION.get(size, {})
        if find(series, "rate") is not None and size == 6:
            table = {"attitude": 0, "rate": 3}
    elif size == 10:
        table = _QUATERNION
    elif size == position[0].shape[-1]:
        table = {"position": 0}
    else:
        more = size > 15 and find(series, "accelerometer_bias") is not None  # others stand behind the fifteen
        table = STATES if size in SIZES or more else {}
    return {field: at for field, at in table.items() if at < size and find(series, field) is not None}


def covariance_of(series: Series, field: str) -> np.ndarray | None:
    """(n, k, k) of the error of a field, or None."""
    at, found = places(series).get(field), find(series, "covariance")
    if at is None or found is None:
        return None
    own = find(series, field)
    k = 3 if field == "attitude" or own is None else own[0].shape[-1]
    return np.asarray(found[0][:, at : at + k, at : at + k], dtype=float)


def variance_of(series: Series, field: str, k: int) -> np.ndarray | None:
    """(n,) of the error of one component of a field, or None."""
    spread = covariance_of(series, field)
    return None if spread is None else spread[:, k, k]


def error_of(estimate: Series, truth: Series, field: str) -> np.ndarray | None:
    """(n, k) estimate minus truth at the estimate's times, of an attitude the turn in the body in rad; NaN
    where the truth is unknown, None where one of the two has no such field."""
    mine, right = find(estimate, field), find(truth, field)
    if (
        mine is None
        or right is None
        or not len(truth)
        or mine[0].ndim != 2
        or right[0].shape[1:] != mine[0].shape[1:]
    ):
        return None
    known = between(truth, field, estimate.time)
    return np.asarray(np.deg2rad(turn_between(known, mine[0])) if field == "attitude" else mine[0] - known)


def nees(estimate: Series, truth: Series) -> tuple[np.ndarray, int] | None:
    """(n,) error^T covariance^-1 error of all that has both, NaN where unknown, and its degrees."""
    found = find(estimate, "covariance")
    errors, rows = [], []
    for field, at in places(estimate).items():
        error = error_of(estimate, truth, field) if field in ("position", "velocity", "attitude") else None
        if error is not None and np.isfinite(error).any():
            errors.append(error)
            rows += list(range(at, at + error.shape[1]))
    if found is None or not errors:
        return None
    error, P = np.concatenate(errors, axis=1), np.asarray(found[0], dtype=float)[:, rows][:, :, rows]
    value = np.full(len(error), np.nan)
    known = np.isfinite(error).all(axis=1) & np.isfinite(P).all(axis=(1, 2))
    value[known] = _squared(error[known], P[known])
    return value, len(rows)


def _squared(error: np.ndarray, P: np.ndarray) -> np.ndarray:
    """Error^T P^-1 error; NaN where P has no inverse."""
    try:
        return np.asarray(np.einsum("ni,ni->n", error, np.linalg.solve(P, error[..., None])[..., 0]))
    except np.linalg.LinAlgError:
        one = [np.linalg.lstsq(p, e, rcond=None)[0] @ e if np.linalg.matrix_rank(p) == len(p) else np.nan
               for p, e in zip(P, error, strict=True)]  # fmt: skip
        return np.array(one)


def bounds(degrees: float, outside: float = 0.05) -> tuple[float, float]:
    """Between which a chi-squared variable lies but for a share of cases, half of them on each side."""
    low, high = (float(chi_square(p, degrees)) for p in (outside / 2, 1 - outside / 2))
    return low, high


def is_far(mean: float, degrees: float) -> bool:
    """Whether a mean per number, of squares of so many numbers in all, is far from 1, and not by chance."""
    low, high = bounds(degrees, outside=1e-4)
    return not 1 / FAR < mean < FAR and not low < mean * degrees < high


__all__ = ["bounds", "covariance_of", "error_of", "is_far", "nees", "places", "variance_of"]
