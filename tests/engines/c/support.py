"""Written C in a folder: built, replayed, and asked how it ended."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

from flowgraph import Graph, lower
from flowgraph.engines.c import write_c

STRICT = ("-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic")
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all")


def ran(*words: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """A program to its end."""
    return subprocess.run(
        [str(w) for w in words], cwd=cwd, capture_output=True, text=True, check=False, errors="replace"
    )


def built(folder: Path, *flags: str, compiler: Sequence[str] = ("cc",), module: str | None = None) -> Path:
    """The replay program of the one filter in a folder."""
    name = module or next(f.stem for f in folder.glob("*.h"))
    done = ran(*compiler, *(flags or STRICT), "-o", "replay", "main.c", f"{name}.c", "-lm", cwd=folder)
    assert done.returncode == 0, done.stderr[:2000]
    return folder / "replay"


def written(graph: Graph, folder: Path, *flags: str) -> Path:
    """The replay program of a graph."""
    write_c(lower(graph), folder)
    return built(folder, *flags)


def replays(program: Path, text: str | bytes) -> subprocess.CompletedProcess[str]:
    """How a csv file is replayed."""
    file = program.parent / "e.csv"
    file.write_bytes(text if isinstance(text, bytes) else text.encode())
    return ran(program, file)
