"""What a search for parameters makes small: a measure of a graph on recordings, at given settings.

Two measures can be made small. With `likelihood`, the negative logarithm of how likely the innovations r of
covariance S are, a value read,

    1/2 (r^T S^-1 r + log det S + m log 2 pi)        summed over all, over the number of values

which needs no truth, and has its least where the filter is as sure as it is right (R. Mehra, "On the
identification of variances and adaptive Kalman filtering", IEEE Trans. Automatic Control 15(2), 1970; F. C.
Schweppe, "Evaluation of likelihood functions for Gaussian signals", IEEE Trans. Information Theory 11(1),
1965). With `error`, the logarithm of a metric against the truth, of which the mean over recordings is taken,
so that a recording counts by how much better it gets and not by how hard it is.
"""

from __future__ import annotations

import copy
import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.data.settings import text
from flowgraph.engines.options import RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.engines.registry import find_engine
from flowgraph.errors import DataError
from flowgraph.language.recording import remembering
from flowgraph.pipeline.digests import digest
from flowgraph.study.coordinates import Parameter
from flowgraph.study.slopes import Slopes
from flowgraph.study.spec import Value
from flowgraph.study.tasks import flight_part, grouped, loaded, prepared, simulate_together

ASTRAY = 1e6
"""What a recording counts on which the filter fails: more than any that works."""


_MOVED_KEPT = 8


@dataclass(frozen=True)
class Recording:
    """A flight to fit to or to judge by, and the seed of it and of the run."""

    data: str
    seed: int = 0


@dataclass(frozen=True)
class Judged:
    """One recording by the measure that was made small, and by the metrics: a value each of three.

    Args:
        recording: which.
        held_out: whether the search that gave `after` did without it.
        before: at the start of the search. after: with what was found. own: with the graph's own settings.
        metrics: before, after and own, by name; those that all three have.
        fold: the number of the search that it was held out of, from 0, where there were several.
    """

    recording: Recording
    held_out: bool
    before: float
    after: float
    own: float
    metrics: Mapping[str, tuple[float, float, float]] = field(default_factory=dict)
    fold: int | None = None


