"""The fields of a series, as pictures ask for them: by name, with unit, in few components."""

from __future__ import annotations

import numpy as np

from flowgraph.data.series import Series
from flowgraph.errors import DataError, UnknownNameError
from flowgraph.types import ArrayType, leaves_of

# where each quantity stands in the 15 error states; a covariance of 6 or 9 holds the first of them
STATES = {"position": 0, "velocity": 3, "attitude": 6, "gyro_bias": 9, "accelerometer_bias": 12}
SIZES = (6, 9, 15)


def find(series: Series, field: str) -> tuple[np.ndarray, ArrayType] | None:
    """The leaf called `field`, at the top of the signal or inside it."""
    for (name, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
        if name == field or name.endswith("." + field):
            return array, type_
    return None


def need(series: Series, field: str) -> tuple[np.ndarray, ArrayType]:
    """The same, where there is nothing to draw without it.

    Raises:
        UnknownNameError: where there is no such field.
        DataError: where the series is empty.
    """
    found = find(series, field)
    if found is None:
        raise UnknownNameError("field", field, series.leaves, path=series.name)
    if not len(series):
        raise DataError(
            "there are no values to plot", path=series.name, expected="at least one value",
            got="an empty series", fix="run over data that fire this stream",
        )  # fmt: skip
    return found


def components(field: str, n: int) -> tuple[str, ...]:
    """The names of n components of a field: w, x, y, z of an attitude, else x, y, z or numbers."""
    if n == 4 and any(word in field for word in ("attitude", "quaternion", "orientation")):
        return ("w", "x", "y", "z")
    return ("x", "y", "z")[:n] if n in (2, 3) else tuple(map(str, range(n)))


def unit_words(unit: str | None, frame: str | None) -> str:
    """What stands on an axis: `[m, world]`, or nothing."""
    words = ", ".join(part for part in (unit, frame) if part)
    return f"[{words}]" if words else ""
