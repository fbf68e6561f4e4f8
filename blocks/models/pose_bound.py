"""The bound of every filter of a pose that is driven by an inertial unit and corrected by a motion capture.

The state's error is that of `PoseBelief`: position, velocity (world) and a right rotation vector (body). Over
a step of a true trajectory, from velocity v and attitude R to v' and R', it moves by

        [I  dt I  S dt/2]
    F = [0   I    S     ]      S = -skew(v' - v - gravity dt) R
        [0   0    R'^T R]

for the force of the step, turned into the world and times dt, is v' - v - gravity dt. It takes in the white
noise of the unit, and the motion capture sees position and rotation vector. The unit has no biases.

Source: as in `blocks/metrics/bound.py`; F is that of an error-state filter, J. Solà, "Quaternion kinematics
for the error-state Kalman filter", arXiv:1711.02508, 2017, sec. 5.4.
"""

from __future__ import annotations

import numpy as np

from flowgraph.blocks.geometry.rotations import skew, to_matrix
from flowgraph.blocks.inertial.imu import GRAVITY, ImuNoise
from flowgraph.blocks.metrics.bound import posterior_bound, smoothing_bound

__all__ = ["pose_bound"]


def pose_bound(
    time: np.ndarray,
    velocity: np.ndarray,
    attitude: np.ndarray,
    *,
    measured: np.ndarray,
    noise: ImuNoise,
    position_noise: float,
    attitude_noise: float,
    start: np.ndarray | None = None,
    gravity: tuple[float, float, float] = GRAVITY,
    smoothing: bool = False,
) -> np.ndarray:
    """The covariance (n, ..., 9, 9) that no filter's error falls below, in the order of `PoseBelief`.

    Args:
        time: (n,) int64 ns, the times of the inertial unit.
        velocity: (n, ..., 3) m/s, world, of the truth; further axes are flights.
        attitude: (n, ..., 4) of the truth.
        measured: (n,) bool, where there is a pose.
        noise: of the inertial unit; its biases are not looked at.
        position_noise, attitude_noise: standard deviations of the pose, m and rad.
        start: (9, 9), how well the start is known; exactly where it is left out.
        gravity: m/s^2, world.
        smoothing: that of a smoother, which knows the later poses too.
    """
    dt = np.diff(time) * 1e-9
    turned = np.asarray(to_matrix(attitude, xp=np))
    across = dt.reshape(-1, *[1] * (velocity.ndim - 1))
    push = np.diff(velocity, axis=0) - np.array(gravity) * across
    wide = across[..., None]
    F = np.zeros((*push.shape[:-1], 9, 9))
    F[..., :6, :6] = np.eye(6)
    F[..., :3, 3:6] = np.eye(3) * wide
    F[..., 3:6, 6:] = -skew(push, xp=np) @ turned[:-1]
    F[..., :3, 6:] = F[..., 3:6, 6:] * (0.5 * wide)
    F[..., 6:, 6:] = turned[1:].mT @ turned[:-1]
    one = np.eye(3)
    Q = np.zeros((len(dt), 9, 9))
    for k, step in enumerate(dt):
        white = noise.accelerometer**2 * step
        Q[k, :6, :6] = white * np.kron([[step**2 / 3.0, step / 2.0], [step / 2.0, 1.0]], one)
        Q[k, 6:, 6:] = noise.gyro**2 * step * one
    Q = Q.reshape(len(dt), *[1] * (velocity.ndim - 2), 9, 9)
    bound = posterior_bound(
        F,
        Q,
        np.delete(np.eye(9), (3, 4, 5), axis=0),
        np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3),
        start=np.zeros((9, 9)) if start is None else start,
        measured=measured,
    )
    return smoothing_bound(F, Q, bound) if smoothing else bound
