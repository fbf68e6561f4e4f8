"""The loop over the ticks of a recording, with the reaction to each pattern written out in it.

A recording says beforehand which patterns of present sources occur. So one function goes through its ticks,
and what a run keeps between them (registers, stamps) lies in local variables until it ends or breaks. The
reactions are those of `plan`, but for blocks of single numbers, which are written out as `scalars` says:
they pass plain Python numbers from one to the next, and a NumPy scalar is made only for a block that is
called.

A loop is written where every block could be recorded, so that none sees or keeps more than its ports: one
that might look at the run in the middle of a tick is called tick by tick. So is everything while a debugger
traces, since a person steps through the lines of blocks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import chain
from typing import Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.engines.python.plan import Plan, Presence, Writer, compiled, named
from flowgraph.engines.python.scalars import KINDS, plain, silent, written
from flowgraph.language.graph import Argument, CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.language.recording import StepTrace
from flowgraph.types import ArrayType, Type, flatten, leaves_of, unflatten

MOST_PATTERNS = 8
"""With more patterns than these the text would be longer than what it saves."""

_PART = 4096


@dataclass(frozen=True)
class Loop:
    """A compiled loop, the names that it needs, and the sources whose values it reads as Python's numbers."""

    plan: Plan
    names: dict[str, Any]
    plain: frozenset[int]


def loop(graph: Graph, patterns: tuple[int, ...]) -> Loop | None:
    """The loop for a recording with these patterns, kept with the graph; None where there is to be none."""
    if not 0 < len(patterns) <= MOST_PATTERNS or sys.gettrace() is not None:
        return None
    known = ("loop", patterns)
    if known not in graph.plans:
        graph.plans[known] = _written(graph, patterns) if _may(graph) else None
    found: Loop | None = graph.plans[known]
    return found


def numbers(array: np.ndarray) -> Iterator[Any]:
    """The entries of an array as Python's numbers, made some at a time."""
    return chain.from_iterable(array[k : k + _PART].tolist() for k in range(0, len(array), _PART))


def feed(series: Series, k: int, to: Loop | None) -> Callable[[], Any]:
    """The values of source k one after the other, as a loop reads them."""
    single = to is not None and k in to.plain
    return numbers(series.leaves["value"]).__next__ if single else iter(series).__next__


def _may(graph: Graph) -> bool:
    return all(
        not call.block.host and all(isinstance(v, StepTrace) for v in call.variants.values())
        for _, call in graph.calls
    )


def _written(graph: Graph, patterns: tuple[int, ...]) -> Loop:
    which = _Scalars(graph, patterns)
    lines, owner = ["def react(ticks):", "    t = None"], {}
    used = sorted({i for i, _ in graph.registers})
    loads, stores = [], []
    for index in used:
        register = graph.nodes[index]
        assert isinstance(register, RegisterNode)
        if index in which.registers:
            local = which.locals(index)
            loads.append(f"    {', '.join(local)}, = open{index}(r[{index}])")
            stores.append(f"        r[{index}] = close{index}({', '.join(local)})")
        else:
            loads.append(f"    r{index} = r[{index}]")
            stores.append(f"        r[{index}] = r{index}")
    lines += [*loads, "    try:", "        for t, key in ticks:"]
    for n, key in enumerate(patterns):
        lines.append(f"            {'if' if n == 0 else 'elif'} key == {key}:")
        writer = _LoopWriter(graph, key, which, len(lines))
        writer.reaction()
        lines += writer.lines
        owner |= writer.owner
    lines += ["    except BaseException:", "        broken(t)", "        raise"]
    lines += ["    finally:", *(stores or ["        pass"])]
    names: dict[str, Any] = {"int32": np.int32, "bool_": np.bool_}
    for index in which.registers:
        names[f"open{index}"] = partial(_open, graph.nodes[index].type)  # type: ignore[union-attr]
        names[f"close{index}"] = partial(_close, graph.nodes[index].type)  # type: ignore[union-attr]
    for index, node in enumerate(graph.nodes):
        for k, port in enumerate(node.outputs if isinstance(node, CallNode) else ()):
            if index in which.calls:
                names[f"close{index}_{k}"] = partial(_close, port.type)
    to = " or ".join(named(graph, key) for key in patterns)
    text = "\n".join(lines) + "\n"
    return Loop(compiled(graph, text, owner, to), names, frozenset(which.sources.values()))


def _open(type_: Type, value: Any) -> list[Any]:
    """The leaves of a register as Python's numbers."""
    return [np.asarray(leaf).item() for leaf in flatten(value, type_)]


