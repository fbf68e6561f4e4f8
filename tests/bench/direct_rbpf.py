"""The benchmark's peer: the Rao-Blackwellized particle filter as one hand-written NumPy loop, without
flowgraph.

The same equations, layout (particle axis last) and random numbers as `graphs/rbpf_indoor.py`, as somebody
would write them who needs this one filter only: arrays changed in place, small products spelt out. Of
flowgraph it takes the random numbers alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flowgraph.recorder.namespaces import NUMPY
from flowgraph.recorder.random import Site, seed_words

PRODUCT = np.zeros((4, 16))
"""A quaternion product as a matrix times the 16 products of the parts."""
for _row, _signs in enumerate(("+0-5-a-f", "+1+4+b-e", "+2-7+8+d", "+3+6-9+c")):
    for _sign, _place in zip(_signs[::2], _signs[1::2], strict=True):
        PRODUCT[_row, int(_place, 16)] = 1.0 if _sign == "+" else -1.0


@dataclass
class Cloud:
    """The particles' state: log weights (n), attitudes (4, n), means (3, n), covariance blocks (3, 3, n)."""

    log_weight: np.ndarray
    q: np.ndarray
    v: np.ndarray
    p: np.ndarray
    V: np.ndarray
    C: np.ndarray
    P: np.ndarray


@dataclass
class History:
    """Poses (ticks, 10) as position, velocity, attitude; at each measured pose (k): size, resampled,
    index."""

    poses: np.ndarray
    sizes: np.ndarray
    resampled: np.ndarray
    index: np.ndarray


def run(
    time: np.ndarray,
    imu_index: np.ndarray,
    pose_index: np.ndarray,
    imu: np.ndarray,
    poses: np.ndarray,
    *,
    start: Cloud,
    seed: int,
    gyro_noise: float,
    accelerometer_noise: float,
    position_noise: float,
    attitude_noise: float,
    resample_below: float,
    still: float = 0.0,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
) -> History:
    """Filter a whole flight: every tick predicts with the latest IMU sample, a tick with a pose also updates.

    Args:
        time: (ticks,) int64 ns: all times of either sensor, as `direct_eskf.ticks` gives them.
        imu_index, pose_index: (ticks,) row of `imu` or `poses` that arrives at each tick, -1 for none.
        imu: (m, 6) gyro in rad/s and specific force in m/s^2, body.
        poses: (k, 7) position in m and attitude, world.
        start: the cloud at the first tick; not changed.
        gyro_noise, accelerometer_noise: densities; position_noise, attitude_noise: standard deviations.
        resample_below: as a fraction of the particles; systematic resampling.
        still: seconds at the start whose mean reading, less gravity upwards (`up`), is the bias.
    """
    cloud = Cloud(*(np.array(field) for field in vars(start).values()))
    n = cloud.log_weight.shape[0]
    words = seed_words(seed)
    gyro_site = Site("rbpf_indoor.attitude/gyro", "normal", (3, n))
    place_site = Site("rbpf_indoor.resample/place", "uniform", (1,))
    g = np.array(gravity)[:, None]
    level = np.concatenate([np.zeros(3), 9.81 * np.array(up)])
    out = History(
        np.empty((len(time), 10)),
        np.empty(len(poses)),
        np.empty(len(poses), bool),
        np.empty((len(poses), n), np.int32),
    )
    bias, count, first = np.zeros(6), 0, None
    reading = last = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81])
    before = int(time[0])
    k = 0
    for tick in range(len(time)):
        now = int(time[tick])
        dt = (now - before) * 1e-9
        before = now
        if imu_index[tick] >= 0:
            reading = imu[imu_index[tick]]
            if still > 0.0:
                first = now if first is None else first
                if now - first <= round(still * 1e9):
                    count += 1
                    bias = bias + (reading - level - bias) / count
                reading = reading - bias

        errors = gyro_site.numbers(now, words, xp=NUMPY)
        drive, last = 0.5 * (last + reading), reading
        predict(cloud, drive, errors, dt, gyro_noise, accelerometer_noise, g)
        if pose_index[tick] >= 0:
            update(cloud, poses[pose_index[tick]], position_noise, attitude_noise)
        weight = np.exp(cloud.log_weight)
        out.poses[tick, 0:3], out.poses[tick, 3:6] = cloud.p @ weight, cloud.v @ weight
        M = (cloud.q * weight) @ cloud.q.T
        for _ in range(5):
            M = M @ M
        mean = M @ cloud.q[:, 0]
        parts = M.diagonal()
        if mean @ mean <= 1e-6 * (parts @ parts):
            mean = M[:, parts.argmax()]
        out.poses[tick, 6:10] = mean / math.sqrt(mean @ mean)
        if pose_index[tick] >= 0:
            out.sizes[k] = 1.0 / (weight @ weight)
            out.resampled[k] = out.sizes[k] < resample_below * n
            out.index[k] = np.arange(n)
            if out.resampled[k]:
                out.index[k] = systematic(weight, float(place_site.numbers(now, words, xp=NUMPY)[0]))
                for name, field in vars(cloud).items():
                    setattr(cloud, name, field[..., out.index[k]])
                cloud.log_weight[:] = -math.log(n)
            k += 1
    return out


