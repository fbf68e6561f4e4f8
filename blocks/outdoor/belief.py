"""The outdoor sensors in an error-state Kalman filter: one Gaussian over now and the last picture.

State x = (position, velocity, attitude, position at the last picture, attitude at the last picture): 17
numbers, on a space of 15 dimensions. The last two are clones, which optical flow is measured from. Where the
unit has biases that are worth estimating, those of gyroscope and accelerometer follow: 23 numbers, 21
dimensions. A sensor is a function of the state; `update_extended` derives its Jacobian and does the rest.
Attitude errors are right (body) rotation vectors.

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
from flowgraph.blocks.outdoor.layout import BELIEF, belief_layout
from flowgraph.blocks.signals import Belief, Gaussian, Imu, OpticalFlow, PoseBelief

__all__ = [
    "BIASED",
    "FLOW",
    "FieldObserver",
    "OUTDOOR",
    "PositionObserver",
    "clone_crossing",
    "clone_transition",
    "flow_vector",
    "new_picture",
    "observe_distance",
    "observe_flow",
    "outdoor_navigation",
    "outdoor_pose",
    "outdoor_space",
    "outdoor_steps",
    "picture_cross",
    "picture_taken",
    "predict_clone",
    "start_outdoor",
]

OUTDOOR = StateSpace(euclidean(3), euclidean(3), quaternion(), euclidean(3), quaternion())
"""The state: position, velocity, attitude; position and attitude at the last picture."""

BIASED = StateSpace(*OUTDOOR.parts, euclidean(3), euclidean(3))
"""The state with the biases of gyroscope (rad/s) and accelerometer (m/s^2)."""

FLOW = StateSpace(euclidean(3), quaternion())
"""What optical flow measures: displacement (m) and turn."""

_COPIED = {"picture_position": "position", "picture_attitude": "attitude"}
"""What a new picture makes of the clones."""


def outdoor_space(mean: Array) -> StateSpace:
    """That of a state (17 or 23)."""
    return BIASED if belief_layout(mean).biased else OUTDOOR


def _parts(x: Array) -> tuple[Array, Array, Array, Array, Array]:
    p, v, q, p0, q0 = (x[..., at] for at in BELIEF.means.values())
    return p, v, q, p0, q0


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
    """Predict a belief over `OUTDOOR` or `BIASED` by `dt` seconds, with an IMU reading held over the step.

        a = R(q Exp(w dt/2)) f + gravity
        p' = p + v dt + a dt^2/2      v' = v + a dt      q' = q * Exp(w dt)      P' = F (P + Q/2) F^T + Q/2

    The clones stay. F is the Jacobian of this step (Solà eqs. 269-270, to second order in w dt); Q is the
    spectral density times dt. With dt = 0, as at the first firing, this is the identity. Biases are taken off
    the reading, and walk.

    Args:
        belief: mean (17) and covariance (15, 15), or 23 and (21, 21).
        imu: rad/s and m/s^2, body.
        noise: densities; of the walks only where there are biases.
    """
    x, layout = belief.mean, belief_layout(belief.mean)
    p, v, q, _, _ = _parts(x)
    kind = q.dtype
    imu = _unbiased(x, imu)
    half, middle, R, back = _half_way(q, imu, dt, xp)
    step = (_times(R, imu.specific_force) + xp.asarray(gravity, dtype=kind)) * dt
    F = _clone_jacobian(x, R, back, imu, dt, xp)
    power = layout.diagonal(
        velocity=noise.accelerometer**2, attitude=noise.gyro**2,
        gyro_bias=noise.gyro_bias**2, accelerometer_bias=noise.accelerometer_bias**2,
    )  # fmt: skip
    Q = xp.asarray(np.diag(power), dtype=kind) * (0.5 * dt)
    P = F @ (belief.covariance + Q) @ F.mT + Q
    turned = normalize(multiply(middle, half, xp=xp), xp=xp)
    return Gaussian(
        mean=xp.concat([p + (v + 0.5 * step) * dt, v + step, turned, x[..., 10:]], axis=-1),
        covariance=0.5 * (P + P.mT),
    )


def clone_crossing(belief: Gaussian, imu: Imu, dt: Any, xp: Any) -> Array:
    """What `cross_covariance` asks of a filter that predicts with `predict_clone`."""
    return belief.covariance @ clone_transition(belief.mean, imu, dt, xp).mT


def clone_transition(x: Array, imu: Imu, dt: Any, xp: Any) -> Array:
    """F (15, 15) of `predict_clone` at the state x (17), or (21, 21) at one of 23."""
    imu = _unbiased(x, imu)
    _, _, R, back = _half_way(_parts(x)[2], imu, dt, xp)
    return _clone_jacobian(x, R, back, imu, dt, xp)


def _unbiased(x: Array, imu: Imu) -> Imu:
    """The reading less the biases of the state, where it has any."""
    layout = belief_layout(x)
    if not layout.biased:
        return imu
    gyro, force = (x[..., layout.means[name]] for name in ("gyro_bias", "accelerometer_bias"))
    return Imu(gyro=imu.gyro - gyro, specific_force=imu.specific_force - force)


def _half_way(q: Array, imu: Imu, dt: Any, xp: Any) -> tuple[Array, Array, Array, Array]:
    """Half the step's turn, the attitude half-way, its matrix, and that of half the turn back."""
    half = from_rotation_vector(imu.gyro * (0.5 * dt), xp=xp)
    middle = multiply(q, half, xp=xp)
    return half, middle, to_matrix(middle, xp=xp), to_matrix(half, xp=xp).mT


