"""A run that goes on from a checkpoint, or in the folder of a streamed run: what its command leaves out is as
it was in the first one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from flowgraph.data.notes import note
from flowgraph.engines.checkpoint import read_checkpoint
from flowgraph.engines.options import Checkpoint
from flowgraph.engines.streaming import streamed_about
from flowgraph.errors import DeclarationError


@dataclass(frozen=True)
class Command:
    """What a run is asked to play; `folder` is where the first of its commands was given, and names of files
    in the others are from there."""

    graph: str
    data: list[str]
    truth: str | None = None
    engine: str = "python"
    dtype: str = "float64"
    seed: int = 0
    settings: list[str] | None = None
    folder: str = ""

    @property
    def notes(self) -> tuple[str, ...]:
        """Where files are named from, if that is another folder than this."""
        if self.folder in ("", str(Path.cwd())):
            return ()
        return (note("info", f"the checkpoint was written in {self.folder}: its files are named from there"),)


def resumed(resume: Path | None, **given: Any) -> Command:
    """The command as given, filled up with that of the checkpoint or folder, or else with the defaults.

    Raises:
        DataError: for a file that is no checkpoint, or a folder without a streamed run.
        DeclarationError: where neither says which graph, or which data.
    """
    before: Mapping[str, Any] = {}
    if resume is not None:
        before = streamed_about(resume) if resume.is_dir() else read_checkpoint(resume).about
    found = {**before, **{name: value for name, value in given.items() if value is not None}}
    for name, spelled in (("graph", "GRAPH"), ("data", "--data SPEC")):
        if not found.get(name):
            raise DeclarationError(
                f"missing {'argument' if name == 'graph' else 'option'} {spelled}",
                path="run",
                expected="flowgraph run GRAPH --data SPEC, or --resume FILE",
                got=f"no {spelled}",
                fix="name it; `flowgraph list` names the graphs and the kinds of data",
            )
    found.setdefault("folder", str(Path.cwd()))
    return Command(**{name: value for name, value in found.items() if value is not None})


def kept_in(
    file: Path | None, every: float | None, resume: Path | None, command: Command
) -> Checkpoint | None:
    """How the run is kept, and from where it goes on; None where neither was asked for.

    Raises:
        DeclarationError: for a time between checkpoints where none are written.
    """
    if every is not None and file is None:
        raise DeclarationError(
            "there is a time between checkpoints, and no file for them",
            path="--every",
            expected="--checkpoint FILE --every SECONDS",
            got=f"--every {every:g} alone",
            fix="name the file, or leave --every out",
        )
    if file is None and resume is None:
        return None
    more = {} if every is None else {"every": every}
    return Checkpoint(file, resume=resume, about=asdict(command), **more)
