"""Blocks: immutable objects with typed ports and one pure step.

A block is a plain function. Its positional parameters are ports, its keyword-only parameters settings;
five names are handed in by the engine: `dt` (float seconds since this block last fired, 0 at first), `t`
(the tick's time, int64 ns), `xp` (the array namespace), `draw` (random numbers) and `path`. A port
annotated `X | None` is an optional input. The return annotation types the outputs; an output annotated
`| None` has a clock of its own: the step returns None, or `when(condition, value)`, where it is absent.

A block with memory declares its initial state with `@name.init`; its step then takes the state first and
returns `(new state, outputs)`. Everything else about it is the same.
"""

from __future__ import annotations

import functools
import inspect
import re
import sys
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, NamedTuple, TypeVar

from flowgraph.errors import DeclarationError, FlowgraphError, LoweringError, TypeMismatchError
from flowgraph.ops import Spec
from flowgraph.random import Site, site
from flowgraph.symbolic import Symbolic, Trace, namespace
from flowgraph.types import (
    ArrayType,
    StructType,
    Type,
    annotation_type,
    bind,
    check_fits,
    flatten,
    leaves_of,
    tuple_type,
    type_of,
    unflatten,
    without_none,
)

R = TypeVar("R")

HANDED_IN = ("dt", "t", "xp", "path", "draw")
"""Keyword-only parameters that the engine supplies; all others are settings."""

REQUIRED: Any = inspect.Parameter.empty


class When(NamedTuple):
    """An output that is present only where `present` is true."""

    present: Any
    value: Any


def when(present: Any, value: Any) -> Any:
    """Return `value` from a block's step as an output that exists only where `present` is true."""
    return When(present, value)


class Port(NamedTuple):
    """One end of a wire: name, type (None: any) and whether it may be absent."""

    name: str
    type: Type | None
    optional: bool


class StepOutput(NamedTuple):
    """What one variant of a step gives at an output; `presence` is "always", "never" or a value number."""

    presence: str | int
    type: Type | None
    leaves: tuple[int, ...]


@dataclass(frozen=True)
class StepTrace:
    """The instructions of one variant of a step, with the numbers of its ends."""

    trace: Trace
    arguments: tuple[tuple[int, ...] | None, ...]
    state: tuple[int, ...]
    time: int
    dt: int
    outputs: tuple[StepOutput, ...]
    next_state: tuple[int, ...]
    sites: tuple[tuple[Site, int], ...] = ()


class SymbolicDraw:
    """`draw` while a step is recorded: each site becomes a value that comes from outside."""

    def __init__(self, trace: Trace, prefix: str) -> None:
        self._trace, self._prefix = trace, prefix
        self.sites: dict[Site, Symbolic] = {}

    def normal(self, name: str, shape: tuple[int, ...]) -> Symbolic:
        return self._at(site(self._prefix, "normal", name, shape))

    def uniform(self, name: str, shape: tuple[int, ...]) -> Symbolic:
        return self._at(site(self._prefix, "uniform", name, shape))

    def _at(self, found: Site) -> Symbolic:
        if any(known.name == found.name and known != found for known in self.sites):
            raise DeclarationError(
                "a random stream is drawn in two shapes",
                path=found.name,
                expected="one draw a name",
                got=f"{found.kind}{found.shape} and another",
                fix="give each draw a name of its own",
            )
        if found not in self.sites:
            self.sites[found] = self._trace.input(Spec(found.shape, "real"))
        return self.sites[found]


