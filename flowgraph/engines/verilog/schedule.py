"""When each sum is made, and where its word lies: list scheduling on one lane, and memory used again.

A sum of n terms takes n cycles one after the other; its word can be read some cycles after the last. Of the
sums that could be made, the one goes first from which the way to the end is longest. A loop begins its next
round at once: its words are read before they are written again. Where a round would wait, it makes several
elements at a time. Words of registers are overwritten once nobody reads them any more in the tick, so that a
tick ends with its registers in place.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field, replace

from flowgraph.engines.verilog.nodes import UNITS, Constant, Held, Sum, Term
from flowgraph.engines.verilog.plan import Plan, Stage

LATENCY = 23
"""Cycles from the microword that writes a word to the first that can read it."""

AHEAD = 4
"""Cycles more until an index can be read: the places of words are worked out before they are read."""

UNIT_LATENCY = {"divide": 45, "root": 45, "logarithm": 193, "angle": 93}
"""Cycles from the microword that starts a unit to the first that can take what it made."""

_LEAST = 4
"""Microwords of a loop, since its end is decoded so much earlier."""

_ABREAST = 16
"""Elements that a round of a loop makes at most."""

_LONGEST = 2100
"""Microwords of a round, beyond which it makes no more elements at a time."""

Item = tuple[int, int]
"""A sum and which of the elements of a round it makes."""


@dataclass(frozen=True)
class Slot:
    """One microword: a term of a sum; `writes` is the number of the word that the last term of it makes."""

    term: Term
    first: bool
    node: Sum
    mode: str
    writes: int | None
    line: str
    nth: int = 0


@dataclass(frozen=True)
class Loop:
    """A microword that says how many rounds follow, and how many elements each makes."""

    last: int
    step: int = 1


@dataclass(frozen=True)
class Word:
    """What a step of the program does: a term, the head of a loop, or nothing.

    Args:
        does: that.
        back: whether the loop goes on from its begin, in three steps.
        ends: whether a round ends here.
        repeat: of nothing, whether it is done as often as the head before says.
    """

    does: Slot | Loop | None = None
    back: bool = False
    ends: bool = False
    repeat: bool = False


@dataclass
class Schedule:
    """A tick in order of time.

    Args:
        words: a step each.
        cycles: that it takes.
        place: of each word that is computed and of the first of each row, relative to the first free place;
            words of registers and constants are not in it.
        size: how many places are used.
        index: the same of indices, and how many.
        loops: of each loop its first and last step.
        repeats: whether the machine has loops.
    """

    words: list[Word] = field(default_factory=list)
    cycles: int = 0
    place: dict[Item, int] = field(default_factory=dict)
    size: int = 0
    indices: int = 0
    loops: list[tuple[int, int]] = field(default_factory=list)
    repeats: bool = False

    @property
    def slots(self) -> list[Slot | None]:
        """The term of each step."""
        return [w.does if isinstance(w.does, Slot) else None for w in self.words]


def schedule(plan: Plan, rows: bool = False) -> Schedule:
    """The order of a tick's sums, for a machine with rows or without."""
    made = Schedule(repeats=rows)
    ready: dict[int, int] = {}  # cycles from which a word, or all of a row, can be read
    spans: list[tuple[int, int]] = []
    for stage in plan.stages:
        start = len(made.words)
        if stage.row:
            _loop(plan, stage, made, ready)
        else:
            _words(plan, stage, made, ready)
        spans.append((start, len(made.words) - 1))
    if made.words and made.words[-1].ends:  # the program halts behind its last loop
        made.words.append(Word())
        made.cycles += 1
    _places(plan, made, spans)
    return made


def _words(plan: Plan, stage: Stage, made: Schedule, ready: dict[int, int]) -> None:
    """Words one by one, with terms that are many between them."""
    order = _Order(plan, [(n, 0) for n in stage.order], ready, made.cycles)
    last: int | None = None
    idle = 0
    for slot in order.slots:
        if slot is None:
            idle += 1
            continue
        if slot.term.times and last != slot.term.times - 1:
            last = slot.term.times - 1
            _wait(made, idle - 1)
            made.words.append(Word(Loop(last)))
            made.cycles += 1
        elif idle:
            last = last if _wait(made, idle) else None
        idle = 0
        made.words.append(Word(slot))
        made.cycles += slot.term.times or 1
        if slot.writes is not None:
            ready[slot.writes] = made.cycles - 1 + _latency(slot.node)


