"""In which ticks a value is needed, told by the pattern of present inputs alone.

A set of patterns is the bits of a whole number: bit p is the p-th pattern that occurs. A Boolean made of
presence alone is such a set; one made of data too lies between two of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from flowgraph.pipeline.pipeline import Port
from flowgraph.pipeline.program import Program

Patterns = int
Bounds = Mapping[int, tuple[Patterns, Patterns]]


def present_in(place: int, patterns: Sequence[int]) -> Patterns:
    """The patterns in which the input of that place is present."""
    return sum(1 << p for p, key in enumerate(patterns) if key >> place & 1)


def bounds_of(program: Program, inputs: Sequence[Port], patterns: Sequence[int]) -> Bounds:
    """For each scalar Boolean, the patterns in which it is surely true, and those in which it may be."""
    every = (1 << len(patterns)) - 1
    found = {port.present: (present_in(k, patterns),) * 2 for k, port in enumerate(inputs)}
    for n, a in program.constants.items():
        if a.dtype == bool and a.shape == ():
            found[n] = (every * bool(a),) * 2
    for i in program.instructions:
        if i.spec.dtype != "bool" or i.spec.shape != ():
            continue
        given = [found.get(a, (0, every)) for a in i.args]
        if i.op == "logical_and":
            found[i.out] = given[0][0] & given[1][0], given[0][1] & given[1][1]
        elif i.op == "logical_or":
            found[i.out] = given[0][0] | given[1][0], given[0][1] | given[1][1]
        elif i.op == "logical_not":
            found[i.out] = every & ~given[0][1], every & ~given[0][0]
    return found


def needed_in(program: Program, bounds: Bounds, every: Patterns) -> dict[int, Patterns]:
    """For each value, the patterns in whose ticks an output or a register may take it."""
    found: dict[int, Patterns] = dict.fromkeys(program.writes, every)

    def need(n: int, where: Patterns) -> None:
        found[n] = found.get(n, 0) | where

    for flag, leaves in program.outputs:
        if flag is not None:
            need(flag, every)
            for n in leaves:
                need(n, bounds.get(flag, (0, every))[1])
    for i in reversed(program.instructions):
        here = found.get(i.out, 0)
        if not here:
            continue
        if i.op == "where":
            low, high = bounds.get(i.args[0], (0, every))
            need(i.args[0], here)
            need(i.args[1], here & high)
            need(i.args[2], here & ~low)
        elif i.op == "logical_and" and not i.spec.shape:  # false where the other surely is, whatever it is
            need(i.args[0], here & bounds[i.args[1]][1] if i.args[1] in bounds else here)
            need(i.args[1], here & bounds[i.args[0]][1] if i.args[0] in bounds else here)
        else:
            for a in i.args:
                need(a, here)
    return found
