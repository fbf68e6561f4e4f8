"""Where the files of a study are: beside the file that names them, whatever folder a command is run in.

A study is moved, resumed and compared by what it says, so a path in it means the same everywhere: what a file
says is relative to that file, what a program says to the folder it runs in, and what is kept is absolute.
"""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from flowgraph.data.joint import parts_of
from flowgraph.data.own import is_in_file, kind_and_place
from flowgraph.data.registry import find_entry, flight_names
from flowgraph.errors import DeclarationError

__all__ = ["absolute", "beside", "placed_graphs"]


def absolute(spec: str, folder: Path) -> str:
    """A flight, such as "euroc:DIR", with what it names in `folder` by its absolute path."""
    return "+".join(_absolute(part, folder) for part in parts_of(spec, flight_names()))


def placed_graphs(graphs: Iterable[Any], parameters: Any, folder: Path) -> tuple[list[Any], Any]:
    """Graphs of a study in that folder, each FILE.py:NAME with the absolute path of its file; and the
    parameters, of which those of one graph stand under its name."""
    names = list(graphs)
    placed = {name: _absolute_name(name, folder) for name in names if isinstance(name, str)}
    if isinstance(parameters, Mapping):
        parameters = {placed.get(n, n): values for n, values in parameters.items()}
    return [placed[n] if isinstance(n, str) else n for n in names], parameters


def _absolute_name(name: str, folder: Path) -> str:
    return _path(folder, os.path.expanduser(name)) if is_in_file(name) else name


def _absolute(spec: str, folder: Path) -> str:
    kind, colon, rest = spec.partition(":")
    if is_in_file(kind_and_place(spec)[0]):
        own, place = kind_and_place(spec)
        further = _path(folder, place) if _is_in(folder, place) else place
        return _absolute_name(own, folder) + (f":{further}" if place else "")
    if not rest or not _has_place(kind):
        return spec
    whole, more = rest, ""
    while not _is_in(folder, whole) and ":" in whole:  # KIND:WHERE:MORE, and a name may have a colon in it
        whole, _, last = whole.rpartition(":")
        more = f":{last}{more}"
    if not _is_in(folder, whole):
        return spec
    further = [_path(folder, m) if _is_in(folder, m) and set("./") & set(m) else m for m in more.split(":")]
    return kind + colon + _path(folder, whole) + ":".join(further)


def beside(spec: Any, folder: Path) -> Any:
    """A flight of a study in that folder, with absolute paths; what is no text is left to other checks.

    Raises:
        DeclarationError: for a path from where the command runs, which is not the folder of the study.
    """
    if not isinstance(spec, str):
        return spec
    found, here = absolute(spec, folder), absolute(spec, Path.cwd())
    if found == spec != here:
        raise DeclarationError(
            "a path in a study is relative to the study's file",
            path=f"data: {spec}",
            expected=f"a file or folder in {folder}",
            got="one in the folder where the command runs",
            fix=f"write {here}, or its path from {folder}",
        )
    return found


def _has_place(kind: str) -> bool:
    """Whether flights of a kind are somewhere; those that can do without an argument are made."""
    if kind not in flight_names():
        return False
    first = next(iter(inspect.signature(find_entry("flowgraph.flights", kind)).parameters.values()), None)
    return first is not None and first.default is first.empty


def _is_in(folder: Path, path: str) -> bool:
    try:
        return bool(path) and not path.startswith("~") and (folder / path).exists()
    except (OSError, ValueError):  # no name of a file
        return False


def _path(folder: Path, path: str) -> str:
    return os.path.normpath(os.path.abspath(folder / path))
