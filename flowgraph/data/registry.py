"""Finding graphs and flights by name, through entry points: the engine imports none of them itself.

A package offers a graph under the entry point group `flowgraph.graphs` (a `@graph` function with
`on_flight`), a source of flights under `flowgraph.flights` (a function `load(argument, *, seed, settings)`),
and an experiment under `flowgraph.benches` (a function of keyword settings that returns a `Report`). Ours are
found the same way as a user's. What cannot be imported is a `PluginError` to those who ask for it, and
stands in nobody else's way.
"""

from __future__ import annotations

import functools
import inspect
import math
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from flowgraph.data.arrival import LATENCY, delayed_flight
from flowgraph.data.inputs import Inputs
from flowgraph.data.joint import joined, numbered, of_a_truth, parts_of, shared, with_truth
from flowgraph.data.notes import said
from flowgraph.data.result import Result
from flowgraph.data.series import Flight
from flowgraph.errors import DataError, DeclarationError, FlowgraphError, PluginError, UnknownNameError
from flowgraph.language.declare import GraphFunction
from flowgraph.language.graph import Graph

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
    """

    graph: Graph
    inputs: Inputs
    score: Callable[[Result], dict[str, float]]
    estimate: str = "belief"
    notes: tuple[str, ...] = ()

    @property
    def order(self) -> str:
        """The convention in which roll, pitch and yaw are drawn."""
        return str(getattr(self.score, "order", "zyx"))

    def remarks(self, result: Result) -> tuple[str, ...]:
        """All notes on a run: the case's, the result's, and those of the score."""
        tell = getattr(self.score, "remarks", None)
        return said((*self.notes, *result.notes, *(tell(result) if tell is not None else ())))


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
    """The installed graph of that name.

    Raises:
        UnknownNameError: listing the names that exist; PluginError: if its package cannot be imported.
    """
    found: GraphFunction = find_entry("flowgraph.graphs", name)
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
        spec: KIND or KIND:WHERE; several, of one flight, are joined by `+`: "csv:imu.csv+csv:mocap.csv".
        seed: of what is simulated.
        settings: of the loaders by name. Of several parts, each takes those that it has; `2.NAME` is for the
            second alone. Every kind has `STREAM.latency`, the seconds after which a stream arrives; LOW:HIGH
            for random ones.
        truth: a SPEC whose truth, or only stream of poses, is the flight's truth; its settings have the
            number after the last part.

    Raises:
        UnknownNameError: for a kind that is not installed, or a setting that it does not have.
        PluginError: for a kind whose package cannot be imported.
        DeclarationError: for a setting that is not usable; DataError: where files are missing or wrong, or
            parts do not fit together.
    """
    late = {k: v for k, v in (settings or {}).items() if k.endswith(LATENCY)}
    rest = {k: v for k, v in (settings or {}).items() if k not in late}
    flight = _load(spec, seed, rest, truth)
    return delayed_flight(flight, late, seed=seed) if late else flight


def _load(spec: str, seed: int, settings: Mapping[str, str], truth: str | None) -> Flight:
    specs = [*parts_of(spec, flight_names()), *([truth] if truth is not None else [])]
    loaders = [find_entry("flowgraph.flights", s.partition(":")[0]) for s in specs]
    each = [dict(settings)]
    if len(specs) > 1:
        claims = [getattr(inspect.getmodule(load), "claims", None) for load in loaders]
        names = [flight_settings(s) for s in specs]
        given = of_a_truth(settings, names) if truth is not None else settings
        each = shared(specs, names, claims, given)
    found = [_read(load, s, seed, given) for load, s, given in zip(loaders, specs, each, strict=True)]
    if truth is None:
        return found[0] if len(found) == 1 else joined(specs, found)
    whole = found[0] if len(found) == 2 else joined(specs[:-1], found[:-1])
    return with_truth(whole, truth, found[-1])


def _read(load: Callable[..., Flight], spec: str, seed: int, settings: Mapping[str, str]) -> Flight:
    kind, _, argument = spec.partition(":")
    try:
        return load(argument, seed=seed, settings=settings)
    except FlowgraphError:
        raise
    except Exception as error:  # of a damaged file a library may say anything
        raise DataError(
            "this recording cannot be read",
            path=spec,
            expected=f"a whole recording of the kind {kind}",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="restore the file; if it is whole, please report it to the package that reads this kind",
        ) from error


def flight_settings(spec: str, truth: str | None = None) -> list[str]:
    """The settings that the loaders of a SPEC understand; of several parts, for all and for each."""
    specs = [*parts_of(spec, flight_names()), *([truth] if truth is not None else [])]
    names = []
    for one in specs:
        module = inspect.getmodule(find_entry("flowgraph.flights", one.partition(":")[0]))
        names.append(list(getattr(module, "SETTINGS", getattr(module, "DEFAULTS", {}))))
    return [*(names[0] if len(names) == 1 else numbered(names)), "STREAM" + LATENCY]


def setting_names(function: Callable[..., Any]) -> list[str]:
    """The keyword-only arguments of a function."""
    return [p.name for p in inspect.signature(function).parameters.values() if p.kind is p.KEYWORD_ONLY]


def parsed_settings(
    function: Callable[..., Any], given: Mapping[str, str], *, also: Sequence[str], path: str
) -> tuple[dict[str, Any], dict[str, str]]:
    """Split `--set` texts into keyword arguments of `function`, as its annotations say, and those of `also`.

    Raises:
        UnknownNameError: for a key that is in neither; DeclarationError: for a text that is no such value.
    """
    hints = typing.get_type_hints(function)
    own = setting_names(function)
    mine: dict[str, Any] = {}
    rest: dict[str, str] = {}
    for key, text in given.items():
        name = key.replace(".", "_")  # start.heading is the argument start_heading
        if key in also:
            rest[key] = text
        elif name in own:
            mine[name] = _parse(text, hints.get(name, str), f"{path}.{key}")
        elif "STREAM." + key.rpartition(".")[2] in also:  # a setting that streams of any name have
            rest[key] = text
        else:
            raise UnknownNameError("setting", key, [*own, *also], path=path)
    return mine, rest


def _parse(text: str, annotation: Any, path: str) -> Any:
    kinds = [k for k in (typing.get_args(annotation) or (annotation,)) if k is not type(None)]
    if text.lower() == "none" and type(None) in typing.get_args(annotation):
        return None
    words = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
    try:
        value = words[text.lower()] if kinds[0] is bool else kinds[0](text)
        if kinds[0] in (int, float) and ("_" in text or not math.isfinite(value)):
            raise ValueError
        return value
    except (KeyError, OverflowError, TypeError, ValueError):
        raise DeclarationError(
            "this setting cannot be read",
            path=path,
            expected=" or ".join(("finite " if k is float else "") + k.__name__ for k in kinds),
            got=repr(text),
            fix=f"write --set {path.rsplit('.', 1)[-1]}=VALUE",
        ) from None
