"""Tuning: noise parameters of one graph, fitted to several recordings, and judged by others.

What is sought is the logarithm of each parameter, between bounds; what is made small stands in
`flowgraph/study/trials.py`. Recordings that are held out take no part in the search. With folds each
recording is held out once, of a search over others. Each is judged at the start of the search, with what was
found, and with the graph's own settings.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph.data.registry import find_graph
from flowgraph.data.settings import parsed_settings
from flowgraph.engines.registry import engine_names
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.study.spec import Value, text
from flowgraph.study.tasks import flight_part
from flowgraph.study.trials import ASTRAY, Judged, Recording, Trials, surprise

__all__ = ["MEASURES", "METHODS", "Fit", "Found", "Judged", "Recording", "Tuned", "surprise", "tune"]

MEASURES = ("likelihood", "error")
METHODS = ("L-BFGS-B", "Nelder-Mead", "Powell")
_STEP = 1e-3


@dataclass(frozen=True)
class Fit:
    """A parameter to find: a setting of the graph between `low` and `high`, positive; from `start`."""

    name: str
    low: float
    high: float
    start: float | None = None


@dataclass(frozen=True)
class Found:
    """Where a search ended.

    Args:
        parameters: the values found.
        evaluations: how many points were tried, on all its recordings each.
        converged: whether the search ended by itself; `message` says how.
        at_bound: parameters that ended at a bound, so that the least lies beyond it, each with "low" or
            "high".
    """

    parameters: dict[str, float]
    evaluations: int
    converged: bool
    message: str
    at_bound: dict[str, str]


@dataclass(frozen=True)
class Tuned(Found):
    """What was found.

    Args:
        graph: its name.
        start: where the search began.
        measure, metric: what was made small.
        judged: each recording before and after. Where there are folds, each once, held out of its own.
        folds: what each search found that left a part of the recordings out; `parameters` are of the search
            over all.
        without_effect: parameters whose farther bound gives the same measure on every recording fitted to.
    """

    graph: str
    start: dict[str, float]
    measure: str
    metric: str | None
    judged: tuple[Judged, ...]
    folds: tuple[Found, ...] = ()
    without_effect: tuple[str, ...] = ()

    def mean(self, *, held_out: bool) -> tuple[float, float, float] | None:
        """The measure before, after and of the graph's own, over the recordings of one kind; None without.

        Of an error it is the mean logarithm.
        """
        found = [(j.before, j.after, j.own) for j in self.judged if j.held_out == held_out]
        if not found:
            return None
        before, after, own = np.mean(found, axis=0).tolist()
        return before, after, own


def tune(
    graph: str,
    fits: Sequence[Fit],
    recordings: Sequence[Recording],
    held_out: Sequence[Recording] = (),
    *,
    folds: int | None = None,
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
        folds: instead, so many parts of the recordings (the k-th, the k + folds-th ...) are held out in turn
            of a search over the others, and judged by what that one found. As many as there are recordings
            leave out one at a time.
        measure: "likelihood" of the innovations or "error" against the truth.
        metric: the error to make small; the first that the graph's score has if left out.
        settings: other settings of graph and flights, as `--set`.
        method: "L-BFGS-B" (by central differences; the default for likelihood), "Nelder-Mead" (the default
            for an error, which may be rough) or "Powell".
        engine: in "xla" and "c" all recordings of the same ticks and all points of a gradient go together.
        most: points to try at most, about, in each search.
        watch: told the number of points tried, the best so far and its measure.

    Raises:
        UnknownNameError, DeclarationError: for what cannot be asked.
        DataError: where a graph collects no innovations, or a flight has no truth, or a loader refuses.
    """
    method = method or ("L-BFGS-B" if measure == "likelihood" else "Nelder-Mead")
    for kind, given, valid in (
        ("measure", measure, MEASURES), ("method", method, METHODS), ("engine", engine, engine_names()),
    ):  # fmt: skip
        if given not in valid:
            raise UnknownNameError(kind, given, valid, path="tune")
    settings = dict(settings or {})
    _check(graph, fits, recordings, held_out, settings, most, folds)
    problem = Trials(graph, [*recordings, *held_out], settings, measure, metric, engine)
    if same := problem.twice():
        raise _wrong("data", "recordings that differ, each once, fitted to or held out", same)
    start = {f.name: _start(graph, f) for f in fits}
    whole = range(len(recordings))

    def search(places: Sequence[int]) -> Found:
        return _search(problem, fits, start, places, method, most, watch)

    parts: list[Found] = []
    judged: list[Judged] = []
    for k in range(folds or 0):
        parts.append(search([i for i in whole if i % (folds or 1) != k]))
        out = [i for i in whole if i % (folds or 1) == k]
        judged += problem.judged(out, start, parts[-1].parameters, held_out=True, fold=k)
    found = search(whole)
    if not parts:
        judged = problem.judged(whole, start, found.parameters, held_out=False)
        later = range(len(recordings), len(recordings) + len(held_out))
        judged += problem.judged(later, start, found.parameters, held_out=True)
    judged.sort(key=lambda j: problem.recordings.index(j.recording))
    return Tuned(
        found.parameters, found.evaluations, found.converged, found.message, found.at_bound,
        graph, start, measure, problem.metric, tuple(judged), tuple(parts),
        _without_effect(problem, fits, found.parameters, whole),
    )  # fmt: skip


