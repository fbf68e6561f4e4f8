"""Runs that outlive their process: kept in a file now and then, and gone on with to the same bits.

A recording is played in stretches. After each a file takes the place of the last one, whole or not at all:
the registers (queues, counters and stamps are registers too), the seed (random numbers have no other memory),
how many ticks of the recording are done, and the outputs so far. A process that is killed at any moment
leaves the last whole one.

Going on plays the rest of the same recording. So the file says of which run it is, by digests of the graph,
the recording and the start, and is refused by name where one differs. What a block on the host remembers by
itself is in no register, and is not kept.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import arrays_of, whole
from flowgraph.data.result import Result
from flowgraph.data.series import Series, chained
from flowgraph.data.tape import Tape
from flowgraph.engines.options import Checkpoint, Meter, RunOptions
from flowgraph.engines.state import flat_state, nested_state
from flowgraph.errors import DataError, LoweringError
from flowgraph.language.graph import Graph
from flowgraph.pipeline.digests import digest, graph_digest, package_version, python_digest
from flowgraph.pipeline.lowering import lower
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.types import Type, unflatten

FORMAT = 1

PARTS = {
    "version": ("version of flowgraph", "go on with the version that wrote it, or start the run anew"),
    "graph": ("graph", "name the graph that it was written of"),
    "engine": ("engine", "go on in the engine that it was written by"),
    "dtype": ("kind of number", "give the dtype of the first run"),
    "passes": ("choice of passes", "give the passes of the first run"),
    "seed": ("seed", "give the seed of the first run"),
    "inputs": ("recording", "give the data and the settings of the first run"),
    "program": ("form of this graph", "give the settings of the first run; changed code starts anew"),
    "start": ("start", "give the settings, init= or state= of the first run"),
}
"""What a checkpoint is of: how a message calls it, and what to do where it differs."""

Stretch = Callable[[int, int], Result]
"""Plays the ticks from the first on, before the last, and gives what came of them."""


def identity(
    name: str, program: str, tape: Tape, start: Any, seed: int, options: RunOptions, *, passes: Any = ()
) -> dict[str, str]:
    """What a run is of, by the names of `PARTS`."""
    inputs = [(s.time, dict(s.leaves)) for s in tape.series]
    return {
        "version": package_version(), "graph": name, "program": program, "inputs": digest(inputs),
        "start": digest(start), "seed": str(seed), "engine": options.engine, "dtype": options.dtype,
        "passes": ",".join(passes),
    }  # fmt: skip


def program_digest(graph: Graph) -> str:
    """Of a graph with its numbers and its code."""
    try:
        lowered = graph_digest(lower(graph))
    except LoweringError:
        return python_digest(graph, every=True)
    return digest((lowered, python_digest(graph)))


def pipeline_digest(pipeline: Pipeline) -> str:
    """Of a pipeline with its numbers."""
    return graph_digest(pipeline)


@dataclass(frozen=True)
class Kept:
    """What a checkpoint holds.

    Args:
        identity: what the run is of.
        ticks: how many of them are done.
        state: after them.
        outputs: leaves by output, and under "" the times.
        about: what whoever wrote it has added.
    """

    identity: Mapping[str, str]
    ticks: int
    state: Mapping[str, Any]
    outputs: Mapping[str, Mapping[str, np.ndarray]]
    about: Mapping[str, Any]


def read_checkpoint(file: str | Path) -> Kept:
    """Read a checkpoint.

    Raises:
        DataError: where there is none, or it is cut, damaged, or of another format.
    """
    try:
        flat = arrays_of(file)
        head = json.loads(flat.pop("head").tobytes())
        if head["format"] != FORMAT:
            raise ValueError(f"format {head['format']!r}, where this version reads {FORMAT}")
        outputs: dict[str, dict[str, np.ndarray]] = {name: {} for name in head["outputs"]}
        for key in [k for k in flat if k.startswith("outputs\n")]:
            _, name, leaf = key.split("\n")
            outputs[name][leaf] = flat.pop(key)
        found = head["identity"], int(head["ticks"]), nested_state(flat), outputs
        if set(found[0]) != set(PARTS) or found[1] < 0 or "seed" not in found[2]:
            raise ValueError("parts of it are missing")
        return Kept(*found, dict(head["about"]))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise DataError(
            "this is no checkpoint",
            path=str(file),
            expected="a whole file written by a run with --checkpoint",
            got=f"{type(error).__name__}: {error}"[:300],
            fix="name the file of the run that was broken off; where there is none yet, start it anew",
        ) from None


def write_checkpoint(file: str | Path, kept: Kept) -> None:
    """Write a checkpoint; the one that is there stays until the new one is whole."""
    head = {
        "format": FORMAT, "identity": dict(kept.identity), "ticks": kept.ticks,
        "outputs": list(kept.outputs), "about": dict(kept.about),
    }  # fmt: skip
    arrays = {
        "head": np.frombuffer(json.dumps(head).encode(), np.uint8),
        **flat_state(kept.state),
        **{f"outputs\n{n}\n{leaf}": a for n, leaves in kept.outputs.items() for leaf, a in leaves.items()},
    }
    with whole(file) as out:
        np.savez(out, **arrays)  # type: ignore[arg-type]


class Keeper:
    """Plays a recording in stretches, and keeps the run after each.

    Args:
        asked: the files, and the time between them.
        identity: what the run is of.
        tape: all ticks of the recording.
        types: of the outputs, by name.

    Attributes:
        start: the checkpoint from which the run goes on; None for one that begins.

    Raises:
        DataError: for a checkpoint to go on from that is none, or is of another run.
    """

    def __init__(
        self, asked: Checkpoint, identity: Mapping[str, str], tape: Tape, types: Mapping[str, Type]
    ) -> None:
        self._asked, self._identity, self._tape, self._types = asked, identity, tape, types
        self.start = None if asked.resume is None else read_checkpoint(asked.resume)
        self._done = 0
        self._parts: list[Result] = []
        if self.start is not None:
            _check_same(str(asked.resume), self.start.identity, identity)
            self._done = self.start.ticks
            if self._done > len(tape.time) or set(self.start.outputs) != set(types):
                raise _other(str(asked.resume), "inputs", "fewer ticks or outputs", "more")
            self._parts.append(self._before(self.start))

    def play(self, stretch: Stretch) -> Result:
        """Play to the end of the recording; gives the whole run."""
        for first, last in self.stretches():
            self.add(stretch(first, last))
            if self._asked.file is not None and last < len(self._tape.time):
                self._write(self._asked.file)
        return self.whole()

    def stretches(self) -> Iterator[tuple[int, int]]:
        """The ticks still to be played, cut where a checkpoint is due: the first, and one past the last."""
        time, first, end = self._tape.time, self._done, len(self._tape.time)
        step = round(self._asked.every * 1e9)
        while first < end:
            due = int(time[0]) + ((int(time[first]) - int(time[0])) // step + 1) * step
            cut = self._asked.file is not None and due <= int(time[-1])
            last = int(np.searchsorted(time, due)) if cut else end
            yield first, last
            first = last
        if self._done == end and not self._parts:
            yield end, end

    def add(self, part: Result) -> None:
        """The next stretch has been played."""
        self._parts.append(part)
        self._done += part.ticks

    def whole(self) -> Result:
        """All stretches so far as one result."""
        if len(self._parts) > 1:
            self._parts = [_joined(self._parts, self._types)]
        return self._parts[0]

    def meter(self, meter: Meter | None, *, anew: bool = True) -> Meter | None:
        """A meter of the whole run for what counts anew with each stretch; or else since the run went on."""
        before = self._done if anew else self.start.ticks if self.start is not None else 0
        return None if meter is None else _Onward(meter, before)

    def _write(self, file: str | Path) -> None:
        found = self.whole()
        outputs = {n: {"": s.time, **s.leaves} for n, s in found.series.items()}
        write_checkpoint(file, Kept(self._identity, self._done, found.state, outputs, self._asked.about))

    def _before(self, kept: Kept) -> Result:
        try:
            series = {name: _series(kept.outputs[name], type_, name) for name, type_ in self._types.items()}
        except (KeyError, ValueError, TypeError, StopIteration) as error:
            raise _other(str(self._asked.resume), "graph", str(error), "other outputs") from None
        name, engine = self._identity["graph"], self._identity["engine"]
        return Result(name, engine, series, kept.state, {}, kept.ticks, 0.0)


class _Onward:
    def __init__(self, meter: Meter, before: int) -> None:
        self._meter, self._before = meter, before

    def update(self, ticks: int, time: int) -> None:
        self._meter.update(self._before + ticks, time)


def _series(leaves: Mapping[str, np.ndarray], type_: Type, name: str) -> Series:
    made = [array for leaf, array in leaves.items() if leaf != ""]
    return Series(leaves[""], unflatten(type_, iter(made)), type=type_, name=name, gaps=True)


def _joined(parts: list[Result], types: Mapping[str, Type]) -> Result:
    series = {name: chained([p.series[name] for p in parts]) for name in types}
    ticks, wall = sum(p.ticks for p in parts), sum(p.wall_s for p in parts)
    return replace(parts[-1], series=series, ticks=ticks, wall_s=wall)


def _check_same(file: str, kept: Mapping[str, str], now: Mapping[str, str]) -> None:
    for part in PARTS:
        if kept[part] != now[part]:
            raise _other(file, part, now[part], kept[part])


def _other(file: str, part: str, expected: str, got: str) -> DataError:
    what, fix = PARTS[part]
    return DataError(
        f"this checkpoint is of another {what}", path=file, expected=expected, got=got, fix=fix
    )  # fmt: skip
