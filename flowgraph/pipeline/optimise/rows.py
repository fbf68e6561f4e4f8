"""Rows: rotations and cross products of many particles become sums of rows of one number a particle.

A backend that computes loop by loop over whole arrays writes what lies between two loops to memory, and puts
rows together (`concat`, a product with a matrix of signs) by a loop of its own. Taken apart, as `unroll` does
it, they are sums that one loop computes. Only such rearrangements are taken apart and the arithmetic right
around them, not what is the same for each element anyway. A row that is dear and needed more than once is
marked `materialise`, or such a backend would compute it in each loop that needs it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.pipeline.optimise.elements import MOVES, Table
from flowgraph.pipeline.optimise.unroll import LARGEST_WORK, Unroller
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction

LEAST_LANES = 512
"""Particles from which on a row is worth a loop."""

_LARGEST_ARRAY = 16
_DEAR = 16
"""Operations a number, above which a row that is needed again is kept."""

_PLAIN = MOVES | {"add", "subtract", "multiply", "negative"}


class _Rows(Unroller):
    def __init__(self, program: Program) -> None:
        lanes = frozenset(n for n in program.lanes if n >= LEAST_LANES)
        super().__init__(program, LARGEST_WORK, lanes)
        self.cost: dict[int, int] = {}
        self.chosen = self._chosen()

    def expanded(self, i: Instruction) -> Table | None:
        return super().expanded(i) if i.out in self.chosen else None

    def make(self, op: str, *entries: Any, **attrs: Any) -> int:
        made = super().make(op, *entries, **attrs)
        if op != "constant":
            self.cost[made] = 1 + sum(self.cost.get(e, 0) for e in entries if isinstance(e, int))
        return made

    def settled(self, i: Instruction, table: Table) -> None:
        users = len(self.program.users.get(i.out, ()))
        dear = any(self.cost.get(e, 0) >= _DEAR for e in table.flat if isinstance(e, int))
        if not (users and i.out in self.program.writes) and not (users > 1 and dear):
            return
        kept: dict[int, int] = {}
        own = self.tables[i.out] = table.copy()  # another value's may be a view of the same
        for at in np.ndindex(table.shape):
            entry = self.entry(table[at])
            if self.elements.laned(self.draft.specs[entry]):
                if entry not in kept:
                    kept[entry] = self.draft.emit("materialise", entry, by=i)
                own[at] = kept[entry]

    def _chosen(self) -> set[int]:
        """What puts rows together, what only such instructions use, and what is computed of the result."""
        program, users = self.program, self.program.users
        able = [i for i in program.instructions if self._can(i)]
        found = {i.out for i in able if i.op in ("concat", "stack", "matmul")}
        before = -1
        while before != len(found):
            before = len(found)
            for i in able:
                if any(a in found and a not in program.writes for a in i.args):
                    found.add(i.out)
            for i in reversed(able):
                used = users.get(i.out, ())
                if used and i.out not in program.writes and all(u.out in found for u in used):
                    found.add(i.out)
        return found

    def _can(self, i: Instruction) -> bool:
        if not self.elements.laned(i.spec) or i.spec.dtype != "real":
            return False
        if i.op == "matmul":
            signs = self.program.constants.get(i.args[0])
            return signs is not None and signs.ndim == 2 and bool(np.isin(signs, (-1.0, 0.0, 1.0)).all())
        return i.op in _PLAIN and self.elements.count(i.out) <= _LARGEST_ARRAY


def take_rows(program: Program) -> Program:
    """Take apart what puts rows of many particles together."""
    return _Rows(program).run()
