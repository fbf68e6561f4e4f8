"""Finding graphs and flights by name, through entry points: the engine imports none of them itself.

A package offers a graph under the entry point group `flowgraph.graphs` (a `@graph` function with
`on_flight`), a source of flights under `flowgraph.flights` (a function `load(argument, *, seed, settings)`),
and an experiment under `flowgraph.benches` (a function of keyword settings that returns a `Report`). Ours are
found the same way as a user's. What cannot be imported is a `PluginError` to those who ask for it, and
stands in nobody else's way. A name FILE.py:NAME is looked for in that file; see `own`.
"""

from __future__ import annotations

import functools
import inspect
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

from flowgraph.data.arrival import LATENCY, delayed_flight
from flowgraph.data.consistency import far_nis, measured
from flowgraph.data.flight import Flight
from flowgraph.data.inputs import Inputs
from flowgraph.data.joint import joined, numbered, of_a_truth, parts_of, shared, with_truth
from flowgraph.data.notes import note, said
from flowgraph.data.own import flight_in_file, graph_in_file, is_in_file, kind_and_place, settings_by_text
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.data.suspect import suspect_readings
from flowgraph.errors import DataError, FlowgraphError, PluginError, UnknownNameError
from flowgraph.language.declare import GraphFunction
from flowgraph.language.graph import Graph
from flowgraph.recorder.random import seed_words
from flowgraph.verbs import verb

if typing.TYPE_CHECKING:
    from importlib.metadata import EntryPoint


@dataclass(frozen=True)
class Case:
    """A graph made ready for one flight.

    Args:
        graph: built, with the start and the noise for this flight.
        inputs: the flight's streams by source name.
        score: `result -> {metric: value}`, against the flight's truth. It may have a method `reads(graph)`,
            the names of the streams that it looks at; then a study of many runs at once keeps only those. It
            may have a method `remarks(result)`, notes on what the figures do not tell, and an attribute
            `order`, the convention of the graph's own angles, in which pictures draw them: "zyx" or "zxy".
        estimate: name of the collected stream that the score and the pictures are of.
        notes: what was assumed when it was made ready, a sentence each; see `flowgraph.data.notes`.
        begin: where the start follows from the flight, what makes it in a graph under construction, of which
            the flight is a part: `(first, at) -> {register: stream}`, each present where `at` is, at the
            first tick; `first(name)` is what a stream of the flight, or "truth", is there. `study.whole`
            checks that this is the start that the graph was built with.
        files: what `--out` writes beside what it writes of every run: by name, what writes a result to a
            path.
    """

    graph: Graph
    inputs: Inputs
    score: Callable[[Result], dict[str, float]]
    estimate: str = "belief"
    notes: tuple[str, ...] = ()
    files: Mapping[str, Callable[[Result, Path], None]] = field(default_factory=dict)
    begin: Callable[..., Mapping[str, Any]] | None = None

    @property
    def order(self) -> str:
        """The convention in which roll, pitch and yaw are drawn."""
        return str(getattr(self.score, "order", "zyx"))

    @property
    def recorded(self) -> dict[str, Series]:
        """What the graph is fed, by source, where it is recorded."""
        inputs = self.inputs.streams if isinstance(self.inputs, Flight) else self.inputs
        return {n: s for n, s in inputs.items() if isinstance(s, Series) and n in self.graph.sources}

    def page(self, result: Result, *, truth: Series | None = None) -> Any:
        """The page of a run of this case, which shows itself in a notebook and has `save(FILE)`.

        Args:
            result: of `simulate(case.graph, case.inputs)`.
            truth: to compare with; that of the flight where the inputs are one.
        """
        return verb("Case.page")(self, result, truth=truth)

    def _repr_html_(self) -> str:
        return str(verb("Case._repr_html_")(self))

    def remarks(self, result: Result) -> tuple[str, ...]:
        """All notes on a run: the case's, the result's, those of the score, where a NIS is far from 1, and
        what the readings show of their own sensors."""
        tell = getattr(self.score, "remarks", None)
        told = tell(result) if tell is not None else ()
        far = (far_nis(measured(name), s) for name, s in result.series.items() if "nis" in s.leaves)
        suspect = map(suspect_readings, self.recorded.values())
        more = chain.from_iterable((*far, *suspect, _too_late(result)))
        return said((*self.notes, *result.notes, *told, *more))


