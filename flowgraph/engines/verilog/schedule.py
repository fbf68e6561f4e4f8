"""When each sum is made, and where its word lies: list scheduling on one lane, and memory used again.

A sum of n terms takes n cycles one after the other; its word can be read some cycles after the last. Of the
sums that could be made, the one goes first from which the way to the end is longest. Words of registers are
overwritten once nobody reads them any more in the tick, so that a tick ends with its registers in place.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable
from dataclasses import dataclass

from flowgraph.engines.verilog.nodes import UNITS, Constant, Held, Sum, Term
from flowgraph.engines.verilog.tick import Tick

LATENCY = 23
"""Cycles from the microword that writes a word to the first that can read it."""

UNIT_LATENCY = {"divide": 45, "root": 45, "logarithm": 193, "angle": 93}
"""Cycles from the microword that starts a unit to the first that can take what it made."""


@dataclass(frozen=True)
class Slot:
    """One microword: a term of a sum; `writes` is the number of the word that the last term of it makes."""

    term: Term
    first: bool
    node: Sum
    mode: str
    writes: int | None
    line: str


@dataclass(frozen=True)
class Schedule:
    """A tick in order of time.

    Args:
        slots: a microword a cycle; None is a cycle in which nothing begins.
        place: of each word that is computed, relative to the first free place; words of registers and
            constants are not in it.
        words: how many places are used.
    """

    slots: list[Slot | None]
    place: dict[int, int]
    words: int


class Plan:
    """The sums of a tick that something needs, with what must come before what."""

    def __init__(self, tick: Tick) -> None:
        self.tick = tick
        self.fixed: dict[int, Held] = {}  # sums whose word is a register's
        self.outputs: dict[int, int] = {}  # words that outputs are, where they are overwritten: their copies
        self._registers = set(tick.writes)
        self._copies()
        self._live()

    def _copies(self) -> None:
        tick, nodes = self.tick, self.tick.nodes
        wanted = [
            n for flag, leaves in tick.outputs if flag is not None for x in leaves for n in x.ravel().tolist()
        ]
        wanted += [flag for flag, _ in tick.outputs if flag is not None]
        uses: dict[int, int] = {}
        for node in nodes:
            if isinstance(node, Sum):
                for r in _reads(node):
                    uses[r] = uses.get(r, 0) + 1
        for n in wanted:
            uses[n] = uses.get(n, 0) + 1
            node = nodes[n]
            if isinstance(node, Held) and node in self._registers and n not in self.outputs:
                self.outputs[n] = self._copy(n)
        taken: set[int] = set()
        for held, source in tick.writes.items():
            node = nodes[source]
            alone = isinstance(node, Sum) and not uses.get(source) and source not in taken
            if alone and not any(isinstance(nodes[r], Held) for r in _reads(tick.made(source))):
                taken.add(source)
                self.fixed[source] = held
                continue
            if isinstance(node, Held):
                source = self._copy(source)
            tick.line.append("registers")
            tick.nodes.append(Sum((Term("MUL", source, tick.one),), "RAW"))
            self.fixed[len(tick.nodes) - 1] = held

    def _copy(self, n: int) -> int:
        self.tick.line.append("registers")
        self.tick.nodes.append(Sum((Term("MUL", n, self.tick.one),), "RAW"))
        return len(self.tick.nodes) - 1

    def _live(self) -> None:
        nodes = self.tick.nodes
        self.kept = {self.outputs.get(n, n) for n in self._ends()}
        stack = [*self.kept, *self.fixed]
        live: set[int] = set()
        while stack:
            n = stack.pop()
            node = nodes[n]
            if n in live or not isinstance(node, Sum):
                continue
            live.add(n)
            stack += _reads(node)
        self.order = sorted(live)
        by_held: dict[Held, list[int]] = {}
        for n in self.order:
            for r in _reads(self.tick.made(n)):
                node = nodes[r]
                if isinstance(node, Held):
                    by_held.setdefault(node, []).append(n)
        self.after = {n: [r for r in by_held.get(held, ()) if r != n] for n, held in self.fixed.items()}

    def _ends(self) -> Iterable[int]:
        for flag, leaves in self.tick.outputs:
            if flag is not None:
                yield flag
                for x in leaves:
                    yield from x.ravel().tolist()


def _reads(node: Sum) -> list[int]:
    """The numbers of the words and units that a sum reads."""
    return [t.a for t in node.terms] + [t.b for t in node.terms if t.kind != "TAKE"]


def schedule(plan: Plan) -> Schedule:
    """The order of a tick's sums."""
    nodes, order, made = plan.tick.nodes, plan.order, plan.tick.made
    needs = {n: sorted({r for r in _reads(made(n)) if isinstance(nodes[r], Sum)}) for n in order}
    users: dict[int, list[int]] = {n: [] for n in order}
    for n in order:
        for r in needs[n]:
            users[r].append(n)
    later: dict[int, list[int]] = {n: [] for n in order}
    for n, readers in plan.after.items():
        for r in readers:
            later[r].append(n)
    missing = {n: len(needs[n]) + len(plan.after.get(n, ())) for n in order}
    urgent: dict[int, int] = {}
    for n in sorted(order, reverse=True):
        node = made(n)
        behind = max((urgent[u] for u in users[n]), default=0)
        urgent[n] = behind + _latency(node) + len(node.terms)
    takes = {n: len(users[n]) for n in order if made(n).mode == "START"}
    ready: dict[int, int] = {}
    waiting: list[tuple[int, int]] = []
    free: list[tuple[int, int]] = []
    blocked: dict[int, list[tuple[int, int]]] = {k: [] for k in range(len(UNITS))}
    busy = dict.fromkeys(range(len(UNITS)), 0)
    slots: list[Slot | None] = []
    issued: dict[int, int] = {}
    earliest_after: dict[int, int] = dict.fromkeys(order, 0)

    def offer(n: int) -> None:
        heapq.heappush(waiting, (max(_start(made(n), ready)[0], earliest_after[n]), n))

    for n in order:
        if missing[n] == 0:
            offer(n)
    while len(issued) < len(order):
        while waiting and waiting[0][0] <= len(slots):
            _, n = heapq.heappop(waiting)
            heapq.heappush(free, (-urgent[n], n))
        if not free:
            slots += [None] * (waiting[0][0] - len(slots))
            continue
        _, n = heapq.heappop(free)
        node = made(n)
        if node.mode == "START":
            if busy[node.unit]:
                blocked[node.unit].append((-urgent[n], n))
                continue
            busy[node.unit] = takes[n]
        terms = node.terms if node.mode == "START" else [node.terms[k] for k in _start(node, ready)[1]]
        for k, term in enumerate(terms):
            last = k == len(terms) - 1
            mode = node.mode if last else "HOLD" if node.mode == "START" else ""
            write = n if last and node.mode != "START" else None
            first = k == 0 or node.mode == "START"
            slots.append(Slot(term, first, node, mode, write, plan.tick.line[n]))
        issued[n] = len(slots) - 1
        ready[n] = issued[n] + _latency(node)
        if terms[0].kind == "TAKE":
            busy[node.unit] -= 1
            if not busy[node.unit]:
                for one in blocked[node.unit]:
                    heapq.heappush(free, one)
                blocked[node.unit] = []
        for u in users[n]:
            missing[u] -= 1
            if not missing[u]:
                offer(u)
        for u in later[n]:
            missing[u] -= 1
            earliest_after[u] = max(earliest_after[u], len(slots))
            if not missing[u]:
                offer(u)
    place, words = _places(plan, slots, issued)
    return Schedule(slots, place, words)


