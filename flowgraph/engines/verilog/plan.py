"""What a tick needs, with what must come before what, in stages: words one by one, and loops over rows.

A stage makes words, or all rows of one length in one loop, in which each element is made of the elements
beside it. What reads a row otherwise (its sum, one of its elements, a part of it) belongs to a later stage.
Every sum comes as late as what reads it allows. The registers are written in the last stages, when nobody
reads them any more.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from flowgraph.engines.verilog.nodes import Held, Joined, Sum, Term, View
from flowgraph.engines.verilog.rows import root_of
from flowgraph.engines.verilog.tick import Tick


@dataclass(frozen=True)
class Stage:
    """Sums that are made together: `row` is the length of the rows that they are, or 0 for words."""

    row: int
    order: list[int]


class Plan:
    """The sums of a tick that something needs, with what must come before what.

    Attributes:
        fixed: sums whose word is a register's.
        outputs: words that outputs are, where they are overwritten: their copies.
        kept: words that are read after the tick.
        order: all sums that are made.
        after: for a sum that overwrites a register's word, who reads that before.
        stages: in order.
        rows: those of them that have a place for each element, with the last stage that reads them.
        joined: for a row that lies behind others, all of them.
    """

    def __init__(self, tick: Tick) -> None:
        self.tick = tick
        self.fixed: dict[int, Held] = {}
        self.outputs: dict[int, int] = {}
        self.rows: dict[int, int] = {}
        self._registers = set(tick.writes)
        self.joined = {r: x.parts for x in tick.nodes if isinstance(x, Joined) for r in x.parts}
        self._copies()
        self._live()
        self._in_stages()

    def base(self, n: int) -> int:
        """The row that a part of one is of."""
        node = self.tick.nodes[n]
        return node.of if isinstance(node, View) else n

    def sources(self, n: int) -> tuple[int, ...]:
        """What must be made before the word or row n can be read."""
        n = self.base(n)
        node = self.tick.nodes[n]
        return node.parts if isinstance(node, Joined) else (n,)

    def reads(self, node: Sum) -> Iterator[tuple[int, bool]]:
        """The words, rows and units that a sum reads, and whether each as the element beside its own."""
        for t in node.terms:
            for r in self.sources(t.a):
                yield r, r == t.a and t.kind != "GET" and not t.times
            for r in self.sources(t.b) if t.kind != "TAKE" else ():
                yield r, r == t.b and not t.times

    def class_of(self, n: int) -> int:
        """The length of the rows whose loop a sum belongs to; 0 for none."""
        node = self.tick.made(n)
        return 0 if node.gather == "running" else node.row

    def _copies(self) -> None:
        tick, nodes = self.tick, self.tick.nodes
        written = {h.value for h in self._registers}
        wanted = [
            root_of(n)
            for flag, leaves in tick.outputs
            if flag is not None
            for x in leaves
            for n in x.ravel().tolist()
        ]
        wanted += [flag for flag, _ in tick.outputs if flag is not None]
        uses: dict[int, int] = {}
        for node in nodes:
            if isinstance(node, Sum):
                for r, _ in self.reads(node):
                    uses[r] = uses.get(r, 0) + 1
        for n in [r for w in wanted for r in self.sources(w)]:
            uses[n] = uses.get(n, 0) + 1
            node = nodes[n]
            if not isinstance(node, Held) or n in self.outputs:
                continue
            if node in self._registers or (node.row and node.value in written):
                self.outputs[n] = self._copy(n, node.row)
        taken: set[int] = set()
        for held, source in tick.writes.items():
            node = nodes[source]
            alone = (
                isinstance(node, Sum) and not uses.get(source) and source not in taken and not tick.shortest
            )
            if alone and not any(isinstance(nodes[r], Held) for r, _ in self.reads(tick.made(source))):
                taken.add(source)
                self.fixed[source] = held
                continue
            if isinstance(node, Held):
                source = self._copy(source, node.row)
            self.fixed[self._copy(source, held.row)] = held

    def _copy(self, n: int, row: int) -> int:
        self.tick.line.append("registers")
        self.tick.nodes.append(Sum((Term("MUL", n, self.tick.one),), "RAW", row=row))
        return len(self.tick.nodes) - 1

    def _live(self) -> None:
        nodes = self.tick.nodes
        self.kept = {self.outputs.get(r, r) for n in self._ends() for r in self.sources(n)}
        stack = [*self.kept, *self.fixed]
        live: set[int] = set()
        while stack:
            n = stack.pop()
            node = nodes[n]
            if n in live or not isinstance(node, Sum):
                continue
            live.add(n)
            stack += [r for r, _ in self.reads(node)]
        self.order = sorted(live)
        by_held: dict[Held, list[int]] = {}
        for n in self.order:
            for r, _ in self.reads(self.tick.made(n)):
                node = nodes[r]
                if isinstance(node, Held):
                    by_held.setdefault(node, []).append(n)
        self.after = {n: [r for r in by_held.get(held, ()) if r != n] for n, held in self.fixed.items()}

    def _ends(self) -> Iterable[int]:
        for flag, leaves in self.tick.outputs:
            if flag is not None:
                yield flag
                for x in leaves:
                    yield from map(root_of, x.ravel().tolist())

    def _in_stages(self) -> None:
        made, nodes = self.tick.made, self.tick.nodes
        kinds = [0, *sorted({self.class_of(n) for n in self.order} - {0})]
        many = len(kinds)
        if many == 1:
            self.stages = [Stage(0, self.order)]
            return
        place = {row: k for k, row in enumerate(kinds)}
        depth: dict[int, int] = {}  # stages from the end; the first `many` write the registers
        takes: dict[int, list[int]] = {}
        for n in reversed(self.order):
            kind = place[self.class_of(n)]
            depth[n] = d = kind if n in self.fixed else max(depth.get(n, 0), many + kind)
            if made(n).mode == "START":
                for t in takes[n]:
                    depth[t] = d
            for r, beside in self.reads(made(n)):
                if not isinstance(nodes[r], Sum):
                    continue
                if made(r).mode == "START":
                    takes.setdefault(r, []).append(n)
                to = place[self.class_of(r)]
                least = d if to == kind and (beside or kind == 0) else d + 1
                depth[r] = max(depth.get(r, 0), least + (to - least) % many)
        orders: dict[int, list[int]] = {}
        for n in self.order:
            orders.setdefault(depth[n], []).append(n)
        self.stages = [Stage(kinds[d % many], orders[d]) for d in sorted(orders, reverse=True)]
        stage_of = {n: k for k, stage in enumerate(self.stages) for n in stage.order}
        for n in self.order:
            for r, beside in self.reads(made(n)):
                if not isinstance(nodes[r], Sum) or not made(r).row or made(r).mode == "START":
                    continue
                if stage_of[r] != stage_of[n] or not beside or self.class_of(r) == 0:
                    self.rows[r] = max(self.rows.get(r, 0), stage_of[n])
            if n in self.kept and made(n).row:
                self.rows[n] = len(self.stages)
        for n in self.fixed:
            self.rows.pop(n, None)


__all__ = ["Plan", "Stage"]
