"""The sheet that pictures are drawn on, and what all of them have in common.

A picture goes to a file or a page, so it must come out the same wherever it is made. What a person's session
does to matplotlib stays outside: a backend that a notebook's kernel has named for its child processes, a
matplotlibrc that wants TeX. Figures are made without pyplot; they need no display and keep no global state.

A picture must not flatter either. A variance below zero has no root, so its band has a gap and a mark, not
the width of certainty; values that are not there are said to be missing; and where the first moments, in
which a filter is still finding itself, would set the scale for the rest, the axis is that of the rest and
says so.
"""

from __future__ import annotations

import functools
import io
import os
import sys
import textwrap
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar

import numpy as np

from flowgraph.data.files import whole
from flowgraph.errors import MissingDependencyError, UnknownNameError, writes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ENDINGS = (".png", ".svg", ".pdf")
COLOURS = ("#3b6ea8", "#c8792b", "#4f8a5b", "#a85a6d", "#7a68a8", "#8b8378")
TRUTH, BAND, WRONG = "#22303c", "#9db4d0", "#c0392b"
TITLE, SMALL = 9, 7
SETTLING = 0.1
"""The share of a recording in which a filter may still be finding itself."""

_P = ParamSpec("_P")
_R = TypeVar("_R")
_alone = threading.RLock()  # the settings of matplotlib are of the whole process


def picture(draw: Callable[_P, _R]) -> Callable[_P, _R]:
    """Draw with matplotlib as it is by itself, whatever this process, its user or its parent have set."""

    @functools.wraps(draw)
    def drawn(*args: _P.args, **kwargs: _P.kwargs) -> _R:
        with plain_matplotlib():
            return draw(*args, **kwargs)

    return drawn


@contextmanager
def plain_matplotlib(settings: Mapping[str, Any] | None = None) -> Iterator[None]:
    """Matplotlib's own defaults and these settings inside, what was set before outside.

    Raises:
        MissingDependencyError: where matplotlib is not installed.
    """
    with _alone:
        first = "matplotlib" not in sys.modules
        matplotlib = _matplotlib()
        if first and "MPLBACKEND" in os.environ:
            with suppress(ValueError):  # it is left as it would be without us, for whoever shows a window
                matplotlib.rcParams["backend"] = os.environ["MPLBACKEND"]
    with _alone, matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(settings or {})
        yield


