"""The report of a study: one page with tables and charts, and the charts as PNG beside it.

Nothing in the page comes from elsewhere. The worst runs are listed with the command that runs each again, and
with a link to its trajectory where the study kept it; some are in the page whole, to be scrubbed through and
compared.
"""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from flowgraph.data.notes import note
from flowgraph.data.registry import flight_settings
from flowgraph.data.settings import text
from flowgraph.drawing.report_page import Raw, figure, report_page, safe, shown_runs, table
from flowgraph.errors import UnknownNameError
from flowgraph.study.charts import pictures, ratios
from flowgraph.study.shown import chosen as chosen_runs
from flowgraph.study.shown import shown_again
from flowgraph.study.statistics import compared, differing, metrics_of, quantiles
from flowgraph.study.store import Store, put_inside, read_study, read_table

WORST = 10
PAGE, FIGURES = "report.html", "figures"


@dataclass(frozen=True)
class Reported:
    """What was written: the page, the pictures, the summary as rows of numbers, and notes on what is not."""

    page: Path
    figures: tuple[Path, ...]
    summary: list[dict[str, Any]]
    notes: tuple[str, ...] = ()

    def _repr_html_(self) -> str:
        from flowgraph.drawing.notebook import report_cell  # only who shows it needs what draws

        page = self.page.read_text(encoding="utf-8")
        return report_cell(self.summary, self.notes, page, "the page of the study")


def write_report(folder: str | Path, *, metric: str | None = None, runs: int | None = 0) -> Reported:
    """Write `report.html` and `figures/*.png` into the folder of a study.

    Args:
        folder: of the study.
        metric: what to draw and to rank runs by, less being better; the first if left out.
        runs: how many are run again, in the Python engine, to stand in the page whole: the worst, and the one
            in the middle. None: three, where each took a few seconds at most.

    Raises:
        DataError: without results; UnknownNameError: for a metric that the table does not have.
    """
    target = Path(folder)
    rows, study = read_table(target), read_study(target)
    names = study.names()
    metrics = metrics_of(rows, names, study.metrics)
    if metric is not None and metric not in metrics:
        raise UnknownNameError("metric", metric, metrics, path=str(target))
    chosen = metric or (metrics[0] if metrics else None)
    failed = [r for r in rows if r.get("error") is not None]
    summary = quantiles(rows, names, study.metrics)
    notes: list[str] = []
    rerun = [] if chosen is None else chosen_runs(rows, chosen, runs, study.engine)
    share = 1.0 / max(len(rerun), 1)
    made = [
        (r, shown_again(r, names, chosen or "", share=share, dtype=study.dtype, say=notes.append))
        for r in rerun
    ]  # the worst first
    views = [(r, view) for r, view in made if view is not None]
    place = {str(r["key"]): k for k, (r, _) in enumerate(views)}
    parts = [
        f"<section><p>{_count(len(rows), 'run')} over {safe(', '.join(study.data))};"
        f" {_count(len(study.each_seed), 'seed')}; engine {safe(study.engine)}, {safe(study.dtype)}."
        f" {len(failed)} failed.</p>" + "".join(f"<p>{safe(one)}</p>" for one in notes) + "</section>",
    ]
    files, charts = [], []
    for k, picture in enumerate(pictures(rows, names, chosen) if chosen is not None else []):
        image = picture.png()
        files.append(target / FIGURES / f"{picture.name}.png")
        put_inside(files[-1], image)
        charts.append(picture.chart(place))
        parts.append(figure(k, picture.title, image))
    parts.append("<section><h2>Summary by setting</h2>" + table(summary) + "</section>")
    if chosen is not None:
        worst = _worst(rows, names, chosen, Store(target))
        parts.append(f"<section><h2>Worst runs by {safe(chosen)}</h2>{worst}</section>")
    if failed:
        lines = [{**_setting(r, names), "error": r["error"]} for r in failed[:50]]
        more = f"<p>and {len(failed) - 50} more.</p>" if len(failed) > 50 else ""
        parts.append(f"<section><h2>Failed runs ({len(failed)})</h2>{table(lines)}{more}</section>")
    if views:
        parts.append(shown_runs(f"The worst by {chosen}, and the one in the middle, run again."))
    title = f"Study: {', '.join(study.graphs)}"
    page = report_page(title, ", ".join(study.data), parts, charts=charts, runs=[v for _, v in views])
    put_inside(target / PAGE, str(page).encode())
    return Reported(target / PAGE, tuple(files), summary, tuple(notes))


class Comparison(NamedTuple):
    """What was written: the page, a row a graph and metric, and notes on what differs and is left out."""

    page: Path
    rows: list[dict[str, Any]]
    notes: tuple[str, ...]


