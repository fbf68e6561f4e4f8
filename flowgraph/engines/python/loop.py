"""The loop over the ticks of a recording, with the reaction to each pattern written out in it.

A recording says beforehand which patterns of present sources occur. So one function goes through its ticks,
and what a run keeps between them (registers, stamps) lies in local variables until it ends or breaks. The
reactions are those of `plan`, but for blocks that `steps` can write out: they pass the leaves of a value in
variables, and one is put together only for a block that is called, and for what is collected.

A loop is written where every block could be recorded, so that none sees or keeps more than its ports: one
that might look at the run in the middle of a tick is called tick by tick. So is everything while a debugger
traces, since a person steps through the lines of blocks.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from typing import Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.engines.python.lifetimes import let_go
from flowgraph.engines.python.plan import Plan, Presence, Writer, compiled, named
from flowgraph.engines.python.steps import KINDS, Line, Written, silent, single, written
from flowgraph.engines.python.strips import Rooms, Strips, Whole
from flowgraph.language.graph import Argument, CallNode, Graph, RegisterNode, SourceNode, Wire
from flowgraph.language.recording import StepTrace
from flowgraph.recorder.random import Site
from flowgraph.types import ArrayType, Signal, StructType, Type, leaves_of, unflatten

MOST_PATTERNS = 8
"""With more patterns than these the text would be longer than what it saves."""

_PART = 4096


@dataclass(frozen=True)
class Loop:
    """A compiled loop, the names that it needs, and where it goes by leaves: which sources it reads, and
    which of the collected streams it keeps. The values of `steady` sources, which every tick has, come with
    the ticks. Of the collected streams that are there at some patterns whatever happens, `stamped` has these:
    nobody need note their times. What it draws has for each name its site, and the patterns at which it is
    drawn; None where a condition says so."""

    plan: Plan
    names: dict[str, Any]
    open: frozenset[int]
    steady: tuple[int, ...]
    kept: frozenset[int]
    stamped: Mapping[int, frozenset[int]]
    sites: Mapping[str, tuple[Site, frozenset[int] | None]]


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


def feed(series: Series, k: int, to: Loop | None) -> Iterator[Any]:
    """The values of source k one after the other, as a loop reads them."""
    if to is None or k not in to.open:
        return iter(series)
    columns = [
        numbers(array) if single(leaf) else iter(array)
        for array, (_, leaf) in zip(series.leaves.values(), leaves_of(series.type), strict=True)
    ]
    return columns[0] if isinstance(series.type, ArrayType) else zip(*columns, strict=True)


def _may(graph: Graph) -> bool:
    return all(
        not call.block.host and all(isinstance(v, StepTrace) for v in call.variants.values())
        for _, call in graph.calls
    )


def _written(graph: Graph, patterns: tuple[int, ...]) -> Loop:
    which = _Which(graph, patterns)
    lines, owner = ["def react(ticks):", "    done = None"], dict[int, str]()
    stores = {"through[0]": "done"}
    for index, register in graph.registers:
        if index in which.registers:
            local = ", ".join(which.locals(index))
            lines.append(f"    {local}, = {', '.join(leaves(register.type, f'r[{index}]'))},")
            stores[f"r[{index}]"] = put_together(register.type, which.locals(index), str(index))
        else:
            lines.append(f"    r{index} = r[{index}]")
            stores[f"r[{index}]"] = f"r{index}"
    given = ["t", "key", *(which.given(k) for k in which.steady)]
    lines += ["    rooms = Rooms()", "    try:", f"        for {', '.join(given)} in ticks:"]
    for n, key in enumerate(patterns):
        lines.append(f"            {'if' if n == 0 else 'elif'} key == {key}:")
        writer = _LoopWriter(graph, key, which, len(lines))
        writer.reaction()
        strips = Strips(writer.lines, writer.whole)
        owner |= {
            len(lines) + n: writer.owner[writer.first + k + 1] for n, (_, k) in enumerate(strips.made, 1)
        }
        which.names |= strips.names
        lines += let_go([line for line, _ in strips.made], writer.arrays | strips.arrays)
    lines.append("            done = t")
    lines += ["    finally:", f"        {', '.join(stores)}, = {', '.join(stores.values())},"]
    to = " or ".join(named(graph, key) for key in patterns)
    code = compiled(graph, "\n".join(lines) + "\n", owner, to)
    kept = frozenset(k for k, c in enumerate(graph.collected) if which.here(c.wire))
    open_ = frozenset(which.sources.values())
    return Loop(code, which.names, open_, which.steady, kept, which.stamped, which.drawn(patterns))


def leaves(type_: Type, text: str) -> list[str]:
    """The leaves of a value as expressions, single numbers as Python's."""
    if isinstance(type_, ArrayType):
        return [f"{KINDS[type_.dtype][0]}({text})" if single(type_) else text]
    found = []
    for k, (name, part) in enumerate(type_.fields):
        of = f"[{k}]" if type_.cls is tuple else f"[{name!r}]" if type_.cls is dict else f".{name}"
        found += leaves(part, text + of)
    return found


