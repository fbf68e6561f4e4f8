"""The Python engine's plan: one straight-line function for each pattern of present sources.

Which nodes fire in a tick is mostly decided by which sources have an event in it. For each such pattern
that occurs, the reaction is written out once as Python text, with everything known about presence folded
away, and compiled. The blocks' own steps are called from it directly, so a debugger steps from the
reaction (its text is registered for tracebacks) into the lines that the user wrote.
"""

from __future__ import annotations

import linecache
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from types import CodeType
from typing import Any

import numpy as np

from flowgraph.errors import TypeMismatchError
from flowgraph.language.block import When
from flowgraph.language.clock import AllOf, AnyOf, Clock, Condition, Counted, Not, Source
from flowgraph.language.graph import NEVER, Argument, CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.language.recording import StepTrace
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.types import Signal, as_value

Presence = bool | str
"""Whether something is present: known for a pattern, or an expression of the reaction's variables."""


@dataclass(frozen=True)
class Plan:
    """A compiled reaction and, for each of its lines, the node it belongs to."""

    code: CodeType
    source: str
    nodes: Mapping[int, str]


def plan(graph: Graph, key: int) -> Plan:
    """The reaction for the pattern `key` (bit k: source k has an event); kept with the graph."""
    if key not in graph.plans:
        writer = Writer(graph, key)
        text, nodes = writer.write()
        graph.plans[key] = compiled(graph, text, nodes, named(graph, key))
    found: Plan = graph.plans[key]
    return found


def named(graph: Graph, key: int) -> str:
    """A pattern by the names of its sources."""
    return "+".join(n for k, n in enumerate(graph.sources) if key >> k & 1) or "nothing"


def compiled(graph: Graph, text: str, nodes: Mapping[int, str], to: str) -> Plan:
    """A text as code, which tracebacks and debuggers can show."""
    code = _code(text, f"reaction of {graph.name} to {to}")
    file = code.co_filename
    if file not in linecache.cache:
        linecache.cache[file] = (len(text), None, text.splitlines(True), file)
    return Plan(code, text, nodes)


@lru_cache(maxsize=256)
def _code(text: str, title: str) -> CodeType:
    """Compiled once for all graphs that are built alike: compiling takes longer than writing."""
    return compile(text, f"<{title}, {blake2b(text.encode(), digest_size=6).hexdigest()}>", "exec")


def explain(error: BaseException, plans: Iterable[Plan], name: str, time: int) -> None:
    """Add to an error from a block's step the path in the graph of this name, and the time."""
    nodes = {plan.code.co_filename: plan.nodes for plan in plans}
    trace = error.__traceback__
    while trace is not None:
        code = trace.tb_frame.f_code
        if code.co_name == "react" and code.co_filename in nodes:
            node = nodes[code.co_filename].get(trace.tb_lineno)  # None between two ticks
            error.add_note(f"in {name if node is None else f'{name}, at {node}'}, t = {time} ns")
        trace = trace.tb_next


def presence(result: Any) -> tuple[bool, Any]:
    """Whether a step's output is there, and its value."""
    if result is None:
        return False, None
    return result if isinstance(result, When) else (True, result)


