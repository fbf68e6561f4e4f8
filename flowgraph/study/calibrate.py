"""Calibration: when a sensor was read, where it sits and how it is turned, by what a filter makes of it.

Levers, mounts and noises are found by the likelihood of the innovations. So is an offset, unless there is a
truth that it does not move: the clock that matters is then that of the truth, by which the filter is judged,
and where the likelihood says another, that of the inertial unit, it is said.

A time offset moves events past each other, so a likelihood has steps in it, as fine as the periods of the
sensors. It is therefore begun where two streams see the same motion (`guess`), or at the best of a grid, and
then read off a parabola over points that no period divides; how far the points lie from it is part of its
deviation. Levers, mounts and noises are smooth, and are found as by `tune`. Both are done in turn, until the
offsets stay.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.notes import note
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.pipeline.digests import digest
from flowgraph.study.coordinates import Coordinates, Fit, Parameter
from flowgraph.study.guess import Guess, guess_offset
from flowgraph.study.search import Search
from flowgraph.study.spec import Value
from flowgraph.study.tasks import loaded
from flowgraph.study.trials import Recording, Trials
from flowgraph.study.tune import MEASURES, check_fits, placed, start_of_fit

__all__ = ["Calibrated", "calibrate"]

OFFSET = "time_offset"
_POINTS, _WIDTHS = 13, (0.03, 0.02)
"""Of a parabola, and how far it reaches to both sides, s: first and then."""

_GRID = 11
_ONE_CLOCK = 0.003  # s, within which two measures tell of one
_APART = 0.05  # s, between clocks that are not the same


@dataclass(frozen=True)
class Calibrated:
    """What was found.

    Args:
        graph: its name.
        parameters, deviations: by name.
        evaluations: how many points were tried.
        guesses: of the offsets, where two streams told of the same motion.
        notes: what should be known of it.
    """

    graph: str
    parameters: dict[str, Parameter]
    deviations: dict[str, Any]
    evaluations: int
    guesses: dict[str, Guess]
    notes: tuple[str, ...]


def calibrate(
    graph: str,
    fits: Sequence[Fit],
    recordings: Sequence[Recording],
    *,
    measure: str | None = None,
    metric: str | None = None,
    settings: Mapping[str, Value] | None = None,
    engine: str = "reference",
    most: int = 200,
    watch: Callable[[int, Mapping[str, Parameter], float], None] | None = None,
) -> Calibrated:
    """Find offsets, levers, mounts and whatever else `tune` can find by likelihood.

    Args:
        graph: its name.
        fits: what to find; STREAM.time_offset (s), STREAM.lever (m), STREAM.mount (rotation vector, degrees)
            between bounds, each component; or a noise.
        recordings: to fit to.
        measure: "likelihood", or "error" against the truth, whose clock an offset is then of. None: the
            error for offsets where every recording has a truth that they do not move, else the likelihood.
        metric, settings, engine, most, watch: as of `tune`.

    Raises:
        UnknownNameError, DeclarationError: for what cannot be asked.
        DataError: where the graph collects no innovations, or a loader refuses.
    """
    settings = dict(settings or {})
    fits = [replace(f, scale="linear") if placed(f.name) else f for f in fits]
    if measure is not None and measure not in MEASURES:
        raise UnknownNameError("measure", measure, MEASURES, path="calibrate")
    check_fits(graph, fits, recordings, (), settings, verb="calibrate")
    names = [f.name for f in fits]
    problem = Trials(graph, recordings, settings, measure or "likelihood", metric, engine, names)
    offsets = [f for f in fits if f.name.rpartition(".")[2] == OFFSET]
    others = [f for f in fits if f not in offsets]
    found: dict[str, Parameter] = {f.name: start_of_fit(graph, f) for f in fits}
    of_truth = measure is None and bool(offsets) and _truth_stays(problem, offsets)
    tried = _Tried(problem.by("error") if of_truth else problem, watch)
    notes: list[str] = []
    guesses: dict[str, Guess] = {}
    left: set[int] = set()
    begun: dict[str, float] = {}
    whole = _unthinned(problem, settings) if offsets else []
    for f in offsets:
        stream = f.name.rpartition(".")[0]
        told = [guess_offset(flight, stream, f.low, f.high) for flight in whole]
        known = [g for g in told if g is not None and g.sure]
        if known:
            guesses[f.name] = known[0]
            begin = float(np.median([g.offset for g in known]))  # one of another clock moves it least
            found[f.name] = begun[f.name] = begin
            said = f"{f.name}: begun at {begin:.4g} s, by {known[0].by}"
            notes.append(note("info", f"{said}, whose correlation is {known[0].correlation:.3f} there"))
            said_of, apart = _apart(f.name, recordings, told, begin)
            notes += said_of
            left |= apart
        else:
            grid = np.linspace(f.low, f.high, _GRID)
            found[f.name] = float(grid[int(tried.along(f.name, grid, found).argmin())])
    places = [k for k in range(len(recordings)) if k not in left] or list(range(len(recordings)))
    tried.places = places
    deviations: dict[str, Any] = {}
    widths = _WIDTHS if offsets else (0.0,)
    for width in widths:
        for f in offsets:
            value, deviations[f.name], inside = _vertex(f, width, found, tried)
            found[f.name] = value
            side = {f.low: "lower", f.high: "upper"}.get(value)
            if side is not None and width == widths[-1]:
                notes.append(note("warning", f"{f.name} ended at its {side} bound: widen it"))
            elif not inside and width == widths[-1]:
                kept = "it is a guess"
                if f.name in begun:
                    found[f.name], kept = begun[f.name], f"it stays at {begun[f.name]:.4g} s"
                said = f"{f.name}: the {tried.measure} says no place near {value:.4g} s: {kept}"
                notes.append(note("warning", said))
        if others:
            fixed = {f.name: found[f.name] for f in offsets}
            held = problem.at(fixed)
            search = Search(
                held, Coordinates(others, {f.name: found[f.name] for f in others}),
                places, forward=True,
            )  # fmt: skip
            ended = search.run("L-BFGS-B", most, watch)
            found |= ended.parameters
            deviations |= ended.deviations or dict.fromkeys(ended.parameters)
            tried.count += ended.evaluations
            if width == widths[-1]:
                ends = ended.at_bound.items()
                notes += [note("warning", f"{n} ended at its {side} bound: widen it") for n, side in ends]
    count = tried.count
    if of_truth:
        likely = _Tried(problem, watch)
        likely.places = places
        for f in offsets:
            other, deviations[f.name] = _by_likelihood(f, found, deviations[f.name], likely)
            notes += other
        count += likely.count
    return Calibrated(graph, found, deviations, count, guesses, tuple(dict.fromkeys(notes)))


def _unthinned(problem: Trials, settings: Mapping[str, Value]) -> list[Flight]:
    """The flights with all their rows: what streams tell of one motion needs more than an aid may be."""
    kept = {name: value for name, value in settings.items() if name.rpartition(".")[2] != "every"}
    if len(kept) == len(settings):
        return problem.flights
    return [loaded(one.data, one.seed, kept) for one in problem.recordings]


def _truth_stays(problem: Trials, offsets: Sequence[Fit]) -> bool:
    """Whether every recording has a truth that the offsets do not move."""
    moved = problem.at({f.name: f.low for f in offsets}).flights
    return all(
        here.truth is not None and there.truth is not None and digest(here.truth) == digest(there.truth)
        for here, there in zip(problem.flights, moved, strict=True)
    )


def _by_likelihood(
    f: Fit, found: Mapping[str, Parameter], deviation: float | None, likely: _Tried
) -> tuple[list[str], float | None]:
    """A note where the likelihood says another offset than the truth; and the deviation of what the truth
    says, to which that of the likelihood is added: the curve of an error tells none of the sensors' noise."""
    here = float(found[f.name])
    try:
        there, spread, inside = _vertex(f, _WIDTHS[-1], found, likely)
    except DataError:
        return [], deviation  # without innovations there is nothing to say
    if deviation is None or spread is None:
        return [], deviation
    sure = math.hypot(deviation, spread)
    if not inside or abs(there - here) <= max(3.0 * sure, _ONE_CLOCK):
        return [], sure
    said = f"{f.name}: the truth says {here:.4f} s, the likelihood {there:.4f} s"
    return [note("info", f"{said}: the clock of the truth is not the inertial unit's")], sure


