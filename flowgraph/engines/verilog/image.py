"""The machine of a pipeline: its program and memory as numbers, and where inputs and outputs lie."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flowgraph.engines.fixed.engine import Integers
from flowgraph.engines.verilog.bounds import need_room
from flowgraph.engines.verilog.nodes import (
    KINDS,
    MODES,
    UNITS,
    Constant,
    Held,
    Joined,
    Sum,
    Table,
    View,
    in_memory,
)
from flowgraph.engines.verilog.order import COPIES, Lanes, Slot
from flowgraph.engines.verilog.plan import Plan
from flowgraph.engines.verilog.rows import element_of, root_of
from flowgraph.engines.verilog.schedule import Loop, Schedule, Word, schedule
from flowgraph.engines.verilog.tick import Tick, held_values
from flowgraph.errors import DeclarationError
from flowgraph.pipeline.pipeline import Pipeline

BLOCK = 2048
"""Words that a block of the memory holds."""

MOST_LANES = 8
"""Each has two copies of the memory, and two words are written in a cycle: more would wait for each other."""


@dataclass(frozen=True)
class Entry:
    """The program of one pattern of present inputs.

    Args:
        key: bit k tells that input k is present.
        start: its first step.
        cycles: that its microwords take; the machine is ready some cycles later.
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
        lanes: terms that are begun in a cycle.

    Attributes:
        width: bits of a word of a real number.
        place_bits, step_bits: of addresses.
        memory, program: numbers of 36 bits, and microwords.
        places: for each value that the memory holds before a tick, the places of its words.
        entries: for each of `keys`.
        listing: a line for each microword.
        has_rows: whether there are loops, or rows that are read at computed places.
        indices: how many of these places are kept.
        element_bits: of the number of an element.
        lanes: how many, and whether the memory is deep.
        memories: of 18 kbit that memory and program want in an ECP5; a synthesis may leave some out.
    """

    def __init__(self, pipeline: Pipeline, keys: Sequence[int], lanes: int = 1) -> None:
        if not 1 <= lanes <= MOST_LANES:
            raise DeclarationError(
                "a machine has some lanes",
                path="lanes",
                expected=f"1 to {MOST_LANES}",
                got=str(lanes),
                fix="write --lanes 2",
            )
        self.pipeline, self.keys = pipeline, list(keys)
        cells = [c for r in pipeline.registers for c in r.cells]
        self.player = Integers(pipeline, [c.reset for c in cells], np.zeros(2, np.uint32))
        self.width = self.player.formats.width
        self.wide = self.player.formats.widest
        plans = [Plan(Tick(self.player, key)) for key in keys]
        for plan in plans:
            need_room(plan)
        self.has_rows = any(_has_rows(p) for p in plans)
        self.places = self._held()
        self._constants(plans)
        self.lanes = Lanes(lanes, lanes > 1, self._copies(plans, lanes))
        schedules = self._schedules(plans)
        if not self.lanes.deep and self.words > BLOCK:
            self.lanes = replace(self.lanes, deep=True)
            schedules = self._schedules(plans)
        self.indices = max((s.indices for s in schedules), default=0)
        longest = [0, *(w.does.last + 1 for s in schedules for w in s.words if isinstance(w.does, Loop))]
        self.element_bits = max(1, max(longest).bit_length())
        self.place_bits = max(
            4, (self.words - 1).bit_length(), (self.indices - 1).bit_length(), self.element_bits + 1
        )
        self.memory = [0] * self.words
        for words, place in self.tables.items():
            self.memory[place : place + len(words)] = map(in_memory, words)
        for word, place in self.constants.items():
            self.memory[place] = in_memory(word)
        for c, v in zip(cells, self.player.cells, strict=True):
            self.put(c.read, np.asarray(v))
        self.program: list[int] = []
        self.listing: list[str] = []
        self.entries: list[Entry] = []
        for key, p, s in zip(keys, plans, schedules, strict=True):
            self._append(key, p, s)
        self.step_bits = max(4, len(self.program).bit_length())

    @property
    def memories(self) -> int:
        banks = self.lanes.banks
        copies = 2 * self.lanes.count * banks
        program = self.lanes.count * self._lane_bits + (6 if self.has_rows else 1)
        return copies * memories(-(-self.words // banks), 36) + memories(len(self.program), program)

    @property
    def _lane_bits(self) -> int:
        """Of a lane's part of a microword."""
        return 31 + 3 * self.place_bits + 4 * self.has_rows

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

    def _constants(self, plans: list[Plan]) -> None:
        """Places for what is known, behind what is held; the computed words come behind both."""
        base = sum(p.size for p in self.places.values())
        constants: dict[int, int] = {0: base}
        known = [p.tick.nodes[n] for p in plans for n in self._used(p)]
        for node in known:
            if isinstance(node, Constant):
                constants.setdefault(node.word, base + len(constants))
        self.constants = constants
        self.tables: dict[tuple[int, ...], int] = {}
        first = base + len(constants)
        for node in known:
            if isinstance(node, Table) and node.words not in self.tables:
                self.tables[node.words] = first
                first += node.row
        self._first = first + first % 2  # in the first bank

    def _copies(self, plans: list[Plan], lanes: int) -> tuple[int, ...]:
        """How many units there are of each kind: one in a machine that has but one lane, and no rows."""
        several = lanes > 1 or self.has_rows
        kinds = Counter(
            made.unit for p in plans for made in map(p.tick.made, p.order) if made.mode == "START"
        )
        return tuple(min(COPIES[unit] if several else 1, kinds[k]) for k, unit in enumerate(UNITS))

    def _schedules(self, plans: list[Plan]) -> list[Schedule]:
        found = [
            schedule(p, self.has_rows, self.lanes, {h: self._place(h) for h in p.fixed.values()})
            for p in plans
        ]
        self.words = self._first + max((s.size for s in found), default=0)
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

    def _append(self, key: int, plan: Plan, made: Schedule) -> None:
        nodes = plan.tick.nodes

        def at(n: int, nth: int = 0) -> tuple[int, bool]:
            """The place of a word, or of the first element of a row of which a round makes the nth."""
            node = nodes[n]
            if isinstance(node, View):
                return at(node.of)[0] + node.offset + nth * bool(node.row), bool(node.row)
            if isinstance(node, Joined):
                return at(node.parts[0], nth)
            if isinstance(node, Table):
                return self.tables[node.words] + nth, True
            if isinstance(node, Constant):
                return self.constants[node.word], False
            held = plan.fixed.get(n) if isinstance(node, Sum) else node
            if isinstance(held, Held):
                place = self._place(held)
                return (place + nth, True) if held.row else (place, False)
            lies = self._first if plan.tick.made(n).mode != "INDEX" else 0
            if n in plan.rows:
                return lies + made.place[(n, 0)] + nth, True
            return lies + made.place.get((n, nth), made.place.get((n, 0), -1)), False

        def ended(number: int) -> int:
            n = root_of(number)
            node = nodes[n]
            offset, n = (node.offset, node.of) if isinstance(node, View) else (0, n)
            return at(plan.outputs.get(n, n))[0] + offset + element_of(number)

        start = len(self.program)
        words = made.words or [Word()]
        for t, word in enumerate(words):
            last = t == len(words) - 1
            self.program.append(self._microword(word, at, last))
            self.listing.append(f"{start + t:6d} {self._said(word, at)}{' halt' if last else ''}")
        outputs: list[tuple[int, list[np.ndarray]] | None] = []
        for flag, leaves in plan.tick.outputs:
            if flag is None:
                outputs.append(None)
                continue
            rows = [[ended(n) for n in x.ravel().tolist()] for x in leaves]
            places = [np.array(r, dtype=np.int64).reshape(x.shape) for r, x in zip(rows, leaves, strict=True)]
            outputs.append((ended(flag), places))
        terms = sum(1 for _ in made.slots)
        self.entries.append(Entry(key, start, made.cycles, outputs, terms))

    def _place(self, held: Held) -> int:
        """Where a word lies that the memory holds before a tick."""
        halves = 1 if held.width else self.places[held.value].shape[-1]
        return int(self.places[held.value].reshape(-1)[held.place * halves + int(held.high)])

    def _microword(self, word: Word, at: _At, last: bool) -> int:
        lane_bits = self._lane_bits
        code = 0
        repeat, running = word.repeat, False
        if isinstance(word.does, Loop):
            code = word.does.step << 31 + self.place_bits | word.does.last << 31 + 2 * self.place_bits
        else:
            for k, slot in enumerate(word.does):
                if slot is not None:
                    code |= self._part(slot, at) << k * lane_bits
                    repeat |= slot.term.times > 0
                    running |= slot.node.gather == "running"
        marks = (last, repeat, running, word.back, word.ends, isinstance(word.does, Loop))
        return code | sum(int(mark) << k for k, mark in enumerate(marks)) << self.lanes.count * lane_bits

    def _part(self, slot: Slot, at: _At) -> int:
        """A lane's part of a microword."""
        bits, t, node = self.place_bits, slot.term, slot.node
        to, to_moves = 0, False
        if slot.mode == "START":
            to = node.unit | slot.copy << 2
        elif slot.writes is not None:
            to, to_moves = at(slot.writes, slot.nth)
        ends = slot.mode not in ("", "HOLD")
        a, a_moves = (0, False) if t.kind == "TAKE" else at(t.a, 0 if t.kind == "GET" else slot.nth)
        b, b_moves = (node.unit | slot.copy << 2, False) if t.kind == "TAKE" else at(t.b, slot.nth)
        code = KINDS.index(t.kind)
        code |= (t.shift & 0xFF) << 4
        code |= int(t.minus) << 12 | int(slot.first) << 13 | node.limit << 14
        code |= ((node.end if ends else 0) & 0xFF) << 18
        code |= int(node.floor) << 26 | MODES.index(slot.mode) << 27
        code |= to << 31 | b << 31 + bits | a << 31 + 2 * bits
        marks = int(a_moves and t.kind != "GET") | int(b_moves) << 1 | int(to_moves) << 2
        return code | (marks | int(node.gather == "peak") << 3) << 31 + 3 * bits

    def _said(self, word: Word, at: _At) -> str:
        marks = f"{' back' * word.back}{' round' * word.ends}{' repeated' * word.repeat}"
        if isinstance(word.does, Loop):
            return f"loop to {word.does.last} by {word.does.step}"
        if not any(word.does):
            return f"-{marks}"
        return " | ".join("-" if slot is None else self._told(slot, at) for slot in word.does) + marks

    def _told(self, slot: Slot, at: _At) -> str:
        """What a lane begins."""
        t = slot.term

        def said(n: int, nth: int) -> str:
            place, moves = at(n, nth)
            return f"[{place}{' + k' if moves else ''}]"

        sign = "-" if t.minus else "+"
        words = (
            f"unit {UNITS[slot.node.unit]}"
            if t.kind == "TAKE"
            else f"{said(t.a, 0 if t.kind == 'GET' else slot.nth)} {said(t.b, slot.nth)}"
        )
        text = f"{'' if slot.first else '  '}{sign} {t.kind} {words} >> {t.shift}"
        if t.times:
            text += f" {slot.node.gather} for k < {t.times}"
        if slot.mode:
            to = UNITS[slot.node.unit] if slot.writes is None else said(slot.writes, slot.nth)
            text += f"  => {slot.mode} >> {slot.node.end} {to}  // {slot.line}"
        return text


def memories(words: int, bits: int) -> int:
    """Memories of 18 kbit for words of so many bits: each holds 2,048 of 9, 1,024 of 18 or 512 of 36."""
    rest = words % BLOCK
    wide = 9 if rest > BLOCK // 2 else 18 if rest > BLOCK // 4 else 36
    return words // BLOCK * -(-bits // 9) + (-(-bits // wide) if rest else 0)


_At = Callable[[int, int], tuple[int, bool]]


def _has_rows(plan: Plan) -> bool:
    """Whether a machine needs loops or computed places."""
    return any(
        node.row or node.mode == "INDEX" or any(t.times for t in node.terms)
        for node in map(plan.tick.made, plan.order)
    )
