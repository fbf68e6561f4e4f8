"""Blocks: immutable objects with typed ports and one pure step.

A block is a plain function. Its positional parameters are ports, its keyword-only parameters settings;
five names are handed in by the engine: `dt` (float seconds since this block last fired, 0 at first), `t`
(the tick's time, int64 ns), `xp` (the array namespace), `draw` (random numbers) and `path`. A port
annotated `X | None` is an optional input. The return annotation types the outputs; an output annotated
`| None` has a clock of its own: the step returns None, or `when(condition, value)`, where it is absent.

A block with memory declares its initial state with `@name.init`; its step then takes the state first and
returns `(new state, outputs)`. Everything else about it is the same.

A block whose settings make it unfit for some kind of number says so with `@name.limited`; see `Limit`.
"""

from __future__ import annotations

import copy
import functools
import inspect
import re
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

from flowgraph.errors import DeclarationError
from flowgraph.types import (
    StructType,
    Type,
    annotation_type,
    without_none,
)
from flowgraph.verbs import verb

R = TypeVar("R")

HANDED_IN = ("dt", "t", "xp", "path", "draw")
"""Keyword-only parameters that the engine supplies; all others are settings."""

WIRING = ("at", "name", "draws")
"""Keywords of every wiring: the clock at which to fire, the node's name, the names of its random streams."""

REQUIRED: Any = inspect.Parameter.empty


class When(NamedTuple):
    """An output that is present only where `present` is true."""

    present: Any
    value: Any


def when(present: Any, value: Any) -> Any:
    """Return `value` from a block's step as an output that exists only where `present` is true."""
    return When(present, value)


class Limit(NamedTuple):
    """Kinds of number in which a block, with the settings that it has, must not be computed, and why.

    Args:
        numbers: of `NUMBERS`, those that are refused.
        message, expected, got, fix: of the error; `path` is filled in when the graph is lowered.
    """

    numbers: tuple[str, ...]
    message: str
    expected: str
    got: str
    fix: str
    path: str = ""


NUMBERS = ("float64", "float32", "fixed")
"""What a `real` can be in a lowered graph; "fixed" stands for every fixed-point format."""


class Port(NamedTuple):
    """One end of a wire: name, type (None: any) and whether it may be absent.

    A port with a default other than None is a setting where nothing is wired to it.
    """

    name: str
    type: Type | None
    optional: bool
    default: Any = REQUIRED


