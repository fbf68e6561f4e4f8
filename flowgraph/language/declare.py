"""Declaring a graph: `@graph`, `delay`, `build`.

Inside a `@graph` function, calling a block with streams adds a node; types and clocks are checked there and
then. `build` runs the function once, checks what can only be checked at the end (unfed delays, cycles,
unused sources) and freezes the result. A graph called inside another nests: its nodes keep their names
under its own.
"""

from __future__ import annotations

import functools
import inspect
import sys
import typing
from collections.abc import Callable, Mapping
from typing import Any

from flowgraph.errors import DeclarationError, UnknownNameError, asking_line, naming_lines, place
from flowgraph.language.block import REQUIRED
from flowgraph.language.builder import Builder, builder, building
from flowgraph.language.clock import Source, Timing
from flowgraph.language.graph import Graph, SourceNode, Wire
from flowgraph.language.stream import Held, Stream
from flowgraph.types import Type, annotation_type, bind, check_fits, without_none

T = typing.TypeVar("T")

if typing.TYPE_CHECKING:
    from flowgraph.data.flight import Flight
    from flowgraph.data.registry import Case


def delay(init: T, *, name: str | None = None, type: Any = None) -> Held[T]:
    """A register read before this tick's write: last tick's value. Feed it with `.feed(stream)`.

    Args:
        init: its value at the start of a run (a run may name another).
        name: its name in paths and in `run.state`.
        type: its type where `init` does not say it (a unit, a frame).
    """
    declared = annotation_type(type) if type is not None else None
    return builder("delay").register("delay", name or "delay", init, declared, given=name is not None)


