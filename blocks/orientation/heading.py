"""The heading of a level frame by a magnetometer, and the orientation that tilt and heading make together.

The level frame of `marg` has z up and a heading that drifts. Here is the angle from it to the world, a filter
of one number, beside what is known of the field where nothing disturbs it. A reading is judged by the field's
strength and dip, which the heading does not change: the farther they are from the undisturbed field's, the
larger the variance of the heading that it shows. Beside a magnet both pass through normal for an instant, so
the doubt of a reading fades only slowly.

Source: D. Laidig and T. Seel, "VQF: highly accurate IMU orientation estimation with bias estimation and
magnetic disturbance rejection", Information Fusion 91, 2023 (a heading apart from an inclination, and the
test of strength and dip).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.geometry.manifold import angle
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, normalize, rotate, to_matrix
from flowgraph.blocks.kalman.filters import correct
from flowgraph.blocks.kalman.lost import Held, aged
from flowgraph.blocks.signals import (
    Alignment,
    AttitudeBiasBelief,
    HeadingBelief,
    Imu,
    LevelBelief,
    MagneticField,
    Rest,
)

__all__ = [
    "FieldTrust",
    "OrientationBelief",
    "doubt_heading",
    "join_orientation",
    "predict_heading",
    "start_heading",
    "update_heading",
]

OrientationBelief = AttitudeBiasBelief
"""The older name of the belief over attitude and gyroscope bias."""

ANGLE = angle()


@dataclass(frozen=True)
class FieldTrust:
    """How a reading of the field is judged.

    A disturbance that points anywhere changes the relative strength by as much as the dip, so both have one
    limit; 0.06 is twice what they change by in rooms.

    Args:
        density: rad/sqrt(Hz), of the heading that an undisturbed field shows. It is that of the field, which
            differs by degrees from place to place; the noise of a sensor is a hundredth of it.
        strength: relative deviation of the field's strength at which the variance is doubled.
        dip: rad, deviation of the dip at which it is doubled.
        memory: s, in which strength and dip of the undisturbed field are learned.
        power: of the deviation; the more, the sharper a disturbed field is refused.
        hold: s, the time constant with which the doubt of a reading fades; 0 forgets it at once.
    """

    density: float = 0.085
    strength: float = 0.06
    dip: float = 0.06
    memory: float = 30.0
    power: int = 2
    hold: float = 0.3


def start_heading(found: Alignment, field: np.ndarray) -> HeadingBelief:
    """The heading to start from, which is that of the alignment to 0.1 rad, and the field (3,) in T as
    undisturbed."""
    m = rotate(np.asarray(found.attitude), np.asarray(field, dtype=float), xp=np)
    return HeadingBelief(
        angle=np.float64(0.0),
        variance=np.float64(0.01),
        strength=np.float64(np.linalg.norm(m)),
        dip=np.float64(np.arctan2(-m[2], np.hypot(m[0], m[1]))),
    )


@block
def predict_heading(
    belief: HeadingBelief,
    level: LevelBelief,
    imu: Imu,
    rest: Rest,
    *,
    drift: float,
    scale: float = 0.0,
    dt: float,
    xp: Any,
) -> HeadingBelief:
    """The level frame's heading wanders as the gyroscope does, and at rest stays.

        var' = var + (drift^2 + (scale w_z)^2) dt          w_z the rate about the vertical

    Args:
        drift: rad/s/sqrt(Hz), noise and the bias about the vertical, which gravity does not show.
        scale: s^(1/2), as in `predict_level`.
    """
    rate = rotate(level.attitude, imu.gyro - level.gyro_bias, xp=xp)[..., 2]
    return HeadingBelief(
        angle=belief.angle,
        variance=belief.variance + (drift**2 + (scale * rate) ** 2) * dt * (1.0 - rest.still),
        strength=belief.strength,
        dip=belief.dip,
    )


@block
def doubt_heading(  # type: ignore[no-untyped-def]
    state, belief: HeadingBelief, imu: Imu | None, *, held: Held, dt: float, xp: Any
) -> tuple[Any, HeadingBelief]:
    """Make a heading less sure by the age of the reading of the gyroscope: rate^2 w, as `bridge` has it.

    State: that age, s.
    """
    rest, _, w = aged(state, imu, held, dt, xp)
    return rest, belief.replace(variance=belief.variance + held.rate**2 * w)


@doubt_heading.init
def _fresh(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


_LONG = 10**13
"""ns; whoever waits longer than this has had no reading. Told in whole numbers: a word that holds the time
since before all time has no bits for the time between two readings."""


@block
def update_heading(  # type: ignore[no-untyped-def]
    state,
    prior: HeadingBelief,
    level: LevelBelief,
    field: MagneticField | None,
    *,
    trust: FieldTrust,
    north: float,
    t: int,
    xp: Any,
) -> tuple[Any, HeadingBelief]:
    """Correct the heading with the field, where there is a reading.

        m = R(q) field        z = north - atan2(m_y, m_x)          residual = z - a, in (-pi, pi]
        doubt = ((|m| / strength - 1) / s)^p + ((dip_m - dip) / d)^p
        held = max(doubt, held hold / (hold + dt))        variance = (density^2 / dt) (1 + held)

    with dt the time since the last reading. Strength and dip follow the field with the time constant
    `memory`, the slower the more it is off.

    Args:
        prior: the heading at this tick.
        level: attitude and velocity, without north.
        field: T, body; or absent.
        trust: how a reading is judged.
        north: rad, from the world's x axis to the field's horizontal part; pi/2 where y is north.

    State: time of the last reading (int64 ns), and the doubt that is held.
    """
    if field is None:
        return state, prior
    kind = prior.angle.dtype
    since = t - state["time"]
    since = xp.where(since > _LONG, 0 * since, since)  # the first reading comes after no time
    dt = xp.astype(since, kind) * 1e-9
    m = rotate(level.attitude, field.field, xp=xp)
    flat = xp.sqrt(m[..., 0] ** 2 + m[..., 1] ** 2)
    strength = xp.sqrt(xp.linalg.vecdot(m, m))
    dip = xp.atan2(-m[..., 2], flat)
    off_strength = (strength / prior.strength - 1.0) / trust.strength
    off_dip = (dip - prior.dip) / trust.dip
    doubt = xp.abs(off_strength) ** trust.power + xp.abs(off_dip) ** trust.power
    held = xp.maximum(doubt, state["held"] * (trust.hold / xp.maximum(trust.hold + dt, 1e-6)))
    variance = (1.0 + held) * trust.density**2 / xp.maximum(dt, 1e-6)
    z = north - xp.atan2(m[..., 1], m[..., 0])
    found = correct(
        prior.variance[..., None, None],
        ANGLE.minus(z, prior.angle, xp)[..., None],
        xp.ones((1, 1), dtype=kind),
        variance[..., None, None],
        xp=xp,
    )
    learn = dt / (trust.memory * (1.0 + held) + dt)
    return {"time": t, "held": held}, HeadingBelief(
        angle=ANGLE.plus(prior.angle, found.shift[..., 0], xp),
        variance=found.covariance[..., 0, 0],
        strength=prior.strength + learn * (strength - prior.strength),
        dip=prior.dip + learn * (dip - prior.dip),
    )


@update_heading.init
def _(*_: Any, **__: Any) -> Any:
    return {"time": np.int64(-(2**62)), "held": np.float64(0.0)}


@block
def join_orientation(level: LevelBelief, heading: HeadingBelief, *, xp: Any) -> AttitudeBiasBelief:
    """Attitude Exp(a e_z) * q, with the variance of the heading about the vertical and that of the tilt about
    the horizontal axes: P = T P_level T^T + var u u^T, u the vertical in the body, T = I - u u^T on the
    attitude."""
    kind = level.attitude.dtype
    up = xp.asarray((0.0, 0.0, 1.0), dtype=kind)
    turn = from_rotation_vector(up * heading.angle[..., None], xp=xp)
    R = to_matrix(level.attitude, xp=xp)
    u = R[..., 2, :]
    along = u[..., :, None] * u[..., None, :]
    one = xp.eye(3, dtype=kind) + 0.0 * along
    zero = 0.0 * along
    T = xp.concat(
        [xp.concat([zero, one - along, zero], axis=-1), xp.concat([zero, zero, one], axis=-1)], axis=-2
    )
    spread = xp.concat([u, 0.0 * u], axis=-1)
    P = T @ level.covariance @ T.mT
    P = P + heading.variance[..., None, None] * (spread[..., :, None] * spread[..., None, :])
    return AttitudeBiasBelief(
        attitude=normalize(multiply(turn, level.attitude, xp=xp), xp=xp),
        gyro_bias=level.gyro_bias,
        covariance=0.5 * (P + P.mT),
    )
