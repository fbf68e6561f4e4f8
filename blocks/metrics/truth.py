"""The truth at the times of an estimate: interpolated where it is known, and nowhere else.

A truth may have gaps: rows that are NaN, and stamps that lie far apart, as when a motion capture lost the
body and its rows were left out. Nothing is compared across them, and `truth_remarks` counts what is left out.
"""

from __future__ import annotations

import numpy as np

from flowgraph import Series
from flowgraph.blocks.geometry.rotations import slerp
from flowgraph.data.notes import note
from flowgraph.errors import DataError

__all__ = ["interpolate", "interpolate_pose", "known", "truth_remarks", "within_truth"]

_STEPS, _SHORTEST = 3, 100_000_000  # a gap is longer than so many median steps, and than so many ns


def interpolate_pose(truth: Series, time: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The truth's position (n, 3) and attitude (n, 4) at `time` (n,) int64 ns: `interpolate` of both."""
    return interpolate(truth, "position", time), interpolate(truth, "attitude", time)


def interpolate(truth: Series, name: str, time: np.ndarray) -> np.ndarray:
    """A field of the truth at `time` (n,) int64 ns: linear, and slerp for the attitude.

    A time outside the truth gets its first or last value, and one in a gap what lies between its ends:
    `known` tells where that is no truth.
    """
    right = np.clip(np.searchsorted(truth.time, time), 1, max(len(truth) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(truth) - 1)
    span = np.maximum(truth.time[right] - truth.time[left], 1)
    part = np.clip((time - truth.time[left]) / span, 0.0, 1.0)  # integer differences: exact before dividing
    x = truth[name]
    if name == "attitude":
        return slerp(x[left], x[right], part)
    return np.asarray(x[left] + (x[right] - x[left]) * part[:, None])


def known(truth: Series, time: np.ndarray) -> np.ndarray:
    """Whether the truth covers each of `time` (n,) int64 ns.

    It does not before its first and after its last row, where its position or attitude is NaN on one side,
    and between two rows that lie farther apart than three of its median steps and a tenth of a second.
    """
    if not len(truth):
        return np.zeros(len(time), dtype=bool)
    held = np.asarray((time >= truth.time[0]) & (time <= truth.time[-1]))
    steps = np.diff(truth.time)
    if len(steps):
        wide = steps > max(_STEPS * float(np.median(steps)), _SHORTEST)
        right = np.clip(np.searchsorted(truth.time, time), 1, len(steps))
        held &= ~wide[right - 1] | (time == truth.time[right]) | (time == truth.time[right - 1])
    for name in {"position", "attitude"} & set(truth.leaves):
        if not np.isfinite(truth[name]).all():  # unknown at some time, and so between its neighbours
            held[held] = np.isfinite(interpolate(truth, name, time[held])).all(axis=-1)
    return held


def within_truth(estimate: Series, truth: Series, settle: float) -> Series:
    """The ticks of an estimate that can be compared: `settle` seconds or more after the first, where the
    truth is `known`.

    Raises:
        DataError: when there is none.
    """
    held = _settled(estimate, settle) & known(truth, estimate.time)
    chosen = estimate[_rows(held)]
    if not len(truth) or not len(chosen):
        raise DataError(
            "no tick of the estimate lies within the truth",
            path=estimate.name,
            expected=f"ticks {settle} s or more after the first, where the truth is known",
            got=f"{estimate!r}, {truth!r}",
            fix="check the time offsets, or make settle smaller",
        )
    return chosen


def truth_remarks(estimate: Series, truth: Series, settle: float) -> tuple[str, ...]:
    """Notes on what a comparison leaves out: fields that the truth does not have, and ticks in its gaps."""
    found = []
    told = {"position", "attitude"} if "attitude" in estimate.leaves else {"position", "velocity"}
    for name in sorted((told & set(estimate.leaves)) - set(truth.leaves)):
        found.append(note("skipped", f"the truth has no {name}: errors of it are left out"))
    inner = estimate.time[_settled(estimate, settle)]
    inner = inner[(inner >= truth.time[:1]) & (inner <= truth.time[-1:])] if len(truth) else inner[:0]
    left = inner[~known(truth, inner)]
    if len(left):
        span = 1e-9 * float(np.median(np.diff(inner))) * len(left)
        found.append(note("skipped", f"truth: {len(left)} ticks ({span:.3g} s) where it is not known"))
    return tuple(found)


def _settled(estimate: Series, settle: float) -> np.ndarray:
    return np.asarray(estimate.time - estimate.time[:1] >= round(settle * 1e9))


def _rows(held: np.ndarray) -> slice | np.ndarray:
    """The rows of a mask, as a slice where nothing lies between them: that copies nothing."""
    rows = np.flatnonzero(held)
    whole = len(rows) and rows[-1] - rows[0] + 1 == len(rows)
    return slice(int(rows[0]), int(rows[-1]) + 1) if whole else held