class GraphFunction:
    """What `@graph` makes of a function: call it inside another graph, or `build` it."""

    def __init__(self, function: Callable[..., Any], local: Mapping[str, Any] | None = None) -> None:
        functools.update_wrapper(self, function)
        self.function = function
        self.name = function.__name__
        self._local = local
        self.prepare: Callable[..., Case] | None = None

    @functools.cached_property
    def parameters(self) -> tuple[dict[str, tuple[Type, bool]], dict[str, Any]]:
        """Sources (type and whether optional) and settings with their defaults."""
        try:
            hints = typing.get_type_hints(self.function, localns=dict(self._local or {}), include_extras=True)
        except NameError as error:
            raise DeclarationError(
                f"an annotation cannot be resolved: {error}",
                path=self.name,
                expected="names visible where the graph is defined",
                got=str(error),
                fix="import the signal type at module level",
            ) from None
        sources: dict[str, tuple[Type, bool]] = {}
        settings: dict[str, Any] = {}
        for p in inspect.signature(self.function).parameters.values():
            annotation, optional = without_none(hints.get(p.name))
            if p.kind is p.KEYWORD_ONLY:
                settings[p.name] = p.default
            elif typing.get_origin(annotation) is Stream:
                type_ = annotation_type(typing.get_args(annotation)[0])
                if type_ is None:
                    raise DeclarationError(
                        f"source {p.name!r} has no signal type",
                        path=self.name,
                        expected="Stream[SomeSignal] or Stream[Scalar]",
                        got=str(annotation),
                        fix="annotate it with a Signal class",
                    )
                sources[p.name] = (type_, optional)
            else:
                raise DeclarationError(
                    f"parameter {p.name!r} is neither a stream nor a setting",
                    path=self.name,
                    expected="positional parameters annotated Stream[...], settings after *",
                    got=str(annotation),
                    fix=f"write {p.name}: Stream[SomeSignal], or put it after *",
                )
        return sources, settings

    def __call__(self, *streams: Any, name: str | None = None, **keywords: Any) -> Any:
        """Nest this graph in the one under construction; returns what its function returns."""
        build = builder(self.name)
        with build.scope(name or self.name, given=name is not None):
            bound = self._bound(build, streams, keywords)
            for source, (type_, optional) in self.parameters[0].items():
                value = bound.arguments.get(source)
                if value is None and optional:
                    continue
                if not isinstance(value, Stream | Held):
                    raise DeclarationError(
                        f"source {source!r} needs a stream",
                        path=self.name,
                        expected=f"Stream of {type_}",
                        got=repr(value),
                        fix="pass a stream of the enclosing graph",
                    )
                check_fits(
                    value.type, type_, given_at=value.label, wanted_at=f"{self.name}.{source}", sizes={}
                )
            return self.function(*streams, **keywords)

    def _bound(
        self, build: Builder, streams: tuple[Any, ...], keywords: dict[str, Any]
    ) -> inspect.BoundArguments:
        sources, settings = self.parameters
        for key in keywords:
            if key not in sources and key not in settings:
                raise UnknownNameError("source or setting", key, [*sources, *settings], path=self.name)
        try:
            return inspect.signature(self.function).bind(*streams, **keywords)
        except TypeError as error:
            raise DeclarationError(
                f"this graph is called wrongly: {error}",
                path=f"{build.name}/{self.name}",
                expected=f"{self.name}({', '.join([*sources, *(f'{k}=...' for k in settings)])})",
                got=f"{len(streams)} streams, {', '.join(keywords) or 'no settings'}",
                fix="give each source a stream, and each setting without a default a value",
            ) from None

    def build(self, *, sizes: Mapping[str, int] | None = None, **declared: Any) -> Graph:
        """Run the function once and freeze the graph.

        Args:
            sizes: values of symbolic sizes in source types.
            **declared: a `periodic(...)` or `aperiodic(...)` for each source (aperiodic where left out; an
                optional source exists only if it is named), and a value for each setting.

        Raises:
            DeclarationError, TypeMismatchError, ClockError, CycleError: at the line that is wrong.
        """
        sources, settings = self.parameters
        for key in declared:
            if key not in sources and key not in settings:
                raise UnknownNameError("source or setting", key, [*sources, *settings], path=self.name)
        chosen = {k: declared.get(k, default) for k, default in settings.items()}
        missing = [k for k, v in chosen.items() if v is REQUIRED]
        if missing:
            raise DeclarationError(
                f"setting {missing[0]!r} is missing",
                path=self.name,
                expected=", ".join(settings),
                got=", ".join(k for k in declared if k in settings) or "none",
                fix=f"write {self.name}.build(..., {missing[0]}=...)",
            )
        build = Builder(self.name)
        code = getattr(inspect.unwrap(self.function), "__code__", None)
        whole = None if code is None else place(self.function.__globals__, code.co_firstlineno)
        with building(build), naming_lines(whole):
            streams = {
                name: self._source(build, name, type_, optional, declared.get(name), sizes or {})
                for name, (type_, optional) in sources.items()
            }
            result = self.function(**streams, **chosen)
            for name, stream in _named(result, self.name).items():
                build.collect(name, stream)
            return build.freeze(inspect.getdoc(self.function) or "", chosen)

    def _source(
        self, build: Builder, name: str, type_: Type, optional: bool, timing: Any, sizes: Mapping[str, int]
    ) -> Stream[Any] | None:
        if timing is None and optional:
            return None
        timing = Timing() if timing is None or timing is True else timing
        if not isinstance(timing, Timing):
            raise DeclarationError(
                f"the clock of source {name!r} is not understood",
                path=self.name,
                expected='periodic("5ms") or aperiodic(max_rate=100)',
                got=repr(timing),
                fix=f'write build({name}=periodic("5ms"))',
            )
        path = build.path(name, given=True)
        return build.stream(Wire(build.add(SourceNode(path, bind(type_, sizes), Source(path, timing))), 0))

    def on_flight(self, prepare: Callable[..., Case]) -> Callable[..., Case]:
        """Decorator: `prepare(flight, **settings) -> Case` makes this graph ready for a recorded flight."""
        self.prepare = prepare
        return prepare

    def case(self, flight: Flight, **settings: Any) -> Case:
        """This graph, built and started for a flight.

        Raises:
            DeclarationError: where no function was registered with `on_flight`, or this is no flight.
            UnknownNameError: for a setting that this function does not have.
        """
        if self.prepare is None:
            raise DeclarationError(
                "this graph does not know how to start on a flight",
                path=self.name,
                expected=f"a function registered with @{self.name}.on_flight",
                got="none",
                fix="build the graph yourself and call simulate(graph, inputs)",
            )
        if not hasattr(flight, "streams"):
            raise DeclarationError(
                "a case is of a flight",
                path=self.name,
                expected="a Flight",
                got=repr(flight)[:80],
                fix=f'load it first: {self.name}.case(load_flight("sim"))',
            )
        known = inspect.signature(self.prepare).parameters
        if not any(p.kind is p.VAR_KEYWORD for p in known.values()):
            for key in settings.keys() - getattr(self.prepare, "refused", {}).keys():  # see there
                if key not in known:
                    raise UnknownNameError("setting", key, list(known)[1:], path=self.name)
        return self.prepare(flight, **settings)

    def __getattr__(self, name: str) -> typing.NoReturn:
        if name.startswith("_") or not (name in Graph.__dataclass_fields__ or hasattr(Graph, name)):
            raise AttributeError(f"a @graph function has no attribute {name!r}")
        error = DeclarationError(
            "this graph is declared, but not built",
            path=self.name,
            expected="a built graph",
            got=f"the function {self.name}",
            fix=f"build it first: {self.name}.build(...)",
        )
        error.line = asking_line()
        raise error

    def __repr__(self) -> str:
        return f"<@graph {self.name}>"


def graph(function: Callable[..., Any]) -> GraphFunction:
    """Declare a graph: positional parameters annotated `Stream[...]` are sources, keyword-only ones settings.

    The function returns a stream (collected as "output"), a dict of named streams, or a tuple of them.
    """
    frame = sys._getframe(1)
    return GraphFunction(function, None if frame.f_locals is frame.f_globals else frame.f_locals)


def _named(result: Any, name: str) -> dict[str, Any]:
    if result is None:
        return {}
    if isinstance(result, Mapping):
        return dict(result)
    if isinstance(result, tuple):
        return {f"output_{k + 1}": stream for k, stream in enumerate(result)}
    return {"output": result}
