"""Pictures and reference tables of the site, made when it is built and kept out of the tree.

`generated/NAME.svg` is the diagram of each installed graph, started on a simulated flight, and
`generated/rooms.svg` that of the rooms of this package; `screens` makes interactive pages and takes pictures
of them. The pages named in `RUN` are run as programs, and the pictures that they write are taken as they are.
"""

from __future__ import annotations

import contextlib
import logging
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import matplotlib
from mkdocs.plugins import event_priority
from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).parent))
import library
import reference
import rooms
import screens

from flowgraph import FlowgraphError
from flowgraph.cli.options import graph_of
from flowgraph.data.registry import graph_names

matplotlib.use("Agg")

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
RUN = ("index.md", "tutorial.md", "complementary.md")
drawn: set[str] = set()
log = logging.getLogger("mkdocs.hooks.pictures")


@event_priority(100)  # the notebooks are there before the plugin that runs them looks
def on_files(files: Any, config: Any) -> Any:
    """Add the pictures to the files of the site."""
    diagrams = dict(graphs())
    drawn.update(diagrams)
    pictures = {f"{name}.svg": svg for name, svg in diagrams.items()}
    pictures["rooms.svg"] = rooms.house().draw(legend=False).encode()
    pictures |= dict(screens.screens())
    for name, content in {**pictures, **dict(written_by_pages(Path(config["docs_dir"])))}.items():
        files.append(File.generated(config, f"generated/{name}", content=content))
    for notebook in sorted(EXAMPLES.glob("notebooks/*.ipynb")):
        place = str(notebook.relative_to(EXAMPLES))
        files.append(File(place, str(EXAMPLES), config["site_dir"], config["use_directory_urls"]))
    for place, text in reference.pages():
        files.append(File.generated(config, place, content=text))
    return files


def on_post_build(config: Any) -> None:
    """Hold the reference against what is public."""
    for name in reference.missing(Path(config["site_dir"])):
        log.warning("%s is public and has no entry in the reference", name)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Put the reference tables where a page has a mark for them; notebooks are pages of the site."""
    return library.filled(markdown, drawn).replace("](../examples/notebooks/", "](notebooks/")


def on_page_content(html: str, page: Any, **_: Any) -> str:
    """In notebooks, links to files of the tree become links to pages of the site."""
    if not page.file.src_uri.endswith(".ipynb"):
        return html
    html = re.sub(r'href="(?:\.\./)+docs/(\w+)\.md', r'href="../../\1/', html)
    return re.sub(r'href="(\w+)\.ipynb', r'href="../\1/', html)


def graphs() -> Iterator[tuple[str, bytes]]:
    """The diagram of each installed graph."""
    for name in graph_names():
        try:
            yield name, graph_of(name)[0].draw().encode()
        except FlowgraphError as error:
            log.warning("no diagram of %s: %s", name, error)


def written_by_pages(docs: Path) -> Iterator[tuple[str, bytes]]:
    """What the python blocks of some pages write."""
    with tempfile.TemporaryDirectory() as folder:
        for page in RUN:
            module = ModuleType(f"docs_{Path(page).stem}")
            sys.modules[module.__name__] = module
            code = "\n".join(re.findall(r"^```python\n(.*?)^```$", (docs / page).read_text(), re.M | re.S))
            with inside(folder), contextlib.redirect_stdout(None):
                exec(compile(code, page, "exec"), module.__dict__)
        for file in sorted(Path(folder).iterdir()):
            if file.suffix in (".svg", ".png"):
                yield file.name, file.read_bytes()


@contextlib.contextmanager
def inside(folder: str) -> Iterator[None]:
    """Work in a folder for a while."""
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)
