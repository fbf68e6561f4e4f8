"""The optimiser: passes over a program, once for all backends.

A pass takes a program and returns one that computes the same with less. It knows the instructions and
nothing of a backend; what it makes are the same typed instructions in single-assignment form, so whatever
plays the one list plays the other. Each can be switched off by its name. The last two change no
list: with `loops` they are what `plan` tells a backend about loops, buffers and the order of axes.

The first four change no bit, and `algebra` none but for 0 times NaN or infinity. `symmetry`, `structure`,
`mirror`, `sparse` and `unroll` add in another order than a matrix product does, or not at all where a zero is
known, so results agree as far as rounding lets them: states within 1e-9 max(1, |x|), covariances within
1e-6 sqrt(P_ii P_jj), the same decisions.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import Any

import numpy as np

from flowgraph.errors import UnknownNameError
from flowgraph.pipeline.optimise.algebra import simplify
from flowgraph.pipeline.optimise.loops import gather
from flowgraph.pipeline.optimise.memory import Plan, plan
from flowgraph.pipeline.optimise.simple import drop, fold, share
from flowgraph.pipeline.optimise.sparse import mirror_products, tell_zeros
from flowgraph.pipeline.optimise.structure import split_products
from flowgraph.pipeline.optimise.symmetry import halve_products
from flowgraph.pipeline.optimise.unroll import LARGEST_WORK, unroll
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, is_symmetric

__all__ = [
    "ARRAYS",
    "COMPILED",
    "DEFAULT",
    "PASSES",
    "RELYING",
    "Plan",
    "check_passes",
    "optimise",
    "plan",
    "usable",
    "without",
]

PASSES = {
    "fold": "compute now what depends on constants alone",
    "share": "compute once what the list computes twice",
    "drop": "leave out what no output and no register needs",
    "loops": "bring work over the same axes together, for one loop",
    "algebra": "leave out what has no effect: x + 0, 1 x, 0 x, moves to and fro",
    "symmetry": "compute one half of A P A^T",
    "structure": "split products along zero and identity blocks",
    "mirror": "write A P A^T, with zeros in A, as A (A P)^T",
    "sparse": "tell which elements of larger factors are zero, numbers or scalars that are there",
    "unroll": "take small arrays apart into scalars",
    "reuse": "let arrays share memory whose times do not overlap",
    "layout": "lay the axis of particles out innermost",
}
"""The passes by name, and what each does."""

DEFAULT = tuple(PASSES)
"""All passes: for code that is compiled."""

ARRAYS = ("fold", "share", "drop", "algebra")
"""Passes that keep arrays whole: for backends that are fast on arrays and slow on many small operations."""

COMPILED = tuple(n for n in PASSES if n != "structure")
"""Passes for C, unless others are asked for. `structure` cuts large products into many small ones, symmetric
ones too: `mirror` and `sparse` save as much in a fifth of the compiler's time."""

RELYING = ("symmetry", "mirror")
"""Passes that take registers as symmetric which are so at reset: not for runs that begin otherwise."""


def optimise(
    program: Program, passes: Collection[str] = DEFAULT, *, unroll_work: int = LARGEST_WORK
) -> Program:
    """The same program with less work.

    Args:
        program: specialised for a pattern of sources, or for all.
        passes: names from `PASSES`, in any order; the order in which they are applied is fixed.
        unroll_work: scalar operations of an instruction above which `unroll` leaves it whole.

    Raises:
        UnknownNameError: for a pass that is not there.
    """
    chosen = set(check_passes(passes))
    small = unroll_work if "unroll" in chosen else 0
    steps: list[tuple[str, Callable[..., Program], dict[str, Any]]] = [
        ("fold", fold, {}),
        ("share", share, {}),
        ("algebra", simplify, {}),
        ("drop", drop, {}),
        ("symmetry", halve_products, {"largest": small, "banded": "structure" in chosen}),
        ("structure", split_products, {"largest": small}),
        ("unroll", unroll, {"largest": unroll_work}),
        ("algebra", simplify, {}),
        ("fold", fold, {}),
        ("share", share, {}),
        ("drop", drop, {}),
        ("loops", gather, {}),
        ("mirror", mirror_products, {}),
        ("sparse", tell_zeros, {}),
    ]
    for name, step, settings in steps:
        if name in chosen:
            program = step(program, **settings)
    return program


def check_passes(passes: Collection[str]) -> tuple[str, ...]:
    """The passes in their order.

    Raises:
        UnknownNameError: for a pass that is not there.
    """
    for name in (passes,) if isinstance(passes, str) else passes:
        if name not in PASSES:
            raise UnknownNameError("pass", name, list(PASSES), path="passes")
    return tuple(n for n in PASSES if n in passes)


def without(*names: str, passes: Collection[str] = DEFAULT) -> tuple[str, ...]:
    """`passes` but for some.

    Raises:
        UnknownNameError: for a pass that is not there.
    """
    off = check_passes(names)
    return tuple(n for n in check_passes(passes) if n not in off)


def usable(pipeline: Pipeline, passes: Collection[str], cells: Sequence[Any]) -> tuple[str, ...]:
    """The passes that hold for a run which starts from these register cells.

    A run that sets a register otherwise which is symmetric at reset goes without those in `RELYING`.
    """
    kept = [c for r in pipeline.registers for c in r.cells]
    odd = any(
        is_symmetric(c.reset) and not is_symmetric(np.asarray(v)) for c, v in zip(kept, cells, strict=True)
    )
    return without(*RELYING, passes=passes) if odd else check_passes(passes)
