"""What several commands take: a graph, a flight, their settings, and the case that they make together."""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from flowgraph.data.files import text_of
from flowgraph.data.flight import Flight
from flowgraph.data.inputs import Inputs
from flowgraph.data.registry import Case, find_graph, flight_settings, load_flight
from flowgraph.data.settings import parsed_settings, text
from flowgraph.engines.registry import engine_names
from flowgraph.errors import DataError, DeclarationError
from flowgraph.language.graph import Graph

Name = Annotated[str, typer.Argument(metavar="GRAPH", help="A graph from `flowgraph list`, or FILE.py:NAME.")]
NameOrNone = Annotated[
    str | None,
    typer.Argument(
        metavar="GRAPH", help="A graph from `flowgraph list`, or FILE.py:NAME.", show_default=False
    ),
]
Data = Annotated[
    list[str],
    typer.Option(
        "--data",
        metavar="SPEC",
        help="sim, sim:thesis, sim:hover, sim:roundtrip, sim:plane, euroc:PATH, broad:FILE, ese650:DIR:N ..."
        " Several files of one flight: csv:A+csv:B.",
    ),
]
DataOrNone = Annotated[
    list[str] | None,
    typer.Option("--data", metavar="SPEC", help="As for run; if left out, a simulated flight that fits."),
]
Truth = Annotated[
    str | None,
    typer.Option("--truth", metavar="SPEC", help="Whose truth, or only stream of poses, is the truth."),
]
EXAMPLES: tuple[tuple[str, Mapping[str, str]], ...] = (
    ("sim", {}),
    ("sim:thesis", {"sensors": "all"}),
    ("sim:plane", {}),
    ("course", {"duration": "1"}),
)
"""The flights on which a graph is shown when nobody names one: the first that has what it needs."""

