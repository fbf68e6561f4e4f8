"""Two tables that are read at one place as one of twice the width.

A processor reads from a table element by element, however long its vectors are. So start and slope of the
segments from which normal numbers are made, two int32 tables, become one of int64, which is read once.
"""

from __future__ import annotations

import math
from collections import defaultdict

import numpy as np

from flowgraph.engines.c.values import LONG
from flowgraph.pipeline.optimise.draft import LARGEST_CONSTANT, Draft
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction


def join_tables(program: Program) -> Program:
    """The program in which two constant int32 tables that are read at the same many places are one."""
    found: dict[tuple[int, int], list[Instruction]] = defaultdict(list)
    for i in program.instructions:
        if i.op == "take" and _is_table(program, i) and math.prod(i.spec.shape) > LONG:
            found[i.args[1], len(program.constants[i.args[0]])].append(i)
    pairs = [(a, b) for (_, n), some in found.items() for a, b in zip(some[::2], some[1::2], strict=False)]
    if not pairs:
        return program
    partner = {a.out: b for a, b in pairs}
    draft, upper = Draft(program), dict[int, int]()
    for i in program.instructions:
        if i.out in upper:
            draft.replace(i.out, upper[i.out])
        elif i.out in partner:
            low, high = (program.constants[x.args[0]].astype(np.int64) for x in (i, partner[i.out]))
            table = draft.constant(high << 32 | low & 0xFFFFFFFF, "int64")
            both = draft.emit("take", table, draft.now(i.args[1]), by=i, axis=0)
            shifted = draft.emit("bitwise_right_shift", both, draft.constant(32, "int64"), by=i)
            upper[partner[i.out].out] = draft.emit("astype", shifted, by=i, dtype="int32")
            draft.replace(i.out, draft.emit("astype", both, by=i, dtype="int32"))
        else:
            draft.keep(i)
    return draft.done()


def _is_table(program: Program, i: Instruction) -> bool:
    table = program.constants.get(i.args[0])
    return (
        table is not None and table.ndim == 1 and table.dtype == np.int32 and table.size <= LARGEST_CONSTANT
    )
