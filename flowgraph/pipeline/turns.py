"""A pipeline as the body of a replay: one tick of it is one turn.

What a pipeline remembers (its register cells) and what it gives (its outputs) become one vector of reals,
the history before or after a turn; what happens at a tick (which inputs came, when, and with what) becomes
another, the row. A `Layout` says what lies where. Whole numbers are cut into pieces that a float32 holds
exactly, so that a time in ns comes out as it went in.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from flowgraph.errors import LoweringError
from flowgraph.pipeline.optimise import ARRAYS, optimise
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise
from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.replay import Body, Case, Turn, written
from flowgraph.recorder.symbolic import Symbolic
from flowgraph.recorder.symbolic_namespace import namespace
from flowgraph.recorder.trace import Trace

MOST_CASES = 8
"""Up to so many patterns of present inputs each have a case of their own."""

_PIECES = {"int32": (16,), "uint32": (16,), "int64": (44, 22), "uint64": (44, 22)}
"""By how many bits a whole number is shifted for its pieces; the last is what is left."""


class Slot(NamedTuple):
    """Where an array lies in a vector."""

    start: int
    shape: tuple[int, ...]
    dtype: str

    @property
    def pieces(self) -> int:
        return 1 + len(_PIECES.get(self.dtype, ()))

    @property
    def stop(self) -> int:
        return self.start + self.pieces * math.prod(self.shape)


class Layout:
    """Arrays side by side in a vector of reals, given their shapes and kinds."""

    def __init__(self, arrays: Iterable[tuple[tuple[int, ...], str]]) -> None:
        found: list[Slot] = []
        for shape, dtype in arrays:
            found.append(Slot(found[-1].stop if found else 0, tuple(shape), dtype))
        self.slots = tuple(found)
        self.size = found[-1].stop if found else 0

    def pack(self, values: Sequence[Any], xp: Any) -> Any:
        """The vector (size,) of these arrays."""
        parts = [p for v, slot in zip(values, self.slots, strict=True) for p in packed(v, slot, xp)]
        return xp.concat(parts, axis=0)

    def unpack(self, vector: Any, k: int, xp: Any) -> Any:
        """Array number k of a vector."""
        return unpacked(vector, self.slots[k], xp)


def packed(value: Any, slot: Slot, xp: Any) -> list[Any]:
    """An array as pieces of a vector."""
    flat = xp.reshape(xp.asarray(value), (math.prod(slot.shape),))
    if slot.dtype == "real":
        return [flat]
    kind = np.dtype(slot.dtype).type
    parts, above = [], 0
    for bits in _PIECES.get(slot.dtype, ()):
        piece = xp.bitwise_right_shift(flat, kind(bits))
        parts.append(_low(piece, above - bits, kind, xp) if above else piece)
        above = bits
    parts.append(_low(flat, above, kind, xp) if above else flat)
    return [xp.astype(part, xp.float64) for part in parts]


def _low(value: Any, bits: int, kind: Any, xp: Any) -> Any:
    return xp.bitwise_and(value, kind(2**bits - 1))


def unpacked(vector: Any, slot: Slot, xp: Any) -> Any:
    """The array that lies in a slot of a vector."""
    n = math.prod(slot.shape)
    if slot.dtype == "real":
        return xp.reshape(vector[slot.start : slot.stop], slot.shape)
    starts = range(slot.start, slot.stop, n) if n else [slot.start]
    parts = [xp.reshape(vector[a : a + n], slot.shape) for a in starts]
    if slot.dtype == "bool":
        return parts[0] != 0.0
    kind = np.dtype(slot.dtype).type
    shifts = (*_PIECES[slot.dtype], 0)
    whole = [xp.astype(p, getattr(xp, slot.dtype)) for p in parts]
    total = whole[-1]
    for part, bits in zip(whole[:-1], shifts[:-1], strict=True):
        total = total + part * kind(2**bits if bits < 63 else 0)
    return total


@dataclass(frozen=True)
class Turns:
    """A pipeline made ready to be replayed.

    Args:
        body: of `replay`.
        history: what lies in the history: all cells, then for each output its presence and what is no cell.
        row: what lies in a row: the key of what is present, the time, and the leaves of all inputs.
        start: (k,) the history at the start.
        leaves: of each input, the places of its leaves in `row`.
        outputs: of each output, the place of its presence in `history`, and those of its leaves.
    """

    body: Body
    history: Layout
    row: Layout
    start: np.ndarray
    leaves: tuple[tuple[int, ...], ...]
    outputs: tuple[tuple[int, tuple[int, ...]], ...]


def turns_of(pipeline: Pipeline) -> Turns:
    """A pipeline's tick as a turn.

    Raises:
        LoweringError: for one with random numbers, queues that can be full, or host blocks.
    """
    _need_plain(pipeline)
    count = len(pipeline.inputs)
    keys: list[int | None] = list(range(2**count)) if 2**count <= MOST_CASES else [None]
    programs = [optimise(specialise(pipeline, key), ARRAYS) for key in keys]
    cells = [c for r in pipeline.registers for c in r.cells]
    fields: list[tuple[tuple[int, ...], str]] = [(c.shape, c.dtype) for c in cells]
    outputs: list[tuple[int, tuple[int, ...]]] = []
    kept: list[tuple[int, int | None]] = []
    for k, port in enumerate(pipeline.outputs):
        present, places = len(fields), []
        fields.append(((), "bool"))
        kept.append((k, None))
        for j, leaf in enumerate(port.leaves):
            cell = _same_cell(programs, k, j)
            places.append(len(fields) if cell is None else cell)
            if cell is None:
                fields.append((leaf.shape, leaf.dtype))
                kept.append((k, j))
        outputs.append((present, tuple(places)))
    history = Layout(fields)
    row = Layout(
        [((), "real"), ((), "int64"), *((x.shape, x.dtype) for p in pipeline.inputs for x in p.leaves)]
    )
    ends, leaves = 2, []
    for port in pipeline.inputs:
        leaves.append(tuple(range(ends, ends + len(port.leaves))))
        ends += len(port.leaves)
    made = [
        _case(pipeline, key, program, history, row, leaves, kept)
        for key, program in zip(keys, programs, strict=True)
    ]
    resets = [np.asarray(c.reset) for c in cells]
    rest = [np.zeros(shape, bool if kind == "bool" else kind.replace("real", "float64"))
            for shape, kind in fields[len(cells) :]]  # fmt: skip
    start = history.pack([*resets, *rest], NUMPY)
    return Turns(
        Body({"cases": [written(case) for case in made]}), history, row, start, tuple(leaves), tuple(outputs)
    )


def _need_plain(pipeline: Pipeline) -> None:
    faults = [f.path for f in pipeline.faults]
    sites, hosts = [s.name for s in pipeline.random], [h.path for h in pipeline.host]
    for what, found, fix in (
        ("draws random numbers", sites, "use a method without them"),
        ("has a queue that can be full", faults, "pair its streams before they come to it"),
        ("has a block for the host", hosts, "put it before or behind"),
    ):
        if found:
            raise LoweringError(
                f"a graph that is replayed {what}",
                path=f"{pipeline.name}/{found[0]}",
                expected="blocks of array operations, which give the same each time they are replayed",
                got=", ".join(found),
                fix=fix,
            )


def _same_cell(programs: Sequence[Program], k: int, j: int) -> int | None:
    """The register cell that is written with leaf j of output k whenever that is present."""
    common: set[int] | None = None
    for program in programs:
        present, leaves = program.outputs[k]
        if present is not None:
            here = {c for c, n in enumerate(program.writes) if n == leaves[j]}
            common = here if common is None else common & here
    return min(common) if common else None


def _case(
    pipeline: Pipeline, key: int | None, program: Program, history: Layout, row: Layout,
    leaves: Sequence[tuple[int, ...]], kept: Sequence[tuple[int, int | None]],
) -> Case:  # fmt: skip
    """One case: what a tick with these inputs makes of the history before it."""
    trace = Trace()
    before, now = trace.input(Spec((history.size,), "real")), trace.input(Spec((row.size,), "real"))
    later: dict[int, Callable[[], Any]] = {
        n: partial(history.unpack, before, k, namespace) for k, n in enumerate(program.reads)
    }
    later[pipeline.time] = partial(row.unpack, now, 1, namespace)
    for k, (port, places) in enumerate(zip(pipeline.inputs, leaves, strict=True)):
        later[port.present] = partial(_present, now, k)
        for leaf, place in zip(port.leaves, places, strict=True):
            later[leaf.value] = partial(row.unpack, now, place, namespace)
    values: dict[int, Symbolic] = {n: trace.constant(a) for n, a in program.constants.items()}

    def value(n: int) -> Symbolic:
        if n not in values:
            values[n] = later[n]()
        return values[n]

    lines: list[str] = []
    for i in program.instructions:
        values[i.out] = trace.apply(i.op, *(value(a) for a in i.args), **i.attrs)
        lines += [i.line] * (len(trace.instructions) - len(lines))
    found: list[Any] = [value(n) for n in program.writes]
    for k, j in kept:
        present, numbers = program.outputs[k]
        if j is None:
            found.append(np.bool_(False) if present is None else value(present))
        elif present is None:
            leaf = pipeline.outputs[k].leaves[j]
            found.append(np.zeros(leaf.shape, np.float64 if leaf.dtype == "real" else leaf.dtype))
        else:
            found.append(value(numbers[j]))
    result = history.pack([trace.constant(x) if isinstance(x, np.ndarray | np.generic) else x for x in found],
                          namespace)  # fmt: skip
    lines += [f"{pipeline.name}, kept"] * (len(trace.instructions) - len(lines))
    turns = tuple(
        Turn(i.op, i.args, i.attrs, i.out, i.spec, line)
        for i, line in zip(trace.instructions, lines, strict=True)
    )
    return Case(dict(trace.constants), turns, result.number)


def _present(row: Any, k: int) -> Any:
    """Whether input k came, by the key of a row."""
    whole = namespace.astype(row[0], namespace.int32)
    return namespace.bitwise_and(namespace.bitwise_right_shift(whole, np.int32(k)), np.int32(1)) != 0
