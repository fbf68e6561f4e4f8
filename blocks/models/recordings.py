"""What filters with controls were given, as a batch estimate takes it: motion, measurements, all readings.

The motion and its noise are those of the filters' own prediction; a measurement is seen as they see it. But a
filter drives its step with the readings that it has by then, and a batch has them all: it takes a reading of
an instant to go over to the next on a straight line, and the step is driven by the mean of its two ends.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.filtering.batch import Aged, Derived, Moves, Recording
from flowgraph.blocks.geometry.euler import (
    angles_from_quaternion,
    body_rate_matrix,
    matrix_from_angles,
    quaternion_from_angles,
)
from flowgraph.blocks.geometry.manifold import StateSpace, quaternion
from flowgraph.blocks.geometry.rotations import rotate
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise, error_jacobian, predict
from flowgraph.blocks.kalman.lost import Held
from flowgraph.blocks.kalman.matrices import noise_matrix
from flowgraph.blocks.models import euler_ins
from flowgraph.blocks.models.inertial_pose import INERTIAL, INERTIAL_BIASED, pose_seen
from flowgraph.blocks.models.point import point_model
from flowgraph.blocks.models.pose import POSE
from flowgraph.blocks.signals import Belief, CameraVelocity, Gaussian, Imu
from flowgraph.blocks.statespace import LinearMeasurement, Measurement, MeasurementModel
from flowgraph.blocks.vision.camera import Mount
from flowgraph.blocks.vision.motion import camera_velocity
from flowgraph.types import unflatten

__all__ = [
    "recorded",
    "EulerPoseSeen",
    "drive_at",
    "euler_moves",
    "euler_recording",
    "inertial_moves",
    "inertial_recording",
    "place_seen",
    "point_recording",
    "pose_recording",
    "turn_seen",
    "velocity_recording",
]


def drive_at(time: np.ndarray, controls: Series, reading: str) -> Series:
    """What drives the step to each of these times (n,) int64 ns, of a unit whose readings are all known.

    Args:
        controls: the readings, of vectors; one with a NaN is left out.
        reading: "instant", and the step is driven by the mean of what the unit would read at its two ends; or
            "mean", of the step since the reading before, and it drives all of that.
    """
    leaves = list(controls.leaves.values())
    good = np.all([np.isfinite(a).all(axis=-1) for a in leaves], axis=0)
    stamps = controls.time[good]
    if reading == "mean":
        after = np.minimum(np.searchsorted(stamps, time), len(stamps) - 1)
        found = [a[good][after] for a in leaves]
    else:
        since = (time - stamps[0]).astype(float)
        own = (stamps - stamps[0]).astype(float)
        ends = [np.stack([np.interp(since, own, column) for column in a[good].T], axis=-1) for a in leaves]
        found = [np.concatenate([a[:1], 0.5 * (a[1:] + a[:-1])]) for a in ends]
    return Series(time, unflatten(controls.type, iter(found)), name="control")


def inertial_moves(
    noise: ImuNoise, gravity: tuple[float, float, float] = GRAVITY, *, biased: bool = True
) -> Derived:
    """`inertial.predict` as a motion: its step, its Jacobian and its noise.

    Args:
        noise: of the unit.
        gravity: m/s^2, world.
        biased: over `INERTIAL_BIASED`; else over `INERTIAL`, without biases.
    """
    space = INERTIAL_BIASED if biased else INERTIAL
    t = space.tangent

    def linearised(x: Array, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        exactly = xp.zeros((15, 15), dtype=x.dtype)
        biases = (x[..., 10:13], x[..., 13:]) if biased else (xp.zeros((3,), dtype=x.dtype),) * 2
        belief = Belief(x[..., :3], x[..., 3:6], x[..., 6:10], *biases, exactly)
        after = predict.step(belief, imu, noise=noise, gravity=gravity, dt=dt, xp=xp)
        F = error_jacobian(belief, imu, dt, xp)
        mean = xp.concat([getattr(after, part) for part in space.names], axis=-1)
        return mean, F[..., :t, :t], after.covariance[..., :t, :t]  # which, of what was exact, is Q

    return Derived(space, linearised)


def euler_moves(order: str, noise: ImuNoise, gravity: tuple[float, float, float] = GRAVITY) -> Derived:
    """`euler_ins.predict_extended` as a motion over `euler_ins.STATE`."""

    def linearised(x: Array, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array]:
        exactly = Gaussian(mean=x, covariance=xp.zeros((15, 15), dtype=x.dtype))
        after = euler_ins.predict_extended.step(
            exactly, imu, order=order, noise=noise, gravity=gravity, dt=dt, xp=xp
        )
        turn, push = euler_ins.increments(x, imu, dt)
        F, _ = euler_ins.move_jacobians(x, turn, push, dt, order=order, xp=xp)
        return after.mean, F, after.covariance

    return Derived(euler_ins.STATE, linearised)


def place_seen(noise: float, lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> MeasurementModel:
    """The position of a point of the body, as a measurement over `INERTIAL_BIASED`.

    Args:
        noise: standard deviation on each axis, m.
        lever: the point, m, body.
    """

    def observe(x: Any, xp: Any) -> Array:
        return x.position + rotate(x.attitude, xp.asarray(lever, dtype=x.position.dtype), xp=xp)

    return MeasurementModel(INERTIAL_BIASED, observe, noise=np.repeat(noise**2, 3))


def turn_seen(noise: float) -> MeasurementModel:
    """The attitude, as a measurement over `INERTIAL_BIASED`.

    Args:
        noise: standard deviation about each axis, rad.
    """
    return MeasurementModel(
        INERTIAL_BIASED,
        lambda x, xp: x.attitude,
        noise=np.repeat(noise**2, 3),
        measured_space=StateSpace(quaternion()),
    )


@dataclass(frozen=True, eq=False)
class EulerPoseSeen(MeasurementModel):
    """A measured pose over `euler_ins.STATE`, as `update_pose_angles` takes it: of a point of the body, with
    noise of its angles and of its own covariance; the residual of the attitude is a rotation vector."""

    order: str = "zxy"
    factor: float = 1.0

    def covariance(self, message: Any, m: int, kind: Any, xp: Any) -> Array:
        R = noise_matrix(self.noise, 6, "R", kind=kind, xp=xp)
        e = angles_from_quaternion(message.attitude, order=self.order, xp=xp)
        G = body_rate_matrix(e, order=self.order, xp=xp)
        one, none = xp.eye(3, dtype=kind), xp.zeros((3, 3), dtype=kind)
        T = xp.concat([xp.concat([one, none], axis=-1), xp.concat([none, G], axis=-1)], axis=-2)
        return T @ R @ T.mT + self.factor * message.covariance


def inertial_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, reading: str, noise: ImuNoise, position_noise: float,
    attitude_noise: float = 0.01, lever: tuple[float, float, float] = (0.0, 0.0, 0.0),
    gravity: tuple[float, float, float] = GRAVITY, held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `ins_eskf` is given: `imu`, `position` and perhaps `attitude`."""
    seen: dict[Measurement, Series] = {place_seen(position_noise, lever): inputs["position"]}
    if "attitude" in inputs:
        seen[turn_seen(attitude_noise)] = inputs["attitude"]
    moves = inertial_moves(noise, gravity)
    return recorded(moves, seen, start, inputs["imu"], reading, held, position=0, velocity=3, attitude=6)


