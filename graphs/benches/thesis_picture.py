"""What `bench thesis` shows: its errors with their intervals and bounds, beside the thesis's own.

A smoothed filter stands beside the filters; the dashed line is the bound of these. `draw` makes one picture,
and `write_page` a page with the same panels as charts, the table, and a flight of each filter to be looked at
and compared.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flowgraph import Flight
from flowgraph.drawing.consistency import error_of
from flowgraph.drawing.recorder import Recorder
from flowgraph.drawing.report_page import axis, chart, figure, report_page, safe, series, shown_runs, table
from flowgraph.drawing.run_page import describe_run
from flowgraph.engines.watched import simulate_watched

__all__ = ["draw", "drawn", "write_page"]

PANELS = (
    ("position_rmse_m", None, "position RMSE [m]"),
    ("attitude_rmse_deg", None, "attitude RMSE [deg]"),
    ("thesis_metric_position", "thesis_position", "mean squared position error [m²]"),
    ("thesis_metric_attitude", "thesis_attitude", "mean of |R − R_true|⁴ (Frobenius)"),
)
"""By column of the table: the column with the thesis's figure, if it has one, and the words."""

_TITLE = "Filters on the thesis's flights (motion capture, accelerometer, gyroscope)"


def draw(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    """Bars of the errors with their intervals and the bound, and the thesis's metric beside its figures."""
    drawn(rows).savefig(path, dpi=110)


def drawn(rows: Sequence[Mapping[str, Any]]) -> Any:
    """The figure of `draw`."""
    from matplotlib.figure import Figure  # slow to import, and only a picture needs it

    made = Figure(figsize=(13, 8), layout="constrained")
    for ax, panel in zip(made.subplots(2, 2).flat, PANELS, strict=True):
        _panel(ax, rows, *panel)
    made.suptitle(_TITLE)
    return made


def _png(rows: Sequence[Mapping[str, Any]], panel: tuple[str, str | None, str]) -> bytes:
    from matplotlib.figure import Figure  # slow to import, and only a picture needs it

    made = Figure(figsize=(9, 4.5), layout="constrained")
    _panel(made.subplots(), rows, *panel)
    sink = io.BytesIO()
    made.savefig(sink, format="png", dpi=110)
    return sink.getvalue()


def _placed(rows: Sequence[Mapping[str, Any]]) -> tuple[list[str], dict[str, Any], float]:
    """The settings, by filter its rows with the place of each, and the width of a bar."""
    codes, names = (
        [str(x) for x in dict.fromkeys(row[key] for row in rows)] for key in ("setting", "filter")
    )
    width = 0.8 / len(names)
    places = {}
    for n, name in enumerate(names):
        mine = [row for row in rows if row["filter"] == name]
        at = [codes.index(row["setting"]) + (n - 0.5 * (len(names) - 1)) * width for row in mine]
        places[name] = list(zip(at, mine, strict=True))
    return codes, places, width


def _panel(ax: Any, rows: Sequence[Mapping[str, Any]], key: str, published: str | None, label: str) -> None:
    codes, places, width = _placed(rows)
    for n, (name, placed) in enumerate(places.items()):
        at, values = np.array([x for x, _ in placed]), np.array([row[key] for _, row in placed])
        ax.bar(at, values, width * 0.95, label=name)
        if key == "position_rmse_m":
            ends = [[row["position_rmse_low_m"], row["position_rmse_high_m"]] for _, row in placed]
            ax.errorbar(at, values, np.abs(np.array(ends).T - values), fmt="none", ecolor="0.2", lw=1)
        if published:
            seen = [np.nan if row[published] is None else row[published] for _, row in placed]
            ax.plot(at, seen, "k_", ms=9, mew=2, label="thesis's figure" if n == 0 else None)
            ax.set_yscale("log")
    if published is None:
        for n, least in enumerate(_bounds(rows, codes, key)):
            ax.hlines(least, n - 0.45, n + 0.45, "k", "--", lw=1, label="bound" if n == 0 else None)
    ax.set_xticks(range(len(codes)), codes)
    ax.set_ylabel(label)
    ax.grid(axis="y", alpha=0.3)
    ax.set_ymargin(0.25)  # room for the legend
    ax.legend(fontsize=8, ncols=4, loc="upper left")


def _bounds(rows: Sequence[Mapping[str, Any]], codes: Sequence[str], key: str) -> list[float]:
    return [next(row[f"bound_{key}"] for row in rows if row["setting"] == code) for code in codes]


def write_page(
    rows: Sequence[Mapping[str, Any]], path: Path, *, words: str, flight: Flight, trials: Mapping[str, Any]
) -> None:
    """Write the page of the table.

    Args:
        words: how it was made.
        flight: that the filters are shown on.
        trials: by filter what runs it on this flight.
    """
    charts = [_chart(rows, *panel) for panel in PANELS]
    pictures = [figure(k, panel[2], _png(rows, panel)) for k, panel in enumerate(PANELS)]
    parts = [
        f"<section><p>{safe(words)}</p></section>", *pictures,
        f"<section><h2>Table</h2>{table(rows)}</section>",
        shown_runs(f"The filters on one flight, {flight.name}, in the first setting."),
    ]  # fmt: skip
    runs = [_shown(name, trial, flight, 1.0 / len(trials)) for name, trial in trials.items()]
    report_page("The thesis's experiment", _TITLE, parts, charts=charts, runs=runs, file=path)


def _chart(rows: Sequence[Mapping[str, Any]], key: str, published: str | None, label: str) -> dict[str, Any]:
    codes, places, width = _placed(rows)
    lines = []
    for name, placed in places.items():
        ends = None
        if key == "position_rmse_m":
            ends = [(row["position_rmse_low_m"], row["position_rmse_high_m"]) for _, row in placed]
        told = [f"{name}, {row['setting']}: {row[key]:.4g}" for _, row in placed]
        lines.append(series(name, "bar", [x for x, _ in placed], [row[key] for _, row in placed],
                            ends=ends, words=told, width=0.95 * width))  # fmt: skip
    marks = []
    if published:
        seen = [(x, row) for placed in places.values() for x, row in placed if row[published] is not None]
        told = [f"thesis, {row['filter']}, {row['setting']}: {row[published]:.4g}" for _, row in seen]
        lines.append(series("thesis's figure", "dash", [x for x, _ in seen],
                            [row[published] for _, row in seen], words=told, width=0.95 * width))  # fmt: skip
    else:
        marks = [
            {"name": "bound", "y": least, "from": n - 0.45, "to": n + 0.45}
            for n, least in enumerate(_bounds(rows, codes, key))
        ]
    return chart(label, axis("", names=codes), axis(label, log=published is not None), lines, marks=marks)


def _shown(name: str, trial: Any, flight: Flight, share: float) -> dict[str, Any]:
    """A filter's run on the flight, watched."""
    graph = trial.graph()
    recorder = Recorder(graph, trial.inputs, share)
    result = simulate_watched(graph, trial.inputs, recorder, init=trial.start)
    output = next(n for n in ("belief", "pose") if n in result.series)
    assert flight.truth is not None
    off, turned = (error_of(result[output], flight.truth, field) for field in ("position", "attitude"))
    assert off is not None
    assert turned is not None
    figures = {
        "position_rmse_m": float(np.sqrt(np.nanmean(np.sum(off**2, axis=1)))),
        "attitude_rmse_deg": float(np.degrees(np.sqrt(np.nanmean(np.sum(turned**2, axis=1))))),
    }
    return describe_run(graph, result, title=name, estimate=output, truth=flight.truth, inputs=trial.inputs,
                        recorder=recorder, figures=figures, share=share)  # fmt: skip
