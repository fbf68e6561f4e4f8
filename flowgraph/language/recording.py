"""Recording a step: a block's function runs once on symbolic arrays, and what it does is written down.

The result is a `StepTrace`: instructions, and the numbers of the values at its ends (arguments, state, time,
draws, outputs). It is made when a block is wired, which is also how output types are found.
"""

from __future__ import annotations

import typing
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

from flowgraph.errors import (
    DeclarationError,
    FlowgraphError,
    LoweringError,
    TypeMismatchError,
    declaring_line,
)
from flowgraph.language.block import Block, Port, When
from flowgraph.language.freezing import Freezer, NotPlainError, fingerprint
from flowgraph.language.mistakes import is_mistake
from flowgraph.language.purity import line_of_step, refuse_different, refuse_write
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.random import Site, site
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace
from flowgraph.recorder.units import Unit, parsed, written
from flowgraph.types import (
    ArrayType,
    StructType,
    Type,
    bind,
    check_fits,
    flatten,
    leaves_of,
    tuple_type,
    type_of,
    unflatten,
)


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


@contextmanager
def remembering(memory: OrderedDict[Any, Any]) -> Iterator[None]:
    """Within it, a step recorded before with the same settings and types is not recorded again.

    For those who build the same graph many times over. Only steps that read and are set by plain values,
    arrays, dataclasses of these, hashable objects that compare by value and functions of these are
    remembered; the oldest are forgotten beyond a few hundred.
    """
    token = _memory.set(memory)
    try:
        yield
    finally:
        _memory.reset(token)


_memory: ContextVar[OrderedDict[Any, Any] | None] = ContextVar("recorded steps", default=None)
_REMEMBERED = 512


def record(
    block: Block[Any],
    types: Sequence[Type | None],
    settings: Mapping[str, Any],
    state: Type | None,
    path: str,
    draws: str = "",
    *,
    freezer: Freezer | None = None,
) -> StepTrace:
    """Run the step on symbolic arguments (None: absent) and return what it did.

    Args:
        freezer: that froze the step; where functions of the user's are in it, it is run a second time.

    Raises:
        LoweringError: where it does something a pipeline cannot hold; names the line.
        DeclarationError: where it is not a step of this type, or not the same each time.
    """

    def recorded() -> StepTrace:
        made = _record(block, types, settings, state, path, draws)
        if freezer is not None and freezer.own and not freezer.written():
            refuse_different(made.trace, _record(block, types, settings, state, path, draws).trace, path)
        return made

    memory = _memory.get()
    if memory is None:
        return recorded()
    try:
        plain = tuple((n, fingerprint(v)) for n, v in settings.items())
        step = None if block.step is block.declared.step else fingerprint(block.step)
    except NotPlainError:
        return recorded()
    which = (id(block.declared), step, tuple(types), plain, state, path, draws)
    if which not in memory:
        memory[which] = block, recorded()  # id is of what is alive
        while len(memory) > _REMEMBERED:
            memory.popitem(last=False)
    memory.move_to_end(which)
    found: StepTrace = memory[which][1]
    return found