class Trials:
    """A graph on recordings, each loaded once."""

    def __init__(
        self, graph: str, recordings: Sequence[Recording], settings: Mapping[str, Value],
        measure: str, metric: str | None, engine: str, sought: Sequence[str] = (),
    ) -> None:  # fmt: skip
        """Args:
        sought: settings of the flights that are searched for, which a filter need not estimate as well:
            `info["sought"]` of the flights tells it.
        """
        self._sought = tuple(sought)
        self.graph, self.recordings, self.settings = graph, recordings, settings
        self.measure, self.metric, self.engine = measure, metric, engine
        self._flights: list[Flight] = []
        self._moved: OrderedDict[Any, Flight] = OrderedDict()
        self._slopes = Slopes(engine)
        self._worked = False
        self._steps: OrderedDict[Any, Any] = OrderedDict()
        for one in recordings:
            _, flight = prepared(graph, one.data, one.seed, settings)
            self._flights.append(self._told(flight))

    def twice(self) -> tuple[Recording, Recording] | None:
        """Two recordings that hold the same, as a file does whatever the seed or the spelling of its path."""
        seen: dict[str, Recording] = {}
        for one, flight in zip(self.recordings, self._flights, strict=True):
            what = digest((dict(flight.streams), flight.truth))
            if what in seen:
                return seen[what], one
            seen[what] = one
        return None

    @property
    def flights(self) -> list[Flight]:
        """Those of the recordings."""
        return list(self._flights)

    def at(self, fixed: Mapping[str, Parameter]) -> Trials:
        """The same with some settings of the flights fixed at these values."""
        other = copy.copy(self)
        other.settings = {**self.settings, **{n: text(v) for n, v in fixed.items()}}
        other._flights = [self._flight(k, fixed) for k in range(len(self.recordings))]
        other._moved = OrderedDict()
        return other

    def by(self, measure: str) -> Trials:
        """The same by another measure."""
        other = copy.copy(self)
        other.measure = measure
        return other

    def _flight(self, place: int, point: Mapping[str, Parameter]) -> Flight:
        """The flight of a recording, with those of its own settings that a point names."""
        one = self.recordings[place]
        own = flight_part(one.data, point)
        if not own:
            return self._flights[place]
        which = (place, tuple(text(v) for v in own.values()))
        if which not in self._moved:
            self._moved[which] = self._told(loaded(one.data, one.seed, {**self.settings, **own}))
            while len(self._moved) > _MOVED_KEPT:
                self._moved.popitem(last=False)
        self._moved.move_to_end(which)
        return self._moved[which]

    def _told(self, flight: Flight) -> Flight:
        """The flight, with what is sought."""
        return replace(flight, info={**flight.info, "sought": self._sought}) if self._sought else flight

    def _case(self, place: int, point: Mapping[str, Parameter]) -> Case:
        one = self.recordings[place]
        flight = self._flight(place, point)
        with remembering(self._steps):  # only the blocks whose settings move are recorded anew
            return prepared(self.graph, one.data, one.seed, {**self.settings, **point}, flight)[0]

    def _results(self, cases: Sequence[Case], places: Sequence[int]) -> list[Result | Exception]:
        """A result a case; of one that raises, what it raises."""
        found: list[Result | Exception] = []
        options = RunOptions(engine=self.engine)
        if not find_engine(self.engine).takes_many:
            for case, place in zip(cases, places, strict=True):
                seed = self.recordings[place].seed
                try:
                    found.append(run_graph(case.graph, case.inputs, options.but(seed=seed)))
                except Exception as error:
                    found.append(error)
            return found
        made: dict[int, Result | Exception] = {}
        for program, members in grouped(cases):
            seeds = [self.recordings[places[k]].seed for k in members]
            several = [cases[k] for k in members]
            chunk = min(64, 2 ** math.ceil(math.log2(len(members))))
            together = options.but(runs_at_once=chunk)
            made.update(zip(members, self._together(several, seeds, program, together), strict=True))
        return [made[k] for k in range(len(cases))]

    def _together(
        self, cases: Sequence[Case], seeds: Sequence[int], program: Any, options: RunOptions
    ) -> Sequence[Result | Exception]:
        """Cases of one program; where one raises, each alone, so that it fails for itself."""
        try:
            return simulate_together(cases, seeds, program, options)
        except Exception as error:
            if len(cases) == 1:
                return [error]
        single = options.but(runs_at_once=1)
        return [self._together([c], [s], program, single)[0] for c, s in zip(cases, seeds, strict=True)]

    @property
    def slopes(self) -> bool:
        """Whether a slope may come with the measure."""
        return self.measure == "likelihood" and self._slopes.possible

    def sloped(
        self, place: int, point: Mapping[str, Parameter],
        ends: Sequence[tuple[Mapping[str, Parameter], Mapping[str, Parameter]]], widths: Sequence[float],
    ) -> tuple[float, float, np.ndarray]:  # fmt: skip
        """The measure of one recording, of how many values it is, and its slope (p,); NaN where it has none.

        Args:
            place: of the recording.
            point: at which.
            ends: beyond it and before it, for each parameter; widths: how far these are apart.
        """
        case = self._case(place, point)
        around = [(self._case(place, a), self._case(place, b)) for a, b in ends]
        try:
            value, count, slope = self._slopes.of(case, around, widths, self.recordings[place].seed)
        except DataError:
            raise
        except Exception:
            if not self._worked:
                raise
            return ASTRAY, 0.0, np.zeros(len(ends))
        if np.isnan(slope).all():
            return math.nan, 0.0, slope
        if not count:
            whole = run_graph(case.graph, case.inputs, RunOptions(engine=self.engine))
            surprise(whole)  # says what it lacks
        self._worked = True
        if not math.isfinite(value) or not value < ASTRAY:
            return ASTRAY, count, np.zeros(len(ends))
        return value, count, slope

    def measured(self, points: Sequence[Mapping[str, Parameter]], places: Sequence[int]) -> np.ndarray:
        """The measure (points, recordings) on the recordings at some places."""
        pairs = [(p, k) for p in points for k in places]
        cases = [self._case(k, p) for p, k in pairs]
        results = self._results(cases, [k for _, k in pairs])
        self._need_one(results)
        found = [self._value(c, r) for c, r in zip(cases, results, strict=True)]
        return np.array(found).reshape(len(points), len(places))

    def values_at(self, place: int, point: Mapping[str, Parameter]) -> float:
        """How many values were measured of one recording."""
        (result,) = self._results([self._case(place, point)], [place])
        return 0.0 if isinstance(result, Exception) else measured_values(result)

    def _need_one(self, results: Sequence[Result | Exception]) -> None:
        """Until something has worked, what every run raises is no matter of the parameters: raise it."""
        failed = [r for r in results if isinstance(r, Exception)]
        if not self._worked and len(failed) == len(results):
            raise failed[0]
        self._worked = True

    def _value(self, case: Case, result: Result | Exception) -> float:
        if isinstance(result, DataError):
            raise result  # the recording is wrong, whatever the parameters
        if isinstance(result, Exception):
            return ASTRAY
        if self.measure == "likelihood":
            value = surprise(result)
        else:
            error = self._score(case, result)
            value = math.log(error) if error > 0 else ASTRAY
        return min(value, ASTRAY) if math.isfinite(value) else ASTRAY

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

    def judged(
        self, places: Sequence[int], start: Mapping[str, Parameter], point: Mapping[str, Parameter], *,
        held_out: bool, fold: int | None = None,
    ) -> list[Judged]:  # fmt: skip
        """Recordings at the start, with what was found, and with the graph's own settings."""
        found = []
        for k in places:
            cases = [self._case(k, p) for p in (start, point, {})]
            results = self._results(cases, [k] * 3)
            before, after, own = (self._value(c, r) for c, r in zip(cases, results, strict=True))
            scores = [
                c.score(r) if isinstance(r, Result) else {} for c, r in zip(cases, results, strict=True)
            ]
            first, *others = scores
            all_of = {n: tuple(s[n] for s in scores) for n in first if all(n in s for s in others)}
            metrics = {n: (float(a), float(b), float(c)) for n, (a, b, c) in all_of.items()}
            found.append(Judged(self.recordings[k], held_out, before, after, own, metrics, fold))
        return found


def measured_values(result: Result) -> float:
    """How many numbers the innovations of a run are of."""
    held = [s.leaves for s in result.series.values() if {"residual", "covariance"} <= set(s.leaves)]
    return float(sum(n["parts"].sum() if "parts" in n else n["residual"].size for n in held))


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
