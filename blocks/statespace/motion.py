"""How a state moves, declared once, for every method.

A motion is a function over one step: `move(x, u, w, dt, xp) -> x'`. States come one a row, so the same lines
carry a mean, sigma points and a thousand particles. What is random comes in through w, where the world puts
it in: into a turn rate, say, before the turn. w is white noise, as its mean over the step, so it is added to
what it disturbs, `u.rate + w[..., 0]`. Its spectral density is given beside the function, and made discrete
in one place, here: w ~ N(0, density / dt) over dt seconds, and 0 over no time.

Methods ask three things of a `Motion`: to carry states with given noise, for a root of the covariance of that
noise, and for itself linearised,

    x' = move(x, u, 0, dt)      F = d x'/d x      Q = (d x'/d w) (density / dt) (d x'/d w)^T

in the tangent spaces at x and x'. The derivatives are taken of the function itself, line by line.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 6.3 (noise that is constant over a step).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.geometry.views import array_of, joined
from flowgraph.blocks.kalman.triangles import semidefinite_root
from flowgraph.blocks.signals import vector_of
from flowgraph.blocks.statespace.functions import Covariance, Handed, numbers
from flowgraph.errors import DeclarationError

__all__ = ["DiscreteModel", "Motion", "MotionModel", "runge_kutta"]


class Motion(Protocol):
    """How a state of a `space` moves: what every method asks of it.

    `kalman.LinearModel`, motion that is linear in continuous time, is one too.
    """

    @property
    def space(self) -> StateSpace:
        """Of the state."""

    @property
    def linear(self) -> bool:
        """Whether x' is a matrix times x, and noise of a covariance that does not depend on x."""

    def carry(self, x: Array, control: Any, w: Array | None, dt: Any, xp: Any) -> Array:
        """The states (..., size), one a row, after dt seconds with the noises w (..., n_w); None: without."""

    def noise_root(self, control: Any, dt: Any, kind: Any, xp: Any) -> Array | None:
        """A triangular root (n_w, n_w) of the covariance of w over dt seconds; None without noise."""

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array | None]:
        """(x', F, Q) at the state x (size), with F and Q (t, t); Q is None where there is no noise."""


@dataclass(frozen=True, eq=False)
class MotionModel:
    """A motion given by a function, over any space.

    Args:
        space: of the state.
        move: `move(x, u, w, dt, xp) -> x'`, on x (..., size) and w (..., n_w), a state a row. x is a view
            where the parts of the space have names; x' may be a view, an array or the parts in order. u is
            the control, under any name. What it does not need it leaves out: `move(x, w, dt, xp)`. Of a plant
            it may ask for t, s, when the step begins; a filter's has no time but that in its state.
        density: spectral density of w, (n_w, n_w); (n_w) is its diagonal; or a function of the control that
            gives one. None where there is no noise.

    Raises:
        DeclarationError: where `move` has other parameters, or the density is no covariance; and of a filter,
            where it asks for the time.
    """

    space: StateSpace
    move: Callable[..., Any]
    density: Any = None
    _move: Handed = field(init=False, repr=False)
    _density: Covariance | None = field(init=False, repr=False)

    def __post_init__(self) -> None:
        move = Handed(self.move, "MotionModel.move", ("w", "t", "dt", "xp"), "control")
        if ("w" in move.names) != (self.density is not None):
            raise DeclarationError(
                "a noise and its density go together",
                path="MotionModel.density",
                expected="a density and a parameter w of `move`, or neither",
                got=f"density={self.density!r}, move({', '.join(('x', *move.names))})",
                fix="give density=..., or leave w out",
            )
        object.__setattr__(self, "_move", move)
        density = None if self.density is None else Covariance(self.density, "MotionModel.density")
        object.__setattr__(self, "_density", density)

    @property
    def linear(self) -> bool:
        return False

    @property
    def timed(self) -> bool:
        """Whether it asks when a step begins."""
        return "t" in self._move.names

    def carry(self, x: Array, control: Any, w: Array | None, dt: Any, xp: Any, *, t: Any = None) -> Array:
        if self.timed and t is None:
            raise DeclarationError(
                "a filter does not tell a motion the time",
                path="MotionModel.move",
                expected="a motion that depends on its state and what it is told; t is for a plant",
                got=f"move({', '.join(('x', *self._move.names))})",
                fix="leave t out: a part of the state may grow by 1 a second, or a control say it",
            )
        found = self._move(self.space.view(x, xp), control, w=w, t=t, dt=dt, xp=xp)
        return numbers(found, x, self.space, xp)

    def noise_root(self, control: Any, dt: Any, kind: Any, xp: Any) -> Array | None:
        if self._density is None:
            return None
        if self._density.size is None:
            root = semidefinite_root(self._density.matrix(control, kind, xp), xp=xp)
        else:  # the root of a constant, scaled: the noise over no time has none
            root = semidefinite_root(self._density.matrix(control, np.float64, np), xp=np)
        return xp.asarray(root, dtype=kind) * xp.sqrt(_per_second(dt, kind, xp))

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array | None]:
        t, size, kind = self.space.tangent, self.space.size, x.dtype
        D = None if self._density is None else self._density.matrix(control, kind, xp)
        n = 0 if D is None else D.shape[-1]

        def moved(s: Array, xp: Any) -> Array:
            return self.carry(s[..., :size], control, s[..., size:] if n else None, dt, xp)

        after, both = linearised(moved, x[None, :], self.space, xp, seen=self.space, more=n)
        F, G = both[0, :, :t], both[0, :, t:]
        return after[0, :], F, None if D is None else G @ (D * _per_second(dt, kind, xp)) @ G.mT


