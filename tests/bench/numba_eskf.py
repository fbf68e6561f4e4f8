"""The benchmark's peer: the loop of `direct_eskf.py`, compiled by numba.

The same equations and functions; only what numba has no rule for is written otherwise: products of small
matrices are loops, as its BLAS calls cost more than they compute at this size, and `solve` is a Cholesky
factorization in place. Needs numba.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit

_compiled = njit(cache=False, fastmath=True)


@_compiled
def _product(a: Any, b: Any) -> Any:
    out = np.zeros((a.shape[0], b.shape[1]))
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            for j in range(b.shape[1]):
                out[i, j] += a[i, k] * b[k, j]
    return out


@_compiled
def _product_transposed(a: Any, b: Any) -> Any:
    """a b^T."""
    out = np.zeros((a.shape[0], b.shape[0]))
    for i in range(a.shape[0]):
        for j in range(b.shape[0]):
            total = 0.0
            for k in range(a.shape[1]):
                total += a[i, k] * b[j, k]
            out[i, j] = total
    return out


@_compiled
def _skew(x: float, y: float, z: float) -> Any:
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


@_compiled
def _multiply(a: Any, b: Any) -> Any:
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


@_compiled
def _exp(v: Any) -> Any:
    squared = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if squared < 1e-8:
        scale, w = 0.5 - squared / 48.0, 1.0 - squared / 8.0
    else:
        half = 0.5 * math.sqrt(squared)
        scale, w = 0.5 * math.sin(half) / half, math.cos(half)
    return np.array([w, scale * v[0], scale * v[1], scale * v[2]])


@_compiled
def _matrix(q: Any) -> Any:
    w, x, y, z = q[0], q[1], q[2], q[3]
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
            [2.0 * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0 * (y * z - w * x)],
            [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    )


@_compiled
def _solve(S: Any, B: Any) -> Any:
    """S^-1 B for a symmetric positive S (3, 3)."""
    L = np.zeros((3, 3))
    for i in range(3):
        for j in range(i + 1):
            total = S[i, j]
            for k in range(j):
                total -= L[i, k] * L[j, k]
            L[i, j] = math.sqrt(total) if i == j else total / L[j, j]
    X = B.copy()
    for c in range(B.shape[1]):
        for i in range(3):
            for k in range(i):
                X[i, c] -= L[i, k] * X[k, c]
            X[i, c] /= L[i, i]
        for i in range(2, -1, -1):
            for k in range(i + 1, 3):
                X[i, c] -= L[k, i] * X[k, c]
            X[i, c] /= L[i, i]
    return X


@_compiled
def loop(
    time: Any, imu_index: Any, position_index: Any, imu: Any, positions: Any, start: Any, power: Any,
    position_noise: float, arm: Any, states: Any, covariances: Any,
) -> None:  # fmt: skip
    """`direct_eskf.run`, with the results written into `states` (n, 16) and `covariances` (n, 15, 15)."""
    p, v, q, bg, ba = start[0].copy(), start[1].copy(), start[2].copy(), start[3].copy(), start[4].copy()
    P = start[5].copy()
    g = np.array([0.0, 0.0, -9.81])
    F, H, one = np.eye(15), np.zeros((3, 15)), np.eye(15)
    for i in range(3):
        H[i, i] = 1.0
    arm_skew = -_skew(arm[0], arm[1], arm[2])
    R = position_noise**2
    reading = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    before = time[0]
    for k in range(len(time)):
        if imu_index[k] >= 0:
            reading = imu[imu_index[k]].copy()
        dt = (time[k] - before) * 1e-9
        before = time[k]

        half = _exp((reading[:3] - bg) * (0.5 * dt))
        force = reading[3:] - ba
        half_matrix = _matrix(half)
        middle = _product(_matrix(q), half_matrix)
        back = half_matrix.T.copy()
        turn = _product(_product(middle, _skew(-dt * force[0], -dt * force[1], -dt * force[2])), back)
        reset = _product(back, back)
        step = np.zeros(3)
        for i in range(3):
            step[i] = (
                middle[i, 0] * force[0] + middle[i, 1] * force[1] + middle[i, 2] * force[2] + g[i]
            ) * dt
            F[i, 3 + i] = dt
            for j in range(3):
                pulls = (turn[i, j], turn[i, j] * (-0.5 * dt), -dt * middle[i, j])
                for n in range(3):
                    F[3 + i, 6 + 3 * n + j] = pulls[n]
                    F[i, 6 + 3 * n + j] = pulls[n] * (0.5 * dt)
                F[6 + i, 6 + j] = reset[i, j]
                F[6 + i, 9 + j] = -dt * back[i, j]
        for i in range(15):
            P[i, i] += power[i] * (0.5 * dt)
        P = _product_transposed(_product(F, P), F)
        for i in range(15):
            P[i, i] += power[i] * (0.5 * dt)
        P = 0.5 * (P + P.T)
        p = p + (v + 0.5 * step) * dt
        v = v + step
        q = _multiply(q, _multiply(half, half))
        q = q / math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])

        if position_index[k] >= 0:
            rotation = _matrix(q)
            H[:, 6:9] = _product(rotation, arm_skew)
            HP = _product(H, P)
            S = _product_transposed(HP, H)
            B = np.zeros((3, 16))
            for i in range(3):
                S[i, i] += R
                across = rotation[i, 0] * arm[0] + rotation[i, 1] * arm[1] + rotation[i, 2] * arm[2]
                B[i, :15] = HP[i]
                B[i, 15] = positions[position_index[k], i] - p[i] - across
            solved = _solve(S, B)
            d = np.zeros(15)
            for j in range(15):
                for i in range(3):
                    d[j] += B[i, 15] * solved[i, j]
            turned = one.copy()
            turned[6:9, 6:9] -= _skew(0.5 * d[6], 0.5 * d[7], 0.5 * d[8])
            gain = _product(turned, solved[:, :15].T.copy())
            A = turned - _product(gain, H)
            P = _product_transposed(_product(A, P), A) + R * _product_transposed(gain, gain)
            P = 0.5 * (P + P.T)
            p, v, bg, ba = p + d[0:3], v + d[3:6], bg + d[9:12], ba + d[12:15]
            q = _multiply(q, _exp(d[6:9]))

        states[k, 0:3], states[k, 3:6], states[k, 6:10], states[k, 10:13], states[k, 13:16] = p, v, q, bg, ba
        covariances[k] = P


def run(
    time: np.ndarray,
    imu_index: np.ndarray,
    position_index: np.ndarray,
    imu: np.ndarray,
    positions: np.ndarray,
    *,
    start: tuple[np.ndarray, ...],
    densities: tuple[float, ...],
    position_noise: float,
    lever: tuple[float, ...],
) -> tuple[np.ndarray, np.ndarray]:
    """States and covariances, from the arguments of `direct_eskf.run`."""
    gyro, accelerometer, gyro_walk, accelerometer_walk = np.square(densities)
    power = np.repeat([0.0, accelerometer, gyro, gyro_walk, accelerometer_walk], 3)
    states, covariances = np.empty((len(time), 16)), np.empty((len(time), 15, 15))
    first = tuple(np.ascontiguousarray(part, float) for part in start)
    loop(
        time, imu_index, position_index, imu, positions, first, power, float(position_noise), np.array(lever),
        states, covariances,
    )  # fmt: skip
    return states, covariances