def _close(type_: Type, *leaves: Any) -> Any:
    """A value of NumPy's numbers from Python's."""
    kinds = [getattr(np, "float64" if t.dtype == "real" else KINDS[t.dtype][1]) for _, t in leaves_of(type_)]
    return unflatten(type_, iter([kind(leaf) for kind, leaf in zip(kinds, leaves, strict=True)]))


class _Scalars:
    """Which calls, sources and registers of a graph are written out as single numbers."""

    def __init__(self, graph: Graph, patterns: tuple[int, ...]) -> None:
        self.graph = graph
        writers = [Writer(graph, key) for key in patterns]
        self.calls = {i: call for i, call in graph.calls if self._may(call, writers)}
        ports = {
            n: k for k, n in enumerate(i for i, n in enumerate(graph.nodes) if isinstance(n, SourceNode))
        }
        while True:
            read = {w.node for call in self.calls.values() for w in self._wires(call)}
            self.sources = {
                i: k
                for i, k in ports.items()
                if i in read and isinstance(t := graph.nodes[i].type, ArrayType) and plain(t)  # type: ignore[union-attr]
            }
            self.registers = self._registers()
            wrong = [i for i, call in self.calls.items() if not all(map(self._single, call.arguments))]
            if not wrong:
                break
            for i in wrong:
                del self.calls[i]

    def locals(self, register: int) -> list[str]:
        """The variables that hold the leaves of a register."""
        node = self.graph.nodes[register]
        assert isinstance(node, RegisterNode)
        return [f"r{register}_{n}" for n in range(len(leaves_of(node.type)))]

    def type(self, argument: Argument) -> Type | None:
        """What comes to a port."""
        if argument.wire is not None:
            return self.graph.port(argument.wire).type
        register = None if argument.register is None else self.graph.nodes[argument.register]
        return register.type if isinstance(register, RegisterNode) else None

    def here(self, wire: Wire) -> bool:
        """Whether a stream passes as Python's numbers."""
        return wire.node in self.calls or wire.node in self.sources

    def _may(self, call: CallNode, writers: list[Writer]) -> bool:
        ends = [port.type for port in call.outputs] + [t for a in call.arguments if (t := self.type(a))]
        if call.block.fault is not None or not all(map(plain, ends)):
            return False
        if not silent(call.block) or not all(map(silent, call.settings.values())):
            return False
        fires = [w for w in writers if w.when(call.firing) is not False]
        return all(self.written(call, w) is not None for w in fires)

    def written(self, call: CallNode, writer: Writer) -> Any:
        """The call's step as text, as it fires in a pattern."""
        state = None if call.state is None else self.graph.nodes[call.state].type  # type: ignore[union-attr]
        return written(writer.variant(call), [self.type(a) for a in call.arguments], state)

    def _wires(self, call: CallNode) -> list[Wire]:
        found = [a.wire for a in call.arguments if a.wire is not None]
        for a in call.arguments:
            register = None if a.register is None else self.graph.nodes[a.register]
            if isinstance(register, RegisterNode) and register.feed is not None:
                found.append(register.feed)
        return found

    def _registers(self) -> dict[int, RegisterNode]:
        states = {call.state for call in self.calls.values()}
        return {
            i: node
            for i, node in self.graph.registers
            if i in states or (node.feed is not None and plain(node.type) and self.here(node.feed))
        }

    def _single(self, argument: Argument) -> bool:
        """Whether what comes is there as numbers, or is one that is made so by a word."""
        if argument.wire is not None and self.here(argument.wire):
            return True
        if argument.register is not None and argument.register in self.registers:
            return True
        return self.type(argument) is None or isinstance(self.type(argument), ArrayType)


