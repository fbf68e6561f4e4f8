"""Particles whose control has become old: they spread by its age, as a Gaussian does in `kalman.lost`.

What is Gaussian given a particle becomes less sure; what is drawn is drawn farther. With T, s and w of
`bridge`, a velocity is spread by force^2 w, the position with it, and an attitude by rate^2 w. While controls
come as they should, s is 0, and clouds stay as they are, to the bit. What is drawn is too
few to be everywhere: over a pause of all streams such clouds stay.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.kalman.lost import Held, aged
from flowgraph.blocks.models.euler_ins import STATE
from flowgraph.blocks.signals import Cloud, OutdoorCloud, PlaneCloud, StateCloud

__all__ = ["spread_cloud", "spread_outdoor", "spread_plane", "spread_states"]

_SHARE = math.sqrt(1.0 / 12.0)
"""Of what the velocity does not tell of the position, where both are driven by one white noise."""


@block
def spread_cloud(  # type: ignore[no-untyped-def]
    state, cloud: Cloud, control: Any | None, *, held: Held, dt: float, draw: Any, xp: Any
) -> tuple[Any, Cloud]:
    """Spread a Rao-Blackwellized cloud: its motion's covariances, and its attitudes, which are drawn.

    Draws `held` (3, n). State: the age of the control, s.
    """
    rest, part, w = aged(state, control, held, dt, xp, pause=0.0)
    kind = cloud.position.dtype
    one = xp.asarray(np.eye(3)[:, :, None] * held.force**2, dtype=kind)
    errors = xp.asarray(draw.normal("held", (3, cloud.log_weight.shape[-1])), dtype=kind)
    turn = lanes.exponential(errors * (held.rate * xp.sqrt(w)), xp=xp)
    turned = lanes.normalize(lanes.multiply(cloud.attitude, turn, xp=xp), xp=xp)
    return rest, cloud.replace(
        attitude=xp.where(w > 0.0, turned, cloud.attitude),
        velocity_covariance=cloud.velocity_covariance + one * w,
        cross_covariance=cloud.cross_covariance + one * (0.5 * part * w),
        position_covariance=cloud.position_covariance + one * (part * part * w / 3.0),
    )


@block
def spread_outdoor(  # type: ignore[no-untyped-def]
    state, cloud: OutdoorCloud, control: Any | None, *, held: Held, dt: float, xp: Any
) -> tuple[Any, OutdoorCloud]:
    """Spread the Gaussian of each particle of an outdoor cloud: velocity, positions and turn.

    State: the age of the control, s.
    """
    rest, part, w = aged(state, control, held, dt, xp)
    kind = cloud.motion.dtype
    parts = np.zeros((4, 4, 4))
    parts[0, 0, 0] = held.force**2
    parts[1, 0, 1:3] = parts[1, 1:3, 0] = held.force**2
    parts[2, 1:3, 1:3] = held.force**2
    parts[3, 3, 3] = held.rate**2
    biases = cloud.covariance.shape[0] - 12  # which stay
    tables = [np.pad(np.kron(p, np.eye(3)), (0, biases))[:, :, None] for p in parts]
    v, vp, pp, turn = (xp.asarray(table, dtype=kind) for table in tables)
    more = v * w + vp * (0.5 * part * w) + pp * (part * part * w / 3.0) + turn * w
    return rest, cloud.replace(covariance=cloud.covariance + more)


@block
def spread_states(  # type: ignore[no-untyped-def]
    state, cloud: StateCloud, control: Any | None, *, held: Held, dt: float, draw: Any, xp: Any
) -> tuple[Any, StateCloud]:
    """Spread the states of `particle_ins`: position, angles and velocity of each; biases stay.

    Draws `held` (9, n). State: the age of the control, s.
    """
    rest, part, w = aged(state, control, held, dt, xp, pause=0.0)
    x = cloud.state
    errors = xp.asarray(draw.normal("held", (9, x.shape[0])), dtype=x.dtype).mT * xp.sqrt(w)
    push, apart, turn = errors[:, 0:3] * held.force, errors[:, 3:6] * held.force, errors[:, 6:9] * held.rate
    place = (0.5 * push + _SHARE * apart) * part
    more = xp.concat([place, turn, push, xp.zeros((x.shape[0], 6), dtype=x.dtype)], axis=-1)
    return rest, cloud.replace(state=xp.where(w > 0.0, STATE.plus(x, more, xp), x))


@block
def spread_plane(  # type: ignore[no-untyped-def]
    state, cloud: PlaneCloud, control: Any | None, *, held: Held, dt: float, draw: Any, xp: Any
) -> tuple[Any, PlaneCloud]:
    """Spread points that are moved by a velocity, which differs from an old one by force T (m/s).

    Draws `held` (2, n). State: the age of the control, s.
    """
    rest, _, w = aged(state, control, held, dt, xp, pause=0.0)
    errors = xp.asarray(draw.normal("held", cloud.position.shape), dtype=cloud.position.dtype)
    return rest, cloud.replace(position=cloud.position + errors * (held.force * xp.sqrt(w)))


@spread_cloud.init
@spread_outdoor.init
@spread_states.init
@spread_plane.init
def _fresh(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)
