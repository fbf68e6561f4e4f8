"""The passes that change no bit: constants folded, repeated sub-expressions shared, unused code dropped."""

from __future__ import annotations

import json
import math

from flowgraph.pipeline.evaluate import evaluate
from flowgraph.pipeline.optimise.draft import LARGEST_CONSTANT, Draft, ends
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import OPS

_COMMUTATIVE = """
add multiply maximum minimum equal not_equal logical_and logical_or logical_xor bitwise_and bitwise_or
bitwise_xor hypot"""

COMMUTATIVE = frozenset(_COMMUTATIVE.split())
"""Operations whose two arguments may change places without changing a bit of the result."""


def fold(program: Program) -> Program:
    """Compute now what depends on constants alone, as the reference interpreter would."""
    draft = Draft(program)
    for i in program.instructions:
        args = draft.args(i)
        small = i.op in OPS and math.prod(i.spec.shape) <= LARGEST_CONSTANT
        if small and all(a in draft.constants for a in args):
            value = evaluate(i, *(draft.constants[a] for a in args))
            draft.replace(i.out, draft.constant(value, i.spec.dtype))
        else:
            draft.keep(i)
    return draft.done()


def share(program: Program) -> Program:
    """Compute once what the list computes twice: same operation, same arguments, same attributes."""
    draft = Draft(program)
    found: dict[tuple[object, ...], int] = {}
    for n, array in program.constants.items():
        first = found.setdefault(("constant", array.dtype.str, array.shape, array.tobytes()), n)
        if first != n:
            draft.replace(n, first)
    for i in program.instructions:
        args = draft.args(i)
        ordered = tuple(sorted(args)) if i.op in COMMUTATIVE else args
        key = (i.op, ordered, json.dumps(i.attrs, sort_keys=True) if i.attrs else "", i.spec)
        first = found.setdefault(key, i.out)
        if first == i.out:
            draft.keep(i)
        else:
            draft.replace(i.out, first)
    return draft.done()


def drop(program: Program) -> Program:
    """Leave out what neither an output nor a register needs."""
    needed = set(ends(program.outputs, program.writes))
    live = set()
    for i in reversed(program.instructions):
        if i.out in needed:
            live.add(i.out)
            needed.update(i.args)
    draft = Draft(program)
    for i in program.instructions:
        if i.out in live:
            draft.keep(i)
    return draft.done()
