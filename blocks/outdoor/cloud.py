"""The particles of an outdoor filter: attitude by particles, drawn once a picture; all else Gaussian given
each.

Given a particle's attitude, velocity and position are linear in the sensors. Drawing the gyroscope's noise at
every step, to let sharp sensors weigh the outcome, wastes particles: most are drawn where the next reading
will not have them. So the noise since the last draw stays a small Gaussian too, a rotation vector e that the
particle's Kalman filter carries beside its motion; within a few hundredths of a radian every sensor is linear
in it. Each reading is then a Kalman update of each particle, and weighs it by how likely it was beforehand.
When a picture is taken, e is drawn from what all readings since the last one have left of it, and the motion
is conditioned on the draw: the proposal that looks at the readings first, and the least uneven weights.

Biases of the unit, where they are estimated, are linear in all of this as well: they stay in the Kalman
filter of each particle, which needs no more particles for them.

Optical flow measures from one picture to the next. Each particle keeps its attitude at the last picture and,
in its Kalman state, how far it has moved since, which is zero and certain when a picture is taken.

Source: A. Doucet, N. de Freitas, K. Murphy and S. Russell, "Rao-Blackwellised particle filtering for dynamic
Bayesian networks", UAI 2000; for the draw: A. Doucet, S. Godsill and C. Andrieu, "On sequential Monte Carlo
sampling methods for Bayesian filtering", Statistics and Computing 10, 2000, sec. II-D (the optimal proposal,
by local linearisation); for the sensors: R. Fiszel's thesis on reactive pose estimation, Stanford 2017.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np

from flowgraph import Array, block
from flowgraph.blocks.geometry import lanes
from flowgraph.blocks.geometry.rotations import to_matrix
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.outdoor.flight import OutdoorStart
from flowgraph.blocks.outdoor.layout import PARTICLE, Layout, particle_layout
from flowgraph.blocks.particles.cloud import cloud_belief, start_cloud
from flowgraph.blocks.signals import (
    Ancestors,
    Cloud,
    Gaussian,
    Imu,
    OutdoorCloud,
    PoseBelief,
    PoseEstimate,
    Weights,
)

__all__ = [
    "ACCELEROMETER_BIAS",
    "GYRO_BIAS",
    "MOVED",
    "POSITION",
    "TURN",
    "VELOCITY",
    "as_cloud",
    "cloud_biases",
    "outdoor_belief",
    "predict_outdoor",
    "shifted",
    "start_outdoor_cloud",
    "take_outdoor_ancestors",
    "take_picture",
    "turned",
]

VELOCITY, POSITION, MOVED, TURN, GYRO_BIAS, ACCELEROMETER_BIAS = PARTICLE.with_biases().errors.values()
"""Where each stands in a covariance. The means have no turn, which is zero: biases come three before."""

_MOVING = ("position", "moved")


@functools.cache
def _white(layout: Layout) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What white noise on the acceleration leaves: the coefficients of dt, dt^2 and dt^3."""
    return (
        layout.blocks({("velocity", "velocity"): 1.0}),
        layout.blocks({pair: 0.5 for m in _MOVING for pair in (("velocity", m), (m, "velocity"))}),
        layout.blocks({(a, b): 1.0 / 3.0 for a in _MOVING for b in _MOVING}),
    )


_KEPT = {"velocity": 1.0, "position": 1.0, "gyro_bias": 1.0, "accelerometer_bias": 1.0}
"""What of the state outlives a picture."""

_MOTION_OF_POSE = np.eye(9, 12, 0)[[3, 4, 5, 0, 1, 2, 6, 7, 8]] * (np.arange(9) < 6)[:, None]
"""(9, 12): position and velocity of (v, p, s, e), in the order of `PoseBelief`."""

_TURN_OF_POSE = np.eye(9, 3, -6)
"""(9, 3): the place of a rotation vector in `PoseBelief`."""

_LEAST_VARIANCE = 1e-20
"""Below it (rad^2) a turn is taken for certain when it is drawn; in float32 too it is not zero."""


