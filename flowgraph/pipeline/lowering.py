"""Lowering: a graph becomes one list of instructions in stages.

The recorded steps of the blocks are put one after the other in firing order. What depends on presence is
made explicit: each stage has an enable value, an optional input selects between the two recorded variants
of a step, and a register keeps its old value where its stage does not fire. Specialising the list for a
pattern of present sources (in `program`) folds all of that away again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.language.clock import AllOf, AnyOf, Clock, Condition, Counted, Not, Source, Timing
from flowgraph.language.graph import NEVER, CallNode, Graph, RegisterNode, SourceNode, Wire, join_states
from flowgraph.language.recording import StepTrace
from flowgraph.pipeline.cut import cut
from flowgraph.pipeline.pipeline import Cell, Fault, Leaf, Pipeline, Port, RandomSite, Register
from flowgraph.pipeline.stage_list import StageList, fixed
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.random import Site
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace
from flowgraph.types import DTYPES, Type, axis_names, flatten, leaves_of


def lower(graph: Graph, *, dtype: str = "float64") -> Pipeline:
    """The fixed-size pipeline of a graph; made once and kept with it.

    Host blocks stay outside (`flowgraph.pipeline.cut`): the pipeline's `host` names them, what they give
    before it are inputs of the pipeline, and what they read after it are outputs.

    Args:
        graph: a built graph.
        dtype: what `real` is going to be: "float64", "float32" or "fixed". The pipeline is the same for all;
            a graph that cannot be trusted in this one is refused.

    Raises:
        LoweringError: for a host block between accelerated ones, or a step that does what a pipeline cannot
            hold; names the line. Also for a block whose settings rule out `dtype`, with the reason.
    """
    if "pipeline" not in graph.plans:
        parts = cut(graph)
        made = _Lowering(graph if parts is None else parts.accelerated).pipeline()
        graph.plans["pipeline"] = made if parts is None else replace(made, host=parts.host)
    found: Pipeline = graph.plans["pipeline"]
    found.need_numbers(dtype)
    return found


class _Lowering(StageList):
    def __init__(self, graph: Graph) -> None:
        super().__init__(graph.name)
        self.graph = graph
        self.time = self.value(Spec((), "int64"))
        self.seed = self.value(Spec((2,), "uint32"))
        self.sites: dict[Site, int] = {}
        self.leaves: dict[Wire, list[int]] = {}
        self.sources: dict[Clock, int] = {}
        self.flags: dict[Wire, int] = {}
        self.known_clocks: dict[Clock, int] = {}
        self.conditions = graph.conditions()
        self.reads: dict[int, list[int]] = {}
        self.writes: dict[int, list[int]] = {}
        self.durations: dict[int, int] = {}

    def pipeline(self) -> Pipeline:
        graph = self.graph
        inputs = []
        for index, node in enumerate(graph.nodes):
            if isinstance(node, SourceNode):
                numbers = self.values(node.type)
                self.leaves[Wire(index, 0)] = numbers
                self.sources[node.clock] = self.value(Spec((), "bool"))
                inputs.append(
                    self.port(
                        node.path,
                        node.type,
                        f"{node.clock}: {node.clock.timing}",
                        self.sources[node.clock],
                        numbers,
                        node.clock.timing,
                    )
                )
        for index, register in graph.registers:
            self.reads[index] = self.values(register.type)
        for index, call in graph.calls:
            self.call(index, call)
        for index, register in graph.registers:
            if register.feed is not None and index not in self.writes:
                self.write(index, register)
        outputs = []
        self.place = "outputs"
        for c in graph.collected:
            port = graph.port(c.wire)
            outputs.append(
                self.port(c.name, port.type, str(port.clock), self.when(port.clock), self.leaves[c.wire])
            )
        self.close("outputs", "outputs", self.constant(np.True_), (), ())
        return Pipeline(
            graph.name,
            graph.doc,
            self.time,
            self.seed,
            tuple(inputs),
            tuple(outputs),
            tuple(self.registers()),
            self.constants,
            tuple(self.stages),
            tuple(self.faults()),
            tuple(RandomSite(s.name, s.kind, s.shape, s.hash, n) for s, n in self.sites.items()),
            tuple(
                limit._replace(path=call.path)
                for _, call in graph.calls
                for limit in call.block.limits(call.settings)
            ),
        )

    # -- presence ------------------------------------------------------------------------------------

    def when(self, clock: Clock) -> int:
        """The number of the Boolean that tells whether a clock ticks."""
        if clock not in self.known_clocks:
            self.known_clocks[clock] = self._when(clock)
        return self.known_clocks[clock]

    def _when(self, clock: Clock) -> int:
        if isinstance(clock, Source):
            return self.sources[clock]
        if isinstance(clock, Not):
            return self.emit("logical_not", self.when(clock.term))
        if isinstance(clock, AnyOf | AllOf):
            terms = [self.when(t) for t in clock.terms]
            if not terms:
                return self.constant(np.bool_(isinstance(clock, AllOf)))
            joined = terms[0]
            for term in terms[1:]:
                joined = self.emit("logical_or" if isinstance(clock, AnyOf) else "logical_and", joined, term)
            return joined
        assert isinstance(clock, Counted | Condition)
        flag = self.flags[self.conditions[clock]]
        return self.emit("logical_and", self.when(clock.parent), flag)

    # -- registers -----------------------------------------------------------------------------------

    def current(self, index: int) -> list[int]:
        """What a reader of a register sees: for a latest, the fresh value where there is one."""
        register = self.graph.nodes[index]
        assert isinstance(register, RegisterNode)
        if register.role != "latest":
            return self.reads[index]
        if index not in self.writes:
            self.write(index, register)
        return self.writes[index]

    def write(self, index: int, register: RegisterNode) -> None:
        assert register.feed is not None
        kept, outer, place = self.pending, self.place, register.path
        self.pending, self.place = [], place
        present = self.when(self.graph.port(register.feed).clock)
        fresh = zip(self.leaves[register.feed], self.reads[index], strict=True)
        self.writes[index] = [self.select(present, new, old) for new, old in fresh]
        self.close(
            register.path, register.role, present, [register.path], [register.path], _axis([register.type])
        )
        self.pending, self.place = kept, outer

    def duration(self, stamp: int) -> int:
        """Seconds since a clock last ticked; 0 the first time."""
        if stamp not in self.durations:
            (last,) = self.reads[stamp]
            first = self.emit("equal", last, self.constant(np.int64(NEVER)))
            since = self.emit(
                "subtract", self.time, last
            )  # chosen among integers: what is no duration is no real
            gap = self.emit("where", first, self.constant(np.int64(0)), since)
            seconds = self.emit("astype", gap, dtype="real")
            self.durations[stamp] = self.emit("multiply", seconds, self.constant(np.float64(1e-9)))
        return self.durations[stamp]

    def registers(self) -> list[Register]:
        made = []
        joins = join_states(self.graph)
        for index, node in self.graph.registers:
            written = self.writes.get(index, self.reads[index])
            initial = flatten(node.initial, node.type)
            cells = [
                Cell(
                    name,
                    read,
                    write,
                    fixed(t.shape),
                    t.dtype,
                    np.asarray(reset, DTYPES[t.dtype]),
                    t.unit,
                    t.frame,
                    axis_names(t),
                )
                for (name, t), read, write, reset in zip(
                    leaves_of(node.type), self.reads[index], written, initial, strict=True
                )
            ]
            made.append(Register(node.path, "join" if index in joins else node.role, tuple(cells)))
        return made

    def faults(self) -> list[Fault]:
        found = []
        for _, call in self.graph.calls:
            if call.block.fault is not None and call.state is not None:
                register = self.graph.nodes[call.state]
                cell, message = call.block.fault
                found.append(
                    Fault(call.path, register.path, cell, message, int(call.settings.get("size", 0)))
                )
        return found

    # -- calls ---------------------------------------------------------------------------------------

    def call(self, index: int, call: CallNode) -> None:
        self.place = call.path
        for variant in call.variants.values():
            if isinstance(variant, LoweringError):
                raise variant
        given = [self.argument(a) for a in call.arguments]  # registers that are read get their stage first
        firing, dt = self.clock(call)
        memory = self.reads[call.state] if call.state is not None else []
        options = [
            self.when(self.graph.port(a.wire).clock)
            for a in call.arguments
            if a.optional and a.wire is not None
        ]
        for variant in call.variants.values():
            for site, _ in variant.sites if isinstance(variant, StepTrace) else ():
                self.random(site, firing)
        played = {
            c: self.inline(v, given, memory, dt) for c, v in call.variants.items() if isinstance(v, StepTrace)
        }
        for k in range(len(call.outputs)):
            leaves = {c: outs[k][1] for c, (outs, _) in played.items() if outs[k][1]}
            self.leaves[Wire(index, k)] = self.choose(options, leaves) or self.blanks(call.outputs[k].type)
            if call.dynamic[k]:
                flags = self.choose(options, {c: [outs[k][0]] for c, (outs, _) in played.items()})
                flag = flags[0] if flags else self.constant(np.False_)
                self.flags[Wire(index, k)] = self.emit("logical_and", firing, flag)
        if call.state is not None:
            new = self.choose(options, {c: state for c, (_, state) in played.items()}) or memory
            self.writes[call.state] = [self.select(firing, n, o) for n, o in zip(new, memory, strict=True)]
        registers = [a.register for a in call.arguments if a.register is not None]
        memory_of = [] if call.state is None else [self.graph.nodes[call.state].path]
        reads = [self.graph.nodes[i].path for i in registers] + memory_of
        self.close(call.path, call.block.name, firing, reads, memory_of, self.axis(call))

    def blanks(self, type_: Type) -> list[int]:
        """What stands for an output that is never present."""
        return [self.constant(np.zeros(fixed(t.shape), DTYPES[t.dtype])) for _, t in leaves_of(type_)]

    def axis(self, call: CallNode) -> str | None:
        given = [self.graph.port(a.wire).type for a in call.arguments if a.wire is not None]
        held = [self.graph.nodes[a.register] for a in call.arguments if a.register is not None]
        types = [n.type for n in held if isinstance(n, RegisterNode)]
        return _axis([*(p.type for p in call.outputs), *given, *types])

    def clock(self, call: CallNode) -> tuple[int, int | None]:
        """When a call fires, and the seconds since it last did, in a stage of their own."""
        firing = self.when(call.firing)
        dt, stamp = None, []
        if call.stamp is not None:
            dt = self.duration(call.stamp)
            if call.stamp not in self.writes:
                self.writes[call.stamp] = [self.select(firing, self.time, self.reads[call.stamp][0])]
                stamp = [self.graph.nodes[call.stamp].path]
        self.close(f"clock({call.firing})", "clock", self.constant(np.True_), stamp, stamp)
        return firing, dt

    def random(self, site: Site, firing: int) -> None:
        """A stage that draws a site's numbers, once for all that use them."""
        if site in self.sites:
            return
        trace = Trace()
        time, seed = trace.input(Spec((), "int64")), trace.input(Spec((2,), "uint32"))
        drawn = trace.apply("materialise", site.numbers(time, seed, xp=namespace))
        renamed = {time.number: self.time, seed.number: self.seed}
        self.copy(trace, renamed)
        self.sites[site] = renamed[drawn.number]
        self.close(f"random({site.name})", "random", firing, (), ())

    def argument(self, argument: Any) -> list[int]:
        if argument.wire is not None:
            return self.leaves[argument.wire]
        return [] if argument.register is None else self.current(argument.register)

    def inline(
        self, step: StepTrace, given: list[list[int]], memory: list[int], dt: int | None
    ) -> tuple[list[tuple[int, list[int]]], list[int]]:
        """Copy a recorded step; returns (presence, leaves) an output, and the new state."""
        renamed = {step.time: self.time}
        if dt is not None:
            renamed[step.dt] = dt
        renamed.update(zip(step.state, memory, strict=True))
        for numbers, actual in zip(step.arguments, given, strict=True):
            if numbers is not None:
                renamed.update(zip(numbers, actual, strict=True))
        renamed.update({n: self.sites[site] for site, n in step.sites})
        self.copy(step.trace, renamed)
        outputs = []
        for out in step.outputs:
            flag = (
                renamed[out.presence]
                if isinstance(out.presence, int)
                else self.constant(np.bool_(out.presence == "always"))
            )
            outputs.append((flag, [renamed[n] for n in out.leaves]))
        return outputs, [renamed[n] for n in step.next_state]

    def choose(self, options: list[int], cases: dict[tuple[bool, ...], list[int]]) -> list[int]:
        """Select between the variants of a step by the presence of its options."""
        if len(cases) == 1:
            return next(iter(cases.values()))
        if not options or not cases:
            return []
        present = {c[1:]: v for c, v in cases.items() if c[0]}
        absent = {c[1:]: v for c, v in cases.items() if not c[0]}
        if not present or not absent:
            return self.choose(options[1:], present or absent)
        pairs = zip(self.choose(options[1:], present), self.choose(options[1:], absent), strict=True)
        return [self.select(options[0], yes, no) for yes, no in pairs]

    def port(
        self,
        name: str,
        type_: Type,
        clock: str,
        present: int,
        numbers: list[int],
        timing: Timing | None = None,
    ) -> Port:
        leaves = [
            Leaf(leaf, n, fixed(t.shape), t.dtype, t.unit, t.frame, axis_names(t))
            for (leaf, t), n in zip(leaves_of(type_), numbers, strict=True)
        ]
        return Port(name, str(type_), clock, present, tuple(leaves), timing)


def _axis(types: Sequence[Type]) -> str | None:
    """The first named axis of these types."""
    names = (name for type_ in types for _, leaf in leaves_of(type_) for name in axis_names(leaf))
    return next((n for n in names if n is not None), None)
