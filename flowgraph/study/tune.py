"""Tuning: noise parameters of one graph, fitted to several recordings, and judged by others.

What is sought is the logarithm of each parameter, between bounds (`coordinates`); what is made small stands
in `trials`. The slope of a likelihood comes with it where it has one (`slopes`), else it is of differences. A
parameter found by likelihood has a standard deviation: the root of the inverse of the observed information,
the second derivative of the likelihood of all that was measured.

Recordings that are held out take no part in the search. With folds each recording is held out once, of a
search over others. Each is judged at the start of the search, with what was found, and with the graph's own
settings.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flowgraph.data.registry import find_graph, flight_settings
from flowgraph.data.settings import keyword_types, parsed_settings, text
from flowgraph.engines.registry import engine_names
from flowgraph.errors import DeclarationError, UnknownNameError
from flowgraph.study.coordinates import Coordinates, Fit, Parameter
from flowgraph.study.search import Found, Search
from flowgraph.study.spec import Value
from flowgraph.study.tasks import flight_part
from flowgraph.study.trials import ASTRAY, Judged, Recording, Trials, surprise

__all__ = ["MEASURES", "METHODS", "Fit", "Found", "Judged", "Recording", "Tuned", "surprise", "tune"]

MEASURES = ("likelihood", "error")
METHODS = ("L-BFGS-B", "Nelder-Mead", "Powell")
SLOPES = ("forward", "differences")
TRIPLES = ("lever", "mount")
PLACED = ("time_offset", *TRIPLES)
"""Settings of a flight's streams that are parameters: when a sensor was read, where it sits and how."""


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
    start: dict[str, Parameter]
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
    slopes: str | None = None,
    engine: str = "reference",
    most: int = 200,
    watch: Callable[[int, Mapping[str, Parameter], float], None] | None = None,
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
        method: "L-BFGS-B" (by slopes; the default for likelihood), "Nelder-Mead" (the default for an error,
            which may be rough) or "Powell".
        slopes: "forward" derivatives of the likelihood, where it has any, or "differences"; forward in an
            engine that plays pipelines if left out.
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
        ("slopes", slopes or SLOPES[0], SLOPES),
    ):  # fmt: skip
        if given not in valid:
            raise UnknownNameError(kind, given, valid, path="tune")
    settings = dict(settings or {})
    _check(graph, fits, recordings, held_out, settings, most, folds)
    problem = Trials(graph, [*recordings, *held_out], settings, measure, metric, engine)
    if same := problem.twice():
        raise _wrong("data", "recordings that differ, each once, fitted to or held out", same)
    start = {f.name: start_of_fit(graph, f) for f in fits}
    whole = range(len(recordings))

    def search(places: Sequence[int]) -> Found:
        searched = Search(problem, Coordinates(fits, start), places, forward=slopes != "differences")
        return searched.run(method, most, watch)

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
        found.deviations, graph, start, measure, problem.metric, tuple(judged), tuple(parts),
        _without_effect(problem, fits, found.parameters, whole),
    )  # fmt: skip


def _without_effect(
    problem: Trials, fits: Sequence[Fit], found: Mapping[str, Parameter], places: Sequence[int]
) -> tuple[str, ...]:
    """The parameters that move no measure to the last bit, from what was found to the farther bound."""
    far = [{f.name: _far(f, found[f.name])} for f in fits]
    base, *moved = problem.measured([dict(found), *({**found, **one} for one in far)], places)
    works = base < ASTRAY
    return tuple(
        f.name for f, row in zip(fits, moved, strict=True) if works.any() and (row == base)[works].all()
    )


def placed(name: str) -> bool:
    """Whether a parameter says when a sensor was read, or where it sits: it may have either sign."""
    return "." in name and name.rpartition(".")[2] in PLACED


def _far(fit: Fit, found: Parameter) -> Parameter:
    """The farther bound of a number; of an array, all of it so much larger or smaller."""
    if fit.scale == "linear":
        middle = 0.5 * (fit.low + fit.high)
        return (
            np.where(np.asarray(found) < middle, fit.high, fit.low)
            if np.ndim(found)
            else (fit.high if found < middle else fit.low)
        )
    if np.ndim(found) == 0:
        return fit.high if float(found) ** 2 < fit.low * fit.high else fit.low
    return np.asarray(found) * 10.0


def start_of_fit(graph: str, fit: Fit) -> Parameter:
    """Where to begin: as told, or at the graph's own value, or in the middle of the bounds."""
    prepare = find_graph(graph).prepare
    if fit.start is not None:
        return np.asarray(fit.start, dtype=float) if np.ndim(fit.start) else float(fit.start)
    known = None if prepare is None else inspect.signature(prepare).parameters.get(fit.name)
    own = None if known is None else known.default
    if isinstance(own, np.ndarray):
        return own
    if isinstance(own, float | int) and not isinstance(own, bool) and fit.low <= own <= fit.high:
        return float(own)
    if fit.name.rpartition(".")[2] in TRIPLES:
        return np.full(3, 0.5 * (fit.low + fit.high))
    return 0.5 * (fit.low + fit.high) if fit.scale == "linear" else math.sqrt(fit.low * fit.high)


