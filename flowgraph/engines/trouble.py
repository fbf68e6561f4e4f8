"""What ends a run before its inputs do: a queue that was full, and a number that is no longer finite.

Some engines stop there and others play on; here all come to the same. What is earliest in time is named, and
the error carries the result of the ticks before it. A run is looked at when it is over: at its outputs, and
at its registers as they are then. Where something is wrong it is played again, up to the tick in question.

A number that is not finite is an error where an operation made it. Where it was only moved it may stay: a NaN
that came in as data (`gaps`), an infinity or a NaN that a step writes down, an initial value.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from flowgraph.data.batch import Runs
from flowgraph.data.finite import finite
from flowgraph.data.notes import note
from flowgraph.data.result import Result
from flowgraph.data.tape import Tape
from flowgraph.engines.reference import Interpreter
from flowgraph.errors import DivergedError, FifoOverflowError, RunError
from flowgraph.language.graph import NEVER
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.recorder.random import seed_words

_MOVING = """where getitem reshape broadcast_to concat stack permute_dims matrix_transpose take roll flip sort
materialise tril triu"""
MOVES = frozenset(_MOVING.split())
"""Operations that make no number of their own."""

Place = tuple[str, str]
"""The name of an output or the path of a register, and a leaf of it."""


@dataclass(frozen=True)
class Playback:
    """A run that is over, and how to play it again.

    Args:
        pipeline: what was played; None for a graph that cannot be lowered.
        cells: its register cells at the start.
        gaps: gives the inputs, by name, whose leaf (by place) may hold a NaN.
        tape: gives the ticks.
        again: plays the first n ticks without looking; None where that would do things a second time.
    """

    pipeline: Pipeline | None
    cells: Sequence[Any]
    gaps: Callable[[], Mapping[str, Sequence[bool]]]
    tape: Callable[[], Tape]
    again: Callable[[int], Result] | None


class Astray(NamedTuple):
    """An output or register that is not finite: `time` of the first such value in ns, and how many rows."""

    place: Place
    time: int | None
    rows: int

    def __str__(self) -> str:
        if self.time is None:
            return f"register {_named(self.place)} is not finite at the end"
        return f"{self.rows} values of {_named(self.place)} are not finite, the first at t = {self.time} ns"


def gaps_of(tape: Tape, names: Sequence[str]) -> dict[str, list[bool]]:
    """The inputs whose leaves hold what is not finite."""
    return {
        name: [not finite(a) for a in s.leaves.values()] for name, s in zip(names, tape.series, strict=True)
    }


def cells_of(pipeline: Pipeline, state: Mapping[str, Any]) -> list[np.ndarray]:
    """The register cells of a pipeline, in order, from a state."""
    parts = dict(_leaves(state))
    return [parts[r.path, c.name] for r in pipeline.registers for c in r.cells]


def overflow(pipeline: Pipeline, cells: Sequence[Any]) -> FifoOverflowError | None:
    """The error of the queue that was full first, from the register cells at the end of a run."""
    values = iter(cells)
    found = {(r.path, c.name): next(values) for r in pipeline.registers for c in r.cells}
    times = [(int(found[f.register, f.cell]), k) for k, f in enumerate(pipeline.faults)]
    time, k = min((t for t in times if t[0] != NEVER), default=(NEVER, 0))
    if time == NEVER:
        return None
    fault = pipeline.faults[k]
    return overflow_error(fault.message, fault.path, fault.bound, time)


def overflow_error(message: str, path: str, bound: int | None, time: int) -> FifoOverflowError:
    """The error of a queue that was full at `time`."""
    error = FifoOverflowError(
        message,
        path=path,
        expected=f"at most {bound} waiting values of one stream",
        got=f"one more at t = {time} ns",
        fix="raise size=, or look why the other stream is silent",
    )
    error.time = time
    return error


def settled(result: Result, run: Playback, diverged: str, error: RunError | None = None) -> Result:
    """The result of a run, looked at; `error` is what ended it after the last tick of `result`.

    Raises:
        DivergedError: where a number is not finite, unless `diverged` is "count".
        RunError: `error`, with the result.
    """
    found = astray(result, run)
    if found and diverged == "raise":
        raise _diverged(result, run, found)
    if found:
        counts = {f"{_named(f.place)}.diverged": f.rows for f in found}
        notes = tuple(note("diverged", str(f)) for f in found)
        result = replace(result, stats={**result.stats, **counts}, notes=(*result.notes, *notes))
    if error is not None:
        error.result = result
        raise error
    return result


def all_finite(result: Result) -> bool:
    """Whether all that a run gave is finite."""
    arrays = [a for s in result.series.values() for a in s.leaves.values()]
    arrays += [a for _, a in _leaves(result.state)]
    return all(map(finite, arrays))


def astray(result: Result, run: Playback) -> list[Astray]:
    """What is not finite, outputs before registers."""
    outputs = [
        Astray((name, leaf), int(series.time[rows.argmax()]), int(rows.sum()))
        for name, series in result.series.items()
        for leaf, array in series.leaves.items()
        if (rows := _bad_rows(array)) is not None
    ]
    return _made(outputs, _bad_registers(result), run)


def _made(outputs: list[Astray], registers: list[Astray], run: Playback) -> list[Astray]:
    """Those that an operation of the pipeline made."""
    if run.pipeline is None or not (outputs or registers):
        return [*outputs, *registers]
    ours, moved = moved_leaves(run.pipeline, run.cells, run.gaps())
    return [f for f in outputs if ours.get(f.place)] + [f for f in registers if moved.get(f.place)]


def _bad_rows(array: np.ndarray) -> np.ndarray | None:
    if finite(array):
        return None
    found: np.ndarray = ~np.isfinite(array).reshape(len(array), -1).all(axis=1)
    return found


def _leaves(state: Mapping[str, Any]) -> Iterator[tuple[Place, np.ndarray]]:
    for path, part in state.get("registers", {}).items():
        for leaf, value in part.items() if isinstance(part, Mapping) else [("value", part)]:
            yield (path, leaf), np.asarray(value)


def _bad_registers(result: Result) -> list[Astray]:
    return [Astray(place, None, 1) for place, value in _leaves(result.state) if not finite(value)]


def moved_leaves(
    pipeline: Pipeline, cells: Sequence[Any], gaps: Mapping[str, Sequence[bool]]
) -> tuple[dict[Place, bool], dict[Place, bool]]:
    """For each leaf of an output and of a register, whether all that is not finite there was made there.

    Args:
        pipeline: of the run.
        cells: its register cells at the start.
        gaps: the inputs, by name, whose leaf may hold a NaN.
    """
    held = [(r.path, c) for r in pipeline.registers for c in r.cells]
    given = {n for n, a in pipeline.constants.items() if not finite(a)}
    for port in pipeline.inputs:
        may = gaps.get(port.name, [True] * len(port.leaves))
        given |= {leaf.value for leaf, gap in zip(port.leaves, may, strict=True) if gap}
    for (_, cell), value in zip(held, cells, strict=True):
        array = np.asarray(value)
        if not finite(array):
            given.add(cell.read)
    while True:
        for i in pipeline.instructions:
            if i.op in MOVES and not given.isdisjoint(i.args[1:] if i.op == "where" else i.args):
                given.add(i.out)
        more = {c.read for _, c in held if c.write in given} - given
        if not more:
            break
        given |= more
    outputs = {(p.name, leaf.name): leaf.value not in given for p in pipeline.outputs for leaf in p.leaves}
    return outputs, {(path, c.name): c.write not in given and c.read not in given for path, c in held}


def _named(place: Place) -> str:
    return place[0] if place[1] == "value" else f"{place[0]}.{place[1]}"


class ManyTroubles:
    """What ends runs of a batch, gathered while they are played.

    Args:
        pipeline: of all runs.
        cells, tape: of the n-th run, before its first tick.

    Attributes:
        full: the runs in which a queue was full.
    """

    def __init__(
        self, pipeline: Pipeline, cells: Callable[[int], Sequence[Any]], tape: Callable[[int], Tape]
    ) -> None:
        self._pipeline, self._cells, self._tape = pipeline, cells, tape
        self._held = [(r.path, c.name) for r in pipeline.registers for c in r.cells]
        self.full: dict[int, FifoOverflowError] = {}
        self._found: dict[int, list[Astray]] = {}

    def finish(self, n: int, cells: Sequence[Any]) -> None:
        """The n-th run has ended with these register cells."""
        if self._pipeline.faults and (error := overflow(self._pipeline, cells)) is not None:
            self.full[n] = error
        found = [
            Astray(place, None, 1)
            for place, cell in zip(self._held, map(np.asarray, cells), strict=True)
            if not finite(cell)
        ]
        if found:
            self._found[n] = self._made(n, [], found)

    def _made(self, n: int, outputs: list[Astray], registers: list[Astray]) -> list[Astray]:
        gaps = gaps_of(self._tape(n), [p.name for p in self._pipeline.inputs])
        ours, held = moved_leaves(self._pipeline, self._cells(n), gaps)
        return [f for f in outputs if ours[f.place]] + [f for f in registers if held[f.place]]

    def astray(self, series: Mapping[str, Runs]) -> dict[int, str]:
        """Runs in which what was kept, or a register at the end, is not finite, and what it is."""
        found: dict[int, list[Astray]] = {}
        for name, runs in series.items():
            for leaf, array in runs.leaves.items():
                if finite(array):
                    continue
                bad = ~np.isfinite(array).reshape(*array.shape[:2], -1).all(axis=2) & runs.present
                for n in np.flatnonzero(bad.any(axis=1)).tolist():
                    first = int(runs.time[bad[n].argmax()])
                    found.setdefault(n, []).append(Astray((name, leaf), first, int(bad[n].sum())))
        self._found = {
            n: self._made(n, found.get(n, []), self._found.get(n, [])) for n in sorted({*found, *self._found})
        }
        return {n: "; ".join(map(str, all_)) for n, all_ in self._found.items() if all_}

    def error(self, n: int) -> RunError:
        """The error of the n-th run, as far as the batch knows it."""
        return (
            self.full[n]
            if n in self.full
            else DivergedError(
                "a number is not finite any more",
                path=_named(self._found[n][0].place),
                expected="finite numbers",
                got=str(self._found[n][0]),
                fix='look at the settings and the data, or go on with diverged="count"',
            )
        )


# -- where it began ----------------------------------------------------------------------------------------


def _diverged(result: Result, run: Playback, found: list[Astray]) -> DivergedError:
    """The error of what was not finite first, with the result of the ticks before."""
    tape = run.tape()
    seen = min((f.time for f in found if f.time is not None), default=None)
    tick = len(tape.time) if seen is None else int(np.searchsorted(tape.time, seen))
    if run.again is None:
        tick = min(tick, len(tape.time) - 1)
        return _error(found[0], int(tape.time[tick]), tape, tick, _until(result, int(tape.time[tick])), run)
    before = run.again(tick)
    if astray(before, run):  # a register was, before an output was
        good, tick = 0, tick
        while tick - good > 1:
            middle = (good + tick) // 2
            if astray(run.again(middle), run):
                tick = middle
            else:
                good = middle
        tick -= 1
        before = run.again(tick)
    tick = min(tick, len(tape.time) - 1)
    first = astray(run.again(tick + 1), run) or found
    return _error(first[0], int(tape.time[tick]), tape, tick, before, run)


def _until(result: Result, time: int) -> Result:
    """What came before `time`; without a state, which is that of the end."""
    series = {name: s[s.time < time] for name, s in result.series.items()}
    return replace(result, series=series, state={}, stats={})


def _error(what: Astray, time: int, tape: Tape, tick: int, before: Result, run: Playback) -> DivergedError:
    last = int(tape.time[tick - 1]) if tick else None
    block, cause = _origin(run, tape, tick, what, before) or (what.place[0], "")
    error = DivergedError(
        "a number is not finite any more",
        path=block,
        expected=f"finite numbers in {'register' if what.time is None else 'output'} {_named(what.place)}",
        got=f"NaN or infinity at t = {time} ns{cause}; "
        + ("there was no tick before" if last is None else f"the last good tick is t = {last} ns"),
        fix='look at the settings and the data at that time, or go on with diverged="count"',
    )
    error.time, error.last, error.result = time, last, before
    return error


def _origin(run: Playback, tape: Tape, tick: int, what: Astray, before: Result) -> tuple[str, str] | None:
    """The block in which the number was first made, and by what: the tick is played once more, looked at."""
    pipeline = run.pipeline
    names = None if pipeline is None else [p.name for p in pipeline.inputs]
    if pipeline is None or len(tape.series) != len(names or ()) or not before.state:
        return None
    cells = cells_of(pipeline, before.state)
    key, time = int(tape.key[tick]), int(tape.time[tick])
    values = []
    for k, series in enumerate(tape.series):
        if key >> k & 1:
            row = int((tape.key[:tick] >> k & 1).sum())
            values.append(tuple(a[row] for a in series.leaves.values()))
    player = Interpreter(pipeline, cells, np.dtype(np.float64), seed_words(int(before.state["seed"])))
    with np.errstate(all="ignore"):
        program, env = player.values(time, key, values)
    ends = {
        (p.name, leaf.name): n
        for p, (_, numbers) in zip(pipeline.outputs, program.outputs, strict=True)
        for leaf, n in zip(p.leaves, numbers, strict=False)
    }
    held = [(r.path, c.name) for r in pipeline.registers for c in r.cells]
    writes = dict(zip(held, program.writes, strict=True))
    number = (writes if what.time is None else ends).get(what.place)
    if number is None or np.isfinite(env[number]).all():
        return None
    made = {i.out: i for i in program.instructions}
    stages = {i.out: stage.path for stage in pipeline.stages for i in stage.instructions}
    while number in made:
        i = made[number]
        worse = [
            a for a in _used(i, env) if np.asarray(env[a]).dtype.kind == "f" and not np.isfinite(env[a]).all()
        ]
        if not worse:
            return stages.get(number, what.place[0]), f", made by {i.op} at {i.line}"
        number = worse[0]
    given = {leaf.value: p.name for p in pipeline.inputs for leaf in p.leaves}
    source = f", from one of input {given[number]!r}" if number in given else ""
    return what.place[0], source


def _used(i: Any, env: Mapping[int, Any]) -> tuple[int, ...]:
    """The arguments that the result of an instruction may hold: of a selection, those that are selected."""
    if i.op != "where":
        return tuple(i.args)
    choice, yes, no = i.args
    return tuple(n for n, taken in ((yes, np.any(env[choice])), (no, not np.all(env[choice]))) if taken)