def pose_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, reading: str, noise: ImuNoise, position_noise: float,
    attitude_noise: float, lever: tuple[float, float, float], gravity: tuple[float, float, float],
    held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `ekf` and `ukf` are given: `imu` and `vicon`; over `INERTIAL`."""
    seen = {pose_seen(position_noise, attitude_noise, lever=lever): inputs["vicon"]}
    moves = inertial_moves(noise, gravity, biased=False)
    return recorded(moves, seen, start, inputs["imu"], reading, held, position=0, velocity=3, attitude=6)


def euler_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, order: str, reading: str, noise: ImuNoise, R: Any,
    lever: tuple[float, float, float], gravity: tuple[float, float, float], held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `ins_ekf_pose` and `ins_ukf_pose` are given: `imu` and `pose`; over `euler_ins.STATE`."""

    def observe(x: Array, xp: Any) -> Array:
        place = euler_ins.seen_place(x, lever, order=order, xp=xp)
        return xp.concat([place, quaternion_from_angles(x[..., 3:6], order=order, xp=xp)], axis=-1)

    read = lambda pose: (pose.position, pose.attitude)
    seen = EulerPoseSeen(euler_ins.STATE, observe, R, POSE, read, order=order)
    moves = euler_moves(order, noise, gravity)
    return recorded(
        moves, {seen: inputs["pose"]}, start, inputs["imu"], reading, held, position=0, velocity=6, attitude=3
    )


