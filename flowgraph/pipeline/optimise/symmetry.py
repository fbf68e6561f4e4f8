"""Symmetric products once: A P A^T has as many different elements as are on one side of its diagonal.

P is known to be symmetric where it is a sum of a matrix and its transpose, or a register that begins
symmetric and is written back so. Then only the part above the diagonal is computed, and the rest is mirrored.
"""

from __future__ import annotations

import math

from flowgraph.pipeline.optimise.blocks2d import block
from flowgraph.pipeline.optimise.draft import Draft
from flowgraph.pipeline.optimise.facts import facts_of
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction

_BANDS = 5


def halve_products(program: Program, *, largest: int = 0, banded: bool = True) -> Program:
    """Compute one half of each product that is known to be symmetric.

    Args:
        program: what to rewrite.
        largest: a product of at most so many multiplications is only marked, by an upper triangle and its
            mirror: unrolling it then leaves the other half unused.
        banded: compute a larger one in bands of rows; else it stays whole.
    """
    facts = facts_of(program)
    draft = Draft(program)
    for i in program.instructions:
        if i.op != "matmul" or len(i.spec.shape) != 2 or not facts.is_congruence(i.args):
            draft.keep(i)
        elif program.specs[i.args[0]].shape[1] * math.prod(i.spec.shape) <= largest:
            full = draft.emit("matmul", *draft.args(i), by=i)
            below = draft.emit("matrix_transpose", draft.emit("triu", full, by=i, k=1), by=i)
            draft.replace(i.out, draft.emit("add", draft.emit("triu", full, by=i), below, by=i))
        elif banded and i.spec.shape[0] > 1:
            draft.replace(i.out, _banded(draft, i))
        else:
            draft.keep(i)
    return draft.done()


def _banded(draft: Draft, i: Instruction) -> int:
    """Each band of rows from the diagonal on; what is left of it, transposed from the bands above."""
    x, y = draft.args(i)
    n, inner = draft.specs[x].shape
    size = max(3, math.ceil(n / _BANDS))
    cuts = [(low, min(low + size, n)) for low in range(0, n, size)]
    made: list[int] = []
    rows = []
    for low, high in cuts:
        right = block(draft, y, (0, inner), (low, n), i)
        made.append(draft.emit("matmul", block(draft, x, (low, high), (0, inner), i), right, by=i))
        parts = []
        for (start, end), above in zip(cuts, made[:-1], strict=False):
            mirror = block(draft, above, (0, end - start), (low - start, high - start), i)
            parts.append(draft.emit("matrix_transpose", mirror, by=i))
        parts.append(made[-1])
        rows.append(draft.emit("concat", *parts, by=i, axis=1) if len(parts) > 1 else parts[0])
    return draft.emit("concat", *rows, by=i, axis=0) if len(rows) > 1 else rows[0]
