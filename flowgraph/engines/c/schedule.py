"""When everything is computed: straight code and loops in turn.

Level by level there is straight code, then one loop for each space. An operation belongs to the first level
at which all it needs is there; what a loop sums up, or stores for a look-up, is there at the next level. So
a chain of operations over the particles is one loop up to where it needs a sum over all of them. What one
loop computes and a later one needs is kept in memory in between.

A search among sorted numbers goes from one turn to the next, so it has a loop of its own, with no more than
it needs: the turns of the others can be done together.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from flowgraph.engines.c.blocks import in_blocks
from flowgraph.engines.c.nodes import Buffer, Item, Macro, Node, Space, Store, Tape
from flowgraph.engines.c.values import row_major

Group = tuple[int, Space]
REPEATED = ("load", "iota", "const", "given")
"""Operations that a loop does again rather than read from memory."""


class Place(NamedTuple):
    """Where the numbers of a loop lie: in a buffer, from an offset on, in these steps."""

    buffer: Buffer
    offset: int
    strides: tuple[int, ...]


@dataclass
class Schedule:
    """What is computed where.

    Args:
        items: all that is needed, in order; those of a group have its level and space.
        uses: how often a node is named.
        spills: where a node of one loop is kept for later ones: where that loop stores it anyway, as a
            register's new value is, or in memory of its own.
        late: state buffers that cannot be written in place, with the work buffer that stands in.
        span: first and last level at which a work buffer is in use.
        blocks: loops that go block by block, with the product that takes each block.
    """

    items: list[Item] = field(default_factory=list)
    uses: dict[Node, int] = field(default_factory=lambda: defaultdict(int))
    spills: dict[Node, Place] = field(default_factory=dict)
    late: dict[Buffer, Buffer] = field(default_factory=dict)
    span: dict[Buffer, tuple[int, int]] = field(default_factory=dict)
    blocks: dict[Group, Macro] = field(default_factory=dict)
    levels: int = 1


def arguments(item: Item) -> tuple[Node, ...]:
    """The nodes an item names."""
    return (item.node,) if isinstance(item, Store) else item.args


def reads(item: Item) -> list[Buffer]:
    """The buffers an item reads."""
    if isinstance(item, Macro):
        return [v.buffer for v in item.inputs]
    if isinstance(item, Node) and item.op in ("load", "gather", "search"):
        return [item.extra[0]]
    return []


def group_of(item: Item) -> Group:
    """Level and space in which an item is written down; a reduction stands in the loop it sums over."""
    if isinstance(item, Node) and item.op == "reduce":
        return item.level - 1, item.extra[1]
    return item.level, () if isinstance(item, Macro) else item.space


def schedule(tape: Tape, roots: Iterable[Item], *, blocks: bool = False) -> Schedule:
    """Order what the roots need.

    Args:
        tape: of all that was made.
        roots: what is wanted.
        blocks: whether products over many places go with the loops before them, and one number of an array
            is read where a loop keeps it.
    """
    roots = list(roots)
    if blocks:
        _name_turns(_live(roots))
    made = Schedule(sorted(_live(roots), key=lambda i: i.order))
    _level(made.items)
    made.levels = 1 + max((group_of(i)[0] for i in made.items), default=0)
    users: dict[Node, list[Group]] = defaultdict(list)
    for item in made.items:
        for node in arguments(item):
            made.uses[node] += 1
            users[node].append(group_of(item))
    factors = {v.buffer for i in made.items if isinstance(i, Macro) and i.kind == "matmul" for v in i.inputs}
    kept = {
        i.node: Place(i.buffer, i.offset, i.strides)
        for i in made.items
        if isinstance(i, Store) and i.level == i.node.level and (_is_whole(i, factors) or _is_state(i))
    }
    for node, groups in users.items():
        if node.space and node.op not in REPEATED and any(g[0] > node.level for g in groups):
            own = Buffer("", node.dtype, _size(node.space), "work")
            made.spills[node] = kept.get(node) or Place(own, 0, row_major(node.space))
    _write_state(made, users)
    if blocks:
        made.blocks = in_blocks(made.items, [place.buffer for place in made.spills.values()])
    _spans(made, users)
    return made


def _is_whole(store: Store, factors: set[Buffer]) -> bool:
    """Whether it keeps its node as a spill would: all of it, in C's order.

    A row of a factor of a product does not: that factor may be no longer than a block.
    """
    buffer = store.buffer
    plain = buffer.kind == "work" and store.space == store.node.space != ()
    row = buffer in factors and buffer.size != _size(store.space)
    return plain and not row and store.strides == row_major(store.space)


def _is_state(store: Store) -> bool:
    """Whether it gives a register a new value, in the loop of its node: that stays until the next tick."""
    there = store.buffer.kind == "state" and store.space == store.node.space and len(store.space) == 1
    return there and store.node.dtype == store.buffer.dtype == "real"


def _size(space: Space) -> int:
    size = 1
    for n in space:
        size *= n
    return size


def _name_turns(items: set[Item]) -> None:
    """Make of a load of what one turn of a loop stores the number that its node has in that turn.

    Then it is read where the loop keeps it anyway, as in a register: one number is no reason to store all.
    """
    for item in items:
        if not (isinstance(item, Node) and item.op == "load" and not item.extra[2]):
            continue
        buffer, offset, _ = item.extra
        for store in buffer.writers if buffer.kind == "work" else ():
            if not (isinstance(store, Store) and len(store.space) == 1 and store.strides[0] > 0):
                continue
            turn, between = divmod(offset - store.offset, store.strides[0])
            own = store.node.space == store.space and store.node.op not in REPEATED
            if own and not between and 0 <= turn < store.space[0]:
                item.op, item.args, item.extra = "turn", (store.node,), turn


def _live(roots: Iterable[Item]) -> set[Item]:
    found: set[Item] = set()
    waiting = list(roots)
    while waiting:
        item = waiting.pop()
        if item in found:
            continue
        found.add(item)
        waiting.extend(arguments(item))
        for buffer in reads(item):
            if buffer.kind == "work":
                waiting.extend(buffer.writers)
    return found


def _level(items: list[Item]) -> None:
    """Give each its level: what stands in a loop that searches, and no search needs, comes after it."""
    least: dict[Item, int] = {}
    while True:
        for buffer in {b for i in items for b in _filled(i)}:
            buffer.ready = 0
        for item in items:
            item.level = _first_level(item, least.get(item, 0))
        rest = _beside_searches(items)
        if not rest:
            return
        least |= rest


def _first_level(item: Item, least: int) -> int:
    needed = [a.level + (a.op == "search" and a.space != ()) for a in arguments(item)]
    level = max([*needed, *(b.ready for b in reads(item))], default=0)
    level = max(level + (_is_sum(item) or _is_turn(item)), least)
    for buffer in _filled(item):
        _ready(buffer, level + 1 if isinstance(item, Store) and item.space else level)
    return level


def _filled(item: Item) -> list[Buffer]:
    if isinstance(item, Macro):
        return [item.output.buffer]
    return [item.buffer] if isinstance(item, Store) else []


def _is_sum(item: Item) -> bool:
    return isinstance(item, Node) and item.op == "reduce"


def _is_turn(item: Item) -> bool:
    return isinstance(item, Node) and item.op == "turn"


def _beside_searches(items: list[Item]) -> dict[Item, int]:
    """What stands in the first loop with a search that has more than it needs, and the level after it."""
    loops: dict[Group, list[Item]] = defaultdict(list)
    for item in items:
        level, space = group_of(item)
        if space and not (isinstance(item, Node) and item.op in REPEATED):
            loops[level, space].append(item)
    for (level, _), inside in sorted(loops.items()):
        waiting: list[Item] = [i for i in inside if isinstance(i, Node) and i.op == "search"]
        if not waiting:
            continue
        needed: set[Item] = set()
        while waiting:
            item = waiting.pop()
            if item not in needed:
                needed.add(item)
                waiting.extend(a for a in arguments(item) if a.space and a.level == level)
        rest = {i: level + 1 + _is_sum(i) for i in inside if i not in needed}
        if rest:
            return rest
    return {}


def _ready(buffer: Buffer, level: int) -> None:
    if buffer.kind == "work":
        buffer.ready = max(buffer.ready, level)


def _write_state(made: Schedule, users: dict[Node, list[Group]]) -> None:
    """Find the state that something still reads, or reads elsewhere, when it is to be written."""
    stores: dict[Buffer, list[Store]] = defaultdict(list)
    for item in made.items:
        if isinstance(item, Store) and item.buffer.kind == "state" and item.space:
            stores[item.buffer].append(item)
    for buffer, written in stores.items():
        places = {(s.offset, s.strides): group_of(s) for s in written}
        first = min(level for level, _ in places.values())
        for item in made.items:
            if buffer not in reads(item):
                continue
            if isinstance(item, Node) and item.op == "load":
                at = places.get((item.extra[1], item.extra[2]))
                ends = users[item] if item.space else []
                safe = all(g[0] < first or (at is not None and (g[0] < at[0] or g == at)) for g in ends)
                safe = safe or not any(
                    _overlap(
                        _reach(item.extra[1], item.extra[2], item.space), _reach(s.offset, s.strides, s.space)
                    )
                    for s in written
                )
            else:
                level, space = group_of(item)
                safe = level < first or (level == first and not space)
            if not safe:
                made.late[buffer] = Buffer("", buffer.dtype, buffer.size, "work")
                break


def _reach(offset: int, strides: tuple[int, ...], space: Space) -> tuple[int, int]:
    """The first and last place that is read or written in loops."""
    return offset, offset + sum(s * (n - 1) for s, n in zip(strides, space, strict=False))


def _overlap(a: tuple[int, int], b: tuple[int, int]) -> bool:
    return a[0] <= b[1] and b[0] <= a[1]


def _spans(made: Schedule, users: dict[Node, list[Group]]) -> None:
    """From where to where each work buffer is in use."""

    def extend(buffer: Buffer, *levels: int) -> None:
        first, last = made.span.get(buffer, (levels[0], levels[0]))
        made.span[buffer] = (min(first, *levels), max(last, *levels))

    for item in made.items:
        level = group_of(item)[0]
        if isinstance(item, Store) and item.buffer.kind == "work":
            extend(item.buffer, level)
        if isinstance(item, Store) and item.buffer in made.late:
            extend(made.late[item.buffer], level, made.levels)
        if isinstance(item, Macro):
            extend(item.output.buffer, level)
        for buffer in reads(item):
            if buffer.kind == "work":
                extend(buffer, level)
                if isinstance(item, Node) and item.op == "load" and item.space:
                    extend(buffer, *(g[0] for g in users[item]))
    for node, place in made.spills.items():
        if place.buffer.kind == "work":
            extend(place.buffer, node.level, *(g[0] for g in users[node]))


def is_flat(items: Iterable[Node | Store], space: Space) -> bool:
    """Whether all that a nest of loops reads and writes lies in their order, so that one loop will do."""
    for item in items:
        for part in (item, *arguments(item)):
            if isinstance(part, Node) and part.op in ("iota", "gather", "search"):
                return False
            strides = _strides(part)
            steps = zip(strides, strides[1:], space[1:], strict=False)
            if any(wide != step * n for wide, step, n in steps):
                return False
    return True


def _strides(part: Node | Store) -> tuple[int, ...]:
    """Its steps through memory in the loops around it."""
    if isinstance(part, Store):
        return part.strides
    return part.extra[2] if part.op == "load" else ()