def _matplotlib() -> ModuleType:
    """Matplotlib, also where the environment names a backend that only its parent process has."""
    named = os.environ.pop("MPLBACKEND", None)
    try:
        import matplotlib  # may be absent, and is slow to import
    except ImportError:
        raise MissingDependencyError(
            "plots need matplotlib", expected="the Python package matplotlib", got="it cannot be imported",
            fix="pip install matplotlib",
        ) from None  # fmt: skip
    finally:
        if named is not None:
            os.environ["MPLBACKEND"] = named
    return matplotlib


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of a size in inches; to be called in a function that is a `picture`.

    It shows itself in a notebook, where a figure that pyplot has not made otherwise would not.
    """
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(width, height), layout="constrained")
    figure.__dict__["_repr_png_"] = functools.partial(png, figure)
    return figure


def png(figure: Figure) -> bytes:
    """A figure as the content of a PNG file, as large as a cell of a notebook."""
    content = io.BytesIO()
    figure.savefig(content, dpi=90, format="png")
    return content.getvalue()


def save(figure: Figure, file: str | Path | None) -> Figure:
    """Give all axes one look, and write the figure where a file is named.

    Raises:
        UnknownNameError: for an ending other than .png, .svg and .pdf.
        OutputError: where the file cannot be written.
    """
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


def heading(figure: Figure, words: str) -> None:
    """What the whole figure shows, over all of it."""
    wide = max(int(11 * figure.get_figwidth()), 20)
    figure.suptitle("\n".join(textwrap.wrap(words, wide)), x=0.01, ha="left", fontsize=11)


def footnotes(figure: Figure, lines: Sequence[str]) -> None:
    """What a reader should know of what is not drawn, below all panels."""
    wide = max(int(17 * figure.get_figwidth()), 20)
    words = "\n".join("\n".join(textwrap.wrap(line, wide, subsequent_indent="    ")) for line in lines)
    figure.supxlabel(words, x=0.01, ha="left", fontsize=SMALL, color=TRUTH)


def title(axis: Any, words: str, *, above: int = 0) -> None:
    """A title over the left end of an axis, in as many lines as its width asks for.

    Args:
        above: points to leave free below it, such as for a legend.
    """
    figure = axis.figure
    inches = figure.get_figwidth() * axis.get_subplotspec().get_position(figure).width
    lines = textwrap.wrap(words, max(int(13 * inches), 20), break_on_hyphens=False)
    axis.set_title("\n".join(lines), loc="left", fontsize=TITLE, pad=4 + above)


def legend(axis: Axes, names: Sequence[str]) -> int:
    """The names of the lines in one row over the axis; returns the points that they take below a title."""
    place: dict[str, Any] = {"loc": "lower left", "bbox_to_anchor": (0.0, 1.0), "borderaxespad": 0.0}
    axis.legend(fontsize=SMALL, ncols=len(names), frameon=False, borderpad=0.1, **place)
    return 11


def mark_ends(axis: Any, path: np.ndarray) -> None:
    """Where a way (n, 2 or 3) starts and where it ends."""
    there = path[np.isfinite(path).all(axis=1)]
    if len(there):
        axis.plot(*there[:1].T, "o", ms=5, mfc="white", mec=COLOURS[0], label="start")
        axis.plot(*there[-1:].T, "s", ms=5, color=COLOURS[0], label="end")


def dot(many: int) -> float:
    """The size of a dot, in points, that is seen where there are few of them and hides nothing where many."""
    return 3.5 if many <= 300 else 2.5 if many <= 1000 else 1.5


def nothing_here(axis: Axes, values: np.ndarray) -> bool:
    """Say on an axis that none of its values is a number; False where one is."""
    if np.isfinite(values).any():
        return False
    words = "no values" if not values.size else f"none of {len(values)} values is finite"
    axis.text(0.5, 0.5, words, transform=axis.transAxes, ha="center", va="center", fontsize=8, color=WRONG)
    axis.set_yticks([])
    return True


def deviation(variance: np.ndarray) -> np.ndarray:
    """The root of a variance; NaN, which is drawn as a gap, where it is below zero."""
    root = np.full(np.shape(variance), np.nan)
    np.sqrt(variance, out=root, where=np.asarray(variance) >= 0.0)
    return root


def mark_broken(axis: Axes, seconds: np.ndarray, broken: np.ndarray) -> None:
    """Marks along the foot of an axis at the times at which a variance is below zero or no number."""
    wrong: np.ndarray = np.asarray(broken, dtype=bool)
    if wrong.any():
        axis.plot(
            seconds[wrong], np.zeros(int(wrong.sum())), "|", ms=7, mew=1.2, color=WRONG,
            transform=axis.get_xaxis_transform(), clip_on=False,
        )  # fmt: skip
        words = f"no variance at {int(wrong.sum())} of {len(wrong)} times"
        axis.text(0.99, 0.03, words, transform=axis.transAxes, ha="right", fontsize=SMALL, color=WRONG)


def scale_when_settled(axis: Axes, seconds: np.ndarray, *drawn: np.ndarray) -> None:
    """Choose the range of an axis for what comes after the start, where the start would hide it.

    Args:
        seconds: (n,) times.
        drawn: arrays (n,) that are on the axis: a line, the ends of its band.
    """
    if len(seconds) < 20:
        return
    late = seconds > seconds[0] + SETTLING * (seconds[-1] - seconds[0])
    every, after = _range(np.stack(drawn)), _range(np.stack([d[late] for d in drawn]))
    span = after[1] - after[0]
    if span > 0 and every[1] - every[0] > 3 * span:
        axis.set_ylim(after[0] - 0.15 * span, after[1] + 0.15 * span)
        words = f"the start reaches {every[0]:.2g} to {every[1]:.2g}"
        axis.text(0.99, 0.97, words, transform=axis.transAxes, ha="right", va="top", fontsize=SMALL)


def _range(values: np.ndarray) -> tuple[float, float]:
    finite = values[np.isfinite(values)]
    return (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