class Writer:
    """Writes the reaction to one pattern."""

    def __init__(self, graph: Graph, key: int) -> None:
        self.graph = graph
        self.present = {node.clock: bool(key >> k & 1) for k, node in enumerate(graph.sources.values())}
        self.conditions = {clock: f"p{w.node}_{w.output}" for clock, w in graph.conditions().items()}
        self.lines: list[str] = ["def react(t):"]
        self.owner: dict[int, str] = {}
        self.indent = 1

    def write(self) -> tuple[str, dict[int, str]]:
        self.reaction()
        return "\n".join(self.lines) + "\n", self.owner

    def reaction(self) -> None:
        """The lines of one tick: what is present, the calls in their order, what is kept of it, then all
        that is written: in lines without a call, between which Python hears no signal such as Ctrl-C."""
        before = len(self.lines)
        for k, (index, node) in enumerate(
            (i, n) for i, n in enumerate(self.graph.nodes) if isinstance(n, SourceNode)
        ):
            if self.present[node.clock]:
                self.read(index, k, node)
        for index, call in self.graph.calls:
            self.call(index, call)
        for k, collected in enumerate(self.graph.collected):
            self.guarded(self.fresh(collected.wire), self.kept(k, collected.wire), collected.name)
        for index, call in self.graph.calls:
            firing = self.when(call.firing)
            if call.state is not None:
                self.guarded(firing, self.remembered(index, call.state), call.path)
            if call.stamp is not None:
                self.guarded(firing, f"{self.stamp(call.stamp)} = t", call.path)
        for index, register in self.graph.registers:
            if register.feed is not None:
                self.guarded(self.fresh(register.feed), self.fed(index, register.feed), register.path)
        if len(self.lines) == before:
            self.emit("pass", "")

    def read(self, index: int, k: int, node: SourceNode) -> None:
        """The line that takes the next value of source k."""
        self.emit(f"x{index} = n{k}()", node.path)

    def held(self, register: int) -> str:
        """What a register holds, as a block is handed it."""
        return f"r[{register}]"

    def stamp(self, register: int) -> str:
        """The place of the time at which a call last fired."""
        return f"r[{register}]"

    def remembered(self, index: int, register: int) -> str:
        """The line that writes the new state of a call."""
        return f"r[{register}] = s{index}"

    def fed(self, register: int, wire: Wire) -> str:
        """The line that writes a stream into its register."""
        return f"r[{register}] = {self.value(wire)}"

    def kept(self, k: int, wire: Wire) -> str:
        """The statement that keeps the value of collected stream k and its time."""
        return f"c{k}({self.value(wire)}); u{k}(t)"

    def emit(self, line: str, owner: str) -> None:
        self.lines.append("    " * self.indent + line)
        self.owner[len(self.lines)] = owner

    def guarded(self, condition: Presence, line: str, owner: str) -> None:
        if condition is True:
            self.emit(line, owner)
        elif condition is not False:
            self.emit(f"if {condition}:", owner)
            self.indent += 1
            self.emit(line, owner)
            self.indent -= 1

    def when(self, clock: Clock) -> Presence:
        if isinstance(clock, Source):
            return self.present[clock]
        if isinstance(clock, Not):
            inner = self.when(clock.term)
            return not inner if isinstance(inner, bool) else f"not {inner}"
        if isinstance(clock, AnyOf | AllOf):
            ends = isinstance(clock, AnyOf)
            terms = [self.when(t) for t in clock.terms]
            if ends in terms:
                return ends
            open_ = [t for t in terms if isinstance(t, str)]
            return f"({(' or ' if ends else ' and ').join(open_)})" if open_ else not ends
        assert isinstance(clock, Counted | Condition)
        return self.when(clock.parent) and self.conditions[clock]

    def fresh(self, wire: Wire) -> Presence:
        return self.when(self.graph.port(wire).clock)

    def value(self, wire: Wire) -> str:
        source = isinstance(self.graph.nodes[wire.node], SourceNode)
        return f"x{wire.node}" if source else f"v{wire.node}_{wire.output}"

    def argument(self, argument: Argument) -> str:
        if argument.wire is not None:
            return (
                self.choose(self.fresh(argument.wire), self.value(argument.wire), "None")
                if argument.optional
                else self.value(argument.wire)
            )
        if argument.register is None:
            return "None"
        register = self.graph.nodes[argument.register]
        assert isinstance(register, RegisterNode)
        held = self.held(argument.register)
        if register.role == "latest" and register.feed is not None:
            return self.choose(self.fresh(register.feed), self.value(register.feed), held)
        return held

    @staticmethod
    def choose(condition: Presence, yes: str, no: str) -> str:
        return f"({yes} if {condition} else {no})" if isinstance(condition, str) else yes if condition else no

    def call(self, index: int, call: CallNode) -> None:
        firing = self.when(call.firing)
        if firing is not False:
            self.fire(index, call, firing)

    def fire(self, index: int, call: CallNode, firing: Presence) -> None:
        """The lines of a call that fires, or fires on a condition."""
        outputs = [f"v{index}_{k}" for k in range(len(call.outputs))]
        if firing is not True:
            for k, (name, dynamic) in enumerate(zip(outputs, call.dynamic, strict=True)):
                self.emit(f"{name} = None" + (f"; p{index}_{k} = False" if dynamic else ""), call.path)
            self.emit(f"if {firing}:", call.path)
            self.indent += 1
        inputs = [self.held(call.state)] if call.state is not None else []
        inputs += [self.argument(a) for a in call.arguments]
        inputs += [f"{k}=k{index}_{k}" for k in call.settings]
        for handed in sorted(call.block.handed):
            inputs.append(
                f"{handed}="
                + {
                    "t": "int64(t)",
                    "xp": "xp",
                    "path": repr(call.path),
                    "dt": "" if call.stamp is None else self.dt(call.stamp),
                    "draw": f"d{index}(t)",
                }[handed]
            )
        target = ", ".join(outputs) or "_"
        if call.state is not None:
            target = f"s{index}, {target if len(outputs) == 1 else f'({target})'}"
        self.emit(f"{target} = f{index}({', '.join(inputs)})", call.path)
        if call.block.fault is not None:
            leaf = call.block.fault[0]
            self.emit(f"if s{index}[{leaf!r}] != NEVER: overflow({index}, t)", call.path)
        for k, dynamic in enumerate(call.dynamic):
            if dynamic:
                self.emit(self.unpack(index, call, k), call.path)
        if firing is not True:
            self.indent -= 1

    def variant(self, call: CallNode) -> Any:
        """How its step was recorded, where the pattern says which of its optional inputs are there."""
        wires = [a.wire for a in call.arguments if a.optional and a.wire is not None]
        choice = tuple(self.fresh(w) for w in wires)
        return call.variants.get(choice) if all(isinstance(c, bool) for c in choice) else None  # type: ignore[arg-type]

    def unpack(self, index: int, call: CallNode, k: int) -> str:
        step = self.variant(call)
        name, flag = f"v{index}_{k}", f"p{index}_{k}"
        if not isinstance(step, StepTrace):
            return f"{flag}, {name} = presence({name})"
        known = step.outputs[k].presence
        return f"{flag} = {known == 'always'}" if isinstance(known, str) else f"{flag}, {name} = {name}"

    def dt(self, stamp: int) -> str:
        last = self.stamp(stamp)
        return f"real((t - {last}) * 1e-9) if {last} != NEVER else real(0.0)"


