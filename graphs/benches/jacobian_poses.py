"""Jacobians by hand of poses without biases: `ekf`, `ins_ekf_pose`, `outdoor_eskf`, `attitude_mekf`."""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, jacobian
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean
from flowgraph.blocks.geometry.rotations import (
    from_rotation_vector,
    multiply,
    rotate,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.kalman.filters import correct
from flowgraph.blocks.models import euler_ins, pose
from flowgraph.blocks.orientation.commanded import TURN, predict_turn
from flowgraph.blocks.outdoor import belief as outdoor
from flowgraph.blocks.signals import (
    BodyRate,
    Gaussian,
    Pose,
    QuaternionBelief,
)
from flowgraph.graphs.benches.jacobian_inertial import moved_inertially
from flowgraph.graphs.benches.jacobian_pairs import (
    LEVER,
    NOISE,
    SIGMA,
    Pair,
    gaussian,
    imu_of,
    imu_reading,
    pose_reading,
    predicted,
    vector,
)

__all__ = ["POSE_PAIRS"]

# The pose of `ekf`, in ten numbers: (v, p, q), with the errors of each.

PLAIN = StateSpace(euclidean(10))


def _ten(rng: np.random.Generator) -> np.ndarray:
    q = rng.normal(size=4)
    return np.concatenate([rng.normal(size=6), q / np.linalg.norm(q)])


def _quaternion(x: Array, P: Array) -> QuaternionBelief:
    return QuaternionBelief(velocity=x[..., 0:3], position=x[..., 3:6], attitude=x[..., 6:10], covariance=P)


def _pose_by_hand(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    return gaussian(pose.predict_pose.step(_quaternion(x, P), imu_of(z), noise=NOISE, dt=dt, xp=xp), xp)


def _pose_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        v, p, q = s[..., 0:3], s[..., 3:6], s[..., 6:10]
        return xp.concat(pose.move(v, p, q, imu_of(z), dt, xp), axis=-1)

    y, F = jacobian(move, x, xp)
    P = F @ P @ F.mT + pose.motion_noise(y[..., 6:10], NOISE, dt, xp)
    return gaussian(pose.unit(y[..., 0:3], y[..., 3:6], y[..., 6:10], P, xp), xp)


def _captured(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    measured = Pose(position=z[..., :3], attitude=z[..., 3:7])
    found, _ = pose.update_pose.step(
        _quaternion(x, P), measured, position_noise=SIGMA, attitude_noise=SIGMA, lever=LEVER, xp=xp
    )
    return gaussian(found, xp)


def _captured_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def see(s: Array, xp: Any) -> Array:
        place = s[..., 3:6] + rotate(s[..., 6:10], xp.asarray(LEVER, dtype=x.dtype), xp=xp)
        return xp.concat([place, s[..., 6:10]], axis=-1)

    y, H = linearised(see, x, PLAIN, xp, seen=pose.POSE)
    R = xp.asarray(SIGMA**2 * np.eye(6), dtype=x.dtype)
    found = correct(P, pose.POSE.minus(z[..., :7], y, xp), H, R, xp=xp)
    m = x + found.shift
    return gaussian(pose.unit(m[..., 0:3], m[..., 3:6], m[..., 6:10], found.covariance, xp), xp)


# The Euler angles of `ins_ekf_pose`.

ORDER = "zxy"


def _angles(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([rng.normal(size=3), rng.uniform(-1.0, 1.0, 3), 0.1 * rng.normal(size=9)])


def _euler(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    given = Gaussian(mean=x, covariance=P)
    return euler_ins.predict_extended.step(given, imu_of(z), order=ORDER, noise=NOISE, dt=dt, xp=xp)


def _euler_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        state, noise = s[..., :15], s[..., 15:]
        turn, push = euler_ins.increments(state, imu_of(z), dt)
        turn, push = turn + noise[..., :3], push + noise[..., 3:6]
        after = euler_ins.move(state, turn, push, dt, order=ORDER, xp=xp)
        return xp.concat([after[..., :9], after[..., 9:] + noise[..., 6:]], axis=-1)

    y, both = linearised(move, x, euler_ins.STATE, xp, seen=euler_ins.STATE, more=12)
    F, L = both[..., :15], both[..., 15:]
    Q = xp.asarray(euler_ins.increment_variances(NOISE), dtype=x.dtype) * dt
    mean = euler_ins.STATE.plus(y, xp.zeros((15,), dtype=x.dtype), xp)
    return predicted(mean, F, P, 0.0, (L * Q) @ L.mT)


# The clones of `outdoor_eskf`.


def _clone(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    given = Gaussian(mean=x, covariance=P)
    return outdoor.predict_clone.step(given, imu_of(z), noise=NOISE, dt=dt, xp=xp)


def _clone_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        none = xp.zeros((6,), dtype=x.dtype)
        after = moved_inertially(xp.concat([s[..., :10], none], axis=-1), imu_of(z), dt, xp)
        return xp.concat([after[..., :10], s[..., 10:]], axis=-1)

    y, F = linearised(move, x, outdoor.OUTDOOR, xp, seen=outdoor.OUTDOOR)
    power = np.repeat([0.0, NOISE.accelerometer**2, NOISE.gyro**2, 0.0, 0.0], 3)
    Q = xp.asarray(np.diag(power), dtype=x.dtype) * (0.5 * dt)
    return predicted(y, F, P, Q, Q)


# The commanded attitude of `attitude_mekf`.


def _turned_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    move = lambda s, xp: multiply(s, from_rotation_vector(z * dt, xp=xp), xp=xp)
    y, F = linearised(move, x, TURN, xp, seen=TURN)
    mean = TURN.plus(y, xp.zeros((3,), dtype=x.dtype), xp)
    return predicted(mean, F, P, 0.0, xp.eye(3, dtype=x.dtype) * (0.01**2 * dt))


POSE_PAIRS: dict[str, Pair] = {
    "predict_pose": Pair(("ekf",), PLAIN, imu_reading, _pose_by_hand, _pose_derived, start=_ten),
    "update_pose": Pair(("ekf",), PLAIN, pose_reading, _captured, _captured_derived, start=_ten),
    "predict_extended": Pair(
        ("ins_ekf_pose",), euler_ins.STATE, imu_reading, _euler, _euler_derived, start=_angles
    ),
    "predict_clone": Pair(("outdoor_eskf",), outdoor.OUTDOOR, imu_reading, _clone, _clone_derived),
    "predict_turn": Pair(
        ("attitude_mekf",), TURN, vector(3),
        lambda x, P, z, dt, xp: predict_turn.step(
            Gaussian(mean=x, covariance=P), BodyRate(z), noise=0.01, dt=dt, xp=xp
        ),
        _turned_derived,
    ),
}  # fmt: skip