def velocity_recording(
    inputs: Mapping[str, Series], *, start: Gaussian, order: str, reading: str, noise: ImuNoise,
    mount: Mount, velocity_noise: float, rate_noise: float, rate: str,
    gravity: tuple[float, float, float], held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `ins_ukf_velocity` is given: `imu` and `motion`; over `euler_ins.STATE`. The gyroscope's rate at a
    picture is on the straight line between its readings."""
    imu, motion = inputs["imu"], inputs["motion"]
    if rate == "gyro":
        good = np.isfinite(imu["gyro"]).all(axis=-1)
        since = lambda time: (time - imu.time[0]).astype(float)
        gyro = imu["gyro"][good].T
        body = np.stack([np.interp(since(motion.time), since(imu.time[good]), one) for one in gyro], axis=-1)
    else:
        body = motion["rate"] @ np.asarray(mount.rotation)

    def observe(x: Array, v: Array, message: CameraVelocity, xp: Any) -> Array:
        R = matrix_from_angles(x[..., 3:6], order=order, xp=xp)
        bias = x[..., 9:12] if rate == "gyro" else 0.0 * x[..., 9:12]
        seen = camera_velocity(x[..., 6:9], R, message.rate - bias - v[..., 3:], mount=mount, xp=xp)
        return seen + v[..., :3]

    seen = MeasurementModel(
        euler_ins.STATE, observe, np.repeat(np.square([velocity_noise, rate_noise]), 3),
        read=lambda message: message.velocity,
    )  # fmt: skip
    told = motion.holding(CameraVelocity(velocity=motion["velocity"], rate=body))
    moves = euler_moves(order, noise, gravity)
    return recorded(moves, {seen: told}, start, imu, reading, held, position=0, velocity=6, attitude=3)


def point_recording(
    seen: Series, controls: Series, *, start: Gaussian, noise: float, position_noise: float, control: str,
    held: Held | None = None,
) -> Recording:  # fmt: skip
    """What `kalman` and `async_kalman` are given: positions, and `WorldAcceleration` as control."""
    moves = point_model(noise)
    place = LinearMeasurement(moves.space, np.eye(3, 6), position_noise**2, read=lambda z: z.position)
    return recorded(moves, {place: seen}, start, controls, control, held, position=0, velocity=3)


def recorded(
    moves: Moves, seen: Mapping[Any, Series], start: Gaussian, controls: Series, reading: str,
    held: Held | None, **places: int,
) -> Recording:  # fmt: skip
    """What a filter with controls was given; `places` are those of its state that age with a control."""
    drive: Callable[[np.ndarray], Series] = partial(drive_at, controls=controls, reading=reading)
    aged = None if held is None else Aged(controls, held, places)
    return Recording(moves, seen, start, drive, None if held is None else held.longest, aged)
