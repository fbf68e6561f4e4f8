"""Tuning: noise parameters of one graph, fitted to several recordings, and judged by others.

Two measures can be made small. With `likelihood`, the negative logarithm of how likely the innovations r of
covariance S are, a value read,

    1/2 (r^T S^-1 r + log det S + m log 2 pi)        summed over all, over the number of values

which needs no truth, and has its least where the filter is as sure as it is right (R. Mehra, "On the
identification of variances and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970; F. C.
Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11(1),
1965). With `error`, the mean over recordings of the logarithm of a metric against the truth, so that a
recording counts by how much better it gets and not by how hard it is.

What is sought is the logarithm of each parameter, between bounds. Recordings that are held out take no part
in the search; before and after are given for both.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph.errors import DataError, DeclarationError, UnknownNameError
from flowgraph.recording import remembering
from flowgraph.registry import Case, find_graph, parsed_settings
from flowgraph.result import Result
from flowgraph.series import Flight
from flowgraph.simulate import ENGINES, simulate
from flowgraph.study.spec import Value, text
from flowgraph.study.tasks import MANY, flight_part, grouped, prepared, simulate_together

MEASURES = ("likelihood", "error")
METHODS = ("L-BFGS-B", "Nelder-Mead", "Powell")
_STEP = 1e-3
_ASTRAY = 1e6
"""What a recording counts on which the filter fails: more than any that works."""


@dataclass(frozen=True)
class Recording:
    """A flight to fit to or to judge by, and the seed of it and of the run."""

    data: str
    seed: int = 0


@dataclass(frozen=True)
class Fit:
    """A parameter to find: a setting of the graph between `low` and `high`, positive; from `start`."""

    name: str
    low: float
    high: float
    start: float | None = None


@dataclass(frozen=True)
class Judged:
    """One recording before and after, by the measure that was made small and by the metrics."""

    recording: Recording
    held_out: bool
    before: float
    after: float
    metrics: Mapping[str, tuple[float, float]] = field(default_factory=dict)


@dataclass(frozen=True)
class Tuned:
    """What was found.

    Args:
        graph: its name.
        parameters: the values found.
        start: those of the search's start; "before" is the graph with its own.
        measure, metric: what was made small.
        judged: each recording, before and after.
        evaluations: how many points were tried, on all recordings each.
        converged: whether the search ended by itself; `message` says how.
        at_bound: parameters that ended at a bound, so that the least lies beyond it.
    """

    graph: str
    parameters: dict[str, float]
    start: dict[str, float]
    measure: str
    metric: str | None
    judged: tuple[Judged, ...]
    evaluations: int
    converged: bool
    message: str
    at_bound: tuple[str, ...]

    def mean(self, *, held_out: bool) -> tuple[float, float] | None:
        """The measure before and after, over the recordings of one kind; None without any."""
        found = [(j.before, j.after) for j in self.judged if j.held_out == held_out]
        return (
            (float(np.mean([b for b, _ in found])), float(np.mean([a for _, a in found]))) if found else None
        )


def tune(
    graph: str,
    fits: Sequence[Fit],
    recordings: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    measure: str = "likelihood",
    metric: str | None = None,
    settings: Mapping[str, Value] | None = None,
    method: str | None = None,
    engine: str = "reference",
    most: int = 200,
    watch: Callable[[int, Mapping[str, float], float], None] | None = None,
) -> Tuned:
    """Find the parameters of a graph that suit the recordings best.

    Args:
        graph: its name.
        fits: what to find.
        recordings: to fit to.
        held_out: to judge by only.
        measure: "likelihood" of the innovations or "error" against the truth.
        metric: the error to make small; the first that the graph's score has if left out.
        settings: other settings of graph and flights, as `--set`.
        method: "L-BFGS-B" (by central differences; the default for likelihood), "Nelder-Mead" (the default
            for an error, which may be rough) or "Powell".
        engine: in "xla" all recordings of the same ticks and all points of a gradient go together.
        most: points to try at most, about.
        watch: told the number of points tried, the best so far and its measure.

    Raises:
        UnknownNameError, DeclarationError: for what cannot be asked.
        DataError: where a graph collects no innovations, or a flight has no truth, or a loader refuses.
    """
    method = method or ("L-BFGS-B" if measure == "likelihood" else "Nelder-Mead")
    for kind, given, valid in (
        ("measure", measure, MEASURES), ("method", method, METHODS), ("engine", engine, ENGINES),
    ):  # fmt: skip
        if given not in valid:
            raise UnknownNameError(kind, given, valid, path="tune")
    settings = dict(settings or {})
    _check(graph, fits, recordings, held_out, settings, most)
    problem = _Problem(graph, [*recordings, *held_out], settings, measure, metric, engine)
    low, high = (np.log([getattr(f, n) for f in fits]) for n in ("low", "high"))
    start = np.log([f.start or math.sqrt(f.low * f.high) for f in fits])
    count, best = 0, (math.inf, start)

    def named(x: np.ndarray) -> dict[str, float]:
        return {f.name: float(v) for f, v in zip(fits, np.exp(x), strict=True)}

    def values(points: np.ndarray) -> np.ndarray:
        nonlocal count, best
        found = problem.measured([named(x) for x in points], len(recordings)).mean(axis=1)
        count += len(points)
        if found.min() < best[0]:
            best = float(found.min()), points[int(found.argmin())]
        if watch is not None:
            watch(count, named(best[1]), best[0])
        return np.asarray(found)

    def with_slope(x: np.ndarray) -> tuple[float, np.ndarray]:
        """The measure and its slope, by central differences that stay within the bounds."""
        ends = [np.clip(x + s * _STEP * e, low, high) for e in np.eye(len(x)) for s in (1.0, -1.0)]
        found = values(np.array([x, *ends]))
        steps = np.array([(a - b).sum() for a, b in zip(ends[::2], ends[1::2], strict=True)])
        return float(found[0]), (found[1::2] - found[2::2]) / steps

    from scipy import optimize

    minimize: Callable[..., Any] = optimize.minimize
    how: dict[str, Any] = {"method": method, "bounds": list(zip(low, high, strict=True))}
    if method == "L-BFGS-B":
        limits = {"maxfun": max(1, most // (2 * len(fits) + 1)), "ftol": 1e-8}
        ended = minimize(with_slope, start, jac=True, options=limits, **how)
    else:
        names = {"Nelder-Mead": ("xatol", "fatol"), "Powell": ("xtol", "ftol")}[method]
        limits = {"maxfev": most, names[0]: 1e-3, names[1]: 1e-6}
        ended = minimize(lambda x: float(values(x[None])[0]), start, options=limits, **how)
    found = named(best[1])
    at_bound = tuple(
        f.name for f, x, a, b in zip(fits, best[1], low, high, strict=True) if min(x - a, b - x) < 2e-3
    )
    return Tuned(
        graph, found, named(start), measure, problem.metric, problem.judged(found, len(recordings)), count,
        bool(ended.success), str(ended.message), at_bound,
    )  # fmt: skip


class _Problem:
    """A graph on recordings, each loaded once."""

    def __init__(
        self, graph: str, recordings: Sequence[Recording], settings: Mapping[str, Value],
        measure: str, metric: str | None, engine: str,
    ) -> None:  # fmt: skip
        self.graph, self.recordings, self.settings = graph, recordings, settings
        self.measure, self.metric, self.engine = measure, metric, engine
        self._flights: list[Flight] = []
        self._steps: OrderedDict[Any, Any] = OrderedDict()
        for one in recordings:
            _, flight = prepared(graph, one.data, one.seed, settings)
            self._flights.append(flight)

    def _case(self, place: int, point: Mapping[str, float]) -> Case:
        one = self.recordings[place]
        flight = self._flights[place]
        with remembering(self._steps):  # only the blocks whose settings move are recorded anew
            return prepared(self.graph, one.data, one.seed, {**self.settings, **point}, flight)[0]

    def _results(self, cases: Sequence[Case], places: Sequence[int]) -> list[Result | Exception]:
        """A result a case; of one that raises, what it raises."""
        found: list[Result | Exception] = []
        if self.engine not in MANY:
            for case, place in zip(cases, places, strict=True):
                seed = self.recordings[place].seed
                try:
                    found.append(simulate(case.graph, case.inputs, engine=self.engine, seed=seed))
                except Exception as error:
                    found.append(error)
            return found
        made: dict[int, Result | Exception] = {}
        for program, members in grouped(cases):
            seeds = [self.recordings[places[k]].seed for k in members]
            several = [cases[k] for k in members]
            chunk = min(64, 2 ** math.ceil(math.log2(len(members))))
            try:
                results: Sequence[Any] = simulate_together(
                    several, seeds, program=program, engine=self.engine, dtype="float64", chunk=chunk
                )
            except Exception as error:
                results = [error] * len(members)
            made.update(zip(members, results, strict=True))
        return [made[k] for k in range(len(cases))]

    def measured(self, points: Sequence[Mapping[str, float]], count: int) -> np.ndarray:
        """The measure (points, recordings) on the first `count` recordings."""
        pairs = [(p, k) for p in points for k in range(count)]
        cases = [self._case(k, p) for p, k in pairs]
        results = self._results(cases, [k for _, k in pairs])
        found = [self._value(c, r) for c, r in zip(cases, results, strict=True)]
        return np.array(found).reshape(len(points), count)

    def _value(self, case: Case, result: Result | Exception) -> float:
        if isinstance(result, DataError):
            raise result  # the recording is wrong, whatever the parameters
        if isinstance(result, Exception):
            return _ASTRAY
        if self.measure == "likelihood":
            value = surprise(result)
        else:
            error = self._score(case, result)
            value = math.log(error) if error > 0 else _ASTRAY
        return min(value, _ASTRAY) if math.isfinite(value) else _ASTRAY

    def _score(self, case: Case, result: Result) -> float:
        score = case.score(result)
        self.metric = self.metric or next(iter(score), None)
        if self.metric not in score:
            raise DataError(
                "there is no such error to make small",
                path=f"tune, {self.graph}",
                expected=", ".join(score) or "a flight with a truth",
                got=str(self.metric),
                fix="choose another metric, or measure=likelihood, which needs no truth",
            )
        return float(score[self.metric])

    def judged(self, point: Mapping[str, float], fitted: int) -> tuple[Judged, ...]:
        """Each recording with the graph's own values and with those found."""
        found = []
        for k, one in enumerate(self.recordings):
            cases = [self._case(k, {}), self._case(k, point)]
            results = self._results(cases, [k, k])
            before, after = (self._value(c, r) for c, r in zip(cases, results, strict=True))
            scores = [
                c.score(r) if isinstance(r, Result) else {} for c, r in zip(cases, results, strict=True)
            ]
            both = {n: (scores[0][n], scores[1][n]) for n in scores[0] if n in scores[1]}
            found.append(Judged(one, k >= fitted, before, after, both))
        return tuple(found)


