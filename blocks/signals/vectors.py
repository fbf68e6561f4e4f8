"""A message as a vector: what methods that know no types read of it."""

from __future__ import annotations

import math
from typing import Any

from flowgraph import Array
from flowgraph.errors import DeclarationError
from flowgraph.types import ArrayType, flatten, leaves_of, type_of

__all__ = ["vector_of"]


def vector_of(message: Any, xp: Any) -> Array:
    """The numbers (m) of a message: a vector, a number, or the real leaves of a signal in their order.

    Raises:
        DeclarationError: where it has no real numbers.
    """
    type_ = type_of(message)
    if isinstance(type_, ArrayType):
        return message if type_.shape else xp.reshape(xp.asarray(message), (1,))
    leaves = [
        leaf
        for leaf, (_, kind) in zip(flatten(message, type_), leaves_of(type_), strict=True)
        if kind.dtype == "real"
    ]
    if not leaves:
        raise DeclarationError(
            "this message has no real numbers",
            path=str(type_),
            expected="a vector, a number or a signal with real leaves",
            got=", ".join(f"{name}: {kind}" for name, kind in leaves_of(type_)) or "nothing",
            fix="convert it first, with .map(...)",
        )
    flat = [xp.reshape(xp.asarray(leaf), (math.prod(leaf.shape),)) for leaf in leaves]
    return flat[0] if len(flat) == 1 else xp.concat(flat, axis=-1)
