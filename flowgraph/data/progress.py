"""A progress bar for long runs.

    with ProgressBar("ins_eskf", total=inputs) as bar:
        simulate(built, inputs, progress=bar)

A run tells any object with a method `update(ticks, time)` how far it is; this one draws a bar in a terminal.
In a notebook it is a bar in the cell. It is imported only where it is used, and with it `rich`.
"""

from __future__ import annotations

import html
import sys
from collections.abc import Mapping
from time import monotonic
from types import TracebackType
from typing import Any

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from flowgraph.data.flight import Flight
from flowgraph.data.series import Series
from flowgraph.errors import DeclarationError


class ProgressBar:
    """How far a run is, as a bar on standard error, with the time that remains; gone when the run ends.

    In a notebook it stands in the cell, and stays when the run ends. Nothing is drawn where standard error is
    neither a terminal nor a notebook's, so a log stays clean.

    Args:
        name: what stands before the bar.
        total: how many ticks there will be (of `simulate_many`: runs), or the inputs, whose ticks are
            counted. Left out, or for inputs that do not tell, the bar only shows that there is progress.
        console: a `rich` console to draw on; standard error if left out.
    """

    def __init__(self, name: str = "run", *, total: Any = None, console: Console | None = None) -> None:
        self.ticks = 0
        """Ticks done so far."""
        self.total = tick_count(total) if isinstance(total, Flight | Mapping) else total
        """Ticks to come in all, or None."""
        whole = isinstance(self.total, int | np.integer) and not isinstance(self.total, bool)
        if self.total is not None and not (whole and self.total >= 0):
            raise DeclarationError(
                "this is no number of ticks",
                path=name,
                expected="a whole number, inputs, or None",
                got=repr(total),
                fix="write ProgressBar(name, total=inputs)",
            )
        self._console = console or Console(stderr=True)
        columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        visible = self._console.is_terminal
        self._name = name
        self._cell = None if visible or console is not None else _cell_of_notebook()
        self._shown = -np.inf  # when the cell was last drawn, in s
        self._progress = Progress(*columns, console=self._console, transient=True, disable=not visible)
        self._task = self._progress.add_task(name, total=self.total)

    def update(self, ticks: int, time: int) -> None:
        """`ticks` are done; `time`, of the last in ns, is not shown."""
        self.ticks = ticks
        self._progress.update(self._task, completed=ticks)
        self._draw()

    def _draw(self, last: bool = False) -> None:
        """Draw the bar of a notebook, ten times a second at most."""
        if self._cell is not None and (last or monotonic() - self._shown > 0.1):
            self._shown = monotonic()
            self._cell.update(_Bar(self._name, self.ticks, self.total))

    def __enter__(self) -> ProgressBar:
        self._progress.start()
        if self._cell is not None:
            self._cell.display(_Bar(self._name, self.ticks, self.total))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()
        self._draw(last=True)


class _Bar:
    """What stands in a cell: a bar where the end is known, and the numbers."""

    def __init__(self, name: str, ticks: int, total: int | None) -> None:
        self._name, self._ticks, self._total = name, ticks, total

    def _repr_html_(self) -> str:
        bar = (
            "" if self._total is None else f'<progress value="{self._ticks}" max="{self._total}"></progress> '
        )
        return f"{html.escape(self._name)} {bar}{self._count()}"

    def __repr__(self) -> str:
        return f"{self._name} {self._count()}"

    def _count(self) -> str:
        return f"{self._ticks}" + ("" if self._total is None else f"/{self._total}")


def _cell_of_notebook() -> Any:
    """Where a notebook's cell can be drawn anew; None outside of one."""
    if "IPython" not in sys.modules:
        return None
    from IPython import get_ipython  # only there where a notebook runs
    from IPython.display import DisplayHandle  # likewise

    shell = get_ipython()
    made: Any = DisplayHandle
    return made() if shell is not None and hasattr(shell, "kernel") else None


def tick_count(inputs: Flight | Mapping[str, Any]) -> int | None:
    """How many ticks recorded inputs make, where events of one time are one; None for an iterable."""
    given = inputs.streams if isinstance(inputs, Flight) else inputs
    times = []
    for value in given.values():
        if isinstance(value, Series):
            times.append(value.time)
        elif isinstance(value, tuple) and len(value) == 2:
            times.append(np.asarray(value[0]).ravel())
        else:
            return None
    return len(np.unique(np.concatenate(times))) if times else 0


__all__ = ["ProgressBar", "tick_count"]
