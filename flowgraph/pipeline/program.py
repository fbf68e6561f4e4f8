"""Programs: a pipeline specialised for what is known of a tick, and cleaned of what is then unused.

With a pattern of present sources, every selection on presence folds to one of its sides, and the
instructions that only the other side needed disappear. Without one, presence stays an input.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from flowgraph.pipeline.pipeline import Pipeline, work
from flowgraph.recorder.ops import ELEMENTWISE, Spec
from flowgraph.recorder.trace import Instruction


@dataclass(frozen=True)
class Program:
    """Instructions in order, with what they start from and end in.

    Args:
        constants: value number -> array.
        instructions: only those that an output or a register needs.
        outputs: for each output port, (presence, leaves) as value numbers; presence None: known absent.
        writes: for each register cell in order, the value number written back.
        reads: for each register cell in order, the number of its value in a tick.
        symmetric: of those, the square matrices that are symmetric at reset.
        lanes: sizes of axes along which the same is done many times, such as particles.
        origin: for a value that an optimisation has added, the value of the pipeline that it serves.
        elements: for factors of products that are mostly zero, what each element is: a float that is known,
            the number of the scalar value that it equals, or None.
    """

    constants: Mapping[int, np.ndarray]
    instructions: tuple[Instruction, ...]
    outputs: tuple[tuple[int | None, tuple[int, ...]], ...]
    writes: tuple[int, ...]
    specs: Mapping[int, Spec]
    reads: tuple[int, ...] = ()
    symmetric: frozenset[int] = frozenset()
    lanes: frozenset[int] = frozenset()
    origin: Mapping[int, int] = field(default_factory=dict)
    elements: Mapping[int, np.ndarray] = field(default_factory=dict)

    @cached_property
    def surely(self) -> tuple[frozenset[int], tuple[Instruction, ...]]:
        """The values that every tick needs, and backwards the instructions that may need others."""
        sure = set(self.writes)
        for flag, leaves in self.outputs:
            if flag is not None:
                sure.add(flag)
                sure.update(leaves if flag in self.constants else ())
        for i in reversed(self.instructions):
            if i.out in sure:
                sure.update(i.args[:1] if i.op == "where" else i.args)
        others = (i for i in reversed(self.instructions) if i.op == "where" or i.out not in sure)
        return frozenset(sure), tuple(others)

    @cached_property
    def users(self) -> Mapping[int, tuple[Instruction, ...]]:
        """By value, the instructions that take it."""
        found: dict[int, list[Instruction]] = {}
        for i in self.instructions:
            for a in set(i.args):
                found.setdefault(a, []).append(i)
        return {n: tuple(some) for n, some in found.items()}

    @property
    def work(self) -> int:
        """About how many scalar operations it takes."""
        return sum(work(i, self.specs) for i in self.instructions)


def specialise(pipeline: Pipeline, key: int | None, open: int = 0) -> Program:
    """The program for the pattern `key` (bit k: input k is present), or for any pattern with None.

    Args:
        open: inputs, a bit each, whose presence is not known all the same.
    """
    known: dict[int, bool] = {
        n: bool(a) for n, a in pipeline.constants.items() if a.dtype == bool and a.shape == ()
    }
    if key is not None:
        ports = [(k, port) for k, port in enumerate(pipeline.inputs) if not open >> k & 1]
        known.update({port.present: bool(key >> k & 1) for k, port in ports})
    same: dict[int, int] = {}
    kept: list[Instruction] = []
    for i in pipeline.instructions:
        args = tuple(same.get(a, a) for a in i.args)
        fact = _fold(i, args, known, pipeline.specs)
        if isinstance(fact, bool):
            known[i.out] = fact
        elif fact is not None:
            same[i.out] = fact
        else:
            kept.append(Instruction(i.op, args, i.attrs, i.out, i.spec, i.line))
    outputs = []
    for port in pipeline.outputs:
        present = same.get(port.present, port.present)
        absent = known.get(present) is False
        outputs.append(
            (
                None if absent else present,
                () if absent else tuple(same.get(x.value, x.value) for x in port.leaves),
            )
        )
    writes = tuple(same.get(c.write, c.write) for r in pipeline.registers for c in r.cells)
    constants = dict(pipeline.constants) | {n: np.asarray(v) for n, v in known.items()}
    live, needed = _live(
        kept, [*writes, *(n for p, leaves in outputs for n in (*leaves, *([] if p is None else [p])))]
    )
    cells = [c for r in pipeline.registers for c in r.cells]
    return Program(
        {n: a for n, a in constants.items() if n in needed},
        live,
        tuple(outputs),
        writes,
        pipeline.specs,
        tuple(c.read for c in cells),
        frozenset(c.read for c in cells if is_symmetric(c.reset)),
        _lanes(pipeline),
    )


_WIDE = 32


def _lanes(pipeline: Pipeline) -> frozenset[int]:
    """Sizes of named axes that are wider than any matrix of a filter."""
    parts = [c for r in pipeline.registers for c in r.cells]
    parts += [x for port in (*pipeline.inputs, *pipeline.outputs) for x in port.leaves]  # type: ignore[misc]
    named = (n for part in parts for n, axis in zip(part.shape, part.axes, strict=False) if axis)
    return frozenset(n for n in named if n > _WIDE)


def is_symmetric(value: Any) -> bool:
    """Whether this is a square matrix that equals its transpose to the bit."""
    array = np.asarray(value)
    return array.ndim == 2 and array.shape[0] == array.shape[1] and bool((array == array.T).all())


def _fold(
    i: Instruction, args: tuple[int, ...], known: dict[int, bool], specs: Mapping[int, Spec]
) -> bool | int | None:
    """What an instruction's result is known to be: a truth value, another value, or None for not known."""
    facts = [known.get(a) for a in args]
    if i.op == "where" and facts[0] is not None:
        chosen = args[1] if facts[0] else args[2]
        if specs[chosen] == i.spec:
            return known.get(chosen, chosen) if i.spec == Spec((), "bool") else chosen
    if i.op == "logical_not" and facts[0] is not None:
        return not facts[0]
    if i.op in ("logical_and", "logical_or") and i.spec.shape == ():
        ends = i.op == "logical_or"
        if ends in facts:
            return ends
        unknown = [a for a, f in zip(args, facts, strict=True) if f is None]
        return (not ends) if not unknown else unknown[0] if len(unknown) == 1 else None
    return None


