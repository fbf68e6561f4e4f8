"""The page of a report: words, tables and charts of many runs, and some of these runs to scrub through.

It has the parts of the other pages: their look, dark and light, their plots on canvas, and the view of runs
that are picked and compared. What a report says stands in the page as HTML, so that it can be read and
printed where no script runs: tables as they are, and for each chart a picture, whose place the chart takes in
a browser.
"""

from __future__ import annotations

import base64
import html
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from flowgraph.drawing.page import page, written
from flowgraph.errors import plain

__all__ = ["Raw", "axis", "chart", "figure", "report_page", "safe", "series", "shown_runs", "table"]


class Raw(str):
    """Text that is HTML already."""


def report_page(
    title: str,
    words: str,
    parts: Sequence[str],
    *,
    charts: Sequence[Mapping[str, Any]] = (),
    runs: Sequence[Mapping[str, Any]] = (),
    file: str | Path | None = None,
) -> str | Path:
    """A page of a report, written to `file` or returned as text.

    Args:
        parts: its sections, in HTML: `table`, `figure`, `shown_runs` and headings.
        charts: those that `figure` names by number, as `chart` gives them.
        runs: as `describe_run` gives them.

    Raises:
        OutputError: where the file cannot be written.
    """
    data: dict[str, Any] = {"charts": list(charts)} | ({"runs": list(runs)} if runs else {})
    scripts = ("diagram", "run", "report") if runs else ("report",)
    return written(page("report", title, words, data, scripts, body="\n".join(parts)), file)


def chart(
    title: str,
    x: Mapping[str, Any],
    y: Mapping[str, Any],
    lines: Sequence[Mapping[str, Any]],
    *,
    words: str = "",
    marks: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """A chart, as `front/src/model.ts` declares it.

    Args:
        x, y: as `axis` gives them; names on `y` make the chart one of rows.
        lines: as `series` gives them.
        words: what its marks mean.
        marks: dashed lines with a `name`, at an `x`, or at a `y` that reaches `from` one x `to` another.
    """
    return {"title": title, "words": words, "x": dict(x), "y": dict(y),
            "series": [dict(line) for line in lines], "marks": [dict(mark) for mark in marks]}  # fmt: skip


def axis(label: str, *, names: Sequence[str] | None = None, log: bool = False) -> dict[str, Any]:
    """An axis of numbers, or of names that stand at 0, 1, 2 ..."""
    return {"label": label, "log": log, "names": None if names is None else list(names)}


def series(
    name: str, kind: str, x: Sequence[float], y: Sequence[float], *, ends: Any = None, **more: Any
) -> dict[str, Any]:
    """What a colour stands for: values that are no numbers are left out.

    Args:
        kind: "dots", "line", "bar", "dash" or "box".
        ends: pairs (low, high) of an interval around each, or None.
        more: lists as long: `boxes` of five numbers each, `words` that are read at each, `runs` on the page;
            and `width` of a bar or box.
    """
    given = {k: list(v) for k, v in more.items() if isinstance(v, list | tuple)}
    kept = [k for k, (a, b) in enumerate(zip(x, y, strict=True)) if math.isfinite(a) and math.isfinite(b)]
    made: dict[str, Any] = {"name": name, "kind": kind, "x": [float(x[k]) for k in kept]}
    made["y"] = [float(y[k]) for k in kept]
    for n, side in enumerate(("low", "high")):
        made[side] = None if ends is None else [_number(ends[k][n], float(y[k])) for k in kept]
    scalars = {k: v for k, v in more.items() if k not in given}
    return made | {k: [v[n] for n in kept] for k, v in given.items()} | scalars


def _number(value: Any, otherwise: float) -> float:
    return float(value) if value is not None and math.isfinite(value) else otherwise


def figure(number: int, title: str, png: bytes) -> str:
    """The place of a chart, with the picture that stands there until a script draws it, and on paper."""
    code = base64.b64encode(png).decode()
    return (
        f'<section><h2>{safe(title)}</h2><figure data-chart="{number}">'
        f'<img alt="{safe(title)}" src="data:image/png;base64,{code}"></figure></section>'
    )


def shown_runs(words: str) -> str:
    """The place of the runs that are in a page."""
    return f'<section class="shown-runs" id="shown"><h2>Runs</h2><p>{safe(words)}</p></section>'


def table(rows: Sequence[Mapping[str, Any]]) -> str:
    """A table with a line a row, and a column a name; numbers on the right, in four figures."""
    if not rows:
        return "<p>None.</p>"
    rows = [{n: f"{v:.4g}" if isinstance(v, float) else v for n, v in row.items()} for row in rows]
    names = list(dict.fromkeys(n for row in rows for n in row))
    words = {n for n in names if any(_is_text(row.get(n)) for row in rows)}
    head = "".join(f'<th class="text">{safe(n)}</th>' if n in words else f"<th>{safe(n)}</th>" for n in names)
    body = "".join(
        "<tr>" + "".join(_cell(n, row.get(n), n in words) for n in names) + "</tr>" for row in rows
    )
    return f'<div class="table" tabindex="0"><table><tr>{head}</tr>{body}</table></div>'


def _cell(name: str, value: Any, words: bool) -> str:
    said = value if isinstance(value, Raw) else "" if value is None else safe(str(value))
    kind = "text error" if name == "error" else "text" if words else ""
    return f'<td class="{kind}">{said}</td>' if kind else f"<td>{said}</td>"


def _is_text(value: Any) -> bool:
    """Whether a cell is words, which stand on the left; numbers, shortened already or not, on the right."""
    try:
        float(value if isinstance(value, str) else 0.0)
    except ValueError:
        return True
    return False


def safe(words: str) -> str:
    """Text as it can stand in HTML."""
    return html.escape(plain(words))
