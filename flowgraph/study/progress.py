"""How a study goes, told while it runs: a live table for a person, lines of JSON for a program, or nothing.

The rate is that of the last half minute, so that what remains is not judged by how slow the start was.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Sequence
from time import perf_counter
from typing import IO, Any

from rich.console import Console
from rich.live import Live
from rich.markup import escape
from rich.table import Table

from flowgraph.study.execution import Outcome, Watcher
from flowgraph.study.spec import Study
from flowgraph.study.store import Row

_WINDOW = 30.0
_LINES_EVERY = 10.0


class Tally(Watcher):
    """Counts what the others show: done, failed, rate, remaining time and the best so far of each graph.

    Args:
        study: whose first metric is compared, or where it names none the first that comes; less is better.
        clock: seconds that only grow.
    """

    def __init__(self, study: Study, *, clock: Callable[[], float] = perf_counter) -> None:
        self.study, self._clock = study, clock
        self.metric: str | None = study.metrics[0] if study.metrics else None
        self.total = self.kept = self.done = self.failed = 0
        self.best: dict[str, Row] = {}
        self._recent: deque[float] = deque()
        self._began = clock()

    def start(self, total: int, kept: Sequence[Row]) -> None:
        self.total, self.kept, self._began = total, len(kept), self._clock()
        for row in kept:
            self._count(row)

    def row(self, row: Row) -> None:
        self.done += 1
        self._recent.append(self._clock())
        self._count(row)

    def _count(self, row: Row) -> None:
        if row.get("error") is not None:
            self.failed += 1
            return
        if self.metric is None:
            names = (n for n, v in row.items() if isinstance(v, float) and not n.endswith("_s"))
            self.metric = next((n for n in names if n not in self.study.names()), None)
        value = row.get(self.metric or "")
        best = self.best.get(row["graph"])
        if not isinstance(value, int | float) or not math.isfinite(value):
            return
        if best is None or value < best[self.metric or ""]:
            self.best[row["graph"]] = row

    @property
    def rate(self) -> float:
        """Runs a second of late."""
        now = self._clock()
        while self._recent and self._recent[0] < now - _WINDOW:
            self._recent.popleft()
        return len(self._recent) / max(min(now - self._began, _WINDOW), 1e-9)

    @property
    def remaining(self) -> float | None:
        """Seconds to the end at this rate; None while nothing is known."""
        left = self.total - self.kept - self.done
        return 0.0 if not left else left / self.rate if self.rate else None


class Lines(Tally):
    """A line of plain text now and then, for a log."""

    def __init__(self, study: Study, console: Console, **more: Any) -> None:
        super().__init__(study, **more)
        self._console, self._said = console, -math.inf

    def start(self, total: int, kept: Sequence[Row]) -> None:
        super().start(total, kept)
        self._console.print(f"{total} runs, {len(kept)} of them there already", markup=False)

    def row(self, row: Row) -> None:
        super().row(row)
        if self._clock() - self._said > _LINES_EVERY:
            self._said = self._clock()
            self._console.print(self._line(), markup=False)

    def _line(self) -> str:
        at = f"{self.kept + self.done} of {self.total}"
        at += f", {self.rate:.3g} runs/s, {duration(self.remaining)} left"
        return at + (f", {self.failed} failed" if self.failed else "")


class LiveTable(Tally):
    """A table that is drawn over itself in a terminal, and gone at the end."""

    def __init__(self, study: Study, console: Console, **more: Any) -> None:
        super().__init__(study, **more)
        self._looking = ""
        self._live = Live(get_renderable=self.table, console=console, refresh_per_second=4, transient=True)
        self._live.start()

    def planning(self, described: int, total: int) -> None:
        self._looking = f"{described} of {total} settings looked at"

    def end(self, outcome: Outcome) -> None:
        self.stop()

    def stop(self) -> None:
        self._live.stop()

    def table(self) -> Table:
        """What is shown now."""
        table = Table(box=None, pad_edge=False, show_header=False)
        table.add_column(style="bold")
        table.add_column()
        if not self.total:
            table.add_row("study", self._looking or "looking at what is there")
            return table
        there = self.kept + self.done
        table.add_row("runs", f"{there} of {self.total} ({100 * there // self.total} %), {self.kept} kept")
        table.add_row("rate", f"{self.rate:.3g} a second, {duration(self.remaining)} left")
        table.add_row("failed", f"[red]{self.failed}[/]" if self.failed else "0")
        for graph, row in self.best.items():
            at = ", ".join(f"{n}={row[n]}" for n in self.study.names() if row.get(n) is not None)
            where = f"{row['data']}, seed {row['seed']}" + (f", {at}" if at else "")
            value = row[self.metric or ""]
            table.add_row(f"best {escape(graph)}", escape(f"{self.metric} {value:.4g}: {where}"))
        return table


class JsonLines(Tally):
    """An object a line: `start`, a `run` for each row, and `end`."""

    def __init__(self, study: Study, stream: IO[str], **more: Any) -> None:
        super().__init__(study, **more)
        self._stream = stream

    def start(self, total: int, kept: Sequence[Row]) -> None:
        super().start(total, kept)
        self._say(event="start", runs=total, kept=len(kept), failed=self.failed)

    def row(self, row: Row) -> None:
        super().row(row)
        left = self.remaining
        self._say(
            event="run", done=self.kept + self.done, runs=self.total, failed=self.failed,
            rate=self.rate, remaining_s=left, row=row,
        )  # fmt: skip

    def end(self, outcome: Outcome) -> None:
        self._say(event="end", **summary(outcome))

    def _say(self, **what: Any) -> None:
        self._stream.write(json.dumps(finite(what), allow_nan=False) + "\n")
        self._stream.flush()


def summary(outcome: Outcome) -> dict[str, Any]:
    """The outcome in numbers."""
    return {
        "runs": len(outcome.rows),
        "done": outcome.done,
        "kept": outcome.kept,
        "failed": len(outcome.failed),
        "seconds": outcome.seconds,
        "interrupted": outcome.interrupted,
        "folder": str(outcome.folder),
    }


def finite(value: Any) -> Any:
    """The same with null in place of what JSON has no number for."""
    if isinstance(value, dict):
        return {n: finite(v) for n, v in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value


def duration(seconds: float | None) -> str:
    """Seconds as a person says them."""
    if seconds is None:
        return "?"
    whole = round(seconds)
    if whole < 60:
        return f"{whole} s"
    if whole < 3600:
        return f"{whole // 60} min {whole % 60:02d} s"
    return f"{whole // 3600} h {whole % 3600 // 60:02d} min"