def predict(
    cloud: Cloud,
    reading: np.ndarray,
    errors: np.ndarray,
    dt: float,
    sigma: float,
    density: float,
    g: np.ndarray,
) -> None:
    """Turn each particle by the rate and a drawn error; then its Kalman prediction."""
    u = reading[:3, None] * (0.5 * dt) + errors * (0.5 * sigma * math.sqrt(dt))
    half = np.sqrt(np.maximum(np.sum(u * u, axis=0), 1e-30))
    u *= np.sin(half) / half
    turn = np.concatenate([np.cos(half)[None], u])
    q = PRODUCT @ (cloud.q[:, None] * turn).reshape(16, -1)
    cloud.q = q / np.sqrt(np.sum(q * q, axis=0))

    step = rotate(cloud.q, reading[3:]) + g
    step *= dt
    cloud.p += (cloud.v + 0.5 * step) * dt
    cloud.v += step
    power = density**2
    drifted = cloud.V * dt
    drifted += cloud.C
    cloud.P += (drifted + cloud.C.transpose(1, 0, 2)) * dt
    cloud.C = drifted
    for i in range(3):
        cloud.V[i, i] += power * dt
        cloud.C[i, i] += power * (0.5 * dt * dt)
        cloud.P[i, i] += power * (dt * dt * dt / 3.0)


def rotate(q: np.ndarray, f: np.ndarray) -> np.ndarray:
    """R(q) f (3, n) for one vector f: f + 2 w (v x f) + 2 v x (v x f), as f's matrix times q q^T."""
    a, b, c = f.tolist()
    w, x, y, z = q
    side = np.array([[0.0, 0.0, c, -b], [0.0, -c, 0.0, a], [0.0, b, -a, 0.0]]) @ q  # v x f
    along = a * x + b * y + c * z
    out = side * w
    out += q[1:] * along
    out *= 2.0
    out += f[:, None] * (w * w - x * x - y * y - z * z)
    return out


def update(cloud: Cloud, pose: np.ndarray, position_noise: float, attitude_noise: float) -> None:
    """Kalman update with the position; weights by the likelihood of position and attitude."""
    a, b, c, d = pose[3:].tolist()
    relative = np.array([[a, b, c, d], [b, -a, -d, c], [c, d, -a, -b], [d, -c, b, -a]]) @ cloud.q  # q^-1 * z
    sine = np.sqrt(np.sum(relative[1:] ** 2, axis=0))
    angle = 2.0 * np.arctan2(sine, np.abs(relative[0]))
    log_weight = cloud.log_weight - 0.5 * (angle / attitude_noise) ** 2

    r = position_noise**2
    e = pose[:3, None] - cloud.p
    S = cloud.P.copy()
    for i in range(3):
        S[i, i] += r
    adjoint = np.empty_like(S)
    for i in range(3):
        for j in range(i, 3):
            i1, i2, j1, j2 = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            adjoint[i, j] = S[i1, j1] * S[i2, j2] - S[i1, j2] * S[i2, j1]
            adjoint[j, i] = adjoint[i, j]
    determinant = np.sum(S[0] * adjoint[0], axis=0)
    inverse = adjoint / determinant
    u = np.einsum("ijn,jn->in", inverse, e)
    cloud.v += np.einsum("ijn,in->jn", cloud.C, u)
    cloud.p += np.einsum("ijn,jn->in", cloud.P, u)
    solved = np.einsum("ijn,jkn->ikn", inverse, cloud.C)
    V = cloud.V - np.einsum("jin,jkn->ikn", cloud.C, solved)
    P = r * np.einsum("ijn,jkn->ikn", inverse, cloud.P)
    cloud.V = 0.5 * (V + V.transpose(1, 0, 2))
    cloud.C = r * solved
    cloud.P = 0.5 * (P + P.transpose(1, 0, 2))

    log_weight -= 0.5 * (np.sum(e * u, axis=0) + np.log(determinant))
    log_weight -= log_weight.max()
    cloud.log_weight = log_weight - math.log(np.sum(np.exp(log_weight)))


def systematic(weight: np.ndarray, u: float) -> np.ndarray:
    """Systematic resampling on weights rounded to multiples of 2^-38, as the graph does it."""
    parts = np.floor(weight * 2.0**38 + 0.5).astype(np.int64)
    ends = np.cumsum(parts)
    n, total = len(parts), int(ends[-1])
    places = (np.arange(n) * total + math.floor(u * total)) // n
    return np.searchsorted(ends, places, side="right")