Settings = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="KEY=VALUE", help="A setting of the graph or the flight; repeatable."),
]
SEED_HELP = "Of a simulated flight, and of the graph's draws."
Seed = Annotated[int, typer.Option(min=0, max=2**64 - 1, help=SEED_HELP)]
SettingsFile = Annotated[
    Path | None,
    typer.Option("--settings", metavar="FILE", help="What tune or calibrate found; --set goes before it."),
]
Formats = Annotated[
    Path | None,
    typer.Option("--formats", metavar="DIR", help="For fixed point: what flowgraph quantise wrote."),
]
Engine = Annotated[str, typer.Option(help=", ".join(engine_names()))]
Shard = Annotated[
    str | None,
    typer.Option("--shard", metavar="AXIS=N", help="Devices that share an axis: particles=4, in xla."),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def one_flight(data: list[str] | None) -> str | None:
    """The SPEC of the one flight that a command takes.

    Raises:
        DeclarationError: for several, which would be several recordings.
    """
    if data and len(data) > 1:
        raise DeclarationError(
            "this command takes one flight",
            path="--data",
            expected="one SPEC",
            got=" and ".join(data),
            fix=f"if these are files of one flight, write --data {'+'.join(data)}; several flights go to"
            " flowgraph tune or into a study",
        )
    return data[0] if data else None


def case_of(
    name: str,
    spec: str,
    settings: list[str] | None,
    seed: int,
    truth: str | None = None,
    say: Callable[[tuple[str, ...]], None] = lambda notes: None,
) -> tuple[Case, Flight]:
    """A graph made ready for a flight; `say` is told the notes of each as soon as they are known."""
    graph = find_graph(name)
    given = pairs(settings)
    if graph.prepare is None:
        return graph.case(Flight(spec, {})), Flight(spec, {})  # raises, saying what is missing
    mine, rest = parsed_settings(graph.prepare, given, also=flight_settings(spec, truth), path=name)
    flight = load_flight(spec, seed=seed, settings=rest, truth=truth)
    say(flight.notes)
    if "seed" in inspect.signature(graph.prepare).parameters:
        mine.setdefault("seed", seed)
    case = graph.case(flight, **mine)
    say(case.notes)
    return case, flight


def graph_of(
    name: str,
    data: str | None = None,
    settings: list[str] | None = None,
    seed: int = 0,
    truth: str | None = None,
) -> tuple[Graph, Inputs]:
    """The graph on a flight, and what it is fed there; without `data`, on the first of `EXAMPLES` that fits.

    If none fits, a graph that needs no settings is built on sources that nothing feeds.

    Raises:
        DataError: the first flight's, where a graph neither fits a flight nor builds without one.
    """
    if data is not None:
        case, _ = case_of(name, data, settings, seed, truth)
        return case.graph, case.inputs
    first: DataError | None = None
    for spec, more in EXAMPLES:
        chosen = {**more, **pairs(settings)}
        try:
            case, _ = case_of(name, spec, [f"{key}={value}" for key, value in chosen.items()], seed)
            return case.graph, case.inputs
        except DataError as error:
            first = first or error
    assert first is not None
    if settings:
        raise first
    try:
        return find_graph(name).build(), {}
    except DeclarationError:
        raise first from None


def _pair(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise DeclarationError(
            "a setting is KEY=VALUE",
            path="--set",
            expected="KEY=VALUE",
            got=repr(text),
            fix=f"write --set {key}=...",
        )
    return key.strip(), value.strip()


def shared(words: str | None, *, streamed: bool = False) -> dict[str, int] | None:
    """What `--shard runs=2,particles=4` asks for.

    Raises:
        DeclarationError: for other words; for a run that is streamed, which goes on one device.
    """
    if words is None:
        return None
    if streamed:
        raise DeclarationError(
            "a streamed run goes on one device",
            path="--shard",
            expected="--shard, or --stream",
            got="both",
            fix="leave one of them out",
        )
    found: dict[str, int] = {}
    for part in words.split(","):
        name, _, number = part.partition("=")
        if not name.strip() or not number.strip().isdecimal() or int(number) < 1 or name.strip() in found:
            raise DeclarationError(
                "a share is a number of devices for each axis",
                path="--shard",
                expected="AXIS=N, with commas between",
                got=repr(words),
                fix="write --shard particles=4, or of many runs --shard runs=2,particles=4",
            )
        found[name.strip()] = int(number)
    return found


def with_file(settings: list[str] | None, file: Path | None) -> list[str]:
    """The `--set` texts, and those of a file that `tune` or `calibrate` wrote for what they do not name.

    Raises:
        DataError: where there is no such file.
    """
    given = list(settings or [])
    if file is None:
        return given
    wrong = functools.partial(
        DataError,
        "these are no settings",
        path=str(file),
        expected='{"parameters": {KEY: {"value": ...}}}, as tune and calibrate write it',
        fix="write it with flowgraph tune --out FILE",
    )
    try:
        read = json.loads(text_of(file))
    except (OSError, ValueError, RecursionError) as error:
        raise wrong(got=f"{type(error).__name__}: {error}"[:200]) from None
    parameters = read.get("parameters") if isinstance(read, dict) else None
    if not isinstance(parameters, dict):
        raise wrong(got="no parameters")
    named = pairs(settings)
    for key, one in parameters.items():
        value = one.get("value") if isinstance(one, dict) else one
        try:
            numbers = value if isinstance(value, str) else np.array(value, dtype=float)  # NaN for None
            if not isinstance(numbers, str) and not np.isfinite(numbers).all():
                raise ValueError
        except (TypeError, ValueError):
            raise wrong(got=f"{key}: {one!r}"[:200]) from None
        word = text(numbers)
        if key not in named:
            given.append(f"{key}={word}")
    return given


def pairs(settings: list[str] | None) -> dict[str, str]:
    """The `--set` texts by key."""
    given: dict[str, str] = {}
    for key, value in map(_pair, settings or []):
        if given.setdefault(key, value) != value:
            raise DeclarationError(
                "a setting is given twice",
                path=f"--set {key}",
                expected="one value",
                got=f"{given[key]} and {value}",
                fix="leave one of them out",
            )
    return given
