"""The tutorial notebooks run, in a kernel, and show what they promise; none keeps an output."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

NOTEBOOKS = Path(__file__).resolve().parents[2] / "examples" / "notebooks"
FILES = sorted(NOTEBOOKS.glob("*.ipynb"))
SHOWS = {
    "first_filter": ["the diagram that unfolds", "image/png", "within three deviations"],
    "your_own_data": ["flight", "<progress", "particles", "position.0"],
    "graph_to_c": ["the listing", "all tables", "iframe", "ins_eskf"],
}
"""What stands in the outputs of each."""

nbformat = pytest.importorskip("nbformat", reason="needs nbformat")


def read(file: Path) -> Any:
    return nbformat.read(str(file), as_version=4)


def test_there_are_three() -> None:
    assert {file.stem for file in FILES} == set(SHOWS)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_notebook_is_valid_and_keeps_no_output(file: Path) -> None:
    notebook = read(file)
    nbformat.validate(notebook)
    assert all(not cell.outputs for cell in notebook.cells if cell.cell_type == "code")
    for link in re.findall(r"\]\(([^)#:]+)\)", "".join(c.source for c in notebook.cells)):
        assert (file.parent / link).exists(), link


@pytest.mark.slow
@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_a_notebook_runs_and_shows_what_it_says(file: Path, tmp_path: Path) -> None:
    nbclient = pytest.importorskip("nbclient", reason="needs nbclient")
    pytest.importorskip("ipykernel", reason="needs ipykernel")
    notebook = read(file)
    patience = {"timeout": 300, "startup_timeout": 300}
    nbclient.NotebookClient(notebook, **patience, resources={"metadata": {"path": str(tmp_path)}}).execute()
    shown = nbformat.writes(notebook)
    for words in SHOWS[file.stem]:
        assert words in shown.split('"source"', 1)[-1], words
    texts = [
        out.data.get("text/plain", "")
        for c in notebook.cells
        for out in c.get("outputs", ())
        if "data" in out
    ]
    assert not any(text.startswith("<flowgraph.") for text in texts), (
        "something shows itself as an address only"
    )
