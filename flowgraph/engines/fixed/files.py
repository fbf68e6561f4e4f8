"""The fixed-point C of a pipeline as files: `NAME_fixed.c` and a header that says where each word lies.

A caller keeps `w` (begun as a copy of `fx_first`), `off` and `lost`. For each tick it puts the time and the
words of the present inputs into their places, calls `fx_compute` with the pattern of present inputs, reads
the outputs, and calls `fx_end`. A real x goes in as the whole number nearest to x 2^fraction.
"""

from __future__ import annotations

import math

import numpy as np

from flowgraph.engines.fixed.engine import Integers, need_formats
from flowgraph.engines.fixed.shifts import slim
from flowgraph.engines.fixed.source import Source
from flowgraph.errors import LoweringError
from flowgraph.pipeline.formats import FREE, Formats
from flowgraph.pipeline.pipeline import Pipeline

_MOST_INPUTS = 8


def patterns_with_formats(pipeline: Pipeline) -> tuple[list[int], list[int]]:
    """The patterns of present inputs whose values all have formats, and the others.

    Raises:
        LoweringError: where all lack some: the first's.
    """
    cells = [c.reset for r in pipeline.registers for c in r.cells]
    player = Integers(pipeline, cells, np.zeros(2, np.uint32))
    known, unknown = [], []
    first: LoweringError | None = None
    for key in range(1, 2 ** min(len(pipeline.inputs), _MOST_INPUTS)):
        try:
            player.bind(key)
            known.append(key)
        except LoweringError as error:
            first = first or error
            unknown.append(key)
    if not known and first is not None:
        raise first
    return known, unknown


def texts_of(pipeline: Pipeline) -> tuple[Source, dict[str, str]]:
    """A pipeline with formats as C, and the texts of its header and source by file name.

    Raises:
        DeclarationError: where it has no formats.
    """
    known, unknown = patterns_with_formats(need_formats(pipeline))
    source = Source(pipeline, known)
    name = f"{pipeline.name}_fixed"
    texts = {f"{name}.h": _header(source, unknown), f"{name}.c": f"{source.text}\n{_start(source)}"}
    return source, texts


def _start(source: Source) -> str:
    """The words before a run: constants, and registers at their reset."""
    pipeline = source.pipeline
    words = source.first.copy()
    held = [c for r in pipeline.registers for c in r.cells]
    player = Integers(pipeline, [c.reset for c in held], np.zeros(2, np.uint32))
    for c, v in zip(held, player.cells, strict=True):
        flat = np.asarray(v).astype(np.int64).ravel()
        words[source.place[c.read] : source.place[c.read] + flat.size] = flat
    return f"const int64_t fx_first[FX_SIZE] = {{{', '.join(map(_literal, words.tolist()))}}};\n"


def _literal(n: int) -> str:
    """A 64-bit integer as C has it: the least is no literal."""
    if -(2**31) < n < 2**31:
        return str(n)
    return f"INT64_C({n})" if n > -(2**63) else f"(-INT64_C({2**63 - 1}) - 1)"


def _header(source: Source, unknown: list[int]) -> str:
    pipeline = source.pipeline
    guard = f"{pipeline.name.upper()}_FIXED_H"
    player = Integers(
        pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32)
    )
    lines = [
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <stdint.h>",
        "",
        f"/* {pipeline.name} in fixed point of {_bits(player.formats)} bits.",
        "   A real x is the whole number nearest to x 2^fraction.",
        "   Words lie in w, each value row by row from its place on; begin with a copy of fx_first. */",
        f"enum {{ FX_WORDS = {source.size}, FX_COUNTERS = {len(source.lost)} }};",
        f"enum {{ FX_TIME = {source.place[pipeline.time]} }}; /* of the tick, ns */",
        f"enum {{ FX_RANDOM_SEED = {source.place[pipeline.seed]} }}; /* two words of 32 bits, low first */",
        "extern const int64_t fx_first[FX_WORDS];",
        "/* w[FX_WORDS], off[FX_WORDS + 1] and lost[FX_COUNTERS + 1], the last two zeros at first. off is 1",
        "   where a word was cut, 2 where it was divided by zero; lost counts words that became zero.",
        "   key: bit k tells that input k is present. Both return 1 for a pattern that has no formats. */",
        "int fx_compute(int64_t *w, uint8_t *off, int64_t *lost, int key);",
        "int fx_end(int64_t *w, uint8_t *off, int64_t *lost, int key);",
        "",
    ]
    for k, port in enumerate(pipeline.inputs):
        for leaf in port.leaves:
            fraction = player.formats.fractions.get(leaf.value) if leaf.dtype == "real" else None
            name = f"input {k} {port.name}.{leaf.name}"
            lines.append(_place(name, source.place[leaf.value], leaf.shape, leaf.dtype, fraction))
    for key, bound in zip(source.keys, source.bound, strict=True):
        for port, (flag, leaves) in zip(pipeline.outputs, bound.program.outputs, strict=True):
            if flag is None:
                continue
            lines.append(
                f"/* key {key}: output {port.name} is there where w[{source.place[flag]}] is not 0 */"
            )
            for leaf, n in zip(port.leaves, leaves, strict=True):
                fraction = bound.fractions.get(n)
                name = f"key {key}: output {port.name}.{leaf.name}"
                lines.append(_place(name, source.place[n], leaf.shape, leaf.dtype, fraction))
    if unknown:
        lines.append(f"/* patterns without formats: {', '.join(map(str, unknown))} */")
    return "\n".join([*lines, "", "#endif", ""])


def _bits(formats: Formats) -> str:
    held = f", registers and what is added up in them {formats.held_width}" if formats.held else ""
    return f"{formats.width}{held}"


def _place(name: str, place: int, shape: tuple[int, ...], dtype: str, fraction: np.ndarray | None) -> str:
    """A line of the header: where a value lies, and the fraction of each element."""
    what = dtype
    if fraction is not None:
        slimmed = slim(np.where(fraction == FREE, 0, fraction))
        what = f"fraction {', '.join(map(str, slimmed.ravel().tolist()))}"
    return f"/* {name} {list(shape)}: w[{place}] .. w[{place + max(math.prod(shape), 1) - 1}], {what} */"