def _wait(made: Schedule, cycles: int) -> bool:
    """Steps that do nothing; where many can be one that is repeated, they are, and the answer is no."""
    made.cycles += max(cycles, 0)
    if cycles < _LEAST or not made.repeats:
        made.words += [Word()] * cycles
        return True
    made.words += [Word(Loop(cycles - 2)), Word(repeat=True)]
    return False


def _loop(plan: Plan, stage: Stage, made: Schedule, ready: dict[int, int]) -> None:
    """All rows of one length: a round as often as it takes."""
    best: tuple[float, int, _Order] | None = None
    least = 0
    for step in range(1, min(_ABREAST, stage.row) + 1):
        if stage.row % step:
            continue
        order = _Order(plan, [(n, k) for n in stage.order for k in range(step)], {}, 0)
        pace = max(len(order.slots), _LEAST) / step
        longest = max(_LONGEST, 1.3 * least) if least else len(order.slots)
        least = least or len(order.slots)
        if best is None or (pace < 0.9 * best[0] and len(order.slots) <= longest):
            best = pace, step, order
        terms = sum(len(plan.tick.made(n).terms) for n in stage.order)
        if len(order.slots) < 1.1 * terms * step:
            break
    assert best is not None
    _, step, order = best
    slots = order.slots + [None] * (_LEAST - len(order.slots))
    made.words.append(Word(Loop(stage.row - step, step)))
    made.cycles += 1
    begin = made.cycles
    within = set(stage.order)
    for t, slot in enumerate(slots):
        if slot is not None:
            for n, _ in plan.reads(slot.node):
                if n not in within:
                    begin = max(begin, ready.get(n, 0) - t)
    wait = begin - made.cycles
    head = made.words.pop()
    made.cycles -= 1
    _wait(made, wait)
    made.words.append(head)
    rounds = stage.row // step
    body = [Word(slot) for slot in slots]
    body[-_LEAST] = replace(body[-_LEAST], back=True)
    body[-1] = replace(body[-1], ends=True)
    made.loops.append((len(made.words), len(made.words) + len(body) - 1))
    made.words += body
    made.cycles = begin + rounds * len(body)
    for t, slot in enumerate(slots):
        if slot is not None and slot.writes is not None:
            at = begin + (rounds - 1) * len(body) + t + _latency(slot.node)
            ready[slot.writes] = max(ready.get(slot.writes, 0), at)


class _Order:
    """The order of sums that are made together: `slots`, a microword a cycle, None where nothing begins."""

    def __init__(self, plan: Plan, items: list[Item], ready: dict[int, int], now: int) -> None:
        self.plan = plan
        self.nodes, self.made = plan.tick.nodes, plan.tick.made
        self.slots: list[Slot | None] = []
        self.now = 0  # in cycles
        self.ready: dict[Item, int] = {}
        within = set(items)
        for n, _ in items:
            for r, _ in plan.reads(self.made(n)):
                if (r, 0) not in within and r in ready:
                    self.ready[(r, 0)] = max(ready[r] - now, 0)
        self.within = within
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
            urgent[x] = behind + _latency(node) + sum(t.times or 1 for t in node.terms)
        takes = {x: len(users[x]) for x in items if made(x[0]).mode == "START"}
        waiting: list[tuple[int, Item]] = []
        free: list[tuple[int, Item]] = []
        blocked: dict[int, list[tuple[int, Item]]] = {k: [] for k in range(len(UNITS))}
        busy = dict.fromkeys(range(len(UNITS)), 0)
        earliest_after: dict[Item, int] = dict.fromkeys(items, 0)

        def offer(x: Item) -> None:
            heapq.heappush(waiting, (max(self._start(x)[0], earliest_after[x]), x))

        for x in items:
            if missing[x] == 0:
                offer(x)
        left = len(items)
        while left:
            while waiting and waiting[0][0] <= self.now:
                _, x = heapq.heappop(waiting)
                heapq.heappush(free, (-urgent[x], x))
            if not free:
                self.slots += [None] * (waiting[0][0] - self.now)
                self.now = waiting[0][0]
                continue
            _, x = heapq.heappop(free)
            node = made(x[0])
            if node.mode == "START":
                if busy[node.unit]:
                    blocked[node.unit].append((-urgent[x], x))
                    continue
                busy[node.unit] = takes[x]
            self._put(x, node)
            left -= 1
            self.ready[x] = self.now - 1 + _latency(node)
            if node.terms[0].kind == "TAKE":
                busy[node.unit] -= 1
                if not busy[node.unit]:
                    for one in blocked[node.unit]:
                        heapq.heappush(free, one)
                    blocked[node.unit] = []
            for u in users[x]:
                missing[u] -= 1
                if not missing[u]:
                    offer(u)
            for u in later[x]:
                missing[u] -= 1
                earliest_after[u] = max(earliest_after[u], self.now)
                if not missing[u]:
                    offer(u)

    def _put(self, x: Item, node: Sum) -> None:
        start = node.mode == "START"
        terms = node.terms if start else [node.terms[k] for k in self._start(x)[1]]
        for k, term in enumerate(terms):
            last = k == len(terms) - 1
            mode = node.mode if last else "HOLD" if start else ""
            write = x[0] if last and not start else None
            line = self.plan.tick.line[x[0]]
            self.slots.append(Slot(term, k == 0 or start, node, mode, write, line, x[1]))
            self.now += term.times or 1

    def _start(self, x: Item) -> tuple[int, list[int]]:
        """When a sum can begin, and the order of its terms: what is there last comes last."""
        n, nth = x
        node = self.made(n)
        when = [
            max(self._there(t.a, nth), 0 if t.kind == "TAKE" else self._there(t.b, nth)) for t in node.terms
        ]
        order = range(len(when)) if node.mode == "START" else sorted(range(len(when)), key=lambda k: when[k])
        return max(when[k] - n for n, k in enumerate(order)), list(order)


