"""Jacobians by hand of what is no belief of one Gaussian: the particles of `rbpf_outdoor`, with a Gaussian at
each, and the covariances that complementary filters compute beside their fixed gains."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from flowgraph import Array, jacobian
from flowgraph.blocks.geometry.manifold import Part, Quaternion, StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    between_vectors,
    conjugate,
    from_rotation_vector,
    multiply,
    normalize,
    rotate,
    to_matrix,
    to_rotation_vector,
)
from flowgraph.blocks.geometry.tangent import linearised
from flowgraph.blocks.inertial.imu import ImuNoise
from flowgraph.blocks.orientation.fixed_gain import (
    AttitudeNoise,
    PoseNoise,
    attitude_spread,
    motion_noise,
    pose_spread,
)
from flowgraph.blocks.outdoor.cloud import predict_outdoor
from flowgraph.blocks.outdoor.corrections import (
    correct_distance,
    correct_field,
    correct_flow,
    correct_position,
)
from flowgraph.blocks.signals import (
    Attitude,
    Gaussian,
    MagneticField,
    OpticalFlow,
    OutdoorCloud,
    PoseEstimate,
    Position,
    Range,
    SpecificForce,
)
from flowgraph.graphs.benches.jacobian_inertial import moved_inertially
from flowgraph.graphs.benches.jacobian_pairs import (
    LEVER,
    NOISE,
    SIGMA,
    Pair,
    Step,
    corrected,
    imu_of,
    imu_reading,
    predicted,
    state,
    vector,
)

__all__ = ["CLOUD_PAIRS"]


class _World(Quaternion):
    """An attitude whose error is a rotation vector in the world: Exp(e) q."""

    directions, errors = Part.directions, Part.errors

    def plus(self, x: Array, d: Array, xp: Any) -> Array:
        return normalize(multiply(from_rotation_vector(d, xp=xp), x, xp=xp), xp=xp)

    def minus(self, a: Array, b: Array, xp: Any) -> Array:
        return to_rotation_vector(multiply(a, conjugate(b, xp=xp), xp=xp), xp=xp)


PARTICLE = StateSpace(euclidean(9), _World(4, 3))
"""Velocity, position, displacement since the last picture, attitude; the picture stands in the reading."""


PUSHED = ImuNoise(0.0, NOISE.accelerometer, 0.0, 0.0)
"""What of the noise does not turn the body."""


def _aloft(rng: np.random.Generator) -> np.ndarray:
    """A body that leans by less than half a radian, above the ground."""
    x = state(rng, PARTICLE)
    x[5] = 5.0
    x[9:] = from_rotation_vector(np.append(0.3 * rng.normal(size=2), 0.5).clip(-0.5, 0.5), xp=np)
    return x


def _particle(x: Array, P: Array, picture: Array, xp: Any) -> OutdoorCloud:
    """A cloud of one."""
    return OutdoorCloud(
        log_weight=0.0 * x[..., :1], attitude=x[9:, None], picture=picture[:, None], motion=x[:9, None],
        covariance=P[:, :, None],
    )  # fmt: skip


def _only(cloud: OutdoorCloud, xp: Any) -> Gaussian:
    mean = xp.concat([cloud.motion[:, 0], cloud.attitude[:, 0]], axis=-1)
    return Gaussian(mean=mean, covariance=cloud.covariance[:, :, 0])


def _carried(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    cloud = _particle(x, P, x[9:], xp)
    return _only(predict_outdoor.step(cloud, imu_of(z), noise=NOISE, dt=dt, xp=xp), xp)


def _carried_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        v, p, moved, q = s[..., 0:3], s[..., 3:6], s[..., 6:9], s[..., 9:]
        none = xp.zeros((6,), dtype=x.dtype)
        after = moved_inertially(xp.concat([p, v, q, none], axis=-1), imu_of(z), dt, xp)
        return xp.concat(
            [after[..., 3:6], after[..., :3], moved + after[..., :3] - p, after[..., 6:10]], axis=-1
        )

    y, F = linearised(move, x, PARTICLE, xp, seen=PARTICLE)
    still = _particle(x, 0.0 * P, x[9:], xp)  # of noise alone
    Q = _only(predict_outdoor.step(still, imu_of(z), noise=PUSHED, dt=dt, xp=xp), xp).covariance
    turn = xp.asarray(np.diag([0.0] * 9 + [0.5 * NOISE.gyro**2] * 3), dtype=x.dtype) * dt
    return predicted(y, F, P, turn, turn + Q)


def _weighed(block: Any, read: Callable[[Array], Any], **settings: Any) -> Step:
    """The correction of a particle by its block. The last four numbers of a reading are the last picture."""

    def step(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
        none = xp.asarray(0.0, dtype=x.dtype)
        cloud = _particle(x, P, z[..., -4:], xp)
        return _only(block.step(none, cloud, read(z), **settings, xp=xp)[1][0], xp)

    return step


def _with_picture(n: int) -> Callable[[np.random.Generator], np.ndarray]:
    return lambda rng: np.concatenate([rng.normal(size=n), state(rng, StateSpace(quaternion()))])


def _flow_reading(rng: np.random.Generator) -> np.ndarray:
    return np.concatenate([rng.normal(size=3), *(state(rng, StateSpace(quaternion())) for _ in range(2))])


EARTH = (2e-5, 1e-6, -4e-5)
_three = lambda z, xp: z[..., :3]
_R3 = lambda z: SIGMA**2 * np.eye(3)


def _distance(x: Array, z: Array, xp: Any) -> Array:
    return x[..., 5:6] / to_matrix(x[..., 9:], xp=xp)[..., 2, 2:3]


def _turn_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    """Optical flow: first the displacement, then the turn, as the block has it."""
    there = lambda z, xp: rotate(z[..., 7:], z[..., :3], xp=xp)
    place = corrected(PARTICLE, lambda x, z, xp: x[..., 6:9], there, _R3, reset=False)
    first = place(x, P, z, dt, xp)
    q = multiply(z[..., 7:], z[..., 3:7], xp=xp)
    turn = corrected(
        PARTICLE, lambda x, z, xp: x[..., 9:], lambda z, xp: q, _R3, StateSpace(_World(4, 3)), reset=False
    )
    return turn(first.mean, first.covariance, z, dt, xp)


# The covariances beside fixed gains: the mean is the estimate, and the reading what led to it.

TURN = StateSpace(quaternion())
ALPHA = 0.5
_SPREAD = AttitudeNoise(gyro=0.01, force=(0.3, 0.2, 0.4), start=0.1)


def _upright(rng: np.random.Generator) -> np.ndarray:
    return state(rng, TURN)


def _kept(heading: str) -> tuple[Step, Step]:
    """The covariance of an attitude that a direction corrects. The error is in the body, P in the world."""

    def by_hand(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
        force = _force(x, z, heading, xp)
        settings: dict[str, Any] = {"alpha": ALPHA, "noise": _SPREAD, "heading": heading, "dt": dt, "xp": xp}
        _, found = attitude_spread.step(P, Attitude(x), SpecificForce(force), **settings)
        return Gaussian(mean=x, covariance=found.covariance)

    def derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
        force, R = _force(x, z, heading, xp), to_matrix(x, xp=xp)
        up = xp.asarray([0.0, 0.0, 1.0], dtype=x.dtype)
        if heading == "gyroscope":  # how far the force is from up, about the world's axes
            keep = xp.asarray(np.diag([ALPHA, ALPHA, 1.0]), dtype=x.dtype)
            aside = lambda f, xp: xp.linalg.cross(0.0 * f + up, rotate(x, f, xp=xp)) / _size(f, xp)
        else:
            keep = ALPHA * xp.eye(3, dtype=x.dtype)
            back = conjugate(between_vectors(force, up, xp=xp), xp=xp)
            arc = lambda f, xp: multiply(between_vectors(f, 0.0 * f + up, xp=xp), back, xp=xp)
            aside = lambda f, xp: to_rotation_vector(arc(f, xp), xp=xp)
        J = jacobian(aside, force, xp)[1] * xp.asarray(_SPREAD.force, dtype=x.dtype) * (1.0 - ALPHA)
        P = keep @ (P + _SPREAD.gyro**2 * dt * xp.eye(3, dtype=x.dtype)) @ keep + J @ J.mT
        P = R.mT @ P @ R
        return Gaussian(mean=x, covariance=0.5 * (P + P.mT))

    return by_hand, derived


def _size(f: Array, xp: Any) -> Array:
    return xp.sqrt(xp.linalg.vecdot(f, f))[..., None]


def _force(x: Array, z: Array, heading: str, xp: Any) -> Array:
    """Of a body that does not accelerate, where it is the vertical that is told from it."""
    if heading != "gyroscope":
        return z + xp.asarray([0.0, 0.0, 9.81], dtype=x.dtype)
    return rotate(conjugate(x, xp=xp), xp.asarray([0.0, 0.0, 9.81], dtype=x.dtype), xp=xp)


AUGMENTED = StateSpace(euclidean(6), quaternion(), euclidean(3))
_POSE_NOISE = PoseNoise(NOISE, SIGMA, SIGMA, (1.0, 1.0, 1.0))


def _spread(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    at = PoseEstimate(position=x[..., 0:3], velocity=x[..., 3:6], attitude=x[..., 6:10])
    zero = xp.asarray(0.0, dtype=x.dtype)
    before = {"covariance": P, "since": zero, "seen": zero}
    kept, _ = pose_spread.step(
        before, at, imu_of(z), at, None, alpha=0.5, velocity_alpha=0.5, attitude_alpha=0.5,
        noise=_POSE_NOISE, dt=dt, xp=xp,
    )  # fmt: skip
    return Gaussian(mean=x, covariance=kept["covariance"])


def _spread_derived(x: Array, P: Array, z: Array, dt: Any, xp: Any) -> Gaussian:
    def move(s: Array, xp: Any) -> Array:
        none = xp.zeros((6,), dtype=x.dtype)
        after = moved_inertially(xp.concat([s[..., :10], none], axis=-1), imu_of(z), dt, xp)
        return xp.concat([after[..., :10], s[..., 10:]], axis=-1)

    _, F = linearised(move, x, AUGMENTED, xp, seen=AUGMENTED)
    Q = motion_noise(NOISE, xp.eye(3, dtype=x.dtype), dt, xp)
    return predicted(x, F, P, 0.0, Q)


CLOUD_PAIRS: dict[str, Pair] = {
    "predict_outdoor": Pair(
        ("rbpf_outdoor",), PARTICLE, imu_reading, _carried, _carried_derived
    ),
    "correct_position": Pair(
        ("rbpf_outdoor",), PARTICLE, _with_picture(3),
        _weighed(correct_position, lambda z: Position(z[..., :3]), noise=SIGMA, lever=LEVER),
        corrected(
            PARTICLE,
            lambda x, z, xp: x[..., 3:6] + rotate(x[..., 9:], xp.asarray(LEVER, dtype=x.dtype), xp=xp),
            _three, _R3, reset=False,
        ),
    ),
    "correct_distance": Pair(
        ("rbpf_outdoor",), PARTICLE, _with_picture(1),
        _weighed(correct_distance, lambda z: Range(z[..., 0]), noise=SIGMA),
        corrected(
            PARTICLE, _distance, lambda z, xp: z[..., :1], lambda z: SIGMA**2 * np.eye(1), reset=False
        ),
        start=_aloft,
    ),
    "correct_field": Pair(
        ("rbpf_outdoor",), PARTICLE, _with_picture(3),
        _weighed(correct_field, lambda z: MagneticField(2e-5 * z[..., :3]), earth=EARTH, noise=2e-5 * SIGMA),
        corrected(
            PARTICLE,
            lambda x, z, xp: rotate(
                conjugate(x[..., 9:], xp=xp), xp.asarray(EARTH, dtype=x.dtype) / 2e-5, xp=xp
            ),
            _three, _R3, reset=False,
        ),
    ),
    "correct_flow": Pair(
        ("rbpf_outdoor",), PARTICLE, _flow_reading,
        _weighed(
            correct_flow,
            lambda z: OpticalFlow(
                displacement=z[..., :3], turn=z[..., 3:7], interval=1.0 + 0.0 * z[..., 0]
            ),
            displacement=SIGMA, turn=SIGMA,
        ),
        _turn_derived,
    ),
    "attitude_spread": Pair(
        ("complementary", "roll_pitch"), TURN, vector(3), *_kept("gyroscope"), start=_upright
    ),
    "attitude_spread, shortest_arc": Pair(
        ("orientation_complementary",), TURN, vector(3), *_kept("shortest_arc"), start=_upright
    ),
    "pose_spread": Pair(
        ("augmented_complementary",), AUGMENTED, imu_reading, _spread, _spread_derived, bound=1e-3
    ),
}  # fmt: skip
