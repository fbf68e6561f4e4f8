"""Generated C, kept beside the libraries that it was compiled to: what was written once is not written again.

Writing the C of a filter takes longer than loading it: seconds for a large one. A text is kept under a digest
of the lowered graph with all its numbers, of what was asked, and of the code that writes it down. Like a
library it has a digest behind it, and what does not agree with that is written again.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import flowgraph
from flowgraph.data.files import content_of, put
from flowgraph.engines.c.compile import places
from flowgraph.errors import OutputError
from flowgraph.pipeline.digests import graph_digest
from flowgraph.pipeline.pipeline import Pipeline

__all__ = ["kept_text"]

Text = dict[str, Any]
_WRITERS = ("engines/c", "pipeline", "recorder")
_MARK = b"\nflowgraph text, sha256 "


def kept_text(pipeline: Pipeline, stem: str, asked: object, write: Callable[[], Text]) -> Text:
    """What `write` makes of a pipeline, a mapping that JSON can hold; from the cache where it is there.

    Args:
        pipeline: which is written down.
        stem: with which the file's name begins.
        asked: all else that the text depends on, as `repr` tells it.
        write: makes it.
    """
    what = f"{graph_digest(pipeline)} {asked!r} {_writer()}"
    name = f"{stem}-{hashlib.sha256(what.encode()).hexdigest()[:40]}.json"
    with suppress(OutputError):  # whoever compiles says what is wrong with the folder
        for folder in places():
            found = _read(folder / name)
            if found is not None:
                return found
            made = write()
            content = json.dumps(made).encode()
            mark = _MARK + hashlib.sha256(content).hexdigest().encode()
            with suppress(OutputError, OSError):
                folder.mkdir(parents=True, exist_ok=True)
                put(folder / name, content + mark, lasting=False)
            return made
    return write()


def _read(file: Path) -> Text | None:
    try:
        content, mark, digest = content_of(file).rpartition(_MARK)
    except OSError:
        return None
    if not mark or hashlib.sha256(content).hexdigest().encode() != digest:
        return None
    found: Text = json.loads(content)
    return found


@lru_cache(maxsize=1)
def _writer() -> str:
    """A digest of the code that writes C, by the sizes and times of its files."""
    root = Path(flowgraph.__file__).parent
    found = hashlib.sha256()
    for folder in _WRITERS:
        for file in sorted((root / folder).rglob("*.py")):
            status = file.stat()
            found.update(f"{file.relative_to(root)} {status.st_size} {status.st_mtime_ns}\n".encode())
    return found.hexdigest()


def presence_rows(presence: Mapping[int | None, tuple[int, int]]) -> list[list[int | None]]:
    """The presence of outputs by pattern, as JSON holds it; `presence_of_rows` is its inverse."""
    return [[key, must, may] for key, (must, may) in presence.items()]


def presence_of_rows(rows: list[list[Any]]) -> dict[int | None, tuple[int, int]]:
    """See `presence_rows`."""
    return {key: (must, may) for key, must, may in rows}
