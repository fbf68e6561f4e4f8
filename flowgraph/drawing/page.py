"""One file that is a page: a diagram that unfolds, by itself or beside what flowed in it.

The page asks nothing of a network: its scripts, its look and its data stand in it. The scripts are made from
`front/`, beside this module, and committed as `pages/`, so that who installs or uses this package needs no
node. Names, notes and docstrings come from whoever wrote a graph or a recording. They go into the page as
data, from which no script and no mark-up can be read, and its scripts put them on the screen as text.

The layout is ELK's, in the page: what is folded and unfolded is laid out anew, which a picture made by
Graphviz beforehand cannot be.
"""

from __future__ import annotations

import html
import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any

from flowgraph.data.files import put
from flowgraph.data.flight import Flight
from flowgraph.drawing.model import describe
from flowgraph.drawing.text import doc_words, folded_scopes
from flowgraph.errors import writes
from flowgraph.language.graph import Graph

# All that a page may do is run the scripts that are in it; it can ask for nothing from anywhere.
_POLICY = "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data: blob:"


def diagram_page(
    graph: Graph,
    file: str | Path | None = None,
    *,
    fold: int | None = None,
    rankdir: str | None = None,
    costs: Mapping[str, Mapping[str, Any]] | None = None,
    inputs: Flight | Mapping[str, Any] | None = None,
) -> str | Path:
    """The block diagram as a page in which graphs unfold, wires and ports tell what they carry, and blocks
    what they are; written to `file`, or returned as text.

    Args:
        fold: graphs nested deeper than this are folded at first; None: none, or all where blocks are many.
        rankdir: which way values flow at first, "LR" or "TB"; None: that in which more can be read.
        costs: of the lowered graph, by path of a block or register; under "" those of the whole.
        inputs: what the sources are fed; of one whose values arrive late the page says so.

    Raises:
        DeclarationError: for a depth that is not a whole number from 0.
        OutputError: where the file cannot be written.
    """
    begin: dict[str, Any] = {} if fold is None else {"folded": folded_scopes(graph, fold)}
    begin |= {"down": rankdir in ("TB", "BT")} if rankdir else {}
    data = {"graph": describe(graph, costs, inputs), "begin": begin}
    made = page("diagram", graph.name, doc_words(graph.doc), data, ("diagram",))
    return written(made, file)


def page(
    kind: str,
    title: str,
    words: str,
    data: Mapping[str, Any],
    scripts: tuple[str, ...],
    *,
    asks: str = "",
    body: str = "",
) -> str:
    """A page of a kind that `front/src` knows, with its data as JSON by the id of the element.

    Args:
        asks: the one address that it may connect to.
        body: HTML that stands in it without a script.
    """
    policy = f"{_POLICY}; connect-src {asks}" if asks else _POLICY
    stored = "\n".join(
        f'<script type="application/json" id="{html.escape(name)}">{data_text(value)}</script>'
        for name, value in data.items()
    )
    code = "\n".join(f"<script>{_script(name)}</script>" for name in scripts)
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta http-equiv="Content-Security-Policy" content="{policy}">
<title>{html.escape(title)}</title>
<link rel="icon" href="data:,">
<style>{_part("style.css")}</style>
</head>
<body data-page="{kind}">
<header><h1>{html.escape(title)}</h1><p>{html.escape(words)}</p></header>
<main>{body}</main>
<footer></footer>
{stored}
{code}
<!--
{_part("NOTICES.txt").replace("--", "- -")}-->
</body>
</html>
"""


def data_text(value: Any) -> str:
    """JSON that can stand inside a script element: nothing in it ends the element or begins another."""
    text = json.dumps(value, ensure_ascii=True, separators=(",", ":"), allow_nan=False)
    return text.replace("<", "\\u003c").replace(">", "\\u003e").replace("&", "\\u0026")


def written(text: str, file: str | Path | None) -> str | Path:
    """The text itself, or the file that it was written to."""
    if file is None:
        return text
    path = Path(file)
    with writes(path):
        path.parent.mkdir(parents=True, exist_ok=True)
    return put(path, text)


def _script(name: str) -> str:
    return _part(f"{name}.js").replace("</script", "<\\/script")


def _part(name: str) -> str:
    return (files("flowgraph.drawing") / "pages" / name).read_text(encoding="utf-8")


__all__ = ["diagram_page"]