@block
def predict_outdoor(
    cloud: OutdoorCloud,
    imu: Imu,
    *,
    noise: ImuNoise,
    gravity: tuple[float, float, float] = GRAVITY,
    dt: float,
    xp: Any,
) -> OutdoorCloud:
    """Carry the cloud over `dt` seconds: a Kalman prediction of each particle.

        f = R(q * Exp(gyro dt/2)) specific_force      a = f + gravity      q' = q * Exp(gyro dt)
        v' = v + a dt      p' = p + v dt + a dt^2/2      s' = s + v dt + a dt^2/2      e' = e
        P' = F (P + N/2) F^T + N/2 + Q

    s is the displacement since the last picture. F is the Jacobian: with the attitude wrong by e, the force
    is wrong by e x f. N is the gyroscope's white noise on e, noise.gyro^2 dt, half of it before the step so
    that the motion feels it; Q is white noise on the acceleration, noise.accelerometer^2 [dt, dt^2/2; dt^2/2,
    dt^3/3] on v and on p and s, which move alike. Fires when its inputs do; with dt = 0, as at the first
    firing, this is the identity.

    Where particles have biases, these are taken off their reading, and walk. What is unknown of that of the
    gyroscope turns e by -R b dt, and what is unknown of the accelerometer's pushes the velocity by -R b dt.

    Args:
        cloud: the belief at the last firing.
        imu: the reading that held since then: rad/s and m/s^2, body.
        noise: densities; of the walks only where there are biases.
    """
    kind, layout = cloud.motion.dtype, particle_layout(cloud.covariance)
    rate = imu.gyro[:, None]
    if layout.biased:
        rate = rate - cloud.motion[layout.means["gyro_bias"], :]
    half = lanes.exponential((0.5 * dt) * rate, xp=xp)
    middle = lanes.multiply(cloud.attitude, half, xp=xp)
    attitude = lanes.normalize(lanes.multiply(middle, half, xp=xp), xp=xp)
    turn = None
    if layout.biased:
        R = lanes.rotation_matrices(middle, xp=xp)
        own = imu.specific_force[:, None] - cloud.motion[layout.means["accelerometer_bias"], :]
        force, turn = xp.sum(R * own[None, :, :], axis=1), R * dt
    else:
        force = lanes.rotate(middle, imu.specific_force, xp=xp)
    step = (force + xp.asarray(gravity, dtype=kind)[:, None]) * dt
    path = (cloud.motion[VELOCITY, :] + 0.5 * step) * dt
    white = [table * noise.accelerometer**2 for table in _white(layout)]
    walks = layout.diagonal(gyro_bias=noise.gyro_bias**2, accelerometer_bias=noise.accelerometer_bias**2)
    W, W2, W3 = (xp.asarray(t, dtype=kind) for t in (white[0] + np.diag(walks), white[1], white[2]))
    Q = (W + (W2 + W3 * dt) * dt) * dt
    N = xp.asarray(np.diag(layout.diagonal(turn=0.5 * noise.gyro**2)), dtype=kind) * dt
    wide = cloud.covariance + N[:, :, None]
    for _ in range(2):  # F (F P)^T, which is F P F^T
        wide = lanes.transpose(_advanced(wide, force * dt, dt, xp, turn), xp=xp)
    motion = cloud.motion[:9, :] + xp.concat([step, path, path], axis=0)
    return cloud.replace(
        attitude=attitude,
        motion=xp.concat([motion, cloud.motion[9:, :]], axis=0) if layout.biased else motion,
        covariance=wide + (N + Q)[:, :, None],
    )


def _advanced(A: Array, push: Array, dt: Array, xp: Any, turn: Array | None = None) -> Array:
    """F A for each particle: A (12, 12, n), and push (3, n) the force times dt; with biases A is (18, 18, n),
    and turn (3, 3, n) the rotation times dt."""
    v, p, s, e = (A[part, :, :] for part in (VELOCITY, POSITION, MOVED, TURN))
    if turn is None:
        step = -lanes.cross(push, e, xp=xp)
        path = (v + 0.5 * step) * dt
        return xp.concat([v + step, p + path, s + path, e], axis=0)
    by_rate, by_force = (
        sum(turn[:, k, None, :] * A[part, :, :][None, k, :, :] for k in range(3))
        for part in (GYRO_BIAS, ACCELEROMETER_BIAS)
    )
    step = -lanes.cross(push, e - 0.5 * by_rate, xp=xp) - by_force
    path = (v + 0.5 * step) * dt
    return xp.concat([v + step, p + path, s + path, e - by_rate, A[12:, :, :]], axis=0)


@block
def take_picture(cloud: OutdoorCloud, when: Any | None, *, draw: Any, xp: Any) -> OutdoorCloud:
    """Draw each particle's attitude, and make it that of the last picture.

    e ~ N(0, P_ee), one component after the other, each conditioned on those before it; with a component drawn
    d standard deviations off, and c the covariance of everything with it over its deviation, the mean moves
    by c d and the covariance falls by c c^T. Then q' = Exp(e) q, q_0 = q', and e = s = 0 with no variance.
    Draws `turn` (3, n).

    Args:
        when: the reading that ends at this picture; without one the cloud passes through.
    """
    if when is None:
        return cloud
    P = cloud.covariance
    deviations = xp.asarray(draw.normal("turn", (3, P.shape[-1])), dtype=P.dtype)
    state = 0.0 * P[0, :, :]  # (12, n)
    for k in range(3):
        # what the earlier components have said of this one is in `state` already: the rest is independent
        with_k = P[9 + k, :, :]
        c = with_k / xp.sqrt(xp.maximum(with_k[9 + k, :], _LEAST_VARIANCE))
        state = state + c * deviations[k, :]
        P = P - c[:, None, :] * c[None, :, :]
    layout = particle_layout(P)
    kept = xp.asarray(layout.diagonal(**_KEPT), dtype=P.dtype)
    attitude = turned(cloud.attitude, state[TURN, :], xp)
    return cloud.replace(
        attitude=attitude,
        picture=attitude,
        motion=shifted(cloud.motion, state, xp) * layout.but("turn", kept, xp)[:, None],
        covariance=P * (kept[:, None] * kept[None, :])[:, :, None],
    )


def shifted(motion: Array, state: Array, xp: Any) -> Array:
    """The means (9 or 15, n) after a change of the state (12 or 18, n), but for its turn."""
    return motion + particle_layout(state).but("turn", state, xp)


def turned(q: Array, e: Array, xp: Any) -> Array:
    """Exp(e) q: attitudes (4, n) turned by rotation vectors (3, n) in the world."""
    return lanes.normalize(lanes.multiply(lanes.exponential(e, xp=xp), q, xp=xp), xp=xp)


@block
def as_cloud(cloud: OutdoorCloud) -> Cloud:
    """The cloud without its pictures: what averages and resampling need."""
    P = cloud.covariance
    return Cloud(
        log_weight=cloud.log_weight,
        attitude=cloud.attitude,
        velocity=cloud.motion[VELOCITY, :],
        position=cloud.motion[POSITION, :],
        velocity_covariance=P[VELOCITY, VELOCITY, :],
        cross_covariance=P[POSITION, VELOCITY, :],
        position_covariance=P[POSITION, POSITION, :],
    )


@block
def outdoor_belief(
    cloud: OutdoorCloud, plain: Cloud, weights: Weights, pose: PoseEstimate, *, xp: Any
) -> PoseBelief:
    """The pose with its covariance (9, 9): `cloud_belief`, and what each particle does not know of its turn.

    e, in the world, is R(q)^T e in the body; the mean of the particles' covariances is turned with the mean
    attitude.

    Args:
        cloud, plain: with and without what `as_cloud` leaves out.
        weights, pose: of it.
    """
    found = cloud_belief.step(plain, weights, pose, xp=xp)
    kind = pose.attitude.dtype
    own = xp.sum(cloud.covariance * weights.weight, axis=-1)[:12, :12]
    R = to_matrix(pose.attitude, xp=xp)
    lift = xp.asarray(_TURN_OF_POSE, dtype=kind)
    turn = lift @ R.mT @ xp.asarray(np.eye(3, 12, 9), dtype=kind)  # (9, 12)
    motion = xp.asarray(_MOTION_OF_POSE, dtype=kind)
    across = turn @ own @ motion.mT
    total = found.covariance + turn @ own @ turn.mT + across + across.mT
    return found.replace(covariance=0.5 * (total + total.mT))


@block
def cloud_biases(cloud: OutdoorCloud, weights: Weights, *, xp: Any) -> Gaussian:
    """The biases of a cloud that has them: rad/s and m/s^2, (6), and their covariance (6, 6)."""
    own = cloud.motion[9:, :]
    mean = own @ weights.weight
    apart = own - mean[:, None]
    P = xp.sum(cloud.covariance[12:, 12:, :] * weights.weight, axis=-1)
    return Gaussian(mean=mean, covariance=P + (apart * weights.weight) @ apart.mT)


@block
def take_outdoor_ancestors(cloud: OutdoorCloud, ancestors: Ancestors, *, xp: Any) -> OutdoorCloud:
    """The cloud of the chosen particles; equally weighted if it was resampled."""
    n = cloud.log_weight.shape[-1]
    copy = lambda field: xp.take(field, ancestors.index, axis=-1)
    return OutdoorCloud(
        log_weight=xp.where(ancestors.resampled, -math.log(n), cloud.log_weight),
        attitude=copy(cloud.attitude),
        picture=copy(cloud.picture),
        motion=copy(cloud.motion),
        covariance=copy(cloud.covariance),
    )


def start_outdoor_cloud(
    particles: int, start: OutdoorStart, *, seed: int = 0, biases: bool = False
) -> OutdoorCloud:
    """A cloud to start from, equally weighted and at rest, with a picture taken.

    biases: whether there are any; they are zero, as far as the start's spread says.
    """
    plain = start_cloud(
        particles, seed=seed, position=start.position, attitude=start.attitude, spread=start.spread
    )
    layout, spread = PARTICLE.with_biases() if biases else PARTICLE, start.spread
    deviations = layout.diagonal(
        velocity=spread.velocity, position=spread.position,
        gyro_bias=spread.gyro_bias, accelerometer_bias=spread.accelerometer_bias,
    )  # fmt: skip
    still = np.zeros((layout.size - 6, particles))
    return OutdoorCloud(
        log_weight=plain.log_weight,
        attitude=plain.attitude,
        picture=plain.attitude,
        motion=np.concatenate([plain.velocity, plain.position, still]),
        covariance=np.repeat(np.diag(np.square(deviations))[:, :, None], particles, axis=2),
    )
