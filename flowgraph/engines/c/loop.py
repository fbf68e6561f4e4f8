"""The loop over ticks that the C engine puts around a filter: one call plays a whole stretch of them.

A filter makes each output as a struct. That stays in one place, in the cache, and those of its leaves that
are asked for are copied from there to arrays of their own: a row for each tick in which it is present.
"""

from __future__ import annotations

import math

from flowgraph.engines.c.source import Source
from flowgraph.pipeline.pipeline import Pipeline


def loop_text(pipeline: Pipeline, source: Source) -> str:
    """C that plays a stretch of ticks.

    `leaves` has a pointer for each leaf of each output, null where it is not wanted; `counts` is set to how
    many rows each output has, and bit k of `made[t]` where output k is present in tick t.
    """
    names = source.names
    m, outputs = names.module, range(len(names.outputs))
    given = [f"present >> {k} & 1u ? in{k}++ : NULL" for k in range(len(names.inputs))]
    call = ", ".join(["s", "time[t]", "present", *given, *(f"out{k}" for k in outputs)])
    lines = [
        f'#include "{m}.h"',
        "#include <stddef.h>",
        "#include <string.h>",
        f"size_t fg_size(void) {{ return sizeof({m}_state); }}",
        "void fg_play(void *state, int64_t ticks, const int64_t *time, const int64_t *key,",
        "                    const void *const *inputs, void *const *outputs, char *const *leaves,",
        "                    uint64_t *made, int64_t *counts)",
        "{",
        f"    {m}_state *const s = state;",
        *(f"    const {m}_{n} *in{k} = inputs[{k}];" for k, n in enumerate(names.inputs)),
        *(f"    {m}_{n} *const out{k} = outputs[{k}];" for k, n in enumerate(names.outputs)),
        *(f"    int64_t n{k} = 0;" for k in outputs),
        "    (void)inputs, (void)outputs, (void)leaves, (void)counts;",
        "    for (int64_t t = 0; t < ticks; t++) {",
        "        const uint64_t present = (uint64_t)key[t];",
        f"        const uint64_t there = made[t] = {m}_react({call});",
        "        (void)there;",
    ]
    place = 0
    for k, (port, fields) in enumerate(zip(pipeline.outputs, names.output_leaves, strict=True)):
        lines.append(f"        if (there >> {k} & 1u) {{")
        for leaf, name in zip(port.leaves, fields, strict=True):
            if math.prod(leaf.shape):
                row, size = f"leaves[{place}]", f"sizeof out{k}->{name}"
                lines += [
                    f"            if ({row})",
                    f"                memcpy({row} + n{k} * {size}, &out{k}->{name}, {size});",
                ]
            place += 1
        lines += [f"            n{k}++;", "        }"]
    lines += ["    }", *(f"    counts[{k}] = n{k};" for k in outputs)]
    return "\n".join([*lines, "}", ""])