def _latency(node: Sum) -> int:
    return UNIT_LATENCY[UNITS[node.unit]] if node.mode == "START" else LATENCY


def _start(node: Sum, ready: dict[int, int]) -> tuple[int, list[int]]:
    """When a sum can begin, and the order of its terms: what is there last comes last."""
    when = [max(ready.get(t.a, 0), 0 if t.kind == "TAKE" else ready.get(t.b, 0)) for t in node.terms]
    order = range(len(when)) if node.mode == "START" else sorted(range(len(when)), key=lambda k: when[k])
    return max(when[k] - n for n, k in enumerate(order)), list(order)


def _places(plan: Plan, slots: list[Slot | None], issued: dict[int, int]) -> tuple[dict[int, int], int]:
    """Places for the words that are computed; a place is used again once its word was last read."""
    last: dict[int, int] = {}
    for t, slot in enumerate(slots):
        if slot is not None:
            last[slot.term.a] = t
            if slot.term.kind != "TAKE":
                last[slot.term.b] = t
    place: dict[int, int] = {}
    spare: list[int] = []
    ends: list[tuple[int, int]] = []
    words = 0
    for t, slot in enumerate(slots):
        n = None if slot is None else slot.writes
        if n is None or n in plan.fixed:
            continue
        while ends and ends[0][0] <= t:
            heapq.heappush(spare, heapq.heappop(ends)[1])
        if spare:
            place[n] = heapq.heappop(spare)
        else:
            place[n] = words
            words += 1
        if n not in plan.kept:
            heapq.heappush(ends, (last.get(n, t), place[n]))
    return place, words


__all__ = ["LATENCY", "Constant", "Plan", "Schedule", "Slot", "schedule"]