def _too_late(result: Result) -> tuple[str, ...]:
    """A note where late values were older than the history that they would have been applied in."""
    refused = sum(n for kind, n in result.stats.items() if kind.endswith(".late_refused"))
    fused = sum(n for kind, n in result.stats.items() if kind.endswith(".late_fused"))
    made = ((refused, "refused", "left out"), (fused, "counted", "taken for as old as the history goes back"))
    return tuple(
        note(word, f"{n} late values were older than the history, and {what}: a larger rewind takes them in")
        for n, word, what in made
        if n
    )


@dataclass(frozen=True)
class Report:
    """What an experiment found.

    Args:
        rows: the table, a mapping a row; the values are numbers, texts or None.
        figures: by file name, what draws the picture into a path.
        notes: what the reader should know of the figures, a sentence each.
    """

    rows: Sequence[Mapping[str, Any]]
    figures: Mapping[str, Callable[[Path], None]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


# What packages offer, by the group of their entry points.
KINDS = {
    "flowgraph.graphs": "graph",
    "flowgraph.cases": "way to make a case",
    "flowgraph.flights": "kind of flight",
    "flowgraph.benches": "bench",
    "flowgraph.engines": "engine",
}


@functools.lru_cache(maxsize=8)
def _entries_along(group: str, path: tuple[str, ...]) -> tuple[EntryPoint, ...]:
    from importlib.metadata import entry_points  # slow to import, and only needed to look names up

    return tuple(entry_points(group=group))


def _entries(group: str) -> tuple[EntryPoint, ...]:
    """The entry points of a group; looked up once, for that reads a file of each installed package."""
    return _entries_along(group, tuple(sys.path))


def _loaded(group: str, entry: EntryPoint) -> Any:
    """What an entry point names.

    Raises:
        PluginError: if it cannot be imported, for whatever reason.
    """
    try:
        return entry.load()
    except (Exception, SystemExit) as error:  # a package of somebody else's: anything may happen there
        package = entry.dist.name if entry.dist else "its package"
        raise PluginError(
            f"this {KINDS[group]} cannot be loaded",
            path=entry.name,
            expected=f"{entry.value} of {package}",
            got=" ".join(f"{type(error).__name__}: {error}".split()),
            fix=f"mend {package}, or uninstall it",
        ) from error


def installed(group: str) -> tuple[dict[str, Any], list[PluginError]]:
    """All that packages offer in a group, by name, and an error for each thing that cannot be imported."""
    found: dict[str, Any] = {}
    failed: list[PluginError] = []
    for entry in sorted(_entries(group), key=lambda e: e.name):
        if entry.name in found:
            continue  # the first of a name is the one that is found by it
        try:
            found[entry.name] = _loaded(group, entry)
        except PluginError as error:
            failed.append(error)
    return found, failed


def entry_names(group: str) -> list[str]:
    """The names of all that is installed under a group."""
    return sorted(e.name for e in _entries(group))


def graph_names() -> list[str]:
    """The names of all installed graphs."""
    return entry_names("flowgraph.graphs")


def flight_names() -> list[str]:
    """The kinds of flight that can be loaded."""
    return entry_names("flowgraph.flights")


def find_bench(name: str) -> Callable[..., Report]:
    """The installed experiment of that name.

    Raises:
        UnknownNameError: listing the names that exist; PluginError: if its package cannot be imported.
    """
    found: Callable[..., Report] = find_entry("flowgraph.benches", name)
    return found


def find_graph(name: str) -> GraphFunction:
    """The installed graph of that name, or that of a file, FILE.py:NAME, which is then run.

    One in a file that says nothing of flights takes the streams of a flight by their names.

    Raises:
        UnknownNameError: listing the names that exist; PluginError: if its package or file cannot be
            imported; DeclarationError: where there is no such file, or the name in it is no graph's.
    """
    if not is_in_file(name):
        found: GraphFunction = find_entry("flowgraph.graphs", name)
        return found
    found = graph_in_file(name)
    if found.prepare is None:
        found.on_flight(find_entry("flowgraph.cases", "by_names")(found))
    return found


def find_entry(group: str, name: str) -> Any:
    """What is installed under a name of a group.

    Raises:
        UnknownNameError: listing the names that exist; PluginError: if its package cannot be imported.
    """
    for entry in _entries(group):
        if entry.name == name:
            return _loaded(group, entry)
    raise UnknownNameError(KINDS[group], name, entry_names(group))


def load_flight(
    spec: str, *, seed: int = 0, settings: Mapping[str, str] | None = None, truth: str | None = None
) -> Flight:
    """Load the flight that a text such as "sim" or "euroc:PATH" names.

    Args:
        spec: KIND or KIND:WHERE, where KIND may be FILE.py:NAME; several, of one flight, are joined by `+`:
            "csv:imu.csv+csv:mocap.csv".
        seed: of what is simulated.
        settings: of the loaders by name. Of several parts, each takes those that it has; `2.NAME` is for the
            second alone. Every kind has `STREAM.latency`, the seconds after which a stream arrives; LOW:HIGH
            for random ones.
        truth: a SPEC whose truth, or only stream of poses, is the flight's truth; its settings have the
            number after the last part.

    Raises:
        UnknownNameError: for a kind that is not installed, or a setting that it does not have.
        PluginError: for a kind whose package cannot be imported.
        DeclarationError: for a seed or a setting that is not usable; DataError: where files are missing or
            wrong, or parts do not fit together.
    """
    seed_words(seed)
    late = {k: v for k, v in (settings or {}).items() if k.endswith(LATENCY)}
    rest = {k: v for k, v in (settings or {}).items() if k not in late}
    flight = _load(spec, seed, rest, truth)
    return delayed_flight(flight, late, seed=seed) if late else flight


def _load(spec: str, seed: int, settings: Mapping[str, str], truth: str | None) -> Flight:
    specs = [*parts_of(spec, flight_names()), *([truth] if truth is not None else [])]
    kinds = [_kind(s) for s in specs]
    each = [dict(settings)]
    if len(specs) > 1:
        names = [kind.settings for kind in kinds]
        given = of_a_truth(settings, names) if truth is not None else settings
        each = shared(specs, names, [kind.claims for kind in kinds], given)
    found = [_read(kind, s, seed, given) for kind, s, given in zip(kinds, specs, each, strict=True)]
    if truth is None:
        return found[0] if len(found) == 1 else joined(specs, found)
    whole = found[0] if len(found) == 2 else joined(specs[:-1], found[:-1])
    return with_truth(whole, truth, found[-1])


@dataclass(frozen=True)
class _Kind:
    """A kind of flight: what loads it, its settings, and which of several parts' settings it claims."""

    load: Callable[..., Flight]
    settings: list[str]
    claims: Any = None


def _kind(spec: str) -> _Kind:
    name, _ = kind_and_place(spec)
    if is_in_file(name):
        return _Kind(*flight_in_file(name))
    load = find_entry("flowgraph.flights", name)
    module = inspect.getmodule(load)
    names = list(getattr(module, "SETTINGS", getattr(module, "DEFAULTS", {})))
    return _Kind(load, names, getattr(module, "claims", None))


def _read(kind: _Kind, spec: str, seed: int, settings: Mapping[str, str]) -> Flight:
    name, place = kind_and_place(spec)
    try:
        return kind.load(place, seed=seed, settings=settings)
    except FlowgraphError:
        raise
    except Exception as error:  # of a damaged file a library may say anything
        raise DataError(
            "this recording cannot be read",
            path=spec,
            expected=f"a whole recording of the kind {name}",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="restore the file; if it is whole, please report it to the package that reads this kind",
        ) from error


def flight_settings(spec: str, truth: str | None = None, *, run: bool = True) -> list[str]:
    """The settings that the loaders of a SPEC understand; of several parts, for all and for each.

    Args:
        spec, truth: as of `load_flight`.
        run: whether a file of code may be run for it; otherwise it is only read.
    """
    specs = [*parts_of(spec, flight_names()), *([truth] if truth is not None else [])]
    kinds = [kind_and_place(one)[0] for one in specs]
    names = [
        settings_by_text(kind) if is_in_file(kind) and not run else _kind(one).settings
        for kind, one in zip(kinds, specs, strict=True)
    ]
    return [*(names[0] if len(names) == 1 else numbered(names)), "STREAM" + LATENCY]
