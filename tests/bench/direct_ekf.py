"""The benchmark's peer: the ten-state filter of `graphs/ekf.py` with filterpy's ExtendedKalmanFilter.

The same equations as `blocks/models/pose.py`, as somebody would write them who needs this one filter:
filterpy
does the covariance and the correction, and what it asks its user for, motion, Jacobians and noise, is plain
NumPy with small products spelt out.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from flowgraph import Series

GRAVITY = np.array([0.0, 0.0, -9.81])


def run(
    imu: Series, vicon: Series, *, start: Any, densities: tuple[float, float],
    position_noise: float, attitude_noise: float,
) -> Mapping[str, np.ndarray]:  # fmt: skip
    """Filter a flight whose first pose comes with its first IMU reading.

    Args:
        imu, vicon: readings at every tick; poses at some of them.
        start: velocity, position, attitude and covariance (10, 10).
        densities: gyroscope and accelerometer, continuous.
        position_noise, attitude_noise: m, rad.

    Returns:
        At each tick `position` (n, 3), `velocity`, `attitude` (n, 4), `covariance` (n, 9, 9) in the tangent
        space.
    """
    from filterpy.kalman import ExtendedKalmanFilter

    kalman = ExtendedKalmanFilter(dim_x=10, dim_z=6)
    kalman.x = np.concatenate([start.velocity, start.position, start.attitude])
    kalman.P = np.array(start.covariance)
    kalman.R = np.diag([position_noise**2] * 3 + [attitude_noise**2] * 3)
    poses = dict(zip(np.searchsorted(imu.time, vicon.time).tolist(), range(len(vicon)), strict=True))
    gyro, force, n = imu["gyro"], imu["specific_force"], len(imu)
    found = {
        "velocity": np.empty((n, 3)), "position": np.empty((n, 3)), "attitude": np.empty((n, 4)),
        "covariance": np.empty((n, 9, 9)),
    }  # fmt: skip
    step = _Step(kalman, *densities)
    kalman.predict_x = step.move
    before = np.concatenate([np.zeros(3), -GRAVITY])
    last = int(imu.time[0])
    for k in range(n):
        now = int(imu.time[k])
        reading = np.concatenate([gyro[k], force[k]])
        step.prepare(0.5 * (before + reading), (now - last) * 1e-9)
        kalman.predict()
        step.normalise()
        before, last = reading, now
        if k in poses:
            row = poses[k]
            seen = np.concatenate([vicon["position"][row], vicon["attitude"][row]])
            kalman.update(seen, _observe_jacobian, lambda x: x[3:], residual=_residual)
            step.normalise()
        x, P = kalman.x, kalman.P
        found["velocity"][k], found["position"][k], found["attitude"][k] = x[:3], x[3:6], x[6:]
        T = np.zeros((9, 10))
        T[0:3, 3:6] = T[3:6, 0:3] = np.eye(3)
        T[6:, 6:] = _to_angle(x[6:])
        found["covariance"][k] = T @ P @ T.T
    return found


class _Step:
    """One prediction's motion, Jacobian and noise, handed to the filter."""

    def __init__(self, kalman: Any, gyro: float, accelerometer: float) -> None:
        self.kalman, self.gyro, self.power = kalman, gyro, accelerometer**2
        self.F, self.Q = np.eye(10), np.zeros((10, 10))
        self.next = np.zeros(10)
        self.axes = np.vstack([np.eye(3), -np.eye(3)])

    def prepare(self, reading: np.ndarray, dt: float) -> None:
        x, F, Q = self.kalman.x, self.F, self.Q
        v, p, q = x[:3], x[3:6], x[6:]
        rate, force = reading[:3], reading[3:]
        by_half, by_whole = _right(_exp(rate * (0.5 * dt))), _right(_exp(rate * dt))
        half = by_half @ q
        a = _rotate(half, force) + GRAVITY
        self.next = np.concatenate([v + a * dt, p + (v + a * (0.5 * dt)) * dt, by_whole @ q])
        pull = _rotated_jacobian(half, force) @ by_half * dt
        F[3:6, 0:3] = np.eye(3) * dt
        F[0:3, 6:10], F[3:6, 6:10] = pull, pull * (0.5 * dt)
        F[6:10, 6:10] = by_whole
        push = self.power * dt
        np.fill_diagonal(Q[0:3, 0:3], push)
        np.fill_diagonal(Q[3:6, 3:6], push * dt * dt / 3.0)
        np.fill_diagonal(Q[0:3, 3:6], push * dt / 2.0)
        np.fill_diagonal(Q[3:6, 0:3], push * dt / 2.0)
        apart = _exps(self.axes * (self.gyro * math.sqrt(3.0 * dt))) @ _left(q).T - q
        apart -= apart.mean(0)
        Q[6:, 6:] = apart.T @ apart / 6.0
        self.kalman.F, self.kalman.Q = F, Q

    def move(self, u: Any = 0) -> None:
        self.kalman.x = self.next

    def normalise(self) -> None:
        """The quaternion to unit norm, and the covariance with it."""
        x, P = self.kalman.x, self.kalman.P
        size = math.sqrt(x[6:] @ x[6:])
        q = x[6:] / size
        N = (np.eye(4) - np.outer(q, q)) / size
        P[6:, :] = N @ P[6:, :]
        P[:, 6:] = P[:, 6:] @ N.T
        self.kalman.x = np.concatenate([x[:6], q])
        self.kalman.P = 0.5 * (P + P.T)


