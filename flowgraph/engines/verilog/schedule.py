"""A tick in order of time: what is made when, and where its word lies.

Words are made one by one (`order`). A loop begins its next round at once: its words are read before they are
written again. Where a round would wait, it makes several elements at a time. Words of registers are
overwritten once nobody reads them any more in the tick, so that a tick ends with its registers in place.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace

from flowgraph.engines.verilog.latency import FETCH
from flowgraph.engines.verilog.nodes import Constant, Held
from flowgraph.engines.verilog.order import (
    ALL,
    Item,
    Lanes,
    Order,
    Slot,
    Step,
)  # fmt: skip
from flowgraph.engines.verilog.places import bank_of_row, give_places
from flowgraph.engines.verilog.plan import Plan, Stage

_LEAST = FETCH + 1
"""Microwords of a loop, since its end is decoded so much earlier."""

_ABREAST = 16
"""Elements that a round of a loop makes at most."""

_LONGEST = 2100
"""Microwords of a round, beyond which it makes no more elements at a time."""


@dataclass(frozen=True)
class Loop:
    """A microword that says how many rounds follow, and how many elements each makes."""

    last: int
    step: int = 1


@dataclass(frozen=True)
class Word:
    """What a step of the program does: what each lane begins, the head of a loop, or nothing.

    Args:
        does: that; empty for nothing.
        back: whether the loop goes on from its begin, once what was fetched is done.
        ends: whether a round ends here.
        repeat: of nothing, whether it is done as often as the head before says.
    """

    does: tuple[Slot | None, ...] | Loop = ()
    back: bool = False
    ends: bool = False
    repeat: bool = False


@dataclass
class Schedule:
    """A tick in order of time.

    Args:
        lanes: of the machine.
        words: a step each.
        cycles: that it takes.
        place: of each word that is computed and of the first of each row, relative to the first free place;
            words of registers and constants are not in it.
        size: how many places are used.
        indices: the same of indices.
        loops: of each loop its first and last step.
        repeats: whether the machine has loops.
    """

    lanes: Lanes = field(default_factory=Lanes)
    words: list[Word] = field(default_factory=list)
    cycles: int = 0
    place: dict[Item, int] = field(default_factory=dict)
    size: int = 0
    indices: int = 0
    loops: list[tuple[int, int]] = field(default_factory=list)
    repeats: bool = False

    @property
    def slots(self) -> Iterator[tuple[int, Slot]]:
        """The terms in order of time, each with its step."""
        for t, word in enumerate(self.words):
            if not isinstance(word.does, Loop):
                for slot in word.does:
                    if slot is not None:
                        yield t, slot


def schedule(
    plan: Plan,
    rows: bool = False,
    lanes: Lanes | None = None,
    held: Mapping[Held, int] | None = None,
) -> Schedule:
    """The order of a tick's sums.

    Args:
        plan: the tick.
        rows: whether the machine has loops.
        lanes: what the machine has of them; one of the shallow memory if left out.
        held: places of the words that registers are, for those that are written; all in the first bank if
            left out.
    """
    made = Schedule(lanes or Lanes(), repeats=rows)
    ready: dict[int, int] = {}  # cycles from which a word, or all of a row, can be read
    spans: list[tuple[int, int]] = []
    for stage in plan.stages:
        start = len(made.words)
        if stage.row:
            _loop(plan, stage, made, ready, held or {})
        else:
            _words(plan, stage, made, ready, held or {})
        spans.append((start, len(made.words) - 1))
    if made.words and made.words[-1].ends:  # the program halts behind its last loop
        made.words.append(Word())
        made.cycles += 1
    give_places(plan, made, spans)
    return made


def _banks(plan: Plan, lanes: Lanes, held: Mapping[Held, int], step: int) -> Callable[[Item], int | None]:
    """The bank of the word of an item, in rounds of `step` elements: that of its place, where it has one."""
    banks = lanes.banks

    def bank(x: Item) -> int | None:
        n, nth = x
        if banks == 1:
            return 0
        register = plan.fixed.get(n)
        if register is not None:
            return ALL if register.row and step % banks else (held.get(register, 0) + nth) % banks
        if n in plan.rows:
            return ALL if step % banks else (bank_of_row(plan, n) + nth) % banks
        return None

    return bank


def _words(plan: Plan, stage: Stage, made: Schedule, ready: dict[int, int], held: Mapping[Held, int]) -> None:
    """Words one by one, with terms that are many between them."""
    order = Order(
        plan, [(n, 0) for n in stage.order], ready, made.cycles, made.lanes,
        _banks(plan, made.lanes, held, 1),
    )  # fmt: skip
    last: int | None = None
    idle = 0
    for step in order.steps:
        if not any(step):
            idle += 1
            continue
        times = step[0].term.times if step[0] is not None else 0
        if times and (last != times - 1 or idle >= _LEAST):  # a wait that is repeated has a head of its own
            last = times - 1
            _wait(made, idle - 1)
            made.words.append(Word(Loop(last)))
            made.cycles += 1
        elif idle:
            last = last if _wait(made, idle) else None
        idle = 0
        made.words.append(Word(tuple(step)))
        made.cycles += times or 1
        for slot in step:
            if slot is not None and slot.writes is not None:
                ready[slot.writes] = made.cycles - 1 + made.lanes.latency(slot.node)


def _wait(made: Schedule, cycles: int) -> bool:
    """Steps that do nothing; where many can be one that is repeated, they are, and the answer is no."""
    made.cycles += max(cycles, 0)
    if cycles < _LEAST or not made.repeats:
        made.words += [Word()] * cycles
        return True
    made.words += [Word(Loop(cycles - 2)), Word(repeat=True)]
    return False


def _loop(plan: Plan, stage: Stage, made: Schedule, ready: dict[int, int], held: Mapping[Held, int]) -> None:
    """All rows of one length: a round as often as it takes."""
    step, steps = _round(plan, stage, made.lanes, held)
    made.words.append(Word(Loop(stage.row - step, step)))
    made.cycles += 1
    begin = made.cycles
    within = set(stage.order)
    for t, lanes in enumerate(steps):
        for slot in lanes:
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
    body = [Word(tuple(lanes)) for lanes in steps]
    body[-_LEAST] = replace(body[-_LEAST], back=True)
    body[-1] = replace(body[-1], ends=True)
    made.loops.append((len(made.words), len(made.words) + len(body) - 1))
    made.words += body
    made.cycles = begin + rounds * len(body)
    for t, lanes in enumerate(steps):
        for slot in lanes:
            if slot is not None and slot.writes is not None:
                at = begin + (rounds - 1) * len(body) + t + made.lanes.latency(slot.node)
                ready[slot.writes] = max(ready.get(slot.writes, 0), at)


def _round(plan: Plan, stage: Stage, lanes: Lanes, held: Mapping[Held, int]) -> tuple[int, list[Step]]:
    """How many elements a round makes, and its steps: as many as make it faster."""
    best: tuple[float, int, list[Step]] | None = None
    least = 0
    terms = sum(len(plan.tick.made(n).terms) for n in stage.order)
    bound = max(terms / lanes.count, len(stage.order) / lanes.banks)
    for step in range(1, min(_ABREAST * lanes.count, stage.row) + 1):
        if stage.row % step:
            continue
        items = [(n, k) for n in stage.order for k in range(step)]
        steps = Order(plan, items, {}, 0, lanes, _banks(plan, lanes, held, step)).steps
        pace = max(len(steps), _LEAST) / step
        longest = max(_LONGEST, 1.3 * least) if least else len(steps)
        least = least or len(steps)
        if best is None or (pace < 0.9 * best[0] and len(steps) <= longest):
            best = pace, step, steps
        if len(steps) < 1.1 * bound * step:
            break
    assert best is not None
    _, step, steps = best
    none: Step = [None] * lanes.count
    return step, steps + [none] * (_LEAST - len(steps))


__all__ = [
    "Constant", "Held", "Lanes", "Loop", "Plan", "Schedule", "Slot", "Word",
    "schedule",
]  # fmt: skip