def _apart(
    name: str, recordings: Sequence[Recording], told: Sequence[Guess | None], here: float
) -> tuple[list[str], set[int]]:
    """Notes on recordings whose clocks are others than those of most, and the places of those to leave out:
    all of them, where most are of one."""
    known = {k: g.offset for k, g in enumerate(told) if g is not None and g.sure}
    off = {k for k, offset in known.items() if abs(offset - here) > _APART}
    most = 2 * len(off) < len(known)
    fix = "it is left out" if most else "leave one of them out"
    notes = [
        note("warning", f"{name}: {recordings[k].data} says {known[k]:.4g} s, and is of another clock: {fix}")
        for k in sorted(off)
    ]
    return notes, off if most else set()


class _Tried:
    """The measure over all recordings, counted."""

    def __init__(self, problem: Trials, watch: Any) -> None:
        self.problem, self.count, self._watch = problem, 0, watch
        self.places: Sequence[int] = range(len(problem.recordings))
        self.measure = problem.measure

    def along(self, name: str, values: np.ndarray, rest: Mapping[str, Parameter]) -> np.ndarray:
        """The mean measure (n,) at values of one parameter, the others as they are."""
        found = []
        for value in values:
            point = {**rest, name: float(value)}
            found.append(float(self.problem.measured([point], self.places).mean()))
            self.count += 1
            if self._watch is not None:
                self._watch(self.count, point, found[-1])
        return np.array(found)

    def counted(self, point: Mapping[str, Parameter]) -> float:
        """How many numbers were measured."""
        return sum(self.problem.values_at(place, point) for place in self.places)


def _vertex(
    f: Fit, width: float, found: Mapping[str, Parameter], tried: _Tried
) -> tuple[float, float | None, bool]:
    """Where a parabola through the measure has its least, its deviation, and whether it has one there."""
    middle = float(found[f.name])
    width = min(width, 0.5 * (f.high - f.low))
    middle = min(max(middle, f.low + width), f.high - width)
    steps = np.linspace(-1.0, 1.0, _POINTS) * width
    values = tried.along(f.name, middle + steps, found)
    best = float(middle + steps[int(values.argmin())])
    try:
        p, spread = np.polyfit(steps, values, 2, cov=True)
    except (np.linalg.LinAlgError, ValueError):
        return best, None, False
    if not p[0] > 0.0 or not abs(p[1] / (2.0 * p[0])) <= width:
        return best, None, False
    vertex = -p[1] / (2.0 * p[0])
    J = np.array([p[1] / (2.0 * p[0] ** 2), -1.0 / (2.0 * p[0])])
    rough = float(J @ spread[:2, :2] @ J)
    if tried.measure == "likelihood":  # of an error the curve tells no probability
        rough += 1.0 / (2.0 * p[0] * max(tried.counted({**found, f.name: middle + vertex}), 1.0))
    return float(middle + vertex), math.sqrt(rough), True