def _without_effect(
    problem: Trials, fits: Sequence[Fit], found: Mapping[str, float], places: Sequence[int]
) -> tuple[str, ...]:
    """The parameters that move no measure to the last bit, from what was found to the farther bound."""
    far = [{f.name: f.high if found[f.name] ** 2 < f.low * f.high else f.low} for f in fits]
    base, *moved = problem.measured([dict(found), *({**found, **one} for one in far)], places)
    works = base < ASTRAY
    return tuple(
        f.name for f, row in zip(fits, moved, strict=True) if works.any() and (row == base)[works].all()
    )


def _start(graph: str, fit: Fit) -> float:
    """Where to begin: as told, or at the graph's own value, or in the middle of the bounds."""
    prepare = find_graph(graph).prepare
    if fit.start is not None:
        return float(fit.start)
    known = None if prepare is None else inspect.signature(prepare).parameters.get(fit.name)
    own = None if known is None else known.default
    if isinstance(own, float | int) and not isinstance(own, bool) and fit.low <= own <= fit.high:
        return float(own)
    return math.sqrt(fit.low * fit.high)


def _search(
    problem: Trials,
    fits: Sequence[Fit],
    begin: Mapping[str, float],
    places: Sequence[int],
    method: str,
    most: int,
    watch: Callable[[int, Mapping[str, float], float], None] | None,
) -> Found:
    """Make the mean measure over some recordings small, in the logarithms of the parameters."""
    low, high = (np.log([getattr(f, n) for f in fits]) for n in ("low", "high"))
    start = np.clip(np.log([begin[f.name] for f in fits]), low, high)
    count, best = 0, (math.inf, start)

    def named(x: np.ndarray) -> dict[str, float]:
        return {f.name: float(v) for f, v in zip(fits, np.exp(x), strict=True)}

    def values(points: np.ndarray) -> np.ndarray:
        nonlocal count, best
        found = problem.measured([named(x) for x in points], places).mean(axis=1)
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

    from scipy import optimize  # half a second that only a search needs

    minimize: Callable[..., Any] = optimize.minimize
    limits: dict[str, Any]
    how: dict[str, Any] = {"method": method, "bounds": list(zip(low, high, strict=True))}
    if method == "L-BFGS-B":
        limits = {"maxfun": max(1, most // (2 * len(fits) + 1)), "ftol": 1e-8}
        ended = minimize(with_slope, start, jac=True, options=limits, **how)
    else:
        names = {"Nelder-Mead": ("xatol", "fatol"), "Powell": ("xtol", "ftol")}[method]
        limits = {"maxfev": most, names[0]: 1e-3, names[1]: 1e-6}
        if method == "Nelder-Mead":  # scipy's own first steps are a part of x, which is next to none at x = 0
            limits["initial_simplex"] = np.vstack([start, start + np.diag(_first_steps(start, low, high))])
        ended = minimize(lambda x: float(values(x[None])[0]), start, options=limits, **how)
    ends = zip(fits, best[1], low, high, strict=True)
    at_bound = {f.name: "low" if x - a < b - x else "high" for f, x, a, b in ends if min(x - a, b - x) < 2e-3}
    return Found(named(best[1]), count, bool(ended.success), str(ended.message), at_bound)


def _first_steps(start: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """A quarter of the way between the bounds, at most a factor e, towards the farther one."""
    sign = np.where(high - start >= start - low, 1.0, -1.0)
    return np.asarray(sign * np.minimum(1.0, 0.25 * (high - low)))


def _wrong(place: str, expected: str, got: object) -> DeclarationError:
    return DeclarationError(
        "this cannot be tuned",
        path=f"tune, {place}",
        expected=expected,
        got=repr(got),
        fix=f"mend {place}",
    )


def _check(
    graph: str, fits: Sequence[Fit], recordings: Sequence[Recording], held_out: Sequence[Recording],
    settings: Mapping[str, Value], most: int, folds: int | None,
) -> None:  # fmt: skip
    if not fits:
        raise _wrong("fit", "one parameter or more, such as position_noise=0.001:0.1", "none")
    if not recordings:
        raise _wrong("data", "one recording or more", "none")
    if type(most) is not int or most < 1:
        raise _wrong("most", "a whole number from 1", most)
    if folds is not None and (type(folds) is not int or not 2 <= folds <= len(recordings)):
        raise _wrong("folds", f"a whole number from 2 to that of the recordings, {len(recordings)}", folds)
    if folds is not None and held_out:
        raise _wrong("folds", "either folds or recordings that are held out", f"{len(held_out)} held out")
    prepare = find_graph(graph).prepare
    for fit in fits:
        numbers = [fit.low, fit.low if fit.start is None else fit.start, fit.high]
        if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers) or not (
            0 < fit.low < fit.high and fit.low <= numbers[1] <= fit.high
        ):
            raise _wrong(f"fit {fit.name}", "0 < low <= start <= high, low < high", fit)
        if fit.name in settings or sum(f.name == fit.name for f in fits) > 1:
            raise _wrong(f"fit {fit.name}", "each parameter once, and not set as well", fit.name)
        if fit.name in getattr(prepare, "scoring", ()):
            raise _wrong(
                f"fit {fit.name}", "a setting of the filter; this one changes how a run is scored", fit.name
            )
        if any(flight_part(r.data, {fit.name: fit.low}) for r in (*recordings, *held_out)):
            raise _wrong(f"fit {fit.name}", "a setting of the graph that is none of the flight", fit.name)
        if prepare is not None:
            parsed_settings(prepare, {fit.name: text(float(fit.low))}, also=(), path=graph)
