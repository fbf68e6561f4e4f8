"""Controllers, and what stands between them and a plant.

Source: K. Astrom and R. Murray, "Feedback Systems", 2008: secs. 6.3 (linear quadratic), 10.4 and 10.5 (PID
with a filtered derivative, and against windup by back-calculation).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Array, Scalar, Stream, block, stacked
from flowgraph.blocks.signals import Controller
from flowgraph.errors import DeclarationError
from flowgraph.language.checks import same_type
from flowgraph.types import Type, as_value, flatten, unflatten

__all__ = ["late", "limited", "pid", "regulator", "state_feedback"]


def _check_limits(path: str, low: float, high: float) -> None:
    if np.any(np.greater(low, high)):
        raise DeclarationError(
            "there is nothing between these limits",
            path=path,
            expected="low, and high that is not below it",
            got=f"low={low!r}, high={high!r}",
            fix=f"write {path}(..., low=-1.0, high=1.0)",
        )


@block
def pid(
    state: Controller, error: Scalar, *, gain: float, integral: float = 0.0, derivative: float = 0.0,
    filter: float = 0.0, low: float = -np.inf, high: float = np.inf, dt: float, xp: Any,
) -> tuple[Controller, Scalar]:  # fmt: skip
    """u = gain e + i + d, kept within `low` .. `high`; i grows by `integral` e dt, by the rectangle before.

    The derivative is that of the error through a first-order filter of `filter` seconds, `derivative` de/dt
    where that is 0; it is 0 where it fires first. While u is at a limit the integral does not grow further
    beyond it."""
    _check_limits("pid", low, high)
    kind = error.dtype
    first = xp.asarray(dt, dtype=kind) <= 0.0
    grown = state.integral + integral * state.error * dt
    share = xp.where(first, 0.0, 1.0 / xp.where(first, 1.0, filter + dt))
    slope = xp.where(first, 0.0, share * (filter * state.slope + error - state.error))
    free = gain * error + grown + derivative * slope
    held = xp.minimum(xp.maximum(free, low), high)
    kept = xp.where((free - held) * (grown - state.integral) > 0.0, state.integral, grown)
    return Controller(integral=kept, error=error, slope=slope), held


@pid.init
def _(error: Any, **_: Any) -> Controller:
    return Controller(integral=0.0, error=0.0, slope=0.0)


@block
def state_feedback(x: Array, target: Array, *, gains: Array, xp: Any) -> Array:  # type: ignore[no-untyped-def]
    """u = K (target - x), with `gains` K (m, n)."""
    return xp.asarray(gains, dtype=x.dtype) @ (target - x)


@block
def limited(u, *, low: float, high: float, xp: Any):  # type: ignore[no-untyped-def]
    """Each number of u, no smaller than `low` and no larger than `high`: what an actuator can do."""
    _check_limits("limited", low, high)
    return xp.minimum(xp.maximum(u, low), high)


@block(output=same_type)
def _late(state, x, *, kind, ticks, init, xp):  # type: ignore[no-untyped-def]
    """The value of so many firings ago. State: the values since, the oldest first."""
    behind = stacked(kind, ticks)
    old = flatten(state, behind)
    new = [xp.concat([o[1:], v[None]]) for o, v in zip(old, flatten(x, kind), strict=True)]
    return unflatten(behind, iter(new)), unflatten(kind, iter([o[0] for o in old]))


@_late.init
def _(x: Any, *, kind: Type, ticks: int, init: Any) -> Any:
    rows = [np.broadcast_to(v, (ticks, *np.shape(v))) for v in flatten(init, kind)]
    return unflatten(stacked(kind, ticks), iter(rows))


def late(stream: Stream[Any], ticks: int, init: Any, *, name: str = "late") -> Stream[Any]:
    """A stream as it was so many of its own ticks ago, and `init` before that.

    Raises:
        DeclarationError: where `ticks` is no whole number from 0.
    """
    if isinstance(ticks, bool) or not isinstance(ticks, int) or ticks < 0:
        raise DeclarationError(
            "this is no number of ticks",
            path=name,
            expected="a whole number from 0",
            got=repr(ticks),
            fix="write late(stream, 4, init=...)",
        )
    if not ticks:
        return stream
    kind = stream.type
    start = as_value(init, kind, path=f"{name}.init")
    return _late(stream, kind=kind, ticks=ticks, init=start, name=name)  # type: ignore[no-any-return]


def regulator(
    A: npt.ArrayLike, B: npt.ArrayLike, Q: npt.ArrayLike, R: npt.ArrayLike, *, period: float | None = None
) -> np.ndarray:
    """The gains K (m, n) of the linear quadratic regulator: u = -K x makes the integral of x^T Q x + u^T R u
    least for dx = (A x + B u) dt.

    Args:
        A, B: (n, n) and (n, m), 1/s.
        Q, R: (n, n) and (m, m), what a state and an input cost.
        period: s; with it for an input that is held so long, of the discretised motion, with costs by sample.

    Raises:
        DeclarationError: where there is no such regulator, as for a state that no input reaches.
    """
    from scipy.linalg import LinAlgError, expm, solve_continuous_are, solve_discrete_are  # slow to import

    A, B, Q, R = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (A, B, Q, R))
    try:
        if period is None:
            return np.asarray(np.linalg.solve(R, B.T @ solve_continuous_are(A, B, Q, R)))
        n, m = B.shape
        both = expm(period * np.block([[A, B], [np.zeros((m, n + m))]]))
        F, G = both[:n, :n], both[:n, n:]
        P = solve_discrete_are(F, G, Q, R)
        return np.asarray(np.linalg.solve(R + G.T @ P @ G, G.T @ P @ F))
    except (LinAlgError, ValueError) as error:
        raise DeclarationError(
            "there is no linear quadratic regulator",
            path="regulator",
            expected="(A, B) that an input can steer, Q >= 0 and R > 0 of their sizes",
            got=f"A {A.shape}, B {B.shape}, Q {Q.shape}, R {R.shape}: {error}",
            fix="check which states an input reaches, and that R is positive definite",
        ) from error