def put_together(type_: Type, parts: list[str], node: str) -> str:
    """A value of its leaves as an expression, single numbers as NumPy's; `node` names what makes it."""
    boxed = [
        f"{KINDS[leaf.dtype][1]}({part})" if single(leaf) else part
        for part, (_, leaf) in zip(parts, leaves_of(type_), strict=True)
    ]
    return boxed[0] if isinstance(type_, ArrayType) else f"make{node}({', '.join(boxed)})"


def _maker(type_: StructType) -> Callable[..., Any]:
    if issubclass(type_.cls, Signal) and all(isinstance(t, ArrayType) for _, t in type_.fields):
        return type_.cls
    return lambda *parts: unflatten(type_, iter(parts))


class _Which:
    """Which calls of a graph are written out, and which sources and registers lie in variables by leaf."""

    def __init__(self, graph: Graph, patterns: tuple[int, ...]) -> None:
        self.graph = graph
        self.names: dict[str, Any] = {
            "Rooms": Rooms, "int32": np.int32, "bool_": np.bool_, "concatenate": np.concatenate,
            "asarray": np.asarray,
        }  # fmt: skip
        self._texts: dict[tuple[int, int], Written] = {}
        writers = [Writer(graph, key) for key in patterns]
        self._writers = writers
        self.calls = {i: call for i, call in graph.calls if self._may(i, call, writers)}
        ports = [i for i, n in enumerate(graph.nodes) if isinstance(n, SourceNode)]
        read = {w.node for call in self.calls.values() for w in self._wires(call)}
        self.sources = {i: k for k, i in enumerate(ports) if i in read}
        self._ports = ports
        self.steady = tuple(k for k in range(len(ports)) if all(key >> k & 1 for key in patterns))
        """The sources that are there at all patterns, in order."""
        states = {call.state for call in self.calls.values()}
        self.registers = {
            i: node
            for i, node in graph.registers
            if i in states or (node.feed is not None and self.here(node.feed))
        }
        for (index, _), text in self._texts.items():
            if index in self.calls:
                self.names |= text.names
        for index, node in enumerate(graph.nodes):
            types = [p.type for p in node.outputs] if isinstance(node, CallNode) else [node.type]
            for k, type_ in enumerate(types):
                if isinstance(type_, StructType):
                    self.names[f"make{index}_{k}" if isinstance(node, CallNode) else f"make{index}"] = _maker(
                        type_
                    )

        self.stamped: dict[int, frozenset[int]] = {}
        """The patterns at which collected stream k is there, where nothing else decides that."""
        for k, collected in enumerate(graph.collected):
            there = [w.fresh(collected.wire) for w in writers]
            if not any(isinstance(f, str) for f in there):
                self.stamped[k] = frozenset(key for key, f in zip(patterns, there, strict=True) if f)

    def source(self, index: int) -> list[str]:
        """The variables that hold the leaves of a source, or the one that holds its value."""
        node = self.graph.nodes[index]
        assert isinstance(node, SourceNode)
        count = len(leaves_of(node.type))
        return [f"x{index}_{n}" for n in range(count)] if index in self.sources else [f"x{index}"]

    def given(self, k: int) -> str:
        """Source k as the target of an assignment."""
        node, names = self.graph.nodes[self._ports[k]], self.source(self._ports[k])
        whole = isinstance(node, SourceNode) and isinstance(node.type, ArrayType)
        return names[0] if whole or self._ports[k] not in self.sources else f"({', '.join(names)},)"

    def drawn(self, patterns: tuple[int, ...]) -> dict[str, tuple[Site, frozenset[int] | None]]:
        """The sites of the calls that are written out, and at which patterns they are drawn."""
        found: dict[str, tuple[Site, frozenset[int] | None]] = {}
        for (index, _), text in self._texts.items():
            if index in self.calls:
                fires = [w.when(self.calls[index].firing) for w in self._writers]
                sure = frozenset(k for k, there in zip(patterns, fires, strict=True) if there is True)
                for name, site in text.sites.items():
                    found[name] = site, None if any(isinstance(f, str) for f in fires) else sure
        return found

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
        """Whether the leaves of a stream lie in variables."""
        return wire.node in self.calls or wire.node in self.sources

    def text(self, index: int, call: CallNode, writer: Writer) -> Written | None:
        """The call's step as text, as it fires in a pattern."""
        step = writer.variant(call)
        known = index, id(step)
        if known not in self._texts:
            state = None if call.state is None else self.graph.nodes[call.state].type  # type: ignore[union-attr]
            made = written(step, [self.type(a) for a in call.arguments], state)
            if made is None:
                return None
            self._texts[known] = made
        return self._texts[known]

    def _may(self, index: int, call: CallNode, writers: list[Writer]) -> bool:
        if call.block.fault is not None or not silent(call.block):
            return False
        if not all(map(silent, call.settings.values())):
            return False
        fires = [w for w in writers if w.when(call.firing) is not False]
        return all(self.text(index, call, w) is not None for w in fires)

    def _wires(self, call: CallNode) -> list[Wire]:
        found = [a.wire for a in call.arguments if a.wire is not None]
        for a in call.arguments:
            register = None if a.register is None else self.graph.nodes[a.register]
            if isinstance(register, RegisterNode) and register.feed is not None:
                found.append(register.feed)
        return found