@dataclass(frozen=True, eq=False)
class DiscreteModel:
    """A linear motion by steps, whatever time they take: x' = F x + G u + w, w ~ N(0, Q).

    A prediction over no time, as at the first firing, is no step. Each matrix may be a function of the
    control in place of an array: then it may differ from step to step.

    Args:
        F: (n, n).
        Q: (n, n) covariance of what a step adds; (n) is its diagonal.
        G: (n, m), what a control of m numbers does; None where it does nothing.
        space: of the state; n numbers without names if left out. F may be a function of the control then
            only if it is given.

    Raises:
        DeclarationError: where the matrices do not fit together, or Q is no covariance.
    """

    F: Any
    Q: Any
    G: Any = None
    space: StateSpace = field(default=None, repr=False)  # type: ignore[assignment]
    _Q: Covariance = field(init=False, repr=False)

    def __post_init__(self) -> None:
        size = None if callable(self.F) else len(np.atleast_2d(np.asarray(self.F, dtype=float)))
        space = self.space or (None if size is None else StateSpace(euclidean(size)))
        shapes = [
            tuple(np.shape(m)) for m in (self.F, self.G) if m is not None and not callable(m)
        ]  # rows of each are those of the state
        Q = Covariance(self.Q, "DiscreteModel.Q")
        n = None if space is None or space.size != space.tangent else space.size
        fits = n is not None and Q.size in (None, n) and size in (None, n)
        if not fits or any(len(s) != 2 or s[0] != n for s in shapes):
            raise DeclarationError(
                "the matrices of a linear model do not fit together",
                path="DiscreteModel",
                expected="F (n, n), Q (n, n) and G (n, m), over n numbers",
                got=f"F {np.shape(self.F)}, Q {np.shape(self.Q)}, G {np.shape(self.G)}, space {space}",
                fix="give each one row for each number of the state; with a function for F, give space= too",
            )
        object.__setattr__(self, "space", space)
        object.__setattr__(self, "_Q", Q)

    @property
    def linear(self) -> bool:
        return True

    def _step(self, control: Any, dt: Any, kind: Any, xp: Any) -> tuple[Array, Array | None, Array]:
        """F, what is added, and Q; those of no step where no time has passed."""
        goes = xp.asarray(dt, dtype=kind) > 0.0
        F = xp.asarray(_given(self.F, control), dtype=kind)
        F = xp.where(goes, F, xp.eye(self.space.size, dtype=kind))
        Q = xp.where(goes, self._Q.matrix(control, kind, xp), 0.0)
        if self.G is None:
            return F, None, Q
        pushed = (xp.asarray(_given(self.G, control), dtype=kind) @ vector_of(control, xp)[..., None])[..., 0]
        return F, xp.where(goes, pushed, 0.0), Q

    def carry(self, x: Array, control: Any, w: Array | None, dt: Any, xp: Any) -> Array:
        F, pushed, _ = self._step(control, dt, x.dtype, xp)
        after = F @ x if len(x.shape) == 1 else (F @ x.mT).mT  # of many: each entry's numbers side by side
        after = after if w is None else after + w
        after = after if pushed is None else after + pushed
        return after if self.space.flat else self.space.plus(x, after - x, xp)

    def noise_root(self, control: Any, dt: Any, kind: Any, xp: Any) -> Array | None:
        root = semidefinite_root(self._Q.matrix(control, kind, xp), xp=xp)  # of no step's it is 0
        return xp.where(xp.asarray(dt, dtype=kind) > 0.0, root, 0.0)

    def linearised(self, x: Array, control: Any, dt: Any, xp: Any) -> tuple[Array, Array, Array | None]:
        F, pushed, Q = self._step(control, dt, x.dtype, xp)
        after = (F @ x[..., None])[..., 0]
        after = after if pushed is None else after + pushed
        return (after if self.space.flat else self.space.plus(x, after - x, xp)), F, Q


