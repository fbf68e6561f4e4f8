"""A state of any kind, number by number: what was estimated, how sure the filter was, and what was true.

A panel shows one number of the state in the band of three deviations that the filter claims, with the truth
over it where it is known. An angle that wraps is drawn as it is, in one turn, and its line is broken where it
jumps. Of innovations the residual is drawn in the band in which an honest filter expects it; these need no
truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.canvas import BAND, COLOURS, TRUTH
from flowgraph.errors import DataError
from flowgraph.types import leaves_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flowgraph.data.result import Result

__all__ = ["Quantity", "innovations_of", "plot_states", "seconds_of"]

_A_COLUMN = 6
_MOST = 36
_TURN = 360.0


@dataclass(frozen=True)
class Quantity:
    """One number over time.

    Args:
        name: over the panel.
        seconds: (n,) since the start.
        values: (n,) estimated.
        unit: "m", or "" where none is known.
        deviation: (n,) that the filter claims; None where it claims none.
        truth: (n,) at the same times, NaN where it is not known; None where there is none.
        turns: whether it is an angle in degrees that wraps at half a turn.
        dots: whether its values stand for themselves, without a line.
    """

    name: str
    seconds: np.ndarray
    values: np.ndarray
    unit: str = ""
    deviation: np.ndarray | None = None
    truth: np.ndarray | None = None
    turns: bool = False
    dots: bool = False


def innovations_of(result: Result) -> list[Quantity]:
    """The residuals of all innovations of a run, in the band of their own covariance about zero."""
    found = []
    for name, series in result.series.items():
        if not {"residual", "covariance"} <= set(series.leaves) or not len(series):
            continue
        r, S = series["residual"], series["covariance"]
        units = dict(leaves_of(series.type))["residual"].unit or ""
        for k in range(r.shape[-1]):
            found.append(
                Quantity(
                    name if r.shape[-1] == 1 else f"{name} {k}",
                    seconds_of(series, result),
                    r[:, k],
                    units if "," not in units else "",
                    canvas.deviation(S[:, k, k]),
                    dots=True,
                )
            )
    return found


@canvas.picture
def plot_states(
    quantities: Sequence[Quantity], file: str | Path | None = None, *, heading: str = ""
) -> Figure:
    """A figure with a panel a quantity; written to `file` if given.

    Args:
        quantities: to draw; of more than 36 the first.
        file: ending in .png, .svg or .pdf.
        heading: over all.

    Raises:
        DataError: where there is nothing to draw. UnknownNameError: for another ending.
    """
    if not quantities:
        raise DataError(
            "there is nothing to plot",
            path=heading or "plot_states",
            expected="at least one quantity",
            got="none",
            fix="collect the belief of the filter, or its innovations",
        )
    shown = quantities[:_MOST]
    columns = -(-len(shown) // _A_COLUMN)
    rows = -(-len(shown) // columns)
    figure = canvas.new_figure(8.5 if columns == 1 else 5.5 * columns, 1.9 * rows + 0.7)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    for axis, quantity in zip(axes, shown, strict=False):
        _panel(axis, quantity)
    for axis in axes[len(shown) :]:
        axis.remove()
    for column in range(columns):
        lowest = axes[min((column + 1) * rows, len(shown)) - 1]
        lowest.set_xlabel("time since the start [s]")
        lowest.tick_params(labelbottom=True)
    if heading:
        canvas.heading(figure, heading)
    if len(shown) < len(quantities):
        canvas.footnotes(figure, [f"not drawn: {', '.join(q.name for q in quantities[_MOST:])}"])
    return canvas.save(figure, file)


def _panel(axis: Axes, q: Quantity) -> None:
    t, x = q.seconds, q.values
    drawn = [x]
    around = bool(q.turns and (np.abs(np.diff(x[np.isfinite(x)])) > _TURN / 2).any())
    if q.deviation is not None:
        middle = np.zeros(len(t)) if q.dots else x
        width = np.minimum(3.0 * q.deviation, _TURN / 2) if q.turns else 3.0 * q.deviation
        for turn in (-_TURN, 0.0, _TURN) if around else (0.0,):
            parts = [broken(t, middle + turn + side * width, around) for side in (-1.0, 1.0)]
            axis.fill_between(parts[0][0], parts[0][1], parts[1][1], color=BAND, alpha=0.35, lw=0)
        canvas.mark_broken(axis, t, np.isnan(q.deviation))
        drawn += [middle - width, middle + width]
    if q.dots:
        axis.axhline(0.0, color=TRUTH, lw=0.6)
        axis.plot(t, x, ".", ms=3, color=COLOURS[0])
    else:
        axis.plot(*broken(t, x, around), color=COLOURS[0], lw=1.0)
    if q.truth is not None:
        axis.plot(*broken(t, q.truth, q.turns), color=TRUTH, lw=0.9, ls="--")
    axis.set_ylabel(f"[{q.unit}]" if q.unit else "")
    canvas.title(axis, q.name + (", with 3σ" if q.deviation is not None else ""))
    if canvas.nothing_here(axis, x):
        return
    if around:
        axis.set_ylim(-_TURN / 2, _TURN / 2)
    else:
        canvas.scale_when_settled(axis, t, *drawn)


def broken(seconds: np.ndarray, values: np.ndarray, turns: bool) -> tuple[np.ndarray, np.ndarray]:
    """A line with a gap where an angle in degrees jumps by more than half a turn."""
    if not turns:
        return seconds, values
    jumps = np.flatnonzero(np.abs(np.diff(values)) > _TURN / 2) + 1
    return np.insert(seconds, jumps, seconds[jumps]), np.insert(values, jumps, np.nan)


def seconds_of(series: Series, result: Result) -> np.ndarray:
    """(n,) times of a series since the first of a run."""
    start = min(int(s.time[0]) for s in result.series.values() if len(s))
    return (series.time - start) * 1e-9