def surprise(result: Result) -> float:
    """The negative log-likelihood of all innovations of a run, a measured value.

    Raises:
        DataError: where the graph collects none: streams with a `residual` and its `covariance`.
    """
    total, count = 0.0, 0.0
    for series in result.series.values():
        names = series.leaves
        if not {"residual", "covariance"} <= set(names) or not len(series):
            continue
        r, S = names["residual"], names["covariance"]
        sign, size = np.linalg.slogdet(S)
        if not (sign > 0).all() or not np.isfinite(r).all():
            return math.inf
        parts = names["parts"] if "parts" in names else np.full(len(r), float(r.shape[-1]))
        nis = (r * np.linalg.solve(S, r[..., None])[..., 0]).sum(-1)
        total += 0.5 * float((nis + size + parts * math.log(2.0 * math.pi)).sum())
        count += float(parts.sum())
    if not count:
        raise DataError(
            "this graph collects no innovations",
            path=f"tune, {result.graph}",
            expected="an output with the fields residual and covariance, with events",
            got=", ".join(result.series) or "no outputs",
            fix="tune by error, or collect the innovation in the graph",
        )
    return total / count


def _check(
    graph: str, fits: Sequence[Fit], recordings: Sequence[Recording], held_out: Sequence[Recording],
    settings: Mapping[str, Value], most: int,
) -> None:  # fmt: skip
    def wrong(place: str, expected: str, got: object) -> DeclarationError:
        return DeclarationError(
            "this cannot be tuned",
            path=f"tune, {place}",
            expected=expected,
            got=repr(got),
            fix=f"mend {place}",
        )

    if not fits:
        raise wrong("fit", "one parameter or more, such as position_noise=0.001:0.1", "none")
    if not recordings:
        raise wrong("data", "one recording or more", "none")
    both = [r for r in recordings if r in held_out]
    if both:
        raise wrong("held-out", "recordings that are not fitted to", both[0])
    if type(most) is not int or most < 1:
        raise wrong("most", "a whole number from 1", most)
    prepare = find_graph(graph).prepare
    for fit in fits:
        numbers = [x for x in (fit.low, fit.start or fit.low, fit.high)]
        if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers) or not (
            0 < fit.low < fit.high and fit.low <= numbers[1] <= fit.high
        ):
            raise wrong(f"fit {fit.name}", "0 < low <= start <= high, low < high", fit)
        if fit.name in settings or sum(f.name == fit.name for f in fits) > 1:
            raise wrong(f"fit {fit.name}", "each parameter once, and not set as well", fit.name)
        if any(flight_part(r.data, {fit.name: fit.low}) for r in recordings):
            raise wrong(f"fit {fit.name}", "a setting of the graph, not one of the flight", fit.name)
        if prepare is not None:
            parsed_settings(prepare, {fit.name: text(float(fit.low))}, also=(), path=graph)
