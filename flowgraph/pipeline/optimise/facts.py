"""What is known of the elements of each small array: which are zero or one, which are equal to which.

Every element gets a name: a constant, an input's element, or the operation that makes it from other names.
Two elements of one name are the same number. So a zero block, an identity times a number, and a symmetric
matrix all show in the names, through any amount of `concat`, `reshape` and arithmetic.
"""

from __future__ import annotations

import numpy as np

from flowgraph.pipeline.optimise.draft import Draft
from flowgraph.pipeline.optimise.elements import Elements, Table
from flowgraph.pipeline.optimise.simple import COMMUTATIVE
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec

LARGEST = 1024
"""Elements above which an array's are not told apart."""

ZERO, ONE = 0, 1


class _Names(Elements):
    """Entries are numbers of names."""

    def __init__(self, program: Program) -> None:
        self._numbers: dict[object, int] = {("constant", 0.0): ZERO, ("constant", 1.0): ONE}
        self._constants: dict[int, float] = {ZERO: 0.0, ONE: 1.0}
        super().__init__(program.specs, program.lanes, self.name)

    def number(self, key: object) -> int:
        return self._numbers.setdefault(key, len(self._numbers))

    def known(self, name: int) -> float | None:
        return self._constants.get(name)

    def constant(self, value: float) -> int:
        name = self.number(("constant", value) if value == value else ("not a number",))
        self._constants[name] = value
        return name

    def name(self, op: str, *entries: int, **attrs: object) -> int:
        if op == "constant":
            return self.constant(float(entries[0]))
        a, b = (*entries, -1, -1)[:2]
        if op == "multiply":
            if ZERO in (a, b):
                return ZERO
            if ONE in (a, b):
                return b if a == ONE else a
        elif op == "add" and ZERO in (a, b):
            return b if a == ZERO else a
        elif (op == "subtract" and b == ZERO) or (op == "divide" and b == ONE) or op in ("materialise",):
            return a
        elif (op in ("negative", "sqrt", "abs") and a == ZERO) or (op == "divide" and a == ZERO):
            return ZERO
        elif op == "astype":
            if a in (ZERO, ONE):
                return a
        elif op == "where" and entries[1] == entries[2]:
            return entries[1]
        if op in COMMUTATIVE:
            entries = tuple(sorted(entries))
        return self.number((op, entries, tuple(attrs.items())))

    def dot(self, left: list[int], right: list[int]) -> int:
        """One name for the whole sum: its products, in any order."""
        pairs = [(a, b) for a, b in zip(left, right, strict=True) if a != ZERO and b != ZERO]
        if len(pairs) < 2:
            return self.name("multiply", *pairs[0]) if pairs else ZERO
        return self.number(("dot", tuple(sorted(tuple(sorted(p)) for p in pairs))))


class Facts:
    """The tables of names of a program.

    Args:
        program: what to look at.
        symmetric: reads of registers that are taken to be symmetric.
    """

    def __init__(self, program: Program, symmetric: frozenset[int] = frozenset()) -> None:
        self.specs = program.specs
        self._names = _Names(program)
        self._tables: dict[int, Table | None] = {}
        for n, array in program.constants.items():
            if array.size <= LARGEST and not self._names.laned(Spec(array.shape, "real")):
                table = np.empty(array.shape, object)
                for at in np.ndindex(array.shape):
                    table[at] = self._names.constant(float(array[at]))
                self._tables[n] = table
        for n in symmetric:
            self._tables[n] = mirrored(self._fresh(n))
        self._made = {i.out: i for i in program.instructions}
        for i in program.instructions:
            if self._names.count(i.out) > LARGEST:
                continue
            arguments = [self.table(a) for a in i.args]
            found = None
            if all(t is not None for t in arguments):
                found = self._names.expand(i, [t for t in arguments if t is not None])
            if found is not None and i.op == "matmul" and self.is_congruence(i.args):
                found = mirrored(found)
            self._tables[i.out] = self._fresh(i.out) if found is None else found
        self._scalars: dict[int, list[int]] = {}
        for value, names in self._tables.items():
            if names is not None and self.specs[value].shape == ():
                self._scalars.setdefault(int(names[()]), []).append(value)

    def table(self, value: int) -> Table | None:
        """The names of a value's elements; None where it is too large."""
        if value not in self._tables:
            small = self._names.count(value) <= LARGEST
            self._tables[value] = self._fresh(value) if small else None
        return self._tables[value]

    def _fresh(self, value: int) -> Table:
        table = np.empty(self._names.shape(self.specs[value]), object)
        for at in np.ndindex(table.shape):
            table[at] = self._names.number(("element", value, at))
        return table

    def number(self, name: int) -> float | None:
        """The number that elements of a name are, where it is known."""
        return self._names.known(name)

    def scalar(self, name: int, draft: Draft) -> int | None:
        """A scalar of that name which a draft has by now, as its number there."""
        for value in self._scalars.get(name, ()):
            if value in draft.made or value not in self._made:
                return draft.now(value)
        return None

    def is_symmetric(self, value: int) -> bool:
        """Whether a value is a symmetric matrix for certain."""
        table = self.table(value)
        return table is not None and self.specs[value].shape == table.shape and _symmetric(table)

    def is_congruence(self, args: tuple[int, ...]) -> bool:
        """Whether matmul of these is A P A^T with a symmetric P, as the product of A P and A^T."""
        inner = self._made.get(args[0])
        if inner is None or inner.op != "matmul":
            return False
        left, middle = inner.args
        a, b = self.table(left), self.table(args[1])
        if a is None or b is None or a.ndim != 2 or a.shape != self.specs[left].shape:
            return False
        return b.shape == a.T.shape and bool((b == a.T).all()) and self.is_symmetric(middle)


def facts_of(program: Program) -> Facts:
    """The facts, with those registers taken as symmetric that begin so and are written back so."""
    assumed = program.symmetric
    while True:
        facts = Facts(program, assumed)
        written = dict(zip(program.reads, program.writes, strict=True))
        kept = frozenset(n for n in assumed if facts.is_symmetric(written[n]))
        if kept == assumed:
            return facts
        assumed = kept


def mirrored(table: Table) -> Table:
    """The table of a symmetric matrix: what is below the diagonal is as above."""
    out = table.copy()
    for r, c in np.ndindex(table.shape):
        out[r, c] = table[min(r, c), max(r, c)]
    return out


def _symmetric(table: Table) -> bool:
    return table.ndim == 2 and table.shape[0] == table.shape[1] and bool((table == table.T).all())
