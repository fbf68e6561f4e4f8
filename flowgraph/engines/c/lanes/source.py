"""The C of a pipeline for several runs at once: types, reactions, and the loop over ticks around them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flowgraph.engines.c.entry import reaction_name
from flowgraph.engines.c.file import File
from flowgraph.engines.c.helpers import helper_text
from flowgraph.engines.c.lanes.expressions import TYPES, LaneExpressions, no_lanes
from flowgraph.engines.c.lanes.writer import LaneWriter
from flowgraph.engines.c.names import Names, given, made
from flowgraph.engines.c.nodes import Node
from flowgraph.engines.c.patterns import Pattern
from flowgraph.engines.c.preamble import MACROS, REFUSED
from flowgraph.engines.c.source import MOST_PATTERNS, every_pattern
from flowgraph.engines.c.statements import Writer
from flowgraph.pipeline.pipeline import Cell, Leaf, Pipeline
from flowgraph.pipeline.program import Program
from flowgraph.recorder.replay import Case


@dataclass(frozen=True)
class LaneSource:
    """Generated C of several runs.

    Args:
        names: of everything in it.
        text: of the one file.
        presence: by key, the outputs that are present for certain and those that can be, a bit each.
    """

    names: Names
    text: str
    presence: Mapping[int | None, tuple[int, int]]


def generate_lanes(pipeline: Pipeline, keys: Sequence[int], tidy: Callable[[Program], Program]) -> LaneSource:
    """The C of a pipeline for `WIDTH` runs at once, in double precision.

    Args:
        pipeline: what to write down.
        keys: the patterns of present inputs that come.
        tidy: makes a program shorter.

    Raises:
        NoLanesError: where an operation, or the number of patterns of its inputs, has no form in lanes.
    """
    patterns = every_pattern(pipeline) or sorted(k for k in keys if k)
    if len(patterns) > MOST_PATTERNS:
        raise no_lanes(f"{len(patterns)} patterns of its inputs", pipeline.name)
    file = _LaneFile(pipeline, "double", patterns, tidy, False)
    return LaneSource(file.names, file.text(), file.presence)


class _LaneFile(File):
    writer = LaneWriter

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        self.expressions = LaneExpressions(self.choice)

    def turn(self, name: str, case: Case, sizes: tuple[int, int]) -> str:
        raise no_lanes("a replay", self.pipeline.name)

    def told(self, writer: Writer, flags: list[tuple[int, Node]]) -> list[str]:
        assert isinstance(writer, LaneWriter)
        lines = ["    fg_mask made = fg_mask_of(0);"]
        for k, present in flags:
            if present.op != "const":
                lines.append(f"    made |= {writer.promoted(present)} & fg_mask_of(INT64_C({1 << k}));")
            elif present.extra[0]:
                lines.append(f"    made |= fg_mask_of(INT64_C({1 << k}));")
        return [*lines, "    return made;"]

    def signature(self, pattern: Pattern) -> str:
        return f"static fg_mask {self.called(pattern)}"

    def text(self) -> str:
        assert self.patterns is not None
        reactions = [self.reaction(Pattern.of(key)) for key in self.patterns]
        parts = [
            "#include <math.h>",
            "#include <stdbool.h>",
            "#include <stddef.h>",
            "#include <stdint.h>",
            "",
            REFUSED,
            MACROS,
            PRELUDE,
            helper_text(self.expressions.helpers, self.real),
            *(self._constant(name, b) for name, b in self.constants.values()),
            self._structs(),
            *(text for _, text in self.expressions.functions.values()),
            *reactions,
            self._loop(),
        ]
        return "\n".join(p for p in parts if p is not None).rstrip() + "\n"

    def _structs(self) -> str:
        m, names = self.names.module, self.names
        lines: list[str] = []
        for ports, called, leaves in (
            (self.pipeline.inputs, names.inputs, names.input_leaves),
            (self.pipeline.outputs, names.outputs, names.output_leaves),
        ):
            for port, name, members in zip(ports, called, leaves, strict=True):
                rows = [_member(n, leaf) for n, leaf in zip(members, port.leaves, strict=True)]
                lines += ["typedef struct {", *(rows or ["    fg_mask nothing;"]), f"}} {m}_{name};"]
        lines.append("typedef struct {")
        cells = [c for r in self.pipeline.registers for c in r.cells]
        lines += [_member(n, c) for n, c in zip(self._cell_names(), cells, strict=True)]
        lines.append("    fg_uint seed[2];")  # up to here it is laid out from outside
        lines += [f"    {TYPES[dtype]} {name}[{size}];" for dtype, name, size in self.memory.members()]
        return "\n".join([*lines, f"}} {m}_state;", ""])

    def _loop(self) -> str:
        """What plays a stretch of ticks, and writes what is wanted of each lane to its own place."""
        m, names, outputs = self.names.module, self.names, range(len(self.names.outputs))
        lines = [
            f"size_t fg_size(void) {{ return sizeof({m}_state); }}",
            "void fg_play(void *state, int64_t ticks, const int64_t *time, const int64_t *key,",
            "             const void *const *inputs, void *const *leaves, uint64_t *made, int64_t *counts)",
            "{",
            f"    {m}_state *const s = state;",
            *(f"    const {m}_{n} *in{k} = inputs[{k}];" for k, n in enumerate(names.inputs)),
            *(f"    static _Thread_local {m}_{n} room{k};" for k, n in enumerate(names.outputs)),
            *(f"    {m}_{n} *const {p} = &room{k};" for k, (n, p) in enumerate(
                zip(names.outputs, made(names), strict=True))),
            f"    int64_t count[{max(len(outputs), 1)}][FG_LANES] = {{{{0}}}};",
            "    (void)inputs, (void)leaves, (void)counts, (void)count;",
            "    for (int64_t t = 0; t < ticks; t++) {",
            "        fg_mask there;",
            "        switch (key[t]) {",
        ]  # fmt: skip
        for key in self.patterns or ():
            inputs = [f"in{k}++" for k in range(len(given(names))) if key >> k & 1]
            call = ", ".join(["s", "time[t]", *inputs, *made(names)])
            lines.append(f"        case {key}: there = {reaction_name(Pattern.of(key))}({call}); break;")
        lines += [
            "        default: there = fg_mask_of(0);",
            "        }",
            "        for (int32_t l = 0; l < FG_LANES; l++) made[l * ticks + t] = (uint64_t)there[l];",
        ]
        place = 0
        for k, (port, fields, p) in enumerate(
            zip(self.pipeline.outputs, names.output_leaves, made(names), strict=True)
        ):
            lines.append(f"        const fg_mask there{k} = there >> {k} & 1;")
            for leaf, name in zip(port.leaves, fields, strict=True):
                size = math.prod(leaf.shape)
                if size:
                    vector = f"{'' if leaf.shape else '&'}{p}->{name}"
                    to = f"leaves + FG_LANES * {place}"
                    lines.append(
                        f"        {TYPES[leaf.dtype]}_spread({to}, count[{k}], there{k}, {vector}, {size});"
                    )
                place += 1
            lines.append(f"        for (int32_t l = 0; l < FG_LANES; l++) count[{k}][l] += there{k}[l];")
        lines += [
            "    }",
            f"    for (int32_t l = 0; l < FG_LANES; l++) for (int32_t k = 0; k < {len(outputs)}; k++)",
            f"        counts[{len(outputs)} * l + k] = count[k][l];",
        ]
        return "\n".join([*lines, "}", ""])


def _member(name: str, leaf: Leaf | Cell) -> str:
    size = math.prod(leaf.shape)
    return f"    {TYPES[leaf.dtype]} {name}{f'[{max(size, 1)}]' if leaf.shape else ''};"


def _vectors() -> str:
    """The vector types, and for each how a number is put into all lanes and how one of two is picked."""
    lines = []
    for dtype, name in TYPES.items():
        element = {"real": "double", "bool": "int64_t"}.get(dtype) or f"{dtype}_t"
        width = 4 if dtype.endswith("32") else 8
        lines.append(f"typedef {element} {name} __attribute__((vector_size({width} * FG_LANES)));")
    for dtype, name in TYPES.items():
        element = {"real": "double", "bool": "int64_t"}.get(dtype) or f"{dtype}_t"
        mask = "__builtin_convertvector(m, fg_int)" if dtype.endswith("32") else "m"
        kind = "fg_int" if dtype.endswith("32") else "fg_mask"
        value = "x - (fg_real){0}" if dtype == "real" else f"({name}){{0}} + x"
        lines.append(f"static FG_INLINE {name} {name}_of({element} x) {{ return {value}; }}")
        lines.append(
            f"static FG_INLINE {name} {name}_pick(fg_mask m, {name} yes, {name} no) {{\n"
            f"    const {kind} here = {mask};\n"
            f"    return ({name})((here & ({kind})yes) | (~here & ({kind})no));\n}}"
        )
        kept = "bool" if dtype == "bool" else element
        lines.append(_SPREAD.format(name=name, kept=kept, truth=" != 0" if dtype == "bool" else ""))
    return "\n".join(lines)


_SPREAD = """/* write an output of each lane in which it is there to the row of its own */
static inline void {name}_spread(void *const *leaves, const int64_t *row, fg_mask there, const {name} *from,
                                 int32_t n) {{
    {kept} *to[FG_LANES];
    int32_t wanted = 0;
    for (int32_t l = 0; l < FG_LANES; l++) {{
        to[l] = leaves[l] && there[l] ? ({kept} *)leaves[l] + row[l] * n : NULL;
        wanted += to[l] != NULL;
    }}
    if (wanted == FG_LANES) {{
        {kept} *restrict a = to[0], *restrict b = to[1], *restrict c = to[2], *restrict d = to[3];
        FG_SIMD(omp simd)
        for (int32_t i = 0; i < n; i++) {{
            a[i] = from[i][0]{truth};
            b[i] = from[i][1]{truth};
            c[i] = from[i][2]{truth};
            d[i] = from[i][3]{truth};
        }}
    }} else if (wanted) {{
        for (int32_t l = 0; l < FG_LANES; l++)
            for (int32_t i = 0; to[l] && i < n; i++) to[l][i] = from[i][l]{truth};
    }}
}}"""
WIDTH = 4
"""Lanes: eight, where the processor has vectors that wide, would fill its first cache twice as fast."""

PRELUDE = f"""#define FG_LANES {WIDTH}
{_vectors()}
static FG_INLINE fg_real fg_real_size(fg_real x) {{
    return (fg_real)((fg_ulong)x & fg_ulong_of(UINT64_C(0x7FFFFFFFFFFFFFFF)));
}}
static FG_INLINE bool fg_mask_any(fg_mask m) {{
    int64_t any = 0;
    for (int32_t l = 0; l < FG_LANES; l++) any |= m[l];
    return any != 0;
}}
static FG_INLINE fg_real fg_real_root(fg_real x) {{
    union {{ fg_real all; double one[FG_LANES]; }} a, made;
    a.all = x;
    FG_SIMD(omp simd)
    for (int32_t l = 0; l < FG_LANES; l++) made.one[l] = sqrt(a.one[l]);
    return made.all;
}}
"""
