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

from flowgraph import Series
from flowgraph.blocks.metrics.chi_square import chi_square
from flowgraph.blocks.metrics.errors import error_summary, nees, nees_summary, state_error
from flowgraph.blocks.metrics.truth import interpolate, within_truth
from flowgraph.data.consistency import IN_A_ROW, far_nis
from flowgraph.data.notes import note

__all__ = ["nis_remarks", "nis_summary", "point_errors", "state_nees"]


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
        nis_inside, the fraction of single values in their own band; nis_count; and, where the innovations say
        what a gate `accepted`, nis_rejected.
    """
    if "parts" in innovation.leaves:
        innovation = innovation[innovation["parts"] > 0.0]  # where nothing was measured, nothing was said
    values = innovation["nis"]
    width = innovation["residual"].shape[-1]
    parts = innovation["parts"] if "parts" in innovation.leaves else np.full(len(values), float(width))
    tail = 0.5 * (1.0 - probability)
    total = max(float(parts.sum()), 1.0)
    within = (values >= chi_square(tail, parts)) & (values <= chi_square(1.0 - tail, parts))
    found = {
        "nis_mean": float(values.sum() / total),
        "nis_low": float(chi_square(tail, total) / total),
        "nis_high": float(chi_square(1.0 - tail, total) / total),
        "nis_inside": float(np.mean(within)) if len(values) else float("nan"),
        "nis_count": float(len(values)),
    }
    if "accepted" in innovation.leaves:
        found["nis_rejected"] = float(np.sum(~innovation["accepted"]))
    return found


def nis_remarks(name: str, innovation: Series) -> tuple[str, ...]:
    """Notes where a gate refused `IN_A_ROW` measurements or more in a row, and where the NIS is far from 1.

    What is far from 1 is said in `flowgraph.data.consistency`.

    Args:
        name: of what was measured; empty where there is one kind.
    """
    return (*_refused(name, innovation), *far_nis(name, innovation))


def _refused(name: str, innovation: Series) -> tuple[str, ...]:
    if "accepted" not in innovation.leaves:
        return ()
    edges = np.diff(np.concatenate([[0], ~innovation["accepted"], [0]]).astype(int))
    first = np.flatnonzero(edges > 0)
    rows = np.flatnonzero(edges < 0) - first
    if not len(rows) or rows.max() < IN_A_ROW:
        return ()
    k = int(rows.argmax())
    seconds = (innovation.time[first[k]] - innovation.time[0]) * 1e-9
    what = f"{name}: " if name else ""
    said = (
        f"{what}{rows[k]} measurements in a row, from {seconds:.3g} s after the first on; {rows.sum()} in all"
    )
    return (note("refused", said),)


def point_errors(estimate: Series, truth: Series, *, settle: float = 1.0) -> dict[str, float]:
    """Compare beliefs about a point with the truth, where it covers them and after `settle` seconds.

    Returns:
        position_rmse_m, position_mean_m, position_max_m, velocity_rmse_mps, the `nees_summary` (6 on average
        in a consistent filter) and compared_ticks; of the position alone where the truth has no velocity.

    Raises:
        DataError: when no tick of the estimate lies within the truth.
    """
    if "position" not in truth.leaves:
        return {}
    chosen = within_truth(estimate, truth, settle)
    if "velocity" not in truth.leaves:
        off = interpolate(truth, "position", chosen.time) - chosen["position"]
        place = {f"position_{name}_m": value for name, value in error_summary(off).items()}
        return place | {"compared_ticks": float(len(chosen))}
    error = state_error(chosen.time, truth, chosen["position"], chosen["velocity"])
    return {
        **{f"position_{name}_m": value for name, value in error_summary(error[:, :3]).items()},
        "velocity_rmse_mps": error_summary(error[:, 3:])["rmse"],
        **nees_summary(error, chosen["covariance"]),
        "compared_ticks": float(len(chosen)),
    }
