"""The benchmark's peer: the 15-state inertial filter as one hand-written NumPy loop, without flowgraph.

The same equations as `blocks/inertial/imu.py` and `blocks/inertial/aiding.py`, as somebody would write them
who needs this one filter only: matrices allocated once, blocks written in place, small products spelt out.
"""

from __future__ import annotations

import math

import numpy as np


def run(
    time: np.ndarray,
    imu_index: np.ndarray,
    position_index: np.ndarray,
    imu: np.ndarray,
    positions: np.ndarray,
    *,
    start: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    densities: tuple[float, float, float, float],
    position_noise: float,
    lever: tuple[float, float, float],
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Filter a whole flight: every tick predicts with the latest IMU sample, a tick with a position updates.

    Args:
        time: (n,) int64 ns, the ticks: all times of either sensor.
        imu_index: (n,) row of `imu` that arrives at each tick, -1 for none.
        position_index: (n,) row of `positions` that arrives at each tick, -1 for none.
        imu: (m, 6) gyro in rad/s and specific force in m/s^2, body.
        positions: (k, 3) m, world, of the point at `lever`.
        start: position, velocity, attitude (w, x, y, z), gyro bias, accelerometer bias, covariance (15, 15).
        densities: gyro, accelerometer, gyro bias, accelerometer bias, continuous.
        position_noise: standard deviation, m.
        lever: m, body.
        gravity: m/s^2, world.

    Returns:
        states (n, 16) in the order of `start`, covariances (n, 15, 15), and nis (n,), NaN where no position
        came.
    """
    p, v, q, bg, ba, P = (np.array(part, dtype=float) for part in start)
    n = len(time)
    states, covariances, nis = np.empty((n, 16)), np.empty((n, 15, 15)), np.full(n, np.nan)
    gyro_power, accelerometer_power, gyro_walk, accelerometer_walk = np.square(densities)
    power = np.repeat([0.0, accelerometer_power, gyro_power, gyro_walk, accelerometer_walk], 3)
    arm, arm_skew, g = np.array(lever), _skew(np.array(lever)), np.array(gravity)
    F, H, one, eye = np.eye(15), np.zeros((3, 15)), np.eye(15), np.eye(3)
    H[:, :3] = eye
    R_noise = eye * position_noise**2
    reading = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    before = int(time[0])
    for k in range(n):
        if imu_index[k] >= 0:
            reading = imu[imu_index[k]]
        now = int(time[k])
        dt = (now - before) * 1e-9
        before = now

        half = _exp((reading[:3] - bg) * (0.5 * dt))
        force = reading[3:] - ba
        half_matrix = _matrix(half)
        middle = _matrix(q) @ half_matrix
        step = (middle @ force + g) * dt
        back = half_matrix.T
        pull = np.concatenate([middle @ _skew(force * -dt) @ back] * 2 + [middle * -dt], axis=1)
        pull[:, 3:6] *= -0.5 * dt
        F[0:3, 3:6] = eye * dt
        F[0:3, 6:15] = pull * (0.5 * dt)
        F[3:6, 6:15] = pull
        F[6:9, 6:9] = back @ back
        F[6:9, 9:12] = back * -dt
        noise = power * (0.5 * dt)
        P.flat[::16] += noise
        P = F @ P @ F.T
        P.flat[::16] += noise
        P = 0.5 * (P + P.T)
        p = p + (v + 0.5 * step) * dt
        v = v + step
        q = _multiply(q, _multiply(half, half))
        q = q / math.sqrt(q @ q)

        if position_index[k] >= 0:
            R = _matrix(q)
            H[:, 6:9] = R @ -arm_skew
            residual = positions[position_index[k]] - p - R @ arm
            HP = H @ P
            S = HP @ H.T + R_noise
            solved = np.linalg.solve(S, np.concatenate([HP, residual[:, None]], axis=1))
            nis[k] = residual @ solved[:, 15]
            d = residual @ solved[:, :15]
            reset = one.copy()
            reset[6:9, 6:9] -= _skew(d[6:9] * 0.5)
            gain = reset @ solved[:, :15].T
            A = reset - gain @ H
            P = A @ P @ A.T + gain @ R_noise @ gain.T
            P = 0.5 * (P + P.T)
            p, v, bg, ba = p + d[0:3], v + d[3:6], bg + d[9:12], ba + d[12:15]
            q = _multiply(q, _exp(d[6:9]))

        states[k, 0:3], states[k, 3:6], states[k, 6:10], states[k, 10:13], states[k, 13:16] = p, v, q, bg, ba
        covariances[k] = P
    return states, covariances, nis


def ticks(imu_time: np.ndarray, position_time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The `time`, `imu_index` and `position_index` of two sensors' stamps."""
    time = np.union1d(imu_time, position_time)
    imu_index, position_index = np.full(len(time), -1), np.full(len(time), -1)
    imu_index[np.searchsorted(time, imu_time)] = np.arange(len(imu_time))
    position_index[np.searchsorted(time, position_time)] = np.arange(len(position_time))
    return time, imu_index, position_index


def _skew(v: np.ndarray) -> np.ndarray:
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    w, x, y, z = a.tolist()
    W, X, Y, Z = b.tolist()
    return np.array(
        [
            w * W - x * X - y * Y - z * Z,
            w * X + x * W + y * Z - z * Y,
            w * Y - x * Z + y * W + z * X,
            w * Z + x * Y - y * X + z * W,
        ]
    )


def _exp(v: np.ndarray) -> np.ndarray:
    x, y, z = v.tolist()
    squared = x * x + y * y + z * z
    if squared < 1e-8:
        scale, w = 0.5 - squared / 48.0, 1.0 - squared / 8.0
    else:
        half = 0.5 * math.sqrt(squared)
        scale, w = 0.5 * math.sin(half) / half, math.cos(half)
    return np.array([w, scale * x, scale * y, scale * z])


def _matrix(q: np.ndarray) -> np.ndarray:
    w, x, y, z = q.tolist()
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )
