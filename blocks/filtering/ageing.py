"""A control that is held for longer than its own period is worth less the older it is.

While a control is fresh it counts as it came. Once it is older than it ever should be, each of its numbers
has an error that grows with its age T by the same rule as in `kalman.bridge`: over a part s of a step that
ends at the age T, in which the control was old,

    u + c      c ~ N(0, spread^2 w / dt^2)      w = 2 (T - s/2) s

constant over the step, so that what integrates it is off by `spread` T after a gap T. The error goes through
the motion itself, so every method has it: by the derivative of the motion by its control, by sigma points of
the control, or by a control of its own for each particle.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, Signal, block, real
from flowgraph.blocks.geometry.manifold import StateSpace
from flowgraph.blocks.kalman.lost import Held, aged
from flowgraph.blocks.statespace import Motion
from flowgraph.errors import DeclarationError
from flowgraph.recorder.derivatives import jacobian
from flowgraph.types import Type, flatten, leaves_of, type_of, unflatten

__all__ = ["Ageing", "AgedMotion", "doubt_control"]


class Ageing(NamedTuple):
    """From which age on a control is doubted, and how fast.

    Args:
        after: s, how old a control may be: some of its periods.
        spread: how far each number of the control is off after a second: one number, or one for each real
            number of the control in their order.
    """

    after: float
    spread: float | Sequence[float]


@functools.cache
def doubted(type_: Type) -> type[Signal]:
    """The type of a control of that type with the doubt about it: the variance of its error, in spreads."""
    fields = {"__annotations__": {"control": type_, "doubt": Array}, "doubt": real(), "__doc__": "A control."}
    return type("DoubtedControl", (Signal,), fields)


@block
def doubt_control(state, held: Any, control: Any | None, *, ageing: Ageing, dt: float, xp: Any):  # type: ignore[no-untyped-def]
    """The control that is held, with the doubt about it: 0 while it is fresh.

    Args:
        held: the control of this tick.
        control: the same where it is a fresh one; the age of the one before counts in the step that ends
            with it.
        ageing: from which age on it is doubted.

    State: the age of the control, s.
    """
    rest, _, w = aged(state, control, Held(after=ageing.after), dt, xp)
    dt = xp.asarray(dt, dtype=w.dtype)
    passed = dt > 0.0
    doubt = xp.where(passed, w / xp.where(passed, dt * dt, 1.0), 0.0)
    return rest, doubted(type_of(held))(control=held, doubt=doubt)


@doubt_control.init
def _fresh(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


@dataclass(frozen=True, eq=False)
class AgedMotion:
    """A motion whose control has an error: that of a control that is doubted goes in as noise behind its own.

    Args:
        motion: with a control.
        spread: (m), as in `Ageing`.
    """

    motion: Motion
    spread: np.ndarray

    @property
    def space(self) -> StateSpace:
        """Of the state."""
        return self.motion.space

    @property
    def linear(self) -> bool:
        """Whether the motion is."""
        return self.motion.linear

    def carry(self, x: Array, control: Any, w: Array | None, dt: Any, xp: Any) -> Array:
        """The states (..., size) after dt seconds, with noises w (..., n_w + m) of motion and control."""
        told, m = control.control, len(self.spread)
        if w is None:
            return self.motion.carry(x, told, None, dt, xp)
        n = w.shape[-1] - m
        own, c = w[..., :n] if n else None, w[..., n:]
        if self.linear:
            moved = self.motion.carry(x, told, own, dt, xp)
            return self.space.plus(moved, c @ self._response(told, dt, x.dtype, xp).mT, xp)
        return self.motion.carry(x, _off(told, c, xp), own, dt, xp)

    def noise_root(self, control: Any, dt: Any, kind: Any, xp: Any) -> Array:
        """A triangular root of the covariance of the motion's noise and the control's error."""
        own = self.motion.noise_root(control.control, dt, kind, xp)
        off = xp.asarray(np.diag(self.spread), dtype=kind) * xp.sqrt(xp.astype(control.doubt, kind))
        if own is None:
            return off
        n, m = own.shape[-1], len(self.spread)
        above = xp.concat([own, xp.zeros((n, m), dtype=kind)], axis=-1)
        return xp.concat([above, xp.concat([xp.zeros((m, n), dtype=kind), off], axis=-1)], axis=-2)

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        """(x', F, Q) at the state x (size), Q with what the error of the control adds."""
        told, kind, row, m = control.control, x.dtype, x[None, :], len(self.spread)
        after, F, Q = self.motion.linearised(x, told, dt, xp)
        if self.linear:
            U = self._response(told, dt, kind, xp)
        else:
            root = self.motion.noise_root(told, dt, kind, xp)
            still = None if root is None else xp.zeros((1, root.shape[-1]), dtype=kind)
            moved = lambda c, xp: self.space.minus(
                self.motion.carry(row, _off(told, c, xp), still, dt, xp), after[None, :], xp
            )
            U = jacobian(moved, xp.zeros((1, m), dtype=kind), xp)[1][0, ...]
        off = xp.asarray(self.spread**2, dtype=kind) * xp.astype(control.doubt, kind)
        more = (U * off) @ U.mT
        return after, F, more if Q is None else Q + more

    def _response(self, told: Any, dt: Any, kind: Any, xp: Any) -> Array:
        """(t, m): what a unit of each number of the control does to a linear motion."""
        type_, m, rest = type_of(told), len(self.spread), xp.zeros((1, self.space.size), dtype=kind)
        by = lambda u: self.motion.carry(rest, _made(type_, u, xp), None, dt, xp)[0, :]
        none = by(np.zeros(m))
        return xp.stack([by(unit) - none for unit in np.eye(m)], axis=-1)


def aged_motion(motion: Motion, type_: Type, ageing: Ageing) -> AgedMotion:
    """The motion with a control that is doubted.

    Raises:
        DeclarationError: where the ageing does not fit the control.
    """
    m = sum(int(np.prod(kind.shape)) for _, kind in leaves_of(type_) if kind.dtype == "real")
    spread = np.asarray(ageing.spread, dtype=float)
    good = spread.shape in ((), (m,)) and np.isfinite(spread).all() and (spread >= 0.0).all()
    if not good or not ageing.after > 0.0:
        raise DeclarationError(
            "this ageing does not fit the control",
            path="filtered.held",
            expected=f"after > 0 s, and a spread of one number or {m}, none of them negative",
            got=repr(ageing),
            fix="write held=Ageing(after=0.2, spread=(0.3, 1.0)), in the units of the control",
        )
    spread = np.broadcast_to(spread, (m,)).copy()
    spread.flags.writeable = False
    return AgedMotion(motion, spread)


def _off(told: Any, c: Array, xp: Any) -> Any:
    """The control with errors c (..., m) added to its real numbers, one control a row."""
    type_, at, leaves = type_of(told), 0, []
    for leaf, (_, kind) in zip(flatten(told, type_), leaves_of(type_), strict=True):
        if kind.dtype != "real":
            leaves.append(leaf)
            continue
        size = int(np.prod(kind.shape))
        part, at = c[..., at : at + size], at + size
        leaves.append(leaf + (part if kind.shape else part[..., 0]))
    return unflatten(type_, iter(leaves))


def _made(type_: Type, numbers: np.ndarray, xp: Any) -> Any:
    """A control of these real numbers."""
    at, leaves = 0, []
    for _, kind in leaves_of(type_):
        size = int(np.prod(kind.shape))
        real_ = kind.dtype == "real"
        part = numbers[at : at + size] if real_ else np.zeros(size)
        at += size if real_ else 0
        leaves.append(xp.asarray(part.reshape(kind.shape)))
    return unflatten(type_, iter(leaves))