def _wrong(
    place: str, expected: str, got: object, *, verb: str = "tune", fix: str | None = None
) -> DeclarationError:
    return DeclarationError(
        f"this cannot be {verb.removesuffix('e')}ed",
        path=f"{verb}, {place}",
        expected=expected,
        got=repr(got),
        fix=fix or f"mend {place}",
    )


def _check(
    graph: str, fits: Sequence[Fit], recordings: Sequence[Recording], held_out: Sequence[Recording],
    settings: Mapping[str, Value], most: int, folds: int | None,
) -> None:  # fmt: skip
    check_fits(graph, fits, recordings, held_out, settings)
    if type(most) is not int or most < 1:
        raise _wrong("most", "a whole number from 1", most)
    if folds is not None and (type(folds) is not int or not 2 <= folds <= len(recordings)):
        raise _wrong("folds", f"a whole number from 2 to that of the recordings, {len(recordings)}", folds)
    if folds is not None and held_out:
        raise _wrong("folds", "either folds or recordings that are held out", f"{len(held_out)} held out")


def check_fits(
    graph: str, fits: Sequence[Fit], recordings: Sequence[Recording], held_out: Sequence[Recording],
    settings: Mapping[str, Value], *, verb: str = "tune",
) -> None:  # fmt: skip
    """Refuse what cannot be sought: bounds that are none, what is no parameter of a filter or of its sensors.

    Args:
        verb: what the caller does with them, for messages: "tune" or "calibrate".

    Raises:
        DeclarationError, UnknownNameError: naming the parameter.
    """
    wrong = partial(_wrong, verb=verb)
    if not fits:
        raise wrong("fit", "one parameter or more, such as position_noise=0.001:0.1", "none")
    if not recordings:
        raise wrong("data", "one recording or more", "none")
    prepare = find_graph(graph).prepare
    for fit in fits:
        of_flight = any(flight_part(r.data, {fit.name: fit.low}) for r in (*recordings, *held_out))
        if prepare is not None and not of_flight and not placed(fit.name):
            _need_name(prepare, graph, fit.name)
        numbers = [fit.low, fit.low if fit.start is None or np.ndim(fit.start) else fit.start, fit.high]
        least = -math.inf if fit.scale == "linear" else 0.0
        if not all(isinstance(x, int | float) and math.isfinite(x) for x in numbers) or not (
            least < fit.low < fit.high and fit.low <= numbers[1] <= fit.high
        ):
            expected = "0 < low" if fit.scale == "log" else "low"
            begun = "" if fit.start is None else f", start {fit.start}"
            raise DeclarationError(
                "these are no bounds to search between",
                path=fit.name,
                expected=f"{expected} <= start <= high, low < high",
                got=f"low {fit.low}, high {fit.high}{begun}",
                fix=_bounds_mended(fit),
            )
        matrix = start_of_fit(graph, fit)
        if np.ndim(matrix) == 2 and not _is_covariance(matrix):
            raise wrong(f"fit {fit.name}", "a start that is a covariance", matrix)
        if fit.name in settings or sum(f.name == fit.name for f in fits) > 1:
            again = f"--set {fit.name}, or its bounds" if fit.name in settings else "all but one of them"
            raise wrong(
                f"fit {fit.name}", "each parameter once, and not set as well", fit.name,
                fix=f"leave out {again}",
            )  # fmt: skip
        if fit.name in getattr(prepare, "scoring", ()):
            raise wrong(
                f"fit {fit.name}", "a setting of the filter; this one changes how a run is scored", fit.name
            )
        if placed(fit.name):
            for r in (*recordings, *held_out):
                if not flight_part(r.data, {fit.name: fit.low}):
                    raise UnknownNameError("setting", fit.name, flight_settings(r.data), path=r.data)
            continue
        if of_flight:
            own = ", ".join(keyword_types(prepare)) if prepare is not None else "of the graph"
            raise wrong(
                f"fit {fit.name}", "a setting of the graph that is none of the flight", fit.name,
                fix=f"choose one of {own}",
            )  # fmt: skip
        if prepare is not None:
            parsed_settings(prepare, {fit.name: text(start_of_fit(graph, fit))}, also=(), path=graph)


def _need_name(prepare: Any, graph: str, name: str) -> None:
    """Refuse the name of no setting before anything is said of its bounds."""
    try:
        parsed_settings(prepare, {name: "1.0"}, also=(), path=graph)
    except UnknownNameError as error:
        valid = [*error.valid, *(f"STREAM.{part}" for part in PLACED)]
        raise UnknownNameError("setting", name, valid, path=graph) from None
    except DeclarationError:
        return  # of another kind of value


def _bounds_mended(fit: Fit) -> str:
    numbers = all(isinstance(x, int | float) and math.isfinite(x) for x in (fit.low, fit.high))
    if numbers and fit.low > fit.high and (fit.scale == "linear" or fit.high > 0.0):
        return f"swap the bounds: low {fit.high}, high {fit.low}"
    if numbers and fit.scale == "log" and fit.low <= 0.0:
        return "give bounds above 0: what is searched by its logarithm is positive"
    return "give two finite numbers, the lower one first, and a start between them or none"


def _is_covariance(value: Parameter) -> bool:
    S = np.asarray(value)
    return S.shape[0] == S.shape[1] and bool((S == S.T).all()) and bool((np.linalg.eigvalsh(S) > 0).all())
