"""What the page of a run plots: errors in their bands, estimates on the truth, innovations, consistency.

An error of millimetres on a way of metres is a line on a line, so errors come first and have a scale of their
own: that of the time after the first tenth, in which a filter may still be finding itself. What lies beyond
is said. A panel with more points than a screen has pixels is thinned to the least and the greatest of each
stretch, so that no peak is lost.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from flowgraph.data.consistency import far_nis, measured
from flowgraph.data.notes import note
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.drawing.angles import NAMES, between, euler_angles, euler_variances
from flowgraph.drawing.canvas import SETTLING, deviation
from flowgraph.drawing.consistency import bounds, covariance_of, error_of, is_far, nees
from flowgraph.drawing.fields import STATES, components, find, unit_words
from flowgraph.drawing.recorder import packed
from flowgraph.types import leaves_of

POINTS = 6000
"""Of a line, at most: more than a screen has pixels."""

WIDER = 3.0
"""A start that makes a scale wider than this by factors is left out of it."""

_FIELDS = (*STATES, "rate")
_DEGREES = {"attitude": ("deg", np.rad2deg(1.0))}
_SMALL = 6


class Scopes:
    """The panels of one run, in plain lists, as `front/src/model.ts` declares them.

    Args:
        result: what the graph collected.
        estimate: the name of the stream that the truth is compared with.
        truth: or None.
        inputs: the recorded streams that were fed, by source.
        order: convention of roll, pitch and yaw.
        points: of a line, at most.
    """

    def __init__(
        self,
        result: Result,
        estimate: str,
        truth: Series | None = None,
        inputs: Mapping[str, Series] | None = None,
        order: str = "zyx",
        points: int = POINTS,
    ) -> None:
        self.result, self.truth, self.order, self.points = result, truth, order, points
        self.inputs = dict(inputs or {})
        self.estimate = result.series.get(estimate)
        self.name = estimate
        begins = [s.time[0] for s in (*result.series.values(), *self.inputs.values()) if len(s)]
        self.begin = int(min(begins, default=0))
        self.notes: list[str] = []
        self.times: list[str] = []

    def panels(self) -> list[dict[str, Any]]:
        """All of them, in the order in which they are read."""
        made: list[dict[str, Any]] = []
        if self.estimate is not None and len(self.estimate):
            if self.truth is not None and len(self.truth):
                made += self._errors(self.estimate, self.truth)
            made += self._values(self.estimate)
        for name, series in self.result.series.items():
            if find(series, "nis") is not None and len(series):
                made += self._innovations(name, series)
        if self.estimate is not None and self.truth is not None and len(self.estimate):
            made += self._nees(self.estimate, self.truth)
        for name, series in self.result.series.items():
            if series is not self.estimate and find(series, "nis") is None and len(series):
                made += self._others(name, series)
        groups = list(dict.fromkeys(panel["group"] for panel in made))
        return sorted(made, key=lambda panel: groups.index(panel["group"]))

    def _errors(self, estimate: Series, truth: Series) -> Iterator[dict[str, Any]]:
        for field in _FIELDS:
            error = error_of(estimate, truth, field)
            if error is None or not np.isfinite(error).any():
                continue
            unit, factor = self._unit(estimate, field)
            spread = covariance_of(estimate, field)
            for k in range(error.shape[1]):
                sigma = None if spread is None else 3.0 * factor * deviation(spread[:, k, k])
                name = f"{_words(field)} error {'xyz'[k]}" + (", in the body" if field == "attitude" else "")
                yield self._panel("Errors", name, unit, estimate.time, {"error": factor * error[:, k]}, sigma)

    def _values(self, estimate: Series) -> Iterator[dict[str, Any]]:
        for field in _FIELDS:
            found = find(estimate, field)
            if found is None or found[0].ndim != 2:
                continue
            value, unit = found[0], self._unit(estimate, field)[0]
            spread = covariance_of(estimate, field)
            right = None
            if self.truth is not None and len(self.truth) and find(self.truth, field) is not None:
                right = between(self.truth, field, estimate.time)
            if field == "attitude":
                yield from self._angles(estimate, value, right, spread)
                continue
            names = components(field, value.shape[1])
            for k in range(value.shape[1]):
                sigma = None if spread is None else 3.0 * deviation(spread[:, k, k])
                lines = {"estimate": value[:, k]} | ({} if right is None else {"truth": right[:, k]})
                panel = self._panel(
                    "Estimate", f"{_words(field)} {names[k]}", unit, estimate.time, lines, sigma
                )
                if field == "position":
                    panel["points"] = [p for p in (self._measured(n, k) for n in self.inputs) if p]
                yield panel

    def _angles(
        self, estimate: Series, q: np.ndarray, right: np.ndarray | None, spread: np.ndarray | None
    ) -> Iterator[dict[str, Any]]:
        angles = euler_angles(q, self.order)
        true = None
        if right is not None:
            known = np.isfinite(right).all(axis=1)
            true = np.full((len(q), 3), np.nan)
            if known.any():
                true[known] = euler_angles(right[known], self.order)
                true += 360 * np.round((angles - true) / 360)  # the same turn as the estimate's
        variance = None if spread is None else euler_variances(q, spread, self.order)
        for k in range(3):
            sigma = None if variance is None else np.minimum(3.0 * deviation(variance[:, k]), 180.0)
            lines = {"estimate": angles[:, k]} | ({} if true is None else {"truth": true[:, k]})
            yield self._panel("Estimate", NAMES[k], "[deg]", estimate.time, lines, sigma)

    def _innovations(self, name: str, series: Series) -> Iterator[dict[str, Any]]:
        residual, spread, value = (find(series, f) for f in ("residual", "covariance", "nis"))
        if residual is not None and residual[0].ndim == 2 and residual[0].shape[1] <= _SMALL:
            for k in range(residual[0].shape[1]):
                own = None
                if spread is not None and spread[0].shape[1:] == (residual[0].shape[1],) * 2:
                    own = 3.0 * deviation(spread[0][:, k, k])
                yield self._panel(
                    "Innovations", f"{_words(name)} {k + 1}", unit_words(residual[1].unit, residual[1].frame),
                    series.time, {"innovation": residual[0][:, k]}, own, dots=True,
                )  # fmt: skip
        assert value is not None
        parts = find(series, "parts")
        degrees = np.full(len(series), 1.0) if parts is None else np.asarray(parts[0], dtype=float)
        if parts is None and residual is not None:
            degrees *= residual[0].shape[-1]
        self.notes += (far := far_nis(measured(name), series))
        yield from self._squared(
            f"{_words(name)}: NIS",
            series.time,
            np.asarray(value[0], float),
            degrees,
            wrong=bool(far),
            dots=True,
        )

    def _nees(self, estimate: Series, truth: Series) -> Iterator[dict[str, Any]]:
        found = nees(estimate, truth) if len(truth) else None
        if found is not None:
            value, degrees = found
            known = value[np.isfinite(value)]
            mean = float(np.mean(known)) / degrees if len(known) else 1.0
            title = f"{_words(self.name)}: NEES"
            if wrong := is_far(mean, float(degrees * len(known))):
                self.notes.append(
                    note("warning", f"{title} is {mean:.3g} per number on average, and should be 1")
                )
            yield from self._squared(
                title, estimate.time, value, np.full(len(value), float(degrees)), wrong=wrong
            )

    def _squared(
        self,
        title: str,
        time: np.ndarray,
        value: np.ndarray,
        degrees: np.ndarray,
        *,
        wrong: bool,
        dots: bool = False,
    ) -> Iterator[dict[str, Any]]:
        """A normalised square with what it should be, marked where it is far from that."""
        known = np.isfinite(value) & (degrees > 0)
        if not known.any():
            return
        mean = float(np.mean(value[known] / degrees[known]))
        typical = int(np.median(degrees[known]))
        low, high = bounds(max(typical, 1))
        inside = float(np.mean((value[known] >= low) & (value[known] <= high)))
        words = f"mean {mean:.3g} of 1 per number, {100 * inside:.0f} % inside (95 % is right)"
        lines = {"value": np.where(known, value, np.nan), "expected": degrees}
        panel = self._panel("Consistency", title, "", time, lines, None, dots=dots)
        top = max(2.5 * high, float(np.quantile(value[known], 0.99)))
        panel |= {"range": [0.0, top], "whole": None, "words": words, "bounds": [low, high], "wrong": wrong}
        yield panel

    def _others(self, name: str, series: Series) -> Iterator[dict[str, Any]]:
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            flat = array[:, None] if array.ndim == 1 else array
            if flat.ndim != 2 or not 1 <= flat.shape[1] <= _SMALL:
                continue
            group = (
                "Particles" if "sample_size" in name or "deplet" in name or "resampl" in field else "Outputs"
            )
            words = _words(name) if field == "value" else f"{_words(name)}: {_words(field)}"
            names = components(field, flat.shape[1]) if flat.shape[1] > 1 else ("value",)
            lines = {names[k]: flat[:, k].astype(float) for k in range(flat.shape[1])}
            yield self._panel(group, words, unit_words(type_.unit, type_.frame), series.time, lines, None)

    def _measured(self, name: str, k: int) -> dict[str, Any] | None:
        """What a sensor said of the position, as dots."""
        series = self.inputs[name]
        found = find(series, "position")
        if found is None or found[0].ndim != 2 or k >= found[0].shape[1] or not len(series):
            return None
        some = slice(None, None, -(-len(series) // self.points))
        return {"name": name, "t": self._seconds(series.time[some]), "y": packed(found[0][some, k])}

    def _unit(self, series: Series, field: str) -> tuple[str, float]:
        if field in _DEGREES:
            unit, factor = _DEGREES[field]
            return f"[{unit}]", float(factor)
        found = find(series, field)
        return ("", 1.0) if found is None else (unit_words(found[1].unit, found[1].frame), 1.0)

    def _stored(self, time: np.ndarray) -> int:
        """The place of these times in `times`, where panels share them."""
        made = self._seconds(time)
        if made not in self.times:
            self.times.append(made)
        return self.times.index(made)

    def _seconds(self, time: np.ndarray) -> str:
        return packed((time - self.begin) * 1e-9)

    def _panel(
        self,
        group: str,
        title: str,
        unit: str,
        time: np.ndarray,
        lines: Mapping[str, np.ndarray],
        sigma: np.ndarray | None,
        *,
        dots: bool = False,
    ) -> dict[str, Any]:
        every = {name: np.asarray(line, dtype=float) for name, line in lines.items()}
        ends = dict(every)
        if sigma is not None:
            middle = every["estimate"] if "estimate" in every else np.zeros(len(time))
            ends |= {"low": middle - sigma, "high": middle + sigma}
        at = extremes(list(ends.values()), self.points)
        panel: dict[str, Any] = {
            "group": group, "title": title, "unit": unit, "dots": dots, "t": self._stored(time[at]),
            "lines": [{"name": n, "y": packed(v[at])} for n, v in every.items()],
            "sigma": None if sigma is None else packed(sigma[at]),
        }  # fmt: skip
        return panel | _scale(time, list(every.values()), list(ends.values()))


def _scale(time: np.ndarray, lines: Sequence[np.ndarray], ends: Sequence[np.ndarray]) -> dict[str, Any]:
    """The range of a panel with these lines, which with their bands reach to `ends`, and what lies beyond."""
    settled = np.ones(len(time), bool)
    if len(time) >= 20:
        settled = time >= time[0] + SETTLING * (time[-1] - time[0])
    late, own = _range([v[settled] for v in ends]), _range([v[settled] for v in lines])
    begun, whole = _range(lines), _range(ends)
    if late is None or own is None or begun is None or whole is None:
        return {"range": [0.0, 1.0], "words": f"none of {len(time)} values is finite"}
    if begun[1] - begun[0] <= WIDER * (late[1] - late[0]):  # the start hides nothing
        late, own = (min(late[0], begun[0]), max(late[1], begun[1])), begun
    if late[1] - late[0] > 12 * (own[1] - own[0]) > 0:  # a band so wide that it would hide what it is of
        room = 3 * (own[1] - own[0])
        late = max(late[0], own[0] - room), min(late[1], own[1] + room)
    room = 0.06 * (late[1] - late[0]) or 0.1 * abs(late[0]) or 1.0
    low, high = late[0] - room, late[1] + room
    if low <= begun[0] and begun[1] <= high:
        return {"range": [low, high]}
    words = f"the start reaches {begun[0]:.3g} to {begun[1]:.3g}"
    return {"range": [low, high], "words": words, "whole": [min(whole[0], low), max(whole[1], high)]}


def _words(name: str) -> str:
    return name.replace("_", " ")


def _range(arrays: Sequence[np.ndarray]) -> tuple[float, float] | None:
    values = np.concatenate([np.ravel(a) for a in arrays])
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else None


def extremes(columns: Sequence[np.ndarray], most: int) -> np.ndarray:
    """Indices, in order, of about `most` rows that hold the least and greatest of each column in each of
    equal stretches, and the first and last row; all where they are as few.

    Args:
        columns: arrays (n,) of the same length; NaN is passed over where there is a number.
    """
    n = len(columns[0]) if columns else 0
    if n <= most:
        return np.arange(n)
    stretches = max(most // (2 * len(columns)), 1)
    edges = np.linspace(0, n, stretches + 1).astype(int)
    size = int(np.diff(edges).max())
    rows = np.minimum(edges[:-1, None] + np.arange(size), edges[1:, None] - 1)
    found = [np.array([0, n - 1])]
    for column in columns:
        block = np.asarray(column, dtype=float)[rows]
        for empty, pick in ((np.inf, np.argmin), (-np.inf, np.argmax)):
            at = pick(np.where(np.isnan(block), empty, block), axis=1)
            found.append(np.take_along_axis(rows, at[:, None], axis=1)[:, 0])
        gaps = np.isnan(block)
        found.append(rows[gaps.any(axis=1), gaps[gaps.any(axis=1)].argmax(axis=1)])  # a gap stays a gap
    return np.unique(np.concatenate(found))


__all__ = ["POINTS", "Scopes", "extremes"]
