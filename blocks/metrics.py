"""How good an estimate is: errors against the truth, and whether the filter knew how large they would be.

Position errors are root mean squares in metres; attitude errors geodesic, in degrees, with tilt and heading
apart.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry import geodesic_angle, slerp, tilt_and_heading, to_matrix, world_error
from flowgraph.errors import DataError

__all__ = ["euler_angles", "interpolate_pose", "orientation_errors", "pose_errors"]


def interpolate_pose(truth: Series, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth's position (n, 3) and attitude (n, 4) at `time` (n,) int64 ns: linear and slerp.

    A time outside the truth gets its first or last value.
    """
    right = np.clip(np.searchsorted(truth.time, time), 1, max(len(truth) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(truth) - 1)
    span = np.maximum(truth.time[right] - truth.time[left], 1)
    part = np.clip((time - truth.time[left]) / span, 0.0, 1.0)  # integer differences: exact before dividing
    p, q = truth["position"], truth["attitude"]
    position = p[left] + (p[right] - p[left]) * part[:, None]
    return position, slerp(q[left], q[right], part)


def pose_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare an estimate with the truth at the estimate's times, where the truth covers them.

    Args:
        estimate: with fields `position` and `attitude`, and perhaps the `covariance` of a `Belief`.
        truth: with fields `position` and `attitude`; where they are NaN, nothing is compared.
        settle: seconds after the estimate's first tick that are left out.

    Returns:
        position_rmse_m, attitude_rmse_deg, tilt_rmse_deg, heading_rmse_deg, compared_ticks (how many);
        with a covariance also position_3sigma and tilt_3sigma, the fraction of errors within three standard
        deviations over all axes (99.7 % when the filter is honest), and heading_3sigma.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    chosen = estimate[estimate.time - estimate.time[:1] >= round(settle * 1e9)]
    if len(truth):
        chosen = chosen[(chosen.time >= truth.time[0]) & (chosen.time <= truth.time[-1])]
    if not len(truth) or not len(chosen):
        raise DataError(
            "no tick of the estimate lies within the truth",
            path=estimate.name,
            expected=f"ticks {settle} s or more after the first, between the truth's first and last time",
            got=f"{estimate!r}, {truth!r}",
            fix="check the time offsets, or make settle smaller",
        )
    position, attitude = interpolate_pose(truth, chosen.time)
    known = np.isfinite(position).all(axis=-1) & np.isfinite(attitude).all(axis=-1)
    if not known.all():  # the truth has gaps
        chosen, position, attitude = chosen[known], position[known], attitude[known]
    error = chosen["position"] - position
    tilt, heading = tilt_and_heading(chosen["attitude"], attitude)
    found = {
        "position_rmse_m": _rms(np.linalg.norm(error, axis=-1)),
        "attitude_rmse_deg": _rms(geodesic_angle(chosen["attitude"], attitude)),
        "tilt_rmse_deg": _rms(tilt),
        "heading_rmse_deg": _rms(heading),
        "compared_ticks": float(len(chosen)),
    }
    if "covariance" in chosen.leaves and chosen["covariance"].shape[-1] >= 9:
        P = chosen["covariance"]
        R = to_matrix(chosen["attitude"], xp=np)
        in_world = R @ P[:, 6:9, 6:9] @ R.mT
        turn = world_error(chosen["attitude"], attitude)
        sigma = np.sqrt(np.einsum("nii->ni", in_world))
        inside = np.abs(turn) <= 3.0 * sigma
        at = np.sqrt(np.einsum("nii->ni", P[:, :3, :3]))
        found["position_3sigma"] = float(np.mean(np.abs(error) <= 3.0 * at))
        found["tilt_3sigma"] = float(np.mean(inside[:, :2]))
        found["heading_3sigma"] = float(np.mean(inside[:, 2]))
    return found


def euler_angles(attitude: np.ndarray) -> np.ndarray:
    """Roll, pitch and yaw (..., 3) in rad of attitudes (..., 4): R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = np.asarray(to_matrix(attitude, xp=np))
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    pitch = np.arctan2(-R[..., 2, 0], np.hypot(R[..., 2, 1], R[..., 2, 2]))
    return np.stack([roll, pitch, np.arctan2(R[..., 1, 0], R[..., 0, 0])], axis=-1)


def orientation_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare attitudes with the truth, at the estimate's times that it covers.

    Args:
        estimate: with the field `attitude`.
        truth: with the field `attitude`; where an attitude is NaN, or one of the two on both sides of a time
            is, there is no truth.
        settle: seconds after the estimate's first tick that are left out.

    Returns:
        roll_rmse_rad, pitch_rmse_rad and yaw_rmse_rad, of the differences of Euler angles, each wrapped into
        (-pi, pi]; total_rmse_deg, heading_rmse_deg and inclination_rmse_deg, of the geodesic angle and its
        parts (`tilt_and_heading`); compared_ticks.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    chosen = estimate[estimate.time - estimate.time[:1] >= round(settle * 1e9)]
    if len(truth):
        chosen = chosen[(chosen.time >= truth.time[0]) & (chosen.time <= truth.time[-1])]
        right = np.clip(np.searchsorted(truth.time, chosen.time), 1, max(len(truth) - 1, 1))
        left = right - 1
        right = np.minimum(right, len(truth) - 1)
        part = (chosen.time - truth.time[left]) / np.maximum(truth.time[right] - truth.time[left], 1)
        q = slerp(truth["attitude"][left], truth["attitude"][right], part)
        known = np.isfinite(q).all(axis=-1)
        chosen, q = chosen[known], q[known]
    if not len(truth) or not len(chosen):
        raise DataError(
            "no tick of the estimate lies within the truth",
            path=estimate.name,
            expected=f"ticks {settle} s or more after the first, where the truth knows the attitude",
            got=f"{estimate!r}, {truth!r}",
            fix="check the time offsets, or make settle smaller",
        )
    apart = euler_angles(chosen["attitude"]) - euler_angles(q)
    wrapped = np.pi - np.remainder(np.pi - apart, 2.0 * np.pi)
    tilt, heading = tilt_and_heading(chosen["attitude"], q)
    return {
        **{f"{n}_rmse_rad": _rms(wrapped[:, k]) for k, n in enumerate(("roll", "pitch", "yaw"))},
        "total_rmse_deg": _rms(geodesic_angle(chosen["attitude"], q)),
        "heading_rmse_deg": _rms(heading),
        "inclination_rmse_deg": _rms(tilt),
        "compared_ticks": float(len(chosen)),
    }


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
