"""MATLAB files, read whole or not at all: what a recording must hold is asked for by name and shape.

Files of version 4 to 7.2, through SciPy. Text and numbers only: nothing in a file is run.
"""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.errors import DataError

__all__ = ["read_mat"]


def read_mat(file: Path, fields: Mapping[str, tuple[int | None, ...]]) -> dict[str, np.ndarray]:
    """The numeric arrays of these names as float64.

    Args:
        file: a .mat file.
        fields: the shape of each array; None is any length, and () a number. An array of one row or one
            column may stand for one with a single axis.

    Raises:
        DataError: the file is missing, cut off or no .mat file, or a field is missing, not numeric or of
            another shape.
    """
    if not file.is_file():
        raise DataError(
            f"{file.name} is missing",
            path=str(file),
            expected="a .mat file with " + ", ".join(fields),
            got="no such file",
            fix="check the path",
        )
    content = _content(file, list(fields))
    return {name: _array(file, name, content.get(name), shape) for name, shape in fields.items()}


def _content(file: Path, names: list[str]) -> dict[str, Any]:
    from scipy.io import loadmat, whosmat  # slow to import

    try:
        found: dict[str, Any] = loadmat(file, variable_names=names)
        held = [name for name, _, _ in whosmat(file)] if set(names) - set(found) else []
    except NotImplementedError:
        raise DataError(
            "this is a MATLAB file of version 7.3",
            path=str(file),
            expected="version 4 to 7.2",
            got="an HDF5 container",
            fix="save it with save(..., '-v7')",
        ) from None
    except (ValueError, TypeError, KeyError, IndexError, OSError, EOFError, zlib.error, MemoryError) as error:
        raise DataError(
            "this is no whole .mat file",
            path=str(file),
            expected="a .mat file with " + ", ".join(names),
            got=f"{file.stat().st_size} bytes: {type(error).__name__}: {error}"[:160],
            fix="fetch the file again: it is cut off, or something else",
        ) from None
    except Exception as error:  # SciPy's own, which derives from nothing narrower
        if type(error).__module__.partition(".")[0] != "scipy":
            raise
        raise DataError(
            "this is no whole .mat file",
            path=str(file),
            expected="a .mat file with " + ", ".join(names),
            got=f"{file.stat().st_size} bytes: {error}"[:160],
            fix="fetch the file again: it is cut off, or something else",
        ) from None
    missing = [name for name in names if name not in found]
    if missing:
        raise DataError(
            f"field {missing[0]!r} is missing",
            path=str(file),
            expected="fields " + ", ".join(names),
            got="fields " + (", ".join(held) or "none"),
            fix="give a file of this dataset, or restore it",
        )
    return found


def _array(file: Path, name: str, value: Any, shape: tuple[int | None, ...]) -> np.ndarray:
    words = " x ".join("n" if s is None else str(s) for s in shape) or "one number"
    array = np.asarray(value)
    flat = shape == (None,) and array.ndim == 2 and 1 in array.shape
    if flat or (shape == () and array.size == 1):
        array = array.reshape(-1 if flat else ())
    fits = array.ndim == len(shape) and all(
        want in (None, have) for want, have in zip(shape, array.shape, strict=False)
    )
    if array.dtype.kind not in "biuf" or not fits:
        raise DataError(
            f"field {name!r} is not what it should be",
            path=f"{file}: {name}",
            expected=f"numbers, {words}",
            got=f"{array.dtype}, {' x '.join(map(str, array.shape)) or 'one value'}",
            fix="give a file of this dataset, or restore it",
        )
    return array.astype(np.float64)
