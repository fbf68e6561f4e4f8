"""A graph of one's own on a flight, where nobody has said how: streams, settings and truth go by their names.

    flowgraph run car.py:tracker --data table:drive.csv

Each source of the graph takes the stream of its name; fields go by theirs. The graph's own keyword-only
parameters are its settings, where a word on the command line can mean their values: numbers, texts, truth
values, and arrays as numbers with commas between them. What is scored is the belief that the graph collects,
over the `StateSpace` of its model, against the truth's fields that are called as its parts. A graph with a
parameter `smoothing`, which it hands on to `filtered`, has the settings `smooth=rts` and `lag` too.

A graph that needs more (a start from the first message, streams made of others, errors of another kind) says
so with `on_flight`, and this is then not asked.
"""

from __future__ import annotations

import inspect
import typing
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from flowgraph import Case, Flight, Series, clocks_of
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.smoothing import steps_of
from flowgraph.blocks.metrics.states import ALIGNMENTS, StateErrors
from flowgraph.blocks.scoring.cases import Scored
from flowgraph.blocks.scoring.scorer import Scorer
from flowgraph.blocks.scoring.settings import NotNegative, one_of, positive
from flowgraph.data.notes import note
from flowgraph.data.settings import keyword_types
from flowgraph.errors import DataError, DeclarationError
from flowgraph.language.block import REQUIRED
from flowgraph.language.declare import GraphFunction
from flowgraph.language.graph import CallNode, Graph
from flowgraph.types import ArrayType, StructType, Type, leaves_of, unflatten

__all__ = ["Numbers", "by_names", "fitted", "space_of"]


class Numbers:
    """What reads an array out of a word: numbers with commas between them, rows with semicolons."""

    def __new__(cls, given: Any) -> Any:
        if not isinstance(given, str):
            return np.asarray(given, dtype=float)
        rows = [[float(x) for x in row.split(",")] for row in given.split(";")]
        found = np.array(rows)
        if "_" in given or not np.isfinite(found).all():
            raise ValueError(given)
        return found[0] if len(rows) == 1 else found


_PLAIN = (bool, int, float, str)


def by_names(graph: GraphFunction) -> Callable[..., Case]:
    """What makes a case of a flight, by the names of streams and settings."""
    known = {n: t for n, t in _readable(graph).items() if t is not None}
    settings = [
        inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=d, annotation=known[n])
        for n, d in graph.parameters[1].items()
        if n in known
    ]
    judging = {
        "settle": (NotNegative, Scored.settle),
        "align": (typing.Annotated[str, one_of(*ALIGNMENTS)], ALIGNMENTS[0]),
    }
    if "smoothing" in known:
        judging["smooth"] = (typing.Annotated[str, one_of("none", "rts")], "none")
        judging["lag"] = (typing.Annotated[float | None, positive], None)
    judging = {n: found for n, found in judging.items() if n not in known}
    more = [
        inspect.Parameter(n, inspect.Parameter.KEYWORD_ONLY, default=d, annotation=t)
        for n, (t, d) in judging.items()
    ]

    def prepare(flight: Flight, **given: Any) -> Case:
        scored = {n: given.pop(n, default) for n, (_, default) in judging.items()}
        for n, value in scored.items():
            for check in typing.get_args(judging[n][0])[1:] if value is not None else ():
                check(graph.name, n, value)
        inputs = _inputs(graph, flight)
        chosen = {n: d for n, d in graph.parameters[1].items() if d is not REQUIRED and d is not _EMPTY}
        chosen |= {n: Numbers(v) if known.get(n) is Numbers else v for n, v in given.items()}
        if scored.get("smooth", "none") != "none" or scored.get("lag") is not None:
            chosen["smoothing"] = True
        _need_settings(graph, chosen)
        built = graph.build(**clocks_of(inputs), **chosen)
        return Case(built, inputs, *_score(built, flight, scored), notes=_left_over(graph, flight))

    flown = inspect.Parameter("flight", inspect.Parameter.POSITIONAL_OR_KEYWORD, annotation=Flight)
    prepare.__signature__ = inspect.Signature([flown, *settings, *more], return_annotation=Case)  # type: ignore[attr-defined]
    prepare.__annotations__ = {n: typing.get_args(t)[0] for n, (t, _) in judging.items()} | known
    prepare.__doc__ = inspect.getdoc(graph)
    prepare.__module__, prepare.__wrapped__ = graph.function.__module__, graph.function  # type: ignore[attr-defined]
    prepare.scoring = frozenset(judging)  # type: ignore[attr-defined]
    return prepare


_EMPTY = inspect.Parameter.empty


def _readable(graph: GraphFunction) -> dict[str, Any]:
    """What reads the words of each setting; None of one that no word can mean."""
    annotated = {
        p.name for p in inspect.signature(graph.function).parameters.values() if p.annotation is not _EMPTY
    }
    found: dict[str, Any] = {}
    for name, type_ in keyword_types(graph.function).items():
        default = graph.parameters[1][name]
        kinds = [k for k in (typing.get_args(type_) or (type_,)) if k is not type(None)]
        if isinstance(default, np.ndarray) or type_ is np.ndarray:
            found[name] = Numbers
        elif name in annotated and kinds and kinds[0] in _PLAIN:
            found[name] = type_
        else:
            plain = isinstance(default, _PLAIN) and name not in annotated
            found[name] = type(default) if plain else None
    return found


