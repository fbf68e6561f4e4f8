"""MATLAB files, read whole or not at all: what a recording must hold is asked for by name and shape.

Files of version 4 to 7.2, through SciPy. Text and numbers only: nothing in a file is run.
"""

from __future__ import annotations

import io
import math
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.files import content_of
from flowgraph.errors import DataError

__all__ = ["columns_of", "read_mat", "read_structs"]

_EXPANDED = 32  # times its size, that a compressed file holds at most
_FLAGS, _MATRIX, _COMPRESSED = 6, 14, 15
_INT8, _INT32 = 1, 5
_NUMBERS = {*range(1, 8), 9, 12, 13}  # kinds of parts, as the format numbers them
_KINDS = {*_NUMBERS, _MATRIX, 16, 17, 18}
_CELL, _STRUCT, _CHAR, _SPARSE = 1, 2, 4, 5
_NUMERIC = range(6, 16)  # classes of arrays
_DEEPEST = 64


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
    content = _content(file, list(fields))
    return {name: _array(file, name, content.get(name), shape) for name, shape in fields.items()}


def read_structs(file: Path, *names: str, also: tuple[str, ...] = ()) -> dict[str, Any]:
    """The variables of a .mat file, structs as dictionaries: `names`, which must be there, and `also`; all
    where none are named.

    Raises:
        DataError: the file is missing, cut off or no .mat file, or lacks a variable.
    """
    found = _content(file, list(names), also, simplify_cells=True)
    return {name: value for name, value in found.items() if not name.startswith("__")}


