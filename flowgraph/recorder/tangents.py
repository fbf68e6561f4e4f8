"""Tangents: how an array changes with the numbers that it is differentiated by, and what is known to be zero.

A tangent is a dict from directions to an array (k, *shape): row i says how the array changes along the i-th
of those k directions. Directions that are in no key change nothing, and cost nothing. The keys of one tangent
do not overlap; where those of two do in part, both are cut until they agree. An axis of the array may have
size 1 in a tangent where the change is the same all along it.

Source: A. Griewank and A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, secs. 3.1 and 7.1 (the
forward mode, for several directions at once, of which many may be zero).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

Directions = tuple[int, ...]
Tangent = dict[Directions, Any]
Made = tuple[Any, Tangent]
Rule = Callable[..., Made]
"""`rule(xp, values, tangents, **attrs)`: the value and the tangent of a result, from those of the arguments.
`xp` is the namespace of the values."""

LINALG = ("cholesky", "solve", "cross", "vecdot", "outer")
"""Operations of the extension `linalg`."""


def plain(xp: Any, name: str) -> Any:
    """The function of that name in a namespace of values."""
    return getattr(xp.linalg if name in LINALG else xp, name)


def shape_of(x: Any) -> tuple[int, ...]:
    """The shape of an array or number."""
    return x.shape if type(x) is np.ndarray else tuple(getattr(x, "shape", ()))


def mapped(tangent: Tangent, function: Callable[[Any], Any]) -> Tangent:
    """`function` of each part."""
    return {key: function(d) for key, d in tangent.items()}


def aligned(xp: Any, *tangents: Tangent) -> list[tuple[Directions, list[Any]]]:
    """The parts of several tangents side by side, over keys that all share; None where one has none."""
    keys = list(dict.fromkeys(key for t in tangents for key in t))
    if len(keys) > 1 and len({i for key in keys for i in key}) < sum(map(len, keys)):
        owners = [{i: key for key in t for i in key} for t in tangents]
        groups: dict[tuple[Directions | None, ...], list[int]] = {}
        for i in sorted({i for key in keys for i in key}):
            groups.setdefault(tuple(o.get(i) for o in owners), []).append(i)
        return [
            (tuple(found), [None if key is None else rows(xp, t[key], [key.index(i) for i in found])
                            for key, t in zip(owner, tangents, strict=True)])
            for owner, found in groups.items()
        ]  # fmt: skip
    return [(key, [t.get(key) for t in tangents]) for key in keys]


def added(xp: Any, a: Tangent, b: Tangent) -> Tangent:
    """The sum of two tangents, whose arrays broadcast."""
    if not a or not b:
        return a or b
    if a.keys() == b.keys():
        return {key: d + b[key] for key, d in a.items()}
    pairs = aligned(xp, a, b)
    return {key: d if e is None else e if d is None else d + e for key, (d, e) in pairs}


def rows(xp: Any, d: Any, places: Sequence[int]) -> Any:
    """Those rows of an array, in order."""
    if list(places) == list(range(d.shape[0])):
        return d
    if isinstance(d, np.ndarray):
        return d[np.asarray(places)]
    pieces, start = [], 0
    for end in range(1, len(places) + 1):
        if end == len(places) or places[end] != places[end - 1] + 1:
            pieces.append(d[places[start] : places[end - 1] + 1, ...])
            start = end
    return pieces[0] if len(pieces) == 1 else xp.concat(pieces, axis=0)


def pruned(tangent: Tangent) -> Tangent:
    """Without the directions along which a part that is known now is zero."""
    out: Tangent = {}
    for key, d in tangent.items():
        if isinstance(d, np.ndarray):
            keep = np.flatnonzero(d.reshape(len(key), -1).any(axis=1))
            if keep.size < len(key):
                if keep.size:
                    out[tuple(key[i] for i in keep)] = d[keep]
                continue
        out[key] = d
    return out


def lifted(xp: Any, d: Any, rank: int) -> Any:
    """A part with axes of size 1 put before those of its array, so that it broadcasts with `rank` axes."""
    missing = rank + 1 - len(d.shape)
    return xp.reshape(d, (d.shape[0], *(1,) * missing, *d.shape[1:])) if missing > 0 else d


def spread(xp: Any, d: Any, shape: Sequence[int], axes: Iterable[int]) -> Any:
    """A part with these axes of its array at their full size."""
    sizes = list(d.shape)
    for axis in axes:
        sizes[1 + axis] = shape[axis]
    return d if tuple(sizes) == tuple(d.shape) else xp.broadcast_to(d, tuple(sizes))
