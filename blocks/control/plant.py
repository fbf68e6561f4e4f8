"""A plant: what a controller moves. Its state goes by a model of motion, over the time since it last fired.

Between two ticks it is told what it was last told: the input is held, as a digital controller's is. A
`LinearModel` is exact then, and `runge_kutta` of `statespace` makes a model of a differential equation. The
output of a tick is where the inputs before it led, so a loop closes through a plant without a delay of its
own.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.control.adaptive import DormandPrince
from flowgraph.blocks.statespace import Motion
from flowgraph.errors import DeclarationError
from flowgraph.language.moore import Moore, moore
from flowgraph.types import ArrayType

__all__ = ["plant"]


@block
def moved(state, command, *, model, start, dt, xp):  # type: ignore[no-untyped-def]
    """x' = model.carry(x, command, dt); x where it fires first."""
    new = model.carry(state[None, :], command, None, dt, xp)[0]
    return new, new


@block
def moved_in_time(state, command, *, model, start, t, dt, xp):  # type: ignore[no-untyped-def]
    """x' = model.carry(x, command, dt, t) with t, s, when the step began; x where it fires first."""
    begin = xp.astype(t, state.dtype) * 1e-9 - dt
    new = model.carry(state[None, :], command, None, dt, xp, t=begin)[0]
    return new, new


@moved.init
def _(command: Any, *, model: Motion, start: Any) -> Array:
    return np.asarray(start, dtype=float)


@moved_in_time.init
def _(command: Any, *, model: Motion, start: Any) -> Array:
    return np.asarray(start, dtype=float)


def _as_its_state(types: Any, settings: Any) -> ArrayType:
    return ArrayType((settings["model"].space.size,), "real")


@block(host=True, output=_as_its_state)
def solved(state, command, *, model, start, t, dt):  # type: ignore[no-untyped-def]
    """The state x after dt seconds under the command before; x where it fires first."""
    new = model.after(state, command, float(dt), begin=float(t) * 1e-9 - float(dt))
    return new, new


@solved.init
def _(command: Any, *, model: DormandPrince, start: Any) -> Array:
    return np.asarray(start, dtype=float)


def plant(
    model: Motion | DormandPrince, *, start: Any, command: Any, at: object, name: str = "plant"
) -> Moore:
    """A plant in a loop: read its state at `output`, and `feed` it what it is told.

    Args:
        model: how it moves, without noise: `MotionModel`, `LinearModel`, or another of `statespace`; or a
            `DormandPrince`, which is solved on the host.
        start: the state (size) where it fires first.
        command: what it is told before it is told anything; says the type of its input too.
        at: when its state is read, a stream or clock.
        name: of the node.

    Raises:
        DeclarationError: where `model` is none, or `start` is no state of it.
    """
    space, begins = getattr(model, "space", None), np.asarray(start, dtype=float)
    if space is None or begins.shape != (space.size,):
        raise DeclarationError(
            "this is no plant",
            path=name,
            expected="a motion, and a state of it to start from",
            got=f"{type(model).__name__}, of {space}, from an array of shape {begins.shape}",
            fix="write plant(MotionModel(SPACE, runge_kutta(SPACE, dynamics)), start=..., ...)",
        )
    timed = moved_in_time if getattr(model, "timed", False) else moved
    step = solved if isinstance(model, DormandPrince) else timed
    return moore(step, init=command, at=at, name=name, model=model, start=begins)
