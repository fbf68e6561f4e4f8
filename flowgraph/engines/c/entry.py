"""The entry of a filter: it calls the reaction of the pattern that is there, and looks at what came of it.

In a program of a user's own nobody else looks: so a queue that was full, and an output that is not finite,
are bits of what the entry returns.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

from flowgraph.engines.c.header import NOT_FINITE, OVERFLOW, react_signature
from flowgraph.engines.c.names import Names, given, made
from flowgraph.pipeline.pipeline import Pipeline


def reaction_name(key: int | None) -> str:
    """Of the function for one pattern of present inputs, or for all."""
    return "fg_react" if key is None else f"fg_react_{key}"


def entry_text(
    pipeline: Pipeline, names: Names, real: str, patterns: Sequence[int] | None, *, checked: bool
) -> str:
    """The function that a program calls; with `checked` it returns the bits of what went wrong, too."""
    checks = list(_checks(pipeline, names)) if checked else []
    lines = [*(_FINITE.format(real=real).splitlines() if any("fg_finite" in c for c in checks) else [])]
    lines += [*react_signature(names, "restrict ").splitlines(), "{"]
    outputs = list(made(names))
    ends = "made = {};" if checks else "return {};"
    if checks:
        lines.append("    uint64_t made;")
    if patterns is None:
        pointers = []
        for k, (n, p) in enumerate(zip(names.inputs, given(names), strict=True)):
            lines.append(f"    static const {names.module}_{n} no_{n} = FG_ZERO;")
            pointers.append(f"((present >> {k}) & 1u) ? {p} : &no_{n}")
        call = ", ".join(["s", "time", "present", *pointers, *outputs])
        lines.append("    " + ends.format(f"{reaction_name(None)}({call})"))
    else:
        lines.append("    switch (present) {")
        for key in patterns:
            inputs = [n for k, n in enumerate(given(names)) if key >> k & 1]
            call = ", ".join(["s", "time", *inputs, *outputs])
            said = ends.format(f"{reaction_name(key)}({call})")
            lines.append(f"    case {key}: {said}{' break;' if checks else ''}")
        lines += ["    default: return 0;", "    }"]
    if checks:
        lines += [*(f"    {c}" for c in checks), "    return made;"]
    return "\n".join([*lines, "}", ""])


def fault_cells(pipeline: Pipeline, names: Names) -> list[str]:
    """For each fault of the pipeline what the cell is called that keeps its time."""
    places = {
        (r.path, c.name): n
        for r, called in zip(pipeline.registers, names.registers, strict=True)
        for c, n in zip(r.cells, called, strict=True)
    }
    return [places[f.register, f.cell] for f in pipeline.faults]


def _checks(pipeline: Pipeline, names: Names) -> Iterator[str]:
    for cell in fault_cells(pipeline, names):
        yield f"if (s->{cell} != INT64_MIN) made |= UINT64_C(1) << {OVERFLOW};"
    for k, (port, out, leaves) in enumerate(
        zip(pipeline.outputs, made(names), names.output_leaves, strict=True)
    ):
        for leaf, name in zip(port.leaves, leaves, strict=True):
            size = math.prod(leaf.shape)
            if leaf.dtype == "real" and size:
                place = f"{out}->{name}" if leaf.shape else f"&{out}->{name}"
                there = f"(made >> {k} & 1u) && !fg_finite({place}, {size})"
                yield f"if ({there}) made |= UINT64_C(1) << {NOT_FINITE};"


_FINITE = """/* 0 times a number is 0, and NaN where it is not finite */
static inline bool fg_finite(const {real} *a, int32_t n) {{
    {real} sum = 0;
    for (int32_t i = 0; i < n; i++) sum += 0 * a[i];
    return sum == 0;
}}
"""
