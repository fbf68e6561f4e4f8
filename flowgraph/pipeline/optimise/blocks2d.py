"""Reading a block of a matrix in a draft, through what it was put together from."""

from __future__ import annotations

from flowgraph.pipeline.optimise.draft import Draft
from flowgraph.recorder.trace import Instruction


def block(draft: Draft, value: int, rows: tuple[int, int], columns: tuple[int, int], by: Instruction) -> int:
    """The number of `value[r0:r1, c0:c1]`: a piece that is there already, or an emitted `getitem`.

    Args:
        value: a matrix, by its number in the new list.
        rows, columns: from and to, of a part of it.
    """
    shape = draft.specs[value].shape
    if rows == (0, shape[0]) and columns == (0, shape[1]):
        return value
    known = draft.constants.get(value)
    if known is not None:
        return draft.constant(known[rows[0] : rows[1], columns[0] : columns[1]], draft.specs[value].dtype)
    source = draft.made.get(value)
    if source is not None and source.op == "matrix_transpose" and len(shape) == 2:
        inner = block(draft, source.args[0], columns, rows, by)
        return draft.emit("matrix_transpose", inner, by=by)
    if source is not None and source.op == "concat":
        axis = source.attrs["axis"] % 2
        start, (low, high) = 0, (rows, columns)[axis]
        for part in source.args:
            size = draft.specs[part].shape[axis]
            if start <= low and high <= start + size:
                moved = (low - start, high - start)
                return block(draft, part, moved if axis == 0 else rows, moved if axis == 1 else columns, by)
            start += size
    index = [[rows[0], rows[1], None], [columns[0], columns[1], None]]
    return draft.emit("getitem", value, by=by, index=index)


def element(draft: Draft, value: int, row: int, column: int, by: Instruction) -> int:
    """The number of `value[row, column]`."""
    found = block(draft, value, (row, row + 1), (column, column + 1), by)
    if found in draft.constants:
        return draft.constant(draft.constants[found][0, 0], draft.specs[found].dtype)
    return draft.emit("getitem", found, by=by, index=[0, 0])
