"""Number formats in a folder, and put on the pipeline that they are for.

`flowgraph quantise -o DIR` writes `formats.json`: the formats, what they are worth, and for a person a list
of all values with their lines. Formats hold value numbers, so they are for one structure of a pipeline: the
same graph with the same settings, on any flight.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from flowgraph.data.files import put, text_of
from flowgraph.errors import DataError, DeclarationError, writes
from flowgraph.pipeline.digests import digest, structure
from flowgraph.pipeline.formats import Formats
from flowgraph.pipeline.pipeline import Pipeline
from flowgraph.pipeline.plain import plain

FILE = "formats.json"
_FORMAT, _VERSION = "flowgraph-formats", 1


def structure_of(pipeline: Pipeline) -> str:
    """A digest of what formats of a plain pipeline depend on: not its name, and not its real constants."""
    return digest(structure(replace(pipeline, name="")))


def with_formats(pipeline: Pipeline, formats: Formats) -> Pipeline:
    """The pipeline in plain instructions, with these formats.

    Raises:
        DeclarationError: where they were found for another pipeline.
        LoweringError: where a value has no plain form.
    """
    made = plain(pipeline)
    found = structure_of(made)
    if formats.structure not in ("", found):
        raise DeclarationError(
            "these number formats are for another graph, or for other settings of this one",
            path=pipeline.name,
            expected=f"formats of structure {found}",
            got=formats.structure,
            fix="find them for this one: flowgraph quantise GRAPH --data SPEC --set ... -o DIR",
        )
    return replace(made, formats=formats)


def save_formats(
    folder: str | Path, graph: str, formats: Formats, report: Mapping[str, Any], values: list[dict[str, Any]]
) -> Path:
    """Write `formats.json` into a folder, which is made if missing; returns the file.

    Args:
        folder: where to.
        graph: its name.
        formats: to write.
        report: plain values, what they are worth.
        values: for a person, a row a value.

    Raises:
        OutputError: where it cannot be written.
    """
    head = {"format": _FORMAT, "version": _VERSION, "graph": graph, "report": dict(report)}
    file = Path(folder) / FILE
    with writes(file):
        file.parent.mkdir(parents=True, exist_ok=True)
        put(file, json.dumps({**head, "values": values, **formats.to_json()}) + "\n")
    return file


def load_formats(folder: str | Path) -> Formats:
    """The formats that a folder, or the file itself, holds.

    Raises:
        DataError: where it holds none.
    """
    file = Path(folder)
    file = file / FILE if file.is_dir() else file
    try:
        data = json.loads(text_of(file))
        if (data["format"], data["version"]) != (_FORMAT, _VERSION):
            raise ValueError(f"format {data['format']!r}, version {data['version']!r}")
        return Formats.from_json(data)
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise DataError(
            "no number formats can be read here",
            path=str(file),
            expected=f"a {FILE} written by flowgraph quantise -o DIR",
            got=f"{type(error).__name__}: {error}"[:200],
            fix="flowgraph quantise GRAPH --data SPEC -o DIR",
        ) from None