def _clone_jacobian(x: Array, R: Array, back: Array, imu: Imu, dt: Any, xp: Any) -> Array:
    """F (15, 15) of `predict_clone`, or (21, 21), by a reading less its biases."""
    pull = R @ skew(imu.specific_force * -dt, xp=xp) @ back
    one, zero = 0.0 * R + xp.eye(3, dtype=R.dtype), 0.0 * R
    layout, clones = belief_layout(x), [zero, zero]
    pushed: list[Array] = []
    turned: list[Array] = []
    if layout.biased:  # a turn loses half of a bias's by the middle of the step
        pushed, turned = [pull * (-0.5 * dt), R * -dt], [back * -dt, zero]
    stay = xp.asarray(np.eye(layout.directions)[9:], dtype=R.dtype)
    rows = [
        xp.concat([one, one * dt, pull * (0.5 * dt), *clones, *(m * (0.5 * dt) for m in pushed)], axis=-1),
        xp.concat([zero, one, pull, *clones, *pushed], axis=-1),
        xp.concat([zero, zero, back @ back, *clones, *turned], axis=-1),
        xp.broadcast_to(stay, (*R.shape[:-2], *stay.shape)),
    ]
    return xp.concat(rows, axis=-2)


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
    mean, T = picture_taken(belief.mean, xp)
    return Gaussian(mean=mean, covariance=T @ belief.covariance @ T.mT)


def picture_taken(x: Array, xp: Any) -> tuple[Array, Array]:
    """The state whose clone is its own pose, and T (15, 15), or (21, 21)."""
    layout, (p, v, q, _, _) = belief_layout(x), _parts(x)
    biases = [x[..., 17:]] if layout.biased else []
    mean = xp.concat([p, v, q, p, q, *biases], axis=-1)
    return mean, xp.asarray(layout.copied(_COPIED), dtype=x.dtype)


@block
def picture_cross(belief: Gaussian, flow: OpticalFlow | None, *, xp: Any) -> Gaussian:
    """What `new_picture` makes of a mean, and in place of a covariance P that of the belief before it (rows)
    with the one after, P T^T: what a smoother goes back by."""
    if flow is None:
        return belief
    mean, T = picture_taken(belief.mean, xp)
    return Gaussian(mean=mean, covariance=belief.covariance @ T.mT)


@block
def outdoor_pose(belief: Gaussian) -> PoseBelief:
    """What is believed of now, without the clones and biases."""
    p, v, q, _, _ = _parts(belief.mean)
    return PoseBelief(position=p, velocity=v, attitude=q, covariance=belief.covariance[..., :9, :9])


@block
def outdoor_navigation(belief: Gaussian, *, xp: Any) -> Belief:
    """What is believed of now and of the biases, without the clones."""
    x, P = belief.mean, belief.covariance
    p, v, q, _, _ = _parts(x)
    at = belief_layout(x).means
    pick = xp.asarray(np.eye(21)[[*range(9), *range(15, 21)]], dtype=P.dtype)  # of now, and the biases
    return Belief(
        position=p,
        velocity=v,
        attitude=q,
        gyro_bias=x[..., at["gyro_bias"]],
        accelerometer_bias=x[..., at["accelerometer_bias"]],
        covariance=pick @ P @ pick.mT,
    )


def outdoor_steps(result: Result) -> Steps:
    """Those of a run of `outdoor_eskf` that was wired for a smoother."""
    space = outdoor_space(result["posterior"]["mean"])

    def named(smoothed: Series) -> Series:
        belief = Gaussian(mean=smoothed["mean"], covariance=smoothed["covariance"])
        made = outdoor_pose.step(belief) if space is OUTDOOR else outdoor_navigation.step(belief, xp=np)
        return Series(smoothed.time, made, name=smoothed.name)

    return steps_of(result, space)._replace(named=named)


def start_outdoor(start: OutdoorStart, *, biases: bool = False) -> Gaussian:
    """A belief to start from, at rest, with a picture taken. Tilt and heading are about world axes.

    biases: whether there are any; they are zero, as far as the start's spread says.
    """
    R, spread = np.asarray(to_matrix(start.attitude, xp=np)), start.spread
    mean = np.concatenate([start.position, np.zeros(3), start.attitude, start.position, start.attitude])
    mean = np.append(mean, np.zeros(6)) if biases else mean
    layout = belief_layout(mean)
    P = np.diag(np.square(layout.diagonal(
        position=spread.position, velocity=spread.velocity,
        gyro_bias=spread.gyro_bias, accelerometer_bias=spread.accelerometer_bias,
    )))  # fmt: skip
    P[6:9, 6:9] = R.T @ np.diag(np.square([spread.tilt, spread.tilt, spread.heading])) @ R
    copied = layout.copied(_COPIED)
    return Gaussian(mean=mean, covariance=copied @ P @ copied.T)
