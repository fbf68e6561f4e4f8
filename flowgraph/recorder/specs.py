"""Shape and kind of number of a value in a pipeline, and the error for values that do not go together."""

from __future__ import annotations

from typing import NamedTuple


class Spec(NamedTuple):
    """Shape and dtype of a value in a pipeline."""

    shape: tuple[int, ...]
    dtype: str


class ShapeError(ValueError):
    """The arguments of an operation do not fit together."""
