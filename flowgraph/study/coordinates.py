"""The numbers that a search moves, and the parameters that they stand for.

A search sees a vector of numbers of about one size. A positive parameter is the exponential of one, so that a
factor counts the same wherever it is; one that may have either sign (an offset, a lever) is a share of the
way between its bounds. An array has a number an entry. A covariance has those of its root

    S = L L^T      L = diag(exp a) (I + B)      B strictly lower triangular

so that every vector is a covariance, whose pivots exp 2a lie between the bounds.

Source: J. Pinheiro and D. Bates, "Unconstrained parametrizations for variance-covariance matrices",
Statistics and Computing 6, 1996, sec. 2 (log-Cholesky).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

__all__ = ["Coordinates", "Fit", "Parameter"]

Parameter = float | np.ndarray
"""A number, or an array (n) or (n, n)."""

_SLANT = 5.0  # entries of B: a correlation of 0.98 and more is none that a recording shows


@dataclass(frozen=True)
class Fit:
    """A parameter to find: between `low` and `high`, from `start`.

    Args:
        name: a setting of the graph; or of the flight, STREAM.time_offset, STREAM.lever or STREAM.mount.
        low, high: bounds of a number, of each entry of a vector, of the pivots of a covariance.
        start: where the search begins.
        scale: "log" of what is positive, "linear" of what may have either sign.
    """

    name: str
    low: float
    high: float
    start: Parameter | None = None
    scale: str = "log"


class Coordinates:
    """The vector of a search.

    Args:
        fits: the parameters.
        starts: a value of each by name, which tells its shape.

    Attributes:
        low, high, start: (p,)
        owners: (p,) the names of the parameters that the numbers belong to.
    """

    def __init__(self, fits: Sequence[Fit], starts: Mapping[str, Parameter]) -> None:
        self._fits = list(fits)
        self._shapes = {f.name: np.shape(starts[f.name]) for f in fits}
        low, high, start, owners = [], [], [], []
        for f in fits:
            a, b = (self._forward(f, v) for v in (f.low, f.high))
            x = self._encoded(f, np.asarray(starts[f.name], dtype=float))
            slanted = len(self._shapes[f.name]) == 2
            n = self._shapes[f.name][0] if slanted else len(x)
            low += [a] * n + [-_SLANT] * (len(x) - n)
            high += [b] * n + [_SLANT] * (len(x) - n)
            start += x.tolist()
            owners += [f.name] * len(x)
        self.low, self.high = np.array(low), np.array(high)
        self.start, self.owners = np.clip(start, self.low, self.high), owners

    def _forward(self, f: Fit, value: float) -> float:
        if f.scale == "linear":
            return (value - f.low) / (f.high - f.low)
        return math.log(value) * (0.5 if len(self._shapes[f.name]) == 2 else 1.0)

    def _encoded(self, f: Fit, value: np.ndarray) -> np.ndarray:
        if f.scale == "linear":
            return np.atleast_1d((value - f.low) / (f.high - f.low)).ravel()
        if value.ndim < 2:
            return np.log(np.maximum(np.atleast_1d(value), f.low))
        L = np.linalg.cholesky(value)
        return np.concatenate([np.log(np.diag(L)), (L / np.diag(L)[:, None])[np.tril_indices(len(L), -1)]])

    def decode(self, x: np.ndarray) -> dict[str, Parameter]:
        """The parameters of a vector (p,)."""
        found: dict[str, Parameter] = {}
        at = 0
        for f in self._fits:
            shape = self._shapes[f.name]
            n = self._count(shape)
            found[f.name] = self._decoded(f, shape, np.asarray(x[at : at + n]))
            at += n
        return found

    @staticmethod
    def _count(shape: tuple[int, ...]) -> int:
        return shape[0] * (shape[0] + 1) // 2 if len(shape) == 2 else math.prod(shape)

    @staticmethod
    def _decoded(f: Fit, shape: tuple[int, ...], x: np.ndarray) -> Parameter:
        if f.scale == "linear":
            value = f.low + x * (f.high - f.low)
        elif len(shape) == 2:
            n = shape[0]
            L = np.eye(n)
            L[np.tril_indices(n, -1)] = x[n:]
            L = np.exp(x[:n])[:, None] * L
            return np.asarray(L @ L.T)
        else:
            value = np.exp(x)
        return float(value[0]) if shape == () else value.reshape(shape)

    def deviations(self, x: np.ndarray, covariance: np.ndarray) -> dict[str, Any]:
        """Of each parameter, entry by entry, from the covariance (p, p) of the vector: to first order.

        None where it is not known, as of what ended at a bound.
        """
        step = 1e-6
        found: dict[str, Any] = {}
        columns = []
        for e in np.eye(len(x)):
            ends = [self.decode(x + s * step * e) for s in (1.0, -1.0)]
            columns.append(
                {n: (np.asarray(ends[0][n]) - np.asarray(ends[1][n])) / (2 * step) for n in ends[0]}
            )
        for name, shape in self._shapes.items():
            J = np.stack([c[name] for c in columns], axis=-1)
            touched = [k for k, owner in enumerate(self.owners) if owner == name]
            if np.isnan(np.diag(covariance)[touched]).any():
                found[name] = None
                continue
            part = J[..., touched]
            variance = np.einsum("...i,ij,...j->...", part, covariance[np.ix_(touched, touched)], part)
            deviation = np.sqrt(np.maximum(variance, 0.0))
            found[name] = float(deviation) if shape == () else deviation
        return found
