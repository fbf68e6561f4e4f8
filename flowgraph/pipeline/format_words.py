"""Number formats in words, for diagrams and reports: a line for each input, block and register."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from flowgraph.pipeline.formats import FREE, Formats
from flowgraph.pipeline.pipeline import Pipeline


def formats_by_path(pipeline: Pipeline) -> dict[str, str]:
    """The words of a pipeline with formats: by the path of an input, block or register; under "" the whole's.

    A fraction f says that the last bit of a word is worth 2^-f.
    """
    formats = pipeline.formats
    if formats is None:
        return {}
    found = {"": f"words of {formats.width} bits" + wider_words(formats)}
    for port in pipeline.inputs:
        found[port.name] = _words(formats, (leaf.value for leaf in port.leaves))
    for stage in pipeline.stages:
        found[stage.path] = _words(formats, (i.out for i in stage.instructions))
    for register in pipeline.registers:
        found[register.path] = _words(formats, (c.read for c in register.cells))
    return {path: words for path, words in found.items() if words}


def wider_words(formats: Formats) -> str:
    """How many values have wider words, by bits: ", 97 values of 32, 337 of 44"; empty where none has."""
    rows = [f"{len(values)} of {bits}" for bits, values in formats.by_width().items()]
    return f", wider ones: {', '.join(rows)}" if rows else ""


def _words(formats: Formats, values: Iterable[int]) -> str:
    """The widths and the coarsest and finest fraction of some values; empty where none is real."""
    known = [n for n in values if n in formats.fractions]
    fractions = np.concatenate([np.zeros(0, np.int64), *(np.ravel(formats.fractions[n]) for n in known)])
    fractions = fractions[fractions != FREE]
    if not fractions.size:
        return ""
    widths = sorted({formats.width_of(n) for n in known})
    low, high = int(fractions.min()), int(fractions.max())
    ends = str(low) if low == high else f"{low} to {high}"
    return f"{' and '.join(map(str, widths))} bits, fraction {ends}"
