"""The sensors of the particles of an outdoor filter: each corrects every particle, and weighs it.

Each block takes one sensor, passes the cloud through where there is no reading, and leaves the weights
normalised; so sensors may come in any order, at any time. The whole cloud judges a reading before its
particles are corrected, by its mean and covariance: a gate refuses what is too far off, and a cloud that
refused one reading of a sensor after the other is widened, as `kalman.lost` has it. Of a position, the finite
entries correct; a field and each half of optical flow, which are of the body, are there as a whole or not at
all.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.kalman.lost import PATIENCE, lost_variances
from flowgraph.blocks.outdoor.cloud import MOVED, POSITION, TURN, as_cloud, shifted, turned
from flowgraph.blocks.outdoor.layout import particle_layout
from flowgraph.blocks.particles.cloud import average_attitude, log_sum_exp
from flowgraph.blocks.particles.lost import judged, mixture, within_reach
from flowgraph.blocks.signals import (
    KalmanInnovation,
    MagneticField,
    OpticalFlow,
    OutdoorCloud,
    Position,
    Range,
    Weights,
)

__all__ = ["correct_distance", "correct_field", "correct_flow", "correct_position"]

ORIGIN = (0.0, 0.0, 0.0)
_LEAST_UPRIGHT = 0.05
"""cos(tilt) below which a beam along body z does not meet the ground for any practical purpose."""


@block
def correct_position(
    state: Any,
    cloud: OutdoorCloud,
    position: Position | None,
    *,
    noise: float,
    lever: tuple[float, float, float] = ORIGIN,
    gate: float | None = None,
    patience: int = PATIENCE,
    xp: Any,
) -> tuple[Any, tuple[OutdoorCloud, KalmanInnovation | None]]:
    """Correct each particle with a measured position: z = p + R lever + N(0, noise^2 I).

    Args:
        position: z, m, world, of a point fixed to the body; without one the cloud passes through.
        noise: standard deviation, m.
        lever: the point in body coordinates, m.
        gate, patience: as in `verdict` of `particles.lost`.

    Returns:
        The corrected cloud, and the innovation of the whole cloud where there was a measurement.

    State: that of `kalman.lost.in_doubt`.
    """
    if position is None:
        return state, (cloud, None)
    seen = _place
    if lever != ORIGIN:
        arm = lanes.rotate(cloud.attitude, xp.asarray(lever, dtype=cloud.motion.dtype), xp=xp)
        seen = lambda A: A[POSITION, :, :] - lanes.cross(arm, A[TURN, :, :], xp=xp)
    measured = within_reach(position.position, xp=xp)
    residual = measured[:, None] - cloud.motion[POSITION, :]
    residual = residual if lever == ORIGIN else residual - arm
    gated = _Gated(gate, patience, shown=False)
    count, cloud, innovation, here = _judged(state, cloud, residual, seen, noise**2, gated, xp)
    return count, (_corrected(cloud, residual, seen, noise**2, here, xp), innovation)


@block
def correct_distance(
    state: Any,
    cloud: OutdoorCloud,
    distance: Range | None,
    *,
    noise: float,
    gate: float | None = None,
    patience: int = PATIENCE,
    xp: Any,
) -> tuple[Any, tuple[OutdoorCloud, KalmanInnovation | None]]:
    """Correct each particle with a distance to the ground (world z = 0) along body -z.

        z = p_z / u_z + N(0, noise^2),  u = R (0, 0, 1)

    of which the derivative by e is -p_z / u_z^2 (u_y, -u_x, 0).

    Args:
        distance: z, m; without one the cloud passes through.
        noise: standard deviation, m, along the beam.
        gate, patience: as in `correct_position`, as are what is returned and the state.
    """
    if distance is None:
        return state, (cloud, None)
    up = lanes.rotate(cloud.attitude, xp.asarray([0.0, 0.0, 1.0], dtype=cloud.motion.dtype), xp=xp)
    h = 1.0 / xp.maximum(up[2, :], _LEAST_UPRIGHT)
    predicted = cloud.motion[5, :] * h
    lean_x, lean_y = -predicted * h * up[1, :], predicted * h * up[0, :]

    def seen(A: Array) -> Array:
        return (A[5, :, :] * h + A[9, :, :] * lean_x + A[10, :, :] * lean_y)[None, :, :]

    residual = (within_reach(distance.distance, xp=xp) - predicted)[None, :]
    gated = _Gated(gate, patience, shown=False)
    count, cloud, innovation, here = _judged(state, cloud, residual, seen, noise**2, gated, xp)
    residual = xp.where(here[:, None], residual, 0.0)
    believed = xp.astype(here, residual.dtype)
    across = seen(cloud.covariance)[0, :, :] * believed  # (12, n)
    own = across[5, :] * h + across[9, :] * lean_x + across[10, :] * lean_y
    S, off = own + noise**2, residual[0, :]
    gain = across / S
    log_likelihood = -0.5 * (off * off / S + xp.log(S) + math.log(2.0 * math.pi))
    less = gain[:, None, :] * across[None, :, :]
    return count, (_moved(cloud, gain * off, cloud.covariance - less, log_likelihood, xp), innovation)


@block
def correct_field(
    state: Any,
    cloud: OutdoorCloud,
    field: MagneticField | None,
    *,
    earth: tuple[float, float, float],
    noise: float,
    gate: float | None = None,
    patience: int = PATIENCE,
    xp: Any,
) -> tuple[Any, tuple[OutdoorCloud, KalmanInnovation | None]]:
    """Correct each particle with a measured magnetic field: z = R^T earth + N(0, noise^2 I).

    Turned into the world by the mean attitude, R z = earth + earth x e + N(0, noise^2 I).

    Args:
        field: z, T, body; without one the cloud passes through.
        earth: the field in the world, T.
        noise: standard deviation of each component, T.
        gate, patience: as in `correct_position`, as are what is returned (the innovation in units of the
            noise) and the state.
    """
    if field is None:
        return state, (cloud, None)
    # in units of the noise: squares of tesla are too small for single precision
    expected = xp.asarray([[m / noise] for m in earth], dtype=cloud.motion.dtype)
    measured = within_reach(field.field / noise, xp=xp)
    residual = lanes.rotate(cloud.attitude, measured, xp=xp) - expected
    seen = lambda A: lanes.cross(expected, A[TURN, :, :], xp=xp)
    gated = _Gated(gate, patience, moving=False)
    count, cloud, innovation, here = _judged(state, cloud, residual, seen, 1.0, gated, xp)
    return count, (_corrected(cloud, residual, seen, 1.0, here, xp), innovation)


@block
def correct_flow(
    state: Any,
    cloud: OutdoorCloud,
    flow: OpticalFlow | None,
    *,
    displacement: float,
    turn: float,
    gate: float | None = None,
    patience: int = PATIENCE,
    xp: Any,
) -> tuple[Any, tuple[OutdoorCloud, KalmanInnovation | None]]:
    """Correct each particle with how the body moved and turned since the last picture.

        displacement = R(q_0)^T s + N(0, displacement^2 I)
        turn = q_0^-1 Exp(e) q * Exp(N(0, turn^2 I)),  so that  Log(q_0 turn q^-1) = e + N(0, turn^2 I)

    q_0 is the particle's attitude at the last picture and s its displacement since.

    Args:
        flow: over the time since the reading before it, or since the start; without one the cloud passes
            through.
        displacement, turn: standard deviations, m and rad.
        gate, patience: as in `correct_position`, as are what is returned (the innovation of both, m and rad,
            world) and the state.
    """
    if flow is None:
        return state, (cloud, None)
    moved = lanes.rotate(cloud.picture, within_reach(flow.displacement, xp=xp), xp=xp)
    moved = moved - cloud.motion[MOVED, :]
    residual = xp.concat([moved, _turn_off(cloud, flow, xp)], axis=0)
    noise = xp.asarray(np.repeat([displacement**2, turn**2], 3), dtype=moved.dtype)
    count, cloud, innovation, here = _judged(state, cloud, residual, _both, noise, _Gated(gate, patience), xp)
    cloud = _corrected(cloud, moved, lambda A: A[MOVED, :, :], displacement**2, here[:3], xp)
    off = _turn_off(cloud, flow, xp)
    return count, (_corrected(cloud, off, lambda A: A[TURN, :, :], turn**2, here[3:], xp), innovation)


def _place(A: Array) -> Array:
    return A[POSITION, :, :]


def _both(A: Array) -> Array:
    return A[6:12, :, :]


def _turn_off(cloud: OutdoorCloud, flow: OpticalFlow, xp: Any) -> Array:
    """Log(q_0 turn q^-1) (3, n), world."""
    back = cloud.picture * xp.asarray([[1.0], [-1.0], [-1.0], [-1.0]], dtype=cloud.motion.dtype)
    own = lanes.multiply(back, cloud.attitude, xp=xp)
    error = lanes.rotation_vectors_to(own, flow.turn, xp=xp)  # in the body
    return xp.sum(lanes.rotation_matrices(cloud.attitude, xp=xp) * error[None, :, :], axis=1)


@correct_position.init
@correct_distance.init
@correct_field.init
@correct_flow.init
def _none_refused(*_: Any, **__: Any) -> Any:
    return np.float64(0.0)


class _Gated(NamedTuple):
    """What a reading can be refused by, and what is widened where track was lost: all that moves, or the turn
    alone; and whether the reading shows the turn (`find_back`)."""

    gate: float | None
    patience: int
    moving: bool = True
    shown: bool = True


def _judged(
    state: Array, cloud: OutdoorCloud, residual: Array, seen: Callable[[Array], Array], variance: Any,
    gated: _Gated, xp: Any,
) -> tuple[Array, OutdoorCloud, KalmanInnovation, Array]:  # fmt: skip
    """What the cloud, taken for one Gaussian, makes of residual (m, n) = H x + N(0, variance), where `seen`
    applies H: the next state, the cloud, widened where a gate has refused so many that track is lost, the
    innovation, and which entries (m) there are to correct with."""
    m, kind = residual.shape[0], residual.dtype
    weight = xp.exp(cloud.log_weight)
    own = seen(lanes.transpose(seen(cloud.covariance), xp=xp))
    mean, S = mixture(weight, residual, xp=xp)
    S = S + xp.sum(own * weight, axis=-1) + xp.eye(m, dtype=kind) * variance
    S = 0.5 * (S + S.mT)
    count, innovation, grow = judged(state, mean, S, gate=gated.gate, patience=gated.patience, xp=xp)
    if gated.gate is not None:
        cloud = _widened(cloud, weight, grow, gated, xp)
    return count, cloud, innovation, ~xp.isnan(mean) & innovation.accepted


def _widened(cloud: OutdoorCloud, weight: Array, grow: Array, gated: _Gated, xp: Any) -> OutdoorCloud:
    """Each particle as unsure as `lost_variances` has it of the variances of the whole cloud."""
    kind = cloud.motion.dtype
    q = average_attitude.step(as_cloud.step(cloud), Weights(weight=weight), xp=xp).attitude
    turn = -lanes.rotation_vectors_to(cloud.attitude, q, xp=xp)  # in the body of the mean
    layout = particle_layout(cloud.covariance)
    apart = layout.put("turn", cloud.motion, to_matrix(q, xp=xp) @ turn, xp)
    apart = apart - (apart @ weight)[:, None]
    one = xp.asarray(np.eye(layout.directions), dtype=kind)
    own = xp.sum(cloud.covariance * one[:, :, None], axis=1)
    variance = (apart * apart + own) @ weight
    wide = lost_variances(
        variance, grow, moving=(0, 12) if gated.moving else (9, 12), attitude=9, shown=gated.shown, xp=xp
    )
    return cloud.replace(covariance=cloud.covariance + (one * (wide - variance))[:, :, None])


def _corrected(
    cloud: OutdoorCloud,
    residual: Array,
    seen: Callable[[Array], Array],
    variance: float,
    here: Array,
    xp: Any,
) -> OutdoorCloud:
    """The Kalman update and the weights for residual (3, n) = H x + N(0, variance I), where `seen` applies H,
    of the entries that are `here` (3).

    seen: H A (3, m, n) of A (12, m, n).
    """
    residual = xp.where(here[:, None], residual, 0.0)
    believed = xp.astype(here, residual.dtype)
    across = seen(cloud.covariance) * believed[:, None, None]  # (3, 12, n)
    own = seen(lanes.transpose(across, xp=xp)) * believed[:, None, None]
    own = own + xp.asarray((np.eye(3) * variance)[:, :, None], dtype=residual.dtype)
    inverse, log_determinant = lanes.inverse_and_log_determinant(own, xp=xp)
    u = xp.sum(inverse * residual[None, :, :], axis=1)
    solved = sum(inverse[:, k, None, :] * across[None, k, :, :] for k in range(3))  # (3, 12, n)
    less = sum(across[k, :, None, :] * solved[k, None, :, :] for k in range(3))
    log_likelihood = -0.5 * (xp.sum(residual * u, axis=0) + log_determinant + 3.0 * math.log(2.0 * math.pi))
    state = xp.sum(across * u[:, None, :], axis=0)
    return _moved(cloud, state, cloud.covariance - less, log_likelihood, xp)


def _moved(
    cloud: OutdoorCloud, state: Array, covariance: Array, log_likelihood: Array, xp: Any
) -> OutdoorCloud:
    """The cloud with its means moved by `state` (12 or 18, n), of which the turn goes into the attitude."""
    both = cloud.log_weight + log_likelihood
    return cloud.replace(
        log_weight=both - log_sum_exp(both, xp=xp),
        attitude=turned(cloud.attitude, state[TURN, :], xp),
        motion=shifted(cloud.motion, state, xp),
        covariance=0.5 * (covariance + lanes.transpose(covariance, xp=xp)),
    )
