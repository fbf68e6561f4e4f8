"""Where numbers are kept: registers, memories and FIFOs, in bits, and why a FIFO is as deep as it is."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from flowgraph.language.clock import Timing
from flowgraph.pipeline.costs.timing import Machine, Slot
from flowgraph.pipeline.optimise.memory import Plan
from flowgraph.pipeline.pipeline import Pipeline, spec_of
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec

REAL_BITS = 32
SMALL = 1024
"""Bits up to which an array is kept in flip-flops; a larger one is a memory."""

_BITS = {"real": REAL_BITS, "bool": 1, "int32": 32, "uint32": 32, "int64": 64, "uint64": 64}


def bits(spec: Spec) -> int:
    """Bits of a value, with 32 for a real."""
    return math.prod(spec.shape) * _BITS[spec.dtype]


@dataclass(frozen=True)
class Store:
    """A register or memory: what it is for, its size in bits, and the words moved in a tick."""

    name: str
    use: str
    bits: int
    words: int

    @property
    def kind(self) -> str:
        return "register" if self.bits <= SMALL else "memory"


def stores(pipeline: Pipeline, program: Program, plan: Plan) -> list[Store]:
    """All that keeps numbers: between ticks, for ever (constants), and within a tick (buffers)."""
    found = []
    for register in pipeline.registers:
        for cell in register.cells:
            size = bits(spec_of(cell))
            name = register.path if cell.name == "value" else f"{register.path}.{cell.name}"
            found.append(Store(name, register.role, size, 2 * _words(size)))
    for n, array in program.constants.items():
        size = bits(program.specs[n])
        if array.size > 1:
            found.append(Store(f"%{n}", "constant", size, _words(size)))
    moved = _moved(program, plan)
    for n, (buffer, words) in enumerate(zip(plan.buffers, moved, strict=True)):
        found.append(Store(f"buffer {n}", "within a tick", buffer.size * _BITS[buffer.dtype], words))
    return found


def _moved(program: Program, plan: Plan) -> list[int]:
    """Words written to each buffer in a tick, and read once; a view of what is there already is neither."""
    found = [0] * len(plan.buffers)
    local = {v for loop in plan.loops for v in loop.local}
    for i in program.instructions:
        given = plan.view.get(i.out, (None, 0))[0]
        there = given in i.args or (
            i.op == "stack" and all(plan.view.get(a, (0, 0))[0] == i.out for a in i.args)
        )
        if i.out in local or i.spec.shape == () or there:
            continue
        root = i.out
        while root in plan.view:
            root = plan.view[root][0]
        if root in plan.place:
            found[plan.place[root]] += 2 * _words(bits(i.spec))
    return found


def _words(size: int) -> int:
    return -(-size // 32)


@dataclass(frozen=True)
class Fifo:
    """A FIFO: between what, how deep, how wide in bits, and the reason. Depth None: no depth is enough."""

    name: str
    depth: int | None
    width: int
    why: str

    @property
    def bits(self) -> int | None:
        return None if self.depth is None else self.depth * self.width


def input_fifos(pipeline: Pipeline, interval: int, machine: Machine) -> list[Fifo]:
    """One for each input: events wait while a tick of another is under way."""
    tick = interval / machine.clock * 1e9
    gaps = {p.name: _closest(p.timing) for p in pipeline.inputs}
    load = sum(tick / g for g in gaps.values() if g)
    found = []
    for port in pipeline.inputs:
        width = sum(bits(spec_of(leaf)) for leaf in port.leaves) + _BITS["int64"]
        gap, wait = gaps[port.name], len(gaps) * tick
        depth: int | None = None
        if gap is None:
            why = "its rate has no bound: declare aperiodic(max_rate=...)"
        elif load > 1.0:
            why = f"ticks take {100 * load:.0f} % of the time at the highest rates: none is deep enough"
        else:
            depth = max(1, math.ceil(wait / gap))
            why = (
                f"closest events {_time(gap)} apart; one waits {_time(wait)} at most, "
                f"for a tick of each of {len(gaps)} inputs"
            )
        found.append(Fifo(f"input {port.name}", depth, width, why))
    return found


def _closest(timing: Timing | None) -> float | None:
    """The shortest time between two events, ns."""
    if timing is None:
        return None
    if timing.period is not None:
        return max(timing.period - timing.jitter, 1)
    return 1e9 / timing.max_rate if timing.max_rate else None


def _time(ns: float) -> str:
    return f"{ns / 1e6:.3g} ms" if ns >= 1e6 else f"{ns / 1e3:.3g} us"


def join_fifos(pipeline: Pipeline) -> list[Fifo]:
    """The queues of joins, with room for the value that is just coming."""
    bounds = {f.register: f for f in pipeline.faults}
    makers = {w: s for s in pipeline.stages for w in s.writes}
    found = []
    for register in pipeline.registers:
        fault = bounds.get(register.path)
        if fault is None or fault.bound < 1:
            continue
        block = makers[register.path].block if register.path in makers else "join"
        why = {
            "match": f"size={fault.bound} was declared, and one that comes",
            "zip": f"the clocks let {fault.bound} wait, and one comes",
        }.get(block, f"bound {fault.bound}, and one that comes")
        sides: dict[str, list[Any]] = {}
        for cell in register.cells:
            side, dot, rest = cell.name.partition(".")
            if dot and rest.startswith("items"):
                sides.setdefault(side, []).append(cell)
        for side, cells in sides.items():
            depth = cells[0].shape[0]
            width = sum(bits(spec_of(c)) for c in cells) // depth
            found.append(Fifo(f"{fault.path}, queue {side}", depth, width, why))
    return found


def stage_fifos(
    program: Program, slots: Mapping[str, Slot], stage_of: Callable[[int], str], interval: int
) -> list[Fifo]:
    """Between stages, where a value waits for another that takes longer: so many ticks may be on their way.

    An array along the axis of particles is a stream with an item a particle, and all of them wait.
    """
    made = {i.out for i in program.instructions}
    edges: dict[tuple[str, str], set[int]] = {}
    for i in program.instructions:
        here = stage_of(i.out)
        for a in i.args:
            if a in made and stage_of(a) != here:
                edges.setdefault((stage_of(a), here), set()).add(a)
    found = []
    for (source, target), values in edges.items():
        wait = slots[target].start - slots[source].end
        if wait <= 0:
            continue
        late = max((s for s, t in edges if t == target), key=lambda s: slots[s].end)
        widths: dict[int, int] = {}  # by how many items a tick has
        for value in values:
            spec = program.specs[value]
            items = next((n for n in reversed(spec.shape) if n in program.lanes), 1)
            widths[items] = widths.get(items, 0) + bits(spec) // items
        for items, width in sorted(widths.items()):
            each = f"{items} particles, each waiting" if items > 1 else "waits"
            why = f"{each} {wait} cycles for {late}, with a tick every {interval}"
            found.append(Fifo(f"{source} -> {target}", items * (1 + wait // interval), width, why))
    return found
