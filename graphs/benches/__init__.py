"""Experiments over the graphs: each a function of settings that returns a table, one module each."""

from __future__ import annotations

import importlib.util
import os
from contextlib import suppress
from pathlib import Path

from flowgraph import DataError, MissingDependencyError
from flowgraph.engines.registry import find_engine

__all__ = ["engine_of", "recordings"]


def recordings(data: str | None, name: str, pattern: str) -> list[Path]:
    """The recordings of a dataset: files that match `pattern` in a folder, or in its folder `name`.

    Args:
        data: the folder; $FLOWGRAPH_DATA, or ../shared/datasets, where it is None.

    Raises:
        DataError: where there is none.
    """
    root = Path(data or os.environ.get("FLOWGRAPH_DATA") or "../shared/datasets").expanduser()
    for folder in (root / name, root):
        found = sorted(folder.glob(pattern))
        if found:
            return found
    raise DataError(
        f"there are no recordings of {name}",
        path=str(root),
        expected=f"{pattern} in it, or in its folder {name}",
        got="no such folder" if not root.is_dir() else "none",
        fix="give the folder with --data DIR, or in $FLOWGRAPH_DATA",
    )


def engine_of(engine: str, *, many: bool = False) -> str:
    """The engine to run: with "auto" xla where JAX is installed, else python.

    many: of many runs, where compiling counts for little, c before these where there is a compiler.
    """
    if engine != "auto":
        return engine
    if many:
        with suppress(MissingDependencyError):
            find_engine("c").need()
            return "c"
    return "xla" if importlib.util.find_spec("jax") is not None else "python"
