"""Jacobians by hand of what an IMU carries with its biases: those of `ins_eskf`, `gnss_ins` and `marg`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array
from flowgraph.blocks.geometry.manifold import StateSpace, quaternion
from flowgraph.blocks.geometry.rotations import (
    rotate,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.aiding import aid_attitude, aid_position
from flowgraph.blocks.inertial.imu import GRAVITY, predict
from flowgraph.blocks.inertial.navigation import predict_navigation
from flowgraph.blocks.inertial.outdoors import (
    aid_height,
)
from flowgraph.blocks.models.inertial_pose import INERTIAL_BIASED, inertial_motion
from flowgraph.blocks.models.navigation import navigation_space
from flowgraph.blocks.orientation.marg import LEVEL, hold_velocity, predict_level
from flowgraph.blocks.signals import (
    Attitude,
    Belief,
    Gaussian,
    Height,
    Imu,
    LevelBelief,
    NavigationBelief,
    Position,
    Rest,
)
from flowgraph.graphs.benches.jacobian_pairs import (
    DT,
    LEVER,
    NOISE,
    SIGMA,
    Pair,
    Step,
    corrected,
    gaussian,
    imu_of,
    imu_reading,
    pose_reading,
    predicted,
    state,
    vector,
)

__all__ = ["INERTIAL_PAIRS", "moved_inertially"]

# Inertial beliefs: position, velocity, attitude, biases, and what else is estimated.

ESTIMATED = ("lever", "gyro_scale", "accelerometer_scale", "time_offset", "height_offset")
NAVIGATION = navigation_space(ESTIMATED)


def belief(x: Array, P: Array) -> Any:
    parts = (x[..., 0:3], x[..., 3:6], x[..., 6:10], x[..., 10:13], x[..., 13:16])
    return NavigationBelief(*parts, x[..., 16:], P) if x.shape[-1] > 16 else Belief(*parts, P)


_MOTION = inertial_motion(NOISE, space=INERTIAL_BIASED)


def moved_inertially(x: Array, imu: Imu, dt: Any, xp: Any) -> Array:
    """The step of `predict` and of `predict_navigation` over a flat Earth, of any number of parameters."""
    rate, force = imu.gyro, imu.specific_force
    if x.shape[-1] > 16:  # the scale factors
        rate = rate - (rate - x[..., 10:13]) * x[..., 19:22]
        force = force - (force - x[..., 13:16]) * x[..., 22:25]
    row = lambda a: a[..., None, :]
    imu = Imu(gyro=rate, specific_force=force)
    after = _MOTION.carry(row(x[..., :16]), imu, xp.zeros((1, 12), dtype=x.dtype), dt, xp)[..., 0, :]
    return xp.concat([after, x[..., 16:]], axis=-1)


def predicted_inertially(walks: np.ndarray, space: StateSpace) -> Step:
    def step(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
        y, F = linearised(lambda s, xp: moved_inertially(s, imu_of(z), dt, xp), x, space, xp, seen=space)
        Q = xp.asarray(np.diag([*NOISE.power(), *walks]), dtype=x.dtype) * (0.5 * dt)
        return predicted(y, F, P, Q, Q)

    return step


def _nearly_true(space: StateSpace) -> Callable[[np.random.Generator], np.ndarray]:
    """Any state, but biases of 0.1 and scale factors of a percent."""

    def start(rng: np.random.Generator) -> np.ndarray:
        x = state(rng, space)
        x[7 if space is LEVEL else 10 : 16] *= 0.1
        x[19:25] *= 0.01
        return x

    return start


def _aided(aid: Callable[..., Any]) -> Step:
    return lambda x, P, z, dt, xp: gaussian(aid(belief(x, P), z, xp), xp)


three = lambda z, xp: z[..., :3]
_R3 = lambda z: SIGMA**2 * np.eye(3)
_R1 = lambda z: SIGMA**2 * np.eye(1)


# An attitude and its velocity: `marg`.


def level(x: Array, P: Array) -> LevelBelief:
    return LevelBelief(velocity=x[..., 0:3], attitude=x[..., 3:7], gyro_bias=x[..., 7:10], covariance=P)


def _level_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        none = xp.zeros((3,), dtype=x.dtype)
        after = moved_inertially(xp.concat([none, s, none], axis=-1), imu_of(z), dt, xp)
        return after[..., 3:13]

    y, F = linearised(move, x, LEVEL, xp, seen=LEVEL)
    densities = np.repeat([NOISE.accelerometer, NOISE.gyro, NOISE.gyro_bias], 3)
    return predicted(y, F, P, 0.0, xp.asarray(np.diag(densities**2), dtype=x.dtype) * dt)


def _held_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    """A velocity and, as the body rests, a rate of zero."""
    h = lambda s, z, xp: xp.concat([s[..., 0:3], s[..., 7:10]], axis=-1)
    target = lambda z, xp: xp.concat([0.0 * z[..., :3], z[..., :3]], axis=-1)
    variances = np.repeat([2.0 * 0.005**2 * 0.3 / DT, NOISE.gyro**2 / DT], 3)
    return corrected(LEVEL, h, target, lambda z: np.diag(variances))(x, P, z, dt, xp)


def _held(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    found = hold_velocity.step(
        level(x, P), imu_of(z), Rest(still=1.0 + 0.0 * z[..., 0]), noise=NOISE, speed=0.6, speed_memory=0.3,
        dt=DT, xp=xp,
    )  # fmt: skip
    return gaussian(found, xp)


def _attitude(x: Array, z: Array, xp: Any) -> Array:
    return x[..., 6:10]


INERTIAL_PAIRS: dict[str, Pair] = {
    "predict": Pair(
        ("ins_eskf",), INERTIAL_BIASED, imu_reading,
        lambda x, P, z, dt, xp: gaussian(
            predict.step(belief(x, P), imu_of(z), noise=NOISE, dt=dt, xp=xp), xp
        ),
        predicted_inertially(np.zeros(0), INERTIAL_BIASED), bound=1e-6, start=_nearly_true(INERTIAL_BIASED),
    ),
    "predict_navigation": Pair(
        ("gnss_ins",), NAVIGATION, imu_reading,
        lambda x, P, z, dt, xp: gaussian(
            predict_navigation.step(
                belief(x, P), imu_of(z), noise=NOISE, gravity=GRAVITY, estimated=ESTIMATED, dt=dt, xp=xp
            ), xp,
        ),
        predicted_inertially(np.array([0.0] * 10 + [0.05**2]), NAVIGATION),
        bound=1e-6, start=_nearly_true(NAVIGATION),
    ),
    "aid_position": Pair(
        ("ins_eskf", "ins_particle"), INERTIAL_BIASED, vector(3),
        _aided(lambda b, z, xp: aid_position.step(b, Position(z), noise=SIGMA, lever=LEVER, xp=xp)[0]),
        corrected(
            INERTIAL_BIASED,
            lambda x, z, xp: x[..., :3] + rotate(x[..., 6:10], xp.asarray(LEVER, dtype=x.dtype), xp=xp),
            three, _R3,
        ),
    ),
    "aid_attitude": Pair(
        ("ins_eskf",), INERTIAL_BIASED, lambda rng: pose_reading(rng)[3:],
        _aided(lambda b, z, xp: aid_attitude.step(b, Attitude(z), noise=SIGMA, xp=xp)[0]),
        corrected(INERTIAL_BIASED, _attitude, lambda z, xp: z, _R3, StateSpace(quaternion())),
    ),
    "aid_height": Pair(
        ("gnss_ins",), NAVIGATION, vector(1),
        _aided(lambda b, z, xp: aid_height.step(
            b, Height(z[..., 0]), noise=SIGMA, estimated=ESTIMATED, xp=xp
        )[0]),
        corrected(NAVIGATION, lambda x, z, xp: x[..., 2:3] + x[..., 26:27], lambda z, xp: z, _R1),
    ),
    "predict_level": Pair(
        ("marg",), LEVEL, imu_reading,
        lambda x, P, z, dt, xp: gaussian(
            predict_level.step(level(x, P), imu_of(z), noise=NOISE, gravity=-GRAVITY[2], dt=dt, xp=xp), xp
        ),
        _level_derived, bound=1e-6, start=_nearly_true(LEVEL),
    ),
    "hold_velocity": Pair(("marg",), LEVEL, imu_reading, _held, _held_derived),
}  # fmt: skip
