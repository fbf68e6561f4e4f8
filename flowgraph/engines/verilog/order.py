"""In which order sums are made that are made together: list scheduling on lanes that go in step.

A lane begins a term a cycle, so a sum of n terms takes one lane for n cycles, and its word can be read some
cycles after the last. Of the sums that could be made, the one goes first from which the way to the end is
longest. A word lies in one of the banks of the memory, and each bank takes one word a cycle: two lanes never
end sums for one bank together, nor two indices. The units and terms that are many are the first lane's.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from dataclasses import dataclass

from flowgraph.engines.verilog.latency import AHEAD, DEEP, LATENCY, UNIT_LATENCY
from flowgraph.engines.verilog.nodes import PAIRED, UNITS, Sum, Term
from flowgraph.engines.verilog.plan import Plan

COPIES = {"divide": 4, "root": 2, "logarithm": 4, "angle": 2}
"""How many units of a kind there are at most: a unit takes no number before its last result was taken."""

ALL = -1
"""The bank of words that go through all of them, or any."""

_INDEX = -2
"""Where indices go: each lane has a copy of them, and one is written in a cycle."""

_TRIED = 24
"""Sums that are looked at for a lane in a cycle."""

_FIRST_LANE = frozenset(["TAKE", "NORM", "NORM_EVEN", "BITS"])

Item = tuple[int, int]
"""A sum and which of the elements of a round it makes."""


@dataclass(frozen=True)
class Lanes:
    """What a schedule is for.

    Args:
        count: terms that are begun in a cycle.
        deep: whether the memory answers later.
        copies: how many units there are of each kind.
    """

    count: int = 1
    deep: bool = False
    copies: tuple[int, ...] = (1,) * len(UNITS)

    @property
    def banks(self) -> int:
        """Words that are written in a cycle, at most."""
        return min(self.count, 2)

    def latency(self, node: Sum) -> int:
        """Cycles from the last microword of a sum to the first that can read it."""
        if node.mode == "START":
            return UNIT_LATENCY[UNITS[node.unit]]
        return LATENCY + DEEP * self.deep + AHEAD * (node.mode == "INDEX")


@dataclass(frozen=True)
class Slot:
    """What a lane begins: a term of a sum.

    Args:
        term, node: these.
        first: whether the sum begins.
        mode: what becomes of the sum behind it; empty before its last term.
        writes: the number of the word that the last term makes.
        line: where it comes from.
        nth: of the elements of a round.
        bank: of the word that is written.
        copy: of the unit that is started or asked.
    """

    term: Term
    first: bool
    node: Sum
    mode: str
    writes: int | None
    line: str
    nth: int = 0
    bank: int = 0
    copy: int = 0


Step = list[Slot | None]
"""What each lane begins."""


class Order:
    """The order of sums that are made together.

    Args:
        plan: the tick.
        items: what is made.
        ready: cycles from which words made before can be read.
        now: the cycle in which this begins.
        lanes: the machine.
        bank: of the word of an item; None where it may be any.

    Attributes:
        steps: a microword a cycle, but for one whose term is repeated.
    """

    def __init__(
        self,
        plan: Plan,
        items: list[Item],
        ready: dict[int, int],
        now: int,
        lanes: Lanes,
        bank: Callable[[Item], int | None],
    ) -> None:
        self.plan, self.lanes, self.bank = plan, lanes, bank
        self.made = plan.tick.made
        self.steps: list[Step] = []
        self.ready: dict[Item, int] = {}
        self.within = set(items)
        for n, _ in items:
            for r, _ in plan.reads(self.made(n)):
                if (r, 0) not in self.within and r in ready:
                    self.ready[(r, 0)] = max(ready[r] - now, 0)
        self._skew = 0  # cycles that are no steps, since a term was repeated in them
        self._free = [0] * lanes.count  # from when each lane is
        self._copy: dict[Item, int] = {}  # of the unit that a START has started
        self._draining = False  # whether a term that is repeated waits for all lanes
        self._writes: dict[int, set[int]] = {}  # banks that take a word, by the cycle of its last term
        self._make(items)

    def _item(self, n: int, nth: int) -> Item:
        """What makes the word n for an element."""
        return (n, nth) if (n, nth) in self.within else (n, 0)

    def _there(self, n: int, nth: int) -> int:
        """When a word, or all of a row, can be read."""
        return max(self.ready.get(self._item(r, nth), 0) for r in self.plan.sources(n))

    def _make(self, items: list[Item]) -> None:
        made = self.made
        needs = {
            (n, k): sorted({x for r, _ in self.plan.reads(made(n)) if (x := self._item(r, k)) in self.within})
            for n, k in items
        }
        users: dict[Item, list[Item]] = {x: [] for x in items}
        for x in items:
            for r in needs[x]:
                users[r].append(x)
        later: dict[Item, list[Item]] = {x: [] for x in items}
        missing = {x: len(needs[x]) for x in items}
        for n, k in items:
            for held in self.plan.after.get(n, ()):
                if (held, k) in self.within:
                    later[(held, k)].append((n, k))
                    missing[(n, k)] += 1
        urgent: dict[Item, int] = {}
        for x in sorted(items, reverse=True):
            node = made(x[0])
            behind = max((urgent[u] for u in users[x]), default=0)
            urgent[x] = behind + self.lanes.latency(node) + _length(node)
        alone = {x: self.lanes.count > 1 and _first_lane(made(x[0])) for x in items}
        takes = {x: len(users[x]) for x in items if made(x[0]).mode == "START"}
        waiting: list[tuple[int, Item]] = []
        free: dict[bool, list[tuple[int, Item]]] = {False: [], True: []}
        blocked: dict[int, list[tuple[int, Item]]] = {k: [] for k in range(len(UNITS))}
        busy = [dict.fromkeys(range(copies), 0) for copies in self.lanes.copies]  # results not yet taken
        earliest_after: dict[Item, int] = dict.fromkeys(items, 0)

        def offer(x: Item) -> None:
            heapq.heappush(waiting, (max(self._start(x)[0], earliest_after[x]), x))

        def next_for(lane: int, now: int) -> Item | None:
            """The most urgent sum that this lane can begin; others stay where they are."""
            passed: list[tuple[bool, tuple[int, Item]]] = []
            found = None
            while found is None and len(passed) < _TRIED:
                kinds = [k for k in (False, True) if free[k] and (lane == 0 or not k)]
                if not kinds:
                    break
                kind = min(kinds, key=lambda k: free[k][0])
                entry = heapq.heappop(free[kind])
                x = entry[1]
                node = made(x[0])
                if node.mode == "START" and all(busy[node.unit].values()):
                    blocked[node.unit].append(entry)
                elif self._fits(x, node, now):
                    found = x
                else:
                    passed.append((kind, entry))
                    if _repeated(node):
                        self._draining = True  # the other lanes must come to their end first
                        break
            for kind, entry in passed:
                heapq.heappush(free[kind], entry)
            return found

        for x in items:
            if missing[x] == 0:
                offer(x)
        left = len(items)
        now = 0
        while left:
            while waiting and waiting[0][0] <= now:
                _, x = heapq.heappop(waiting)
                heapq.heappush(free[alone[x]], (-urgent[x], x))
            for lane in range(self.lanes.count):
                if self._free[lane] > now or (lane and self._draining):
                    continue
                chosen = next_for(lane, now)
                if chosen is None:
                    continue
                node = made(chosen[0])
                if node.mode == "START":
                    copy = next(c for c, left_there in busy[node.unit].items() if not left_there)
                    self._copy[chosen] = copy
                    busy[node.unit][copy] = takes[chosen]
                last = self._put(chosen, node, lane, now)
                left -= 1
                self.ready[chosen] = last + self.lanes.latency(node)
                if node.terms[0].kind == "TAKE":
                    copy = self._copy[self._item(node.terms[0].a, chosen[1])]
                    busy[node.unit][copy] -= 1
                    if not busy[node.unit][copy]:
                        for entry in blocked[node.unit]:
                            heapq.heappush(free[self.lanes.count > 1], entry)
                        blocked[node.unit] = []
                for u in users[chosen]:
                    missing[u] -= 1
                    if not missing[u]:
                        offer(u)
                for u in later[chosen]:
                    missing[u] -= 1
                    earliest_after[u] = max(earliest_after[u], last + 1)
                    if not missing[u]:
                        offer(u)
            now += 1
            if not (free[False] or free[True]) and waiting:
                now = max(now, waiting[0][0])
            elif min(self._free) > now:
                now = min(self._free)

    def _fits(self, x: Item, node: Sum, now: int) -> bool:
        """Whether a bank is free when a sum is written, and all lanes are if it repeats a term."""
        if self.lanes.count == 1:
            return True
        if _repeated(node):
            return max(self._free) <= now
        return not _writes(node) or self._bank(x, now + len(node.terms) - 1) is not None

    def _bank(self, x: Item, cycle: int) -> int | None:
        """A bank that can take the word of a sum whose last term is begun in that cycle."""
        taken = self._writes.get(cycle, set())
        if self.made(x[0]).mode == "INDEX":
            return None if _INDEX in taken else _INDEX
        taken = taken - {_INDEX}
        wanted = self.bank(x)
        if wanted == ALL:
            return None if taken else ALL
        return next(
            (
                b
                for b in range(self.lanes.banks)
                if b not in taken and ALL not in taken and wanted in (None, b)
            ),
            None,
        )

    def _put(self, x: Item, node: Sum, lane: int, now: int) -> int:
        """Begin a sum; gives the cycle of its last term."""
        start = node.mode == "START"
        paired = start and UNITS[node.unit] in PAIRED
        terms = [node.terms[k] for k in self._start(x)[1]]
        end = now + _length(node) - 1
        bank = 0
        if _writes(node) and not _repeated(node):
            found = self._bank(x, end)
            assert found is not None
            self._writes.setdefault(end, set()).add(found)
            bank = max(found, 0)
        elif _writes(node) and node.mode != "INDEX":
            bank = self.bank(x) or 0
        asked = self._item(node.terms[0].a, x[1]) if node.terms[0].kind == "TAKE" else x
        copy = self._copy.get(asked, 0)
        for k, term in enumerate(terms):
            last = k == len(terms) - 1
            mode = node.mode if last else "HOLD" if paired else ""
            write = x[0] if last and not start else None
            line = self.plan.tick.line[x[0]]
            step = now + k - self._skew
            while len(self.steps) <= step:
                self.steps.append([None] * self.lanes.count)
            self.steps[step][lane] = Slot(term, k == 0 or paired, node, mode, write, line, x[1], bank, copy)
            extra = (term.times or 1) - 1
            self._skew += extra
            now += extra
        if _repeated(node):
            self._free = [end + 1] * self.lanes.count
            self._draining = False
        self._free[lane] = end + 1
        return end

    def _start(self, x: Item) -> tuple[int, list[int]]:
        """When a sum can begin, and the order of its terms: what is there last comes last."""
        n, nth = x
        node = self.made(n)
        when = [
            max(self._there(t.a, nth), 0 if t.kind == "TAKE" else self._there(t.b, nth)) for t in node.terms
        ]
        order = range(len(when)) if node.mode == "START" else sorted(range(len(when)), key=lambda k: when[k])
        return max(when[k] - n for n, k in enumerate(order)), list(order)


def _length(node: Sum) -> int:
    """Cycles that a lane begins the terms of a sum in."""
    return sum(t.times or 1 for t in node.terms)


def _repeated(node: Sum) -> bool:
    return any(t.times for t in node.terms)


def _writes(node: Sum) -> bool:
    return node.mode != "START"


def _first_lane(node: Sum) -> bool:
    """Whether a sum is made in the first lane alone."""
    return node.mode == "START" or _repeated(node) or any(t.kind in _FIRST_LANE for t in node.terms)


__all__ = [
    "ALL",
    "COPIES",
    "Item",
    "Lanes",
    "Order",
    "Slot",
    "Step",
]
