"""Fiducial tags: where they lie (`TagMap`), and what a camera sees of them in one image (`Tags`).

A map is data: an id and four corners a tag, in metres in the world. The corners of a tag, on the map as in
an image, come in one order: bottom-left, bottom-right, top-right, top-left, as the tag itself is read.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from flowgraph import Series
from flowgraph.blocks.signals import Tags
from flowgraph.data.files import put, text_of
from flowgraph.errors import DataError, DeclarationError

__all__ = ["TagMap", "course_map", "grid_map", "tags_series"]

_DAMAGE = (OSError, ValueError, TypeError, LookupError, ArithmeticError, RecursionError)


@dataclass(frozen=True)
class TagMap:
    """Where tags lie in the world.

    Args:
        ids: (n,) whole numbers, each once.
        corners: (n, 4, 3) m, world, in the order of the module.

    Raises:
        DeclarationError: when the shapes do not fit, a corner is not finite, or an id comes twice.
    """

    ids: np.ndarray
    corners: np.ndarray

    def __post_init__(self) -> None:
        ids, corners = np.asarray(self.ids, dtype=np.int64), np.asarray(self.corners, dtype=float)
        sound = ids.ndim == 1 and corners.shape == (len(ids), 4, 3) and np.isfinite(corners).all()
        if not sound or len(np.unique(ids)) != len(ids) or not len(ids):
            raise DeclarationError(
                "this is no tag map",
                path="TagMap",
                expected="ids (n,), each once, and finite corners (n, 4, 3), for at least one tag",
                got=f"ids of shape {ids.shape}, {len(np.unique(ids))} different; corners of {corners.shape}",
                fix="give one id and four corners a tag",
            )
        order = np.argsort(ids)
        object.__setattr__(self, "ids", ids[order])
        object.__setattr__(self, "corners", corners[order])

    def __len__(self) -> int:
        return len(self.ids)

    def find(self, ids: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """The corners (k, 4, 3) of tags by id, and which of them (k,) the map has."""
        wanted = np.asarray(ids, dtype=np.int64)
        at = np.minimum(np.searchsorted(self.ids, wanted), len(self.ids) - 1)
        return self.corners[at], self.ids[at] == wanted

    def only(self, ids: Iterable[int]) -> Self:
        """The part of the map with these ids."""
        keep = np.isin(self.ids, list(ids))
        return type(self)(self.ids[keep], self.corners[keep])

    def save(self, file: str | Path) -> None:
        """Write the map as JSON: {"tags": [{"id": 7, "corners": [[x, y, z], ...]}, ...]}, m.

        Raises:
            OutputError: where the file cannot be written.
        """
        tags = [{"id": int(i), "corners": c.tolist()} for i, c in zip(self.ids, self.corners, strict=True)]
        put(file, json.dumps({"unit": "m", "tags": tags}, indent=1) + "\n")

    @classmethod
    def load(cls, file: str | Path) -> Self:
        """Read a map that `save` wrote, or a surveyor in the same form.

        Raises:
            DataError: where the file is missing or of another form.
        """
        try:
            tags = json.loads(text_of(file))["tags"]
            return cls(np.array([t["id"] for t in tags]), np.array([t["corners"] for t in tags], dtype=float))
        except (
            OSError,
            ValueError,
            TypeError,
            LookupError,
            ArithmeticError,
            RecursionError,
            DeclarationError,
        ) as error:
            raise DataError(
                "this is no tag map",
                path=str(file),
                expected='JSON: {"tags": [{"id": 7, "corners": [[x, y, z], 4 of them, m]}, ...]}',
                got=f"{type(error).__name__}: {str(error).splitlines()[0]}",
                fix="write one with TagMap.save",
            ) from error


def grid_map(
    ids: npt.ArrayLike,
    *,
    side: float,
    gap: float,
    wide_gap: float | None = None,
    wide_after: Sequence[int] = (),
) -> TagMap:
    """A mat of tags in rows and columns, on the plane z = 0, face up.

    The origin is the top-left corner of the top-left tag; x runs down the mat and y to the right, so z points
    up, out of it.

    Args:
        ids: (rows, columns).
        side: of a tag, m.
        gap: between tags, m.
        wide_gap, wide_after: the gap after the columns with these numbers, counted from 1, where it is wider.
    """
    table = np.asarray(ids)
    rows, columns = table.shape
    extra = np.zeros(columns)
    for column in wide_after:
        extra[column:] += (gap if wide_gap is None else wide_gap) - gap
    top, left = np.arange(rows) * (side + gap), np.arange(columns) * (side + gap) + extra
    x, y = np.meshgrid(top, left, indexing="ij")
    steps = np.array([[side, 0.0, 0.0], [side, side, 0.0], [0.0, side, 0.0], [0.0, 0.0, 0.0]])
    corners = np.stack([x, y, np.zeros_like(x)], axis=-1)[:, :, None, :] + steps
    return TagMap(table.ravel(), corners.reshape(-1, 4, 3))


def course_map() -> TagMap:
    """The mat of the course: 108 tags in 12 rows and 9 columns, id = row + 12 column.

    Tags and gaps are 0.152 m, and the gaps between columns 3 and 4 and between 6 and 7 are 0.178 m.
    """
    ids = np.arange(108).reshape(9, 12).T
    return grid_map(ids, side=0.152, gap=0.152, wide_gap=0.178, wide_after=(3, 6))


def tags_series(
    time: npt.ArrayLike, frames: Sequence[tuple[Any, Any]], *, room: int, name: str = "tags"
) -> Series:
    """A series of `Tags` from one (ids (k,), corners (k, 4, 2)) a frame, padded to `room` tags."""
    n = len(frames)
    ids, corners = np.full((n, room), -1, np.int32), np.zeros((n, room, 4, 2))
    seen = np.zeros((n, room), bool)
    for row, (frame_ids, frame_corners) in enumerate(frames):
        k = len(frame_ids)
        ids[row, :k], corners[row, :k], seen[row, :k] = frame_ids, frame_corners, True
    return Series(time, Tags(ids=ids, corners=corners, seen=seen), name=name)
