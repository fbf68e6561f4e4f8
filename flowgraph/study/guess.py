"""A first guess of how far the clocks of two sensors are apart: by what both see of the motion.

Two streams that tell how fast a body turns, a gyroscope and attitudes, or how it is accelerated, an
accelerometer and positions, tell the same of it up to their axes, so their sizes |w| or |f| rise and fall
together. They are brought to one grid of times, made equally smooth, and shifted until they agree best.

The size of a force hardly changes where a body is pushed aside, since gravity is most of it. Where sizes do
not agree, a unit with a gyroscope is compared by the vectors: its forces, carried by the gyroscope to the
axes of one moment, are what the positions tell, turned, for some seconds until the gyroscope has drifted.
Less their means, which takes gravity away, they correlate as the best turn has it.

Sources: J. Kelly and G. Sukhatme, "A general framework for temporal calibration of multiple proprioceptive
and exteroceptive sensors", Experimental Robotics, 2014 (by the size of the turning rate); W. Kabsch, "A
solution for the best rotation to relate two sets of vectors", Acta Crystallographica A32, 1976.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from flowgraph.data.flight import Flight
from flowgraph.data.series import Series

__all__ = ["Guess", "guess_offset"]

_STEP = 0.005  # s, of the grid
_SMOOTH = 0.45  # s, over which a position is taken for a parabola
_LEAST = 0.5
"""Correlation below which two streams are not said to agree."""

_PIECE, _LONGEST = 6.0, 1.5  # s: with one turn; over which a slow position is taken for a parabola
_SAMPLES = 7  # of a position, at least, in a parabola
_LEAST_TURNED = 0.8  # as _LEAST, where a turn was fitted

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
    if not any(g.sure for g in known):
        known += _by_vectors(flight, stream, low, high)
    return max(known, key=lambda g: g.correlation, default=None)


def _by_vectors(flight: Flight, stream: str, low: float, high: float) -> list[Guess]:
    """By the vectors of positions and of forces, whichever of the two the stream tells; sure ones only."""
    found = []
    for name, other in flight.streams.items():
        pair = {n: s for n, s in ((stream, flight.streams[stream]), (name, other))}
        placed = next((n for n, s in pair.items() if _holds(s, "position")), None)
        unit = next((n for n, s in pair.items() if _holds(s, "gyro", "specific_force")), None)
        if name == stream or placed is None or unit is None:
            continue
        t = pair[placed].time * 1e-9
        smooth = max(_SMOOTH, _SAMPLES * float(np.median(np.diff(t)))) if len(t) > 1 else np.inf
        if smooth > _LONGEST:
            continue
        seen = _windows(t, pair[placed].leaves["position"], 2, smooth)
        felt = _windows(pair[unit].time * 1e-9, _carried(pair[unit]), 0, smooth)
        ends = (low, high) if stream == placed else (-high, -low)
        by = f"accelerations of {stream} and {name}, as vectors"
        guess = _best(seen, felt, *ends, by, _alike_turned)
        if guess is not None and guess.correlation >= _LEAST_TURNED:
            found.append(guess if stream == placed else Guess(-guess.offset, guess.correlation, by))
    return found


def _holds(series: Series, *names: str) -> bool:
    return all(n in series.leaves and series.leaves[n].shape[1:] == (3,) for n in names)


def _carried(series: Series) -> np.ndarray:
    """Forces (n, 3) in the axes of the first reading, by the gyroscope alone."""
    from scipy.spatial.transform import Rotation  # slow to import

    step = np.diff(series.time, prepend=series.time[:1]) * 1e-9
    turn = Rotation.from_rotvec(series.leaves["gyro"] * step[:, None]).as_quat()
    span = 1
    while span < len(turn):  # products of all before, of twice as many each time
        turn[span:] = (Rotation(turn[:-span]) * Rotation(turn[span:])).as_quat()
        span *= 2
    return np.asarray(Rotation(turn).apply(series.leaves["specific_force"].copy()))


def _alike_turned(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """The correlation of vectors (n, 3), each piece turned as fits it best."""
    fit, sizes = 0.0, np.zeros(2)
    piece = ((t - t[0]) // _PIECE).astype(int)
    for k in range(int(piece[-1]) + 1):
        here = piece == k
        if here.sum() < 20:
            continue
        a, b = x[here] - x[here].mean(axis=0), y[here] - y[here].mean(axis=0)
        H = a.T @ b
        s = np.linalg.svd(H, compute_uv=False)
        fit += s[0] + s[1] + np.sign(np.linalg.det(H)) * s[2]
        sizes += np.sum(a * a), np.sum(b * b)
    return float(fit / np.sqrt(sizes.prod())) if sizes.all() else -1.0


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
    """|x| or |x'' - g| in the middle of windows."""
    at, vectors = _windows(t, x, order, _SMOOTH)
    return at, np.linalg.norm(vectors + (_UP if order else 0.0), axis=1)


def _windows(t: np.ndarray, x: np.ndarray, order: int, smooth: float) -> Signal:
    """x (n, 3) or x'' in the middle of windows of so many s, each fitted by a parabola; where a window is
    full enough."""
    middles = np.arange(t[0] + smooth, t[-1] - smooth, 4 * _STEP)
    half = 0.5 * smooth
    at, found = [], []
    usual = float(np.median(np.diff(t)))
    for middle in middles:
        a, b = np.searchsorted(t, [middle - half, middle + half])
        s = (t[a:b] - middle) / half
        if b - a < max(5, 0.8 * smooth / usual) or s[0] > -0.7 or s[-1] < 0.7:
            continue
        weight = (1.0 - s * s)[:, None]
        if order == 0:  # what an acceleration becomes when its second integral is fitted so
            kernel = weight**2
            value = np.sum(kernel * x[a:b], axis=0) / np.sum(kernel)
        else:
            A = np.stack([np.ones_like(s), s, s * s], axis=1)
            value = 2.0 * np.linalg.lstsq(A, x[a:b], rcond=None)[0][2] / half**2
        at.append(middle)
        found.append(value)
    return np.array(at), np.array(found).reshape(-1, 3)


def _alike(t: np.ndarray, x: np.ndarray, y: np.ndarray) -> float:
    """The correlation of numbers (n,)."""
    return float(np.corrcoef(x, y)[0, 1]) if x.std() > 0.0 and y.std() > 0.0 else -1.0


def _best(
    a: Signal, b: Signal, low: float, high: float, by: str, alike: Callable[..., float] = _alike
) -> Guess | None:
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
        columns = [np.interp(t[whole], tb, column) for column in np.atleast_2d(xb.T)]
        found[k] = alike(ta[whole], xa[whole], np.stack(columns, axis=-1).reshape(-1, *xb.shape[1:]))
    k = int(found.argmax())
    offset = float(shifts[k])
    if 0 < k < len(shifts) - 1 and found[k - 1] > -1.0 and found[k + 1] > -1.0:
        left, middle, right = found[k - 1 : k + 2]
        bend = left - 2.0 * middle + right
        offset += _STEP * 0.5 * (left - right) / bend if bend < 0.0 else 0.0
    return Guess(offset, float(found[k]), by)
