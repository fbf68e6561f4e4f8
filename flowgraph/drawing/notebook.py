"""In a notebook, things show themselves: a graph as its diagram, a result as its plot, a flight as a table.

What a cell shows is plain HTML that says the same without a script: pictures and tables. The interactive page
of a graph, a run, a report stands behind a line to open, in a frame of its own that can reach neither the
notebook nor the network; it is packed, so that a saved notebook grows by some hundred kilobytes for it. All
words go in as text, whatever a graph or a recording is called.
"""

from __future__ import annotations

import base64
import gzip
import html
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from flowgraph.data.contents import contents
from flowgraph.data.flight import Flight
from flowgraph.data.registry import Case
from flowgraph.data.result import Result
from flowgraph.data.series import Series
from flowgraph.drawing import canvas
from flowgraph.drawing.draw import draw
from flowgraph.drawing.page import diagram_page, written
from flowgraph.drawing.plot import plot_result
from flowgraph.drawing.report_page import safe
from flowgraph.drawing.run_page import describe_run, run_page
from flowgraph.errors import DataError, MissingDependencyError
from flowgraph.language.graph import Graph
from flowgraph.types import leaves_of

if TYPE_CHECKING:
    from flowgraph.data.batch import Batch

_UNPACK = """<script>
(async () => {
  const packed = Uint8Array.from(atob("%s"), c => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("gzip"));
  const text = await new Response(stream).text();
  document.open(); document.write(text); document.close();
})();
</script>"""


class Page:
    """An interactive page that shows itself in a notebook.

    Args:
        text: the page, whole.
        height: of its frame, in pixels.
    """

    def __init__(self, text: str, *, height: int = 560) -> None:
        self.text, self.height = text, height

    def save(self, file: str | Path) -> Path:
        """Write it to a file.

        Raises:
            OutputError: where it cannot be written.
        """
        return Path(written(self.text, file))

    def _repr_html_(self) -> str:
        return framed(self.text, self.height)

    def __repr__(self) -> str:
        return f"<Page of {len(self.text) // 1024} KiB: save(FILE), or show it in a notebook>"


def framed(text: str, height: int = 560) -> str:
    """A page in a frame, which may run its own scripts and nothing else."""
    packed = base64.b64encode(gzip.compress(text.encode(), 9, mtime=0)).decode()
    inner = html.escape(_UNPACK % packed, quote=True)
    look = f"width:100%;height:{height}px;border:1px solid #ccd4dc"
    return f'<iframe sandbox="allow-scripts" loading="lazy" style="{look}" srcdoc="{inner}"></iframe>'


def graph_cell(graph: Graph) -> dict[str, str]:
    """A graph: its diagram, and behind a line the one that unfolds."""
    bundle = {"text/plain": graph.text()}
    try:
        picture: str | None = str(draw(graph))
    except MissingDependencyError:  # without a layout engine there is still the text
        picture = None
    if picture is not None:
        bundle["image/svg+xml"] = picture
    body = _picture(picture.encode(), "svg+xml") if picture else f"<pre>{safe(graph.text())}</pre>"
    page = diagram_page(graph)
    bundle["text/html"] = body + _opens("the diagram that unfolds", framed(str(page)))
    return bundle


def result_cell(result: Result) -> str:
    """A result: its streams, what it has to say, and its plot."""
    rows = [_about(name, series) for name, series in result.series.items()]
    head = f"{result.graph}: {result.ticks} ticks in {result.wall_s:.3g} s ({result.engine})"
    counts = ", ".join(f"{key}: {value}" for key, value in result.stats.items() if value)
    return "".join(
        (_heading(head), table(rows), _notes((*result.notes, *([counts] if counts else ()))), _plot(result))
    )


def series_cell(series: Series) -> str:
    """A series: its fields with units, and its plot."""
    rows = []
    for (name, leaf), array in zip(leaves_of(series.type), series.leaves.values(), strict=True):
        row: dict[str, Any] = {"field": name, "type": str(leaf)}
        if len(series) and array.size and array.dtype.kind in "fiu":
            row |= {"least": float(np.min(array)), "most": float(np.max(array))}
        rows.append(row)
    shown = Result(series.name, "recorded", {series.name: series}, {}, {}, len(series), 0.0)
    return _heading(repr(series).strip("<>")) + table(rows) + _plot(shown)


def flight_cell(flight: Flight) -> str:
    """A flight: what it holds."""
    rows = []
    for row in contents(flight):
        seconds = ((row["last_ns"] or 0) - (row["first_ns"] or 0)) * 1e-9
        fields = ", ".join(f"{f['name']} [{f['unit'] or '-'}]" for f in row["fields"])
        rows.append(
            {"stream": row["name"], "kind": row["kind"], "readings": row["count"],
             "rate [Hz]": row["rate_hz"], "span [s]": seconds, "gaps": row["gaps"], "fields": fields}
        )  # fmt: skip
    return _heading(f"flight {flight.name}") + table(rows) + _notes(flight.notes)


