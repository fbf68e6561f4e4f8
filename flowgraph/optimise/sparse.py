"""Zeros of larger factors: a product of matrices for backends that multiply what is there, and nothing else.

A Jacobian of a navigation filter is mostly zeros and ones, and some of its elements are numbers that the list
has made as scalars already. Here the products stay whole; the factor is told element by element, and a backend
may leave out what is zero, with one loop along the other factor. `structure` gets there by cutting a product
into smaller ones, which makes more code.

A symmetric product A P A^T is written as A (A P)^T, the same by symmetry: then both products have the factor
with the zeros at the left, and what is made lies along the rows.
"""

from __future__ import annotations

import numpy as np

from flowgraph.optimise.draft import Draft
from flowgraph.optimise.elements import Table
from flowgraph.optimise.facts import Facts, facts_of
from flowgraph.program import Program
from flowgraph.symbolic import Instruction

SMALL = 64
"""Multiplications of a product that is not looked at: any backend takes it as it is."""

MOST_LEFT = 0.5
"""Of the elements of a factor that may be other than zero."""


def tell_zeros(program: Program) -> Program:
    """Say of the factors of larger products which elements are zero, where half of them or more are."""
    if not any(_is_large(program, i) for i in program.instructions):
        return program
    facts = facts_of(program)
    draft = Draft(program)
    found: dict[int, Table] = dict(program.elements)
    for i in program.instructions:
        sides = [_told(facts, draft, n) for n in i.args] if _is_large(program, i) else [None, None]
        left, right = sides[0], sides[-1]
        if right is not None and left is None and facts.is_congruence(i.args):
            first, second = (draft.emit("matrix_transpose", n, by=i) for n in draft.args(i)[::-1])
            found[first] = right.T
            draft.replace(i.out, draft.emit("matmul", first, second, by=i))
            continue
        for n, table in zip(draft.args(i), sides, strict=False):
            if table is not None:
                found[n] = table
        draft.keep(i)
    return draft.done(found)


def _is_large(program: Program, i: Instruction) -> bool:
    if i.op != "matmul" or len(i.spec.shape) != 2 or i.spec.dtype != "real":
        return False
    shapes = [program.specs[n].shape for n in i.args]
    return all(len(s) == 2 for s in shapes) and shapes[0][0] * shapes[0][1] * shapes[1][1] > SMALL


def _told(facts: Facts, draft: Draft, value: int) -> Table | None:
    """What each element of a factor is, where it is mostly zero."""
    names = facts.table(value)
    if names is None or names.shape != draft.program.specs[value].shape:
        return None
    table = np.empty(names.shape, object)
    for at in np.ndindex(names.shape):
        number = facts.number(names[at])
        table[at] = facts.scalar(names[at], draft) if number is None else number
    left = sum(e != 0.0 or not isinstance(e, float) for e in table.flat)
    return table if left <= MOST_LEFT * table.size else None
