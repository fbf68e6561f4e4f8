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

from types import SimpleNamespace

import numpy as np

from flowgraph import Series
from flowgraph.blocks.metrics.chi_square import chi_square
from flowgraph.blocks.metrics.errors import error_summary, nees, nees_summary, state_error
from flowgraph.blocks.metrics.terms import nis_limits, nis_terms
from flowgraph.blocks.metrics.truth import interpolate, within_truth
from flowgraph.data.consistency import CHANCE, FEW, IN_A_ROW, far_nis
from flowgraph.data.notes import note
from flowgraph.recorder.namespaces import NUMPY

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
    width = innovation["residual"].shape[-1]
    terms = nis_terms(SimpleNamespace(**innovation.leaves), nis_limits(width, probability), NUMPY)
    sums = {name: float(np.sum(getattr(terms, name))) for name in terms._fields}
    tail, total = 0.5 * (1.0 - probability), max(sums["parts"], 1.0)
    found = {
        "nis_mean": sums["nis"] / total,
        "nis_low": float(chi_square(tail, total) / total),
        "nis_high": float(chi_square(1.0 - tail, total) / total),
        "nis_inside": sums["inside"] / sums["count"] if sums["count"] else float("nan"),
        "nis_count": sums["count"],
    }
    if "accepted" in innovation.leaves:
        found["nis_rejected"] = sums["rejected"]
    return found


ALIKE, RUN_ALIKE, SIGMAS = 1.0, 0.3, 7.0
"""From which product of one innovation and the next on, a number and in their deviations, they are alike over
`FEW` and over a whole run; and how many deviations of chance that must be, too."""

MANY, LEANING, RARELY = 40, 0.6, 1e-9
"""Over how many innovations their mean is looked at; from how many of their deviations on it is not 0; and
how rarely an honest filter has so large a one."""


def nis_remarks(name: str, innovation: Series, *, loose: bool = False) -> tuple[str, ...]:
    """Notes where a gate refused too many measurements, the NIS is far from 1, or innovations are alike.

    A gate refused too many where `IN_A_ROW` or more come in a row, or where chance hardly refuses as many.

    What is far from 1 is said in `flowgraph.data.consistency`.

    Innovations of an honest filter know nothing of each other (R. Mehra, "On the identification of variances
    and adaptive Kalman filtering", IEEE TAC 15(2), 1970). Where what is left of one is left of the next too,
    something lasts that the filter does not know, though each alone may be small: a clock that is off, a
    start that was too sure, a lever.

    Args:
        name: of what was measured; empty where there is one kind.
        loose: whether the filter is one that expects larger innovations than honest ones, which may be alike.
    """
    far = far_nis(name, innovation)
    alike = () if far or loose else _alike(name, innovation)
    return (*(_refused(name, innovation) or _too_often(name, innovation)), *far, *alike)


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


def _too_often(name: str, innovation: Series) -> tuple[str, ...]:
    if "accepted" not in innovation.leaves or innovation["accepted"].all():
        return ()
    from scipy.special import gammainc, gammaincc  # slow to import, and only scores need them

    values, parts, judged = _judged(innovation)
    refused = judged & ~innovation["accepted"]
    if not refused.any():
        return ()
    rare = np.sort(gammaincc(0.5 * parts[refused], 0.5 * values[refused]))
    counts, usual = np.arange(1, len(rare) + 1), rare * float(judged.sum())
    chances = gammainc(counts, usual)  # of as many, where so many are usual
    k = int(chances.argmin())  # some that are far off are no better for one beside them that is not
    if len(rare) * chances[k] >= CHANCE:
        return ()
    front, some = f"{name}: " if name else "", "" if k + 1 == len(rare) else f" as {k + 1} of them"
    said = f"{front}{len(rare)} of {judged.sum()} measurements; chance has {usual[k]:.2g} as far off{some}"
    return (note("refused", said),)


def _judged(innovation: Series) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The nis and the number of parts of each, and which say anything."""
    values, width = innovation["nis"], float(innovation["residual"].shape[-1])
    parts = innovation["parts"] if "parts" in innovation.leaves else np.full(len(values), width)
    return values, parts, np.isfinite(values) & (parts > 0.0)


def _whitened(innovation: Series) -> np.ndarray:
    """The residuals (n, m) in their own deviations, S^(-1/2) r; 0 where nothing was measured."""
    size, axes = np.linalg.eigh(innovation["covariance"])
    along = (np.swapaxes(axes, -1, -2) @ innovation["residual"][..., None])[..., 0]
    known = size > 1e-12 * size[:, -1:]
    scaled = np.where(known, along / np.sqrt(np.where(known, size, 1.0)), 0.0)
    return np.asarray((axes @ scaled[..., None])[..., 0])


def _alike(name: str, innovation: Series) -> tuple[str, ...]:
    if "covariance" not in innovation.leaves:
        return ()
    _, parts, taken = _judged(innovation)
    if "accepted" in innovation.leaves:
        taken &= innovation["accepted"]
    if taken.sum() <= FEW:
        return ()
    parts, time, white = parts[taken], innovation.time[taken], _whitened(innovation[taken])
    front = f"{name}: " if name else ""
    why = "something lasts that the filter does not know: a clock that is off, too sure a start, a lever"

    def said(what: str, row: int | None, size: float) -> tuple[str, ...]:
        since = (
            ""
            if row is None
            else f", from {(time[row] - innovation.time[0]) * 1e-9:.3g} s after the first on"
        )
        return (note("warning", f"{front}{what}{since}: {size:.2g} a number, where 0 is right; {why}"),)

    products, numbers = np.sum(white[1:] * white[:-1], axis=-1), np.sqrt(parts[1:] * parts[:-1])
    sums, of = (np.convolve(x, np.ones(FEW), "valid") for x in (products, numbers))
    here = np.flatnonzero(sums / of > np.maximum(ALIKE, SIGMAS / np.sqrt(of)))
    if len(here):
        return said("one innovation is like the next", int(here[0]), float((sums / of).max()))
    whole, total = float(products.sum() / numbers.sum()), float(numbers.sum())
    if whole > max(RUN_ALIKE, SIGMAS / np.sqrt(total)):
        return said("one innovation is like the next", None, whole)
    if len(white) >= MANY:
        leaning = np.apply_along_axis(np.convolve, 0, white, np.ones(MANY), "valid")
        most = np.convolve(parts, np.ones(MANY) / MANY, "valid")
        square = np.sum(leaning**2, axis=-1) / MANY
        here = np.flatnonzero(square > np.maximum(LEANING**2 * MANY * most, chi_square(1.0 - RARELY, most)))
        if len(here):
            size = float(np.sqrt(square / most / MANY).max())
            return said(f"the mean of {MANY} innovations is not 0", int(here[0]), size)
    return ()


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