def _record(
    block: Block[Any],
    types: Sequence[Type | None],
    settings: Mapping[str, Any],
    state: Type | None,
    path: str,
    draws: str,
) -> StepTrace:
    trace = Trace()

    def symbolic(type_: Type) -> tuple[Any, tuple[int, ...]]:
        leaves = [trace.input(Spec(_sizes(t, path), t.dtype)) for _, t in leaves_of(type_)]
        trace.units |= {
            leaf.number: unit
            for leaf, (_, t) in zip(leaves, leaves_of(type_), strict=True)
            if (unit := parsed(t.unit)) is not None
        }
        return unflatten(type_, iter(leaves)), tuple(leaf.number for leaf in leaves)

    time, dt = trace.input(Spec((), "int64")), trace.input(Spec((), "real"))
    trace.units[dt.number] = typing.cast(Unit, parsed("s"))
    args = [None if t is None else symbolic(t) for t in types]
    known = {
        number: leaf
        for t, a in zip(types, args, strict=True)
        if t is not None and a is not None
        for number, (_, leaf) in zip(a[1], leaves_of(t), strict=True)
    }
    values = [None if a is None else a[0] for a in args]
    memory = symbolic(state) if state is not None else None
    draw = SymbolicDraw(trace, draws or block.name)
    handed = {"dt": dt, "t": time, "xp": namespace, "path": path, "draw": draw}
    try:
        result = block.step(
            *([memory[0]] if memory else []), *values, **settings, **{h: handed[h] for h in block.handed}
        )
    except FlowgraphError as error:
        error.path = f"{path} ({error.path})" if error.path else path
        raise
    except Exception as error:
        if isinstance(error, ValueError) and "read-only" in str(error):
            refuse_write(path, "an array that it reads", declaring_line(error))
        refusal = LoweringError(
            f"the step cannot be traced: {type(error).__name__}: {error}",
            path=f"{path} ({declaring_line(error)})",
            expected="array-API operations through xp on fixed shapes",
            got=f"{type(error).__name__}",
            fix="use functions of xp, or declare @block(host=True) with annotated outputs",
        )
        if is_mistake(error):
            refusal.in_every_engine = True
            refusal.message = f"the step is wrong: {type(error).__name__}: {error}"
            refusal.expected = "a step that runs on values of the types at its ports"
            refusal.fix = "mend this line; a step that needs numbers is declared with @block(host=True)"
        raise refusal from error
    next_state: tuple[int, ...] = ()
    if memory is not None and state is not None:
        new_state, result = _split(result, path)
        _fits_state(new_state, state, path)
        next_state = _numbers(trace, new_state, state)
    outputs = tuple(
        _output(trace, value, port, known, path, line_of_step(block))
        for value, port in zip(
            _outputs(block, result, path), block.outputs or [Port("out", None, False)], strict=True
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


def _split(result: Any, path: str) -> tuple[Any, Any]:
    if not isinstance(result, tuple) or len(result) != 2 or isinstance(result, When):
        raise DeclarationError(
            "a block with a state must return (state, outputs)",
            path=path,
            expected="a pair",
            got=type(result).__name__,
            fix="return new_state, output",
        )
    return result


def _outputs(block: Block[Any], result: Any, path: str) -> tuple[Any, ...]:
    """The outputs one by one."""
    if block.outputs is None or len(block.outputs) == 1:
        return (result,)
    if not isinstance(result, tuple) or len(result) != len(block.outputs):
        raise DeclarationError(
            "the step returns another number of outputs than it declares",
            path=path,
            expected=f"{len(block.outputs)} outputs ({', '.join(p.name for p in block.outputs)})",
            got=f"{len(result)}" if isinstance(result, tuple) else type(result).__name__,
            fix="return one value an output, as annotated",
        )
    return result


def _fits_state(new: Any, state: Type, path: str) -> None:
    """Check that a step's new state has the type of its initial state."""
    check_fits(
        type_of(new), state, given_at=f"the state returned by {path}", wanted_at=f"{path} state", sizes={}
    )


def _numbers(trace: Trace, value: Any, type_: Type) -> tuple[int, ...]:
    lifted = [leaf if isinstance(leaf, Symbolic) else trace.constant(leaf) for leaf in flatten(value, type_)]
    kinds = [t.dtype for _, t in leaves_of(type_)]
    return tuple(leaf.cast(kind).number for leaf, kind in zip(lifted, kinds, strict=True))


def _output(
    trace: Trace, value: Any, port: Port, known: dict[int, ArrayType], path: str, line: str | None
) -> StepOutput:
    if value is None:
        return StepOutput("never", None, ())
    presence: str | int = "always"
    if isinstance(value, When):
        flag = value.present
        if getattr(flag, "shape", ()) != ():
            raise DeclarationError(
                "an output is present or absent as a whole",
                path=f"{path}.{port.name}",
                expected="one truth value",
                got=f"shape {flag.shape}",
                fix="reduce it with xp.all(...) or xp.any(...)",
            )
        presence = (flag if isinstance(flag, Symbolic) else trace.constant(bool(flag))).cast("bool").number
        value = value.value
    given = _typed(value, known, trace)
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
    numbers = _numbers(trace, value, given)
    check_units(trace, numbers, given, f"{path}.{port.name}", line)
    return StepOutput(presence, given, numbers)


def check_units(trace: Trace, numbers: Sequence[int], type_: Type, path: str, line: str | None) -> None:
    """Refuse a result whose unit is known and is not the one that its type states; `line` is the step's."""
    leaves = leaves_of(type_)
    for number, (name, wanted) in zip(numbers, leaves, strict=len(numbers) == len(leaves)):
        stated, found = parsed(wanted.unit), trace.units.get(number)
        if stated is None or found is None or stated == found:
            continue
        error = TypeMismatchError(
            f"the unit of {name!r} is not the one that is declared",
            path=path,
            expected=wanted.unit,
            got=written(found),
            fix=f"compute it in {wanted.unit}, or mend the unit of the declaration",
        )
        error.line = trace.line(number) or line
        raise error


def _typed(value: Any, known: dict[int, ArrayType], trace: Trace) -> Type:
    """The type of a result; a leaf passed through unchanged keeps its frame too, one computed its unit."""
    if isinstance(value, list):
        raise DeclarationError(
            "a step returns a list",
            expected="an array, a signal or a tuple",
            got="list",
            fix="write xp.stack([...]), or xp.asarray([...]) of constants",
        )
    if isinstance(value, Symbolic) and value.number in known:
        return known[value.number]
    if isinstance(value, tuple):
        return tuple_type([_typed(v, known, trace) for v in value])
    if isinstance(value, Symbolic) and value.dtype_name == "real":
        given = [leaf.unit for leaf in known.values() if leaf.unit is not None]
        return ArrayType(value.shape, "real", trace.unit(value.number, given))
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
