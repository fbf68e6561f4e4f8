"""The cost report as text and as a page."""

from __future__ import annotations

import html
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from flowgraph.pipeline.costs.report import CostReport, Row

_STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; max-width: 75rem; margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; margin: .5rem 0 2rem; }
th, td { padding: .2rem .7rem; border-bottom: 1px solid #ddd; text-align: left; white-space: nowrap; }
th { border-bottom: 2px solid #888; } td.number { text-align: right; font-variant-numeric: tabular-nums; }
td:last-child { white-space: normal; } div { overflow-x: auto; }
"""


def as_text(report: CostReport) -> str:
    """The tables, a column a key, numbers to the right."""
    lines = [f"cost of {report.name}", "", report.intro, ""]
    for section in report.sections:
        lines += [section.title, "-" * len(section.title), section.note, ""]
        lines += _lines(section.rows) if section.rows else ["none"]
        lines.append("")
    return "\n".join(lines)


def _lines(rows: tuple[Row, ...]) -> list[str]:
    keys = list(rows[0])
    cells = [keys, *([shown(row[k]) for k in keys] for row in rows)]
    widths = [max(len(row[n]) for row in cells) for n in range(len(keys))]
    right = [any(isinstance(row[k], int | float) for row in rows) for k in keys]
    padded = [
        "  ".join(
            c.rjust(w) if r else c.ljust(w) for c, w, r in zip(row, widths, right, strict=True)
        ).rstrip()
        for row in cells
    ]
    return [padded[0], "  ".join("-" * w for w in widths), *padded[1:]]


def as_html(report: CostReport) -> str:
    """A page by itself, without scripts or anything from elsewhere."""
    title = html.escape(f"Cost of {report.name}")
    parts = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1><p>{html.escape(report.intro)}</p>",
    ]
    for section in report.sections:
        parts.append(f"<h2>{html.escape(section.title)}</h2><p>{html.escape(section.note)}</p>")
        parts.append(_table(section.rows) if section.rows else "<p>None.</p>")
    return "\n".join([*parts, "</body></html>"]) + "\n"


def _table(rows: tuple[Row, ...]) -> str:
    keys = list(rows[0])
    head = "".join(f"<th>{html.escape(k)}</th>" for k in keys)
    body = "".join(f"<tr>{''.join(_cell(row[k]) for k in keys)}</tr>" for row in rows)
    return f"<div><table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table></div>"


def _cell(value: Any) -> str:
    kind = ' class="number"' if isinstance(value, int | float) else ""
    return f"<td{kind}>{html.escape(shown(value))}</td>"


def shown(value: Any) -> str:
    """A value in a table; numbers with thousands apart."""
    return f"{value:,}" if isinstance(value, int | float) else str(value)
