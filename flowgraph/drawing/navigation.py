"""One page on a navigation filter: the way in space, and the errors in the band that the filter claims.

An error that leaves its band more often than now and then is a filter that is wrong about itself. Position,
velocity and attitude are drawn as errors where the truth is known, since a metre of way hides a millimetre of
error; what the sensors said is drawn beside them as dots.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.angles import angle_name, between, euler_angles, euler_variances, turn_between
from flowgraph.drawing.canvas import BAND, COLOURS, TRUTH
from flowgraph.drawing.consistency import covariance_of, variance_of
from flowgraph.drawing.fields import STATES, find, need, unit_words
from flowgraph.errors import DataError
from flowgraph.types import ArrayType

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SEEN = COLOURS[1]
_MOST_DOTS = 4000
_HALF_A_TURN = 60.0  # a deviation whose band is all directions


@canvas.picture
def plot_trajectory(truth: Series, estimate: Series, file: str | Path | None = None) -> Figure:
    """The trajectory in space beside its error over time, with 3-sigma bands where there is a covariance.

    Args:
        truth, estimate: series with a field `position`; the estimate may have a `covariance`, as in
            `plot_navigation`.
    """
    figure = canvas.new_figure(11, 5.2)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1))
    _space(figure.add_subplot(grid[:, 0], projection="3d"), estimate, truth)
    for k, axis in enumerate(figure.add_subplot(grid[k, 1]) for k in range(3)):
        _error(axis, estimate, truth, None, "position", k)
        if k == 2:
            axis.set_xlabel("time since the start [s]")
    return canvas.save(figure, file)


@canvas.picture
def plot_navigation(
    estimate: Series,
    truth: Series | None = None,
    file: str | Path | None = None,
    *,
    observed: Series | None = None,
    order: str = "zyx",
    extra: Mapping[str, npt.ArrayLike] | None = None,
) -> Figure:
    """One page on a navigation filter: trajectory, errors, attitude and biases; only what exists is drawn.

    Args:
        estimate: a series with `position`, in space or in the plane, and any of `velocity`, `attitude`
            (quaternion w, x, y, z, body to world), `gyro_bias`, `accelerometer_bias` and `covariance` (15 x
            15: position, velocity, attitude, gyro bias, accelerometer bias; or 9 x 9 or 6 x 6: the first of
            them; or what `flowgraph.drawing.consistency` knows).
        truth: the same fields, at times of its own, or None.
        file: ending in .png, .svg or .pdf.
        observed: what a sensor said of the `position`, drawn as dots; or None.
        order: convention of roll, pitch and yaw: "zyx", R = Rz Ry Rx, or "zxy", R = Rz Rx Ry.
        extra: more panels, by title: an array with one value for each time of the estimate, such as
            `{"tilt error [deg]": tilt, "heading error [deg]": heading}`.

    Raises:
        UnknownNameError: where the estimate has no position, or for an unknown file ending.
        DataError: where an array of `extra` does not have one value a time.
    """
    wide = need(estimate, "position")[0].shape[1]
    more = {words: np.asarray(array, dtype=float) for words, array in (extra or {}).items()}
    for words, array in more.items():
        if array.shape != (len(estimate),):
            raise DataError(
                "an extra panel needs one value for each time of the estimate", path=words,
                expected=f"shape {(len(estimate),)}", got=f"shape {array.shape}",
                fix="evaluate it at estimate.time",
            )  # fmt: skip
    fields = [f for f in STATES if find(estimate, f) is not None]
    turned = "attitude" in fields and truth is not None and find(truth, "attitude") is not None
    if turned:
        fields.insert(fields.index("attitude") + 1, "attitude error")
    rows = 2 + len(fields) + -(-len(more) // wide)
    figure = canvas.new_figure(12, 1.75 * rows + 0.6)
    grid = figure.add_gridspec(rows, wide)
    if wide == 3:
        _space(figure.add_subplot(grid[:2, :2], projection="3d"), estimate, truth)
    _from_above(figure.add_subplot(grid[:2, 2] if wide == 3 else grid[:2, :]), estimate, truth, observed)
    for row, field in enumerate(fields, start=2):
        for k in range(wide):
            axis = figure.add_subplot(grid[row, k])
            if field == "attitude":
                _angle(axis, estimate, truth, k, order)
            elif field == "attitude error":
                assert truth is not None
                _turn(axis, estimate, truth, k)
            elif truth is not None and find(truth, field) is not None and field in ("position", "velocity"):
                _error(axis, estimate, truth, observed if field == "position" else None, field, k)
            else:
                _value(axis, estimate, truth, field, k)
    for n, (words, array) in enumerate(more.items()):
        axis = figure.add_subplot(grid[2 + len(fields) + n // wide, n % wide])
        axis.plot(estimate.seconds, array, color=COLOURS[0], lw=1)
        canvas.title(axis, words)
    for axis in figure.axes[-wide:]:
        axis.set_xlabel("time since the start [s]")
    return canvas.save(figure, file)


def _since(series: Series, estimate: Series) -> np.ndarray:
    """The times of a series in seconds since the start of the estimate."""
    return np.asarray((series.time - estimate.time[0]) * 1e-9)


def _label(axis: Axes, words: str, type_: ArrayType, band: bool) -> None:
    canvas.title(axis, words + (", with 3σ" if band else ""))
    axis.set_ylabel(unit_words(type_.unit, type_.frame))


def _within(axis: Axes, seconds: np.ndarray, middle: np.ndarray, variance: np.ndarray | None) -> np.ndarray:
    """Draw the band of three deviations, and return its half width (0 without one)."""
    if variance is None:
        return np.zeros(len(seconds))
    width = 3.0 * canvas.deviation(variance)
    axis.fill_between(seconds, middle - width, middle + width, color=BAND, alpha=0.35, lw=0)
    canvas.mark_broken(axis, seconds, ~(variance >= 0.0))
    return width


def _error(axis: Axes, estimate: Series, truth: Series, observed: Series | None, field: str, k: int) -> None:
    """Estimate less truth (interpolated, where it is known), in the band the filter claims."""
    (value, type_), _ = need(estimate, field), need(truth, field)
    seconds = estimate.seconds
    error = value[:, k] - between(truth, field, estimate.time)[:, k]
    variance = variance_of(estimate, field, k)
    width = _within(axis, seconds, np.zeros(len(seconds)), variance)
    axis.axhline(0, color=TRUTH, lw=0.6)
    if observed is not None:
        seen = observed[:: max(len(observed) // _MOST_DOTS, 1)]
        off = seen["position"][:, k] - between(truth, field, seen.time)[:, k]
        axis.plot(_since(seen, estimate), off, ".", ms=canvas.dot(len(off)), color=_SEEN, alpha=0.7, zorder=1)
    axis.plot(seconds, error, color=COLOURS[0], lw=1.0)
    _label(axis, f"{field} error {'xyz'[k]}", type_, variance is not None)
    if not canvas.nothing_here(axis, error):
        canvas.scale_when_settled(axis, seconds, error, -width, width)


def _turn(axis: Axes, estimate: Series, truth: Series, k: int) -> None:
    """One component of the turn, in the body, between the true attitude and the estimate."""
    q = need(estimate, "attitude")[0]
    error = turn_between(between(truth, "attitude", estimate.time), q)[:, k]
    variance = variance_of(estimate, "attitude", k)
    degrees = None if variance is None else variance * np.rad2deg(1.0) ** 2
    width = _within(axis, estimate.seconds, np.zeros(len(estimate)), degrees)
    axis.axhline(0, color=TRUTH, lw=0.6)
    axis.plot(estimate.seconds, error, color=COLOURS[0], lw=1.0)
    canvas.title(axis, f"attitude error {'xyz'[k]}" + (", with 3σ" if variance is not None else ""))
    axis.set_ylabel("[deg, body]")
    if not canvas.nothing_here(axis, error):
        canvas.scale_when_settled(axis, estimate.seconds, error, -width, width)


def _value(axis: Axes, estimate: Series, truth: Series | None, field: str, k: int) -> None:
    """The estimate itself, in the band the filter claims, and the truth where it is known."""
    value, type_ = need(estimate, field)
    variance = variance_of(estimate, field, k)
    width = _within(axis, estimate.seconds, value[:, k], variance)
    axis.plot(estimate.seconds, value[:, k], color=COLOURS[k], lw=1.0)
    known = None if truth is None else find(truth, field)
    if truth is not None and known is not None:
        axis.plot(_since(truth, estimate), known[0][:, k], color=TRUTH, lw=0.9, ls="--")
    _label(axis, f"{field.replace('_', ' ')} {'xyz'[k]}", type_, variance is not None)
    if not canvas.nothing_here(axis, value[:, k]):
        low, high = value[:, k] - width, value[:, k] + width
        canvas.scale_when_settled(axis, estimate.seconds, value[:, k], low, high)


def _angle(axis: Axes, estimate: Series, truth: Series | None, k: int, order: str) -> None:
    q = need(estimate, "attitude")[0]
    angle = euler_angles(q, order)[:, k]
    spread = covariance_of(estimate, "attitude")
    if spread is not None:
        variance = euler_variances(q, spread, order)[:, k]
        _within(axis, estimate.seconds, angle, np.minimum(variance, _HALF_A_TURN**2))
    axis.plot(estimate.seconds, angle, color=COLOURS[k], lw=1.0)
    known = None if truth is None else find(truth, "attitude")
    if truth is not None and known is not None:
        right = euler_angles(known[0], order)[:, k]
        begin = np.interp(0, truth.time - estimate.time[0], right)
        right = right + 360 * np.round((angle[0] - begin) / 360)  # the same turn as the estimate
        axis.plot(_since(truth, estimate), right, color=TRUTH, lw=0.9, ls="--")
    canvas.title(axis, angle_name(k, order) + (", with 3σ" if spread is not None else ""))
    axis.set_ylabel("[deg]")
    canvas.nothing_here(axis, angle)


def _paths(estimate: Series, truth: Series | None) -> list[tuple[np.ndarray, dict[str, Any]]]:
    paths = [(need(estimate, "position")[0], {"color": COLOURS[0], "lw": 1.2, "label": "estimate"})]
    if truth is not None:
        look = {"color": TRUTH, "lw": 1.0, "ls": "--", "label": "truth"}
        paths.append((need(truth, "position")[0], look))
    return paths


def _space(axis: Any, estimate: Series, truth: Series | None) -> None:
    """The trajectory in space, to one scale on all axes; a flat one keeps some height."""
    paths = _paths(estimate, truth)
    for path, look in paths:
        axis.plot(*path.T, **look)
    canvas.mark_ends(axis, paths[0][0])
    points = np.concatenate([path for path, _ in paths])
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        axis.text2D(0.3, 0.5, "no position is finite", transform=axis.transAxes, color=canvas.WRONG)
        return
    low, high = points.min(axis=0), points.max(axis=0)
    span = high - low
    span = 1.08 * np.maximum(span, [0.3 * span.max() or 1.0] * 3)
    middle = (low + high) / 2
    axis.set(
        **{f"{name}lim": (middle[k] - span[k] / 2, middle[k] + span[k] / 2) for k, name in enumerate("xyz")}
    )
    axis.set_box_aspect(span, zoom=0.88)
    for name in "xyz":
        axis.locator_params(axis=name, nbins=3 if name == "z" else 4)
    unit = need(estimate, "position")[1].unit
    for name in "xyz":
        getattr(axis, f"set_{name}label")(f"{name} [{unit}]" if unit else name, fontsize=8)
    axis.legend(loc="upper left", fontsize=8, frameon=False)


def _from_above(axis: Axes, estimate: Series, truth: Series | None, observed: Series | None) -> None:
    paths = _paths(estimate, truth)
    if observed is not None:
        seen = observed["position"][:: max(len(observed) // _MOST_DOTS, 1)]
        axis.plot(
            seen[:, 0], seen[:, 1], ".", ms=canvas.dot(len(seen)), color=_SEEN, alpha=0.7, label="observed"
        )
    for path, look in paths:
        axis.plot(path[:, 0], path[:, 1], **look)
    canvas.mark_ends(axis, paths[0][0][:, :2])
    axis.set_aspect("equal", adjustable="datalim")
    canvas.title(axis, "from above")
    unit = need(estimate, "position")[1].unit
    axis.set_xlabel(f"x [{unit}]" if unit else "x")
    axis.set_ylabel(f"y [{unit}]" if unit else "y")
    if observed is not None or len(paths[0][0].T) == 2:
        axis.legend(fontsize=canvas.SMALL, frameon=False, loc="best")


__all__ = ["plot_navigation", "plot_trajectory"]
