"""What a sensor sees of a state, declared once, for every method.

`observe(x, xp) -> z` says what would be measured of each state, one a row, without noise; its noise then is
added, z = h(x) + v. Where noise goes in elsewhere, `observe(x, v, xp) -> z` takes it as an argument. A
measurement has a space of its own where some of it are angles. Methods ask what would be seen, and for it
linearised,

    z = h(x)      H = dz/dx      R = (dz/dv) noise (dz/dv)^T

What flows on the wire is a message: a vector, or a signal, whose real leaves are the vector, or from which
`read` takes it. Its covariance may be in the message too: `noise=lambda fix: fix.covariance`.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.statespace.functions import Covariance, Handed, differentiated, numbers, vector_of
from flowgraph.errors import DeclarationError

__all__ = ["LinearMeasurement", "Measurement", "MeasurementModel"]


class Measurement(abc.ABC):
    """What is seen of a state of a `space`: what every method asks of it.

    measured_space: of what is measured; None where it is a vector. read: from the message, the vector.
    """

    space: StateSpace
    measured_space: StateSpace | None
    read: Callable[[Any], Array] | None

    @abc.abstractmethod
    def seen(self, x: Array, v: Array | None, message: Any, xp: Any) -> Array:
        """What would be measured (..., m) of states (..., size) with noises v (..., n_v), if they go in."""

    @abc.abstractmethod
    def noise(self, message: Any, m: int, kind: Any, xp: Any) -> Array:
        """The covariance of the noise: (m, m) where it is added, (n_v, n_v) where it goes in."""

    @property
    @abc.abstractmethod
    def noise_inside(self) -> bool:
        """Whether noise goes into what is seen, and is not added to it."""

    @abc.abstractmethod
    def linearised(self, x: Array, d: Array, message: Any, xp: Any) -> tuple[Array, Array, Array]:
        """(z, H, R) at the state x (size) moved by d (t): H (m, t) by d, R (m, m)."""

    @property
    @abc.abstractmethod
    def linear(self) -> bool:
        """Whether z is a matrix times x, and added noise."""

    def vector(self, message: Any, xp: Any) -> Array:
        """What was measured (m)."""
        return vector_of(message if self.read is None else self.read(message), xp)

    def apart(self, a: Array, b: Array, xp: Any) -> Array:
        """a minus b, in the space of what is measured.

        Raises:
            DeclarationError: where the message has another number of entries.
        """
        if a.shape[-1] != b.shape[-1]:
            raise DeclarationError(
                "what was measured does not fit what would be seen",
                path=f"{type(self).__name__}.read",
                expected=f"{b.shape[-1]} numbers",
                got=f"{a.shape[-1]} numbers in the message",
                fix="take what is measured out of the message: read=lambda message: message.position",
            )
        return a - b if self.measured_space is None else self.measured_space.minus(a, b, xp)


@dataclass(frozen=True, eq=False)
class MeasurementModel(Measurement):
    """A measurement given by a function, over any space.

    Args:
        space: of the state.
        observe: `observe(x, xp) -> z` with noise that is added, or `observe(x, v, xp) -> z`, on x (..., size)
            and v (..., n_v), a state a row. x is a view where the parts of the space have names; z may be a
            view, an array or its parts in order. A parameter of another name is the message.
        noise: covariance of the noise, (n, n); (n) is its diagonal; or a function of the message that gives
            one.
        measured_space: of z, where some of it are angles or attitudes.
        read: from the message, the vector that was measured; its real leaves in their order if left out.

    Raises:
        DeclarationError: where `observe` has other parameters, or the noise is no covariance.
    """

    space: StateSpace
    observe: Callable[..., Any]
    noise: Any  # type: ignore[assignment]
    measured_space: StateSpace | None = None
    read: Callable[[Any], Array] | None = None
    _observe: Handed = field(init=False, repr=False)
    _noise: Covariance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        pass
