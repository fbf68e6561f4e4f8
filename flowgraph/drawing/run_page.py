"""The page of a run: the diagram with what flowed in it, beside scopes, the way in space, and a slider.

What is on the wires at the time of the slider comes from a recorder that watched the run; without one, the
page has the scopes and the way, and says so. A page can hold several runs, to be picked and compared: those
that were put in it before can be read out of it again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.drawing.angles import between
from flowgraph.drawing.fields import find
from flowgraph.drawing.model import describe
from flowgraph.drawing.page import page, written
from flowgraph.drawing.recorder import Recorder, packed
from flowgraph.drawing.scopes import POINTS, Scopes, extremes
from flowgraph.errors import DataError
from flowgraph.language.graph import Graph

WAY, SEEN = 4000, 3000
"""Points of a way in space, and of what a sensor said of it."""

_GNSS = re.compile(r"gps|gnss|fix", re.IGNORECASE)
_STORED = re.compile(r'<script type="application/json" id="runs">(.*?)</script>', re.DOTALL)


def describe_run(
    graph: Graph,
    result: Result,
    *,
    title: str,
    estimate: str,
    truth: Series | None = None,
    inputs: Mapping[str, Series] | None = None,
    order: str = "zyx",
    recorder: Recorder | None = None,
    figures: Mapping[str, Any] | None = None,
    notes: Sequence[str] = (),
    share: float = 1.0,
) -> dict[str, Any]:
    """One run in plain lists and texts, for `run_page`.

    Args:
        graph: that was run.
        title: by which the run is picked.
        estimate: name of the collected stream that the truth is compared with.
        inputs: the recorded streams that were fed, by source.
        order: convention of roll, pitch and yaw.
        recorder: that watched the run.
        figures: the table of figures.
        notes: sentences.
        share: of the points that a page of one run has, for one of several.
    """
    known = dict(inputs or {})
    scopes = Scopes(result, estimate, truth, known, order, int(share * POINTS))
    panels = scopes.panels()
    took = {} if recorder is None else recorder.blocks
    blocks = {path: [1e6 * seconds / max(times, 1), times] for path, (seconds, times) in took.items()}
    return {
        "title": title,
        "graph": describe(graph, inputs=known),
        "engine": result.engine,
        "ticks": result.ticks,
        "end": max(
            (float(s.time[-1] - scopes.begin) * 1e-9 for s in result.series.values() if len(s)), default=0.0
        ),
        "figures": [[key, _figure(value)] for key, value in (figures or {}).items()],
        "notes": list(dict.fromkeys((*notes, *scopes.notes))),
        "times": scopes.times,
        "panels": panels,
        "watch": None if recorder is None else recorder.data(scopes.begin),
        "blocks": blocks,
        "way": _way(scopes.estimate, truth, known, scopes.begin),
    }


def run_page(runs: Sequence[Mapping[str, Any]], file: str | Path | None = None) -> str | Path:
    """A page of one or several runs, as `describe_run` gives them; written to `file`, or returned as text.

    Raises:
        OutputError: where the file cannot be written.
    """
    names = list(dict.fromkeys(str(run["graph"]["name"]) for run in runs))
    words = runs[0]["title"] if len(runs) == 1 else f"{len(runs)} runs"
    return written(page("run", ", ".join(names), words, {"runs": list(runs)}, ("diagram", "run")), file)


def runs_of_page(file: str | Path) -> list[dict[str, Any]]:
    """The runs in a page that `run_page` has written, to put others beside them.

    Raises:
        DataError: for a file that is no such page.
    """
    stored = _STORED.search(Path(file).read_text(encoding="utf-8", errors="replace"))
    if stored is None:
        raise DataError(
            "there are no runs in this file", path=str(file), expected="a page of runs, written before",
            got="another file", fix="name another file, or leave out the option that keeps its runs",
        )  # fmt: skip
    found: list[dict[str, Any]] = json.loads(stored[1])
    return found


def _figure(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _way(
    estimate: Series | None, truth: Series | None, inputs: Mapping[str, Series], begin: int
) -> dict[str, Any] | None:
    """Where the body was: the estimate and the truth at the same times, and what sensors said."""
    found = None if estimate is None else find(estimate, "position")
    if estimate is None or found is None or not len(estimate) or found[0].ndim != 2:
        return None
    path = _in_space(found[0])
    at = extremes(list(path.T), WAY)
    turn = find(estimate, "attitude")
    made: dict[str, Any] = {
        "t": packed((estimate.time[at] - begin) * 1e-9),
        "estimate": packed(path[at]),
        "attitude": packed(turn[0][at]) if turn is not None and turn[0].shape[1:] == (4,) else None,
        "truth": None,
        "unit": found[1].unit or "",
        "seen": [],
    }
    if truth is not None and len(truth) and find(truth, "position") is not None:
        made["truth"] = packed(_in_space(between(truth, "position", estimate.time[at])))
    for name, series in inputs.items():
        seen = find(series, "position")
        if seen is not None and seen[0].ndim == 2 and seen[0].shape[1] in (2, 3) and len(series):
            some = slice(None, None, -(-len(series) // SEEN))
            made["seen"].append({
                "name": name, "gnss": bool(_GNSS.search(name)),
                "t": packed((series.time[some] - begin) * 1e-9), "places": packed(_in_space(seen[0][some])),
            })  # fmt: skip
    return made


def _in_space(places: np.ndarray) -> np.ndarray:
    """(n, 3), with zeros for a height that a plane has not."""
    return np.pad(places[:, :3], ((0, 0), (0, max(3 - places.shape[1], 0))))


__all__ = ["describe_run", "run_page", "runs_of_page"]