def _locked(value: Any) -> None:
    """Make the arrays of a value read-only: whoever else reads the stream must see what was sent."""
    if isinstance(value, np.ndarray):
        value.flags.writeable = False
    elif isinstance(value, Signal):
        for part in vars(value).values():
            _locked(part)
    elif isinstance(value, tuple | dict):
        for part in value.values() if isinstance(value, dict) else value:
            _locked(part)


def _careful(graph: Graph, call: CallNode) -> Callable[..., Any]:
    """The step of a block that could not be recorded: its inputs are locked, and its results checked."""

    def output(value: Any, k: int) -> Any:
        port = call.outputs[k]
        there, inner = presence(value)
        if not there and not call.dynamic[k]:
            raise TypeMismatchError(
                f"output {port.name!r} is absent",
                path=call.path,
                expected=str(port.type),
                got="None",
                fix="return a value, or annotate the output `| None`",
            )
        checked = as_value(inner, port.type, path=f"{call.path}.{port.name}") if there else inner
        return When(there, checked) if call.dynamic[k] else checked

    def step(*args: Any, **settings: Any) -> Any:
        for value in args:
            _locked(value)
        result = call.block.step(*args, **settings)
        state = None
        if call.state is not None:
            state, result = result
            register = graph.nodes[call.state]
            assert isinstance(register, RegisterNode)
            state = as_value(state, register.type, path=f"{call.path} state")
        outputs = [result] if len(call.outputs) == 1 else result or ()
        made = tuple(output(value, k) for k, value in enumerate(outputs))
        found = made[0] if len(call.outputs) == 1 else made
        return found if call.state is None else (state, found)

    return step


def bindings(graph: Graph) -> dict[str, Any]:
    """The names that every reaction of a graph uses and no run changes: steps, settings, namespace."""
    names: dict[str, Any] = {
        "xp": NUMPY,
        "NEVER": NEVER,
        "presence": presence,
        "real": np.float64,
        "int64": np.int64,
    }
    for index, call in graph.calls:
        recorded = all(isinstance(v, StepTrace) for v in call.variants.values())
        names[f"f{index}"] = call.block.step if recorded else _careful(graph, call)
        for key, value in call.settings.items():
            names[f"k{index}_{key}"] = value
    return names


def bound(plan_: Plan, names: dict[str, Any]) -> Callable[..., None]:
    """The reaction as a function, over one run's names."""
    scope = dict(names)
    exec(plan_.code, scope)  # text written above from the graph, never from a file
    reaction: Callable[..., None] = scope.pop("react")  # else it would hold itself
    return reaction


class Reactions(dict[int, Callable[[int], None]]):
    """Reactions by pattern, compiled when a pattern first occurs."""

    def __init__(self, graph: Graph, names: dict[str, Any]) -> None:
        super().__init__()
        self._graph, self._names = graph, names

    def __missing__(self, key: int) -> Callable[[int], None]:
        self[key] = bound(plan(self._graph, key), self._names)
        return self[key]
