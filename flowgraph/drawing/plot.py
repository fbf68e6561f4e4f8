"""Plots of what a run gave back, a panel a field.

A panel shows one field over time, with the unit and frame that its type declares on the axis, so that nobody
has to guess. What is not drawn is said at the foot of the figure: fields too large for lines, and fields that
never change, which need no panel to be read.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.fields import components, unit_words
from flowgraph.drawing.navigation import plot_navigation, plot_trajectory
from flowgraph.errors import DataError
from flowgraph.types import ArrayType, leaves_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from flowgraph.data.result import Result

MOST_COMPONENTS = 6
PANELS_A_COLUMN = 8
FEW = 20
"""So many values that are all the same may be chance; from here on they are a constant."""


@dataclass(frozen=True)
class _Panel:
    words: str
    unit: str
    names: tuple[str, ...]
    colours: tuple[str, ...]
    seconds: np.ndarray
    values: np.ndarray
    broken: np.ndarray  # (n,) where a variance has no root
    dots: bool


@canvas.picture
def plot_result(
    result: Result, file: str | Path | None = None, *, outputs: Sequence[str] | None = None
) -> Figure:
    """A figure with one panel a field of the collected streams; written to `file` if given.

    Vectors of up to six components are drawn as lines, with a panel for each unit where the components have
    several (`unit="m, rad"`); small square matrices as the roots of their diagonal, with a gap and a mark
    where a variance is below zero. What is larger, and what is the same all the time, is named at the foot.
    Streams much slower than the fastest are drawn as dots.

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
    panels: list[_Panel] = []
    still: list[tuple[str, list[_Panel]]] = []
    large: list[str] = []
    for name, series in shown.items():
        dots = _interval(series) > 5 * fastest or len(series) < 2
        for (field, type_), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
            words = name if field == "value" else f"{name}.{field}"
            drawn = _drawable(array)
            if drawn is None:
                large.append(f"{words} ({' × '.join(map(str, array.shape[1:]))})")
                continue
            made = list(_panels_of(words, field, type_, (series.time - start) * 1e-9, array, drawn, dots))
            if len(series) >= FEW and np.isfinite(drawn).all() and (drawn == drawn[0]).all():
                value = ", ".join(f"{v:.4g}" for v in np.atleast_1d(drawn[0]))
                still.append((f"{made[0].words} = {value}", made))
            else:
                panels += made
    if not panels:  # all that there is, then
        panels, still = [panel for _, made in still for panel in made], []
    if not panels:
        raise DataError(
            "there is nothing to plot", path=result.graph, got=", ".join(shown) or "no outputs",
            expected=f"a stream with a field of at most {MOST_COMPONENTS} components",
            fix='collect a part of the stream: collect(stream.map(lambda v: v.part), "part")',
        )  # fmt: skip
    figure = _laid_out(panels)
    canvas.heading(figure, f"{result.graph}  ({result.engine}, {result.ticks} ticks)")
    foot = [f"always the same: {words}" for words, _ in still]
    foot += [f"more than {MOST_COMPONENTS} components, not drawn: {words}" for words in large]
    if foot:
        canvas.footnotes(figure, foot)
    return canvas.save(figure, file)


def _laid_out(panels: Sequence[_Panel]) -> Figure:
    """The panels in columns of one time axis, which has its numbers at the foot of each."""
    columns = -(-len(panels) // PANELS_A_COLUMN)
    rows = -(-len(panels) // columns)
    figure = canvas.new_figure(8.5 if columns == 1 else 5.5 * columns, 1.9 * rows + 0.7)
    axes = figure.subplots(rows, columns, sharex=True, squeeze=False).T.ravel()
    for axis, panel in zip(axes, panels, strict=False):
        _draw(axis, panel)
    for axis in axes[len(panels) :]:
        axis.remove()
    for column in range(columns):
        lowest = axes[min((column + 1) * rows, len(panels)) - 1]
        lowest.set_xlabel("time since the start [s]")
        lowest.tick_params(labelbottom=True)
    return figure


def _draw(axis: Axes, panel: _Panel) -> None:
    marker = "." if panel.dots or len(panel.seconds) <= 60 else None
    style: dict[str, Any] = {"ls": "none"} if panel.dots else {"lw": 1.0}
    for k, (name, colour) in enumerate(zip(panel.names, panel.colours, strict=True)):
        axis.plot(panel.seconds, panel.values[:, k], color=colour, marker=marker, ms=4, label=name, **style)
    axis.set_ylabel(panel.unit)
    above = canvas.legend(axis, panel.names) if len(panel.names) > 1 else 0
    canvas.title(axis, panel.words, above=above)
    canvas.nothing_here(axis, panel.values)
    canvas.mark_broken(axis, panel.seconds, panel.broken)


def _interval(series: Series) -> float:
    """The typical time between two values, in ns."""
    return float(np.median(np.diff(series.time))) if len(series) > 1 else np.inf


def _panels_of(
    words: str, field: str, type_: ArrayType, seconds: np.ndarray, array: np.ndarray, drawn: np.ndarray,
    dots: bool,
) -> Iterator[_Panel]:  # fmt: skip
    """One panel, or one a unit where a vector's components have several."""
    n = drawn.shape[1]
    if array.ndim == 3:
        words += ": square roots of the diagonal"
    broken = np.isnan(drawn).any(axis=1) if array.ndim == 3 else np.zeros(len(drawn), bool)
    names = np.array(components(field, n))
    units = [part.strip() for part in (type_.unit or "").split(",")]
    if len(units) != n or len(set(units)) == 1:
        units = [type_.unit or ""] * n
    for unit in dict.fromkeys(units):
        at = [k for k in range(n) if units[k] == unit]
        own = words if len(at) == n else f"{words} {', '.join(names[at])}"
        yield _Panel(
            own, unit_words(unit, type_.frame), tuple(names[at]), tuple(canvas.COLOURS[k] for k in at),
            seconds, drawn[:, at], broken, dots,
        )  # fmt: skip


def _drawable(array: np.ndarray) -> np.ndarray | None:
    """(n, components) to draw, or None for what is too large."""
    if array.ndim == 3 and array.shape[1] == array.shape[2]:
        array = canvas.deviation(np.diagonal(array, axis1=1, axis2=2).astype(float))
    if array.ndim == 1:
        array = array[:, None]
    return array.astype(float) if array.ndim == 2 and 1 <= array.shape[1] <= MOST_COMPONENTS else None


__all__ = ["plot_navigation", "plot_result", "plot_trajectory"]