def _exp(v: np.ndarray) -> np.ndarray:
    angle = math.sqrt(v @ v)
    scale = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return np.array([math.cos(0.5 * angle), scale * v[0], scale * v[1], scale * v[2]])


def _exps(v: np.ndarray) -> np.ndarray:
    angle = np.sqrt((v * v).sum(1, keepdims=True))
    scale = np.where(angle < 1e-8, 0.5, np.sin(0.5 * angle) / np.maximum(angle, 1e-300))
    return np.hstack([np.cos(0.5 * angle), scale * v])


def _left(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.tolist()
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def _right(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.tolist()
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])


def _cross(v: np.ndarray) -> np.ndarray:
    x, y, z = v.tolist()
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _rotate(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    crossed = _cross(q[1:])
    twice = 2.0 * (crossed @ v)
    return v + q[0] * twice + crossed @ twice


def _rotated_jacobian(q: np.ndarray, v: np.ndarray) -> np.ndarray:
    w, u = q[0], q[1:]
    found = np.empty((3, 4))
    found[:, 0] = w * v + _cross(u) @ v
    outer = np.outer(u, v)
    found[:, 1:] = (u @ v) * np.eye(3) + outer - outer.T - w * _cross(v)
    return 2.0 * found


def _to_angle(q: np.ndarray) -> np.ndarray:
    w, u = q[0], -q[1:]
    found = np.empty((3, 4))
    found[:, 0] = u
    found[:, 1:] = w * np.eye(3) + _cross(u)
    return 2.0 * found


def _observe_jacobian(x: np.ndarray) -> np.ndarray:
    H = np.zeros((6, 10))
    H[:3, 3:6] = np.eye(3)
    H[3:, 6:] = _to_angle(x[6:])
    return H


def _residual(seen: np.ndarray, expected: np.ndarray) -> np.ndarray:
    """Position, and the rotation vector from the expected attitude to the seen one."""
    q = expected[3:] * np.array([1.0, -1.0, -1.0, -1.0])
    turn = _left(q) @ seen[3:]
    turn = turn if turn[0] >= 0.0 else -turn
    sine = math.sqrt(turn[1:] @ turn[1:])
    scale = 2.0 if sine < 1e-12 else 2.0 * math.atan2(sine, turn[0]) / sine
    return np.concatenate([seen[:3] - expected[:3], scale * turn[1:]])
