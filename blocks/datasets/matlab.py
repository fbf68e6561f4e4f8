"""MATLAB files as plain dictionaries and arrays, with errors that name file and variable."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from flowgraph.errors import DataError, DeclarationError, UnknownNameError

__all__ = ["array", "choice", "known_settings", "number", "read_mat", "split_argument", "strictly_later"]


def read_mat(file: Path, *names: str) -> dict[str, Any]:
    """The variables of a .mat file, structs as dictionaries; `names` must be among them.

    Raises:
        DataError: the file is missing, is no MATLAB file before version 7.3, or lacks a variable.
    """
    if not file.is_file():
        raise DataError(
            "this file is missing",
            path=str(file),
            expected="a .mat file",
            got="a folder" if file.is_dir() else "no such file",
            fix="give the path of the .mat file",
        )
    try:
        content = loadmat(str(file), simplify_cells=True)
    except (MatReadError, NotImplementedError, ValueError, TypeError, OSError, KeyError) as error:
        raise DataError(
            "this cannot be read as a MATLAB file",
            path=str(file),
            expected="a .mat file of version 4 to 7.2",
            got=f"{type(error).__name__}: {str(error).splitlines()[0][:80] if str(error) else ''}",
            fix="in MATLAB, save it with -v7",
        ) from error
    found = {name: value for name, value in content.items() if not name.startswith("__")}
    for name in names:
        if name not in found:
            raise DataError(
                f"variable {name!r} is missing",
                path=str(file),
                expected=", ".join(names),
                got=", ".join(found) or "no variable",
                fix="this may be a file of another family",
            )
    return found


def array(content: Mapping[str, Any], name: str, file: Path, *, columns: int | None = None) -> np.ndarray:
    """A variable as float64: (n,), or (n, columns) finite numbers, a single row included.

    Raises:
        DataError: naming file, variable and the first bad row.
    """
    try:
        x = np.asarray(content[name], dtype=float)
    except (TypeError, ValueError):
        x = np.zeros((0, 0, 0))
    x = x.ravel() if columns is None else np.atleast_2d(x)
    if x.ndim != (1 if columns is None else 2) or (columns is not None and x.shape[1] != columns):
        raise DataError(
            f"variable {name!r} has another shape",
            path=str(file),
            expected="numbers, a value a row" if columns is None else f"numbers in {columns} columns",
            got=f"shape {np.shape(content[name])}",
            fix="this may be a file of another family",
        )
    bad = ~np.isfinite(x if columns is None else x.sum(axis=1))
    if bad.any():
        raise DataError(
            f"variable {name!r} holds a value that is not finite",
            path=f"{file}: {name}, row {int(np.flatnonzero(bad)[0]) + 1}",
            expected="finite numbers",
            got=f"NaN or infinity in {int(bad.sum())} rows",
            fix="mend or delete the row",
        )
    return x


def strictly_later(seconds: np.ndarray, what: str, file: Path) -> tuple[np.ndarray, list[str]]:
    """Which rows (n,) come after all before them, and notes that name those that do not."""
    stamps = np.rint(np.asarray(seconds) * 1e9)
    before = np.concatenate([[-np.inf], np.maximum.accumulate(stamps)[:-1]])
    keep = stamps > before
    bad = np.flatnonzero(~keep)
    if not len(bad):
        return keep, []
    first = int(bad[0])
    step = 1e3 * float(seconds[first] - seconds[first - 1])
    more = f"; {len(bad)} rows in all are not after those before them" if len(bad) > 1 else ""
    note = f"{file.name}: {what}, row {first + 1} is {step:+.3f} ms after the one before{more}: left out"
    return keep, [note]


def split_argument(argument: str, form: str) -> tuple[Path, Path | None]:
    """FILE and perhaps SECOND of "FILE[:SECOND]".

    Raises:
        DeclarationError: without a FILE.
    """
    first, _, second = argument.partition(":")
    if not first:
        raise DeclarationError(
            "which file?",
            path=form.partition(":")[0],
            expected=form,
            got=repr(argument),
            fix="name the file after the colon",
        )
    return Path(first).expanduser(), Path(second).expanduser() if second else None


def known_settings(given: Mapping[str, Any], valid: Mapping[str, str], path: str) -> None:
    """Refuse settings that a loader does not have.

    Raises:
        UnknownNameError: listing the valid ones.
    """
    for name in given:
        if name not in valid:
            raise UnknownNameError("setting", name, valid, path=path)


def choice(given: Mapping[str, Any], name: str, valid: tuple[str, ...], path: str) -> str:
    """One of a few words; the first where it is left out.

    Raises:
        UnknownNameError: listing the words.
    """
    value = str(given.get(name, valid[0]))
    if value not in valid:
        raise UnknownNameError(name, value, valid, path=path)
    return value


def number(
    given: Mapping[str, Any], name: str, otherwise: float, path: str, *, positive: bool = False
) -> float:
    """A finite number, below 1e9 either way.

    Raises:
        DeclarationError: for anything else.
    """
    try:
        value = float(given.get(name, otherwise))
        if not abs(value) < 1e9 or (positive and not value > 0.0):
            raise ValueError
    except (TypeError, ValueError):
        raise DeclarationError(
            f"setting {name!r} is not usable",
            path=path,
            expected=f"a {'positive ' if positive else ''}number",
            got=repr(given.get(name)),
            fix=f"for example {name}={otherwise:g}",
        ) from None
    return value
