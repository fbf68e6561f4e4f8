"""Where the recordings are that tests may read: $FLOWGRAPH_DATA, or shared/datasets beside the repository."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

DATA = Path(os.environ.get("FLOWGRAPH_DATA", Path(__file__).resolve().parents[2] / "shared" / "datasets"))


def recordings(name: str) -> Path:
    """The folder of a dataset; the test is skipped where it is absent."""
    folder = DATA / name
    if not folder.is_dir():
        pytest.skip(
            f"the recordings of {name} are not here; set FLOWGRAPH_DATA to the folder that holds {name}/"
        )
    return folder
