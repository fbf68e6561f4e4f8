"""`run --stream`: a run whose results go to Parquet as they come, and which goes on where it was broken off.

Nothing is kept of what was written, so there is nothing to score, draw or export: what the folder holds is
read with `pyarrow.dataset` or pandas.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from time import perf_counter
from typing import Any

from flowgraph.cli.resume import Command
from flowgraph.cli.terminal import err_console
from flowgraph.data.notes import note
from flowgraph.data.progress import ProgressBar
from flowgraph.data.registry import Case
from flowgraph.engines.streaming import simulate_to_parquet
from flowgraph.errors import DeclarationError


def stream_folder(stream: Path | None, resume: Path | None, beside: Mapping[str, object]) -> Path | None:
    """Where a run is streamed to, by `--stream DIR` or `--resume DIR`; None for one that is not.

    Args:
        stream, resume: as given.
        beside: other options by name, which ask for a whole result.

    Raises:
        DeclarationError: for one of these that was given, or two places.
    """
    going_on = resume is not None and resume.is_dir()
    folder = resume if going_on else stream
    if folder is None:
        return None
    if resume is not None and stream is not None and stream != resume:
        raise DeclarationError(
            "a streamed run goes on in its own folder",
            path="--resume",
            expected="--resume DIR, with what --stream DIR has written",
            got=f"--stream {stream} and --resume {resume}",
            fix="leave one of them out",
        )
    asked = [name for name, value in beside.items() if value not in (None, False)]
    if asked:
        raise DeclarationError(
            f"a streamed run keeps nothing that {asked[0]} could take",
            path="--stream",
            expected="--stream DIR alone: its results are in the folder",
            got=", ".join(asked),
            fix=f"leave {asked[0]} out, or run the whole recording without --stream",
        )
    return folder


def streamed(
    case: Case,
    command: Command,
    folder: Path,
    *,
    resume: bool,
    diverged: str,
    quiet: bool,
    say: Callable[[tuple[str, ...]], None],
) -> dict[str, Any]:
    """Run a case into a folder; returns the row of the run."""
    start = perf_counter()
    hidden = quiet or not err_console.is_terminal
    name, engine = command.graph, command.engine
    with (
        nullcontext()
        if hidden
        else ProgressBar(f"{name} ({engine})", total=case.inputs, console=err_console) as meter
    ):
        found = simulate_to_parquet(
            case.graph, case.inputs, folder, engine=engine, dtype=command.dtype, seed=command.seed,
            progress=meter, diverged=diverged, resume=resume, about=asdict(command),
        )  # fmt: skip
    say(found.notes)
    say((note("info", f"streamed to {folder}, a folder of Parquet a stream; nothing is scored or drawn"),))
    row = {"graph": name, "engine": engine, "ticks": found.ticks, "wall_s": found.wall_s}
    return row | {"setup_s": perf_counter() - start - found.wall_s, **found.stats}