def _need_settings(graph: GraphFunction, chosen: Mapping[str, Any]) -> None:
    missing = [n for n in graph.parameters[1] if n not in chosen]
    if missing:
        raise DeclarationError(
            f"nobody says {', '.join(missing)} of this graph",
            path=graph.name,
            expected="a default for each setting, or a function that makes a case of a flight",
            got=f"no value for {', '.join(missing)}",
            fix=f"write --set {missing[0]}=... if it is a number, give it a default, or register a function:"
            f" @on_flight({graph.name}, ...) def for_flight(on): return on.case(..., {missing[0]}=...)",
        )


def _inputs(graph: GraphFunction, flight: Flight) -> dict[str, Series]:
    sources = graph.parameters[0]
    needed = [n for n, (_, optional) in sources.items() if not optional]
    flight.need(graph.name, *needed, fix="call the flight's streams as the graph calls its sources")
    return {n: fitted(flight.streams[n], t, n) for n, (t, _) in sources.items() if n in flight.streams}


def fitted(series: Series, type_: Type, name: str) -> Series:
    """A series as the signal that a source takes, whose fields have the same names and shapes.

    Raises:
        DataError: where a field is missing, or has another shape.
    """
    if series.type == type_:
        return series
    wanted = dict(leaves_of(type_))
    own = series.leaves
    if isinstance(type_, ArrayType) and len(own) == 1:
        own = {"value": next(iter(own.values()))}
    shapes = {n: tuple(own[n].shape[1:]) if n in own else None for n in wanted}
    n = len(series)
    lone = {k for k, s in shapes.items() if s == (1,) and wanted[k].shape == ()}  # one column is one number
    if any(shapes[k] != t.shape and k not in lone for k, t in wanted.items()):
        raise DataError(
            f"the stream {name!r} is not what the graph takes",
            path=series.name,
            expected=", ".join(f"{k}{list(t.shape) or ''}" for k, t in wanted.items()),
            got=", ".join(f"{k}{list(a.shape[1:]) or ''}" for k, a in own.items()),
            fix=f"name the columns of a field: --set {name}.{next(iter(wanted))}=...",
        )
    said = {k: t.unit for k, t in leaves_of(series.type)}
    for k, t in wanted.items():
        unit = said.get(k) or said.get("value")
        if unit and t.unit and unit != t.unit:
            raise DataError(
                f"the stream {name!r} is in another unit than the graph takes",
                path=f"{series.name}.{k}",
                expected=t.unit,
                got=unit,
                fix="mend the unit in the head of the table, or in the signal",
            )
    leaves = [own[k].reshape(n) if k in lone else own[k] for k in wanted]
    for leaf, (k, t) in zip(leaves, wanted.items(), strict=True):
        if t.dtype != "real" and not (leaf == np.rint(leaf)).all():
            raise DataError(
                f"the stream {name!r} has broken numbers where the graph takes whole ones",
                path=f"{series.name}.{k}", expected=t.dtype, got=str(leaf[leaf != np.rint(leaf)].flat[0]),
                fix="mend the data, or declare the field real(...)",
            )  # fmt: skip
    kinds: dict[str, Any] = {
        "int64": np.int64,
        "int32": np.int32,
        "uint32": np.uint32,
        "bool": np.bool_,
        "real": np.float64,
    }
    cast: list[np.ndarray] = [
        leaf.astype(kinds[t.dtype]) for leaf, t in zip(leaves, wanted.values(), strict=True)
    ]
    values = unflatten(type_, iter(cast))
    return Series(series.time, values, type=type_, name=name, gaps=series.gaps)


def _left_over(graph: GraphFunction, flight: Flight) -> tuple[str, ...]:
    spare = [n for n in flight.streams if n not in graph.parameters[0]]
    return (note("skipped", f"streams that {graph.name} does not take: {', '.join(spare)}"),) if spare else ()


def space_of(graph: Graph) -> StateSpace | None:
    """The space of the model that a graph is a filter of; None where there is none, or several."""
    found = {
        repr(space): space  # what a step reads is a copy, and of each step another
        for node in graph.nodes
        if isinstance(node, CallNode)
        for value in node.settings.values()
        if isinstance(space := getattr(value, "space", None), StateSpace)
    }
    return next(iter(found.values())) if len(found) == 1 else None


def _score(graph: Graph, flight: Flight, scored: Mapping[str, Any]) -> tuple[Any, str]:
    """The score of a run, and the stream that it is of: the belief over the space of the graph's model."""
    space = space_of(graph)
    types = {c.name: graph.port(c.wire).type for c in graph.collected}
    estimate = next((n for n, t in types.items() if _is_belief(t, space) and not n.endswith("prior")), None)
    settle = scored.get("settle", Scored.settle)
    if space is None or not space.names or estimate is None:
        return Scorer(flight.truth, _nothing, next(iter(types), ""), settle), next(iter(types), "")
    errors = StateErrors(space, scored.get("align", ALIGNMENTS[0]))
    steps = partial(steps_of, space=space)
    smooth, lag = scored.get("smooth", "none"), scored.get("lag")
    return Scorer(flight.truth, errors, estimate, settle, steps=steps, smooth=smooth, lag=lag), estimate


def _nothing(*_: Any, **__: Any) -> dict[str, float]:
    return {}


def _is_belief(type_: Type, space: StateSpace | None) -> bool:
    if space is None or not isinstance(type_, StructType):
        return False
    leaves = dict(leaves_of(type_))
    return "mean" in leaves and leaves["mean"].shape == (space.size,)
