"""Attitudes as pictures show them: angles of Euler, their deviations, and errors as a turn of the body."""

from __future__ import annotations

import numpy as np

from flowgraph.data.series import Series

NAMES = ("roll", "pitch", "yaw")


def angle_name(k: int, order: str) -> str:
    """Of roll, pitch or yaw; with the convention where it is not the usual one."""
    return NAMES[k] + (f" ({order})" if order != "zyx" else "")


def euler_angles(quaternion: np.ndarray, order: str = "zyx") -> np.ndarray:
    """(n, 3) roll, pitch and yaw in degrees of (n, 4) w, x, y, z, without jumps.

    R = Rz(yaw) Ry(pitch) Rx(roll), or for "zxy" R = Rz(yaw) Rx(roll) Ry(pitch).
    """
    w, x, y, z = quaternion.T
    if order == "zxy":
        roll = np.arcsin(np.clip(2 * (w * x + y * z), -1.0, 1.0))
        pitch = np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))
        yaw = np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
        return np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=-1), axis=0))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=-1), axis=0))


def angle_rates(quaternion: np.ndarray, order: str = "zyx") -> np.ndarray:
    """E (n, 3, 3) with d(roll, pitch, yaw) = E d(rotation vector in the body).

    It has no bound where the middle angle is 90 degrees: the pitch of "zyx", the roll of "zxy".
    """
    roll, pitch, _ = np.deg2rad(euler_angles(quaternion, order)).T
    outer, middle = (pitch, roll) if order == "zxy" else (roll, pitch)
    level = np.maximum(np.abs(np.cos(middle)), 1e-3)
    s, c, slope = np.sin(outer), np.cos(outer), np.sin(middle) / level
    one, none = np.ones_like(s), np.zeros_like(s)
    if order == "zxy":
        E = np.array([[c, none, s], [s * slope, one, -c * slope], [-s / level, none, c / level]])
    else:
        E = np.array([[one, s * slope, c * slope], [none, c, -s], [none, s / level, c / level]])
    return np.moveaxis(E, 2, 0)


def euler_variances(quaternion: np.ndarray, spread: np.ndarray, order: str = "zyx") -> np.ndarray:
    """(n, 3) variances of roll, pitch and yaw, degrees squared, from (n, 3, 3) of a turn of the body."""
    E = angle_rates(quaternion, order)
    return np.asarray(np.einsum("nij,njk,nik->ni", E, spread, E) * np.rad2deg(1.0) ** 2)


def matrices(quaternion: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotation matrices, body to world, of (n, 4) w, x, y, z."""
    w, x, y, z = quaternion.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def between(truth: Series, field: str, time: np.ndarray) -> np.ndarray:
    """A field of the truth at other times: linear (attitudes of unit length), NaN where it is not known.

    It is not known before the first and after the last row, beside a row of NaN, and in a pause of more
    than three of the truth's own steps and a tenth of a second.
    """
    right = truth[field]
    after = np.clip(np.searchsorted(truth.time, time), 1, max(len(truth) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(truth) - 1)
    a, b = right[before], right[after]
    step = truth.time[after] - truth.time[before]
    share = ((time - truth.time[before]) / np.maximum(step, 1))[:, None]
    if field == "attitude":
        b = np.where(np.sum(a * b, axis=1, keepdims=True) < 0.0, -b, b)
    there = np.where(share == 0.0, a, np.where(share == 1.0, b, a + (b - a) * share))
    if field == "attitude":
        there = there / np.linalg.norm(there, axis=1, keepdims=True)
    typical = float(np.median(np.diff(truth.time))) if len(truth) > 1 else 0.0
    inner = (share[:, 0] > 0.0) & (share[:, 0] < 1.0)
    unknown = (share[:, 0] < 0.0) | (share[:, 0] > 1.0) | (inner & (step > max(3 * typical, 1e8)))
    there[unknown] = np.nan
    return np.asarray(there)


def turn_between(truth: np.ndarray, estimate: np.ndarray) -> np.ndarray:
    """(n, 3) degrees: the rotation vector, in the body, that takes the true attitude to the estimate."""
    w, v = truth[:, :1], -truth[:, 1:]
    w2, v2 = estimate[:, :1], estimate[:, 1:]
    vector = w * v2 + w2 * v + np.cross(v, v2)
    scalar = w * w2 - np.sum(v * v2, axis=1, keepdims=True)
    vector, scalar = np.where(scalar < 0, -vector, vector), np.abs(scalar)
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    share = np.where(length > 1e-12, 2 * np.arctan2(length, scalar) / np.maximum(length, 1e-12), 2.0)
    return np.asarray(np.rad2deg(vector * share))
