"""Pictures of an inertial filter beside what it was told and what was true.

Two figures. In space: truth, observations and estimate, with equal axes, so that a metre is a metre in every
direction. Over time: position, roll, pitch and yaw, velocity and the two biases, each with the band of three
standard deviations that the filter claims, and the error of position and attitude.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy  # its parts are loaded when they are used

from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.angles import angle_name, euler_angles, euler_variances
from flowgraph.drawing.canvas import BAND, COLOURS, TRUTH
from flowgraph.drawing.fields import STATES
from flowgraph.errors import DataError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["plot_ins", "plot_map", "plot_space"]

_SEEN = COLOURS[1]
_MOST_POINTS = 2000
_UNITS = {
    "position": ("m", "xyz"),
    "velocity": ("m/s", "xyz"),
    "gyro_bias": ("rad/s", "xyz"),
    "accelerometer_bias": ("m/s$^2$", "xyz"),
}


@canvas.picture
def plot_map(estimate: Series, truth: Series | None = None, file: str | Path | None = None) -> Figure:
    """The way over the ground from above, with a bar of scale and an arrow to the north.

    Args:
        estimate, truth: series with `position` (3), m: east, north, up.
        file: ending in .png, .svg or .pdf.

    Raises:
        DataError: where a series is empty or has no positions.
        UnknownNameError: for an unknown file ending.
    """
    _need_positions(estimate)
    figure = canvas.new_figure(7.0, 7.0)
    axis: Any = figure.add_subplot()
    if truth is not None and "position" in truth.leaves and len(truth):
        axis.plot(*_thinned(truth)[:, :2].T, color=TRUTH, label="truth")
    way = _thinned(estimate)
    axis.plot(*way[:, :2].T, color=COLOURS[0], label="estimate")
    axis.plot(*way[0, :2], "o", color=COLOURS[0], label="start")
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_axis_off()
    axis.margins(0.1)
    wide = max(float(np.ptp(way[:, 0])), float(np.ptp(way[:, 1])), 1e-3)
    bar = _round_length(0.3 * wide)
    west, south = float(way[:, 0].min()), float(way[:, 1].min()) - 0.08 * wide
    axis.plot([west, west + bar], [south, south], color="black", linewidth=3.0)
    axis.annotate(
        f"{bar:g} m", (west + 0.5 * bar, south), (0.0, -14.0), textcoords="offset points", ha="center"
    )
    axis.annotate(
        "N", (0.95, 0.97), (0.95, 0.86), xycoords="axes fraction", ha="center", fontsize="large",
        arrowprops={"arrowstyle": "->", "color": "black"},
    )  # fmt: skip
    axis.legend(loc="upper left")
    return canvas.save(figure, file)


def _thinned(series: Series) -> np.ndarray:
    return np.asarray(series["position"][:: max(len(series) // _MOST_POINTS, 1)])


def _round_length(most: float) -> float:
    """The longest of 1, 2, 5 times a power of ten that is no longer."""
    power = 10.0 ** np.floor(np.log10(most))
    return float(max(power * step for step in (1.0, 2.0, 5.0) if power * step <= most * (1.0 + 1e-12)))


@canvas.picture
def plot_space(
    estimate: Series,
    truth: Series | None = None,
    observed: Series | None = None,
    file: str | Path | None = None,
) -> Figure:
    """The trajectory in space with equal axes; written to `file` if given.

    Args:
        estimate, truth, observed: series with `position` (3), m; the last is drawn as dots.
        file: ending in .png, .svg or .pdf.

    Raises:
        DataError: where a series is empty or has no positions.
        UnknownNameError: for an unknown file ending.
    """
    figure = canvas.new_figure(8.0, 7.0)
    axis: Any = figure.add_subplot(projection="3d")
    _need_positions(estimate)
    spans = [estimate["position"]]
    if observed is not None:
        _need_positions(observed)
        p = observed["position"][:: max(len(observed) // _MOST_POINTS, 1)]
        axis.plot(*p.T, ".", ms=canvas.dot(len(p)), color=_SEEN, alpha=0.7, label="observed")
    if truth is not None:
        _need_positions(truth)
        inside = _within(truth, estimate)
        axis.plot(*truth["position"][inside].T, color=TRUTH, lw=1.2, label="truth")
        spans.append(truth["position"][inside])
    axis.plot(*estimate["position"].T, color=COLOURS[0], lw=1.2, label="estimate")
    canvas.mark_ends(axis, estimate["position"])
    points = np.concatenate(spans)
    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = 0.5 * (low + high), 0.55 * max(float((high - low).max()), 1e-3)
    for k, name in enumerate("xyz"):
        getattr(axis, f"set_{name}lim")(middle[k] - half, middle[k] + half)
        getattr(axis, f"set_{name}label")(f"{name} [m]")
    axis.set_box_aspect((1, 1, 1))
    axis.legend(loc="upper left")
    return canvas.save(figure, file)


@canvas.picture
def plot_ins(
    estimate: Series,
    truth: Series | None = None,
    observed: Series | None = None,
    file: str | Path | None = None,
    *,
    order: str = "zyx",
) -> Figure:
    """States over time with 3-sigma bands, and the errors; written to `file` if given.

    Args:
        estimate: a series of `Belief`: position, velocity, attitude, biases and covariance (15, 15).
        truth: with `position` and `attitude`, and perhaps `velocity` and biases; or None.
        observed: with `position` and `attitude`, drawn as dots; or None.
        file: ending in .png, .svg or .pdf.
        order: convention of roll, pitch and yaw: "zyx" or "zxy".

    Raises:
        DataError: where a series is empty or has no positions.
        UnknownNameError: for an unknown file ending.
    """
    _need_positions(estimate)
    rows = [*_UNITS]
    rows.insert(1, "attitude")
    figure = canvas.new_figure(13.0, 2.0 * (len(rows) + (truth is not None)) + 0.6)
    axes = figure.subplots(len(rows) + (truth is not None), 3, sharex=True, squeeze=False)
    seconds = estimate.seconds
    deviation = canvas.deviation(np.einsum("nii->ni", estimate["covariance"]))
    for row, name in enumerate(rows):
        for k in range(3):
            axis = axes[row, k]
            sigma = deviation[:, STATES[name] + k]
            if name == "attitude":
                _attitude(axis, estimate, truth, observed, k, order)
            else:
                unit, letters = _UNITS[name]
                _state(axis, estimate, truth, observed, name, k, seconds, sigma)
                axis.set_title(f"{name.replace('_', ' ')} {letters[k]}", loc="left", fontsize=9)
                axis.set_ylabel(f"[{unit}]")
    if truth is not None:
        _errors(axes[-1], estimate, truth, seconds)
    for axis in axes[-1]:
        axis.set_xlabel("time since the start [s]")
    axes[0, 0].legend(loc="best", fontsize=8)
    return canvas.save(figure, file)


def _need_positions(series: Series) -> None:
    if "position" not in series.leaves or not len(series):
        raise DataError(
            "there is nothing to plot",
            path=series.name,
            expected="a series with positions, one at least",
            got=f"{len(series)} values of " + (", ".join(series.leaves) or "nothing"),
            fix="choose another stream",
        )


def _within(series: Series, other: Series) -> np.ndarray:
    inside = (series.time >= other.time[0]) & (series.time <= other.time[-1])
    return inside if inside.any() else np.ones(len(series), bool)


def _since(series: Series, other: Series) -> np.ndarray:
    """The times of `series` in seconds since the start of `other`."""
    return np.asarray((series.time - other.time[0]) * 1e-9)


def _state(
    axis: Axes, estimate: Series, truth: Series | None, observed: Series | None, name: str, k: int,
    seconds: np.ndarray, sigma: np.ndarray,
) -> None:  # fmt: skip
    value = estimate[name][:, k]
    axis.fill_between(
        seconds, value - 3 * sigma, value + 3 * sigma, color=BAND, alpha=0.4, lw=0, label="3 sigma"
    )
    if observed is not None and name in observed.leaves:
        axis.plot(
            _since(observed, estimate), observed[name][:, k], ".", ms=1.5, color=_SEEN, label="observed"
        )
    if truth is not None and name in truth.leaves:
        inside = _within(truth, estimate)
        axis.plot(_since(truth, estimate)[inside], truth[name][inside, k], color=TRUTH, lw=1, label="truth")
    axis.plot(seconds, value, color=COLOURS[0], lw=1, label="estimate")
    reach = value[len(value) // 20 :]
    around = max(float(np.ptp(reach)), 6.0 * float(np.nanmedian(sigma)), 1e-9)
    middle = 0.5 * float(reach.max() + reach.min())
    axis.set_ylim(middle - 0.75 * around, middle + 0.75 * around)


def _rotations(series: Series) -> Any:
    return scipy.spatial.transform.Rotation.from_quat(series["attitude"][:, [1, 2, 3, 0]])


def _attitude(
    axis: Axes, estimate: Series, truth: Series | None, observed: Series | None, k: int, order: str
) -> None:
    """Roll, pitch or yaw, degrees, without jumps of a turn, in the band that the filter claims for it."""

    def drawn(series: Series) -> np.ndarray:
        return euler_angles(series["attitude"], order)[:, k]

    value, at = drawn(estimate), STATES["attitude"]
    spread = estimate["covariance"][:, at : at + 3, at : at + 3]
    variance = np.minimum(euler_variances(estimate["attitude"], spread, order)[:, k], 180.0**2)
    wide = 3.0 * canvas.deviation(variance)
    axis.fill_between(estimate.seconds, value - wide, value + wide, color=BAND, alpha=0.4, lw=0)
    if observed is not None and "attitude" in observed.leaves:
        axis.plot(_since(observed, estimate), drawn(observed), ".", ms=1.5, color=_SEEN)
    if truth is not None and "attitude" in truth.leaves:
        inside = _within(truth, estimate)
        axis.plot(_since(truth, estimate)[inside], drawn(truth)[inside], color=TRUTH, lw=1)
    axis.plot(estimate.seconds, value, color=COLOURS[0], lw=1)
    axis.set_title(angle_name(k, order), loc="left", fontsize=9)
    axis.set_ylabel("[deg]")


def _errors(axes: Any, estimate: Series, truth: Series, seconds: np.ndarray) -> None:
    """Distance in position, geodesic angle, and the distance of velocities where the truth has them."""
    inside = (estimate.time >= truth.time[0]) & (estimate.time <= truth.time[-1])
    time, at = estimate.time[inside], seconds[inside]

    def there(name: str) -> np.ndarray:
        columns = [np.interp(time, truth.time, truth[name][:, k]) for k in range(3)]
        return np.stack(columns, axis=1)

    apart = np.linalg.norm(estimate["position"][inside] - there("position"), axis=1)
    axes[0].plot(at, apart, color=COLOURS[3], lw=1)
    axes[0].set_title("error of position", loc="left", fontsize=9)
    axes[0].set_ylabel("[m]")
    if len(time) and len(truth) > 1:
        start = truth.time[0]
        true = scipy.spatial.transform.Slerp(truth.time - start, _rotations(truth))(time - start)
        turn = (true.inv() * _rotations(estimate)[inside]).magnitude()
        axes[1].plot(at, np.degrees(turn), color=COLOURS[3], lw=1)
    axes[1].set_title("error of attitude", loc="left", fontsize=9)
    axes[1].set_ylabel("[deg]")
    if "velocity" in truth.leaves:
        slip = np.linalg.norm(estimate["velocity"][inside] - there("velocity"), axis=1)
        axes[2].plot(at, slip, color=COLOURS[3], lw=1)
    axes[2].set_title("error of velocity", loc="left", fontsize=9)
    axes[2].set_ylabel("[m/s]")
