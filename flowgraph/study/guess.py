"""A first guess of how far the clocks of two sensors are apart: by what both see of the motion.

Two streams that tell how fast a body turns, a gyroscope and attitudes, or how it is accelerated, an
accelerometer and positions, tell the same of it up to their axes, so their sizes |w| or |f| rise and fall
together. They are brought to one grid of times, made equally smooth, and shifted until they agree best.

Source: J. Kelly and G. Sukhatme, "A general framework for temporal calibration of multiple proprioceptive
and exteroceptive sensors", Experimental Robotics, 2014 (by the size of the turning rate).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flowgraph.data.series import Flight, Series

__all__ = ["Guess", "guess_offset"]

_STEP = 0.005  # s, of the grid
_SMOOTH = 0.45  # s, over which a position is taken for a parabola
_LEAST = 0.5
"""Correlation below which two streams are not said to agree."""

_UP = np.array([0.0, 0.0, 9.81])
Signal = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Guess:
    """What a correlation says.

    Args:
        offset: s, to be added to the stamps.
        correlation: of the two then, from -1 to 1.
        by: what was compared.
    """

    offset: float
    correlation: float
    by: str

    @property
    def sure(self) -> bool:
        """Whether they agree well enough to begin there."""
        return self.correlation >= _LEAST


def guess_offset(flight: Flight, stream: str, low: float, high: float) -> Guess | None:
    """The offset between `low` and `high` (s) at which a stream agrees best with any other of the flight.

    None where no two streams tell of the same.
    """
    found = []
    for name, other in flight.streams.items():
        if name == stream or not {"gyro", "specific_force"} & set(other.leaves):
            continue
        for by, told in (("turning rates", _turning), ("accelerations", _pushed)):
            a, b = told(flight.streams[stream]), told(other)
            if a is not None and b is not None:
                found.append(_best(a, b, low, high, f"{by} of {stream} and {name}"))
    known = [g for g in found if g is not None]
    return max(known, key=lambda g: g.correlation, default=None)


def _turning(series: Series) -> Signal | None:
    """|w| (n,) with times in s: of a gyroscope, or of attitudes from each to the next."""
    leaves, t = series.leaves, series.time * 1e-9
    for name in ("gyro", "rate"):
        if name in leaves and leaves[name].shape[1:] == (3,):
            return t, np.linalg.norm(leaves[name], axis=1)
    if "attitude" not in leaves or len(t) < 3:
        return None
    q = leaves["attitude"]
    turn = 2.0 * np.arccos(np.clip(np.abs(np.sum(q[1:] * q[:-1], axis=1)), -1.0, 1.0))
    return 0.5 * (t[1:] + t[:-1]), turn / np.diff(t)


def _pushed(series: Series) -> Signal | None:
    """|f| (n,) with times in s: of an accelerometer, or of positions with gravity added."""
    leaves, t = series.leaves, series.time * 1e-9
    for name in ("specific_force", "force"):
        if name in leaves and leaves[name].shape[1:] == (3,):
            return _parabola(t, leaves[name], 0)
    if "position" not in leaves or leaves["position"].shape[1:] != (3,):
        return None
    return _parabola(t, leaves["position"], 2)


def _parabola(t: np.ndarray, x: np.ndarray, order: int) -> Signal:
    """|x| or |x'' - g| in the middle of windows, each fitted by a parabola; where a window is full enough."""
    middles = np.arange(t[0] + _SMOOTH, t[-1] - _SMOOTH, 4 * _STEP)
    half = 0.5 * _SMOOTH
    at, sizes = [], []
    usual = float(np.median(np.diff(t)))
    for middle in middles:
        a, b = np.searchsorted(t, [middle - half, middle + half])
        s = (t[a:b] - middle) / half
        if b - a < max(5, 0.8 * _SMOOTH / usual) or s[0] > -0.7 or s[-1] < 0.7:
            continue
        weight = (1.0 - s * s)[:, None]
        if order == 0:  # what an acceleration becomes when its second integral is fitted so
            kernel = weight**2
            value = np.sum(kernel * x[a:b], axis=0) / np.sum(kernel)
        else:
            A = np.stack([np.ones_like(s), s, s * s], axis=1)
            fitted = np.linalg.lstsq(A, x[a:b], rcond=None)[0]
            value = 2.0 * fitted[2] / half**2 + _UP
        at.append(middle)
        sizes.append(float(np.linalg.norm(value)))
    return np.array(at), np.array(sizes)


def _best(a: Signal, b: Signal, low: float, high: float, by: str) -> Guess | None:
    """The shift of a with the largest correlation, refined by a parabola through three."""
    (ta, xa), (tb, xb) = a, b
    if len(ta) < 20 or len(tb) < 20:
        return None
    shifts = np.arange(low, high + _STEP / 2, _STEP)
    found = np.full(len(shifts), -1.0)
    step = float(np.median(np.diff(tb)))
    for k, shift in enumerate(shifts):
        t = ta + shift
        after = np.clip(np.searchsorted(tb, t), 1, len(tb) - 1)
        whole = (t >= tb[0]) & (t <= tb[-1]) & (tb[after] - tb[after - 1] < 3.0 * step)
        if whole.sum() < 20:
            continue
        x, y = xa[whole], np.interp(t[whole], tb, xb)
        if x.std() > 0.0 and y.std() > 0.0:
            found[k] = np.corrcoef(x, y)[0, 1]
    k = int(found.argmax())
    offset = float(shifts[k])
    if 0 < k < len(shifts) - 1 and found[k - 1] > -1.0 and found[k + 1] > -1.0:
        left, middle, right = found[k - 1 : k + 2]
        bend = left - 2.0 * middle + right
        offset += _STEP * 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return Guess(offset, float(found[k]), by)
