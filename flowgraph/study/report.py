"""The report of a study: one HTML file with tables and pictures, and the pictures as PNG beside it.

Nothing in the file comes from elsewhere: pictures are in it as data, and there is no script. The worst runs
are listed with the command that runs each again, and with a link to its trajectory where the study kept it.
"""

from __future__ import annotations

import base64
import html
import io
import math
import shlex
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from flowgraph.data.notes import note
from flowgraph.data.registry import flight_settings
from flowgraph.data.settings import text
from flowgraph.drawing import canvas
from flowgraph.errors import UnknownNameError, plain
from flowgraph.study.statistics import compared, differing, finite_values, grouped, metrics_of, quantiles
from flowgraph.study.store import Store, is_key, put_inside, read_study, read_table

WORST = 10
_FEW = 10  # values of a box that are drawn as points too
PAGE, FIGURES = "report.html", "figures"

_STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:70em;margin:2em auto;padding:0 1em;color:#222}
table{border-collapse:collapse;margin:.7em 0 1.5em;font-variant-numeric:tabular-nums;font-size:90%}
th,td{padding:.2em .8em;text-align:right;border-bottom:1px solid #ddd}
th{border-bottom:2px solid #888}.text{text-align:left}
code{font-size:85%}img{max-width:100%}.error{color:#a00;max-width:45em}.table{overflow-x:auto}
@media(prefers-color-scheme:dark){body{background:#1b1b1b;color:#ddd}th,td{border-color:#444}
img{background:#fff}.error{color:#f88}}"""


@dataclass(frozen=True)
class Reported:
    """What was written: the page, the pictures, and the summary as rows of numbers."""

    page: Path
    figures: tuple[Path, ...]
    summary: list[dict[str, Any]]


def write_report(folder: str | Path, *, metric: str | None = None) -> Reported:
    """Write `report.html` and `figures/*.png` into the folder of a study.

    Args:
        folder: of the study.
        metric: what to draw and to rank runs by, less being better; the first if left out.

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
    parts = [
        f"<h1>Study: {_safe(', '.join(study.graphs))}</h1>",
        f"<p>{_count(len(rows), 'run')} over {_safe(', '.join(study.data))};"
        f" {_count(len(study.each_seed), 'seed')}; engine {_safe(study.engine)}, {_safe(study.dtype)}."
        f" {len(failed)} failed.</p>",
    ]
    files: list[Path] = []
    if chosen is not None:
        for title, name, draw in _pictures(rows, names, chosen):
            image = _png(draw)
            files.append(target / FIGURES / f"{name}.png")
            put_inside(files[-1], image)
            code = base64.b64encode(image).decode()
            parts.append(
                f'<h2>{_safe(title)}</h2><img alt="{_safe(title)}" src="data:image/png;base64,{code}">'
            )
    parts.append("<h2>Summary by setting</h2>" + _table(_shown(summary)))
    if chosen is not None:
        parts.append(f"<h2>Worst runs by {_safe(chosen)}</h2>" + _worst(rows, names, chosen, Store(target)))
    if failed:
        lines = [{**_setting(r, names), "error": r["error"]} for r in failed[:50]]
        more = f"<p>and {len(failed) - 50} more.</p>" if len(failed) > 50 else ""
        parts.append(f"<h2>Failed runs ({len(failed)})</h2>" + _table(lines) + more)
    page = _page("Study of " + ", ".join(study.graphs), parts)
    put_inside(target / PAGE, page.encode())
    return Reported(target / PAGE, tuple(files), summary)


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
    table = compared(
        theirs, ours, [metric] if metric else metrics, names,
        flight=[n for n in names if n in flown and n not in across],
    )  # fmt: skip
    notes = _compared_notes(table, differing(theirs, ours, names))
    image = _png(lambda figure: _draw_ratios(figure, table))
    put_inside(Path(out) / FIGURES / "ratio.png", image)
    code = base64.b64encode(image).decode()
    parts = [
        f"<h1>{_safe(str(b))} beside {_safe(str(a))}</h1>",
        "<p>Ratio of the second to the first, the median over runs of the same flight and seed, with its 95 %"
        " bootstrap interval. Below 1 the second has less; in what part of the runs it does is under"
        " <em>less</em>. Of an error less is better, of a count or of a share within a bound it need not"
        " be.</p>",
        *(f"<p>{_safe(one)}</p>" for one in notes),
        f'<img alt="ratios" src="data:image/png;base64,{code}">',
        _table(_shown(table)),
    ]
    page = Path(out) / "comparison.html"
    put_inside(page, _page("Comparison", parts).encode())
    return Comparison(page, table, notes)


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


# -- pictures ------------------------------------------------------------------------------------------

Draw = Callable[[Any], None]


def _pictures(
    rows: Sequence[Mapping[str, Any]], names: list[str], metric: str
) -> list[tuple[str, str, Draw]]:
    found: list[tuple[str, str, Draw]] = [
        (f"{metric} by data set and filter", "boxes", lambda figure: _draw_boxes(figure, rows, metric))
    ]
    for name in names:
        values = {r.get(name) for r in rows if r.get(name) is not None}
        if len(values) > 1 and all(isinstance(v, int | float) and not isinstance(v, bool) for v in values):
            file = "against-" + "".join(c if c.isalnum() else "-" for c in name)[:60]
            file += f"-{len(found)}" if file in [f for _, f, _ in found] else ""
            draw = lambda figure, name=name: _draw_against(figure, rows, name, metric)
            found.append((f"{metric} against {name}", file, draw))
    return found


def _png(draw: Draw) -> bytes:
    sink = io.BytesIO()
    with canvas.plain_matplotlib({"text.parse_math": False}):  # a dollar in a name is a dollar
        figure = canvas.new_figure(9.0, 4.5)
        draw(figure)
        figure.savefig(sink, format="png", dpi=110)
    return sink.getvalue()


def _draw_boxes(figure: Any, rows: Sequence[Mapping[str, Any]], metric: str) -> None:
    """A box a filter at each data set: quartiles, whiskers to the furthest within 1.5 of their distance.

    Of a few runs each is a point as well, for the box of one is only a line.
    """
    ax = figure.add_subplot()
    graphs, flights = (list(dict.fromkeys(r[n] for r in rows)) for n in ("graph", "data"))
    width = 0.8 / len(graphs)
    for k, graph in enumerate(graphs):
        places, values = [], []
        for n, data in enumerate(flights):
            found = finite_values([r for r in rows if r["graph"] == graph and r["data"] == data], metric)
            if len(found):
                places.append(n - 0.4 + width * (k + 0.5))
                values.append(found)
        if values:
            colour = f"C{k}"
            ax.boxplot(
                values, positions=places, widths=0.85 * width, patch_artist=True,
                flierprops={"markersize": 3},
                boxprops={"facecolor": colour, "alpha": 0.5}, medianprops={"color": "black"},
            )  # fmt: skip
            few = [
                (x, v) for x, found in zip(places, values, strict=True) if len(found) <= _FEW for v in found
            ]
            ax.plot([x for x, _ in few], [v for _, v in few], "o", color=colour, markersize=5)
        ax.plot([], [], color=f"C{k}", linewidth=6, alpha=0.5, label=graph)
    _log_where_wide(ax.yaxis, finite_values(rows, metric))
    ax.set_xticks(range(len(flights)), [_short(f) for f in flights], rotation=25 if len(flights) > 3 else 0)
    ax.set_xlim(-0.6, len(flights) - 0.4)
    ax.set_ylabel(metric)
    ax.legend()


def _draw_against(figure: Any, rows: Sequence[Mapping[str, Any]], name: str, metric: str) -> None:
    """Median and quartiles at each value of a parameter; each run as a point where the values are many."""
    ax = figure.add_subplot()
    for k, ((graph, data), members) in enumerate(grouped(rows, ["graph", "data"]).items()):
        points = {
            x: finite_values(g, metric) for (x,), g in grouped(members, [name]).items() if x is not None
        }
        points = {x: v for x, v in sorted(points.items()) if len(v)}
        if not points:
            continue
        label, x = f"{graph}, {_short(data)}", np.array(list(points), dtype=float)
        if len(points) > 30 and max(map(len, points.values())) <= 3:
            every = [(a, b) for a, v in points.items() for b in v]
            ax.plot(*zip(*every, strict=True), ".", color=f"C{k}", alpha=0.6, label=label)
            continue
        low, middle, high = (
            np.array([np.quantile(v, q) for v in points.values()]) for q in (0.25, 0.5, 0.75)
        )
        ax.plot(x, middle, "o-", color=f"C{k}", label=label)
        ax.fill_between(x, low, high, color=f"C{k}", alpha=0.2)
    values = [r[name] for r in rows if isinstance(r.get(name), int | float)]
    _log_where_wide(ax.xaxis, np.array(values, dtype=float), wide=9.0)
    _log_where_wide(ax.yaxis, finite_values(rows, metric))
    ax.set_xlabel(name)
    ax.set_ylabel(metric)
    if ax.get_legend_handles_labels()[1]:
        ax.legend()


def _draw_ratios(figure: Any, table: Sequence[Mapping[str, Any]]) -> None:
    ax = figure.add_subplot()
    for k, line in enumerate(table):
        ax.plot([line["low"], line["high"]], [k, k], "-", color="C0", linewidth=3, alpha=0.5)
        ax.plot(line["ratio"], k, "o", color="C0")
    ax.axvline(1.0, color="black", linewidth=1)
    ax.set_yticks(range(len(table)), [f"{line['graph']}: {line['metric']}" for line in table])
    ax.invert_yaxis()
    ax.set_xlabel("ratio")


def _log_where_wide(axis: Any, values: np.ndarray, wide: float = 30.0) -> None:
    if len(values) and values.min() > 0 and values.max() > wide * values.min():
        getattr(axis.axes, f"set_{axis.axis_name}scale")("log")


# -- text ------------------------------------------------------------------------------------------------


def _worst(rows: Sequence[Mapping[str, Any]], names: list[str], metric: str, store: Store) -> str:
    usable = [
        r for r in rows if r.get("error") is None and isinstance(r.get(metric), int | float)
        and math.isfinite(r[metric])
    ]  # fmt: skip
    lines = []
    for row in sorted(usable, key=lambda r: -r[metric])[:WORST]:
        line: dict[str, Any] = {**_setting(row, names), metric: row[metric]}
        line["run again"] = _Raw(f"<code>{_safe(_command(row, names))}</code>")
        if is_key(row["key"]) and store.has_trajectory(row["key"]):
            file = store.trajectory_file(row["key"]).relative_to(store.folder)
            line["trajectory"] = _Raw(f'<a href="{_safe(file.as_posix())}">{_safe(row["key"][:8])}.npz</a>')
        lines.append(line)
    if not lines:
        return "<p>None.</p>"
    words = "With <code>--html worst.html --beside</code> after each of them, they are compared on one page."
    return f"<p>{words}</p>{_table(_shown(lines))}"


def _setting(row: Mapping[str, Any], names: Sequence[str]) -> dict[str, Any]:
    return {n: row.get(n) for n in ("graph", "data", "seed", *names)}


def _command(row: Mapping[str, Any], names: Sequence[str]) -> str:
    words = ["flowgraph", "run", row["graph"], "--data", row["data"], "--seed", str(row["seed"])]
    for name in names:
        if row.get(name) is not None:
            words += ["--set", f"{name}={text(row[name])}"]
    return shlex.join(words)


class _Raw(str):
    """Text that is HTML already."""


def _table(rows: Sequence[Mapping[str, Any]]) -> str:
    if not rows:
        return "<p>None.</p>"
    names = list(dict.fromkeys(n for row in rows for n in row))
    words = {n for n in names if any(_is_text(row.get(n)) for row in rows)}
    head = "".join(
        f'<th class="text">{_safe(n)}</th>' if n in words else f"<th>{_safe(n)}</th>" for n in names
    )
    body = "".join(
        "<tr>" + "".join(_cell(n, row.get(n), n in words) for n in names) + "</tr>" for row in rows
    )
    return f'<div class="table"><table><tr>{head}</tr>{body}</table></div>'


def _cell(name: str, value: Any, words: bool) -> str:
    said = value if isinstance(value, _Raw) else "" if value is None else _safe(str(value))
    kind = "text error" if name == "error" else "text" if words else ""
    return f'<td class="{kind}">{said}</td>' if kind else f"<td>{said}</td>"


def _is_text(value: Any) -> bool:
    """Whether a cell is words, which stand on the left; numbers, shortened already or not, on the right."""
    try:
        float(value if isinstance(value, str) else 0.0)
    except ValueError:
        return True
    return False


def _count(number: int, what: str) -> str:
    return f"{number} {what}" + ("" if number == 1 else "s")


def _shown(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{n: f"{v:.4g}" if isinstance(v, float) else v for n, v in row.items()} for row in rows]


def _page(title: str, parts: Sequence[str]) -> str:
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{_safe(title)}</title>'
        f'<meta name="viewport" content="width=device-width"><style>{_STYLE}</style></head><body>'
        + "\n".join(parts)
        + "</body></html>\n"
    )


def _safe(words: str) -> str:
    return html.escape(plain(words))


def _short(data: str) -> str:
    """The end of a flight's name, which tells it from others; from a folder on where there is one."""
    if len(data) <= 24:
        return data
    name = data.rstrip("/").rpartition("/")[2]
    return "…/" + name if name != data and len(name) <= 30 else "…" + data[-23:]
