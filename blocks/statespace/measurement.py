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
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.signals import vector_of
from flowgraph.blocks.statespace.functions import Covariance, Handed, numbers
from flowgraph.errors import DeclarationError
from flowgraph.recorder.derivatives import jacobian

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
    def covariance(self, message: Any, m: int, kind: Any, xp: Any) -> Array:
        """Of the noise: (m, m) where it is added, (n_v, n_v) where it goes in."""

    @property
    @abc.abstractmethod
    def inside(self) -> bool:
        """Whether noise goes into what is seen, and is not added to it."""

    @abc.abstractmethod
    def linearised(self, x: Array, d: Array | None, message: Any, xp: Any) -> tuple[Array, Array, Array]:
        """(z, H, R) at the state x (size) moved by d (t), which is 0 where it is None: H (m, t) by d, R (m,
        m)."""

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
    noise: Any
    measured_space: StateSpace | None = None
    read: Callable[[Any], Array] | None = None
    _observe: Handed = field(init=False, repr=False)
    _noise: Covariance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        observe = Handed(self.observe, "MeasurementModel.observe", ("v", "xp"), "message")
        object.__setattr__(self, "_observe", observe)
        object.__setattr__(self, "_noise", Covariance(self.noise, "MeasurementModel.noise"))

    @property
    def inside(self) -> bool:
        return "v" in self._observe.names

    @property
    def linear(self) -> bool:
        return False

    def seen(self, x: Array, v: Array | None, message: Any, xp: Any) -> Array:
        found = self._observe(self.space.view(x, xp), message, v=v, xp=xp)
        return numbers(found, x, self.measured_space, xp)

    def covariance(self, message: Any, m: int, kind: Any, xp: Any) -> Array:
        return self._noise.matrix(message, kind, xp, None if self.inside else m)

    def linearised(self, x: Array, d: Array | None, message: Any, xp: Any) -> tuple[Array, Array, Array]:
        kind, t, size, row = x.dtype, self.space.tangent, self.space.size, x[None, :]
        inside = self.covariance(message, 0, kind, xp) if self.inside else None
        n = 0 if inside is None else inside.shape[-1]
        if d is None:
            see = lambda s, xp: self.seen(s[..., :size], s[..., size:] if n else None, message, xp)
            z, both = linearised(see, row, self.space, xp, seen=self.measured_space, more=n)
        else:
            still = xp.zeros((1, n), dtype=kind)
            z = self.seen(self.space.plus(row, d[None, :], xp), still if n else None, message, xp)

            def apart(c: Array, xp: Any) -> Array:
                v = c[..., t:] if n else None
                return self.apart(self.seen(self.space.plus(row, c[..., :t], xp), v, message, xp), z, xp)

            _, both = jacobian(apart, xp.concat([d[None, :], still], axis=-1) if n else d[None, :], xp)
        H, V = both[0, :, :t], both[0, :, t:]
        R = self.covariance(message, H.shape[-2], kind, xp) if inside is None else V @ inside @ V.mT
        return z[0, :], H, R


@dataclass(frozen=True, eq=False)
class LinearMeasurement(Measurement):
    """z = H x + v, over a space of vectors and angles.

    Args:
        space: of the state, of n numbers.
        H: (m, n), or a function of the message that gives it.
        noise: covariance of v, (m, m); (m) is its diagonal, one number the variance of each entry; or a
            function of the message.
        measured_space, read: as in `MeasurementModel`.

    Raises:
        DeclarationError: where H does not fit the space, or the noise is no covariance.
    """

    space: StateSpace
    H: Any
    noise: Any
    measured_space: StateSpace | None = None
    read: Callable[[Any], Array] | None = None
    _noise: Covariance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        n = self.space.size
        shape = (0, n) if callable(self.H) else np.shape(self.H)
        if len(shape) != 2 or shape[1] != n or self.space.tangent != n:
            raise DeclarationError(
                "the matrix of a measurement does not fit",
                path="LinearMeasurement.H",
                expected=f"shape (m, {n}), over a space without attitudes",
                got=f"shape {shape}, {self.space}",
                fix="give it a column for each number of the state",
            )
        object.__setattr__(self, "_noise", Covariance(self.noise, "LinearMeasurement.noise"))

    @property
    def inside(self) -> bool:
        return False

    @property
    def linear(self) -> bool:
        return True

    def _matrix(self, message: Any, kind: Any, xp: Any) -> Array:
        given = self.H(message) if callable(self.H) else np.asarray(self.H, dtype=float)
        return xp.asarray(given, dtype=kind)

    def seen(self, x: Array, v: Array | None, message: Any, xp: Any) -> Array:
        H = self._matrix(message, x.dtype, xp)
        return (H @ x[..., None])[..., 0] if len(x.shape) == 1 else (H @ x.mT).mT  # as in the motion's carry

    def covariance(self, message: Any, m: int, kind: Any, xp: Any) -> Array:
        return self._noise.matrix(message, kind, xp, m)

    def linearised(self, x: Array, d: Array | None, message: Any, xp: Any) -> tuple[Array, Array, Array]:
        z = self.seen(x if d is None else self.space.plus(x, d, xp), None, message, xp)
        return z, self._matrix(message, x.dtype, xp), self.covariance(message, z.shape[-1], x.dtype, xp)
