"""Products over particles, block by block with the loop that makes their factors.

A covariance of a cloud is a product of (m, N) and (N, k) matrices that a loop over the N particles fills just
before. Whole, they are written to memory and read back, and are larger than all that the cloud itself is. So
where nobody else reads them they have room for a block of particles: the loop fills a block, the product adds
it to its sums, in the same order as it would have at once.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

from flowgraph.engines.c.nodes import Buffer, Item, Macro, Node, Space, Store, View

BLOCK = 120
"""Particles to a block: what they fill stays in a processor's own cache. No power of two, by which rows of a
factor would push each other out: with 512, all of the filter took a fifth longer."""
_LEAST_ROWS, _MOST_COLUMNS = 4, 32
"""Of a product that is summed in vectors, with room on the stack for the factors of a block."""


def fills(item: Item, group: tuple[int, Space]) -> bool:
    """Whether an item is a store of this loop, row by row."""
    level, space = group
    return isinstance(item, Store) and item.level == level and item.space == space and item.strides == (1,)


def in_blocks(items: list[Item], kept: Iterable[Buffer]) -> dict[tuple[int, Space], Macro]:
    """The product that goes with each loop, by level and space; its factors are made a block long.

    Args:
        items: all that is computed, with their levels.
        kept: buffers that later loops read.
    """
    found: dict[tuple[int, Space], Macro] = {}
    apart = set(kept)
    summed = {(i.level - 1, i.extra[1]) for i in items if isinstance(i, Node) and i.op == "reduce"}
    for item in items:
        if not (isinstance(item, Macro) and item.kind == "matmul" and len(item.output.shape) == 2):
            continue
        (rows, n), columns = item.inputs[0].shape[-2:], item.output.shape[1]
        group = item.level - 1, (n,)
        whole = [len(v.shape) == 2 and v.buffer.kind == "work" and not v.offset for v in item.inputs]
        along = [item.inputs[0].strides == (n, 1), item.inputs[1].strides == (1, n)]
        buffers = {v.buffer for v in item.inputs}
        if (
            n >= 4 * BLOCK
            and rows >= _LEAST_ROWS
            and 1 < columns <= _MOST_COLUMNS
            and all(whole + along)
            and group not in found
            and group not in summed
            and item.output.buffer.dtype == "real"
            and not buffers & apart
            and all(b.writers and all(fills(w, group) for w in b.writers) for b in buffers)
            and not any(_reads(other, buffers) for other in items if other is not item)
        ):
            found[group] = item
    for (level, (n,)), product in found.items():
        product.level = level
        for buffer in {v.buffer for v in product.inputs}:
            buffer.size = buffer.size // n * BLOCK
    return found


def of_a_block(product: Macro) -> Macro:
    """The product of as many particles as a block has."""
    left, right = product.inputs
    rows, columns = product.output.shape
    factors = (
        View(left.buffer, (rows, BLOCK), 0, (BLOCK, 1)),
        View(right.buffer, (BLOCK, columns), 0, (1, BLOCK)),
    )
    return replace(product, inputs=factors)


def _reads(item: Item, buffers: set[Buffer]) -> bool:
    if isinstance(item, Macro):
        return any(v.buffer in buffers for v in item.inputs)
    return isinstance(item, Node) and item.op in ("load", "gather", "search") and item.extra[0] in buffers
