"""Queues of fixed size as plain values, for the state of joins and windows.

A queue is `{"items": the leaves of its type with a leading axis of its size, "count": how many are in it}`.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph.types import Type, flatten, zeros

FULL = ("error", "drop_oldest")
"""What a value does that finds a queue full."""


def empty_queue(type_: Type, size: int) -> dict[str, Any]:
    """An empty queue with room for `size` values of a type."""
    blank = zeros(type_)
    items = tuple(np.repeat(np.asarray(leaf)[None], size, axis=0) for leaf in flatten(blank, type_))
    return {"items": items, "count": np.int32(0)}


def push(queue: dict[str, Any], leaves: list[Any], present: Any, xp: Any) -> dict[str, Any]:
    """The queue with a value, given as its leaves, at its end where `present`; one too many only counts."""
    size = queue["items"][0].shape[0]
    slot = (xp.arange(size, dtype=xp.int32) == queue["count"]) & present
    items = tuple(
        xp.where(
            xp.reshape(slot, (size,) + (1,) * (old.ndim - 1)), xp.expand_dims(xp.asarray(new), axis=0), old
        )
        for old, new in zip(queue["items"], leaves, strict=True)
    )
    return {"items": items, "count": queue["count"] + xp.astype(xp.asarray(present), xp.int32)}


def drop_first(queue: dict[str, Any], n: Any, xp: Any) -> dict[str, Any]:
    """The queue without its first `n` values."""
    size = queue["items"][0].shape[0]
    index = xp.clip(xp.arange(size, dtype=xp.int32) + n, max=xp.asarray(np.int32(size - 1)))
    return {
        "items": tuple(xp.take(leaf, index, axis=0) for leaf in queue["items"]),
        "count": queue["count"] - n,
    }
