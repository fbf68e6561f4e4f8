"""Patterns of present inputs, and which of them share a reaction.

A reaction for each pattern, in which all that depends on presence is folded away, is the quickest code, and
the most of it. Often the presence of an input decides about little: whether a reading is taken or the one
that is held, before the same prediction. There one reaction serves both, and asks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_, or_

from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.program import Program, specialise

MORE = 1.1
"""How many times the work of the smallest a reaction may do that serves several patterns."""

LEAST = 1_000
"""Scalar operations below which a reaction is no burden to a compiler."""


@dataclass(frozen=True)
class Pattern:
    """What a reaction serves.

    Args:
        keys: the patterns of present inputs, a bit an input.
        inputs: those that are present in any.
        open: of these, those that are not in all: their presence is data.
        every: whether it serves all that there are, and names none.
    """

    keys: tuple[int, ...]
    inputs: int
    open: int
    every: bool = False

    @classmethod
    def of(cls, *keys: int) -> Pattern:
        """That of these patterns."""
        inputs = reduce(or_, keys)
        return cls(keys, inputs, inputs & ~reduce(and_, keys))

    @classmethod
    def all(cls, pipeline: Pipeline) -> Pattern:
        """That of every pattern."""
        inputs = 2 ** len(pipeline.inputs) - 1
        return cls((), inputs, inputs, every=True)


def shared(pipeline: Pipeline, keys: Sequence[int]) -> list[Pattern]:
    """These patterns; together those that one reaction serves with as much work, its outputs as certain."""
    alone = {key: specialise(pipeline, key) for key in keys}
    groups = [Pattern.of(key) for key in keys]
    for k in range(len(pipeline.inputs)):
        for group in list(groups):
            with_it = tuple(key | 1 << k for key in group.keys)
            other = next((g for g in groups if g.keys == with_it), None)
            if group.inputs >> k & 1 or other is None or group not in groups:
                continue
            both = Pattern.of(*group.keys, *other.keys)
            programs = [alone[key] for key in both.keys]
            if _are_like(specialise(pipeline, both.inputs, both.open), programs):
                groups[groups.index(group)] = both
                groups.remove(other)
    return groups


def _are_like(program: Program, alone: list[Program]) -> bool:
    least = min(p.work for p in alone)
    certain = _certain(program)
    return least >= LEAST and program.work <= MORE * least and all(_certain(p) == certain for p in alone)


def _certain(program: Program) -> list[object]:
    """Of each output whether it is absent, present, or neither for certain."""
    flags = [flag for flag, _ in program.outputs]
    return [None if f is None else program.constants.get(f, "asked") for f in flags]
