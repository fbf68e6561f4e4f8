"""What readings show of their own sensor, before any filter: that it is stuck, spikes, or a clock changes.

A filter that expects no size of what it corrects by cannot tell a bad reading from a good one, but the
reading often can: noise never repeats itself, no body jumps away and back between two readings, and a clock
does not change its rate. Each judgement compares a stream with itself, so that no unit and no noise is asked
for; what a whole recording does throughout is taken for its usual way.
"""

from __future__ import annotations

import numpy as np

from flowgraph.data.notes import note
from flowgraph.data.series import Series

__all__ = ["suspect_readings"]

STUCK, STUCK_S, OFTEN = 5, 0.2, 0.05
"""How many times in a row, and for how many seconds, a reading is repeated by a sensor that is stuck; what
part of the others may be repeated where that is not the usual way."""

BLOCK, ALONE, ASIDE = 32, 30.0, 0.2
"""Over how many readings a usual difference is told; how many times that a spike is off from the mean of
those beside it; and how far these are from each other at most, by how far it is off."""

RATE, SPAN, STEPS, CERTAIN = 0.004, 1.0, 20, 7.0
"""By how much of itself a rate has changed; over how many s, and steps at least, it is told; and how many
deviations of a mean that must be, too."""

_TOLD, _WIDE = ("covariance", "deviation", "interval"), 9
"""What a reading tells of itself; of how many numbers a reading is, which a list is not."""


def suspect_readings(series: Series) -> tuple[str, ...]:
    """Notes on a stream: readings that repeat, readings that stand alone, and a rate that changes.

    Where its usual way is one of these (a barometer that is read more often than it measures) nothing is
    said of that.
    """
    if len(series) < STUCK + 2:
        return ()
    values = {
        name: leaf.reshape(len(leaf), -1)
        for name, leaf in series.leaves.items()
        if leaf.dtype.kind == "f" and not name.endswith(_TOLD) and leaf[:1].size <= _WIDE
    }
    if not values:
        return ()
    t = (series.time - series.time[0]) * 1e-9
    spiked = [said for name, leaf in values.items() for said in _spikes(series.name, name, leaf, t)]
    return (*_stuck(series.name, np.hstack(list(values.values())), t), *spiked, *_rate(series.name, t))


def _stuck(name: str, values: np.ndarray, t: np.ndarray) -> tuple[str, ...]:
    again = np.all(values[1:] == values[:-1], axis=-1) & (np.diff(t) > 0.0)
    edges = np.diff(np.concatenate([[0], again, [0]]).astype(int))
    first, last = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    long = (last - first >= STUCK) & (t[last] - t[first] >= STUCK_S) if len(first) else np.zeros(0, bool)
    others = len(again) - int((last - first)[long].sum())
    if not long.any() or int((last - first)[~long].sum()) > OFTEN * others or others < STUCK:
        return ()
    longest = int(np.argmax(np.where(long, t[last] - t[first], 0.0)))
    begins, lasts = t[first[longest]], t[last[longest]] - t[first[longest]]
    often = "" if long.sum() == 1 else f", {long.sum()} times in all"
    return (
        note("warning", f"{name}: the same reading for {lasts:.3g} s, from {begins:.3g} s after the first on"
             f"{often}, though no two others are alike: a sensor that is stuck"),
    )  # fmt: skip


def _spikes(name: str, leaf: str, values: np.ndarray, t: np.ndarray) -> tuple[str, ...]:
    if leaf.endswith("attitude") or len(values) < 2 * BLOCK:
        return ()
    off = np.linalg.norm(values[1:-1] - 0.5 * (values[2:] + values[:-2]), axis=-1)
    apart = np.linalg.norm(values[2:] - values[:-2], axis=-1)
    blocks = np.array_split(off, len(off) // BLOCK)
    usual = np.array([np.nanmedian(b) if np.isfinite(b).any() else np.nan for b in blocks])
    around = np.fmax(usual, np.fmax(np.append(usual[1:], usual[-1]), np.append(usual[0], usual[:-1])))
    scale = np.repeat(around, [len(b) for b in blocks])
    alone = (scale > 0.0) & (off > ALONE * scale) & (apart < ASIDE * off)
    if not alone.any():
        return ()
    row = int(np.argmax(alone))
    far = float((off[alone] / scale[alone]).max())
    what = f"{name}: readings of {leaf} stand alone, {alone.sum()} of them"
    return (
        note("warning", f"{what}, from {t[row + 1]:.3g} s after the first on: off from those beside them by"
             f" up to {far:.2g} usual differences: spikes"),
    )  # fmt: skip


def _rate(name: str, t: np.ndarray) -> tuple[str, ...]:
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    usual = float(np.median(steps)) if len(steps) else 0.0
    steps = steps[(steps > 0.5 * usual) & (steps < 1.5 * usual)]
    each = max(STEPS, round(SPAN / usual)) if usual > 0.0 else 0
    if not each or len(steps) < 6 * each:
        return ()
    means = steps[: len(steps) // each * each].reshape(-1, each).mean(axis=-1)
    count = np.arange(1, len(means))
    before = np.cumsum(means)[:-1] / count
    after = (means.sum() - np.cumsum(means)[:-1]) / (len(means) - count)
    chance = np.median(np.abs(np.diff(means))) / 0.6745 / np.sqrt(2.0)
    certain = np.abs(after - before) / np.sqrt(1.0 / count + 1.0 / (len(means) - count))
    inner = slice(1, -1)
    k = 1 + int(np.argmax(certain[inner]))
    change = abs(after[k] - before[k])
    if change <= RATE * usual or certain[k] <= CERTAIN * chance:
        return ()
    since = (k + 1) * each * usual
    return (
        note("warning", f"{name}: comes at {1.0 / after[k]:.4g} Hz from about {since:.2g} s after the first"
             f" on, at {1.0 / before[k]:.4g} Hz before: a clock or a rate that changed"),
    )  # fmt: skip