def columns_of(
    content: Mapping[str, Any],
    name: str,
    file: Path,
    columns: int | None = None,
    *,
    fix: str = "mend or delete the row",
    gaps: bool = False,
) -> np.ndarray:
    """A variable as float64: (n,), or (n, columns) numbers, a single row included; finite but for `gaps`.

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
            f"field {name!r} has another shape",
            path=str(file),
            expected="numbers, a value a row" if columns is None else f"numbers in {columns} columns",
            got=f"shape {np.shape(content[name])}",
            fix="this may be a file of another family",
        )
    bad = ~np.isfinite(x if columns is None else x.sum(axis=1))
    if bad.any() and not gaps:
        raise DataError(
            f"field {name!r} holds a value that is not finite",
            path=f"{file}: {name}, row {int(np.flatnonzero(bad)[0]) + 1}",
            expected="finite numbers",
            got=f"NaN or infinity in {int(bad.sum())} rows",
            fix=fix,
        )
    return x


def _content(file: Path, names: list[str], also: tuple[str, ...] = (), **how: Any) -> dict[str, Any]:
    if not file.is_file():
        raise DataError(
            f"{file.name} is missing",
            path=str(file),
            expected="a .mat file with " + ", ".join(names),
            got="a folder" if file.is_dir() else "no such file",
            fix="check the path",
        )
    from scipy.io import loadmat, whosmat  # slow to import

    try:
        content = content_of(file, most=2**40)
        _check_parts(content)
        wanted = [*names, *also] or None  # all
        found: dict[str, Any] = loadmat(io.BytesIO(content), variable_names=wanted, **how)
        held = [name for name, _, _ in whosmat(io.BytesIO(content))] if set(names) - set(found) else []
    except NotImplementedError:
        raise DataError(
            "this is a MATLAB file of version 7.3",
            path=str(file),
            expected="version 4 to 7.2",
            got="an HDF5 container",
            fix="save it with save(..., '-v7')",
        ) from None
    except Exception as error:  # a broken file may raise nearly anything
        raise DataError(
            "this is no whole .mat file",
            path=str(file),
            expected="a .mat file with " + ", ".join(names),
            got=f"{file.stat().st_size} bytes: {type(error).__name__}: {error}"[:160],
            fix="fetch the file again: it is cut off, or something else; in MATLAB, save it with -v7",
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


def _check_parts(content: bytes) -> None:
    """See that each part of a file of version 5 is one, and lies in what holds it, before it is read.

    SciPy takes a part's kind for the place of a pointer, unchecked, so that a wrong one ends the process.

    Raises:
        ValueError: where a part is none, or the compressed ones hold over 32 times the file and 16 MiB.
        zlib.error: where one is damaged.
    """
    if 0 in content[:4] or len(content) < 128:
        return  # version 4, which has no parts, or no file at all
    if content[124 + (content[126] == ord("I"))] != 1:
        return  # another version, which is refused by its number
    order = "<" if content[126:128] == b"IM" else ">"
    limit = _EXPANDED * len(content) + 2**24
    place = 128
    while place + 8 <= len(content):
        kind, size = struct.unpack_from(f"{order}II", content, place)
        part = content[place + 8 : place + 8 + size]
        if kind == _COMPRESSED:
            unpacker, whole = zlib.decompressobj(), bytearray()
            while part and not unpacker.eof:
                whole += unpacker.decompress(part, 2**20)
                part = unpacker.unconsumed_tail
                if len(whole) > limit:
                    raise ValueError("its compressed parts hold far more than the file is long")
            limit -= len(whole)
            _walk(memoryview(whole), order, 0)
        else:
            _walk(memoryview(content)[place : place + 8 + size], order, 0)
        place += 8 + size


def _walk(parts: memoryview, order: str, depth: int) -> None:
    """Go through the parts of a variable, and those of the cells and fields in it."""
    place = 0
    found: list[tuple[int, memoryview]] = []
    while place + 8 <= len(parts):
        kind, size = struct.unpack_from(f"{order}II", parts, place)
        small = kind >> 16
        if small:  # a part of up to 4 bytes beside its kind
            kind, size, start, end = kind & 0xFFFF, small, place + 4, place + 8
        else:
            start = place + 8
            end = start + size + -size % 8
        if kind not in _KINDS or start + size > len(parts) or (small and (size > 4 or kind == _MATRIX)):
            raise ValueError(f"a part of kind {kind} and {size} bytes")
        if depth == 0 and kind != _MATRIX:
            raise ValueError(f"a variable of kind {kind}")
        found.append((kind, parts[start : start + size]))
        if kind == _MATRIX and size:  # a field that was never set has nothing in it
            if depth > _DEEPEST:
                raise ValueError("cells within cells without end")
            _walk(found[-1][1], order, depth + 1)
        place = end
    if depth:
        _check_array(found, order)


def _check_array(parts: list[tuple[int, memoryview]], order: str) -> None:
    """See that an array has the parts of its class, for SciPy reads on where one is missing.

    Raises:
        ValueError: where it has not.
    """
    kinds = [kind for kind, _ in parts]
    if kinds[:3] != [_FLAGS, _INT32, _INT8] or len(parts[0][1]) != 8:
        raise ValueError(f"an array with parts of kinds {kinds[:3]}")
    (flags,) = struct.unpack_from(f"{order}I", parts[0][1])
    kept, numbers = flags & 0xFF, 1 + (flags >> 11 & 1)  # a complex array has two parts
    shape = parts[1][1]
    cells = math.prod(struct.unpack_from(f"{order}{len(shape) // 4}i", shape))
    values, wanted, allowed = kinds[3:], cells, {_MATRIX}
    if kept in _NUMERIC:
        wanted, allowed = numbers, _NUMBERS
    elif kept == _SPARSE:
        wanted, allowed = 2 + numbers, _NUMBERS
    elif kept == _CHAR:
        wanted, allowed = 1, _KINDS - {_MATRIX}
    elif kept == _STRUCT:
        length = struct.unpack_from(f"{order}i", parts[3][1])[0] if values[:2] == [_INT32, _INT8] else 0
        if length < 1:
            raise ValueError("a struct without names of its fields")
        values, wanted = values[2:], cells * (len(parts[4][1]) // length)
    elif kept != _CELL:
        raise ValueError(f"an array of class {kept}")
    if len(values) != wanted or not set(values) <= allowed:
        raise ValueError(f"an array of class {kept} with {len(values)} parts of kinds {sorted(set(values))}")


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
