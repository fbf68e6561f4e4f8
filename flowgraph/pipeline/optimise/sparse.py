"""Zeros of larger factors: a product of matrices for backends that multiply what is there, and nothing else.

A Jacobian of a navigation filter is mostly zeros and ones, and some of its elements are numbers that the
list has made as scalars already. Here the products stay whole; the factor is told element by element, and a
backend may leave out what is zero, in one loop along the other factor. `structure` gets there by cutting a
product into smaller ones, which makes more code.

A symmetric product A P A^T is the same as A (A P)^T. Written so, both products have the factor with the zeros
at the left, and what such a loop makes lies along the rows.
"""

from __future__ import annotations

import numpy as np

from flowgraph.pipeline.optimise.draft import Draft
from flowgraph.pipeline.optimise.elements import Table
from flowgraph.pipeline.optimise.facts import Facts, facts_of
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction

SMALL = 64
"""Multiplications of a product that is not looked at: any backend takes it as it is."""

MOST_LEFT = 0.5
"""Of the elements of a factor that may be other than zero."""


def tell_zeros(program: Program) -> Program:
    """Say of the factors of larger products what each element is, where half of them or more are zero."""
    if not any(_is_large(program, i) for i in program.instructions):
        return program
    facts, draft = facts_of(program), Draft(program)
    found: dict[int, Table] = {}
    for i in program.instructions:
        if _is_large(program, i):  # a factor's first product says: later there are scalars it cannot name
            new = [n for n in i.args if n not in found]
            found |= {n: table for n in new if (table := _told(facts, draft, n)) is not None}
        draft.keep(i)
    return draft.done(found)


def mirror_products(program: Program) -> Program:
    """Write A P A^T as A (A P)^T where P is symmetric for certain and half of A or more is zero."""
    if not any(_is_large(program, i) for i in program.instructions):
        return program
    facts, draft = facts_of(program), Draft(program)
    for i in program.instructions:
        turned = _is_large(program, i) and facts.is_congruence(i.args)
        if turned and _told(facts, draft, i.args[1]) is not None:
            first, second = (draft.emit("matrix_transpose", n, by=i) for n in draft.args(i)[::-1])
            draft.replace(i.out, draft.emit("matmul", first, second, by=i))
        else:
            draft.keep(i)
    return draft.done()


def _is_large(program: Program, i: Instruction) -> bool:
    if i.op != "matmul" or len(i.spec.shape) != 2 or i.spec.dtype != "real":
        return False
    a, b = (program.specs[n].shape for n in i.args)
    return len(a) == len(b) == 2 and a[0] * a[1] * b[1] > SMALL


def _told(facts: Facts, draft: Draft, value: int) -> Table | None:
    """What each element of a factor is, where it is mostly zero; see `Program.elements`."""
    names = facts.table(value)
    if names is None or names.shape != draft.program.specs[value].shape:
        return None
    if sum(facts.number(name) != 0.0 for name in names.flat) > MOST_LEFT * names.size:
        return None
    table = np.empty(names.shape, object)
    for at in np.ndindex(names.shape):
        name = int(names[at])
        number = facts.number(name)
        table[at] = facts.scalar(name, draft) if number is None else number
    return table
