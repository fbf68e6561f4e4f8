"""Pictures of an orientation estimate: roll, pitch and yaw, their errors over time, and the biases.

The angles are drawn over the truth, with the band of three standard deviations that the filter claims. The
error is split as one would judge it, into a turn about the vertical (heading) and one about a horizontal axis
(inclination), each in its own band.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.angles import NAMES, between, euler_angles, euler_variances, matrices
from flowgraph.drawing.canvas import BAND, COLOURS, TRUTH
from flowgraph.drawing.fields import find, need
from flowgraph.errors import DataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# where the attitude error and the gyroscope's bias stand in a covariance, by its size
PLACES = {3: (0, None), 6: (0, 3), 9: (6, None), 15: (6, 9)}


@canvas.picture
def plot_orientation(estimate: Series, truth: Series | None = None, file: str | Path | None = None) -> Figure:
    """One page on an orientation filter; only what exists is drawn.

    Args:
        estimate: with `attitude` (w, x, y, z, body to world), and perhaps `gyro_bias` and `covariance`, of
            which the attitude's part is of a right rotation vector in the body, rad: 3 x 3 (attitude), 6 x 6
            (attitude, gyroscope bias), 9 x 9 or 15 x 15 (as a navigation filter has them).
        truth: with `attitude`, at times of its own, NaN where it is not known; perhaps with `gyro_bias`.
        file: ending in .png, .svg or .pdf.

    Raises:
        UnknownNameError: where the estimate has no attitude, or for an unknown file ending.
        DataError: where it has no values.
    """
    q = need(estimate, "attitude")[0]
    bias = find(estimate, "gyro_bias")
    start = int(estimate.time[0])
    known = truth if truth is not None and find(truth, "attitude") is not None and len(truth) else None
    rows = 1 + (known is not None) + (bias is not None)
    figure = canvas.new_figure(12, 2.3 * rows + 0.6)
    axes = figure.subplots(rows, 3, squeeze=False, sharex=True)
    spread = _spread(estimate, "attitude")
    _draw_angles(axes[0], estimate, q, known, spread, start)
    if known is not None:
        _draw_errors(axes[1], estimate, q, known, spread)
    if bias is not None:
        _draw_biases(axes[-1], estimate, bias[0], truth, start)
    for axis in axes[-1]:
        axis.set_xlabel("time since the start [s]")
    return canvas.save(figure, file)


@canvas.picture
def plot_comparison(
    estimates: Mapping[str, Series], truth: Series | None = None, file: str | Path | None = None
) -> Figure:
    """Roll, pitch and yaw of several filters over the truth, a panel an angle.

    Args:
        estimates: by name, each with `attitude`; the first is drawn on top.
        truth: with `attitude`, at times of its own, NaN where it is not known.
        file: ending in .png, .svg or .pdf.

    Raises:
        UnknownNameError: where an estimate has no attitude, or for an unknown file ending.
        DataError: where one has no values, or there is none.
    """
    if not estimates:
        raise DataError(
            "there is nothing to compare",
            path="estimates",
            expected="the series of one filter at least",
            got="none",
            fix="run a filter that gives attitudes",
        )
    start = min(int(s.time[0]) if len(need(s, "attitude")[0]) else 0 for s in estimates.values())
    figure = canvas.new_figure(11, 8.0)
    axes = figure.subplots(3, 1, sharex=True)
    looks: Any = [{"color": colour, "lw": 1.0} for colour in COLOURS]
    shown = [(name, s, looks[k % len(looks)]) for k, (name, s) in enumerate(estimates.items())]
    if truth is not None and len(truth) and find(truth, "attitude") is not None:
        shown.append(("truth", truth, {"color": TRUTH, "lw": 1.0, "ls": "--"}))
    for name, series, look in [*shown[1:], shown[0]]:
        q = need(series, "attitude")[0]
        known = np.isfinite(q).all(axis=1)
        angles = np.full((len(q), 3), np.nan)
        angles[known] = _wrapped(euler_angles(q[known]))
        for axis, angle in zip(axes, angles.T, strict=True):
            axis.plot((series.time - start) * 1e-9, _broken(angle), label=name, **look)
    for k, axis in enumerate(axes):
        _name(axis, NAMES[k], "[deg]")
    place: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
    axes[0].legend(fontsize=8, frameon=False, ncols=len(shown), **place)
    axes[-1].set_xlabel("time since the start [s]")
    return canvas.save(figure, file)


def _spread(estimate: Series, part: str) -> np.ndarray | None:
    """The covariance (n, 3, 3) of the attitude error or the gyroscope's bias, where the estimate has it."""
    found = find(estimate, "covariance")
    if found is None or found[0].ndim != 3:
        return None
    places = PLACES.get(found[0].shape[1], (None, None))
    at = places[0 if part == "attitude" else 1]
    return None if at is None else np.asarray(found[0][:, at : at + 3, at : at + 3])


