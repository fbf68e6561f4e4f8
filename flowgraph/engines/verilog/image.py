"""The machine of a pipeline: its program and memory as numbers, and where inputs and outputs lie."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.verilog.nodes import KINDS, MODES, UNITS, Constant, Held, Sum, in_memory
from flowgraph.engines.verilog.schedule import Plan, Schedule, Slot, schedule
from flowgraph.engines.verilog.tick import Tick, held_values
from flowgraph.pipeline.pipeline import Pipeline


@dataclass(frozen=True)
class Entry:
    """The program of one pattern of present inputs.

    Args:
        key: bit k tells that input k is present.
        start: its first step.
        cycles: microwords in it; the machine is ready some cycles later.
        outputs: for each output, where the truth value lies that tells whether it is there, and for each leaf
            the places of its words, with an axis of one or two halves behind those of a leaf that is no real;
            None where the output never is there.
        terms: microwords that are not empty.
    """

    key: int
    start: int
    cycles: int
    outputs: list[tuple[int, list[np.ndarray]] | None]
    terms: int


class Image:
    """What the machine of a pipeline holds.

    Args:
        pipeline: with formats.
        keys: patterns of present inputs.

    Attributes:
        width: bits of a word of a real number.
        place_bits, step_bits: of addresses.
        memory, program: numbers of 36 bits, and microwords.
        places: for each value that the memory holds before a tick, the places of its words.
        entries: for each of `keys`.
        listing: a line for each microword.
        units: names of those that are used.
    """

    def __init__(self, pipeline: Pipeline, keys: Sequence[int]) -> None:
        self.pipeline, self.keys = pipeline, list(keys)
        cells = [c for r in pipeline.registers for c in r.cells]
        self.player = Integers(pipeline, [c.reset for c in cells], np.zeros(2, np.uint32))
        self.width = self.player.formats.width
        self.wide = max(self.width, self.player.formats.held_width)
        plans = [Plan(Tick(self.player, key)) for key in keys]
        schedules = [schedule(p) for p in plans]
        self.places = self._held()
        base = sum(p.size for p in self.places.values())
        constants: dict[int, int] = {0: base}
        for p in plans:
            for n in self._used(p):
                node = p.tick.nodes[n]
                if isinstance(node, Constant):
                    constants.setdefault(node.word, base + len(constants))
        self.constants = constants
        first = base + len(constants)
        self.words = first + max((s.words for s in schedules), default=0)
        self.place_bits = max(4, (self.words - 1).bit_length())
        self.units = sorted(
            {UNITS[s.node.unit] for x in schedules for s in x.slots if s and s.mode == "START"}
        )
        self.memory = [0] * self.words
        for word, place in constants.items():
            self.memory[place] = in_memory(word)
        for c, v in zip(cells, self.player.cells, strict=True):
            self.put(c.read, np.asarray(v))
        self.program: list[int] = []
        self.listing: list[str] = []
        self.entries: list[Entry] = []
        for key, p, s in zip(keys, plans, schedules, strict=True):
            self._append(key, p, s, first)
        self.step_bits = max(4, len(self.program).bit_length())

    def _held(self) -> dict[int, np.ndarray]:
        found: dict[int, np.ndarray] = {}
        place = 0
        for value, spec in held_values(self.pipeline).items():
            halves = 2 if spec.dtype in ("int64", "uint64") else 1
            size = math.prod(spec.shape) * halves
            shape = spec.shape if spec.dtype == "real" else (*spec.shape, halves)
            found[value] = np.arange(place, place + size).reshape(shape)
            place += size
        return found

    def _used(self, plan: Plan) -> list[int]:
        found = [t for n in plan.order for x in plan.tick.made(n).terms for t in (x.a, x.b)]
        return found + list(plan.kept)

    def put(self, value: int, x: np.ndarray) -> None:
        """Words of a value that the memory holds before a tick."""
        for place, word in self.words_of(value, x):
            self.memory[place] = word

    def words_of(self, value: int, x: np.ndarray) -> list[tuple[int, int]]:
        """Place and word of each part of a value: reals as words, others as they are."""
        places = self.places[value]
        if self.pipeline.specs[value].dtype == "real":
            return [
                (p, in_memory(w)) for p, w in zip(places.ravel().tolist(), np.ravel(x).tolist(), strict=True)
            ]
        found = []
        signed = self.pipeline.specs[value].dtype == "int64"
        for row, number in zip(
            places.reshape(-1, places.shape[-1]).tolist(), np.ravel(x).tolist(), strict=True
        ):
            n = int(number)
            if len(row) == 1:
                found.append((row[0], in_memory(n)))
            else:
                high = n >> 32 if signed else (n >> 32) & 0xFFFFFFFF
                found += [(row[0], n & 0xFFFFFFFF), (row[1], in_memory(high))]
        return found

    def _append(self, key: int, plan: Plan, made: Schedule, first: int) -> None:
        nodes = plan.tick.nodes

        def at(n: int) -> int:
            node = nodes[n]
            if isinstance(node, Constant):
                return self.constants[node.word]
            held = plan.fixed.get(n) if isinstance(node, Sum) else node
            if isinstance(held, Held):
                return int(self.places[held.value].reshape(-1)[self._part(held)])
            return first + made.place[n]

        def ended(n: int) -> int:
            return at(plan.outputs.get(n, n))

        start = len(self.program)
        slots = made.slots or [None]
        for t, slot in enumerate(slots):
            last = t == len(slots) - 1
            self.program.append(self._microword(slot, at, last))
            self.listing.append(f"{start + t:6d} {self._said(slot, at)}{' halt' if last else ''}")
        outputs: list[tuple[int, list[np.ndarray]] | None] = []
        for flag, leaves in plan.tick.outputs:
            if flag is None:
                outputs.append(None)
                continue
            rows = [[ended(n) for n in x.ravel().tolist()] for x in leaves]
            places = [np.array(r, dtype=np.int64).reshape(x.shape) for r, x in zip(rows, leaves, strict=True)]
            outputs.append((ended(flag), places))
        self.entries.append(Entry(key, start, len(slots), outputs, sum(s is not None for s in slots)))

    def _part(self, held: Held) -> int:
        halves = 1 if held.width else self.places[held.value].shape[-1]
        return held.place * halves + int(held.high)

    def _microword(self, slot: Slot | None, at: Callable[[int], int], last: bool) -> int:
        if slot is None:
            return int(last) << 31
        t, node = slot.term, slot.node
        to = 0
        if slot.mode == "START":
            to = node.unit
        elif slot.writes is not None:
            to = at(slot.writes)
        ends = slot.mode not in ("", "HOLD")
        a = 0 if t.kind == "TAKE" else at(t.a)
        b = node.unit if t.kind == "TAKE" else at(t.b)
        code = KINDS.index(t.kind)
        code |= (t.shift & 0xFF) << 4
        code |= int(t.minus) << 12 | int(slot.first) << 13 | node.limit << 14
        code |= ((node.end if ends else 0) & 0xFF) << 18
        code |= int(node.floor) << 26 | MODES.index(slot.mode) << 27 | int(last) << 31
        bits = self.place_bits
        return code | to << 32 | b << 32 + bits | a << 32 + 2 * bits

    def _said(self, slot: Slot | None, at: Callable[[int], int]) -> str:
        if slot is None:
            return "-"
        t = slot.term
        sign = "-" if t.minus else "+"
        words = f"unit {UNITS[slot.node.unit]}" if t.kind == "TAKE" else f"[{at(t.a)}] [{at(t.b)}]"
        text = f"{'' if slot.first else '  '}{sign} {t.kind} {words} >> {t.shift}"
        if slot.mode:
            to = UNITS[slot.node.unit] if slot.writes is None else f"[{at(slot.writes)}]"
            text += f"  => {slot.mode} >> {slot.node.end} {to}  // {slot.line}"
        return text