class Block(Generic[R]):
    """A typed function from port values to outputs, with settings and perhaps a state.

    Calling it inside a `@graph` function wires it; `block.step(...)` runs the function itself on arrays.

    Args:
        step: the function.
        name: what to call it; the function's name where left out.
        host: whether it must stay in Python on the host (OpenCV, files, plots): lowering refuses it.
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
        self.clock_rule, self.output_rule, self.fault = clock, output, fault

    def init(self, function: Callable[..., Any]) -> Callable[..., Any]:
        """Decorator: `function(*port_types, **settings)` is the initial state; the step takes it first."""
        self._init = function
        self.__dict__.pop("_signature_parts", None)
        return function

    def __call__(self, *streams: Any, **settings: Any) -> Any:
        """Wire this block into the graph under construction: streams to ports, the rest to settings."""
        from flowgraph.wiring import wire

        return wire(self, streams, settings)

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
                ports.append(Port(p.name, annotation_type(annotation), optional or p.default is None))
            elif p.kind is p.KEYWORD_ONLY and p.name in HANDED_IN:
                handed.add(p.name)
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

    def initial(self, types: Sequence[Type | None], settings: Mapping[str, Any]) -> Any:
        """The initial state for these argument types and settings."""
        assert self._init is not None
        return self._init(*types, **settings)

    def record(
        self,
        types: Sequence[Type | None],
        settings: Mapping[str, Any],
        state: Type | None,
        path: str,
        draws: str = "",
    ) -> StepTrace:
        """Run the step on symbolic arguments (None: absent) and return what it did.

        Raises:
            LoweringError: where it does something a pipeline cannot hold; names the line.
        """
        trace = Trace()

        def symbolic(type_: Type) -> tuple[Any, tuple[int, ...]]:
            leaves = [trace.input(Spec(_sizes(t, path), t.dtype)) for _, t in leaves_of(type_)]
            return unflatten(type_, iter(leaves)), tuple(leaf.number for leaf in leaves)

        time, dt = trace.input(Spec((), "int64")), trace.input(Spec((), "real"))
        args = [None if t is None else symbolic(t) for t in types]
        known = {
            number: leaf
            for t, a in zip(types, args, strict=True)
            if t is not None and a is not None
            for number, (_, leaf) in zip(a[1], leaves_of(t), strict=True)
        }
        values = [None if a is None else a[0] for a in args]
        memory = symbolic(state) if state is not None else None
        draw = SymbolicDraw(trace, draws or self.name)
        handed = {"dt": dt, "t": time, "xp": namespace, "path": path, "draw": draw}
        try:
            result = self.step(
                *([memory[0]] if memory else []), *values, **settings, **{h: handed[h] for h in self.handed}
            )
        except FlowgraphError as error:
            error.path = f"{path} ({error.path})" if error.path else path
            raise
        except Exception as error:
            raise LoweringError(
                f"the step cannot be traced: {type(error).__name__}: {error}",
                path=f"{path} ({_line_of(error)})",
                expected="array-API operations through xp on fixed shapes",
                got=f"{type(error).__name__}",
                fix="use functions of xp, or declare @block(host=True) with annotated outputs",
            ) from error
        next_state: tuple[int, ...] = ()
        if memory is not None and state is not None:
            new_state, result = self._split(result, path)
            fits_state(new_state, state, path)
            next_state = _numbers(trace, new_state, state)
        outputs = tuple(
            _output(trace, value, port, known, path)
            for value, port in zip(
                self.split_outputs(result, path), self.outputs or [Port("out", None, False)], strict=True
            )
        )
        return StepTrace(
            trace,
            tuple(None if a is None else a[1] for a in args),
            memory[1] if memory else (),
            time.number,
            dt.number,
            outputs,
            next_state,
            tuple((known, value.number) for known, value in draw.sites.items()),
        )

    def _split(self, result: Any, path: str) -> tuple[Any, Any]:
        if not isinstance(result, tuple) or len(result) != 2 or isinstance(result, When):
            raise DeclarationError(
                "a block with a state must return (state, outputs)",
                path=path,
                expected="a pair",
                got=type(result).__name__,
                fix="return new_state, output",
            )
        return result

    def split_outputs(self, result: Any, path: str) -> tuple[Any, ...]:
        """The outputs one by one."""
        if self.outputs is None or len(self.outputs) == 1:
            return (result,)
        if not isinstance(result, tuple) or len(result) != len(self.outputs):
            raise DeclarationError(
                "the step returns another number of outputs than it declares",
                path=path,
                expected=f"{len(self.outputs)} outputs ({', '.join(p.name for p in self.outputs)})",
                got=f"{len(result)}" if isinstance(result, tuple) else type(result).__name__,
                fix="return one value an output, as annotated",
            )
        return result

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


def fits_state(new: Any, state: Type, path: str) -> None:
    """Check that a step's new state has the type of its initial state."""
    check_fits(
        type_of(new), state, given_at=f"the state returned by {path}", wanted_at=f"{path} state", sizes={}
    )