def _draw_angles(
    axes: np.ndarray,
    estimate: Series,
    q: np.ndarray,
    truth: Series | None,
    spread: np.ndarray | None,
    start: int,
) -> None:
    angles, seconds = _wrapped(euler_angles(q)), estimate.seconds
    variances = None if spread is None else euler_variances(q, spread)
    sigmas = None if variances is None else canvas.deviation(variances)
    for k, axis in enumerate(axes):
        drawn = _broken(angles[:, k])
        shown = [drawn]
        if sigmas is not None:
            band = 3.0 * sigmas[:, k]
            axis.fill_between(seconds, drawn - band, drawn + band, color=BAND, alpha=0.35, lw=0)
        axis.plot(seconds, drawn, color=COLOURS[k], lw=1.0, label="estimate")
        if truth is not None:
            right = need(truth, "attitude")[0]
            known = np.isfinite(right).all(axis=1)
            angle = np.full(len(right), np.nan)
            angle[known] = _wrapped(euler_angles(right[known]))[:, k]
            axis.plot(
                (truth.time - start) * 1e-9, _broken(angle), color=TRUTH, lw=0.9, ls="--", label="truth"
            )
            seen = (truth.time >= estimate.time[0]) & (truth.time <= estimate.time[-1])
            shown.append(angle[seen])
            place: Any = {"loc": "lower right", "bbox_to_anchor": (1.0, 1.0), "borderaxespad": 0.2}
            axis.legend(fontsize=canvas.SMALL, frameon=False, ncols=2, **place)  # beside the title
        both = np.concatenate(shown)
        both = both[np.isfinite(both)]
        room = max(0.08 * float(np.ptp(both)), 1.0) if len(both) else 1.0
        if (
            sigmas is not None
        ):  # near the pole the band of roll and yaw has no bounds; it must not set the scale
            room = max(room, min(3.3 * float(np.nanmedian(sigmas[:, k])), 60.0))
        if len(both):
            axis.set_ylim(float(both.min()) - room, float(both.max()) + room)
        _name(axis, NAMES[k] + (", with 3σ" if sigmas is not None else ""), "[deg]")


def _draw_errors(
    axes: np.ndarray, estimate: Series, q: np.ndarray, truth: Series, spread: np.ndarray | None
) -> None:
    """Total, inclination and heading error, where the truth is known on both sides of a time."""
    right = between(truth, "attitude", estimate.time)
    R = matrices(q) @ matrices(right).transpose(0, 2, 1)
    total = np.rad2deg(np.arccos(np.clip((np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0, -1.0, 1.0)))
    tilt = np.rad2deg(np.arccos(np.clip(R[:, 2, 2], -1.0, 1.0)))
    heading = np.rad2deg(np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1]))
    bands: list[np.ndarray | None] = [None, None, None]
    if spread is not None:
        W = matrices(q)
        world = np.diagonal(W @ spread @ W.transpose(0, 2, 1), axis1=1, axis2=2)
        bands[1] = np.rad2deg(3.0 * canvas.deviation(world[:, 0] + world[:, 1]))
        bands[2] = np.rad2deg(3.0 * canvas.deviation(world[:, 2]))
    names = ("total error", "inclination error", "heading error")
    for k, (axis, error) in enumerate(zip(axes, (total, tilt, heading), strict=True)):
        band = bands[k]
        if band is not None:
            low = -band if k == 2 else 0.0 * band
            axis.fill_between(estimate.seconds, low, band, color=BAND, alpha=0.35, lw=0)
        axis.axhline(0, color=TRUTH, lw=0.6)
        axis.plot(estimate.seconds, error, color=COLOURS[k], lw=1.0)
        _name(axis, names[k] + (", with 3σ" if band is not None else ""), "[deg]")


def _draw_biases(
    axes: np.ndarray, estimate: Series, bias: np.ndarray, truth: Series | None, start: int
) -> None:
    spread = _spread(estimate, "gyro_bias")
    right = None if truth is None else find(truth, "gyro_bias")
    for k, axis in enumerate(axes):
        if spread is not None:
            band = 3.0 * canvas.deviation(spread[:, k, k])
            axis.fill_between(
                estimate.seconds, bias[:, k] - band, bias[:, k] + band, color=BAND, alpha=0.35, lw=0
            )
        axis.plot(estimate.seconds, bias[:, k], color=COLOURS[k], lw=1.0)
        if truth is not None and right is not None:
            axis.plot((truth.time - start) * 1e-9, right[0][:, k], color=TRUTH, lw=0.9, ls="--")
        _name(axis, f"gyro bias {'xyz'[k]}" + (", with 3σ" if spread is not None else ""), "[rad/s]")


def _wrapped(degrees: np.ndarray) -> np.ndarray:
    return 180.0 - np.remainder(180.0 - degrees, 360.0)


def _broken(angle: np.ndarray) -> np.ndarray:
    """The angle with a gap where it wraps, so that no line is drawn across."""
    gap = np.abs(np.diff(angle, prepend=angle[:1])) > 180.0
    return np.where(gap, np.nan, angle)


def _name(axis: Axes, title: str, unit: str) -> None:
    canvas.title(axis, title)
    axis.set_ylabel(unit)


__all__ = ["plot_comparison", "plot_orientation"]
