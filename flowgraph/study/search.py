"""The search of a tuning: the mean measure over some recordings is made small in the numbers of a vector."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.study.coordinates import Coordinates, Parameter
from flowgraph.study.trials import Trials

__all__ = ["Found", "Search"]

_STEP, _APART, _CURVE = 1e-3, 1e-4, 1e-2
"""Of differences of measures, of settings that are built anew, of slopes."""

_NUDGE = 1e-9
"""Constants of a pipeline that are equal by chance are one, and change together; a little aside not."""


@dataclass(frozen=True)
class Found:
    """Where a search ended.

    Args:
        parameters: the values found.
        evaluations: how many points were tried, on all its recordings each.
        converged: whether the search ended by itself; `message` says how.
        at_bound: parameters that ended at a bound, so that the least lies beyond it, each with "low" or
            "high".
        deviations: the standard deviation of each that was found by likelihood; None of one at a bound.
    """

    parameters: dict[str, Parameter]
    evaluations: int
    converged: bool
    message: str
    at_bound: dict[str, str]
    deviations: dict[str, Any]


class Search:
    """One search.

    Args:
        problem: what is measured.
        coordinates: of the vector.
        places: of the recordings that count.
        forward: whether slopes may come with the measure; differences otherwise.
    """

    def __init__(
        self, problem: Trials, coordinates: Coordinates, places: Sequence[int], *, forward: bool
    ) -> None:
        self.problem, self.at, self.places = problem, coordinates, list(places)
        self.count = 0
        self.best: tuple[float, np.ndarray] = (math.inf, coordinates.start)
        self._forward = forward and problem.slopes
        self._rough: set[int] = set()
        self._values = np.ones(len(self.places))  # how many each recording has
        self._watch: Callable[[int, Mapping[str, Parameter], float], None] | None = None

    def run(
        self, method: str, most: int, watch: Callable[[int, Mapping[str, Parameter], float], None] | None
    ) -> Found:
        """Search from the start of the coordinates, with about `most` points."""
        from scipy import optimize  # half a second that only a search needs

        self._watch = watch
        low, high, start = self.at.low, self.at.high, self.at.start
        how: dict[str, Any] = {"method": method, "bounds": list(zip(low, high, strict=True))}
        limits: dict[str, Any]
        if method == "L-BFGS-B":
            each = 1 if self._forward else 2 * len(low) + 1
            limits = {"maxfun": max(1, most // each), "ftol": 1e-8}
            ended = optimize.minimize(self.with_slope, start, jac=True, options=limits, **how)
        else:
            names = {"Nelder-Mead": ("xatol", "fatol"), "Powell": ("xtol", "ftol")}[method]
            limits = {"maxfev": most, names[0]: 1e-3, names[1]: 1e-6}
            if method == "Nelder-Mead":  # scipy's own first steps are a part of x, which is next to none at 0
                limits["initial_simplex"] = np.vstack([start, start + np.diag(first_steps(start, low, high))])
            ended = optimize.minimize(lambda x: float(self.values(x[None])[0]), start, options=limits, **how)
        x = self.best[1]
        ends = zip(self.at.owners, x, low, high, strict=True)
        at_bound = {n: "low" if v - a < b - v else "high" for n, v, a, b in ends if min(v - a, b - v) < 2e-3}
        deviations = self._deviations(x) if self.problem.measure == "likelihood" and ended.success else {}
        return Found(
            self.at.decode(x), self.count, bool(ended.success), str(ended.message), at_bound, deviations
        )

    def values(self, points: np.ndarray) -> np.ndarray:
        """The measure at points (n, p)."""
        found = self.problem.measured([self.at.decode(x) for x in points], self.places).mean(axis=1)
        self._tell(found, points)
        return np.asarray(found)

    def _tell(self, found: np.ndarray, points: np.ndarray) -> None:
        self.count += len(points)
        if found.min() < self.best[0]:
            self.best = float(found.min()), points[int(found.argmin())]
        if self._watch is not None:
            self._watch(self.count, self.at.decode(self.best[1]), self.best[0])

    def with_slope(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The measure and its slope: forward where it has one, by central differences within the bounds."""
        value, slope = self._forward_slope(x) if self._forward else (math.nan, np.full(len(x), np.nan))
        missing = np.flatnonzero(np.isnan(slope))
        if not len(missing) and not math.isnan(value):
            return value, slope
        low, high = self.at.low, self.at.high
        ends = [np.clip(x + s * _STEP * np.eye(len(x))[k], low, high) for k in missing for s in (1.0, -1.0)]
        first = [x] if math.isnan(value) else []
        found = self.values(np.array([*first, *ends]))
        value = float(found[0]) if first else value
        steps = np.array([(a - b).sum() for a, b in zip(ends[::2], ends[1::2], strict=True)])
        slope[missing] = (found[len(first) :: 2] - found[len(first) + 1 :: 2]) / steps
        return value, slope

    def _forward_slope(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        """The measure and its slope; NaN where a parameter has none."""
        value, slope = self._sloped(x)
        if self._rough < set(np.flatnonzero(np.isnan(slope)).tolist()):
            nudged = x + _NUDGE * (1.0 + np.arange(len(x)) / 7.0)
            other, again = self._sloped(nudged)
            value, slope = (value if math.isnan(other) else other), again
            self._rough = set(np.flatnonzero(np.isnan(slope)).tolist())
            if len(self._rough) == len(x):
                self._forward = False
        if not math.isnan(value):
            self._tell(np.array([value]), x[None])
        return value, slope

    def _sloped(self, x: np.ndarray) -> tuple[float, np.ndarray]:
        smooth = [k for k in range(len(x)) if k not in self._rough]
        steps = [_APART * np.eye(len(x))[k] for k in smooth]
        ends = [(self.at.decode(x + e), self.at.decode(x - e)) for e in steps]
        slope = np.full(len(x), np.nan)
        parts = []
        for k, place in enumerate(self.places):
            value, count, d = self.problem.sloped(place, self.at.decode(x), ends, [2.0 * _APART] * len(ends))
            parts.append((value, d))
            self._values[k] = max(count, 1.0)
        slope[smooth] = np.mean([d for _, d in parts], axis=0)
        return float(np.mean([v for v, _ in parts])), slope

    def _deviations(self, x: np.ndarray) -> dict[str, Any]:
        """The standard deviation of each parameter, by the change of the slope of all recordings together.

        Parameters at a bound are taken as known.
        """
        inner = np.flatnonzero((x - self.at.low > 2e-3) & (self.at.high - x > 2e-3))
        covariance = np.full((len(x), len(x)), np.nan)
        if len(inner):
            slopes = []
            _, base = self.with_slope(x)
            for k in inner:
                step = _CURVE * np.eye(len(x))[k]
                slopes.append((self.with_slope(x + step)[1] - base)[inner] / _CURVE)
            curve = np.array(slopes) * self._counted()
            curve = 0.5 * (curve + curve.T)
            if np.isfinite(curve).all() and (np.linalg.eigvalsh(curve) > 0.0).all():
                covariance[np.ix_(inner, inner)] = np.linalg.inv(curve)
        return self.at.deviations(x, covariance)

    def _counted(self) -> float:
        """How many values the mean measure stands for."""
        if not self._forward:
            counts = [self.problem.values_at(place, self.at.decode(self.best[1])) for place in self.places]
            self._values = np.array(counts)
        return float(self._values.sum())


def first_steps(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """A quarter of the way between the bounds, at most a factor e, towards the farther one."""
    sign = np.where(high - start >= start - low, 1.0, -1.0)
    return np.asarray(sign * np.minimum(1.0, 0.25 * (high - low)))
