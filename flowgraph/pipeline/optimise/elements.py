"""Arrays element by element: which number each element of a small array is, as an expression of others.

A walk through the list gives each array a table with one entry an element. Moving data about (`reshape`,
`concat`, `getitem`, a transpose) only rearranges entries; arithmetic asks a `make` function for a new entry
from those of its arguments. What `make` returns decides what the walk is for: names of expressions, to find
zeros, identity blocks and symmetric matrices; or numbers of emitted instructions, to unroll.

A last axis whose size is among `lanes` (particles, say) is not taken apart: an entry then stands for a
whole row of that axis, or for one number that is the same all along it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flowgraph.recorder.ops import ELEMENTWISE, OPS, Spec
from flowgraph.recorder.trace import Instruction

Table = np.ndarray
"""Of objects: an entry for each element of an array, without its axis of lanes."""

_MOVES = "reshape broadcast_to permute_dims matrix_transpose concat stack flip roll getitem tril triu"

MOVES = frozenset(_MOVES.split())
"""Operations that compute nothing."""

_CHAINS = {"sum": "add", "prod": "multiply", "max": "maximum", "min": "minimum",
           "any": "logical_or", "all": "logical_and"}  # fmt: skip

Make = Callable[..., Any]
"""`make(op, *entries, **attrs)`, or `make("constant", value, dtype)`: the entry of a result."""


class Elements:
    """Rules by which tables follow from tables.

    Args:
        specs: of all values.
        lanes: sizes of last axes that are not taken apart.
        make: see `Make`.
    """

    def __init__(self, specs: Mapping[int, Spec], lanes: frozenset[int], make: Make) -> None:
        self.specs, self.lanes, self.make = specs, lanes, make

    def laned(self, spec: Spec) -> bool:
        return bool(spec.shape) and spec.shape[-1] in self.lanes

    def shape(self, spec: Spec) -> tuple[int, ...]:
        """The shape of the table of a value."""
        return spec.shape[:-1] if self.laned(spec) else spec.shape

    def count(self, value: int) -> int:
        """How many entries the table of a value has."""
        return math.prod(self.shape(self.specs[value]))

    def longest(self, value: int) -> int:
        """The longest axis of the table of a value."""
        return max(self.shape(self.specs[value]), default=1)

    def expand(self, i: Instruction, tables: list[Table]) -> Table | None:
        """The table of an instruction's result from those of its arguments; None: there is no rule."""
        if any(n == 0 for n in i.spec.shape):
            return None
        if i.op in ELEMENTWISE:
            return self._elementwise(i, tables)
        made = self.laned(i.spec) and not any(self.laned(self.specs[a]) for a in i.args)
        if made and i.op != "broadcast_to":
            return None  # an axis that was taken apart would have to be put together
        if i.op in MOVES:
            return self._move(i, tables)
        rule = getattr(self, f"_{i.op}", self._chain if i.op in _CHAINS else None)
        return None if rule is None else rule(i, tables)

    # -- element by element ------------------------------------------------------------------------------

    def _elementwise(self, i: Instruction, tables: list[Table]) -> Table:
        shape = self.shape(i.spec)
        wide = [self._spread(t, self.specs[a], i.spec) for a, t in zip(i.args, tables, strict=True)]
        out = np.empty(shape, object)
        for at in np.ndindex(shape):
            out[at] = self.make(i.op, *(t[at] for t in wide), **i.attrs)
        return out

    def _spread(self, table: Table, spec: Spec, result: Spec) -> Table:
        """A table, broadcast to the table of a result."""
        if self.laned(result) and not self.laned(spec) and len(spec.shape) > 0:
            table = table[..., 0]  # a last axis of size 1 meets the lanes
        return np.broadcast_to(table, self.shape(result))

    # -- data moved about --------------------------------------------------------------------------------

    def _move(self, i: Instruction, tables: list[Table]) -> Table | None:
        spec = self.specs[i.args[0]]
        wide = self.laned(spec)
        if i.op == "broadcast_to":
            return self._spread(tables[0], spec, i.spec)
        if wide != self.laned(i.spec) or (wide and spec.shape[-1] != i.spec.shape[-1]):
            return None
        if i.op in ("concat", "stack"):
            axis = i.attrs["axis"] % len(i.spec.shape)
            if (wide and axis == len(i.spec.shape) - 1) or any(
                self.laned(self.specs[a]) != wide for a in i.args
            ):
                return None
            join = np.concatenate if i.op == "concat" else np.stack
            return join(tables, axis=axis)
        (table,) = tables
        if i.op == "reshape":
            return table.reshape(self.shape(i.spec))
        if i.op == "getitem":
            index = [e if isinstance(e, int) else slice(*e) for e in i.attrs["index"]]
            if wide and (isinstance(index[-1], int) or i.attrs["index"][-1] != [None, None, None]):
                return None
            entries = table[tuple(index[:-1] if wide else index)]
            return entries if isinstance(entries, np.ndarray) else _scalar(entries)
        if wide:
            return None
        if i.op in ("tril", "triu"):
            keep = getattr(np, i.op)(np.ones(i.spec.shape, bool), **i.attrs)
            out = np.empty(i.spec.shape, object)
            zero = self.make("constant", 0, i.spec.dtype)
            for at in np.ndindex(i.spec.shape):
                out[at] = table[at] if keep[at] else zero
            return out
        if i.op == "matrix_transpose":
            return table.swapaxes(-1, -2)
        moved: Table = OPS[i.op].run(np, table, **i.attrs)
        return moved

    def _take(self, i: Instruction, tables: list[Table]) -> Table | None:
        spec, index = (self.specs[a] for a in i.args)
        last = i.attrs["axis"] % len(spec.shape) == len(spec.shape) - 1
        if not (self.laned(spec) and last and len(index.shape) == 1 and self.laned(index)):
            return None
        out = np.empty(tables[0].shape, object)
        for at in np.ndindex(out.shape):
            out[at] = self.make("take", tables[0][at], tables[1][()], axis=0)
        return out

    # -- sums and products -------------------------------------------------------------------------------

    def _chain(self, i: Instruction, tables: list[Table]) -> Table | None:
        (table,) = tables
        spec = self.specs[i.args[0]]
        rank, axis = len(spec.shape), i.attrs.get("axis")
        axes = range(rank) if axis is None else [axis] if isinstance(axis, int) else axis
        gone = sorted({a % rank for a in axes}) if rank else []
        if (self.laned(spec) and rank - 1 in gone) or self.laned(spec) != self.laned(i.spec):
            return None
        kept = [k for k in range(table.ndim) if k not in gone]
        rows = table.transpose([*kept, *gone]).reshape(-1, math.prod(table.shape[k] for k in gone))
        out = np.empty(len(rows), object)
        for n, row in enumerate(rows):
            entries = list(row)
            if spec.dtype != i.spec.dtype:
                entries = [self.make("astype", e, dtype=i.spec.dtype) for e in entries]
            out[n] = self.total(_CHAINS[i.op], entries)
        return out.reshape(self.shape(i.spec))

    def total(self, op: str, entries: list[Any]) -> Any:
        """The entries joined by an operation, from the first to the last."""
        found = entries[0]
        for entry in entries[1:]:
            found = self.make(op, found, entry)
        return found

    def dot(self, left: list[Any], right: list[Any]) -> Any:
        """The sum of products."""
        return self.total("add", [self.make("multiply", a, b) for a, b in zip(left, right, strict=True)])

    def _matmul(self, i: Instruction, tables: list[Table]) -> Table | None:
        (a, b), (left, right) = (self.specs[n] for n in i.args), tables
        if self.laned(a) or (self.laned(b) and len(b.shape) < 2) or self.laned(b) != self.laned(i.spec):
            return None
        if a.dtype == "bool":
            return None
        left = left if len(a.shape) > 1 else left[None, :]
        column = len(b.shape) == 1 or self.laned(b)
        right = right[..., :, None] if column else right
        batch = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
        left = np.broadcast_to(left, (*batch, *left.shape[-2:]))
        right = np.broadcast_to(right, (*batch, *right.shape[-2:]))
        out = np.empty((*batch, left.shape[-2], right.shape[-1]), object)
        for at in np.ndindex(out.shape):
            row, col = left[(*at[:-2], at[-2])], right[(*at[:-2], slice(None), at[-1])]
            out[at] = self.dot(list(row), list(col))
        return out.reshape(self.shape(i.spec))

    def _vecdot(self, i: Instruction, tables: list[Table]) -> Table | None:
        if any(self.laned(self.specs[a]) for a in i.args) or self.laned(i.spec):
            return None
        size = tables[0].shape[-1]
        left, right = (np.broadcast_to(t, (*i.spec.shape, size)) for t in tables)
        out = np.empty(i.spec.shape, object)
        for at in np.ndindex(out.shape):
            out[at] = self.dot(list(left[at]), list(right[at]))
        return out

    def _outer(self, i: Instruction, tables: list[Table]) -> Table | None:
        if any(self.laned(self.specs[a]) for a in i.args):
            return None
        out = np.empty(i.spec.shape, object)
        for r, c in np.ndindex(out.shape):
            out[r, c] = self.make("multiply", tables[0][r], tables[1][c])
        return out

    def _cross(self, i: Instruction, tables: list[Table]) -> Table:
        a, b = (np.broadcast_to(t, i.spec.shape) for t in tables)
        out = np.empty(i.spec.shape, object)
        for at in np.ndindex(i.spec.shape[:-1]):
            for k in range(3):
                m, n = (k + 1) % 3, (k + 2) % 3
                plus = self.make("multiply", a[(*at, m)], b[(*at, n)])
                out[(*at, k)] = self.make("subtract", plus, self.make("multiply", a[(*at, n)], b[(*at, m)]))
        return out


def _scalar(entry: Any) -> Table:
    out = np.empty((), object)
    out[()] = entry
    return out
