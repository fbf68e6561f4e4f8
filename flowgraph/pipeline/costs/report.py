"""The cost report: what a lowered graph takes in operations, memory, time and energy.

Everything is counted on the instruction list, as lowered and as the optimiser leaves it, and nothing is
synthesised.
The tick that is reported in detail is the one in which every source has an event.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from flowgraph.errors import DeclarationError
from flowgraph.pipeline.costs.energy import SOURCE, access_pj, arithmetic_pj
from flowgraph.pipeline.costs.operations import KINDS, operations
from flowgraph.pipeline.costs.show import as_html, as_text
from flowgraph.pipeline.costs.storage import (
    REAL_BITS,
    SMALL,
    Fifo,
    Store,
    input_fifos,
    join_fifos,
    stage_fifos,
    stores,
)
from flowgraph.pipeline.costs.timing import Interval, Machine, Slot, critical_path, interval, reach, schedule
from flowgraph.pipeline.format_words import formats_by_path
from flowgraph.pipeline.optimise import DEFAULT, Plan, check_passes, optimise, plan
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise

MOST_PATTERNS = 8
"""Patterns of present sources up to which each has a program of its own."""

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Section:
    """A table of the report with what is to be known of it."""

    title: str
    note: str
    rows: tuple[Row, ...]


class Costs:
    """What one program of a pipeline takes.

    Args:
        pipeline: a lowered graph.
        key: the pattern of present sources; None: any.
        passes: of the optimiser.
        machine: what it is to run on.
    """

    def __init__(
        self,
        pipeline: Pipeline,
        key: int | None,
        passes: Collection[str] = DEFAULT,
        machine: Machine | None = None,
    ) -> None:
        self.pipeline, self.machine = pipeline, machine or Machine()
        self.lowered = specialise(pipeline, key)
        self.program: Program = optimise(self.lowered, passes)
        self.passes = check_passes(passes)
        self._stages = {i.out: stage.path for stage in pipeline.stages for i in stage.instructions}

    def stage_of(self, value: int) -> str:
        """The path of the stage that a value of the optimised list serves."""
        return self._stages.get(self.program.origin.get(value, value), "constants")

    @cached_property
    def plan(self) -> Plan:
        return plan(self.program, self.passes)

    @cached_property
    def stores(self) -> list[Store]:
        """Registers, constants and buffers."""
        return stores(self.pipeline, self.program, self.plan)

    @cached_property
    def interval(self) -> Interval:
        return interval(self.program, self.machine)

    @cached_property
    def slots(self) -> dict[str, Slot]:
        return schedule(self.program, self.machine, self.stage_of)

    @cached_property
    def operations(self) -> Counter[str]:
        return counted(self.program)

    @cached_property
    def by_stage(self) -> dict[str, Counter[str]]:
        found: dict[str, Counter[str]] = {}
        for i in self.program.instructions:
            found.setdefault(self.stage_of(i.out), Counter()).update(operations(i, self.program.specs))
        return found

    @property
    def bits(self) -> int:
        """Of all registers, memories and buffers."""
        return sum(s.bits for s in self.stores)

    @property
    def energy_pj(self) -> float:
        """Of a tick: its operations, and the accesses to its memories (registers are free)."""
        accesses = sum(access_pj(s.words, s.bits // 8) for s in self.stores if s.kind == "memory")
        return arithmetic_pj(self.operations) + accesses

    def latency(self) -> dict[str, int]:
        """For each input, the operations on the longest chain from it to an output."""
        ends = [n for _, leaves in self.program.outputs for n in leaves]
        found = {}
        for port in self.pipeline.inputs:
            depth = reach(self.program, {port.present, *(leaf.value for leaf in port.leaves)})
            found[port.name] = max((depth.get(n, 0) for n in ends), default=0)
        return found

    def fifos(self) -> list[Fifo]:
        """Of inputs, joins and stages."""
        every = self.interval.cycles
        return [
            *input_fifos(self.pipeline, every, self.machine),
            *join_fifos(self.pipeline),
            *stage_fifos(self.program, self.slots, self.stage_of, every),
        ]


def counted(program: Program) -> Counter[str]:
    """Scalar operations of a program by kind."""
    found: Counter[str] = Counter()
    for i in program.instructions:
        found.update(operations(i, program.specs))
    return found


@dataclass(frozen=True)
class CostReport:
    """The report as tables; `text` and `html` show it.

    Args:
        name: of the graph.
        intro: what the figures are of.
        sections: in order.
    """

    name: str
    intro: str
    sections: tuple[Section, ...]

    def __getitem__(self, title: str) -> tuple[Row, ...]:
        """The rows of a section, by its title."""
        return next(s.rows for s in self.sections if s.title == title)

    def text(self) -> str:
        """The tables as plain text."""
        return as_text(self)

    def html(self) -> str:
        """The tables as a page of its own."""
        return as_html(self)

    def _repr_html_(self) -> str:
        from flowgraph.drawing.notebook import report_cell  # only who shows it needs what draws

        first = self.sections[0]
        return report_cell(first.rows, (self.intro, first.note), self.html(), "all tables")


def cost_report(
    pipeline: Pipeline,
    *,
    passes: Collection[str] = DEFAULT,
    multipliers: int = 16,
    lanes: int = 1,
    clock: float = 100e6,
) -> CostReport:
    """What a pipeline takes.

    Args:
        pipeline: a lowered graph.
        passes: of the optimiser.
        multipliers: of a lane.
        lanes: particles that are worked on at once.
        clock: Hz.

    Raises:
        UnknownNameError: for a pass that is not there.
        DeclarationError: for a machine without a multiplier, a lane or a clock.
    """
    for name, value in (("multipliers", multipliers), ("lanes", lanes), ("clock", clock)):
        if not value > 0:
            raise DeclarationError(
                f"a machine needs {name}",
                path=f"cost_report, {name}",
                expected="more than 0",
                got=repr(value),
                fix=f"write {name}={'100e6' if name == 'clock' else 16}",
            )
    machine = Machine(multipliers, lanes, clock)
    count = len(pipeline.inputs)
    full = 2**count - 1
    keys: list[int | None] = [*range(1, full + 1)] if full < MOST_PATTERNS else [None]
    costs = {key: Costs(pipeline, key, passes, machine) for key in keys}
    whole = costs[keys[-1]]
    intro = (
        f"Counted on the instruction list, not synthesised. Reals of {REAL_BITS} bits. "
        f"{multipliers} multipliers a lane, {lanes} lane{'s' * (lanes > 1)}, {clock / 1e6:g} MHz. "
        f"Passes: {', '.join(whole.passes) or 'none'}."
    )
    return CostReport(
        pipeline.name,
        intro,
        (
            _patterns(pipeline, costs),
            _saved(whole),
            _stages(whole),
            _timing(whole),
            _stores(whole),
            _fifos(whole),
            _energy(whole),
            *_formats(pipeline),
        ),
    )


def _formats(pipeline: Pipeline) -> list[Section]:
    """The number formats, where the pipeline has some."""
    rows = tuple(
        {"path": path or pipeline.name, "words": words} for path, words in formats_by_path(pipeline).items()
    )
    note = "Of inputs, blocks and registers: the last bit of a word of fraction f is worth 2^-f."
    return [Section("Number formats", note, rows)] if rows else []


def _patterns(pipeline: Pipeline, costs: Mapping[int | None, Costs]) -> Section:
    rows = []
    for key, c in costs.items():
        names = [p.name for k, p in enumerate(pipeline.inputs) if key is None or key >> k & 1]
        rows.append(
            {
                "present": "any of " + ", ".join(names) if key is None else ", ".join(names),
                "instructions": len(c.program.instructions),
                "operations": sum(c.operations.values()),
                "multiplications": c.operations["multiply"] + c.operations["integer multiply"],
                "critical path": critical_path(c.program),
                "initiation interval": c.interval.cycles,
                "energy nJ": round(c.energy_pj / 1e3, 2),
            }
        )
    return Section(
        "Ticks",
        "One line a pattern of sources that have an event in a tick. What follows is of the last line.",
        tuple(rows),
    )


def _saved(c: Costs) -> Section:
    before = counted(c.lowered)
    rows = [
        {"kind": k, "as lowered": before[k], "optimised": c.operations[k]}
        for k in KINDS
        if before[k] or c.operations[k]
    ]
    rows.append({"kind": "all", "as lowered": sum(before.values()), "optimised": sum(c.operations.values())})
    return Section(
        "Operations", "Scalar operations by kind, as lowered and as the optimiser left them.", tuple(rows)
    )


def _stages(c: Costs) -> Section:
    kinds = [k for k in KINDS if c.operations[k]]
    order = {s.path: n for n, s in enumerate(c.pipeline.stages)}
    rows = []
    for path, counts in sorted(c.by_stage.items(), key=lambda item: order.get(item[0], -1)):
        slot = c.slots[path]
        rows.append(
            {"stage": path, **{k: counts[k] for k in kinds}, "start": slot.start, "cycles": slot.duration}
        )
    rows.append({"stage": "all", **{k: c.operations[k] for k in kinds}, "start": "", "cycles": ""})
    return Section(
        "Stages",
        "Operations by stage, with when a stage starts and how many cycles it takes on multipliers of its "
        "own. What two stages share is counted in the first.",
        tuple(rows),
    )


def _timing(c: Costs) -> Section:
    rows = [{"what": "critical path", "value": critical_path(c.program), "unit": "operations"}]
    rows += [
        {"what": f"latency from {name}", "value": n, "unit": "operations"} for name, n in c.latency().items()
    ]
    rows += [
        {"what": "cycles for the multipliers", "value": c.interval.multipliers, "unit": "cycles"},
        {
            "what": "longest chain from register to register",
            "value": c.interval.feedback,
            "unit": "operations",
        },
        {"what": "initiation interval", "value": c.interval.cycles, "unit": "cycles"},
        {"what": "ticks a second", "value": round(c.machine.clock / c.interval.cycles), "unit": "Hz"},
    ]
    return Section(
        "Timing",
        "Latency: operations that wait for one another. The initiation interval is the larger of the two "
        "lines above it, a lower bound: a multiplier begins a multiplication each cycle, and quotients, "
        "roots and functions are multiplications as in the energy table.",
        tuple(rows),
    )


def _stores(c: Costs) -> Section:
    kept = [s for s in c.stores if not s.name.startswith("buffer ")]
    rows: list[Row] = [{"name": s.name, "for": s.use, "kind": s.kind, "bits": s.bits} for s in kept]
    buffers = Counter(s.bits for s in c.stores if s.name.startswith("buffer "))
    for size, count in sorted(buffers.items(), reverse=True):
        kind = Store("", "", size, 0).kind
        name = f"{count} buffers of {size:,}" if count > 1 else "1 buffer"
        rows.append({"name": name, "for": "within a tick", "kind": kind, "bits": count * size})
    for kind in ("register", "memory"):
        total = sum(s.bits for s in c.stores if s.kind == kind)
        rows.append({"name": "all", "for": "", "kind": kind, "bits": total})
    return Section(
        "Memory",
        f"What is kept between ticks, for ever, and within a tick; up to {SMALL} bits it is a register. "
        "Buffers within a tick are shared by arrays whose times do not overlap.",
        tuple(rows),
    )


def _fifos(c: Costs) -> Section:
    rows = [
        {"fifo": f.name, "depth": "none" if f.depth is None else f.depth, "width": f.width, "why": f.why}
        for f in c.fifos()
    ]
    return Section("FIFOs", "Depth in values, width in bits.", tuple(rows))


def _energy(c: Costs) -> Section:
    rows = [
        {
            "what": kind,
            "count": c.operations[kind],
            "nJ": round(arithmetic_pj({kind: c.operations[kind]}) / 1e3, 3),
        }
        for kind in KINDS
        if c.operations[kind]
    ]
    words = sum(s.words for s in c.stores if s.kind == "memory")
    accesses = c.energy_pj - arithmetic_pj(c.operations)
    rows.append({"what": "words to and from memories", "count": words, "nJ": round(accesses / 1e3, 3)})
    rows.append({"what": "all", "count": "", "nJ": round(c.energy_pj / 1e3, 3)})
    return Section(
        "Energy",
        f"An estimate for one tick from {SOURCE}. Arithmetic and memories alone: no control, clock or "
        "leakage. A quotient is 5 multiplications and 4 additions, a root 8 and 2, a function 9 and 9; "
        "comparisons and logic count as additions of integers.",
        tuple(rows),
    )
