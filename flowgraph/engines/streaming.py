"""Runs that are longer than memory: events in as they come, results out to Parquet, and nothing kept between.

The events are read some ticks at a time, played, and written as a row group of each stream; the registers
are all that goes on to the next. So a run takes the memory of one stretch, in any engine and over any length.
After some stretches the files are closed and a note is written of how far they go and of the state there.
That note is the checkpoint of such a run: its cost does not grow with what was written before.

    streamed/run.json              how far, of which run
    streamed/state-00001.npz       the state after part 0
    streamed/belief/part-00000.parquet
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flowgraph.data.export.packages import needed
from flowgraph.data.export.tables import ParquetParts
from flowgraph.data.files import put, text_of
from flowgraph.data.inputs import Inputs
from flowgraph.data.pieces import nothing, stretches
from flowgraph.data.result import Result, statistics
from flowgraph.engines.checkpoint import program_digest
from flowgraph.engines.options import Meter, RunOptions
from flowgraph.engines.parts import run_graph
from flowgraph.engines.state import load_state, save_state
from flowgraph.errors import DataError, writes
from flowgraph.language.checks import need_count
from flowgraph.language.graph import NEVER, Graph

NOTE = "run.json"
FORMAT = 1
TICKS, PARTS = 65_536, 16


@dataclass(frozen=True)
class Streamed:
    """What a streamed run has written.

    Args:
        folder: with a folder a stream, which `pyarrow.dataset` and pandas read as one table.
        ticks: how many were run in all, those before a resumption included.
        wall_s: seconds spent in the engine's loop by this call.
        state: after the last tick.
        stats, notes: as of a `Result`.
    """

    folder: Path
    ticks: int
    wall_s: float
    state: Mapping[str, Any]
    stats: Mapping[str, int]
    notes: tuple[str, ...]


def simulate_to_parquet(
    graph: Graph,
    inputs: Inputs,
    folder: str | Path,
    *,
    engine: str = "python",
    dtype: str = "float64",
    init: Mapping[str, Any] | None = None,
    state: Mapping[str, Any] | None = None,
    seed: int = 0,
    progress: Meter | None = None,
    diverged: str = "raise",
    ticks: int = TICKS,
    parts: int = PARTS,
    resume: bool = False,
    about: Mapping[str, Any] | None = None,
) -> Streamed:
    """Run a graph over inputs of any length, and write what comes of it as it comes.

    Args:
        graph, inputs, engine, dtype, init, state, seed, progress, diverged: as `simulate` takes them. Inputs
            that are iterables, of `(time, value)` or of `Series` one after the other, are read as far as they
            are needed; arrays are read and checked many times faster than single events.
        folder: for the files; made if missing. What an earlier run of it has left must be resumed or gone.
        ticks: that are played at a time: what they take is the memory of the run.
        parts: of so many of these a file is made, after which a run can be resumed.
        resume: go on with what the folder says. Give the same inputs, from their beginning or from any event
            that was not played yet on; of what was played nothing is played again.
        about: plain values to keep in the note, such as the command.

    Raises:
        As `simulate`. DeclarationError: for less than one tick or part. DataError: for a folder that holds
        another run, or none to go on with. MissingDependencyError: without pyarrow.
    """
    for package in ("pyarrow", "pyarrow.parquet"):
        needed(package, "Parquet", "parquet")
    for name, given in (("ticks", ticks), ("parts", parts)):
        need_count("simulate_to_parquet", name, given, least=1)
    target = Path(folder)
    options = RunOptions(engine=engine, dtype=dtype, init=init, state=state, seed=seed, diverged=diverged)
    which = {
        "format": FORMAT, "graph": graph.name, "program": program_digest(graph), "engine": engine,
        "dtype": dtype, "seed": str(seed),
    }  # fmt: skip
    done, number = 0, 0
    found = _noted(target, which, resume)
    about = about or {}
    if found is not None:
        about = about or found.get("about", {})
        done, number = int(found["ticks"]), int(found["part"])
        options = options.but(init=None, state=load_state(target / found["state"]))
    with writes(target):
        target.mkdir(parents=True, exist_ok=True)
    last: Result | None = None
    wall, notes = 0.0, dict[str, None]()
    before = {} if options.state is None else options.state["sources"]
    played = stretches(graph, inputs, {n: int(before.get(n, NEVER)) for n in graph.sources}, ticks)
    for head in played:
        with ParquetParts(target, number, {"graph": graph.name, "engine": engine}) as files:
            for stretch in itertools.chain([head], itertools.islice(played, parts - 1)):
                last = run_graph(graph, stretch, options)
                files.add(last.series)
                options = options.but(init=None, state=last.state)
                done, wall = done + last.ticks, wall + last.wall_s
                notes.update(dict.fromkeys(last.notes))
                if progress is not None:
                    progress.update(done, max(int(t) for t in last.state["sources"].values()))
        number += 1
        assert last is not None
        _write_note(target, {**which, "about": dict(about)}, done, number, last.state)
    if last is None:  # nothing came
        last = run_graph(graph, nothing(graph), options)
    return Streamed(target, done, wall, last.state, statistics(graph, last.state), tuple(notes))


def _noted(folder: Path, which: Mapping[str, Any], resume: bool) -> dict[str, Any] | None:
    """What the folder says of an earlier run; None for one that begins."""
    file = folder / NOTE
    if not resume:
        if file.exists():
            raise DataError(
                "a streamed run is already here", path=str(file), expected="a folder without one",
                got="its note",
                fix="go on with resume=True (--resume DIR), name another folder, or remove this one",
            )  # fmt: skip
        return None
    try:
        found: dict[str, Any] = json.loads(text_of(file))
        wrong = [part for part in which if found[part] != which[part]]
        if not {"ticks", "part", "state"} <= set(found):
            raise ValueError("it does not say how far it goes")
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise DataError(
            "there is no streamed run to go on with", path=str(file), expected="the note of one",
            got=f"{type(error).__name__}: {error}"[:200],
            fix="name the folder of one, or start it anew, without resume",
        ) from None  # fmt: skip
    if wrong:
        raise DataError(
            f"this streamed run is of another {wrong[0]}", path=str(file), expected=str(which[wrong[0]]),
            got=str(found[wrong[0]]), fix="give what the first run was given, or start anew elsewhere",
        )  # fmt: skip
    return found


def streamed_about(folder: str | Path) -> dict[str, Any]:
    """What was kept with a streamed run, such as its command.

    Raises:
        DataError: for a folder without one.
    """
    found = _noted(Path(folder), {}, True)
    about = None if found is None else found.get("about", {})
    return about if isinstance(about, dict) else {}


def _write_note(folder: Path, which: Mapping[str, Any], ticks: int, part: int, state: Any) -> None:
    name = f"state-{part:05}.npz"
    save_state(state, folder / name)
    put(folder / NOTE, json.dumps({**which, "ticks": ticks, "part": part, "state": name}, indent=1) + "\n")
    with suppress(OSError):
        (folder / f"state-{part - 1:05}.npz").unlink(missing_ok=True)
