"""Structural zeros and identity blocks: a product of matrices without the work that is known beforehand.

The Jacobian of a navigation filter is mostly blocks of zeros, identities, and identities times dt. Such a
factor is cut into square blocks; rows of blocks that look alike make one smaller product, an identity block
passes its rows through, and a zero block is not there. It is done only where it saves a good part of the
multiplications: many small products have a cost of their own.

A zero of the structure is taken as zero whatever it is multiplied with, NaN and infinity too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.pipeline.optimise.blocks2d import block, element
from flowgraph.pipeline.optimise.draft import Draft
from flowgraph.pipeline.optimise.elements import Table
from flowgraph.pipeline.optimise.facts import ONE, ZERO, Facts, facts_of
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction

_SIZES = (2, 3, 4, 5, 6)
_WORTH = 0.75  # of the multiplications may remain, at most


@dataclass(frozen=True)
class _Term:
    """Columns low..high of a band of rows; `scale` is the name of s where they are s times an identity."""

    low: int
    high: int
    scale: int | None = None


@dataclass(frozen=True)
class _Band:
    """Rows low..high, and what of them is not zero."""

    low: int
    high: int
    terms: tuple[_Term, ...]

    def work(self, columns: int) -> int:
        """Multiplications when multiplied with a matrix of so many columns."""
        rows = self.high - self.low
        return sum(
            rows * columns * ((t.high - t.low) if t.scale is None else int(t.scale != ONE))
            for t in self.terms
        )


def split_products(program: Program, *, largest: int = 0) -> Program:
    """Replace products with a structured factor by smaller ones.

    Args:
        program: what to rewrite.
        largest: products of at most so many multiplications stay, since unrolling finds their zeros itself.
    """
    facts = facts_of(program)
    draft = Draft(program)
    for i in program.instructions:
        new = _product(draft, i, facts, largest) if i.op == "matmul" else None
        if new is None:
            draft.keep(i)
        else:
            draft.replace(i.out, new)
    return draft.done()


def _product(draft: Draft, i: Instruction, facts: Facts, largest: int) -> int | None:
    a, b = (draft.program.specs[n].shape for n in i.args)
    left, right = (facts.table(n) for n in i.args)
    if len(a) != 2 or len(b) != 2 or left is None or right is None:
        return None
    if left.shape != a or right.shape != b or a[0] * a[1] * b[1] <= largest:
        return None
    whole = a[0] * a[1] * b[1]
    by_rows, by_columns = _bands(left, b[1]), _bands(right.T, a[0])
    work_left = sum(band.work(b[1]) for band in by_rows)
    work_right = sum(band.work(a[0]) for band in by_columns)
    if min(work_left, work_right) > _WORTH * whole:
        return None
    x, y = draft.args(i)
    if work_left <= work_right:
        return _joined(draft, i, x, y, by_rows, facts, transposed=False)
    return _joined(draft, i, y, x, by_columns, facts, transposed=True)


def _bands(table: Table, columns: int) -> list[_Band]:
    """The cut of a matrix that leaves the fewest multiplications, the fewest pieces among equals."""
    cuts = [_cut(table, size) for size in _SIZES if size <= max(table.shape)]
    cuts.append([_Band(0, table.shape[0], (_Term(0, table.shape[1]),))])
    return min(
        cuts, key=lambda bands: (sum(b.work(columns) for b in bands), sum(len(b.terms) for b in bands))
    )


def _cut(table: Table, size: int) -> list[_Band]:
    """Square blocks of a size, neighbours that are not zero joined, and bands of the same terms too."""
    rows, columns = table.shape
    bands: list[_Band] = []
    for top in range(0, rows, size):
        bottom = min(top + size, rows)
        terms: list[_Term] = []
        for low in range(0, columns, size):
            part = table[top:bottom, low : low + size]
            high = low + part.shape[1]
            if (part == ZERO).all():
                continue
            scale = _scale(part)
            before = terms[-1] if terms else None
            if scale is None and before is not None and before.scale is None and before.high == low:
                terms[-1] = _Term(before.low, high)
            else:
                terms.append(_Term(low, high, scale))
        last = bands[-1] if bands else None
        if last is not None and last.terms == tuple(terms) and all(t.scale is None for t in terms):
            bands[-1] = _Band(last.low, bottom, last.terms)
        else:
            bands.append(_Band(top, bottom, tuple(terms)))
    return bands


def _scale(part: Table) -> int | None:
    """The name of s where a block is s times an identity."""
    if part.shape[0] != part.shape[1]:
        return None
    eye = np.eye(len(part), dtype=bool)
    first: int = part[0, 0]
    return first if (part[eye] == first).all() and (part[~eye] == ZERO).all() else None


def _joined(
    draft: Draft, i: Instruction, x: int, y: int, bands: list[_Band], facts: Facts, *, transposed: bool
) -> int:
    """The product, band by band: of `x`, which has the structure, and `y`; of the transposes of both in turn.

    Transposed: the bands are columns of x, and the product is y x.
    """
    breadth = draft.specs[y].shape[0 if transposed else 1]
    pieces = []
    for band in bands:
        across, total = (band.low, band.high), None
        for term in band.terms:
            along = (term.low, term.high)
            other = block(draft, y, *(((0, breadth), along) if transposed else (along, (0, breadth))), i)
            if term.scale is None:
                own = block(draft, x, *((along, across) if transposed else (across, along)), i)
                piece = draft.emit("matmul", *((other, own) if transposed else (own, other)), by=i)
            elif term.scale == ONE:
                piece = other
            else:
                corner = (term.low, band.low) if transposed else (band.low, term.low)
                scale = facts.scalar(term.scale, draft)
                scale = element(draft, x, *corner, i) if scale is None else scale
                piece = draft.emit("multiply", other, scale, by=i)
            total = piece if total is None else draft.emit("add", total, piece, by=i)
        if total is None:
            width = band.high - band.low
            shape = (breadth, width) if transposed else (width, breadth)
            total = draft.constant(np.zeros(shape), draft.specs[x].dtype)
        pieces.append(total)
    axis = 1 if transposed else 0
    return pieces[0] if len(pieces) == 1 else draft.emit("concat", *pieces, by=i, axis=axis)