class _LoopWriter(Writer):
    """Writes the reaction to one pattern, from a line of the loop on."""

    def __init__(self, graph: Graph, key: int, which: _Scalars, first: int) -> None:
        super().__init__(graph, key)
        self.which, self.first = which, first
        self.lines, self.indent = [], 4
        self.leaves: dict[tuple[int, int], list[str]] = {(i, 0): [f"x{i}"] for i in which.sources}
        self.next: dict[int, list[str]] = {}

    def emit(self, line: str, owner: str) -> None:
        self.lines.append("    " * self.indent + line)
        self.owner[self.first + len(self.lines)] = owner

    def stamp(self, register: int) -> str:
        return f"r{register}"

    def held(self, register: int) -> str:
        node = self.which.registers.get(register)
        if node is None:
            return f"r{register}"
        return self._boxed(node.type, self.which.locals(register), f"close{register}")

    def value(self, wire: Wire) -> str:
        if not self.which.here(wire):
            return super().value(wire)
        leaves = self._leaves(wire)
        return self._boxed(self.graph.port(wire).type, leaves, f"close{wire.node}_{wire.output}")

    def kept(self, wire: Wire) -> str:
        if self.which.here(wire) and isinstance(self.graph.port(wire).type, ArrayType):
            return self._leaves(wire)[0]
        return self.value(wire)

    def remembered(self, index: int, register: int) -> str:
        if index not in self.which.calls:
            return f"r{register} = s{index}"
        return f"{', '.join(self.which.locals(register))}, = {', '.join(self.next.get(index, ['None']))},"

    def fed(self, register: int, wire: Wire) -> str:
        if register not in self.which.registers:
            return f"r{register} = {self.value(wire)}"
        return f"{', '.join(self.which.locals(register))}, = {', '.join(self._leaves(wire))},"

    def _leaves(self, wire: Wire) -> list[str]:
        """The variables of a stream; of one that this pattern never has, nobody reads them."""
        absent = ["None"] * len(leaves_of(self.graph.port(wire).type))
        return self.leaves.get((wire.node, wire.output), absent)

    @staticmethod
    def _boxed(type_: Type, leaves: list[str], close: str) -> str:
        if isinstance(type_, ArrayType):
            return f"{KINDS[type_.dtype][1]}({leaves[0]})"
        return f"{close}({', '.join(leaves)})"

    def fire(self, index: int, call: CallNode, firing: Presence) -> None:
        if index not in self.which.calls:
            super().fire(index, call, firing)
            return
        step = self.variant(call)
        constants, lines = self.which.written(call, self)
        local = dict(constants)
        if firing is not True:
            for k, dynamic in enumerate(call.dynamic):
                if dynamic:
                    self.emit(f"p{index}_{k} = False", call.path)
            self.emit(f"if {firing}:", call.path)
            self.indent += 1
        before = len(self.lines)
        local[step.time] = "t"
        if call.stamp is not None:
            last = self.stamp(call.stamp)
            local[step.dt] = f"w{index}_{step.dt}"
            self.emit(f"{local[step.dt]} = (t - {last}) * 1e-9 if {last} != NEVER else 0.0", call.path)
        if call.state is not None:
            local |= dict(zip(step.state, self.which.locals(call.state), strict=True))
        for argument, given in zip(call.arguments, step.arguments, strict=True):
            if given:
                local |= dict(zip(given, self._read(argument), strict=True))
        for i, form in lines:
            self.emit(f"w{index}_{i.out} = {form.format(*(local[a] for a in i.args))}", call.path)
            local[i.out] = f"w{index}_{i.out}"
        made = {i.out for i, _ in lines} | set(constants)
        for k, (output, dynamic) in enumerate(zip(step.outputs, call.dynamic, strict=True)):
            if dynamic:
                there = output.presence
                known = str(there == "always") if isinstance(there, str) else local[there]
                self.emit(f"p{index}_{k} = {known}", call.path)
            if output.leaves:
                self.leaves[index, k] = [self._own(index, n, local, made, call) for n in output.leaves]
        self.next[index] = [self._own(index, n, local, made, call) for n in step.next_state]
        if firing is not True:
            if len(self.lines) == before:
                self.emit("pass", call.path)
            self.indent -= 1

    def _own(self, index: int, number: int, local: dict[int, str], made: set[int], call: CallNode) -> str:
        """A value in a variable of its own: a register may be written before it is read."""
        if number in made or local[number].startswith(("w", "x")):
            return local[number]
        self.emit(f"w{index}_{number} = {local[number]}", call.path)
        made.add(number)
        local[number] = f"w{index}_{number}"
        return local[number]

    def _read(self, argument: Argument) -> Iterable[str]:
        """The leaves of what comes to a port."""
        if argument.wire is not None:
            if self.which.here(argument.wire):
                return self._leaves(argument.wire)
            return [self._number(argument, super().value(argument.wire))]
        assert argument.register is not None
        node = self.graph.nodes[argument.register]
        assert isinstance(node, RegisterNode)
        if argument.register not in self.which.registers:
            return [self._number(argument, self.argument(argument))]
        held = self.which.locals(argument.register)
        if node.role != "latest" or node.feed is None:
            return held
        there, new = self.fresh(node.feed), self._leaves(node.feed)
        return [self.choose(there, a, b) for a, b in zip(new, held, strict=True)]

    def _number(self, argument: Argument, text: str) -> str:
        type_ = self.which.type(argument)
        assert isinstance(type_, ArrayType)
        return f"{KINDS[type_.dtype][0]}({text})"
