"""What the rounding of one value alone does to what a filter is judged by, for each value in turn.

Some ticks of a flight are played in float64, and played again from one value on, which is rounded to its
format: how far does that move what is judged, at once or through a register until later? This is no bound,
but an order: where bits are short, they are missed first in the values that stand first.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

import numpy as np

from flowgraph.engines.fixed.abreast import Recorded, Step, abreast
from flowgraph.engines.numpy.rules import bound
from flowgraph.pipeline.formats import FREE
from flowgraph.pipeline.program import Program
from flowgraph.recorder.trace import Instruction

_SAMPLES, _EARLY = 5, 7
"""Ticks of each pattern of present inputs that are looked at: some from the first to the last at equal
distances, and some more at the start, where a filter finds its biases and its gains are large."""

_WINDOWS = 3
"""Stretches over which what a register does is followed."""

_LONGEST = 512
"""Ticks of such a stretch at most."""

_SLIGHT = 2.0**-20
"""The part of itself by which a register is moved then."""

_COMPARISONS = frozenset(["less", "less_equal", "greater", "greater_equal", "equal", "not_equal"])

_REAL: np.dtype[Any] = np.dtype(np.float64)

Judged = Callable[[Program], Mapping[int, tuple[int, ...]]]
"""By a value that is judged, or a decision: the real values that it is made of, one or two that are
compared."""


def decisions(program: Program) -> dict[int, tuple[int, ...]]:
    """The last real values before truth values and integers of an output, or of a register."""
    specs, made = program.specs, {i.out: i for i in program.instructions}
    leaves = [n for flag, some in program.outputs if flag is not None for n in (flag, *some)]
    left = [n for n in (*leaves, *program.writes) if n in made and specs[n].dtype != "real"]
    found: dict[int, tuple[int, ...]] = {}
    seen = set(left)
    while left:
        i = made[left.pop()]
        real = tuple(a for a in i.args if specs[a].dtype == "real")
        if real:
            found[i.out] = real if i.op in _COMPARISONS else real[:1]
        more = {a for a in i.args if a in made and specs[a].dtype != "real"} - seen
        seen |= more
        left += more
    return found


def estimates(port: int, leaves: Collection[int]) -> Judged:
    """The leaves of an output that is judged by its numbers.

    Args:
        port: its place among the outputs.
        leaves: the places of the leaves.
    """

    def of(program: Program) -> dict[int, tuple[int, ...]]:
        flag, values = program.outputs[port]
        return {} if flag is None else {values[k]: (values[k],) for k in leaves}

    return of


def impacts(
    flight: Recorded, fractions: Mapping[int, np.ndarray], values: Collection[int], judged: Iterable[Judged]
) -> dict[int, float]:
    """How much the rounding of each value alone moves what is judged: 1 the most, 0 not at all.

    Of decisions that is the number that is expected to change, of others the part of their size; of what
    is kept in a register, as much as is gathered in as many ticks as the flight has.

    Args:
        flight: of a plain pipeline.
        fractions: to which each value is rounded.
        values: which to look at: no moves.
        judged: what is judged, of one or more kinds; each kind counts alike.
    """
    steps, after = _sampled(flight)
    found: dict[int, float] = dict.fromkeys(values, 0.0)
    with np.errstate(all="ignore"):
        for kind in judged:
            gains = _gains(flight, after, kind)
            gathered = float(np.sqrt(len(flight.tape.time)))
            mine: dict[int, float] = {}
            for step in steps:
                again = _Again(step)
                ends = kind(step.program)
                for value in values:
                    moved = again.rounded(value, fractions)
                    if not moved:
                        continue
                    most = _most(ends, moved, step.values, step.program)
                    for gain, n in zip(gains, step.program.writes, strict=True):
                        if gain and n in moved:
                            most = max(most, gathered * gain * _part(moved[n], step.values[n]))
                    mine[value] = max(mine.get(value, 0.0), most)
            largest = max(mine.values(), default=0.0)
            for value, size in mine.items():
                found[value] = max(found[value], size / largest if largest else 0.0)
    return found


def _sampled(flight: Recorded) -> tuple[list[Step], list[tuple[int, list[Any]]]]:
    """Some ticks of each pattern with all their values, and the registers after some of them."""
    keys = np.asarray(flight.tape.key)
    chosen: set[int] = set()
    rarest = np.zeros(0, int)
    for key in np.unique(keys):
        at = np.flatnonzero(keys == key)
        rarest = at if not rarest.size or at.size < rarest.size else rarest
        places = np.concatenate(
            [np.linspace(0, at.size - 1, _SAMPLES), np.geomspace(1, at.size, _EARLY) - 1.0]
        )
        chosen.update(at[np.unique(places.astype(int))].tolist())
    begun = rarest[np.unique(np.linspace(0, max(rarest.size - 2, 0), _WINDOWS).astype(int))].tolist()
    steps, after = [], []
    for n, step in enumerate(abreast([flight])):
        if n in chosen:
            steps.append(Step(step.program, step.key, dict(step.values), step.flights))
        if n in begun:
            after.append((n + 1, [np.asarray(step.values[w])[..., 0] for w in step.program.writes]))
    return steps, after


def _gains(flight: Recorded, after: Iterable[tuple[int, list[Any]]], judged: Judged) -> list[float]:
    """For each cell of the registers, by how much what is judged moves for a part of the cell by which all
    its elements are moved up or down: the most until an input as rare as that of the stretch comes again."""
    pipeline = flight.pipeline
    cells = [c for r in pipeline.registers for c in r.cells]
    real = [k for k, c in enumerate(cells) if c.dtype == "real"]
    gains = [0.0] * len(cells)
    for first, kept in after:
        kept = [np.broadcast_to(x, c.shape) for x, c in zip(kept, cells, strict=True)]
        keys = np.asarray(flight.tape.key[first : first + _LONGEST])
        again = np.flatnonzero(keys == flight.tape.key[first - 1])
        tape = flight.tape.part(first, first + (int(again[0]) + 1 if again.size else len(keys)))
        lanes = [Recorded(pipeline, tape, kept, flight.seed)]
        for k in real:
            turn = np.where(np.arange(kept[k].size).reshape(kept[k].shape) * 2654435761 >> 7 & 1, 1.0, -1.0)
            other = [*kept[:k], kept[k] * (1.0 + _SLIGHT * turn), *kept[k + 1 :]]
            lanes.append(Recorded(pipeline, tape, other, flight.seed))
        for step in abreast(lanes):
            ends = judged(step.program)
            involved = {a for args in ends.values() for a in args}
            for lane, k in enumerate(real, 1):
                env = {a: _lane(step.values[a], 0) for a in involved}
                moved = {a: _lane(step.values[a], lane) for a in involved}
                gains[k] = max(gains[k], _most(ends, moved, env, step.program) / _SLIGHT)
    return gains


def _lane(x: np.ndarray, k: int) -> np.ndarray:
    return x[..., k : k + 1] if x.shape[-1] > 1 else x


def _most(
    ends: Mapping[int, tuple[int, ...]],
    moved: Mapping[int, np.ndarray],
    env: Mapping[int, Any],
    program: Program,
) -> float:
    """The most by which anything judged moves: a decision by its number of elements."""
    most = 0.0
    for n, args in ends.items():
        if any(a in moved for a in args):
            had = [np.asarray(env[a]) for a in args]
            have = [np.asarray(moved.get(a, x)) for a, x in zip(args, had, strict=True)]
            part = _part(have[0] - have[-1], had[0] - had[-1]) if len(args) > 1 else _part(have[0], had[0])
            count = np.size(had[0]) if program.specs[n].dtype != "real" else 1
            most = max(most, part * count)
    return most


def _part(x: Any, y: Any) -> float:
    """The root mean square of x - y, by the mean size of y."""
    x, y = np.broadcast_arrays(x, y)
    there = np.isfinite(x) & np.isfinite(y)
    size = float(np.abs(y[there]).mean()) if there.any() else 0.0
    return float(np.sqrt(np.mean((x[there] - y[there]) ** 2))) / size if size > 0.0 else 0.0


class _Again:
    """A tick that is played again from one value on."""

    def __init__(self, step: Step) -> None:
        self._env = step.values
        self._steps: list[tuple[Instruction, Callable[..., Any]]] = [
            (i, bound(i, _REAL)) for i in step.program.instructions
        ]
        self._from = {i.out: k for k, (i, _) in enumerate(self._steps, 1)}

    def rounded(self, value: int, fractions: Mapping[int, np.ndarray]) -> dict[int, np.ndarray]:
        """The values that are others where one is rounded, which may be an input or a register."""
        if value not in self._env:
            return {}
        x = np.asarray(self._env[value])
        f = np.asarray(fractions[value])
        by = np.broadcast_to(np.where(f == FREE, 0, f)[..., None], x.shape).astype(int)
        rounded = np.ldexp(np.floor(np.ldexp(x, by) + 0.5), -by)
        moved = {value: np.where(np.isfinite(rounded), rounded, x)}
        for i, run in self._steps[self._from.get(value, 0) :]:
            if any(a in moved for a in i.args):
                made = run(*[moved.get(a, self._env[a]) for a in i.args])
                if not np.array_equal(made, self._env[i.out], equal_nan=made.dtype.kind == "f"):
                    moved[i.out] = made
        return moved
