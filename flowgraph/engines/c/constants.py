"""Arrays that are known, as C keeps them, and how registers begin.

A few thousand numbers are written as numbers. Of more, as a cloud of a million particles starts with, only
what differs is kept: along an axis on which all are equal there is one, and a register whose numbers are
equal in stretches is filled by a loop over each. What is left is written as the bytes of its numbers, which a
compiler takes in many times as fast: low byte first, as nearly every processor has them, and another refuses
the file.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flowgraph.engines.c.syntax import ctype, number
from flowgraph.recorder.ops import Spec

WRITTEN = 4096
"""So many numbers at most are written as numbers."""
_STRETCHES, _FEW = 16, 16
_ROW = 2048
"""Bytes in a string: C99 promises room for 4095."""

_BYTES = np.array([f"\\{k:03o}" for k in range(256)], "S4")
_TURNED = """#if defined(__BYTE_ORDER__) && __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "tables are written low byte first; with 4096 numbers or fewer in each there would be none"
#endif
"""


def bits(array: np.ndarray) -> np.ndarray:
    """The same array as whole numbers, in which -0 is not 0 and NaN is itself."""
    return np.ascontiguousarray(array).view(f"u{array.dtype.itemsize}")


def without_repeats(array: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """What has to be kept of a large array, in C's order, and the steps through it along each axis."""
    kept = np.asarray(array)
    if kept.size > WRITTEN:
        for axis in range(kept.ndim):
            first = kept.take([0], axis)
            if (bits(kept) == bits(first)).all():
                kept = first
    steps = np.cumprod([1, *kept.shape[:0:-1]])[::-1].tolist()
    return kept, tuple(
        0 if n == 1 and wide != 1 else int(s)
        for s, n, wide in zip(steps, kept.shape, array.shape, strict=False)
    )


def table_text(name: str, array: np.ndarray, spec: Spec, real: str) -> str:
    """A constant array of a file.

    Args:
        name: under which it is read with an index.
        array: its numbers.
        spec: of whose dtype they are.
        real: "double" or "float".
    """
    type_, size = ctype(spec.dtype, real), max(array.size, 1)
    if array.size <= WRITTEN:
        numbers = [number(v, spec.dtype, real) for v in array.ravel().tolist()] or ["0"]
        rows = [", ".join(numbers[k : k + 8]) for k in range(0, len(numbers), 8)]
        return f"static const {type_} {name}[{size}] = {{\n    " + ",\n    ".join(rows) + "};\n"
    kind = np.dtype({"double": "f8", "float": "f4"}.get(type_, spec.dtype)).newbyteorder("<")
    content = array.astype(kind).tobytes()
    content += bytes(-len(content) % _ROW)
    said = _BYTES[np.frombuffer(content, np.uint8)].tobytes().decode("ascii")
    wide = 4 * _ROW
    lines = ",\n    ".join(f'"{said[k : k + wide]}"' for k in range(0, len(said), wide))
    return (
        f"{_TURNED}static const union {{\n    char bytes[{len(content) // _ROW}][{_ROW}];\n"
        f"    {type_} numbers[{array.size}];\n}} {name}_kept = {{{{\n    {lines}}}}};\n"
        f"static const {type_} *const {name} = {name}_kept.numbers;\n"
    )


def start_lines(
    place: str, start: np.ndarray, spec: Spec, real: str, table: Callable[[np.ndarray], str]
) -> list[str]:
    """The statements that give a register its first value.

    Args:
        place: the register in C.
        start: its first value.
        spec: its shape and dtype.
        real: "double" or "float".
        table: makes a table of the file, and gives its name.
    """

    def said(value: object) -> str:
        return number(value, spec.dtype, real)

    flat = np.ascontiguousarray(start).ravel()
    if spec.shape == ():
        return [f"{place} = {said(flat.tolist()[0])};"]
    if not flat.size:
        return []
    ends = [*(np.flatnonzero(np.diff(bits(flat)) != 0) + 1).tolist(), flat.size]
    if len(ends) > 1 and flat.size <= _FEW:
        return [f"{place}[{i}] = {said(v)};" for i, v in enumerate(flat.tolist())]
    if len(ends) > (_STRETCHES if flat.size > WRITTEN else 1):
        return [f"for (int32_t i = 0; i < {flat.size}; i++) {place}[i] = {table(start)}[i];"]
    return [
        f"for (int32_t i = {first}; i < {end}; i++) {place}[i] = {said(flat[first].item())};"
        for first, end in zip([0, *ends], ends, strict=False)
    ]