def _numbers(trace: Trace, value: Any, type_: Type) -> tuple[int, ...]:
    lifted = [leaf if isinstance(leaf, Symbolic) else trace.constant(leaf) for leaf in flatten(value, type_)]
    kinds = [t.dtype for _, t in leaves_of(type_)]
    return tuple(leaf.cast(kind).number for leaf, kind in zip(lifted, kinds, strict=True))


def _output(trace: Trace, value: Any, port: Port, known: dict[int, ArrayType], path: str) -> StepOutput:
    if value is None:
        return StepOutput("never", None, ())
    presence: str | int = "always"
    if isinstance(value, When):
        flag = value.present
        presence = (flag if isinstance(flag, Symbolic) else trace.constant(bool(flag))).cast("bool").number
        value = value.value
    given = _typed(value, known)
    if port.type is not None:
        sizes: dict[str, int] = {}
        wanted = _reals(port.type, given)
        try:
            check_fits(
                wanted, port.type, given_at=f"{path}'s result", wanted_at=f"{path}.{port.name}", sizes=sizes
            )
        except TypeMismatchError as error:
            error.fix = "return what the annotation promises, or mend the annotation"
            raise
        given = _with_units(wanted, bind(port.type, sizes))
    return StepOutput(presence, given, _numbers(trace, value, given))


def _typed(value: Any, known: dict[int, ArrayType]) -> Type:
    """The type of a result; a leaf passed through unchanged keeps its unit and frame."""
    if isinstance(value, Symbolic) and value.number in known:
        return known[value.number]
    if isinstance(value, tuple):
        return tuple_type([_typed(v, known) for v in value])
    return type_of(value)


def _reals(wanted: Type, given: Type) -> Type:
    """`given`, with Python integers where `wanted` has a real taken as reals."""
    if isinstance(wanted, ArrayType) and isinstance(given, ArrayType) and wanted.dtype == "real":
        return ArrayType(given.shape, "real" if given.dtype != "bool" else "bool", given.unit, given.frame)
    return given


def _with_units(given: Type, named: Type) -> Type:
    if isinstance(given, ArrayType) and isinstance(named, ArrayType):
        return replace(
            given,
            unit=named.unit or given.unit,
            frame=named.frame or given.frame,
            axes=named.axes or given.axes,
        )
    if isinstance(given, StructType) and isinstance(named, StructType):
        pairs = zip(given.fields, named.fields, strict=True)
        return StructType(given.name, tuple((n, _with_units(g, w)) for (n, g), (_, w) in pairs), given.cls)
    return given


def _sizes(leaf: ArrayType, path: str) -> tuple[int, ...]:
    unbound = [d for d in leaf.shape if isinstance(d, str)]
    if unbound:
        raise DeclarationError(
            f"size {unbound[0]!r} is not bound",
            path=path,
            expected="every size known when the graph is built",
            got=str(leaf),
            fix=f"give it to build: build(sizes={{{unbound[0]!r}: ...}})",
        )
    return typing.cast(tuple[int, ...], leaf.shape)


def _line_of(error: BaseException) -> str:
    """module:line of the last frame of the user's code in a traceback."""
    place = "?"
    step = error.__traceback__
    while step is not None:
        module = step.tb_frame.f_globals.get("__name__", "?")
        if module not in (__name__, "flowgraph.symbolic", "flowgraph.ops"):
            place = f"{module}:{step.tb_lineno}"
        step = step.tb_next
    return place


def _snake(name: str) -> str:
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()