class Block(Generic[R]):
    """A typed function from port values to outputs, with settings and perhaps a state.

    Calling it inside a `@graph` function wires it; `block.step(...)` runs the function itself on arrays.

    Args:
        step: the function.
        name: what to call it; the function's name where left out.
        host: whether it must stay in Python on the host (OpenCV, files, plots), outside the pipeline.
        clock: for joins, `(firing clock, argument clocks, settings) -> Clock | None` of the first output.
        output: for joins, `(argument types, settings) -> Type` of the first output.
        fault: for joins, `(state leaf, message)`: a time in ns at which a bound was exceeded.
        local: names of the function in which it is defined, for its annotations.
    """

    def __init__(
        self,
        step: Callable[..., Any],
        *,
        name: str | None = None,
        host: bool = False,
        init: Callable[..., Any] | None = None,
        clock: Callable[..., Any] | None = None,
        output: Callable[..., Type] | None = None,
        fault: tuple[str, str] | None = None,
        local: Mapping[str, Any] | None = None,
    ) -> None:
        functools.update_wrapper(self, step)
        self.step = step
        self.name = name or getattr(step, "__name__", type(step).__name__).strip("<>")
        self.host = host
        self._init, self._local = init, local
        self._limits: Callable[..., Sequence[Limit]] | None = None
        self.clock_rule, self.output_rule, self.fault = clock, output, fault
        self.declared: Block[R] = self

    def init(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorator: `function(*port_types, **settings)` is the initial state; the step takes it first."""
        self._init = function
        self.__dict__.pop("_signature_parts", None)
        return function

    def limited(self, function: Callable[..., Sequence[Limit]]) -> Callable[..., Sequence[Limit]]:
        """Decorator: `function(**settings)` gives the `Limit`s that these settings bring; lowering asks."""
        self._limits = function
        return function

    def limits(self, settings: Mapping[str, Any]) -> tuple[Limit, ...]:
        """The kinds of number that these settings rule out."""
        return () if self._limits is None else tuple(self._limits(**settings))

    def __call__(self, *streams: Any, **settings: Any) -> Any:
        """Wire this block into the graph under construction: streams to ports, the rest to settings."""
        return verb("Block.__call__")(self, streams, settings)

    def wired(self, *, at: object = None, name: str | None = None, draws: Any = None) -> Callable[..., Any]:
        """This block with what a call says of its place in the graph: `predict.wired(at=seen)(track)` is
        `predict(track, at=seen)`, in a form that type checkers follow; see `typed_block`."""
        said = {"at": at, "name": name, "draws": draws}
        return functools.partial(self, **{key: value for key, value in said.items() if value is not None})

    @property
    def stateful(self) -> bool:
        return self._init is not None

    @functools.cached_property
    def _signature_parts(
        self,
    ) -> tuple[tuple[Port, ...], dict[str, Any], frozenset[str], tuple[Port, ...] | None]:
        try:
            parameters = list(inspect.signature(self.step).parameters.values())
        except (TypeError, ValueError):  # a ufunc or another builtin: one port
            return (Port("x", None, False),), {}, frozenset(), None
        try:
            hints = typing.get_type_hints(self.step, localns=dict(self._local or {}), include_extras=True)
        except TypeError:
            hints = {}
        except NameError as error:
            raise DeclarationError(
                f"an annotation cannot be resolved: {error}",
                path=self.name,
                expected="names visible where the block is defined",
                got=str(error),
                fix="import the signal type at module level",
            ) from None
        ports, settings, handed = [], {}, set()
        for p in parameters:
            if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD):
                annotation, optional = without_none(hints.get(p.name))
                default = REQUIRED if p.default is None else p.default
                ports.append(
                    Port(p.name, annotation_type(annotation), optional or p.default is None, default)
                )
            elif p.kind is p.KEYWORD_ONLY and p.name in HANDED_IN:
                handed.add(p.name)
            elif p.kind is p.KEYWORD_ONLY and p.name in WIRING:
                raise DeclarationError(
                    f"a setting cannot be called {p.name!r}",
                    path=self.name,
                    expected="a name other than " + ", ".join(WIRING),
                    got=p.name,
                    fix="these say how a block is wired; choose another name",
                )
            elif p.kind is p.KEYWORD_ONLY:
                settings[p.name] = p.default
            else:
                raise DeclarationError(
                    f"parameter {p} cannot be a port or a setting",
                    path=self.name,
                    expected="positional parameters (ports) and keyword-only ones (settings)",
                    got=str(p),
                    fix="name each port and each setting",
                )
        if self.stateful:
            if not ports:
                raise DeclarationError(
                    "a block with init has no state parameter",
                    path=self.name,
                    expected="a step whose first parameter is the state",
                    got="no positional parameter",
                    fix="write def step(state, x, *, ...)",
                )
            ports = ports[1:]
        return tuple(ports), settings, frozenset(handed), self._output_ports(hints.get("return"))

    def _output_ports(self, annotation: Any) -> tuple[Port, ...] | None:
        if annotation is None:
            return None
        if self.stateful:
            parts = typing.get_args(annotation)
            if typing.get_origin(annotation) is not tuple or len(parts) != 2:
                return None
            annotation = parts[1]
        parts = (annotation,)
        if typing.get_origin(annotation) is tuple:
            parts = typing.get_args(annotation)
        if parts == (type(None),):
            return ()
        ports: list[Port] = []
        for part in parts:
            inner, optional = without_none(part)
            type_ = annotation_type(inner)
            name = _snake(type_.name) if isinstance(type_, StructType) and len(parts) > 1 else "out"
            taken = sum(p.name.rstrip("_0123456789") == name for p in ports)
            ports.append(Port(f"{name}_{taken + 1}" if taken else name, type_, optional))
        return tuple(ports)

    @property
    def ports(self) -> tuple[Port, ...]:
        """The input ports in order."""
        return self._signature_parts[0]

    @property
    def settings(self) -> dict[str, Any]:
        """Settings and their defaults (`REQUIRED` where there is none)."""
        return self._signature_parts[1]

    @property
    def handed(self) -> frozenset[str]:
        """Which of `dt`, `t`, `xp`, `draw`, `path` the step asks for."""
        return self._signature_parts[2]

    @property
    def outputs(self) -> tuple[Port, ...] | None:
        """The output ports as annotated; None where the step is not annotated (then: one, inferred)."""
        return self._signature_parts[3]

    def with_step(self, step: Callable[..., Any]) -> Block[R]:
        """This block with another function of the same parameters; `declared` is the one it came from."""
        made = self._like()
        made.step = step
        return made

    def with_settings(self, names: Sequence[str]) -> Block[R]:
        """This block with some of its ports, which have defaults, as settings."""
        made = self._like()
        ports, settings, handed, outputs = self._signature_parts
        settings = settings | {p.name: p.default for p in ports if p.name in names}
        kept = tuple(p for p in ports if p.name not in names)
        made.__dict__["_signature_parts"] = kept, settings, handed, outputs
        return made

    def _like(self) -> Block[R]:
        _ = self._signature_parts  # what the annotations name is looked up where the function was written
        return copy.copy(self)

    def initial(self, types: Sequence[Type | None], settings: Mapping[str, Any]) -> Any:
        """The initial state for these argument types and settings."""
        assert self._init is not None
        return self._init(*types, **settings)

    def __repr__(self) -> str:
        return f"<block {self.name}({', '.join(p.name for p in self.ports)})>"


@typing.overload
def block(step: Callable[..., R], /) -> Block[R]: ...
@typing.overload
def block(
    *, name: str | None = None, host: bool = False, **rules: Any
) -> Callable[[Callable[..., R]], Block[R]]: ...
def block(step: Callable[..., Any] | None = None, /, **options: Any) -> Any:
    """Make a block of a typed function: `@block`, or `@block(host=True)` for one that stays in Python."""
    frame = sys._getframe(1)
    local = None if frame.f_locals is frame.f_globals else frame.f_locals
    if step is None:
        return lambda function: Block(function, local=local, **options)
    return Block(step, local=local)


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def line_of(block: Block[Any]) -> str:
    """module:line of a block's function, as far as it is known."""
    step = inspect.unwrap(block.step)
    code = getattr(step, "__code__", None)
    return getattr(step, "__module__", "") + ("" if code is None else f":{code.co_firstlineno}")
