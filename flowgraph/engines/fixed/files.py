"""The fixed-point C of a pipeline as files: `NAME_fixed.c` and a header that says where each word lies.

A caller keeps `v` and `w`, which `fx_begin` begins, and `count`. For each tick it puts the time and the words
of the present inputs into their places, calls `fx_compute` with the pattern of present inputs, reads the
outputs, and calls `fx_end`. A real x goes in as the whole number nearest to x 2^fraction.
"""

from __future__ import annotations

import math

import numpy as np

from flowgraph.engines.fixed.engine import Integers, need_formats
from flowgraph.engines.fixed.places import KNOWN, KNOWN_SMALL, Place
from flowgraph.engines.fixed.shifts import slim
from flowgraph.engines.fixed.standalone import Standalone
from flowgraph.errors import LoweringError
from flowgraph.pipeline.format_words import wider_words
from flowgraph.pipeline.formats import FREE
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


def texts_of(pipeline: Pipeline) -> tuple[Standalone, dict[str, str]]:
    """A pipeline with formats as C, and the texts of its header and source by file name.

    Raises:
        DeclarationError: where it has no formats.
    """
    known, unknown = patterns_with_formats(need_formats(pipeline))
    source = Standalone(pipeline, known)
    name = f"{pipeline.name}_fixed"
    return source, {f"{name}.h": _header(source, unknown), f"{name}.c": source.text}


def _header(source: Standalone, unknown: list[int]) -> str:
    pipeline = source.pipeline
    guard = f"{pipeline.name.upper()}_FIXED_H"
    player = Integers(
        pipeline, [c.reset for r in pipeline.registers for c in r.cells], np.zeros(2, np.uint32)
    )
    formats = player.formats
    (_, time), (_, seed) = (source.held(n) for n in (pipeline.time, pipeline.seed))
    lines = [
        f"#ifndef {guard}",
        f"#define {guard}",
        "#include <stdint.h>",
        "",
        f"/* {pipeline.name} in fixed point of {formats.width} bits{wider_words(formats)}.",
        "   A real x is the whole number nearest to x 2^fraction.",
        "   Words lie in v and w, each value row by row from its place on. */",
        f"enum {{ FX_SMALL = {max(source.sizes['v'], 1)}, FX_WIDE = {max(source.sizes['w'], 1)} }};",
        f"enum {{ FX_TIME = {time} }}; /* of the tick, ns, in w */",
        f"enum {{ FX_RANDOM_SEED = {seed} }}; /* two words of 32 bits in w, low first */",
        "/* v[FX_SMALL], w[FX_WIDE] and count[3]: words that were cut, quotients by zero, and words that",
        "   became zero, so far. fx_begin puts the registers to their reset.",
        "   key: bit k tells that input k is present. Both return 1 for a pattern that has no formats. */",
        "void fx_begin(int32_t *v, int64_t *w);",
        "int fx_compute(int32_t *v, int64_t *w, int64_t *count, int key);",
        "int fx_end(int32_t *v, int64_t *w, int64_t *count, int key);",
        "",
    ]
    for k, port in enumerate(pipeline.inputs):
        for leaf in port.leaves:
            fraction = player.formats.fractions.get(leaf.value) if leaf.dtype == "real" else None
            name = f"input {k} {port.name}.{leaf.name}"
            lines.append(_place(name, source.held(leaf.value), leaf.shape, leaf.dtype, fraction))
    for key, bound in zip(source.keys, source.bound, strict=True):
        for port, (flag, leaves) in zip(pipeline.outputs, bound.program.outputs, strict=True):
            if flag is None:
                continue
            array, place = source.end(key, flag)
            there = (
                "always there" if array in (KNOWN, KNOWN_SMALL) else f"there where {array}[{place}] is not 0"
            )
            lines.append(f"/* key {key}: output {port.name} is {there} */")
            for leaf, n in zip(port.leaves, leaves, strict=True):
                fraction = bound.fractions.get(n)
                name = f"key {key}: output {port.name}.{leaf.name}"
                lines.append(_place(name, source.end(key, n), leaf.shape, leaf.dtype, fraction))
    if unknown:
        lines.append(f"/* patterns without formats: {', '.join(map(str, unknown))} */")
    return "\n".join([*lines, "", "#endif", ""])


def _place(name: str, at: Place, shape: tuple[int, ...], dtype: str, fraction: np.ndarray | None) -> str:
    """A line of the header: where a value lies, and the fraction of each element."""
    what = dtype
    if fraction is not None:
        slimmed = slim(np.where(fraction == FREE, 0, fraction))
        what = f"fraction {', '.join(map(str, slimmed.ravel().tolist()))}"
    array, place = at
    last = place + max(math.prod(shape), 1) - 1
    return f"/* {name} {list(shape)}: {array}[{place}] .. {array}[{last}], {what} */"
