"""Orientation from gyroscope, accelerometer and magnetometer: the tilt and the heading in two filters.

What a magnet can reach is kept apart from what it must not. The first filter knows gravity and nothing of the
north: its frame, "level", has z up and a heading that only drifts. The second knows the angle from the level
frame to the world and nothing else.

    level     velocity v, attitude q (body to level), gyroscope bias b; covariance 9 x 9
    heading   angle a from level to world; variance; strength and dip of the undisturbed field

    attitude in the world = Exp(a e_z) * q

So no reading of the magnetometer, however wrong, can tilt the estimate or move its bias.

*Acceleration* is not taken for noise of the vertical: it is integrated. A body that is moved by hand has
a velocity that stays small, and that it stays small is the measurement. A tilt shows itself as a velocity
that runs away, an acceleration as one that comes back, so a shake or a tap is told from a tilt without a
threshold. *Rest* is detected, and then the velocity is zero and the gyroscope shows its bias.

The heading is in `blocks/orientation/heading.py`.

Sources: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017, secs.
5-7; D. Laidig and T. Seel, "VQF: highly accurate IMU orientation estimation with bias estimation and magnetic
disturbance rejection", Information Fusion 91, 2023 (a heading apart from an inclination, rest detection, and
the test of strength and dip).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flowgraph import block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    multiply,
    normalize,
    skew,
    to_matrix,
)
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.kalman.filters import correct
from flowgraph.blocks.signals import Alignment, Imu, LevelBelief, Rest

__all__ = [
    "UNIT",
    "RestRule",
    "detect_rest",
    "hold_velocity",
    "predict_level",
    "start_level",
]


UNIT = ImuNoise(gyro=1e-3, accelerometer=5e-3, gyro_bias=1e-4, accelerometer_bias=1e-3)
"""Noise densities for a unit of which nothing is said."""


@dataclass(frozen=True)
class RestRule:
    """When a body is taken to rest.

    Args:
        rate: rad/s. force: m/s^2. The most by which a reading may be off the mean of the last ones.
        bias: rad/s, the largest mean rate that may still be a bias.
        seconds: how long all of that must hold.
        memory: s, the time constant of the mean.
    """

    rate: float = 0.035
    force: float = 0.5
    bias: float = 0.035
    seconds: float = 1.5
    memory: float = 0.5


def start_level(found: Alignment) -> LevelBelief:
    """The tilt, bias and their covariance to start from, surer after an alignment at rest.

    Standard deviations: velocity 0.1 m/s; attitude 0.02 rad at rest, else 0.2; bias 0.001 rad/s at rest, else
    0.02.
    """
    spread = [0.1] * 3 + [0.02 if found.resting else 0.2] * 3 + [0.001 if found.resting else 0.02] * 3
    return LevelBelief(
        velocity=np.zeros(3),
        attitude=np.asarray(found.attitude, dtype=float),
        gyro_bias=np.asarray(found.gyro_bias, dtype=float),
        covariance=np.diag(np.square(spread)),
    )


@block
def detect_rest(state, imu: Imu, *, rule: RestRule, dt: float, xp: Any) -> tuple[Any, Rest]:  # type: ignore[no-untyped-def]
    """Whether the readings have stayed by their running mean for long enough.

    State: the means of rate and force, and for how long all was still (s).
    """
    share = dt / (rule.memory + dt)
    fresh = xp.astype(state["seconds"] < 0.0, imu.gyro.dtype)  # at the first reading the mean is the reading
    share = fresh + (1.0 - fresh) * share
    rate = state["rate"] + (imu.gyro - state["rate"]) * share
    force = state["force"] + (imu.specific_force - state["force"]) * share
    off_rate, off_force = imu.gyro - rate, imu.specific_force - force
    calm = (
        (xp.linalg.vecdot(off_rate, off_rate) < rule.rate**2)
        & (xp.linalg.vecdot(off_force, off_force) < rule.force**2)
        & (xp.linalg.vecdot(rate, rate) < rule.bias**2)
    )
    seconds = xp.where(
        calm, xp.maximum(state["seconds"], 0.0 * state["seconds"]) + dt, 0.0 * state["seconds"]
    )
    still = xp.astype(seconds >= rule.seconds, rate.dtype)
    return {"rate": rate, "force": force, "seconds": seconds}, Rest(still=still)


@detect_rest.init
def _(imu: Any, **_: Any) -> dict[str, Any]:
    return {"rate": np.zeros(3), "force": np.zeros(3), "seconds": np.float64(-1.0)}


_ONE = np.eye(9)


def _noise(noise: ImuNoise) -> np.ndarray:
    parts = (noise.accelerometer, noise.gyro, noise.gyro_bias)
    return np.diag([density**2 for density in parts for _ in range(3)])


@block
def predict_level(
    belief: LevelBelief,
    imu: Imu,
    *,
    noise: ImuNoise,
    scale: float = 0.0,
    gravity: float = 9.81,
    dt: float,
    xp: Any,
) -> LevelBelief:
    """Predict over `dt` seconds with one reading, held over the step, w = gyro - b.

        v' = v + (R(q * Exp(w dt/2)) f + g) dt        q' = q * Exp(w dt)        b' = b

        F = [I  -R [f]x dt     R [f]x dt^2/2]          P' = F P F^T + Q dt
            [0   Exp(-w dt)   -I dt         ]
            [0   0             I            ]

    Q is the spectral density of the noise; to that of the gyroscope comes (scale w_i)^2 on each axis, for a
    scale that is not quite right. With dt = 0, as at the first firing, this is the identity.

    Args:
        scale: s^(1/2), how fast an error of the scale adds up: relative error times the root of the time in
            which a turn goes one way.
        gravity: m/s^2.
    """
    kind = belief.attitude.dtype
    rate = imu.gyro - belief.gyro_bias
    half = from_rotation_vector(rate * (0.5 * dt), xp=xp)
    middle = multiply(belief.attitude, half, xp=xp)
    R = to_matrix(middle, xp=xp)
    back = to_matrix(half, xp=xp).mT
    down = xp.asarray(np.array([0.0, 0.0, -gravity]), dtype=kind)
    acceleration = (R @ imu.specific_force[..., None])[..., 0] + down
    pull = R @ skew(imu.specific_force * -dt, xp=xp)
    one = xp.eye(3, dtype=kind) + 0.0 * R
    none = 0.0 * R
    F = xp.concat(
        [
            xp.concat([one, pull @ back, pull * (-0.5 * dt)], axis=-1),
            xp.concat([none, back @ back, back * -dt], axis=-1),
            xp.concat([none, none, one], axis=-1),
        ],
        axis=-2,
    )
    wrong = (rate * scale) ** 2
    spread = xp.concat([0.0 * wrong, wrong, 0.0 * wrong], axis=-1)
    Q = (xp.asarray(_noise(noise), dtype=kind) + xp.asarray(_ONE, dtype=kind) * spread[..., None, :]) * dt
    P = F @ belief.covariance @ F.mT + Q
    return LevelBelief(
        velocity=belief.velocity + acceleration * dt,
        attitude=normalize(multiply(middle, half, xp=xp), xp=xp),
        gyro_bias=belief.gyro_bias,
        covariance=0.5 * (P + P.mT),
    )


LEVEL = StateSpace(euclidean(3), quaternion(), euclidean(3))
"""Velocity, attitude and gyroscope bias, as `LevelBelief` has them."""

_H = np.hstack([np.vstack([np.eye(3), np.zeros((3, 3))]), np.zeros((6, 3)), np.eye(6, 3, -3)])


@block
def hold_velocity(
    prior: LevelBelief,
    imu: Imu,
    rest: Rest,
    *,
    noise: ImuNoise,
    speed: float,
    speed_memory: float,
    rest_speed: float = 0.005,
    dt: float,
    xp: Any,
) -> LevelBelief:
    """Correct with what is known without a sensor: the velocity is about zero; and at rest the rate is, too.

        0 = v + e           e of standard deviation `speed`, over `speed_memory` seconds the same
        gyro = b + e        only at rest

    A disturbance that lasts as long as its memory has the density 2 speed^2 memory, which per tick is a
    variance of density / dt. H = [I 0 0; 0 0 I], by `correct`, with the reset of the attitude error.

    Args:
        speed: m/s, how fast the body usually moves. speed_memory: s, for how long.
        rest_speed: m/s, how sure the velocity is zero at rest.
    """
    kind = prior.attitude.dtype
    step = xp.maximum(xp.asarray(dt, dtype=kind) + 0.0 * rest.still, 1e-6)
    moving = 2.0 * speed**2 * speed_memory / step
    resting = 2.0 * rest_speed**2 * speed_memory / step
    still = rest.still
    three = xp.ones((3,), dtype=kind)
    variances = xp.concat(
        [three * (moving + (resting - moving) * still), three * (noise.gyro**2 / step)], axis=-1
    )
    present = xp.concat([three > 0.0, three * still > 0.5], axis=-1)
    found = correct(
        prior.covariance,
        xp.concat([-prior.velocity, (imu.gyro - prior.gyro_bias) * still], axis=-1),
        xp.asarray(_H, dtype=kind),
        xp.eye(6, dtype=kind) * variances,
        present=present,
        space=LEVEL,
        xp=xp,
    )
    state = xp.concat([prior.velocity, prior.attitude, prior.gyro_bias], axis=-1)
    moved = LEVEL.plus(state, found.shift, xp)
    return LevelBelief(
        velocity=moved[..., 0:3],
        attitude=moved[..., 3:7],
        gyro_bias=moved[..., 7:10],
        covariance=found.covariance,
    )