def write_comparison(
    a: str | Path, b: str | Path, out: str | Path, *, metric: str | None = None, across: Sequence[str] = ()
) -> Comparison:
    """Compare two studies run by run; writes `comparison.html` and `figures/ratio.png` into `out`.

    Args:
        a, b: their folders.
        out: a folder.
        metric: only this one; all that both have if left out.
        across: settings of the flight in which runs of a pair may differ. Otherwise another setting is
            another flight.

    Raises:
        DataError: where a study has no results, or the two have no runs in common.
    """
    ours, theirs = read_table(b), read_table(a)
    names = [*read_study(a).names(), *read_study(b).names()]
    metrics = [m for m in metrics_of(theirs, names) if m in metrics_of(ours, names)]
    if metric is not None and metric not in metrics:
        raise UnknownNameError("metric", metric, metrics, path=f"{a}, {b}")
    flown = {n for spec in {r["data"] for r in (*ours, *theirs)} for n in flight_settings(spec, run=False)}
    for name in across:
        if name not in names or name not in flown:
            raise UnknownNameError(
                "setting of the flight", name, [n for n in names if n in flown], path="across"
            )
    compared_rows = compared(
        theirs, ours, [metric] if metric else metrics, names,
        flight=[n for n in names if n in flown and n not in across],
    )  # fmt: skip
    notes = _compared_notes(compared_rows, differing(theirs, ours, names))
    picture = ratios(compared_rows)
    image = picture.png()
    put_inside(Path(out) / FIGURES / f"{picture.name}.png", image)
    parts = [
        "<section><p>Ratio of the second to the first, the median over runs of the same flight and seed, with"
        " its 95 % bootstrap interval. Below 1 the second has less; in what part of the runs it does is under"
        " <em>less</em>. Of an error less is better, of a count or of a share within a bound it need not"
        " be.</p>",
        *(f"<p>{safe(one)}</p>" for one in notes),
        "</section>",
        figure(0, picture.title, image),
        f"<section>{table(compared_rows)}</section>",
    ]
    page = Path(out) / "comparison.html"
    title = f"{b} beside {a}"
    put_inside(
        page, str(report_page(title, "two studies compared", parts, charts=[picture.chart({})])).encode()
    )
    return Comparison(page, compared_rows, notes)


def _compared_notes(
    table: Sequence[Mapping[str, Any]], apart: Mapping[str, tuple[str, str]]
) -> tuple[str, ...]:
    """Sentences on the settings that differ, and on runs that no ratio stands for, once for alike lines."""
    notes = [
        note("warning", f"{n} differs: {x} in the first, {y} in the second") for n, (x, y) in apart.items()
    ]
    left: dict[tuple[str, str], list[str]] = {}
    for line in table:
        counts = [(line["failed"], "failed"), (line["unusable"], "zero, negative or no number")]
        counts.append((line["unpaired"], "without their like in the other study"))
        if said := ", ".join(f"{n} {what}" for n, what in counts if n):
            left.setdefault((line["graph"], said), []).append(line["metric"])
    for (graph, said), metrics in left.items():
        shown = ", ".join(metrics[:4]) + (f" and {len(metrics) - 4} more" if len(metrics) > 4 else "")
        notes.append(note("skipped", f"{graph}, {shown}: runs left out: {said}"))
    return tuple(notes)


# -- text ------------------------------------------------------------------------------------------------


def _worst(rows: Sequence[Mapping[str, Any]], names: list[str], metric: str, store: Store) -> str:
    usable = [
        r for r in rows if r.get("error") is None and isinstance(r.get(metric), int | float)
        and math.isfinite(r[metric])
    ]  # fmt: skip
    lines = []
    worst = sorted(usable, key=lambda r: -r[metric])[:WORST]
    kept = store.read(row["key"] for row in worst)
    for row in worst:
        line: dict[str, Any] = {**_setting(row, names), metric: row[metric]}
        line["run again"] = Raw(f"<code>{safe(_command(row, names))}</code>")
        if row["key"] in kept and store.has_trajectory(kept[row["key"]]):
            file = store.trajectory_file(row["key"]).relative_to(store.folder)
            line["trajectory"] = Raw(f'<a href="{safe(file.as_posix())}">{safe(row["key"][:8])}.npz</a>')
        lines.append(line)
    if not lines:
        return "<p>None.</p>"
    words = "With <code>--html worst.html --beside</code> after each of them, they are compared on one page."
    return f"<p>{words}</p>{table(lines)}"


def _setting(row: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    return {n: row.get(n) for n in ("graph", "data", "seed", *names)}


def _command(row: Mapping[str, Any], names: Sequence[str]) -> str:
    words = ["flowgraph", "run", row["graph"], "--data", row["data"], "--seed", str(row["seed"])]
    for name in names:
        if row.get(name) is not None:
            words += ["--set", f"{name}={text(row[name])}"]
    return shlex.join(words)


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")
