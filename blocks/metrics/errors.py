"""How good an estimate is: errors against the truth, and whether the filter knew how large they would be.

Position errors are in metres, velocity errors in m/s; attitude errors geodesic, in degrees, with tilt and
heading apart. Where there is a covariance, the NEES, the squared error in deviations of the filter's own,
tells whether it is honest; see `consistency`. For a pose it is taken in the tangent space: position, velocity
(world) and a rotation vector (body), nine numbers. What the truth does not have is left out of the figures.

Source of the NEES: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and
Navigation", 2001, sec. 5.4.2.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph import Series
from flowgraph.blocks.geometry.euler import angles_from_quaternion, wrapped
from flowgraph.blocks.geometry.rotations import (
    conjugate,
    geodesic_angle,
    multiply,
    tilt_and_heading,
    to_matrix,
    to_rotation_vector,
)
from flowgraph.blocks.metrics.chi_square import chi_square_band, inside
from flowgraph.blocks.metrics.terms import FIGURES, attitude_terms, place_terms, turn_error
from flowgraph.blocks.metrics.truth import interpolate, interpolate_pose, within_truth

__all__ = [
    "attitude_errors",
    "error_summary",
    "interpolate",
    "interpolate_pose",
    "nees",
    "nees_summary",
    "orientation_errors",
    "plane_errors",
    "pose_errors",
    "state_error",
    "tilt_and_heading_nees",
    "within_truth",
]


def error_summary(error: npt.ArrayLike) -> dict[str, float]:
    """`rmse`, `mean` and `max` of the length of error vectors (..., k), or of angles (n,)."""
    size = np.abs(np.asarray(error, dtype=float))
    size = np.linalg.norm(size, axis=-1) if size.ndim > 1 else size
    return {
        "rmse": float(np.sqrt(np.mean(np.square(size)))),
        "mean": float(np.mean(size)),
        "max": float(np.max(size)),
    }


def state_error(
    time: np.ndarray, truth: Series, position: np.ndarray, velocity: np.ndarray, attitude: np.ndarray | None =
    None
) -> np.ndarray:  # fmt: skip
    """The errors (..., n, 6 or 9) of estimates at n times: position, velocity, and attitude where it is
    given.

    The error is that of the truth from the estimate: p_true - p, v_true - v, Log(q^-1 q_true).

    Args:
        time: (n,) int64 ns.
        truth: with fields position, velocity and attitude; interpolated.
        position, velocity: (..., n, 3).
        attitude: (..., n, 4).
    """
    p = interpolate(truth, "position", time)
    parts = [p - position, _true_velocity(truth, time) - velocity]
    if attitude is not None:
        q = interpolate(truth, "attitude", time)
        parts.append(turn_error(attitude, np.broadcast_to(q, attitude.shape), np))
    return np.concatenate(parts, axis=-1)


def nees(error: npt.ArrayLike, covariance: npt.ArrayLike) -> np.ndarray:
    """The normalised estimation error squared e^T P^-1 e (...), of errors e (..., k) and P (..., k, k).

    Where a P is singular, which claims that something is known exactly, only the rest counts.
    """
    e, P = np.asarray(error, dtype=float), np.asarray(covariance, dtype=float)
    try:
        weighed = np.linalg.solve(P, e[..., None])[..., 0]
    except np.linalg.LinAlgError:
        weighed = (np.linalg.pinv(P, hermitian=True) @ e[..., None])[..., 0]
    return np.asarray(np.vecdot(e, weighed))


def nees_summary(error: npt.ArrayLike, covariance: npt.ArrayLike) -> dict[str, float]:
    """Whether errors (n, k) are as large as their covariances (n, k, k) say.

    Returns:
        nees_mean, k in a consistent filter; nees_low and nees_high, the 95 % band of a single tick; and
        nees_inside, the fraction of ticks in it. (Neighbouring ticks err alike, so the mean of one run
        scatters more than one of as many independent ticks: for a sharp test average over runs.)
    """
    values = nees(error, covariance)
    band = chi_square_band(np.shape(error)[-1])
    return {
        "nees_mean": float(np.mean(values)),
        "nees_low": band[0],
        "nees_high": band[1],
        "nees_inside": inside(values, band),
    }


def pose_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare an estimate with the truth at the estimate's times, where the truth covers them.

    Args:
        estimate: with fields `position` and `attitude`, perhaps `velocity`, and perhaps the `covariance` of
            a `Belief` or `PoseBelief`.
        truth: with fields `position` and `attitude`, or one of them, and perhaps `velocity`.
        settle: seconds after the estimate's first tick that are left out.

    Returns:
        position_rmse_m and attitude_rmse_deg, each with mean and max; tilt_rmse_deg, heading_rmse_deg,
        velocity_rmse_mps where both have one, and compared_ticks (how many); with a covariance also
        position_3sigma and tilt_3sigma, the fraction of errors within three standard deviations over all axes
        (99.7 % when the filter is honest), heading_3sigma, and the nine numbers' `nees_summary`.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    chosen = within_truth(estimate, truth, settle)
    has, whole = set(truth.leaves), "covariance" in chosen.leaves and chosen["covariance"].shape[-1] >= 9
    moving = "velocity" in has and "velocity" in chosen.leaves
    P = chosen["covariance"][:, :9, :9] if whole else None
    terms: dict[str, np.ndarray] = {}
    parts = []
    if "position" in has:
        error = chosen["position"] - interpolate(truth, "position", chosen.time)
        terms |= place_terms(error, None if P is None else P[:, :3, :3], np)
        parts.append(-error)
    if moving:
        speed = chosen["velocity"] - _true_velocity(truth, chosen.time)
        terms |= place_terms(speed, None, np, of="velocity")
        parts.append(-speed)
    if "attitude" in has:
        attitude = interpolate(truth, "attitude", chosen.time)
        terms |= attitude_terms(chosen["attitude"], attitude, None if P is None else P[:, 6:9, 6:9], np)
        parts.append(turn_error(chosen["attitude"], attitude, np))
    found = _figures(terms)
    if P is not None and len(parts) == 3:
        found.update(nees_summary(np.concatenate(parts, axis=-1), P))
    return found | {"compared_ticks": float(len(chosen))} if parts else {}


def _figures(terms: Mapping[str, np.ndarray]) -> dict[str, float]:
    """Those of `FIGURES` whose terms (n,) there are."""
    reduced: dict[str, Callable[[np.ndarray], Any]] = {"mean": np.mean, "root": _rms, "most": np.max}
    return {name: float(reduced[how](terms[term])) for name, term, how in FIGURES if term in terms}


def plane_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare `PlaneBelief`s with the truth, where it covers them and after `settle` seconds.

    Returns:
        position_rmse_m, position_mean_m, position_max_m, the `nees_summary` (2 on average in a consistent
        filter) and compared_ticks.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    if "position" not in truth.leaves:
        return {}
    chosen = within_truth(estimate, truth, settle)
    error = interpolate(truth, "position", chosen.time) - chosen["position"]
    return {
        **{f"position_{name}_m": value for name, value in error_summary(error).items()},
        **nees_summary(error, chosen["covariance"]),
        "compared_ticks": float(len(chosen)),
    }


def attitude_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare attitudes with the truth, at ticks that it covers, `settle` seconds after the first on.

    Returns:
        attitude_rmse_deg (geodesic) with mean and max, tilt_rmse_deg, heading_rmse_deg, attitude_end_deg
        (geodesic, at the last tick), compared_ticks and the figures of `orientation_errors`; with a
        covariance (3, 3) also tilt_3sigma, heading_3sigma and the `nees_summary` of its three numbers.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    if "attitude" not in truth.leaves:
        return {}
    chosen = within_truth(estimate, truth, settle)
    q, attitude = chosen["attitude"], interpolate(truth, "attitude", chosen.time)
    P = chosen["covariance"] if "covariance" in chosen.leaves else None
    found = {
        **_figures(attitude_terms(q, attitude, P, np)),
        **_axes_and_parts(q, attitude),
        "attitude_end_deg": float(geodesic_angle(q[-1:], attitude[-1:])[0]),
        "compared_ticks": float(len(chosen)),
    }
    if P is not None:
        found.update(nees_summary(turn_error(q, attitude, np), P))
    return found


def _true_velocity(truth: Series, time: np.ndarray) -> np.ndarray:
    """The truth's velocity (n, 3), interpolated."""
    seconds, at = (truth.time - time[0]) * 1e-9, (time - time[0]) * 1e-9
    return np.stack([np.interp(at, seconds, column) for column in truth["velocity"].T], axis=-1)


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
    if "attitude" not in truth.leaves:
        return {}
    chosen = within_truth(estimate, truth, settle)
    q = interpolate(truth, "attitude", chosen.time)
    return {**_axes_and_parts(chosen["attitude"], q), "compared_ticks": float(len(chosen))}