def runge_kutta(space: StateSpace, rates: Callable[..., Any], *, steps: int = 1) -> Callable[..., Any]:
    """A `move` made of a differential equation, by the classical Runge-Kutta rule of fourth order.

        MotionModel(PENDULUM, runge_kutta(PENDULUM, swing), density=...)

    On angles and vectors the error of a step is of the fifth order in dt; on attitudes and groups the slopes
    are taken to belong to the start of the step, which leaves an error of the third order.

    Args:
        space: of the state.
        rates: `rates(x, u, w, t, xp)`, the velocity of each part as `space.plus(x, velocity=...)` takes it;
            u, w and t may be left out. t is the time in s, which a plant tells (see `MotionModel`).
        steps: equal parts that a step is taken in.

    Raises:
        DeclarationError: where `rates` has other parameters, or `steps` is no whole number from 1.
    """
    slope = Handed(rates, "runge_kutta.rates", ("w", "t", "xp"), "control")
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        raise DeclarationError(
            "a step cannot be taken in so many parts",
            path="runge_kutta.steps",
            expected="a whole number from 1",
            got=repr(steps),
            fix="write steps=4, or leave it out",
        )

    def move(x: Any, u: Any, w: Any, t: Any, dt: Any, xp: Any) -> Any:
        start, h = space.view(x, xp), dt / steps
        for part in range(steps):
            here, begin = array_of(start), None if t is None else t + part * h

            def at(y: Any, share: float, here: Any = here, begin: Any = begin) -> Any:
                now = None if begin is None else begin + share * h
                return joined(space, slope(y, u, w=w, t=now, xp=xp), here, xp, tangent=True)

            go = lambda d: space.view(space.plus(here, d, xp), xp)  # noqa: B023
            k1 = at(start, 0.0)
            k2 = at(go(0.5 * h * k1), 0.5)
            k3 = at(go(0.5 * h * k2), 0.5)
            k4 = at(go(h * k3), 1.0)
            start = go(h / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4))
        return start

    return _asking(move, control=slope.other is not None, noise="w" in slope.names, time="t" in slope.names)


def _asking(move: Callable[..., Any], *, control: bool, noise: bool, time: bool) -> Callable[..., Any]:
    """A `move` with only those parameters that are asked for, as `MotionModel` reads them."""
    names = tuple(n for n, asked in (("u", control), ("w", noise), ("t", time)) if asked)

    def asked(x: Any, *given: Any) -> Any:
        found = dict(zip((*names, "dt", "xp"), given, strict=True))
        return move(x, *(found.get(n) for n in ("u", "w", "t", "dt", "xp")))

    kind = inspect.Parameter.POSITIONAL_ONLY
    asked.__signature__ = inspect.Signature(  # type: ignore[attr-defined]
        [inspect.Parameter(n, kind) for n in ("x", *names, "dt", "xp")]
    )
    return asked


def _given(matrix: Any, control: Any) -> Any:
    return matrix(control) if callable(matrix) else np.asarray(matrix, dtype=float)


def _per_second(dt: Any, kind: Any, xp: Any) -> Array:
    """1 / dt, and 0 over no time."""
    dt = xp.asarray(dt, dtype=kind)
    passed = dt > 0.0
    return xp.where(passed, 1.0 / xp.where(passed, dt, 1.0), 0.0)
