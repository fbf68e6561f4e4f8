"""The outdoor sensors in an error-state Kalman filter: one Gaussian over now and the last picture.

State x = (position, velocity, attitude, position at the last picture, attitude at the last picture): 17
numbers, on a space of 15 dimensions. The last two are clones, which optical flow is measured from. A sensor
is a function of the state; `update_extended` derives its Jacobian and does the rest. Attitude errors are
right (body) rotation vectors.

Sources: J. Solà, "Quaternion kinematics for the error-state Kalman filter", arXiv:1711.02508, 2017; clones:
S. I. Roumeliotis and J. W. Burdick, "Stochastic cloning: a generalized framework for processing relative
state measurements", ICRA 2002.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from flowgraph import Array, Result, Series, block
from flowgraph.blocks.geometry.manifold import StateSpace, euclidean, quaternion
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    from_rotation_vector,
    multiply,
    normalize,
    rotate,
    skew,
    to_matrix,
)  # fmt: skip
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.kalman.smoothing import Steps, steps_of
from flowgraph.blocks.outdoor.flight import OutdoorStart
from flowgraph.blocks.signals import Gaussian, Imu, OpticalFlow, PoseBelief

__all__ = [
    "FLOW",
    "FieldObserver",
    "OUTDOOR",
    "PositionObserver",
    "clone_crossing",
    "flow_vector",
    "new_picture",
    "observe_distance",
    "observe_flow",
    "outdoor_pose",
    "outdoor_steps",
    "picture_cross",
    "predict_clone",
    "start_outdoor",
]

OUTDOOR = StateSpace(euclidean(3), euclidean(3), quaternion(), euclidean(3), quaternion())
"""The state: position, velocity, attitude; position and attitude at the last picture."""

FLOW = StateSpace(euclidean(3), quaternion())
"""What optical flow measures: displacement (m) and turn."""

_CLONES = np.eye(15, 6, -9)  # they stay
_TAKEN = np.zeros((15, 15))  # a new picture: the errors of now become those of the clone
_TAKEN[:9, :9] = np.eye(9)
_TAKEN[9:12, :3] = np.eye(3)
_TAKEN[12:, 6:9] = np.eye(3)


def _parts(x: Array) -> tuple[Array, Array, Array, Array, Array]:
    return x[..., 0:3], x[..., 3:6], x[..., 6:10], x[..., 10:13], x[..., 13:17]


def _times(M: Array, v: Array) -> Array:
    return (M @ v[..., None])[..., 0]


@block
def predict_clone(
    belief: Gaussian,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> Gaussian:
    """Predict a belief over `OUTDOOR` by `dt` seconds, with an IMU reading held over the step.

        a = R(q Exp(w dt/2)) f + gravity
        p' = p + v dt + a dt^2/2      v' = v + a dt      q' = q * Exp(w dt)      P' = F (P + Q/2) F^T + Q/2

    The clones stay. F is the Jacobian of this step (Solà eqs. 269-270, to second order in w dt); Q is the
    spectral density times dt. With dt = 0, as at the first firing, this is the identity.

    Args:
        belief: mean (17) and covariance (15, 15).
        imu: rad/s and m/s^2, body.
        noise: densities; there are no biases.
    """
    p, v, q, p0, q0 = _parts(belief.mean)
    kind = q.dtype
    half, middle, R, back = _half_way(q, imu, dt, xp)
    step = (_times(R, imu.specific_force) + xp.asarray(gravity, dtype=kind)) * dt
    F = _clone_jacobian(R, back, imu, dt, xp)
    power = np.repeat([0.0, noise.accelerometer**2, noise.gyro**2, 0.0, 0.0], 3)
    Q = xp.asarray(np.diag(power), dtype=kind) * (0.5 * dt)
    P = F @ (belief.covariance + Q) @ F.mT + Q
    turned = normalize(multiply(middle, half, xp=xp), xp=xp)
    return Gaussian(
        mean=xp.concat([p + (v + 0.5 * step) * dt, v + step, turned, p0, q0], axis=-1),
        covariance=0.5 * (P + P.mT),
    )


def clone_crossing(belief: Gaussian, imu: Imu, dt: Any, xp: Any) -> Array:
    """What `cross_covariance` asks of a filter that predicts with `predict_clone`."""
    _, _, R, back = _half_way(_parts(belief.mean)[2], imu, dt, xp)
    return belief.covariance @ _clone_jacobian(R, back, imu, dt, xp).mT


def _half_way(q: Array, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array, Array]:
    """Half the step's turn, the attitude half-way, its matrix, and that of half the turn back."""
    half = from_rotation_vector(imu.gyro * (0.5 * dt), xp=xp)
    middle = multiply(q, half, xp=xp)
    return half, middle, to_matrix(middle, xp=xp), to_matrix(half, xp=xp).mT


