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

STUCK, STUCK_S, AXIS, OFTEN, STEP = 5, 0.2, 4, 0.05, 0.2
"""How many times in a row, and for how many seconds, a reading is repeated by a sensor that is stuck, and how
many times as long by one axis of it; what part of the others may be repeated where that is not the usual way;
and by how much of a usual step it jumps into that and out of it, which one that is at rest does not."""

BLOCK, ALONE, ASIDE = 32, 40.0, 0.2
"""Over how many readings a usual difference is told; how many times that a spike is off from the mean of
those beside it; and how far these are from each other at most, by how far it is off."""

RATE, SPAN, STEPS, CERTAIN = 0.004, 1.0, 20, 7.0
"""By how much of itself a rate has changed; over how many s, and steps at least, it is told; and how many
deviations of a mean that must be, too."""

LEAP, ALIKE, MOST = 1.3, 0.1, 0.9
"""By which factor a rate has leapt, where this part of the blocks on each side is as near to their own."""

_TOLD, _LEAST, _WIDE = ("covariance", "deviation", "interval"), 3, 9
"""What a reading tells of itself; of how many numbers a reading is whose noise never repeats all of them,
and which no list is. (A speed of 0 at rest, an angle that goes round, a limit are single numbers.)"""


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
        if leaf.dtype.kind == "f" and not name.endswith(_TOLD) and _LEAST <= leaf[:1].size <= _WIDE
    }
    t = (series.time - series.time[0]) * 1e-9
    said = [
        sentence
        for name, leaf in values.items()
        for judged in (_stuck, _spikes)
        for sentence in judged(series.name, name, leaf, t)
    ]
    return (*said, *(_leap(series.name, t) or _rate(series.name, t)))


def _stuck(name: str, leaf: str, values: np.ndarray, t: np.ndarray) -> tuple[str, ...]:
    told, which, why = _still(values, t, STUCK, STUCK_S), leaf, "a sensor that is stuck"
    if told is None and not leaf.endswith("attitude"):  # of a body that turns about one axis, others rest
        for axis, column in enumerate(values.T[..., None]):
            found = _still(column, t, AXIS * STUCK, AXIS * STUCK_S)
            if found is not None and found[0] > 0.0:  # what rests from the start on has not begun to move
                told, which, why = found, f"{leaf}[{axis}]", "an axis that is stuck or at its limit"
                break
    if told is None:
        return ()
    begins, lasts, count = told
    often = "" if count == 1 else f", {count} times in all"
    when = f"from {begins:.3g} s after the first on{often}"
    said = f"{name}: the same {which} for {lasts:.3g} s, {when}, which its other readings never have: {why}"
    return (note("warning", said),)


def _still(values: np.ndarray, t: np.ndarray, least: int, seconds: float) -> tuple[float, float, int] | None:
    """When the longest of the rows of repeated readings begins, how long it lasts, and how many there are."""
    again = np.all(values[1:] == values[:-1], axis=-1) & (np.diff(t) > 0.0)
    steps = np.linalg.norm(np.diff(values, axis=0), axis=-1)
    moving = steps[np.isfinite(steps) & (steps > 0.0)]
    edges = np.diff(np.concatenate([[0], again, [0]]).astype(int))
    first, last = np.flatnonzero(edges > 0), np.flatnonzero(edges < 0)
    if not len(first) or len(moving) < STUCK:
        return None
    around = np.concatenate([[np.inf], steps, [np.inf]])  # the steps into a row and out of it
    jumps = np.fmin(around[first], around[last + 1]) >= STEP * np.median(moving)
    long = (last - first >= least) & (t[last] - t[first] >= seconds) & jumps
    others = len(again) - int((last - first)[long].sum())
    if not long.any() or int((last - first)[~long].sum()) > OFTEN * others:
        return None
    longest = int(np.argmax(np.where(long, t[last] - t[first], 0.0)))
    return float(t[first[longest]]), float(t[last[longest]] - t[first[longest]]), int(long.sum())


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
             f" up to {far:.2g} usual differences: spikes or jolts"),
    )  # fmt: skip


def _leap(name: str, t: np.ndarray) -> tuple[str, ...]:
    steps = np.diff(t)
    steps = steps[steps > 0.0]
    if len(steps) < 6 * STEPS:
        return ()
    usual = np.log(np.median(steps[: len(steps) // STEPS * STEPS].reshape(-1, STEPS), axis=-1))
    count = np.arange(1, len(usual))
    sums = np.cumsum(usual)[:-1]
    apart = np.abs((usual.sum() - sums) / (len(usual) - count) - sums / count)
    k = 3 + int(np.argmax(apart[2:-2]))
    before, after = usual[:k], usual[k:]
    near = [np.mean(np.abs(x - np.median(x)) < ALIKE) >= MOST for x in (before, after)]
    old, new = np.median(before), np.median(after)
    if not all(near) or abs(new - old) < np.log(LEAP):
        return ()
    since = t[min(k * STEPS, len(t) - 1)]
    return _another_rate(name, np.exp(-new), since, np.exp(-old))


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
    return _another_rate(name, 1.0 / after[k], since, 1.0 / before[k])


def _another_rate(name: str, now: float, since: float, before: float) -> tuple[str, ...]:
    said = f"{name}: comes at {now:.4g} Hz from about {since:.2g} s after the first on, at {before:.4g} Hz"
    return (note("warning", f"{said} before: a clock or a rate that changed"),)
