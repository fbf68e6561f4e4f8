"""Where computed words lie: a place of the memory is used again once its word was last read."""

from __future__ import annotations

import heapq
from typing import TYPE_CHECKING

from flowgraph.engines.verilog.order import Item
from flowgraph.engines.verilog.plan import Plan

if TYPE_CHECKING:
    from flowgraph.engines.verilog.schedule import Schedule


def give_places(plan: Plan, made: Schedule, spans: list[tuple[int, int]]) -> None:
    """Places for the words that are computed, and for rows behind them.

    Args:
        plan: the tick.
        made: its steps; gets `place`, `size` and `indices`.
        spans: of each stage the first and last step.
    """
    last = _last_reads(plan, made, spans)
    banks = made.lanes.banks
    spare: dict[tuple[bool, int], list[int]] = {}
    size: dict[tuple[bool, int], int] = {}
    ends: list[tuple[int, tuple[bool, int], int]] = []
    for t, slot in made.slots:
        n = slot.writes
        if n is None or n in plan.fixed or n in plan.rows:
            continue
        while ends and ends[0][0] <= t:
            _, pool, place = heapq.heappop(ends)
            heapq.heappush(spare.setdefault(pool, []), place)
        index = slot.mode == "INDEX"
        pool = index, slot.bank
        if spare.get(pool):
            place = heapq.heappop(spare[pool])
        else:
            count = size.get(pool, 0)
            size[pool] = count + 1
            place = count if index else count * banks + slot.bank
        made.place[(n, slot.nth)] = place
        if n not in plan.kept:
            heapq.heappush(ends, (last.get((n, slot.nth), t), pool, place))
    words = max((count * banks for (index, _), count in size.items() if not index), default=0)
    made.size = _row_places(plan, made, False, words, banks)
    made.indices = _row_places(plan, made, True, size.get((True, 0), 0), 1)


def _last_reads(plan: Plan, made: Schedule, spans: list[tuple[int, int]]) -> dict[Item, int]:
    """The step in which each word is last read; what a loop reads from before it, is read to its end."""
    end_of = {t: end for start, end in made.loops for t in range(start, end + 1)}
    within = {n: stage.row > 0 for stage in plan.stages for n in stage.order}
    stage_of = {n: k for k, stage in enumerate(plan.stages) for n in stage.order}
    at_stage = [k for k, (start, end) in enumerate(spans) for _ in range(start, end + 1)]
    last: dict[Item, int] = {}
    for t, slot in made.slots:
        for n in (slot.term.a, *(() if slot.term.kind == "TAKE" else (slot.term.b,))):
            n = plan.base(n)
            if within.get(n) and stage_of[n] == at_stage[t]:
                last[(n, slot.nth)] = t
            else:  # read again in each round
                last[(n, 0)] = end_of.get(t, t)
    return last


def bank_of_row(plan: Plan, n: int) -> int:
    """How far a computed row lies behind a place that begins in the first bank."""
    ahead = 0
    for r in plan.joined.get(n, (n,)):
        if r == n:
            break
        if r in plan.rows:
            ahead += plan.tick.made(r).row
    return ahead


def _row_places(plan: Plan, made: Schedule, index: bool, first: int, banks: int) -> int:
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
            size += -size % banks
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
    return most + -most % banks