def needed(program: Program, env: Mapping[int, Any], tail: tuple[int, ...] = ()) -> dict[int, Any]:
    """Which elements of each value bear on an output or a register in this tick: a mask, or True for all.

    A selection needs what it takes: the quotient beside a guard `where(small, 1.0, x / y)` may be of any
    size.

    Args:
        program: of the tick.
        env: the values in it.
        tail: sizes of axes that all values have behind their own, as one of several flights: each by itself.
    """
    sure, others = program.surely
    taken: dict[int, Any] = dict.fromkeys(sure, True)
    for flag, leaves in program.outputs:
        there = env.get(flag, True) if flag is not None else False
        if np.all(there):
            taken.update(dict.fromkeys(leaves, True))
        elif np.any(there):
            taken.update((n, _either(taken.get(n, False), there)) for n in leaves)
    for i in others:
        mask = taken.get(i.out, False)
        if mask is not True and not np.any(mask):
            continue
        for place, a in enumerate(i.args):
            before = taken.get(a, False)
            if before is not True:
                taken[a] = _either(before, _through(i, place, mask, env, tail))
    return {n: mask for n, mask in taken.items() if mask is True or np.any(mask)}


def needed_of(program: Program, env: Mapping[int, Any], values: Iterable[int]) -> dict[int, Any]:
    """What `needed` says of some values alone, found from these on: quick where they are few."""
    sure, _ = program.surely
    ends = {n for flag, leaves in program.outputs if flag is not None and env.get(flag, True) for n in leaves}
    known: dict[int, Any] = {}

    def of(n: int) -> Any:
        """The mask of a value: True, or False for none, or by element."""
        if n in known:
            return known[n]
        mask: Any = n in sure or n in ends
        for i in () if mask is True else program.users.get(n, ()):
            whole = of(i.out)
            if whole is False:
                continue
            for place, a in enumerate(i.args):
                if a == n:
                    mask = _either(mask, _through(i, place, whole, env))
            if mask is True:
                break
        known[n] = mask = mask if mask is True or np.any(mask) else False
        return mask

    asked = set(values)
    try:
        return {n: mask for n in asked if (mask := of(n)) is not False}
    except RecursionError:  # a chain of a thousand that nothing surely takes
        found = needed(program, env)
        return {n: found[n] for n in asked if n in found}


def _through(
    i: Instruction, place: int, mask: Any, env: Mapping[int, Any], tail: tuple[int, ...] = ()
) -> Any:
    """What an instruction of whose result a mask is needed needs of the argument at a place."""
    if i.op == "where" and place:
        chosen = np.asarray(env[i.args[0]], bool)
        mask = (chosen if place == 1 else ~chosen) & mask
    elif i.op != "where" and i.op not in ELEMENTWISE:
        if not tail or mask is True:
            return True
        whole = np.broadcast_to(mask, (*i.spec.shape, *tail))
        return np.any(whole, axis=tuple(range(len(i.spec.shape))))
    if mask is True:
        return True
    return _reduced(np.broadcast_to(mask, (*i.spec.shape, *tail)), np.shape(env[i.args[place]]))


def _either(a: Any, b: Any) -> Any:
    """What one mask or the other asks for: True for all."""
    return True if a is True or b is True else a | b


def _reduced(mask: Any, shape: tuple[int, ...]) -> Any:
    """A mask of a result for an argument that was broadcast to it."""
    mask = np.any(mask, axis=tuple(range(mask.ndim - len(shape))))
    wide = tuple(a for a, n in enumerate(shape) if n == 1 and mask.shape[a] != 1)
    return np.any(mask, axis=wide, keepdims=True) if wide else mask


def _live(instructions: list[Instruction], wanted: list[int]) -> tuple[tuple[Instruction, ...], set[int]]:
    needed = set(wanted)
    live = []
    for i in reversed(instructions):
        if i.out in needed:
            live.append(i)
            needed.update(i.args)
    return tuple(reversed(live)), needed
