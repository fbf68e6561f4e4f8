"""Whether a filter knows how wrong it is: errors, NEES, NIS, and the bands in which they belong.

An honest filter's squared error, measured by its own covariance, is chi-square distributed: with k numbers it
is k on average. The NEES does so with the state's error, for which a truth is needed; the NIS with the
innovations, for which none is. Averaged over N independent runs, N times the mean is chi-square with N k
degrees, which gives the band. For a pose the error is taken in the tangent space: position, velocity (world)
and a rotation vector (body).

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 5.4.2 (eqs. 5.4.2-3 to 5.4.2-13).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.stats import chi2

from flowgraph import Series
from flowgraph.blocks.geometry import conjugate, multiply, to_rotation_vector
from flowgraph.blocks.metrics import interpolate_pose
from flowgraph.errors import DataError

__all__ = [
    "chi_square_band",
    "chi_square_gate",
    "error_summary",
    "inside",
    "nees",
    "nis_summary",
    "point_errors",
    "state_error",
    "state_nees",
]


def chi_square_band(parts: int, *, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """The two-sided band of the mean over `runs` of a chi-square variable with `parts` degrees of freedom."""
    tail = 0.5 * (1.0 - probability)
    low, high = (float(chi2.ppf(p, parts * runs)) / runs for p in (tail, 1.0 - tail))
    return low, high


def chi_square_gate(parts: int, probability: float = 0.999) -> float:
    """The `gate` that an honest measurement of `parts` numbers passes with this probability."""
    return float(chi2.ppf(probability, parts))


def inside(values: npt.ArrayLike, band: tuple[float, float]) -> float:
    """The fraction of the values that lie in the band."""
    x = np.asarray(values)
    return float(np.mean((x >= band[0]) & (x <= band[1])))


def nees(error: npt.ArrayLike, covariance: npt.ArrayLike) -> np.ndarray:
    """The normalised estimation error squared e^T P^-1 e (...), of errors e (..., k) and P (..., k, k)."""
    e, P = np.asarray(error, dtype=float), np.asarray(covariance, dtype=float)
    return np.asarray(np.vecdot(e, np.linalg.solve(P, e[..., None])[..., 0]))


def error_summary(error: npt.ArrayLike) -> dict[str, float]:
    """`rmse`, `mean` and `max` of the length of error vectors (..., k)."""
    size = np.linalg.norm(np.asarray(error, dtype=float), axis=-1)
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
    p, q = interpolate_pose(truth, time)
    seconds, at = (truth.time - time[0]) * 1e-9, (time - time[0]) * 1e-9
    v = np.stack([np.interp(at, seconds, column) for column in truth["velocity"].T], axis=-1)
    parts = [p - position, v - velocity]
    if attitude is not None:
        apart = multiply(conjugate(attitude, xp=np), np.broadcast_to(q, attitude.shape), xp=np)
        parts.append(to_rotation_vector(apart, xp=np))
    return np.concatenate(parts, axis=-1)


def state_nees(estimate: Series, truth: Series) -> np.ndarray:
    """NEES (n,) of a series of beliefs with position, velocity, perhaps attitude, and covariance.

    The covariance is in the order of `state_error`: of `PointBelief` (6), `PoseBelief` (9), or the first nine
    of `Belief`, whose biases are left out.
    """
    attitude = estimate["attitude"] if "attitude" in estimate.leaves else None
    error = state_error(estimate.time, truth, estimate["position"], estimate["velocity"], attitude)
    k = error.shape[-1]
    return nees(error, estimate["covariance"][..., :k, :k])


def nis_summary(innovation: Series, *, probability: float = 0.95) -> dict[str, float]:
    """Whether the innovations of a run are as large as the filter expected.

    Returns:
        nis_mean, per measured number, 1 in a consistent filter; nis_low and nis_high, the band of that mean;
        nis_inside, the fraction of single values in their own band; nis_count; nis_rejected, by a gate.
    """
    values = innovation["nis"]
    width = innovation["residual"].shape[-1]
    parts = innovation["parts"] if "parts" in innovation.leaves else np.full(len(values), float(width))
    tail = 0.5 * (1.0 - probability)
    total = max(float(parts.sum()), 1.0)
    within = (values >= chi2.ppf(tail, parts)) & (values <= chi2.ppf(1.0 - tail, parts))
    accepted = innovation["accepted"] if "accepted" in innovation.leaves else np.ones(len(values), dtype=bool)
    return {
        "nis_mean": float(values.sum() / total),
        "nis_low": float(chi2.ppf(tail, total) / total),
        "nis_high": float(chi2.ppf(1.0 - tail, total) / total),
        "nis_inside": float(np.mean(within)) if len(values) else float("nan"),
        "nis_count": float(len(values)),
        "nis_rejected": float(np.sum(~accepted)),
    }


def point_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare beliefs about a point with the truth, where it covers them and after `settle` seconds.

    Returns:
        position_rmse_m, position_mean_m, position_max_m, velocity_rmse_mps, nees_mean (6 in a consistent
        filter) and compared_ticks.

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
    error = state_error(chosen.time, truth, chosen["position"], chosen["velocity"])
    place = error_summary(error[:, :3])
    return {
        **{f"position_{name}_m": value for name, value in place.items()},
        "velocity_rmse_mps": error_summary(error[:, 3:])["rmse"],
        "nees_mean": float(np.mean(nees(error, chosen["covariance"]))),
        "compared_ticks": float(len(chosen)),
    }
