"""Alignment in motion: the attitude at a time, of which nothing was known, by positions that were measured after.

Seen from the body as it was at the start, the unit tells how the specific force went on: C(t) f(t), with the
turn C(t) since then. Twice integrated that is where the body went, but for gravity, the velocity it had, and
the attitude it had, which is one rotation for all:

    p(t) - gravity t^2/2 = p0 + v0 t + R0 s(t)        s(t) = integral of integral of C f

What p0 and v0 do is linear and falls out of both sides; R0 then is the rotation that takes one set of vectors
into the other (Wahba's problem), with no guess to start from. From there least squares find attitude, velocity
and the unit's biases together, and say how sure they are. A body that only stands or moves steadily shows its
tilt in this way, and no heading.

Source: Y. Wu, X. Pan, "Velocity/position integration formula part I: application to in-flight coarse alignment",
IEEE Trans. on Aerospace and Electronic Systems 49(2), 2013; G. Wahba, SIAM Review 7(3), 1965.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, to_matrix
from flowgraph.blocks.signals import Belief

__all__ = ["Motion", "align_moving"]

_STEPS = 15  # of Gauss and Newton, at most


class Motion(NamedTuple):
    """What an alignment in motion found, as a belief at its start, and how well it fits.

    Args:
        belief: position, velocity, attitude and biases at the first position, with their covariance.
        heading: rad, the deviation of the heading alone.
        residual: m, root mean square an axis.
    """

    belief: Belief
    heading: float
    residual: float


def align_moving(
    imu: Series,
    position: Series,
    *,
    gravity: tuple[float, float, float],
    seconds: float,
    noise: float,
    force: float = 0.3,
    rate: float = 0.02,
) -> Motion | None:
    """The motion at the first of the positions, by those of so many seconds; None where there are fewer than five,
    or readings do not surround them.

    Args:
        imu: a series of `Imu`. position: of a signal with `position`, m.
        gravity: in the world, m/s^2.
        noise: m, what a position may be off by what is not modelled: their own noise, and that of readings.
        force, rate: m/s^2 and rad/s, deviations of the unit's biases.
    """
    first = position.time[0]
    fixes = position[position.time <= first + round(seconds * 1e9)]
    readings = imu[imu.time >= first]
    if len(fixes) < 5 or not len(readings) or readings.time[-1] < fixes.time[-1]:
        return None
    readings = readings[: int(np.searchsorted(readings.time, fixes.time[-1])) + 1]
    at = (readings.time - first) * 1e-9
    steps = np.diff(at, prepend=0.0)
    t = (fixes.time - first) * 1e-9
    z = fixes["position"]
    gyro, pushed = readings["gyro"], readings["specific_force"]

    def course(gyro_bias: np.ndarray, force_bias: np.ndarray) -> np.ndarray:
        """s (k, 3) at the times of the fixes."""
        turns = _turned(np.asarray(from_rotation_vector((gyro - gyro_bias) * steps[:, None], xp=np)))
        before = np.concatenate([[[1.0, 0.0, 0.0, 0.0]], turns[:-1]])
        push = (to_matrix(before, xp=np) @ (pushed - force_bias)[..., None])[..., 0]
        push = 0.5 * (push + (to_matrix(turns, xp=np) @ (pushed - force_bias)[..., None])[..., 0])
        speed = np.cumsum(push * steps[:, None], axis=0)
        early = np.concatenate([np.zeros((1, 3)), speed[:-1]])
        place = np.cumsum((early + 0.5 * push * steps[:, None]) * steps[:, None], axis=0)
        return np.stack([np.interp(t, np.r_[0.0, at], np.r_[0.0, column]) for column in place.T], axis=-1)

    s = course(np.zeros(3), np.zeros(3))
    line = np.stack([np.ones_like(t), t], axis=-1)
    free = z - 0.5 * np.asarray(gravity) * t[:, None] ** 2
    projector = np.eye(len(t)) - line @ np.linalg.pinv(line)
    u, _, vt = np.linalg.svd((projector @ free).T @ (projector @ s))
    R = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    q = _quaternion(R)
    p0, v0 = np.linalg.lstsq(line, free - s @ R.T, rcond=None)[0]
    x = np.concatenate([p0, v0, np.zeros(9)])
    prior = np.concatenate([np.full(3, rate), np.full(3, force)])

    def residual(x: np.ndarray, q: np.ndarray) -> np.ndarray:
        turned = np.asarray(multiply(q, from_rotation_vector(x[6:9], xp=np), xp=np))
        away = free - x[:3] - t[:, None] * x[3:6] - course(x[9:12], x[12:15]) @ to_matrix(turned, xp=np).T
        return np.concatenate([away.ravel() / noise, x[9:15] / prior])

    damping = 1.0
    r = residual(x, q)
    J = np.zeros((len(r), 15))
    for _ in range(_STEPS):
        J = _jacobian(lambda y, q=q: residual(y, q), x, r)  # type: ignore[misc]
        A, g = J.T @ J, J.T @ r
        moved = x - np.linalg.solve(A + damping * 1e-3 * np.diag(np.diag(A)), g)
        new = residual(moved, q)
        if new @ new <= r @ r:
            done = r @ r - new @ new < 1e-4 * (r @ r)
            q = np.asarray(multiply(q, from_rotation_vector(moved[6:9], xp=np), xp=np))
            x = np.concatenate([moved[:6], np.zeros(3), moved[9:]])
            r, damping = new, damping * 0.1
            if done:
                break
        else:
            damping *= 10.0
    off = r[:-6] * noise
    worse = max(1.0, float(np.sqrt(np.sum(off**2) / max(len(off) - 9, 1))) / noise)
    P = np.linalg.inv(J.T @ J + 1e-12 * np.eye(15)) * worse**2
    up = to_matrix(q, xp=np)[2]
    return Motion(
        Belief(
            position=x[:3],
            velocity=x[3:6],
            attitude=q,
            gyro_bias=x[9:12],
            accelerometer_bias=x[12:15],
            covariance=0.5 * (P + P.T),
        ),
        float(np.sqrt(up @ P[6:9, 6:9] @ up)),
        float(np.sqrt(np.mean(off**2))),
    )


def _turned(steps: np.ndarray) -> np.ndarray:
    """The products (n, 4) of the first k of n quaternions, for every k."""
    found, reach = steps, 1
    while reach < len(found):
        found = np.concatenate([found[:reach], np.asarray(multiply(found[:-reach], found[reach:], xp=np))])
        reach *= 2
    return found


def _jacobian(function, x: np.ndarray, at: np.ndarray) -> np.ndarray:  # type: ignore[no-untyped-def]
    """By differences, a column a number."""
    J = np.empty((len(at), len(x)))
    for k in range(len(x)):
        step = np.zeros_like(x)
        step[k] = 1e-5
        J[:, k] = (function(x + step) - at) / 1e-5
    return J


def _quaternion(R: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # slow to import, and only a start needs it

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([w, x, y, z])
