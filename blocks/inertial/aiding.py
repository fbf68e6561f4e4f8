"""Aiding: correct an inertial belief with positions and attitudes, where there are any.

Each block takes a prior and an optional measurement. Without one the prior passes through and there is no
innovation; an entry that is NaN was not measured, and the others correct alone. With one, the error state is
estimated by a Kalman update in Joseph form, folded into the nominal state, and reset.

An `invariant` correction takes the error as one of the group SE_2(3) of attitude, velocity and position: what
was not known of the position turns with the attitude that is corrected, the correction moves along the arc
(`_carried`), and there is no reset. The equations of the error then hold for errors of any size, and a filter
finds a heading of which nothing was known.

Sources: A. Barrau, S. Bonnabel, "The invariant extended Kalman filter as a stable observer", IEEE Trans. on
Automatic Control 62(4), 2017 (the left-invariant error). J. Solà, "Quaternion kinematics for the error-state
Kalman filter", arXiv:1711.02508, 2017, sec. 7: update eqs. 275-276, injection eq. 283, reset eqs. 286-287 for
the right (local) attitude error.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from flowgraph import Array, block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    skew,
    to_matrix,
    to_rotation_vector,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.kalman.filters import correct, scaled
from flowgraph.blocks.kalman.robust import Robust
from flowgraph.blocks.signals import Attitude, Belief, KalmanInnovation, Position

__all__ = ["aid_attitude", "aid_position", "correct_belief"]

Spread = float | tuple[float, float, float]
"""A standard deviation: one number for three axes, or one each."""

ORIGIN = (0.0, 0.0, 0.0)
ALIGNED = (1.0, 0.0, 0.0, 0.0)


STATE = StateSpace(position=euclidean(3), velocity=euclidean(3), attitude=quaternion(), biases=euclidean(6))
"""Of a belief with biases, and of its errors."""


@block
def aid_position(
    prior: Belief,
    position: Position | None,
    scale: Any = None,
    *,
    noise: Spread,
    lever: tuple[float, float, float] = ORIGIN,
    gate: float | None = None,
    robust: Robust | None = None,
    invariant: bool = False,
    xp: Any,
) -> tuple[Belief, KalmanInnovation | None]:
    """Correct a belief with the measured position of a point fixed to the body.

    z = p + R(q) lever + noise, so H = [I, 0, -R skew(lever), 0, 0] and residual = z - p - R lever.

    Args:
        prior: the belief at the time of the measurement.
        position: z, m in the world; or absent.
        noise: standard deviation, m.
        lever: the point in body coordinates, m.
        gate: when given, a measurement that is too far off changes nothing; see `update_linear`. (For three
            axes a nis of 16.3 is 99.9 %.)
        robust: when given, one that is far off counts for less; see `update_linear`.
        scale: on the variance, where it is learned (`learned_scale`).
        invariant: take the error as one of the group SE_2(3), in which that of an attitude may be large, as
            that of a start of which the heading is not known; see the head of this module.

    Returns:
        The posterior, and the innovation (m, world) where there was a measurement.
    """
    if position is None:
        return prior, None
    kind = prior.position.dtype
    R = to_matrix(prior.attitude, xp=xp)
    arm = xp.asarray(lever, dtype=kind)
    apart = position.position - prior.position - (R @ arm[..., None])[..., 0]
    zero = 0.0 * R
    H = xp.concat([zero + xp.eye(3, dtype=kind), zero, R @ -skew(arm, xp=xp), zero, zero], axis=-1)
    return correct_belief(
        prior, apart, H, scaled(_variance(noise, kind, xp), scale, xp), gate, invariant, xp, robust
    )


@block
def aid_attitude(
    prior: Belief,
    attitude: Attitude | None,
    scale: Any = None,
    *,
    noise: Spread,
    mount: tuple[float, float, float, float] = ALIGNED,
    gate: float | None = None,
    robust: Robust | None = None,
    invariant: bool = False,
    xp: Any,
) -> tuple[Belief, KalmanInnovation | None]:
    """Correct a belief with a measured attitude.

    z = q * Exp(noise) * mount; residual = Log(q^-1 * z * mount^-1) and H = [0, 0, I, 0, 0], to first order.

    Args:
        prior: the belief at the time of the measurement.
        attitude: z, a unit quaternion, sensor to world; or absent.
        noise: standard deviation about the body axes, rad.
        mount: the sensor's attitude in the body, a unit quaternion.
        gate, robust, scale, invariant: as in `aid_position`.

    Returns:
        The posterior, and the innovation (rad, body) where there was a measurement.
    """
    if attitude is None:
        return prior, None
    kind = prior.position.dtype
    apart = _attitude_residual(prior.attitude, attitude.attitude, mount, xp)
    zero = 0.0 * to_matrix(prior.attitude, xp=xp)
    H = xp.concat([zero, zero, zero + xp.eye(3, dtype=kind), zero, zero], axis=-1)
    return correct_belief(
        prior, apart, H, scaled(_variance(noise, kind, xp), scale, xp), gate, invariant, xp, robust
    )


def _carried(q: Array, turn: Array, xp: Any) -> tuple[Array, Array]:
    """What a correction of the attitude by `turn` (rad, body) does to errors in the world: J (3, 3), by which
    those of position and velocity are folded in, and the rotation (3, 3) with which they turn.

        J(u) = I + (1 - cos a)/a^2 [u]x + (a - sin a)/a^3 [u]x^2        u = R turn, a = |u|
    """
    R = to_matrix(q, xp=xp)
    u = (R @ turn[..., None])[..., 0]
    square = xp.linalg.vecdot(u, u)
    near = square < 1e-6
    safe = xp.where(near, 1.0 + 0.0 * square, square)
    a = xp.sqrt(safe)
    first = xp.where(near, 0.5 - square / 24.0, (1.0 - xp.cos(a)) / safe)[..., None, None]
    second = xp.where(near, 1.0 / 6.0 - square / 120.0, (a - xp.sin(a)) / (safe * a))[..., None, None]
    S = skew(u, xp=xp)
    push = xp.eye(3, dtype=q.dtype) + first * S + second * (S @ S)
    return push, R @ to_matrix(from_rotation_vector(turn, xp=xp), xp=xp) @ R.mT


def _variance(noise: Spread, kind: Any, xp: Any) -> Array:
    spread = noise if isinstance(noise, tuple) else (noise,) * 3
    return xp.eye(3, dtype=kind) * xp.asarray([s * s for s in spread], dtype=kind)


def _attitude_residual(q: Array, z: Array, mount: tuple[float, ...], xp: Any) -> Array:
    measured = z
    if mount != ALIGNED:
        measured = multiply(z, conjugate(xp.asarray(mount, dtype=q.dtype), xp=xp), xp=xp)
    return to_rotation_vector(multiply(conjugate(q, xp=xp), measured, xp=xp), xp=xp)


class _Group(NamedTuple):
    """The error as one of the group SE_2(3), at an attitude: that of position and velocity turns with it, and
    `more` numbers behind the fifteen stay."""

    attitude: Array
    more: int = 0

    def reset(self, d: Array, xp: Any) -> Array:
        """The Jacobian (15, 15) of the error when the state moves by d, as `StateSpace.reset` gives it."""
        _, swing = _carried(self.attitude, d[..., 6:9], xp)
        none, stay = 0.0 * swing, 0.0 * swing + xp.eye(3, dtype=d.dtype)
        diagonal = (swing, swing, stay, stay, stay)
        rows = [[none] * k + [part] + [none] * (4 - k) for k, part in enumerate(diagonal)]
        found = xp.concat([xp.concat(row, axis=-1) for row in rows], axis=-2)
        if not self.more:
            return found
        side, corner = 0.0 * found[..., :, : self.more], 0.0 * found[..., : self.more, : self.more]
        below = xp.concat([side.mT, corner + xp.eye(self.more, dtype=d.dtype)], axis=-1)
        return xp.concat([xp.concat([found, side], axis=-1), below], axis=-2)


def correct_belief(
    prior: Any,
    apart: Array,
    H: Array,
    R: Array,
    gate: float | None,
    invariant: bool,
    xp: Any,
    robust: Robust | None = None,
) -> tuple[Any, KalmanInnovation]:
    """The correction that every Kalman filter shares, folded into the nominal state.

    Args:
        prior: a `Belief`, or a `NavigationBelief`.
        apart: measured minus predicted (m); NaN where an entry was not measured.
        H: (m, n), the Jacobian by the error of the belief. R: (m, m), the covariance of the noise.
        gate, robust, invariant: as in `aid_position`.
    """
    more = prior.covariance.shape[-1] - 15
    space = _Group(prior.attitude, more) if invariant else _space(more)
    found = correct(prior.covariance, apart, H, R, gate=gate, space=space, robust=robust, xp=xp)
    d, turn = found.shift, found.shift[..., 6:9]
    to_place, to_speed = d[..., 0:3], d[..., 3:6]
    if invariant:
        push, _ = _carried(prior.attitude, turn, xp)
        moved = push @ xp.concat([to_place[..., None], to_speed[..., None]], axis=-1)
        to_place, to_speed = moved[..., 0], moved[..., 1]
    values = {
        "position": prior.position + to_place,
        "velocity": prior.velocity + to_speed,
        "attitude": multiply(prior.attitude, from_rotation_vector(turn, xp=xp), xp=xp),
        "gyro_bias": prior.gyro_bias + d[..., 9:12],
        "accelerometer_bias": prior.accelerometer_bias + d[..., 12:15],
        "covariance": found.covariance,
    }
    if more:
        values["parameters"] = prior.parameters + d[..., 15:]
    return type(prior)(**values), found.innovation


def aided(
    prior: Any,
    measured: Array,
    see: Callable[[Any, Any], Array],
    R: Array,
    gate: float | None,
    invariant: bool,
    xp: Any,
    robust: Robust | None = None,
) -> tuple[Any, KalmanInnovation]:
    """`correct_belief` with z = see(x) + noise, whose Jacobian is derived.

    Args:
        prior, R, gate, robust, invariant: as there.
        measured: z (m).
        see: `see(x, xp)` (..., m), of states one a row with the parts of `STATE`; behind the six biases are
            the parameters of a `NavigationBelief`.
    """
    more = prior.covariance.shape[-1] - 15
    parts = [prior.position, prior.velocity, prior.attitude, prior.gyro_bias, prior.accelerometer_bias]
    x = xp.concat([*parts, prior.parameters] if more else parts, axis=-1)
    space = _space(more)
    y, H = linearised(lambda x, xp: see(space.view(x, xp), xp), x, space, xp)
    return correct_belief(prior, measured - y, H, R, gate, invariant, xp, robust)


def _space(more: int) -> StateSpace:
    """`STATE`, with so many numbers behind it."""
    if not more:
        return STATE
    return StateSpace(
        position=euclidean(3), velocity=euclidean(3), attitude=quaternion(), biases=euclidean(6 + more)
    )