def case_cell(case: Case) -> str:
    """A case: its graph and what it is fed."""
    fed = [_about(name, series) for name, series in case.recorded.items()]
    return (
        _heading(f"{case.graph.name}, made ready; the estimate is {case.estimate!r}")
        + table(fed)
        + _notes(case.notes)
        + graph_cell(case.graph)["text/html"]
    )


def case_page(case: Case, result: Result, *, truth: Series | None = None) -> Page:
    """The page of a run of a case: diagram, scopes, the way in space, and a slider."""
    if truth is None and isinstance(case.inputs, Flight):
        truth = case.inputs.truth
    figures = {key: value for key, value in case.score(result).items() if isinstance(value, int | float)}
    run = describe_run(
        case.graph, result, title=f"{case.graph.name} ({result.engine})", estimate=case.estimate,
        truth=truth, inputs=case.recorded, order=case.order, figures=figures, notes=case.remarks(result),
    )  # fmt: skip
    return Page(str(run_page([run])), height=720)


def batch_cell(batch: Batch) -> str:
    """Many runs: their streams, with how far they lie apart at the end."""
    rows = []
    for name, runs in batch.series.items():
        for leaf, array in runs.leaves.items():
            row: dict[str, Any] = {"stream": name, "field": leaf, "shape": str(array.shape)}
            if array.shape[1] and array.dtype.kind == "f":
                last = array[:, -1].reshape(len(array), -1)
                row["largest deviation of runs at the end"] = float(np.std(last, axis=0).max(initial=0.0))
            rows.append(row)
    head = f"{batch.graph}: {len(batch.seeds)} runs of {batch.ticks} ticks ({batch.engine})"
    bad = [f"diverged: run {k}: {words}" for k, words in batch.diverged.items()]
    return _heading(head) + table(rows) + _notes(bad)


def pipeline_cell(name: str, totals: Mapping[str, Any], listing: str) -> str:
    """A pipeline: its totals, and behind a line its listing."""
    kept = {key: value for key, value in totals.items() if isinstance(value, int | float | str)}
    rows = [{"of the pipeline": key.replace("_", " "), "": value} for key, value in kept.items()]
    return _heading(f"pipeline {name}") + table(rows) + _opens("the listing", f"<pre>{safe(listing)}</pre>")


def report_cell(rows: Sequence[Mapping[str, Any]], notes: Iterable[str], page: str, what: str) -> str:
    """Rows of numbers, and behind a line the page that has them."""
    return table(rows) + _notes(notes) + _opens(what, framed(page))


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table that needs no style sheet."""
    if not rows:
        return "<p>None.</p>"
    names = list(dict.fromkeys(name for row in rows for name in row))
    head = "".join(f"<th>{safe(name)}</th>" for name in names)
    body = "".join("<tr>" + "".join(_cell(row.get(name)) for name in names) + "</tr>" for row in rows)
    return f"<table><tr>{head}</tr>{body}</table>"


def _cell(value: Any) -> str:
    if isinstance(value, bool | np.bool_) or value is None or isinstance(value, str):
        return f'<td style="text-align:left">{safe("" if value is None else str(value))}</td>'
    return f"<td>{safe(f'{value:.4g}' if isinstance(value, float) else str(value))}</td>"


def _about(name: str, series: Series) -> dict[str, Any]:
    """A stream in a line."""
    span = float(series.seconds[-1]) if len(series) else 0.0
    fields = ", ".join(field for field, _ in leaves_of(series.type))
    return {
        "stream": name,
        "kind": str(series.type),
        "values": len(series),
        "span [s]": span,
        "fields": fields,
    }


def _plot(result: Result) -> str:
    """The plot of a result, where it has something to plot."""
    if not any(len(series) for series in result.series.values()):
        return ""
    try:
        return _picture(canvas.png(plot_result(result)), "png")
    except (DataError, MissingDependencyError):
        return ""


def _picture(content: bytes, kind: str) -> str:
    data = base64.b64encode(content).decode()
    return f'<img style="max-width:100%" src="data:image/{kind};base64,{data}">'


def _heading(words: str) -> str:
    return f"<p><b>{safe(words)}</b></p>"


def _notes(notes: Iterable[str]) -> str:
    lines = "".join(f"<li>{safe(words)}</li>" for words in notes)
    return f"<ul>{lines}</ul>" if lines else ""


def _opens(what: str, body: str) -> str:
    return f"<details><summary>{safe(what)}</summary>{body}</details>"


__all__ = ["Page", "case_page", "framed"]
