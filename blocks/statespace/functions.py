"""What a model is made of: functions of the user's with the parameters they ask for, and covariances.

A function takes the state first. What else it needs it names, as a block's step names `dt` and `xp`; one
parameter of any other name is the control of a motion, or the message of a measurement. So a motion without a
control simply has no parameter for it. A covariance is an array, or a function of that control or message,
since many sensors say with each reading how good it is.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.geometry.views import array_of, joined, stacked_parts
from flowgraph.blocks.kalman.matrices import noise_matrix
from flowgraph.errors import DeclarationError

__all__ = ["Covariance", "Handed", "numbers"]


class Handed:
    """A function of a state, called with those of the things on offer that it has parameters for.

    Args:
        function: the state is its first parameter.
        path: in what is refused.
        offered: names of what can be had.
        other: what a parameter of another name is.
    """

    def __init__(self, function: Callable[..., Any], path: str, offered: tuple[str, ...], other: str) -> None:
        if not callable(function):
            _refuse_parameters(path, offered, other, repr(function))
        first, *names = inspect.signature(function).parameters
        strange = [n for n in names if n not in offered]
        if len(strange) > 1:
            _refuse_parameters(path, offered, other, f"({', '.join((first, *names))})")
        self.function = function
        self.names = tuple(names)
        self.other = strange[0] if strange else None

    def __call__(self, x: Any, other: Any, **offered: Any) -> Any:
        return self.function(x, *(other if n == self.other else offered[n] for n in self.names))


def _refuse_parameters(path: str, offered: tuple[str, ...], other: str, got: str) -> None:
    raise DeclarationError(
        "this function has other parameters than a model hands it",
        path=path,
        expected=f"the state, then any of {', '.join(offered)}, and at most one more for the {other}",
        got=got,
        fix=f"write def {path.rpartition('.')[2]}(x, {', '.join(offered)}), and one more for the {other}",
    )


class Covariance:
    """A covariance or spectral density, given as an array or as a function of a message.

    Args:
        given: (n, n); (n) is its diagonal and a number the variance of one entry, or of each where the
            number of entries is told; or a function of the message that gives any of these.
        path: in what is refused.

    Raises:
        DeclarationError: where it is no covariance.
    """

    def __init__(self, given: Any, path: str) -> None:
        self.given, self.path = given, path
        if not callable(given):
            size = len(np.atleast_1d(np.asarray(given, dtype=float)))
            noise_matrix(given, size, path, kind=np.float64, xp=np)

    @property
    def size(self) -> int | None:
        """How many entries it is of; None where a message says it."""
        return None if callable(self.given) else len(np.atleast_1d(np.asarray(self.given, dtype=float)))

    def matrix(self, message: Any, kind: Any, xp: Any, n: int | None = None) -> Array:
        """(n, n), in the precision `kind`."""
        given = self.given(message) if callable(self.given) else self.given
        shape = (
            tuple(np.shape(given)) if isinstance(given, int | float | list | tuple) else tuple(given.shape)
        )
        n = (shape[-1] if shape else 1) if n is None else n
        if not isinstance(given, int | float | list | tuple | np.ndarray) and shape in ((), (n,)):
            return given[..., None] * xp.eye(n, dtype=kind)  # computed by the graph
        return noise_matrix(given, n, self.path, kind=kind, xp=xp)


def numbers(found: Any, like: Array, space: StateSpace | None, xp: Any) -> Array:
    """What a function of states returned, an array, a view or the parts in order, as one array."""
    if not isinstance(found, tuple | list):
        return array_of(found)
    return stacked_parts(found, like, xp) if space is None else joined(space, found, like, xp, tangent=False)
