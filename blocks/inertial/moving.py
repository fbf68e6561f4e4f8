"""Alignment in motion: the attitude at a time, of which nothing was known, by positions that were measured
after.

Seen from the body as it was at the start, the unit tells how the specific force went on: C(t) f(t), with the
turn C(t) since then. Twice integrated that is where the body went, but for gravity, the velocity it had, and
the attitude it had, which is one rotation for all:

    p(t) - gravity t^2/2 = p0 + v0 t + R0 s(t)        s(t) = integral of integral of C f

What p0 and v0 do is linear and falls out of both sides; R0 then is the rotation that takes one set of vectors
into the other (Wahba's problem), with no guess to start from. From there least squares find attitude,
velocity and the unit's biases together, and say how sure they are. A body that only stands or moves steadily
shows its tilt in this way, and no heading.

Source: Y. Wu, X. Pan, "Velocity/position integration formula part I: application to in-flight coarse
alignment", IEEE Trans. on Aerospace and Electronic Systems 49(2), 2013; G. Wahba, SIAM Review 7(3), 1965.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import from_rotation_vector, multiply, skew, to_matrix
from flowgraph.blocks.signals import Belief

__all__ = ["Motion", "align_moving"]

_STEPS = 15  # of Gauss and Newton, at most
_LOST = 0.7  # rad, of a heading that is no guess for more
_VAGUE = np.diag([0.0] * 6 + [3.0 / np.pi**2] * 3 + [0.0] * 6)  # of an attitude of which nothing is known


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
    noise: float,
    least: float = 4.0,
    longest: float = 60.0,
    sure: float = 0.2,
    force: float = 0.3,
    rate: float = 0.02,
) -> Motion | None:
    """The motion at the first of the positions, by those of the seconds after it: of `least` at first, and
    of half as many more again and again until the heading is known to `sure`, which what was found before is
    the guess for.

    Args:
        imu: a series of `Imu`. position: of a signal with `position`, m.
        gravity: in the world, m/s^2.
        noise: m, what a position may be off by what is not modelled: their own noise, and that of readings.
        least, longest: s, how much of the recording is looked at.
        sure: rad, the deviation of the heading that is good enough.
        force, rate: m/s^2 and rad/s, deviations of the unit's biases.

    Returns:
        None where there are fewer than five positions with readings around them.
    """
    first = position.time[0]
    readings = imu[imu.time >= first]
    fixes = position[np.isfinite(position["position"]).all(axis=-1)]
    if not len(readings) or not len(fixes):
        return None
    fixes = fixes[(fixes.time >= first) & (fixes.time <= readings.time[-1])]
    if len(fixes) < 5:
        return None
    ends = (fixes.time - first) * 1e-9
    seconds = max(least, float(ends[4]))
    found: Motion | None = None
    while True:
        part = fixes[ends <= seconds + 1e-6]
        fit = _Fit(readings, part, gravity, noise, np.repeat([rate, force], 3))
        if found is None or found.heading > _LOST:
            guesses = fit.guesses(8 if seconds > 2.0 * least or found is not None else 1)
        else:
            guesses = [found.belief]
        found = min((fit.solved(guess) for guess in guesses), key=lambda motion: motion.residual)
        if (found.heading <= sure and seconds >= 2.0 * least) or seconds >= min(longest, ends[-1]):
            return found
        seconds = min(1.5 * seconds, longest, float(ends[-1]))


class _Fit:
    """Positions of some seconds, and what readings have to say of them."""

    def __init__(
        self, imu: Series, position: Series, gravity: tuple[float, ...], noise: float, prior: np.ndarray
    ) -> None:
        first = position.time[0]
        imu = imu[: int(np.searchsorted(imu.time, position.time[-1])) + 1]
        self.at = (imu.time - first) * 1e-9
        self.steps = np.diff(self.at, prepend=0.0)[:, None]
        self.gyro, self.force = imu["gyro"], imu["specific_force"]
        self.t = (position.time - first) * 1e-9
        self.line = np.stack([np.ones_like(self.t), self.t], axis=-1)
        self.free = position["position"] - 0.5 * np.asarray(gravity) * self.t[:, None] ** 2
        self.noise, self.prior = noise, prior

    def course(self, gyro_bias: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """s (k, 3) at the times of the positions, and how it hangs on the accelerometer's bias (k, 3, 3)."""
        turns = _turned(np.asarray(from_rotation_vector((self.gyro - gyro_bias) * self.steps, xp=np)))
        C = to_matrix(turns, xp=np)
        C = 0.5 * (C + np.concatenate([np.eye(3)[None], C[:-1]]))
        push = np.concatenate([(C @ self.force[..., None])[..., 0], C.reshape(-1, 9)], axis=-1)
        speed = np.cumsum(push * self.steps, axis=0)
        early = np.concatenate([np.zeros((1, 12)), speed[:-1]])
        place = np.cumsum((early + 0.5 * push * self.steps) * self.steps, axis=0)
        at = np.concatenate([[0.0], self.at])
        found = np.stack([np.interp(self.t, at, np.concatenate([[0.0], x])) for x in place.T], axis=-1)
        return found[:, :3], found[:, 3:].reshape(-1, 3, 3)

    def guesses(self, headings: int) -> list[Belief]:
        """The rotation by Wahba's problem; and turned about the vertical, where gyroscope biases have hidden
        what the motion has to say of the heading."""
        s, _ = self.course(np.zeros(3))
        projector = np.eye(len(self.t)) - self.line @ np.linalg.pinv(self.line)
        u, _, vt = np.linalg.svd((projector @ self.free).T @ (projector @ s))
        q = _quaternion(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
        found = []
        for k in range(headings):
            about_z = from_rotation_vector(np.array([0.0, 0.0, 2.0 * np.pi * k / headings]), xp=np)
            turned = np.asarray(multiply(about_z, q, xp=np))
            away = self.free - s @ to_matrix(turned, xp=np).T
            p0, v0 = np.linalg.lstsq(self.line, away, rcond=None)[0]
            found.append(Belief(p0, v0, turned, np.zeros(3), np.zeros(3), np.eye(15)))
        return found

    def residual(self, b: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """What is left of the positions and of the biases, in deviations; and what came of the readings."""
        s, B = self.course(b.gyro_bias)
        s = s - B @ b.accelerometer_bias
        left = self.free - b.position - self.t[:, None] * b.velocity - s @ to_matrix(b.attitude, xp=np).T
        biases = np.concatenate([b.gyro_bias, b.accelerometer_bias])
        return np.concatenate([left.ravel() / self.noise, biases / self.prior]), s, B

    def jacobian(self, b: Belief, r: np.ndarray, s: np.ndarray, B: np.ndarray) -> np.ndarray:
        """Of the residual, by the error of the belief; by a gyroscope bias in differences."""
        R, k = to_matrix(b.attitude, xp=np), len(self.t)
        J = np.zeros((len(r), 15))
        J[: 3 * k, :3] = np.tile(-np.eye(3), (k, 1))
        J[: 3 * k, 3:6] = (-self.t[:, None, None] * np.eye(3)).reshape(-1, 3)
        J[: 3 * k, 6:9] = (R @ skew(s, xp=np)).reshape(-1, 3)
        J[: 3 * k, 12:15] = (R @ B).reshape(-1, 3)
        J[: 3 * k] /= self.noise
        for axis in range(3):
            bias = b.gyro_bias + 1e-5 * np.eye(3)[axis]
            J[:, 9 + axis] = (self.residual(b.replace(gyro_bias=bias))[0] - r) / 1e-5
        J[3 * k :, 9:15] = np.diag(1.0 / self.prior)
        return J

    def solved(self, b: Belief) -> Motion:
        """The most likely motion near a guess (Levenberg and Marquardt)."""
        damping = 1.0
        r, s, B = self.residual(b)
        J = self.jacobian(b, r, s, B)
        for _ in range(_STEPS):
            A = J.T @ J + _VAGUE
            d = -np.linalg.solve(A + damping * 1e-3 * np.diag(np.diag(A)), J.T @ r)
            moved = b.replace(
                position=b.position + d[:3],
                velocity=b.velocity + d[3:6],
                attitude=np.asarray(multiply(b.attitude, from_rotation_vector(d[6:9], xp=np), xp=np)),
                gyro_bias=b.gyro_bias + d[9:12],
                accelerometer_bias=b.accelerometer_bias + d[12:],
            )
            new, s, B = self.residual(moved)
            if new @ new > r @ r:
                damping *= 10.0
                continue
            done = r @ r - new @ new < 1e-3 * (r @ r)
            b, r, damping = moved, new, damping * 0.1
            J = self.jacobian(b, r, s, B)
            if done:
                break
        off = r[:-6] * self.noise
        more = max(1.0, float(np.sqrt(off @ off / max(len(off) - 9, 1))) / self.noise)
        P = np.linalg.inv(J.T @ J / more**2 + _VAGUE)
        up = to_matrix(b.attitude, xp=np)[2]
        return Motion(
            b.replace(covariance=0.5 * (P + P.T)),
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


def _quaternion(R: np.ndarray) -> np.ndarray:
    """The unit quaternion of a rotation matrix."""
    from scipy.spatial.transform import Rotation  # slow to import, and only a start needs it

    x, y, z, w = Rotation.from_matrix(R).as_quat()
    return np.array([w, x, y, z])
