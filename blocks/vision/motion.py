"""The motion of a camera on a body: what it measures, and how that is related to the body's motion.

A camera at place r in the body, turned by R_cb (camera from body), moves with

    v_c = R_cb (R^T v + w x r)        w_c = R_cb w

where v is the body's velocity in the world, R its attitude and w its angular rate in the body. The pair (v_c,
w_c) is the adjoint of the mount, applied to the body's. The rate w may be had in two ways: from the camera's
own rate, w = R_cb^T w_c (the report's eq. 9), or from the gyroscope, w = w_m - b_g (eq. 10).

Source: R. Murray, Z. Li and S. Sastry, "A Mathematical Introduction to Robotic Manipulation", 1994, sec. 2.4.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flowgraph import Array, Series
from flowgraph.blocks.geometry.rotations import skew, slerp, to_matrix
from flowgraph.blocks.vision.camera import Mount
from flowgraph.errors import DataError

__all__ = ["adjoint", "camera_motion_of", "camera_velocity", "find_delay", "velocity_error"]


def adjoint(mount: Mount) -> np.ndarray:
    """The matrix (6, 6) that makes (v_c, w_c) of the body's (R^T v, w).

    Both blocks of its diagonal are R_cb, that above is -R_cb skew(r), that below 0.
    """
    R, r = mount.rotation, mount.camera_in_body
    return np.block([[R, -R @ np.asarray(skew(r, xp=np))], [np.zeros((3, 3)), R]])


def camera_velocity(velocity: Array, R: Array, rate: Array, *, mount: Mount, xp: Any) -> Array:
    """v_c (..., 3) of the body's velocity (..., 3) in the world, attitude (..., 3, 3) and rate (..., 3).

    The first three rows of the adjoint.
    """
    A = xp.asarray(adjoint(mount)[:3], dtype=velocity.dtype)
    body = (R.mT @ velocity[..., None])[..., 0]
    return xp.concat([body, rate], axis=-1) @ A.mT


def camera_motion_of(truth: Series, time: np.ndarray, mount: Mount) -> tuple[np.ndarray, np.ndarray]:
    """(v_c, w_c) (n, 3) each that a truth with `attitude`, `velocity` and `rate` gives at times (n,) ns."""
    right = np.clip(np.searchsorted(truth.time, time), 1, len(truth) - 1)
    left = right - 1
    part = np.clip((time - truth.time[left]) / (truth.time[right] - truth.time[left]), 0.0, 1.0)
    between = lambda x: x[left] + (x[right] - x[left]) * part[:, None]
    R = np.asarray(to_matrix(slerp(truth["attitude"][left], truth["attitude"][right], part), xp=np))
    w = between(truth["rate"])
    v = camera_velocity(between(truth["velocity"]), R, w, mount=mount, xp=np)
    return np.asarray(v), w @ mount.rotation.T


def velocity_error(motion: Series, truth: Series, mount: Mount, delay: float = 0.0) -> float:
    """The root mean square of the distance between measured and true camera velocity, m/s.

    Args:
        motion: `CameraMotion`, whose stamps are `delay` seconds late.
        truth: with `attitude`, `velocity` and `rate` (body). Beside rows that are NaN nothing is compared;
            infinity, where these are all.

    Raises:
        DataError: when no stamp lies within the truth.
    """
    time = motion.time - round(delay * 1e9)
    inside = (time >= truth.time[0]) & (time <= truth.time[-1])
    if not inside.any():
        raise DataError(
            "the camera's motion and the truth do not overlap",
            path=motion.name,
            expected=f"stamps from {truth.time[0]} to {truth.time[-1]} ns",
            got=f"{motion.time[0]} to {motion.time[-1]} ns, {delay:g} s late",
            fix="check the delay",
        )
    expected, _ = camera_motion_of(truth, time[inside], mount)
    error = motion["velocity"][inside] - expected
    error = error[np.isfinite(error).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(error * error, axis=1)))) if len(error) else math.inf


def find_delay(
    motion: Series, truth: Series, mount: Mount, *, most: float = 0.2, step: float = 1e-3
) -> float:
    """How late (s, to a `step`) the camera's velocity is: where it fits the truth best, within +-`most`."""
    delays = np.arange(-round(most / step), round(most / step) + 1) * step
    return float(min(delays, key=lambda delay: velocity_error(motion, truth, mount, delay)))
