"""Plots of what a run gave back: values over time, and trajectories with their errors.

A panel shows one field, with the unit and frame that its type declares on the axis, so that nobody has to
guess. Errors are drawn with the 3-sigma band that the filter itself claims: an error that leaves its band
more often than now and then is a filter that is wrong about itself. Figures are made without pyplot, so they
need no display, keep no global state and may be made in threads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from flowgraph.data.files import whole
from flowgraph.data.series import Series
from flowgraph.errors import DataError, MissingDependencyError, UnknownNameError, writes
from flowgraph.types import ArrayType, leaves_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flowgraph.data.result import Result

ENDINGS = (".png", ".svg", ".pdf")
COLOURS = ("#3b6ea8", "#c8792b", "#4f8a5b", "#a85a6d", "#7a68a8", "#8b8378")
TRUTH, BAND = "#22303c", "#9db4d0"
MOST_COMPONENTS = 6
PANELS_A_COLUMN = 8
# where each quantity stands in the 15 error states; a covariance of 6 or 9 holds the first of them
STATES = {"position": 0, "velocity": 3, "attitude": 6, "gyro_bias": 9, "accelerometer_bias": 12}
SIZES = (6, 9, 15)


def plot_result(
    result: Result, file: str | Path | None = None, *, outputs: Sequence[str] | None = None
) -> Figure:
    """A figure with one panel a field of the collected streams; written to `file` if given.

    Vectors of up to six components are drawn as lines, small square matrices as the roots of their
    diagonal; what is larger is left out. Streams much slower than the fastest are drawn as dots.

    Args:
        file: ending in .png, .svg or .pdf.
        outputs: the names of the streams to show; all where left out.

    Raises:
        UnknownNameError: for an output or a file ending that does not exist.
        DataError: where there is nothing that can be drawn.
    """
    shown = {name: result[name] for name in (result.series if outputs is None else outputs)}
    begins = [s.time[0] for s in result.series.values() if len(s)]
    start = min(begins, default=np.int64(0))
    fastest = min((_interval(s) for s in result.series.values()), default=np.inf)
    panels = []
    for name, series in shown.items():
        dots = _interval(series) > 5 * fastest or len(series) < 2
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            drawn = _drawable(array)
            if drawn is not None:
                title = name if field == "value" else f"{name}.{field}"
                panels.append(
                    (title, field, type_, (series.time - start) * 1e-9, drawn, dots, array.ndim == 3)
                )
    if not panels:
        raise DataError(
            "there is nothing to plot", path=result.graph, got=", ".join(shown) or "no outputs",
            expected=f"a stream with a field of at most {MOST_COMPONENTS} components",
            fix='collect a part of the stream: collect(stream.map(lambda v: v.part), "part")',
        )  # fmt: skip
    columns = -(-len(panels) // PANELS_A_COLUMN)
    rows = -(-len(panels) // columns)
    figure = _figure(8.5 if columns == 1 else 5.5 * columns, 1.75 * rows + 0.7)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    for axis, (title, field, type_, seconds, drawn, dots, is_matrix) in zip(axes, panels, strict=False):
        _lines(axis, seconds, drawn, _components(field, drawn.shape[1]), dots)
        axis.set_title(
            title + (": square roots of the diagonal" if is_matrix else ""), loc="left", fontsize=9
        )
        axis.set_ylabel(_unit(type_))
    for axis in axes[len(panels) :]:
        axis.remove()
    for column in range(columns):
        axes[min((column + 1) * rows, len(panels)) - 1].set_xlabel("time since the start [s]")
    figure.suptitle(
        f"{result.graph}  ({result.engine}, {result.ticks} ticks)", x=0.01, ha="left", fontsize=11
    )
    return _save(figure, file)


def plot_trajectory(truth: Series, estimate: Series, file: str | Path | None = None) -> Figure:
    """The trajectory in space beside its error over time, with 3-sigma bands where there is a covariance.

    Args:
        truth, estimate: series with a field `position`; the estimate may have a `covariance`, as in
            `plot_navigation`.
    """
    figure = _figure(11, 5.2)
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1))
    _space(figure.add_subplot(grid[:, 0], projection="3d"), estimate, truth)
    start = estimate.time[0]
    for k, axis in enumerate(figure.add_subplot(grid[k, 1]) for k in range(3)):
        _error(axis, estimate, truth, "position", k, start)
        if k == 2:
            axis.set_xlabel("time since the start [s]")
    return _save(figure, file)


def plot_navigation(
    estimate: Series,
    truth: Series | None = None,
    file: str | Path | None = None,
    *,
    extra: Mapping[str, npt.ArrayLike] | None = None,
    order: str = "zyx",
) -> Figure:
    """One page on a navigation filter: trajectory, errors, attitude and biases; only what exists is drawn.

    Args:
        estimate: a series with `position`, and any of `velocity`, `attitude` (quaternion w, x, y, z, body to
            world), `gyro_bias`, `accelerometer_bias` and `covariance` (15 x 15: position, velocity, attitude,
            gyro bias, accelerometer bias; or 9 x 9 or 6 x 6: the first of them).
        truth: the same fields, at times of its own, or None.
        file: ending in .png, .svg or .pdf.
        extra: more panels, by title: an array with one value for each time of the estimate, such as
            `{"tilt error [deg]": tilt, "heading error [deg]": heading}`.
        order: convention of roll, pitch and yaw: "zyx", R = Rz Ry Rx, or "zxy", R = Rz Rx Ry.

    Raises:
        UnknownNameError: where the estimate has no position, or for an unknown file ending.
        DataError: where an array of `extra` does not have one value a time.
    """
    _need(estimate, "position")
    more = {title: np.asarray(array, dtype=float) for title, array in (extra or {}).items()}
    for title, array in more.items():
        if array.shape != (len(estimate),):
            raise DataError(
                "an extra panel needs one value for each time of the estimate", path=title,
                expected=f"shape {(len(estimate),)}", got=f"shape {array.shape}",
                fix="evaluate it at estimate.time",
            )  # fmt: skip
    fields = [f for f in STATES if _find(estimate, f) is not None]
    rows = 2 + len(fields) + -(-len(more) // 3)
    figure = _figure(12, 1.75 * rows + 0.6)
    grid = figure.add_gridspec(rows, 3)
    _space(figure.add_subplot(grid[:2, :2], projection="3d"), estimate, truth)
    _from_above(figure.add_subplot(grid[:2, 2]), estimate, truth)
    start = estimate.time[0]
    for row, field in enumerate(fields, start=2):
        for k in range(3):
            axis = figure.add_subplot(grid[row, k])
            if field == "attitude":
                _angle(axis, estimate, truth, k, start, order)
            elif truth is not None and _find(truth, field) is not None and field in ("position", "velocity"):
                _error(axis, estimate, truth, field, k, start)
            else:
                _value(axis, estimate, truth, field, k, start)
    for n, (title, array) in enumerate(more.items()):
        axis = figure.add_subplot(grid[2 + len(fields) + n // 3, n % 3])
        axis.plot(estimate.seconds, array, color=COLOURS[0], lw=1)
        axis.set_title(title, loc="left", fontsize=9)
    for axis in figure.axes[-3:]:
        axis.set_xlabel("time since the start [s]")
    return _save(figure, file)


def _figure(width: float, height: float) -> Figure:
    try:
        from matplotlib.figure import Figure  # may be absent
    except ImportError:
        raise MissingDependencyError(
            "plots need matplotlib", expected="the Python package matplotlib", got="it cannot be imported",
            fix="pip install matplotlib",
        ) from None  # fmt: skip
    return Figure(figsize=(width, height), layout="constrained")


def _save(figure: Figure, file: str | Path | None) -> Figure:
    for axis in figure.axes:
        axis.tick_params(labelsize=8)
        if axis.name != "3d":
            axis.yaxis.label.set_fontsize(8)
            axis.xaxis.label.set_fontsize(8)
            axis.grid(True, color="#e3e8ee", lw=0.6)
            axis.spines[["top", "right"]].set_visible(False)
    if file is not None:
        path = Path(file)
        if path.suffix.lower() not in ENDINGS:
            raise UnknownNameError("file ending", path.suffix, ENDINGS, path=str(path))
        with writes(path):
            path.parent.mkdir(parents=True, exist_ok=True)
        with whole(path) as stream:
            figure.savefig(stream, dpi=130, format=path.suffix[1:].lower())
    return figure


def _interval(series: Series) -> float:
    """The typical time between two values, in ns."""
    return float(np.median(np.diff(series.time))) if len(series) > 1 else np.inf


def _drawable(array: np.ndarray) -> np.ndarray | None:
    """(n, components) to draw, or None for what is too large."""
    if array.ndim == 3 and array.shape[1] == array.shape[2]:
        array = np.sqrt(np.maximum(np.diagonal(array, axis1=1, axis2=2), 0.0))
    if array.ndim == 1:
        array = array[:, None]
    return array.astype(float) if array.ndim == 2 and 1 <= array.shape[1] <= MOST_COMPONENTS else None


def _components(field: str, n: int) -> tuple[str, ...]:
    if n == 4 and any(word in field for word in ("attitude", "quaternion", "orientation")):
        return ("w", "x", "y", "z")
    return ("x", "y", "z")[:n] if n in (2, 3) else tuple(map(str, range(n)))


def _unit(type_: ArrayType) -> str:
    return (
        f"[{', '.join(part for part in (type_.unit, type_.frame) if part)}]"
        if type_.unit or type_.frame
        else ""
    )


def _lines(axis: Axes, seconds: np.ndarray, values: np.ndarray, names: Sequence[str], dots: bool) -> None:
    marker = "." if dots or len(seconds) <= 60 else None
    for k, name in enumerate(names):
        style: dict[str, Any] = {"ls": "none"} if dots else {"lw": 1.0}
        axis.plot(seconds, values[:, k], color=COLOURS[k], marker=marker, ms=4, label=name, **style)
    if len(names) > 1:
        place: dict[str, Any] = {"loc": "lower right", "bbox_to_anchor": (1.0, 0.98), "borderaxespad": 0.0}
        axis.legend(fontsize=7, ncols=len(names), frameon=False, **place)


def _find(series: Series, field: str) -> tuple[np.ndarray, ArrayType] | None:
    """The leaf called `field`, at the top of the signal or inside it."""
    for (name, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
        if name == field or name.endswith("." + field):
            return array, type_
    return None


def _need(series: Series, field: str) -> tuple[np.ndarray, ArrayType]:
    found = _find(series, field)
    if found is None:
        raise UnknownNameError("field", field, series.leaves, path=series.name)
    if not len(series):
        raise DataError(
            "there are no values to plot", path=series.name, expected="at least one value",
            got="an empty series", fix="run over data that fire this stream",
        )  # fmt: skip
    return found


def _sigma(estimate: Series, field: str, k: int) -> np.ndarray | None:
    found = _find(estimate, "covariance")
    place = STATES[field] + k
    if found is None or found[0].shape[-1] not in SIZES or place >= found[0].shape[-1]:
        return None
    sigma: np.ndarray = np.sqrt(np.maximum(found[0][:, place, place], 0.0))
    return sigma


def _label(axis: Axes, words: str, type_: ArrayType, band: bool) -> None:
    axis.set_title(words + (", with 3σ" if band else ""), loc="left", fontsize=9)
    axis.set_ylabel(_unit(type_))


def _error(axis: Axes, estimate: Series, truth: Series, field: str, k: int, start: int) -> None:
    """Estimate less truth (interpolated, where there is some), in the band the filter claims."""
    (value, type_), (right, _) = _need(estimate, field), _need(truth, field)
    nan = float("nan")
    reference = np.interp(estimate.time - start, truth.time - start, right[:, k], left=nan, right=nan)
    seconds = (estimate.time - start) * 1e-9
    sigma = _sigma(estimate, field, k)
    if sigma is not None:
        axis.fill_between(seconds, -3 * sigma, 3 * sigma, color=BAND, alpha=0.35, lw=0)
    axis.axhline(0, color=TRUTH, lw=0.6)
    axis.plot(seconds, value[:, k] - reference, color=COLOURS[k], lw=1.0)
    _label(axis, f"{field} error {'xyz'[k]}", type_, sigma is not None)


def _value(axis: Axes, estimate: Series, truth: Series | None, field: str, k: int, start: int) -> None:
    """The estimate itself, in the band the filter claims, and the truth where it is known."""
    value, type_ = _need(estimate, field)
    seconds = (estimate.time - start) * 1e-9
    sigma = _sigma(estimate, field, k)
    if sigma is not None:
        low, high = value[:, k] - 3 * sigma, value[:, k] + 3 * sigma
        axis.fill_between(seconds, low, high, color=BAND, alpha=0.35, lw=0)
    axis.plot(seconds, value[:, k], color=COLOURS[k], lw=1.0)
    known = None if truth is None else _find(truth, field)
    if truth is not None and known is not None:
        axis.plot((truth.time - start) * 1e-9, known[0][:, k], color=TRUTH, lw=0.9, ls="--")
    _label(axis, f"{field.replace('_', ' ')} {'xyz'[k]}", type_, sigma is not None)


def _angles(quaternion: np.ndarray, order: str = "zyx") -> np.ndarray:
    """(n, 3) roll, pitch and yaw in degrees, without jumps: R = Rz(yaw) Ry(pitch) Rx(roll), or for "zxy"
    R = Rz(yaw) Rx(roll) Ry(pitch)."""
    w, x, y, z = quaternion.T
    if order == "zxy":
        roll = np.arcsin(np.clip(2 * (w * x + y * z), -1.0, 1.0))
        pitch = np.arctan2(2 * (w * y - x * z), 1 - 2 * (x * x + y * y))
        yaw = np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z))
        return np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=-1), axis=0))
    roll = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    yaw = np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    return np.rad2deg(np.unwrap(np.stack([roll, pitch, yaw], axis=-1), axis=0))


def angle_rates(quaternion: np.ndarray, order: str = "zyx") -> np.ndarray:
    """E (n, 3, 3) with d(roll, pitch, yaw) = E d(rotation vector in the body).

    It has no bound where the middle angle is 90 degrees: the pitch of "zyx", the roll of "zxy".
    """
    roll, pitch, _ = np.deg2rad(_angles(quaternion, order)).T
    one, none = np.ones_like(roll), np.zeros_like(roll)
    if order == "zxy":
        s, c, level = np.sin(pitch), np.cos(pitch), np.maximum(np.abs(np.cos(roll)), 1e-3)
        slope = np.sin(roll) / level
        rows = ([c, none, s], [s * slope, one, -c * slope], [-s / level, none, c / level])
    else:
        s, c, level = np.sin(roll), np.cos(roll), np.maximum(np.abs(np.cos(pitch)), 1e-3)
        slope = np.sin(pitch) / level
        rows = ([one, s * slope, c * slope], [none, c, -s], [none, s / level, c / level])
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=1)


def _angle_sigma(estimate: Series, k: int, order: str = "zyx") -> np.ndarray | None:
    """(n,) degrees: the deviation of roll, pitch or yaw, from that of the rotation vector in the body.

    The band ends at 60 degrees: it has no bound where the angles fail.
    """
    found = _find(estimate, "covariance")
    if found is None or found[0].shape[-1] not in SIZES or found[0].shape[-1] < 9:
        return None
    P, q = found[0][:, 6:9, 6:9], _need(estimate, "attitude")[0]
    row = angle_rates(q, order)[:, k]
    variance = np.einsum("ni,nij,nj->n", row, P, row)
    return np.asarray(np.minimum(np.rad2deg(np.sqrt(np.maximum(variance, 0.0))), 60.0))


def _angle(
    axis: Axes, estimate: Series, truth: Series | None, k: int, start: int, order: str = "zyx"
) -> None:
    angle = _angles(_need(estimate, "attitude")[0], order)[:, k]
    sigma = _angle_sigma(estimate, k, order)
    if sigma is not None:
        seconds = (estimate.time - start) * 1e-9
        axis.fill_between(seconds, angle - 3 * sigma, angle + 3 * sigma, color=BAND, alpha=0.35, lw=0)
    axis.plot((estimate.time - start) * 1e-9, angle, color=COLOURS[k], lw=1.0)
    known = None if truth is None else _find(truth, "attitude")
    if truth is not None and known is not None:
        right = _angles(known[0], order)[:, k]
        begin = np.interp(0, truth.time - start, right)
        right = right + 360 * np.round((angle[0] - begin) / 360)  # the same turn as the estimate
        axis.plot((truth.time - start) * 1e-9, right, color=TRUTH, lw=0.9, ls="--")
    name = ("roll", "pitch", "yaw")[k] + (f" ({order})" if order != "zyx" else "")
    axis.set_title(name + (", with 3σ" if sigma is not None else ""), loc="left", fontsize=9)
    axis.set_ylabel("[deg]")


def _paths(estimate: Series, truth: Series | None) -> list[tuple[np.ndarray, dict[str, Any]]]:
    paths = [(_need(estimate, "position")[0], {"color": COLOURS[0], "lw": 1.2, "label": "estimate"})]
    if truth is not None:
        look = {"color": TRUTH, "lw": 1.0, "ls": "--", "label": "truth"}
        paths.append((_need(truth, "position")[0], look))
    return paths


def _space(axis: Any, estimate: Series, truth: Series | None) -> None:
    """The trajectory in space, to one scale on all axes; a flat one keeps some height."""
    paths = _paths(estimate, truth)
    for path, look in paths:
        axis.plot(*path.T, **look)
    points = np.concatenate([path for path, _ in paths])
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    span = high - low
    span = 1.08 * np.maximum(span, [0.3 * span.max() or 1.0] * 3)
    middle = (low + high) / 2
    axis.set(
        **{f"{name}lim": (middle[k] - span[k] / 2, middle[k] + span[k] / 2) for k, name in enumerate("xyz")}
    )
    axis.set_box_aspect(span, zoom=0.88)
    axis.locator_params(axis="z", nbins=3)
    unit = _need(estimate, "position")[1].unit
    for name in "xyz":
        getattr(axis, f"set_{name}label")(f"{name} [{unit}]" if unit else name, fontsize=8)
    axis.legend(loc="upper left", fontsize=8, frameon=False)


def _from_above(axis: Axes, estimate: Series, truth: Series | None) -> None:
    for path, look in _paths(estimate, truth):
        axis.plot(path[:, 0], path[:, 1], **look)
    axis.set_aspect("equal", adjustable="datalim")
    axis.set_title("from above", loc="left", fontsize=9)
    unit = _need(estimate, "position")[1].unit
    axis.set_xlabel(f"x [{unit}]" if unit else "x")
    axis.set_ylabel(f"y [{unit}]" if unit else "y")


__all__ = ["angle_rates", "plot_navigation", "plot_result", "plot_trajectory"]