def _clone_jacobian(R: Array, back: Array, imu: Imu, dt: Any, xp: Any) -> Array:
    """F (15, 15) of `predict_clone`."""
    pull = R @ skew(imu.specific_force * -dt, xp=xp) @ back
    one, zero = 0.0 * R + xp.eye(3, dtype=R.dtype), 0.0 * R
    wide = xp.concat([zero, zero], axis=-1)
    rows = [
        xp.concat([one, one * dt, pull * (0.5 * dt), wide], axis=-1),
        xp.concat([zero, one, pull, wide], axis=-1),
        xp.concat([zero, zero, back @ back, wide], axis=-1),
    ]
    return xp.concat([*rows, xp.asarray(_CLONES.T, dtype=R.dtype)], axis=-2)


class PositionObserver:
    """h(x) = p + R(q) lever, in m, world.

    Args:
        lever: the measured point in the body, m.
    """

    def __init__(self, lever: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.lever = lever

    def __call__(self, x: Array, xp: Any) -> Array:
        p, _, q, _, _ = _parts(x)
        return p + rotate(q, xp.asarray(self.lever, dtype=x.dtype), xp=xp)


class FieldObserver:
    """h(x) = R(q)^T earth / noise: a magnetic field in units of its noise, body.

    Args:
        earth: T, world.
        noise: T.
    """

    def __init__(self, earth: tuple[float, float, float], noise: float) -> None:
        self.earth = tuple(m / noise for m in earth)

    def __call__(self, x: Array, xp: Any) -> Array:
        return _times(to_matrix(_parts(x)[2], xp=xp).mT, xp.asarray(self.earth, dtype=x.dtype))


def observe_distance(x: Array, xp: Any) -> Array:
    """h(x) = p_z / R_33: the distance (1) to the ground along body -z, m."""
    p, _, q, _, _ = _parts(x)
    return p[..., 2:3] / to_matrix(q, xp=xp)[..., 2, 2:3]


def observe_flow(x: Array, xp: Any) -> Array:
    """h(x) = (R(q_0)^T (p - p_0), q_0^-1 q): displacement (3) and turn (4) since the last picture."""
    p, _, q, p0, q0 = _parts(x)
    moved, turn = _times(to_matrix(q0, xp=xp).mT, p - p0), multiply(conjugate(q0, xp=xp), q, xp=xp)
    return xp.concat([moved, turn], axis=-1)


def flow_vector(flow: OpticalFlow, *, xp: Any) -> Array:
    """Displacement and turn (7) of a reading, a point of `FLOW`."""
    return xp.concat([flow.displacement, flow.turn], axis=-1)


@block
def new_picture(belief: Gaussian, flow: OpticalFlow | None, *, xp: Any) -> Gaussian:
    """Make now the last picture, where there was a reading of optical flow; else the belief passes through.

    p_0 = p and q_0 = q, in the mean and in the errors: P' = T P T^T, with ones in T where they are copied.
    """
    if flow is None:
        return belief
    p, v, q, _, _ = _parts(belief.mean)
    T = xp.asarray(_TAKEN, dtype=p.dtype)
    return Gaussian(mean=xp.concat([p, v, q, p, q], axis=-1), covariance=T @ belief.covariance @ T.mT)


@block
def picture_cross(belief: Gaussian, flow: OpticalFlow | None, *, xp: Any) -> Gaussian:
    """What `new_picture` makes of a mean, and in place of a covariance P that of the belief before it (rows)
    with the one after, P T^T: what a smoother goes back by."""
    if flow is None:
        return belief
    p, v, q, _, _ = _parts(belief.mean)
    T = xp.asarray(_TAKEN, dtype=p.dtype)
    return Gaussian(mean=xp.concat([p, v, q, p, q], axis=-1), covariance=belief.covariance @ T.mT)


@block
def outdoor_pose(belief: Gaussian) -> PoseBelief:
    """What is believed of now, without the clones."""
    p, v, q, _, _ = _parts(belief.mean)
    return PoseBelief(position=p, velocity=v, attitude=q, covariance=belief.covariance[..., :9, :9])


def outdoor_steps(result: Result) -> Steps:
    """Those of a run of `outdoor_eskf` that was wired for a smoother."""

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        return Series(smoothed.time, outdoor_pose.step(belief), name=smoothed.name)

    return steps_of(result, OUTDOOR)._replace(named=named)


def start_outdoor(start: OutdoorStart) -> Gaussian:
    """A belief to start from, at rest, with a picture taken. Tilt and heading are about world axes."""
    R = np.asarray(to_matrix(start.attitude, xp=np))
    P = np.zeros((15, 15))
    P[:3, :3], P[3:6, 3:6] = np.eye(3) * start.spread.position**2, np.eye(3) * start.spread.velocity**2
    P[6:9, 6:9] = R.T @ np.diag(np.square([start.spread.tilt, start.spread.tilt, start.spread.heading])) @ R
    pose = [start.position, np.zeros(3), start.attitude, start.position, start.attitude]
    return Gaussian(mean=np.concatenate(pose), covariance=_TAKEN @ P @ _TAKEN.T)