def tilt_and_heading_nees(estimate: Series, truth: Series) -> tuple[np.ndarray, np.ndarray]:
    """The squared errors of tilt and of heading, each (n,), in deviations of the filter's own.

    Of an honest filter they are chi-square with two degrees of freedom and with one, whose medians are 1.39
    and 0.45.

    Args:
        estimate: with `attitude` and `covariance`, whose first three rows and columns are those of a rotation
            vector in the body, rad.
        truth: as in `orientation_errors`.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    chosen = within_truth(estimate, truth, 0.0)
    q, true = chosen["attitude"], interpolate(truth, "attitude", chosen.time)
    turn = np.radians(tilt_and_heading(q, true)[1])
    back = np.stack([np.cos(turn / 2), 0.0 * turn, 0.0 * turn, -np.sin(turn / 2)], axis=-1)
    whole = multiply(q, conjugate(true, xp=np), xp=np)
    tilt = np.asarray(to_rotation_vector(multiply(whole, back, xp=np), xp=np))[:, :2]
    R = to_matrix(q, xp=np)
    P = R @ chosen["covariance"][:, :3, :3] @ R.transpose(0, 2, 1)
    return nees(tilt, P[:, :2, :2]), turn**2 / P[:, 2, 2]


def _axes_and_parts(estimate: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    a, b = (np.asarray(angles_from_quaternion(x, order="zyx", xp=np)) for x in (estimate, truth))
    apart = wrapped(a - b)
    tilt, heading = tilt_and_heading(estimate, truth)
    return {
        **{f"{n}_rmse_rad": _rms(apart[:, k]) for k, n in enumerate(("roll", "pitch", "yaw"))},
        "total_rmse_deg": _rms(geodesic_angle(estimate, truth)),
        "heading_rmse_deg": _rms(heading),
        "inclination_rmse_deg": _rms(tilt),
    }


def _rms(x: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