def _latency(node: Sum) -> int:
    """Cycles from the last microword of a sum to the first that can read it."""
    if node.mode == "START":
        return UNIT_LATENCY[UNITS[node.unit]]
    return LATENCY + AHEAD * (node.mode == "INDEX")


def _places(plan: Plan, made: Schedule, spans: list[tuple[int, int]]) -> None:
    """Places for the words that are computed; a place is used again once its word was last read."""
    end_of = {t: end for start, end in made.loops for t in range(start, end + 1)}
    within = {n: stage.row > 0 for stage in plan.stages for n in stage.order}
    stage_of = {n: k for k, stage in enumerate(plan.stages) for n in stage.order}
    at_stage = [k for k, (start, end) in enumerate(spans) for _ in range(start, end + 1)]
    last: dict[Item, int] = {}
    for t, slot in enumerate(made.slots):
        if slot is None:
            continue
        for n in (slot.term.a, *(() if slot.term.kind == "TAKE" else (slot.term.b,))):
            n = plan.base(n)
            if within.get(n) and stage_of[n] == at_stage[t]:
                last[(n, slot.nth)] = t
            else:  # read again in each round
                last[(n, 0)] = end_of.get(t, t)
    spare: dict[bool, list[int]] = {False: [], True: []}
    size = {False: 0, True: 0}
    ends: list[tuple[int, bool, int]] = []
    for t, slot in enumerate(made.slots):
        n = None if slot is None else slot.writes
        if slot is None or n is None or n in plan.fixed or n in plan.rows:
            continue
        while ends and ends[0][0] <= t:
            _, index, place = heapq.heappop(ends)
            heapq.heappush(spare[index], place)
        index = slot.mode == "INDEX"
        if spare[index]:
            place = heapq.heappop(spare[index])
        else:
            place = size[index]
            size[index] += 1
        made.place[(n, slot.nth)] = place
        if n not in plan.kept:
            heapq.heappush(ends, (last.get((n, slot.nth), t), index, place))
    for index in (False, True):
        size[index] = _row_places(plan, made, index, size[index])
    made.size, made.indices = size[False], size[True]


def _row_places(plan: Plan, made: Schedule, index: bool, first: int) -> int:
    """Places for rows, behind the words: where there is room between those that are still read."""
    used: list[tuple[int, int, int]] = []  # first place, the one behind the last, and the last stage
    most = first
    for k, stage in enumerate(plan.stages):
        used = [u for u in used if u[2] >= k]
        for n in stage.order:
            node = plan.tick.made(n)
            if n not in plan.rows or (node.mode == "INDEX") != index or (n, 0) in made.place:
                continue
            parts = [r for r in plan.joined.get(n, (n,)) if r in plan.rows]
            size = sum(plan.tick.made(r).row for r in parts)
            place = first
            for start, end, _ in sorted(used):
                if place + size <= start:
                    break
                place = max(place, end)
            used.append((place, place + size, max(plan.rows[r] for r in parts)))
            for r in parts:
                made.place[(r, 0)] = place
                place += plan.tick.made(r).row
            most = max(most, place)
    return most


__all__ = ["AHEAD", "LATENCY", "Constant", "Held", "Loop", "Plan", "Schedule", "Slot", "Word", "schedule"]
