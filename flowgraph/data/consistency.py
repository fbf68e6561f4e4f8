"""Whether the innovations of a run are as large as its filter expected: a sentence where they are not.

The normalised innovation squared (NIS) of a filter that is told the truth about its noise is chi-square
distributed, with as many degrees of freedom as a measurement has numbers: divided by these it is 1 on
average. One that is far from 1 says that the noise, a clock, the start or a sensor is not as told. It must
not stand as a number among others, so commands and pages say it by this one judgement.

Source: Y. Bar-Shalom, X. Li, T. Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001,
sec. 5.4.2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.notes import note
from flowgraph.data.series import Series

__all__ = ["chi_square", "far_nis", "measured"]

IN_A_ROW = 5
"""Innovations in a row, taken in or refused, that are more than chance."""

FAR, APART, FEW, CHANCE = 4.0, 1.5, 20, 1e-6
"""By which factor a NIS per number is far from 1 over a few innovations, or below it, and above it over a
whole run; how many innovations such a mean is of at least; how rarely an honest filter has as large a one."""


def chi_square(probability: npt.ArrayLike, parts: npt.ArrayLike) -> np.ndarray:
    """What a chi-square variable with `parts` degrees of freedom stays below with this probability."""
    from scipy.special import gammaincinv  # slow to import, and only gates and scores need it

    return np.asarray(
        2.0 * gammaincinv(0.5 * np.asarray(parts, dtype=float), np.asarray(probability, dtype=float))
    )


def measured(stream: str) -> str:
    """Of what a stream of innovations is, as its name says; empty where there is one kind."""
    return stream.removesuffix("innovation").rstrip("_")


def far_nis(name: str, innovation: Series) -> tuple[str, ...]:
    """A note where the NIS of a run is far from 1; none where it is not, or too little was measured.

    It is where its mean over `IN_A_ROW` innovations that were taken in is more than `FAR`, and more than
    chance allows; or, over all of them, if these are `FEW` or more, above `APART` or below 1 / `FAR`.

    Args:
        name: of what was measured; empty where there is one kind.
        innovation: with `nis`, and as far as it has them `residual` (n, k), `parts` (how many of the k
            numbers were measured) and `accepted` (by a gate).
    """
    leaves: dict[str, Any] = dict(innovation.leaves)
    values = np.asarray(leaves["nis"], dtype=float)
    width = float(np.shape(leaves["residual"])[-1]) if "residual" in leaves else 1.0
    parts = np.asarray(leaves.get("parts", np.full(len(values), width)), dtype=float)
    taken = np.isfinite(values) & (parts > 0.0)
    if "accepted" in leaves:
        taken &= leaves["accepted"]
    values, parts, time = values[taken], parts[taken], innovation.time[taken]
    if not len(values):
        return ()
    front = f"{name}: " if name else ""
    mean = float(values.sum() / parts.sum())
    size = min(IN_A_ROW, len(values))
    sums, numbers = (np.convolve(x, np.ones(size), "valid") for x in (values, parts))
    beyond = np.flatnonzero(sums > np.maximum(FAR * numbers, chi_square(1.0 - CHANCE, numbers)))
    if len(beyond):
        since = (int(time[beyond[0]]) - int(innovation.time[0])) * 1e-9
        said = (
            f"{front}the NIS is far from 1, from {since:.3g} s after the first on: up to"
            f" {(sums / numbers).max():.3g} a number over {size} innovations, {mean:.3g} over all;"
            " the noise, the clock, the start or the sensor is not as told"
        )
        return (note("warning", said),)
    total = float(parts.sum())
    if len(values) >= FEW and mean > max(APART, float(chi_square(1.0 - CHANCE, total)) / total):
        why = "the noise is told too small, or a clock is off"
        return (note("warning", f"{front}the NIS is far from 1: {mean:.3g} a number; {why}"),)
    if mean < 1.0 / FAR and len(values) >= FEW:
        said = f"{front}the NIS is far from 1: {mean:.3g} a number; the noise is told too large"
        return (note("warning", said),)
    return ()
