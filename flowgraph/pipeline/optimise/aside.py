"""What is rarely taken is put aside, so that a backend with branches computes it only then.

A selection by one truth takes one of two arrays, and a program computes both. Where one of them needs work
that serves nothing else, as a root of a covariance that is singular does, that work becomes a `Choice`: a
program of its own, from the values that it reads to the array. In its place stands one instruction,

    choose(truth, other, *inputs)

which is `other`, or what the choice makes of the inputs where the truth says so. It is no instruction of a
pipeline: only who asked for it meets it. Choices that do the same are one.
"""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from flowgraph.pipeline.optimise.draft import ends
from flowgraph.pipeline.pipeline import work
from flowgraph.pipeline.program import Program
from flowgraph.recorder.ops import Spec
from flowgraph.recorder.trace import Instruction

CHOOSE = "choose"
LEAST_WORK = 256
"""Scalar operations that a branch must save."""


@dataclass(frozen=True)
class Choice:
    """Work that is done only where it is taken.

    Args:
        program: its one register is the result.
        inputs: the numbers of what it reads, all real.
        key: equal for choices that do the same.
    """

    program: Program
    inputs: tuple[int, ...]
    key: Any


def put_aside(program: Program, kept: Collection[int] = ()) -> tuple[Program, list[Choice]]:
    """The program with `choose` in the place of selections that compute much in vain.

    The attributes of a `choose` are the number of its `choice` and for which `truth` that is taken.

    Args:
        program: before arrays are taken apart.
        kept: values whose instructions must stay where they are.
    """
    users: dict[int, set[int]] = defaultdict(set)
    for i in program.instructions:
        for a in i.args:
            users[a].add(i.out)
    held = {*kept, *ends(program.outputs, program.writes)}
    gone: set[int] = set()
    chosen: dict[int, Instruction] = {}
    choices: list[Choice] = []
    for i in reversed(program.instructions):  # the outermost first
        if i.op != "where" or i.out in gone or math.prod(program.specs[i.args[0]].shape) != 1:
            continue
        if i.args[1] == i.args[2]:  # the same either way
            continue
        for truth, root in ((False, i.args[2]), (True, i.args[1])):
            other = i.args[1 if root == i.args[2] else 2]
            if {program.specs[root], program.specs[other]} != {i.spec} or i.spec.dtype != "real":
                continue
            part = _part(program, root, i.out, users, held)
            inside = {p.out for p in part}
            read = (a for p in part for a in p.args if a not in inside and a not in program.constants)
            inputs = tuple(dict.fromkeys(read))
            real = inputs and all(program.specs[a].dtype == "real" for a in inputs)
            if not real or sum(work(p, program.specs) for p in part) < LEAST_WORK:
                continue
            gone |= inside
            attrs = {"choice": len(choices), "truth": truth}
            chosen[i.out] = Instruction(CHOOSE, (i.args[0], other, *inputs), attrs, i.out, i.spec, i.line)
            choices.append(_choice(program, part, inputs, root))
            break
    if not chosen:
        return program, []
    listed = tuple(chosen.get(i.out, i) for i in program.instructions if i.out not in gone)
    needed = {a for i in listed for a in i.args} | set(ends(program.outputs, program.writes))
    return (
        Program(
            {n: a for n, a in program.constants.items() if n in needed},
            listed,
            program.outputs,
            program.writes,
            program.specs,
            program.reads,
            program.symmetric,
            program.lanes,
            program.origin,
            program.elements,
        ),
        choices,
    )


def _part(
    program: Program, root: int, end: int, users: dict[int, set[int]], held: Collection[int]
) -> list[Instruction]:
    """The instructions, in order, that serve nothing but one argument of a selection."""
    inside: set[int] = set()
    for i in reversed(program.instructions):
        ours = users[i.out] == {end} if i.out == root else users[i.out] and users[i.out] <= inside
        if ours and i.out not in held and i.op != "replay":
            inside.add(i.out)
    return [i for i in program.instructions if i.out in inside]


def _choice(program: Program, part: list[Instruction], inputs: tuple[int, ...], root: int) -> Choice:
    names = {n: k for k, n in enumerate((*inputs, *(i.out for i in part)))}
    constants = {a: program.constants[a] for i in part for a in i.args if a not in names}

    def named(a: int) -> Any:
        if a in names:
            return names[a]
        array = constants[a]
        return array.tobytes(), array.shape, array.dtype.str

    key = (
        tuple(program.specs[a] for a in inputs),
        tuple((i.op, tuple(map(named, i.args)), json.dumps(i.attrs, sort_keys=True), i.spec) for i in part),
        names[root],
    )
    specs: dict[int, Spec] = {n: program.specs[n] for n in (*names, *constants)}
    body = Program(constants, tuple(part), ((None, ()),), (root,), specs, inputs[:1], lanes=program.lanes)
    return Choice(body, inputs, key)