class _LoopWriter(Writer):
    """Writes the reaction to one pattern, from a line of the loop on."""

    def __init__(self, graph: Graph, key: int, which: _Which, first: int) -> None:
        super().__init__(graph, key)
        self.which, self.first = which, first
        self.lines, self.indent = [], 4
        self.leaves: dict[tuple[int, int], list[str]] = {}
        self.next: dict[int, list[str]] = {}
        self.arrays: set[str] = set()
        self.whole: dict[int, Whole] = {}
        """The lines that are one instruction, by where they stand."""
        self._shapes: dict[int, tuple[int, ...]] = {}
        self.known: dict[str, str] = {}
        """By what is computed, the variable that has it already."""

    def emit(self, line: str, owner: str) -> None:
        self.lines.append("    " * self.indent + line)
        self.owner[self.first + len(self.lines)] = owner

    def read(self, index: int, k: int, node: SourceNode) -> None:
        if k not in self.which.steady:
            self.emit(f"{self.which.given(k)} = n{k}()", node.path)
        if index in self.which.sources:
            self.leaves[index, 0] = self.which.source(index)

    def stamp(self, register: int) -> str:
        return f"r{register}"

    def held(self, register: int) -> str:
        node = self.which.registers.get(register)
        if node is None:
            return f"r{register}"
        return put_together(node.type, self.which.locals(register), str(register))

    def value(self, wire: Wire) -> str:
        if not self.which.here(wire):
            return super().value(wire)
        call = isinstance(self.graph.nodes[wire.node], CallNode)
        maker = f"{wire.node}_{wire.output}" if call else str(wire.node)
        return put_together(self.graph.port(wire).type, self._leaves(wire), maker)

    def kept(self, k: int, wire: Wire) -> str:
        here = self.which.here(wire)
        keep = [f"c{k}_{n}({leaf})" for n, leaf in enumerate(self._leaves(wire))] if here else []
        keep = keep or [f"c{k}({self.value(wire)})"]
        return "; ".join(keep if k in self.which.stamped else [*keep, f"u{k}(t)"])

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

    def fire(self, index: int, call: CallNode, firing: Presence) -> None:
        if index not in self.which.calls:
            super().fire(index, call, firing)
            return
        step, text = self.variant(call), self.which.text(index, call, self)
        assert text is not None
        local, numbers, outside = dict(text.constants), set(text.numbers), self.known
        self.known = dict(outside)
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
        self._shapes = text.shapes
        self.arrays |= {f"w{index}_{n}" for n, shape in text.shapes.items() if shape}
        for line in text.lines:
            self._line(line, index, local, call.path)

        def own(numbers_: Iterable[int], type_: Type) -> list[str]:
            return [
                self._own(index, n, leaf, local, numbers, call)
                for n, (_, leaf) in zip(numbers_, leaves_of(type_), strict=True)
            ]

        for k, (output, dynamic) in enumerate(zip(step.outputs, call.dynamic, strict=True)):
            if dynamic:
                there = output.presence
                known = str(there == "always") if isinstance(there, str) else local[there]
                self.emit(f"p{index}_{k} = {known}", call.path)
            if output.leaves:
                self.leaves[index, k] = own(output.leaves, call.outputs[k].type)
        if call.state is not None:
            self.next[index] = own(step.next_state, self.graph.nodes[call.state].type)  # type: ignore[union-attr]
        if firing is not True:
            if len(self.lines) == before:
                self.emit("pass", call.path)
            self.indent -= 1
            self.known = outside

    def _line(self, line: Line, index: int, local: dict[int, str], owner: str) -> None:
        """A line of a step, unless a block before it has computed the same."""
        i, name = line.instruction, f"w{index}_{line.instruction.out}"
        if line.arms is None or not any(line.arms):
            text = line.form.format(*(local[a] for a in i.args))
            if text in self.known:
                local[i.out] = self.known[text]
                return
            self.emit(f"{name} = {text}", owner)
            self.whole[len(self.lines) - 1] = Whole(
                i, tuple(local[a] for a in i.args), tuple(self._shapes.get(a, ()) for a in i.args)
            )
            self.known[text] = local[i.out] = name
            return
        for word, lines, taken in zip((f"if {local[i.args[0]]}", "else"), line.arms, i.args[1:], strict=True):
            self.emit(f"{word}:", owner)
            outside, self.known = self.known, dict(self.known)
            self.indent += 1
            for inner in lines:
                self._line(inner, index, local, owner)
            self.emit(f"{name} = {local[taken]}", owner)
            self.indent -= 1
            self.known = outside
        local[i.out] = name

    def _own(
        self,
        index: int,
        number: int,
        leaf: ArrayType,
        local: dict[int, str],
        numbers: set[int],
        call: CallNode,
    ) -> str:
        """A value in a variable that nobody writes until the next tick, as a register may be before it is
        read; a single number as Python's."""
        text = local[number]
        if single(leaf) and number not in numbers:
            self.known = {text_: n for text_, n in self.known.items() if n != text}  # it becomes another kind
            text = f"{KINDS[leaf.dtype][0]}({text})"
            numbers.add(number)
        if text[0] not in "wx":
            self.emit(f"w{index}_{number} = {text}", call.path)
            local[number] = f"w{index}_{number}"
        return local[number]

    def _read(self, argument: Argument) -> list[str]:
        """The leaves of what comes to a port."""
        type_ = self.which.type(argument)
        assert type_ is not None
        if argument.wire is not None:
            here = self.which.here(argument.wire)
            return self._leaves(argument.wire) if here else leaves(type_, super().value(argument.wire))
        assert argument.register is not None
        node = self.graph.nodes[argument.register]
        assert isinstance(node, RegisterNode)
        if argument.register not in self.which.registers:
            return leaves(type_, self.argument(argument))
        held = self.which.locals(argument.register)
        if node.role != "latest" or node.feed is None:
            return held
        there, new = self.fresh(node.feed), self._leaves(node.feed)
        return [self.choose(there, a, b) for a, b in zip(new, held, strict=True)]
